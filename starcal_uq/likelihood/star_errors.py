"""Errors that a star brings along: its direction is off by the same in every frame that shows it.

A star s whose tabulated direction errs by u_s (px at the boresight, along two axes on the sky)
shifts its images by ``Z u`` with Z the pixels per direction, turned with every frame. Its variance
per axis is ``tau^2`` and what the catalogue states on top.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.likelihood.marginal import MarginalLikelihood, Profile
from starcal_uq.likelihood.terms import Term

if TYPE_CHECKING:
    from starcal_uq.observations.table import Observations

# Images of one direction to this fraction of a pixel, from one to the next, are of one star where
# no name says so.
_SAME_PX = 0.3
# Stars of one name are one star within this: aberration and proper motion move a direction from
# frame to frame.
_SAME_NAME_PX, _SAME_NAME_RAD = 5.0, 6e-4


def star_numbers(obs: Observations, focal_px: float) -> IntArray:
    """Star of every image (N,), numbered from 0 by direction, or by name where all stars have
    one.
    """
    named = bool(np.all(obs.named != ""))
    tolerance = max(_SAME_NAME_PX / focal_px, _SAME_NAME_RAD) if named else _SAME_PX / focal_px
    place = _linked(obs.directions_icrs, tolerance)
    if not named:
        return place
    # A name alone is not trusted: numbers that start again with every frame are no names of stars.
    code = obs.named.codes.astype(np.int64) * (int(place.max()) + 1) + place
    # Places among the few stars are found sooner than all images are sorted.
    return np.searchsorted(np.unique(code), code)


def first_of_each(numbers: IntArray) -> IntArray:
    """First image (S,) of every star of images (N,) that are numbered from 0, none left out."""
    first = np.empty(int(numbers.max(initial=-1)) + 1, dtype=np.int64)
    first[numbers[::-1]] = np.arange(len(numbers))[::-1]
    return first


def _linked(directions: FloatArray, tolerance: float) -> IntArray:
    """Number groups of directions (N, 3) in which each is nearer to another one than the tolerance,
    rad.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    # Cells first: a star that is seen ten thousand times would have ten million pairs.
    grid = np.round(directions / (0.3 * tolerance)).astype(np.int64)
    # One whole number for the three of a cell, in their order; 21 bits each hold a tolerance of 0.4
    # arcsec and more.
    side = 2 * int(np.abs(grid).max(initial=0)) + 1
    if side < 2**21:
        key = np.ravel_multi_index(tuple((grid + side // 2).T), (side,) * 3)
        # Places among the few cells are found sooner than all images are sorted.
        unique = np.unique(key)
        member = np.searchsorted(unique, key)
        cells = np.stack(np.unravel_index(unique, (side,) * 3), axis=1) - side // 2
    else:
        cells, member = np.unique(grid, axis=0, return_inverse=True)
    pairs = cKDTree(cells).query_pairs(1.0 / 0.3, output_type="ndarray")
    links = coo_array(
        (np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(len(cells),) * 2
    )
    labels = connected_components(links, directed=False)[1]
    return np.asarray(labels[member.ravel()], dtype=np.int64)


def sky_axes(directions: FloatArray, numbers: IntArray) -> FloatArray:
    """Two axes across each of S stars, (2, 3, S), for directions (3, N) of their images."""
    r = directions[:, first_of_each(numbers)]
    helper = np.eye(3)[np.argmin(np.abs(r), axis=0)].T
    u = np.cross(helper, r, axis=0)
    u /= np.linalg.norm(u, axis=0)
    return np.stack([u, np.cross(r, u, axis=0)])


def offset_columns(
    part: MarginalLikelihood, state: Profile, axes: FloatArray, focal_px: float
) -> FloatArray:
    """Whitened shift (2, 2, n) of every image for one px (at the boresight) of offset of its star
    along `axes`.
    """
    rotations = part.frames.spread(state.rotations.T)
    moves = np.einsum("kin,jkn->jin", rotations, axes)
    return state.shifts(moves) / focal_px


def _turn(z: FloatArray) -> FloatArray:
    """The orthogonal matrices nearest to z (2, 2, n)."""
    side = np.sign(z[0, 0] * z[1, 1] - z[0, 1] * z[1, 0])
    angle = np.arctan2(z[0, 1] - side * z[1, 0], z[0, 0] + side * z[1, 1])
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, s], [-side * s, side * c]])


def star_term(
    numbers: IntArray,
    directions: FloatArray,
    focal_px: float,
    rigid: bool = False,
) -> Term:
    """Offsets of the stars along two axes on the sky, px at the boresight.

    `numbers` (N,): star of every image, from 0.
    `directions` (3, N): catalogue directions.
    `rigid`: take the turn of the columns alone, of size one: shifts are then in units of the noise.
    """
    axes, n_stars = sky_axes(directions, numbers), int(numbers.max()) + 1

    def columns(part: MarginalLikelihood, state: Profile, rows: slice | IntArray) -> FloatArray:
        z = offset_columns(part, state, axes[:, :, numbers[rows]], focal_px)
        return _turn(z) if rigid else z

    return Term(numbers, n_stars, columns)


class StarModel:
    """The stars of a table and the variances of their direction errors.

    `obs`: stars; their stated direction errors are taken, where there are any.
    """

    def __init__(self, obs: Observations, focal_px: float) -> None:
        self.numbers = star_numbers(obs, focal_px)
        self.directions = obs.direction_rows
        self.focal_px = focal_px
        self.images = np.bincount(self.numbers)
        self.stated2 = np.zeros(len(self.images))
        if obs.direction_mas is not None:
            stated = np.nan_to_num(obs.direction_mas) * (1e-3 / ARCSEC * focal_px)
            self.stated2 = np.bincount(self.numbers, stated**2) / self.images

    @property
    def n_recurring(self) -> int:
        """Stars with more than one image."""
        return int(np.count_nonzero(self.images > 1))

    def term(self) -> Term:
        """The stars' errors, px at the boresight."""
        return star_term(self.numbers, self.directions, self.focal_px)
