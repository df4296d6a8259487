"""Numbers and units as people read them: digits end where the uncertainty begins."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

MINUS = "\N{MINUS SIGN}"
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def superscript(exponent: int) -> str:
    """An integer in superscript characters."""
    return str(exponent).translate(_SUPERSCRIPTS)


def pretty_unit(unit: str) -> str:
    """A unit as printed: ``1e-10 px^-2`` becomes ``10⁻¹⁰ px⁻²``; the unit 1 is left out."""
    if unit == "1":
        return ""
    text = re.sub(r"\b1e([+-]?\d+)", lambda m: "10" + superscript(int(m[1])), unit)
    return re.sub(r"\^(-?\d+)", lambda m: superscript(int(m[1])), text)


def decimals_for(sigma: float, digits: int = 2) -> int:
    """Decimals that show `sigma` with `digits` significant digits (0 for large, zero or infinite
    sigmas).
    """
    if not (math.isfinite(sigma) and sigma > 0.0):
        return 0
    exponent = int(f"{sigma:.{digits - 1}e}".partition("e")[2])
    return max(0, digits - 1 - exponent)


def fixed(value: float, decimals: int) -> str:
    """A number with this many decimals, a true minus sign, and no negative zero."""
    if math.isnan(value):
        return "not known"
    if math.isinf(value):
        return "∞" if value > 0 else MINUS + "∞"
    text = f"{value:.{decimals}f}"
    if float(text) == 0.0:
        text = text.lstrip("-")
    return text.replace("-", MINUS)


def with_sigma(value: float, sigma: float, digits: int = 2) -> str:
    """`value` with the digits that `sigma` leaves significant.

    Examples
    --------
    >>> with_sigma(499.87234, 0.1512)
    '499.87'
    """
    if not (math.isfinite(sigma) and sigma > 0.0):
        return significant(value, 6)
    if sigma < 1e-6:
        return significant(value, 6)
    return fixed(value, decimals_for(sigma, digits))


def plus_minus(value: float, sigma: float) -> str:
    """`value` with the digits that `sigma` leaves significant, and sigma.

    Examples
    --------
    >>> plus_minus(499.87234, 0.1512)
    '499.87 ± 0.15'
    """
    return f"{with_sigma(value, sigma)} ± {significant(sigma)}"


def significant(value: float, digits: int = 2) -> str:
    """A number with `digits` significant digits, with a power of ten where zeros would pile up."""
    if value == 0.0 or not math.isfinite(value):
        return fixed(value, 0)
    mantissa, _, exponent_text = f"{value:.{digits - 1}e}".partition("e")
    exponent = int(exponent_text)
    if -4 <= exponent < max(digits, 6):
        return fixed(float(f"{value:.{digits - 1}e}"), max(0, digits - 1 - exponent))
    return f"{mantissa.replace('-', MINUS)}×10{superscript(exponent)}"


# Where a tail means nothing any more.
SMALLEST_P = 1e-12


def p_value(p: float, least: float = SMALLEST_P) -> str:
    """``0.31``, or a bound where p is nearer to 0 than `least` can tell, or to 1 than the
    digits.
    """
    if p < least:
        return f"< {significant(least, 1).removeprefix('1×')}"
    return f"> {1.0 - least:.3g}" if p > 1.0 - least and least > SMALLEST_P else significant(p)


def p_words(p: float, least: float = SMALLEST_P) -> str:
    """``p = 0.31``, or a bound as of `p_value`."""
    text = p_value(p, least)
    return f"p {text}" if text[0] in "<>n" else f"p = {text}"


def percent(fraction: float, digits: int = 2) -> str:
    """A fraction in per cent."""
    return f"{significant(100.0 * fraction, digits)}\N{NO-BREAK SPACE}%"


def count(number: int) -> str:
    """An integer with thousands separated by a thin, unbreakable space."""
    return f"{number:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def plural(number: int, singular: str, plural_form: str | None = None) -> str:
    """``1 frame``, ``2 frames``."""
    word = singular if number == 1 else (plural_form or singular + "s")
    return f"{count(number)} {word}"


def join_words(words: Sequence[str]) -> str:
    """``a, b and c``."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} and {words[-1]}"
