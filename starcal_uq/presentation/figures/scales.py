"""How a parameter is put on an axis: value minus a printed reference, in a unit that keeps tick labels short."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from starcal_uq.camera.distortion import Parameter
from starcal_uq.core.formatting import decimals_for, fixed, pretty_unit, superscript
from starcal_uq.core.types import FloatArray


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
        return np.asarray((np.asarray(values, dtype=np.float64) - self.reference) / self.factor)


def axis_scale(parameter: Parameter, estimate: float, sigma: float) -> AxisScale:
    """Choose the reference and the unit from the estimate and its standard deviation (computation units)."""
    value, spread = estimate / parameter.scale, sigma / parameter.scale
    decimals = decimals_for(spread)
    text = fixed(value, decimals)
    rounded = round(value, decimals)
    title = f"{parameter.latex} = {_with_unit(f'{text} ± {fixed(spread, decimals)}', parameter)}"
    exponent = 3 * round(math.log10(spread) / 3.0) if 0.0 < spread < 0.01 else 0
    power = 10.0**exponent
    unit = pretty_unit(parameter.scaled_unit)
    if exponent:
        total = exponent + round(math.log10(parameter.scale))
        unit = f"10{superscript(total)} {pretty_unit(parameter.unit)}".strip()
    sign = "+" if rounded < 0 else "−"
    suffix = f" [{unit}]" if unit else ""
    label = f"{parameter.latex} {sign} {text.lstrip('−')}{suffix}"
    return AxisScale(rounded * parameter.scale, parameter.scale * power, label, title)


def _with_unit(text: str, parameter: Parameter) -> str:
    unit = pretty_unit(parameter.scaled_unit)
    return f"({text}) × {unit}" if parameter.scale != 1.0 else f"{text} {unit}".strip()
