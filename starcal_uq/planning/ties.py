"""Forecast of what known rotations between frames tell, before any data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.attitude.relative import RelativeAttitudes
from starcal_uq.attitude.rotations import rotation_to_quaternion
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.display import public_names
from starcal_uq.core.errors import PlanningError
from starcal_uq.likelihood.ties import Ties
from starcal_uq.maths.linear import inverses

if TYPE_CHECKING:
    from starcal_uq.core.types import FloatArray, IntArray
    from starcal_uq.planning.information import FrameSet

# Frames of all campaigns of one size together, fewest campaigns of a size, and the size from which
# on the information of a campaign is proportional to its frames.
_FRAMES, _FEWEST, _LONG = 20_000, 20, 1000


@dataclass(frozen=True)
class PlannedTies:
    """Rotations that will be known, with their errors about each axis, arcsec.

    Attributes
    ----------
    sigma_arcsec : float
        Error of the rotation from each frame to the next; of a fixed mount, how far it moves.
    alignment_arcsec : float
        How well the axes of the instrument are known in the camera.
    of_mount : bool
        Whether the camera is on a fixed mount, whose attitude is free.
    """

    __dir__ = public_names

    sigma_arcsec: float
    alignment_arcsec: float = 0.0
    of_mount: bool = False

    def __post_init__(self) -> None:
        if not (0.0 < self.sigma_arcsec < np.inf and 0.0 <= self.alignment_arcsec < np.inf):
            raise PlanningError(
                f"the error of the known rotations is {self.sigma_arcsec!r} arcsec: give a number "
                "above zero, such as 5."
            )

    def information(self, mission: FrameSet, chosen: IntArray) -> FloatArray:
        """Information (C, p, p) on the parameters that ties add to campaigns of frames (C, n)."""
        return (self._of_mount if self.of_mount else self._of_chain)(mission, chosen)

    def _of_chain(self, mission: FrameSet, chosen: IntArray) -> FloatArray:
        """Information (C, p, p) of rotations from each of the frames (C, n) to the next."""
        flat = chosen.ravel()
        place = np.arange(flat.size).reshape(chosen.shape)
        first, second = place[:, :-1].ravel(), place[:, 1:].ravel()
        rotations = mission.rotations[flat]
        turns = rotations[second] @ np.swapaxes(rotations[first], 1, 2)
        sigma = np.full((len(first), 1), self.sigma_arcsec)
        known = RelativeAttitudes(first, second, rotation_to_quaternion(turns), sigma)
        noise, response = mission.noise[flat], mission.response[flat]
        tied = Ties(known, first, second).around(rotations, np.moveaxis(noise, 0, 2), 1.0)
        columns = tied.columns(np.moveaxis(response, 0, 2))
        if self.alignment_arcsec > 0.0:
            columns = np.column_stack([columns, (np.eye(3) - turns).reshape(-1, 3)])
        shape = (len(chosen), -1, columns.shape[1])
        solved = tied.solve(columns).reshape(shape)
        gram = np.swapaxes(columns.reshape(shape), 1, 2) @ solved
        return self._without_common(gram, response.shape[2])

    def _of_mount(self, mission: FrameSet, chosen: IntArray) -> FloatArray:
        """Information (C, p, p) of frames (C, n) on one mount of any attitude."""
        spread = mission.noise + (self.sigma_arcsec / ARCSEC) ** 2 * np.eye(3)
        turned = np.broadcast_to(np.eye(3), spread.shape)
        # What all frames do is the mount's, and far larger than the rest.
        columns = np.concatenate([mission.response - mission.common, turned], axis=2)
        gram = np.swapaxes(columns, 1, 2) @ np.linalg.solve(spread, columns)
        return self._without_common(gram[chosen].sum(axis=1), mission.response.shape[2])

    def _without_common(self, gram: FloatArray, p: int) -> FloatArray:
        """Information (C, p, p) from products (C, q, q) with those of a common turn last, which is
        free or known as well as the instrument's axes.
        """
        if gram.shape[1] == p:
            return gram
        inner = gram[:, p:, p:]
        if not self.of_mount:
            inner = inner + (ARCSEC / self.alignment_arcsec) ** 2 * np.eye(3)
        return gram[:, :p, :p] - gram[:, :p, p:] @ np.linalg.solve(inner, gram[:, p:, :p])


def tied_campaigns(
    ties: PlannedTies,
    mission: FrameSet,
    information: FloatArray,
    n_frames: int,
    n_campaigns: int,
    seed: int,
    start: FloatArray | None,
) -> FloatArray:
    """Covariances (C, p, p) as `starcal_uq.planning.forecast.campaigns` gives them, with frames
    tied in the order in which they are drawn.
    """
    n = min(n_frames, _LONG)
    rng = np.random.default_rng([seed, n])
    size = (min(n_campaigns, max(_FRAMES // n, _FEWEST)), n)
    chosen = rng.integers(len(information), size=size)
    total = information[chosen].sum(axis=1)
    if n > 1:
        total += ties.information(mission, chosen)
    total *= n_frames / n
    return inverses(total if start is None else total + start)
