"""The one rule for the level of a check of the model: it fails where the misfit does more than is
stated.

Residuals of many stars show what is too small to matter. So what a misfit does to parameters,
directions and attitudes is compared with their stated standard deviations: up to one of these the
check warns, beyond that the numbers are wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.constants import AXES
from starcal_uq.core.status import Level
from starcal_uq.core.types import AnyDict
from starcal_uq.likelihood.shapes import IN_FIELD

if TYPE_CHECKING:
    from starcal_uq.core.types import FloatArray
    from starcal_uq.diagnostics.misfit import MisfitTest
    from starcal_uq.diagnostics.pattern import Pattern
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.propagation.attitude_error import AttitudeError

# What keeps its place in the field bends directions; so does a scale of each frame's own, whose
# mean no frame shows.
_BENDING = (*IN_FIELD, "frame")


@dataclass(frozen=True)
class Effect:
    """The largest thing that a misfit does, in stated standard deviations."""

    on: str  # A parameter, directions, or an axis of the attitude
    size: float

    @property
    def level(self) -> Level:
        """A failure where it is off by more than is stated, else a warning."""
        return Level.FAIL if self.size > 1.0 else Level.WARN

    @property
    def facts(self) -> AnyDict:
        """The effect among the values of a check."""
        return {"effect_on": self.on, "effect_sigma": self.size}


def largest(effects: Sequence[Effect]) -> Effect:
    """The effect that decides."""
    return max(effects, key=lambda effect: effect.size, default=Effect("nothing", 0.0))


def on_directions(noncentrality: float, n_parameters: int) -> Effect:
    """Effect of a displacement of the field whose square, summed over the stars in units of the
    noise, is this.

    Over the stars of the fit, the stated variances of directions, a best attitude removed, add up
    to one unit of the noise for each parameter.
    """
    return Effect(
        "directions over the field", float(np.sqrt(max(noncentrality, 0.0) / n_parameters))
    )


def of_pattern(
    pattern: Pattern | None, found: Sequence[MisfitTest], cal: Calibration
) -> list[Effect]:
    """Effects on parameters and directions of a pattern, and of these tests, which rejected.

    Where there is no pattern, as in a diagnosis of an earlier version, the tests stand for it.
    """
    effects, absorbed = [], 0.0
    if pattern is not None and pattern.amplitudes.size:
        taken = pattern.parameters / cal.sigmas
        shifts = taken.T @ pattern.products @ taken
        sizes = np.sqrt(np.maximum(np.diag(shifts), 0.0))
        worst = int(np.argmax(sizes))
        effects.append(Effect(cal.parameter_names[worst], float(sizes[worst])))
        weight = np.linalg.pinv(cal.covariance / np.outer(cal.sigmas, cal.sigmas), hermitian=True)
        absorbed = float(np.sum(weight * shifts))
    fitted = pattern.families if pattern is not None else ()
    bending = [
        test for test in found if test.against in _BENDING and (not fitted or test.name in fitted)
    ]
    seen = max((_noncentrality(test) for test in bending), default=0.0)
    return [*effects, on_directions(absorbed + seen, len(cal.theta))]


def _noncentrality(test: MisfitTest) -> float:
    """What a pattern adds to the sum of squares, in units of the noise that is stated, which holds
    the pattern.
    """
    freed = test.dof + test.dof_residual
    beside = freed / (test.dof_residual + test.dof * test.statistic)
    return test.dof * (test.statistic - 1.0) * beside


def on_attitudes(error: AttitudeError | None) -> list[Effect]:
    """Effects of what the tests of a model have added to the attitude error; none where it was not
    propagated.

    A frame's attitude is stated to err by noise and by the rest, against which the rest of the
    misfit is held.
    """
    if error is None or error.misfit is None:
        return []
    pairs = (
        ("the common rotation", error.misfit.common_arcsec, error.common_arcsec),
        (
            "a frame’s attitude",
            error.misfit.rest_arcsec,
            np.hypot(error.nea_arcsec, error.rest_arcsec),
        ),
    )
    return [_worst_axis(name, added, stated) for name, added, stated in pairs]


def _worst_axis(name: str, added: FloatArray, stated: FloatArray) -> Effect:
    sizes = np.divide(added, stated, out=np.zeros(3), where=stated > 0.0)
    worst = int(np.argmax(sizes))
    return Effect(f"{name} in {AXES[worst]}", float(sizes[worst]))
