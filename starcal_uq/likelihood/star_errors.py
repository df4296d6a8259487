"""Errors that a star brings along: its direction is off by the same in every frame that shows it.

A star s whose tabulated direction errs by u_s (px at the boresight, along two axes on the sky)
shifts its images by ``Z u`` with Z the pixels per direction, turned with every frame: a term whose
groups are the stars. With u_s of variance ``tau^2`` per axis, and what the catalogue states on top,
its prior scale is ``sqrt(tau^2 + stated^2)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.likelihood.marginal import MarginalLikelihood, Profile
from starcal_uq.likelihood.terms import Term, TermLikelihood, TermSums
from starcal_uq.observations.frames import StarFrames

if TYPE_CHECKING:
    from starcal_uq.observations.table import Observations

# Images of one direction to this fraction of a pixel, from one to the next, are of one star where
# no name says so.
_SAME_PX = 0.3
# Stars of one name are one star within this: aberration and proper motion move a direction from
# frame to frame.
_SAME_NAME_PX, _SAME_NAME_RAD = 5.0, 6e-4
# Range of log(tau^2 / sigma^2).
_LOG_RATIO = (-14.0, 9.0)


def star_numbers(obs: Observations, focal_px: float) -> IntArray:
    """Star of every image (N,), numbered from 0 by direction, or by name where all stars have
    one.
    """
    names = obs.star_id
    named = names is not None and bool(np.all(names != ""))
    tolerance = max(_SAME_NAME_PX / focal_px, _SAME_NAME_RAD) if named else _SAME_PX / focal_px
    place = _linked(obs.directions_icrs, tolerance)
    if named and names is not None:
        # A name alone is not trusted: numbers that start again with every frame are no names of
        # stars.
        code = np.unique(names, return_inverse=True)[1]
        place = np.unique(code * (int(place.max()) + 1) + place, return_inverse=True)[1]
    return np.asarray(place, dtype=np.int64)


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
        key = (
            ((grid[:, 0] + side // 2) * side + grid[:, 1] + side // 2) * side
            + grid[:, 2]
            + side // 2
        )
        first, member = np.unique(key, return_index=True, return_inverse=True)[1:]
        cells = grid[first]
    else:
        cells, member = np.unique(grid, axis=0, return_inverse=True)
    pairs = cKDTree(cells).query_pairs(1.0 / 0.3, output_type="ndarray")
    links = coo_array(
        (np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(len(cells),) * 2
    )
    labels = connected_components(links, directed=False)[1]
    return np.asarray(labels[member.ravel()], dtype=np.int64)


def sky_axes(directions: FloatArray, numbers: IntArray) -> FloatArray:
    """Two axes across each star's direction, the same for all of its images: (2, 3, N) for
    directions (3, N).
    """
    first = np.unique(numbers, return_index=True)[1]
    r = directions[:, first]
    helper = np.eye(3)[np.argmin(np.abs(r), axis=0)].T
    u = np.cross(helper, r, axis=0)
    u /= np.linalg.norm(u, axis=0)
    return np.stack([u, np.cross(r, u, axis=0)])[:, :, numbers]


def offset_columns(
    part: MarginalLikelihood, state: Profile, axes: FloatArray, focal_px: float
) -> FloatArray:
    """Whitened shift (2, 2, n) of every image for one px (at the boresight) of offset of its star
    along `axes`.

    A small change d of a direction b is the rotation ``b x d``, so that the attitude columns hold
    it already.
    """
    turned = np.cross(part.frames.r[None], axes, axis=1)
    rotation = [part.frames.spread(np.ascontiguousarray(state.rotations[:, i].T)) for i in range(3)]
    angles = np.stack([np.sum(row * turned, axis=1) for row in rotation], axis=1)
    shift: FloatArray = np.einsum("jin,ixn->jxn", angles, state.attitude, optimize=True) / focal_px
    return shift


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
    scale_px: FloatArray | float = 1.0,
    rigid: bool = False,
) -> Term:
    """Offsets of the stars along two axes on the sky, px at the boresight.

    `numbers` (N,): star of every image, from 0.
    `directions` (3, N): catalogue directions.
    `scale_px` (S,): their standard deviation before any data.
    `rigid`: take the turn of the columns alone, of size one: shifts are then in units of the noise.
    """
    axes, n_stars = sky_axes(directions, numbers), int(numbers.max()) + 1

    def columns(part: MarginalLikelihood, state: Profile, rows: slice) -> FloatArray:
        z = offset_columns(part, state, axes[:, :, rows], focal_px)
        return _turn(z) if rigid else z

    scale = np.broadcast_to(np.reshape(scale_px, (-1, 1)), (n_stars, 2))
    return Term("stars' errors", "star_errors", numbers, scale, columns)


@dataclass(frozen=True)
class StarErrors:
    """Direction errors of stars that the covariance of a calibration holds."""

    # `tau_px`, `tau_px_std`: error of a star per axis beyond what its catalogue states, estimated
    # by restricted maximum likelihood, and its standard error; px at the boresight.
    tau_px: float
    tau_px_std: float
    # Root mean square of what the catalogue states, px; zero where the table states nothing
    stated_px: float
    focal_px: float  # Focal length that turns directions into these px
    # `n_stars`, `n_recurring`: distinct stars, and those seen in more than one frame.
    n_stars: int
    n_recurring: int

    @property
    def tau_arcsec(self) -> float:
        """`tau_px` as an angle."""
        return self.tau_px / self.focal_px * ARCSEC

    @property
    def total_px(self) -> float:
        """Error of a star per axis with what its catalogue states, px."""
        return float(np.hypot(self.tau_px, self.stated_px))


class StarModel:
    """The stars of a table and the variances of their direction errors.

    `obs`: stars; their stated direction errors are taken, where there are any.
    """

    def __init__(self, obs: Observations, focal_px: float) -> None:
        self.numbers = star_numbers(obs, focal_px)
        self.directions = np.ascontiguousarray(obs.directions_icrs.T)
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

    def term(self, tau_px: float = 0.0) -> Term:
        """The stars' errors, of `tau_px` per axis beyond what their catalogue states."""
        scale = np.sqrt(tau_px**2 + self.stated2)
        return star_term(self.numbers, self.directions, self.focal_px, scale)

    def ratio(self, tau2: float, sigma: float) -> FloatArray:
        """Variance of each star's offset along its two axes, (2 S,), in units of sigma^2."""
        return np.repeat((tau2 + self.stated2) / sigma**2, 2)

    def estimate(
        self, likelihood: MarginalLikelihood, theta: FloatArray, scale: FloatArray, sigma: float
    ) -> tuple[StarErrors, float, FloatArray]:
        """Estimate tau by restricted maximum likelihood, linearised at theta (p,); `scale` (p,)
        makes parameters alike.

        Attitudes, parameters and sigma are integrated or profiled out; `sigma` is a first value.
        Returns the errors, the noise of the images themselves, and what the errors add to the
        covariance (p, p) of the estimate that takes images as independent, px units.
        """
        from scipy.optimize import minimize_scalar

        p, sums = len(theta), TermSums(self.term())
        gram = sums.add_linearised(likelihood, theta, scale, likelihood.rotations_at(theta))
        dof = likelihood.dof - p

        def restricted(log_ratio: float, noise: float) -> tuple[float, float]:
            """Minus the restricted log likelihood, and the noise there."""
            solved = sums.eliminated(self.ratio(float(np.exp(log_ratio)) * noise**2, noise))
            left = gram - solved.correction()
            rest = left[p, p] - left[:p, p] @ np.linalg.solve(left[:p, :p], left[:p, p])
            value = dof * np.log(rest) + np.linalg.slogdet(left[:p, :p])[1] + solved.log_determinant
            return float(0.5 * value), float(np.sqrt(rest / dof))

        def cost(log_ratio: float) -> float:
            return restricted(log_ratio, sigma)[0]

        # What is stated is known in px: its share of the noise settles in a second round.
        for _ in range(2 if np.any(self.stated2 > 0.0) else 1):
            bounds = self._range(sums, gram, dof)
            best = float(
                minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 0.02}).x
            )
            sigma = restricted(best, sigma)[1]
        step = 0.2
        curvature = (cost(best + step) + cost(best - step) - 2.0 * cost(best)) / step**2
        tau = float(np.exp(0.5 * best) * sigma)
        # The standard error of log ratio is twice that of log tau; near none at all the likelihood
        # has no curvature.
        relative = 0.5 / np.sqrt(curvature) if curvature > 0.25 else 1.0
        inverse = np.linalg.inv(gram[:p, :p])
        pull = np.sqrt(self.ratio(tau**2, 1.0))[:, None] * sums.cross[:, :p] @ inverse
        errors = StarErrors(
            tau_px=tau,
            tau_px_std=float(tau * relative),
            stated_px=float(np.sqrt(np.mean(self.stated2))),
            focal_px=self.focal_px,
            n_stars=len(self.images),
            n_recurring=self.n_recurring,
        )
        return errors, sigma, pull.T @ pull * np.outer(scale, scale)

    def _range(self, sums: TermSums, gram: FloatArray, dof: int) -> tuple[float, float]:
        """Where to look for log(tau^2 / sigma^2): around what likeness within stars says (see
        `diagnostics.stars`).
        """
        low, high = _LOG_RATIO
        if np.any(self.stated2 > 0.0):
            return low, high
        p = len(gram) - 1
        step = np.linalg.solve(gram[:p, :p], gram[:p, p])
        pull = sums.cross[:, p] - sums.cross[:, :p] @ step
        total = float(gram[p, p] - gram[:p, p] @ step)
        g = sums.matrix
        first, second = float(g.trace()), float(g.multiply(g).sum())
        curvature = second - first**2 / dof
        likeness = (float(pull @ pull) / total * dof - first) / curvature
        error = np.sqrt(2.0 / curvature)
        if likeness < 3.0 * error:
            return low, min(float(np.log(6.0 * error)), high)
        # The noise of the images themselves is below that of all together: the ratio may be several
        # times larger.
        return max(float(np.log(likeness)) - 2.0, low), high


class StarLikelihood(TermLikelihood):
    """Exact likelihood with the stars' errors marginalised at a given scale, in units of sigma.

    Arguments are those of `TermLikelihood`; with `axes`, noise of x and y is what a noise model
    found.
    """

    def __init__(
        self,
        obs: Observations,
        model_name: str,
        theta: FloatArray,
        rotations: FloatArray,
        errors: StarErrors,
        sigma: float,
        axes: bool = False,
    ) -> None:
        term = StarModel(obs, errors.focal_px).term(errors.tau_px)
        frames = StarFrames.from_observations(obs, axes)
        super().__init__(frames, model_name, term, theta, rotations, sigma)
