"""What Ye & Yang (2017) print about their simulated experiment, each number once and with its
place.

Ye Tao, Yang Fei: "Autonomous calibration of star sensors based on nonlinear optimization
algorithm", Optics and Precision Engineering 25(9), 2483-2489, doi 10.3788/OPE.20172509.2483.
Numbers are kept as printed: how many digits an author gives is part of what is claimed.
"""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal

LEAST_SQUARES, SAMAAN, PROPOSED = "least_squares", "samaan", "three_stage"
# Rows of their Table 2, in order, as methods of `calibrate`.
PAPER_METHODS = (LEAST_SQUARES, SAMAAN, PROPOSED)


@dataclass(frozen=True)
class Printed:
    """A number of the paper, as text, with its place.

    The method is a name in `calibrate`; the quantity is ``f_mm``, ``x0_px``, ``y0_px``, ``k1``,
    ``k2`` (px^-2, px^-4), ``reprojection_px``, ``max_residual_px`` or ``y0_error_px``.
    """

    method: str
    quantity: str
    text: str
    place: str

    @property
    def value(self) -> float:
        """The number."""
        return float(self.text)

    @property
    def unit_in_last_place(self) -> float:
        """Place value of the last digit printed."""
        return float(Decimal(1).scaleb(int(Decimal(self.text).as_tuple().exponent)))

    @property
    def is_error_size(self) -> bool:
        """Whether it is the size of an error: never negative, and compared on a logarithmic
        scale.
        """
        return self.quantity in ("reprojection_px", "max_residual_px", "y0_error_px")


_QUANTITIES = ("f_mm", "x0_px", "y0_px", "k1", "k2", "reprojection_px")
_ROWS = (
    ("70.2122", "500.09", "527.70", "", "", "0.0567"),
    ("70.2293", "500.18", "531.23", "2.76e-10", "-1.88e-15", "0.0379"),
    ("70.2259", "500.03", "530.09", "2.14e-10", "-3.56e-15", "0.0038"),
)
TABLE_2: tuple[Printed, ...] = tuple(
    Printed(method, quantity, text, f"Table 2, row {number}")
    for number, (method, row) in enumerate(zip(PAPER_METHODS, _ROWS, strict=True), 1)
    for quantity, text in zip(_QUANTITIES, row, strict=True)
    if text
)
PUBLISHED: tuple[Printed, ...] = (
    *TABLE_2,
    Printed(PROPOSED, "y0_error_px", "0.13", "section 3.2"),
    Printed(SAMAAN, "k1", "3.09e-10", "section 3.3"),
    Printed(SAMAAN, "k2", "-1.23e-15", "section 3.3"),
    Printed(PROPOSED, "k1", "1.732e-10", "section 3.3"),
    Printed(PROPOSED, "k2", "-3.449e-15", "section 3.3"),
    Printed(LEAST_SQUARES, "max_residual_px", "0.81", "section 3.3, Fig. 4"),
    Printed(SAMAAN, "max_residual_px", "0.12", "section 3.3, Fig. 5"),
    Printed(PROPOSED, "max_residual_px", "0.015", "section 3.3, Fig. 6; abstract; conclusion"),
)

# Section 3: what was simulated.
N_FRAMES, MIN_STARS, SIGMA_PX, MAX_MAG, N_STARS = 1000, 10, 0.05, 6.0, 5103
# "Two orders of magnitude" more precise than the other methods: abstract, section 3.3, conclusion.
CLAIMED_RATIO = 100.0
# The error of y0 of both other methods "exceeds 2 to 3 pixels": section 3.2.
CLAIMED_Y0_ERROR_PX = (2.0, 3.0)


def printed(method: str, quantity: str, place: str = "") -> Printed:
    """The printed number of a method and quantity; the first whose place starts as given. A
    KeyError where none is.
    """
    for number in PUBLISHED:
        if (number.method, number.quantity) == (method, quantity) and number.place.startswith(
            place
        ):
            return number
    raise KeyError(f"the paper prints no {quantity} of {method}{' in ' + place if place else ''}.")
