"""Ideal projections: from a direction to a point in units of length, and back.

Each is written in plain arithmetic, so that the same function serves CasADi symbols and numbers, and
is smooth at the boresight: no branch, and no division by the angle from it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

# Angles are halved so often before a series, whose terms then fall below rounding.
_HALVINGS = 3
_TERMS = 9


@dataclass(frozen=True)
class Plane:
    """One ideal projection.

    Attributes
    ----------
    name : str
        Its name.
    bare : str
        Name of the distortion model without distortion.
    onto : callable
        ``(b, f) -> (u, v)``: point of a direction, which need not be a unit vector.
    back : callable
        ``(u, v, f) -> (b_x, b_y, b_z)``: direction of a point, of any length.
    radius, angle : callable
        Distance from the principal point in units of f of an angle from the boresight (rad), and
        the other way round.
    limit_rad : float
        Largest angle from the boresight; the pinhole does not reach it.
    """

    name: str
    bare: str
    onto: Callable[[Any, Any], tuple[Any, Any]]
    back: Callable[[Any, Any, Any], tuple[Any, Any, Any]]
    radius: Callable[[float], float]
    angle: Callable[[float], float]
    limit_rad: float


def _onto_pinhole(b: Any, f: Any) -> tuple[Any, Any]:
    return f * b[0] / b[2], f * b[1] / b[2]


def _back_from_pinhole(u: Any, v: Any, f: Any) -> tuple[Any, Any, Any]:
    return u, v, f


def _onto_equidistant(b: Any, f: Any) -> tuple[Any, Any]:
    """Point at distance f t for a direction t rad from the boresight.

    With w = tan^2(t / 2), t / sin t = (1 + w) atan(sqrt w) / sqrt w, which is a function of w
    alone: atan x = 2 atan(x / (1 + sqrt(1 + x^2))) until the series of atan converges at once.
    """
    square = b[0] * b[0] + b[1] * b[1]
    length = (square + b[2] * b[2]) ** 0.5
    w = square / ((length + b[2]) * (length + b[2]))
    scale = 2.0 * f / (length + b[2])
    for _ in range(_HALVINGS):
        root = 1.0 + (1.0 + w) ** 0.5
        scale, w = 2.0 * scale / root, w / (root * root)
    series: Any = 0.0
    for n in reversed(range(_TERMS)):
        series = 1.0 / (2 * n + 1) - w * series
    return scale * series * b[0], scale * series * b[1]


def _back_from_equidistant(u: Any, v: Any, f: Any) -> tuple[Any, Any, Any]:
    """Unit vector of a point; sine and cosine of the angle as series in its square, which is
    halved first: sin 2x / 2x = cos x sin x / x, and 1 - cos 2x = 2 y (2 - y) of y = 1 - cos x.
    """
    x, y = u / f, v / f
    square = (x * x + y * y) / 4.0**_HALVINGS
    sine: Any = 0.0
    versed: Any = 0.0
    for n in reversed(range(_TERMS)):
        sine = 1.0 / math.factorial(2 * n + 1) - square * sine
        versed = 1.0 / math.factorial(2 * n + 2) - square * versed
    versed = square * versed
    for _ in range(_HALVINGS):
        sine, versed = sine * (1.0 - versed), 2.0 * versed * (2.0 - versed)
    return sine * x, sine * y, 1.0 - versed


PINHOLE = Plane(
    "pinhole", "none", _onto_pinhole, _back_from_pinhole, math.tan, math.atan, math.pi / 2
)
# The series hold to rounding up to 150 degrees.
EQUIDISTANT = Plane(
    "equidistant",
    "f_theta",
    _onto_equidistant,
    _back_from_equidistant,
    lambda angle: angle,
    lambda radius: radius,
    math.radians(150.0),
)
