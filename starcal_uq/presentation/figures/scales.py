"""How a parameter is put on an axis: value minus a printed reference, in a unit that keeps tick
labels short.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.camera.distortion import Parameter
from starcal_uq.core.formatting import decimals_for, fixed, pretty_unit, superscript
from starcal_uq.core.types import FloatArray, floats

if TYPE_CHECKING:
    from matplotlib.colors import Normalize


_WIDE = 5.0
_LEVELS_NAMED = 8
# Letters of a symbol with its number.
_LONGEST = 2


@dataclass(frozen=True)
class AxisScale:
    """The axis of one parameter.

    Attributes
    ----------
    reference : float
        What is subtracted, in computation units; rounded, so that the printed number is exact.
    factor : float
        Plotted number = (value - reference) / factor.
    label, title : str
        For the axis, and for the panel ("estimate +- sigma unit").
    """

    reference: float
    factor: float
    label: str
    title: str

    def __call__(self, values: FloatArray | float) -> FloatArray:
        """Computation units to plotted numbers."""
        return np.asarray((floats(values) - self.reference) / self.factor)


_SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
_GREEK = {"sigma": "σ", "sigma_scale": r"$s_\sigma$"}


def symbol(name: str) -> str:
    """A parameter's name as a symbol for labels, such as k₁; other names as they are.

    Typesetting the mathematics of all labels would take a tenth of the time of all figures.
    """
    if name in _GREEK:
        return _GREEK[name]
    return name.translate(_SUBSCRIPTS) if len(name) <= _LONGEST else name


def axis_scale(parameter: Parameter, estimate: float, sigma: float) -> AxisScale:
    """Choose the reference and the unit from the estimate and its standard deviation (computation
    units).
    """
    value, spread = estimate / parameter.scale, sigma / parameter.scale
    decimals = decimals_for(spread)
    text = fixed(value, decimals)
    rounded = round(value, decimals)
    title = (
        f"{symbol(parameter.name)} = {_with_unit(f'{text} ± {fixed(spread, decimals)}', parameter)}"
    )
    exponent = 3 * round(math.log10(spread) / 3.0) if 0.0 < spread < 0.01 else 0
    power = 10.0**exponent
    unit = pretty_unit(parameter.scaled_unit)
    if exponent:
        total = exponent + round(math.log10(parameter.scale))
        unit = f"10{superscript(total)} {pretty_unit(parameter.unit)}".strip()
    sign = "+" if rounded < 0 else "−"
    suffix = f" [{unit}]" if unit else ""
    label = f"{symbol(parameter.name)} {sign} {text.lstrip('−')}{suffix}"
    return AxisScale(rounded * parameter.scale, parameter.scale * power, label, title)


def _with_unit(text: str, parameter: Parameter) -> str:
    unit = pretty_unit(parameter.scaled_unit)
    return f"({text}) × {unit}" if parameter.scale != 1.0 else f"{text} {unit}".strip()


def round_below(value: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above a value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= value))


def round_levels(values: FloatArray) -> tuple[FloatArray, Normalize | None]:
    """Round levels; in equal ratios where the map spans more than a factor of five, else a few
    would hold it all.
    """
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import MaxNLocator

    low, high = float(np.min(values)), float(np.max(values))
    if low > 0.0 and high > _WIDE * low:
        decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
        steps = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0) if high < 50.0 * low else (1.0, 2.0, 5.0)
        candidates = np.outer(decades, steps).ravel()
        first = int(np.searchsorted(candidates, low * (1.0 + 1e-9), side="right")) - 1
        last = int(np.searchsorted(candidates, high * (1.0 - 1e-9)))
        levels = candidates[first : last + 1]
        return levels, LogNorm(float(levels[0]), float(levels[-1]))
    if high - low <= 1e-9 * abs(high):
        # A map without relief still needs two levels to be filled.
        low, high = low - 0.05 * abs(low) - 1e-12, high + 0.05 * abs(high) + 1e-12
    return floats(MaxNLocator(10).tick_values(low, high)), None


def ticks_at_levels(bar: Any, levels: FloatArray) -> None:
    """Ticks of a colour bar at its levels, all of them or every second, third..., in plain
    numbers.
    """
    from matplotlib.ticker import FuncFormatter

    bar.set_ticks(levels[:: -(-len(levels) // _LEVELS_NAMED)])
    bar.formatter = FuncFormatter(lambda value, _: f"{value:.6g}")
    bar.update_ticks()
    bar.ax.minorticks_off()
