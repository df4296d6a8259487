"""Refraction below zeniths that are not known: of one place for all frames, or one for each.

Refraction of standard air is taken off at the zeniths that explain the images best. Its derivatives
by the direction of the zenith are columns of an effect, whose prior is a direction anywhere above
the horizon: a Gaussian of one radian is as dense in its middle as a uniform hemisphere. One more
column is the density of the air. To first order refraction is the same on both sides of the
boresight, so that a zenith of a frame by itself may be the mirrored one: half the difference of
the two is a column as well. Air bends light and does not turn the camera: attitudes are those that
fit the stars as they are seen.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from starcal_uq.attitude.earth import (
    DENSITY_SPREAD,
    air_constants,
    earth_axes,
    normalised,
    raising,
    tangents,
)
from starcal_uq.core.errors import StarcalError
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.likelihood.shapes import Shape, View

if TYPE_CHECKING:
    from starcal_uq.observations.table import Observations

# Spread of a zenith before any data, rad, and of the choice between it, 1, and its mirror image, -1.
_ANYWHERE_RAD, _EITHER = 1.0, 1.0
# A zenith is moved by at most this in one step, rad.
_LONGEST_RAD = 0.2


@dataclass(frozen=True, eq=False)
class Zeniths:
    """Zeniths of frames, and what is not known of them.

    n is one, a place for all frames, or K, a zenith for each. The coefficients of the effect are
    moves of the places to the north and to the east, rad, of zeniths of single frames also what is
    odd about the boresight, 1 at the zenith and -1 at its mirror image; and the density of the air
    less that of the standard air.
    """

    frame_ids: IntArray  # (K,): frames that they are known of
    axes: FloatArray  # (K, 3, 3): axes of the Earth among the stars, by rows; or of the sky
    places: FloatArray  # (n, 3): unit vectors along these axes
    timed: bool  # Whether the axes are those of the Earth
    # (m,): slopes by the coefficients of the log of what the data leave open of the zeniths
    pull: FloatArray = field(default_factory=lambda: np.zeros(0))

    SHAPES: ClassVar = """
        k: frame_ids
        k 3 3: axes
        n 3: places
        m: pull
    """

    @property
    def apiece(self) -> bool:
        """Whether every frame has a zenith of its own."""
        return len(self.places) > 1

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers of coefficients: moves, choices of a mirror image, densities."""
        n = len(self.places)
        return 2 * n, n if self.apiece else 0, 1

    @property
    def prior(self) -> FloatArray:
        """Standard deviations of the coefficients."""
        return np.repeat([_ANYWHERE_RAD, _EITHER, DENSITY_SPREAD], self.sizes)

    @property
    def mean(self) -> FloatArray:
        """Expected coefficients: standard air, and neither the zeniths nor their mirror images."""
        return np.repeat([0.0, 0.0, 1.0], self.sizes)

    @cached_property
    def among_stars(self) -> FloatArray:
        """Zeniths of the frames (K, 3), ICRS axes."""
        return np.asarray(self._ways[0])

    @cached_property
    def _ways(self) -> FloatArray:
        """Zeniths of the frames, and their ways to the north and to the east (3, K, 3), ICRS axes."""
        ways = np.stack([self.places, *tangents(self.places)])
        ways = np.broadcast_to(ways, (3, *self.axes.shape[:2]))
        return np.asarray(np.einsum("akj,kjx->akx", ways, self.axes))

    def seen_in(self, obs: Observations) -> Zeniths:
        """The same place below the frames of a table."""
        return replace(self, frame_ids=obs.frame_ids, axes=frame_axes(obs)[0])

    def moved(self, coefficients: FloatArray, boresights: FloatArray) -> Zeniths:
        """The zeniths that coefficients (m,) point to, at most so far away; where these prefer its
        mirror image about the boresight (K, 3), ICRS axes, that one.
        """
        turn = coefficients[: self.sizes[0]].reshape(2, -1)
        turn = turn * np.minimum(1.0, _LONGEST_RAD / np.maximum(np.hypot(*turn), 1e-12))
        places = self.places + np.einsum("an,anx->nx", turn, np.stack(tangents(self.places)))
        choice = coefficients[self.sizes[0] : -1]
        if self.apiece:
            level = np.sum(places * boresights, axis=1)[:, None]
            places = np.where(choice[:, None] < 0.0, 2.0 * level * boresights - places, places)
        return replace(self, places=normalised(places))

    def shape(self, obs: Observations) -> Shape:
        """Shifts of the images of a table by the coefficients, frames that are not known without
        any.
        """
        number = np.searchsorted(self.frame_ids, obs.frame)
        number = np.minimum(number, len(self.frame_ids) - 1)
        known = self.frame_ids[number] == obs.frame
        member = number if self.apiece else np.zeros_like(number)
        moves, choices, _ = self.sizes

        def columns(view: View) -> FloatArray:
            rows, state, frames = number[view.rows], view.state, view.part.frames
            rotations = np.repeat(state.rotations, frames.sizes, axis=0)
            constants = air_constants()
            zenith, *moving = (
                np.einsum("nij,nj->in", rotations, vector[rows]) for vector in self._ways
            )

            def seen(moves: FloatArray) -> FloatArray:
                return frames.in_pixels(state.shifts(moves) * known[view.rows])

            found = np.zeros((2, len(self.places), 2, frames.n_stars))
            star, own = np.arange(frames.n_stars), member[view.rows]
            for axis, way in enumerate(moving):
                found[axis, own, :, star] = seen(_moved(state.b, zenith, way, constants)).T
            air = seen(raised(state.b, zenith, constants))
            odd = np.zeros((choices, 2, frames.n_stars))
            if choices:
                mirrored = zenith * np.array([[-1.0], [-1.0], [1.0]])
                half = 0.5 * (air - seen(raised(state.b, mirrored, constants)))
                odd[own, :, star] = half.T
                air = air - half
            return np.concatenate([found.reshape(moves, 2, -1), odd, air[None]])

        return Shape("refraction", "zenith", sum(self.sizes), columns)


def raised(b: FloatArray, zenith: FloatArray, air: tuple[float, float]) -> FloatArray:
    """Moves (3, N) of stars b (3, N) by air of these constants below zeniths (3, N)."""
    return zenith * raising(np.sum(zenith * b, axis=0), air)[0]


def _moved(
    b: FloatArray, zenith: FloatArray, way: FloatArray, air: tuple[float, float]
) -> FloatArray:
    """The same by a move of the zeniths along this way (3, N), per rad."""
    length, slope = raising(np.sum(zenith * b, axis=0), air)
    return np.asarray(way * length + zenith * (slope * np.sum(way * b, axis=0)))


def frame_axes(obs: Observations) -> tuple[FloatArray, bool]:
    """Axes of the Earth among the stars for each frame, (K, 3, 3) by rows, and whether they are
    known.

    Without times of all frames one moment's will do, whose Earth is turned as if it did not matter.
    """
    first = obs.frame_starts[:-1]
    if obs.time_utc is not None and not (obs.time_utc[first] == "").any():
        with suppress(StarcalError):
            return earth_axes(obs.time_utc[first]), True
    return np.tile(np.eye(3), (obs.n_frames, 1, 1)), False
