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
    from starcal_uq.diagnostics.misfit_test import MisfitTest
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.propagation.attitude_error import AttitudeError
    from starcal_uq.propagation.onboard import Extended

# Effects that bend directions: what keeps its place in the field, and a scale of each frame's own,
# whose mean no frame shows.
_BENDING = {"axes", "field", "radial", "frame", "zenith"}


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


def of_misfit(
    extended: Extended | None, found: Sequence[MisfitTest], cal: Calibration
) -> list[Effect]:
    """Effects on parameters and directions of the effects that the data would take up; of these
    tests, which rejected, where that is not known.
    """
    if extended is not None:
        moved = (extended.mean - cal.theta) / cal.sigmas
        weight = np.linalg.pinv(cal.correlation, hermitian=True)
        names, sizes = cal.parameter_names, np.abs(moved)
        bent = sum(e.gain_nat for e in extended.effects.fitted if e.name in _BENDING)
        # A gain of one nat is what a displacement gives whose square is two units of the noise.
        seen = float(moved @ weight @ moved) + 2.0 * bent
    else:
        names = tuple(test.moved_name for test in found)
        own, errors = (
            np.array([getattr(t, f"moved_{n}") for t in found]) for n in ("sigma", "std")
        )
        sizes = np.sqrt(np.maximum(np.nan_to_num(own**2 - errors**2), 0.0))
        bending = [test for test in found if test.against in (*IN_FIELD, "frame")]
        seen = max((_noncentrality(test) for test in bending), default=0.0)
    worst = int(np.argmax(sizes))
    return [Effect(names[worst], float(sizes[worst])), on_directions(seen, len(cal.theta))]


def _noncentrality(test: MisfitTest) -> float:
    """What a pattern adds to the sum of squares of all frames, in units of the noise that is stated,
    which holds the pattern.
    """
    freed = test.dof + test.dof_residual
    beside = freed / (test.dof_residual + test.dof * test.statistic) / test.share
    return test.dof * (test.statistic - 1.0) * beside


def on_attitudes(error: AttitudeError | None) -> list[Effect]:
    """Effects of what the tests of a model have added to the attitude error; none where that is not
    assessed.

    A frame's attitude is stated to err by noise and by the rest, against which the rest of the
    misfit is held.
    """
    if error is None or error.misfit is None:
        return []
    found, nea = error.misfit, error.nea_arcsec
    pairs = (
        ("the common rotation", found.common_arcsec, error.common_arcsec, 0.0 * nea),
        ("a frame’s attitude", found.rest_arcsec, error.rest_arcsec, nea),
    )
    return [
        _worst_axis(name, np.sqrt(np.maximum(every**2 - held**2, 0.0)), np.hypot(held, noise))
        for name, every, held, noise in pairs
    ]


def _worst_axis(name: str, added: FloatArray, stated: FloatArray) -> Effect:
    sizes = np.divide(added, stated, out=np.zeros(3), where=stated > 0.0)
    worst = int(np.argmax(sizes))
    return Effect(f"{name} in {AXES[worst]}", float(sizes[worst]))
