"""Errors that a star brings along: its direction is off by the same in every frame that shows it.

A star s whose tabulated direction errs by u_s (px at the boresight, along two axes on the sky)
shifts its images by ``Z u`` with Z the pixels per direction, turned with every frame. With u_s of
variance ``tau^2`` per axis, and what the catalogue states on top, the data have the covariance

    V = sigma^2 (I + Z Lambda Z^T),   Lambda = (tau^2 + stated^2) / sigma^2.

After the attitudes are projected out (P), products with W = V^-1 - V^-1 A (A^T V^-1 A)^-1 A^T V^-1
need one system:

    sigma^2 x^T W y = x^T (I-P) y - c_x^T G^-1 c_y,   c_x = Z^T (I-P) x,   G = Lambda^-1 + Z^T (I-P)
    Z.

G couples stars that were seen together. Z^T Z is block-diagonal over stars and P over frames, so
that either side can be eliminated; the smaller one is left over, and is solved as a sparse or a
dense matrix.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.likelihood.marginal import MarginalLikelihood, Profile

if TYPE_CHECKING:
    from starcal_uq.observations.table import Observations

# Images of one direction to this fraction of a pixel, from one to the next, are of one star where
# no name says so.
_SAME_PX = 0.3
# Stars of one name are one star within this: aberration and proper motion move a direction from
# frame to frame.
_SAME_NAME_PX, _SAME_NAME_RAD = 5.0, 6e-4
# A star variance, in units of the noise, that is none.
_NO_RATIO = 1e-10
# Rows of a dense matrix, 400 MB; a larger one must have few entries, as frames all over the sky
# give.
_LARGEST, _THIN = 7000, 0.01
# Share of entries from which a matrix is solved as a dense one.
_FULL = 0.2
_STARS_AT_ONCE = 20_000
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


def add_by_star(total: FloatArray, values: FloatArray, stars: IntArray) -> None:
    """Add values (..., n) of images to the sums (S, ...) of their stars."""
    if len(total) <= 4 * len(stars):
        present, member = np.arange(len(total)), stars
    else:
        present, member = np.unique(stars, return_inverse=True)
    rows = [np.bincount(member, row, len(present)) for row in values.reshape(-1, values.shape[-1])]
    total[present] += np.stack(rows, axis=1).reshape(len(present), *values.shape[:-1])


def _blocks(blocks: FloatArray) -> Any:
    """A block-diagonal matrix of blocks (S, 2, 2), sparse."""
    from scipy.sparse import bsr_array

    s = len(blocks)
    return bsr_array((blocks, np.arange(s), np.arange(s + 1)), shape=(2 * s, 2 * s)).tocsr()


class StarSums:
    """Sums over all images from which products with the covariance of star errors follow.

    `numbers` (N,): star of every image, from 0.
    `directions` (3, N): catalogue directions.
    `rigid`: take the turn of the columns alone, of size one: shifts are then in units of the noise.
    """

    def __init__(
        self, numbers: IntArray, directions: FloatArray, focal_px: float, rigid: bool = False
    ) -> None:
        self.numbers, self.focal_px, self.rigid = numbers, focal_px, rigid
        self.axes = sky_axes(directions, numbers)
        self.n_stars = int(numbers.max()) + 1
        self.own = np.zeros((self.n_stars, 2, 2))
        self._cross: FloatArray | None = None
        self._blocks: list[tuple[FloatArray, IntArray, IntArray]] = []
        self._frames = 0

    @property
    def cross(self) -> FloatArray:
        """``Z^T (I-P) X`` (2 S, q) of the columns that were added."""
        if self._cross is None:
            return np.zeros((2 * self.n_stars, 0))
        return self._cross.reshape(2 * self.n_stars, -1)

    def columns(self, part: MarginalLikelihood, state: Profile, rows: slice) -> FloatArray:
        """`offset_columns` of the images of some rows."""
        z = offset_columns(part, state, self.axes[:, :, rows], self.focal_px)
        return _turn(z) if self.rigid else z

    def add(
        self, part: MarginalLikelihood, state: Profile, projected: FloatArray, rows: slice
    ) -> FloatArray:
        """Add frames with columns (q, 2, n), attitudes projected out; their `columns` come back."""
        stars, z = self.numbers[rows], self.columns(part, state, rows)
        if self._cross is None:
            self._cross = np.zeros((self.n_stars, 2, len(projected)))
        add_by_star(self.own, np.einsum("ixn,jxn->ijn", z, z), stars)
        add_by_star(self._cross, np.einsum("ixn,qxn->iqn", z, projected), stars)
        # Z^T A times the root of (A^T A)^-1: P in the coordinates of the stars is the square of
        # this.
        root = np.linalg.cholesky(np.moveaxis(state.inverse, 2, 0))
        block = np.einsum(
            "ixn,axn,nab->nib",
            z,
            state.attitude,
            np.repeat(root, part.frames.sizes, axis=0),
            optimize=True,
        )
        frame = self._frames + np.repeat(np.arange(part.frames.n_frames), part.frames.sizes)
        self._blocks.append((block, stars, frame))
        self._frames += part.frames.n_frames
        return z

    @cached_property
    def coupling(self) -> Any:
        """``Z^T A (A^T A)^(-1/2)`` (2 S, 3 K), sparse."""
        from scipy.sparse import csr_array

        block, stars, frames = (np.concatenate(parts) for parts in zip(*self._blocks, strict=True))
        rows = (2 * stars[:, None, None] + np.arange(2)[:, None]) + np.zeros(3, dtype=np.int64)
        columns = (3 * frames[:, None, None] + np.arange(3)) + np.zeros((2, 1), dtype=np.int64)
        shape = (2 * self.n_stars, 3 * self._frames)
        return csr_array((block.ravel(), (rows.ravel(), columns.ravel())), shape=shape)

    @cached_property
    def matrix(self) -> Any:
        """``Z^T (I-P) Z`` (2 S, 2 S), sparse."""
        b = self.coupling
        return (_blocks(self.own) - b @ b.T).tocsr()

    def solved(self, ratio: FloatArray) -> SolvedStars:
        """Solve for star variances `ratio` (2 S,), px^2, in units of sigma^2."""
        return SolvedStars(self, ratio)


def _factor(matrix: Any) -> tuple[Callable[[FloatArray], FloatArray], float]:
    """What solves with a sparse positive definite matrix, and the log of its determinant."""
    from scipy.linalg import cho_factor, cho_solve
    from scipy.sparse.linalg import splu

    n = matrix.shape[0]
    density = matrix.nnz / n**2
    if n > _LARGEST and density > _THIN:
        raise CalibrationError(
            f"the stars' errors need a full matrix of {n} rows, and {_LARGEST} are possible: "
            "calibrate fewer frames, "
            "or leave star_errors out."
        )
    if density > _FULL:
        dense = cho_factor(matrix.toarray(), lower=True, overwrite_a=True, check_finite=False)
        volume = 2.0 * float(np.sum(np.log(np.diag(dense[0]))))
        return lambda columns: np.asarray(cho_solve(dense, columns, check_finite=False)), volume
    sparse = splu(
        matrix.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    volume = float(np.sum(np.log(np.abs(sparse.U.diagonal()))))
    return lambda columns: np.asarray(sparse.solve(np.asfortranarray(columns))), volume


class SolvedStars:
    """``G = Lambda^-1 + Z^T (I-P) Z`` with a factor of its smaller side, or of the stars' or the
    frames'.
    """

    def __init__(self, sums: StarSums, ratio: FloatArray, by_star: bool | None = None) -> None:
        from scipy.sparse import diags_array, eye_array

        self._sums, self.ratio = sums, np.maximum(ratio, _NO_RATIO)
        precision = 1.0 / self.ratio
        b = sums.coupling
        self._by_star = b.shape[0] <= b.shape[1] if by_star is None else by_star
        log_own = 0.0
        if self._by_star:
            left = sums.matrix + diags_array(precision)
        else:
            own = sums.own.copy()
            own[:, 0, 0] += precision[0::2]
            own[:, 1, 1] += precision[1::2]
            self._inverse: FloatArray = np.asarray(np.linalg.inv(own), dtype=np.float64)
            log_own = float(np.sum(np.log(np.linalg.det(own))))
            left = eye_array(b.shape[1]) - b.T @ self._own_solve(b)
        self._solve, log_factor = _factor(left)
        # log |I + Lambda Z^T (I-P) Z|
        self.log_determinant = log_factor + log_own + float(np.sum(np.log(self.ratio)))

    def _own_solve(self, values: Any) -> Any:
        return _blocks(self._inverse) @ values

    def offsets(self, cross: FloatArray) -> FloatArray:
        """``G^-1 c`` (2 S, q): best offsets, px, for ``c = Z^T (I-P) X``."""
        if self._by_star:
            return self._solve(cross)
        b, first = self._sums.coupling, self._own_solve(cross)
        return np.asarray(first + self._own_solve(b @ self._solve(b.T @ first)))

    def correction(self) -> FloatArray:
        """What star errors take off the Gram matrix (q, q) of the columns that were added."""
        cross = self._sums.cross
        taken = cross.T @ self.offsets(cross)
        return np.asarray(0.5 * (taken + taken.T))


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

    def sums(self) -> StarSums:
        """Sums with nothing added yet."""
        return StarSums(self.numbers, self.directions, self.focal_px)

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

        p, sums = len(theta), self.sums()
        gram = add_linearised(sums, likelihood, theta, scale, likelihood.rotations_at(theta))
        dof = likelihood.dof - p

        def restricted(log_ratio: float, noise: float) -> tuple[float, float]:
            """Minus the restricted log likelihood, and the noise there."""
            solved = sums.solved(self.ratio(float(np.exp(log_ratio)) * noise**2, noise))
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

    def _range(self, sums: StarSums, gram: FloatArray, dof: int) -> tuple[float, float]:
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


def add_linearised(
    sums: StarSums,
    likelihood: MarginalLikelihood,
    theta: FloatArray,
    scale: FloatArray,
    rotations: FloatArray,
) -> FloatArray:
    """Gram matrix (p + 1, p + 1) of parameters in units of `scale` (p,) and residuals; their sums
    by star are added.
    """
    frames, p = likelihood.frames, len(theta)
    gram = np.zeros((p + 1, p + 1))
    for first, last in frames.parts(_STARS_AT_ONCE):
        part = MarginalLikelihood(frames.part(first, last), likelihood.model_name)
        state, _ = part.profile(theta, rotations[first:last])
        h = part.derivatives(theta, state) * scale[:, None, None]
        columns = part.project_out(state, np.concatenate([h, state.e[None]]))
        flat = columns.reshape(p + 1, -1)
        gram += flat @ flat.T
        sums.add(part, state, columns, slice(int(frames.starts[first]), int(frames.starts[last])))
    return gram


class StarLikelihood(MarginalLikelihood):
    """Exact likelihood with the stars' errors marginalised at a given scale, in units of sigma.

    Offsets are linear over fractions of a pixel; they are the best ones of the estimate's system,
    and the cost that they and the attitudes leave is that of these residuals. Beyond the attitudes'
    volume, determinants do not depend on theta enough to matter (1e-3 nat).

    `theta` (p,): estimate, px units.
    `rotations` (K, 3, 3): attitudes there.
    `sigma`: noise that they are relative to.
    """

    def __init__(
        self,
        obs: Observations,
        model_name: str,
        theta: FloatArray,
        rotations: FloatArray,
        errors: StarErrors,
        sigma: float,
    ) -> None:
        super().__init__(obs, model_name)
        model = StarModel(obs, errors.focal_px)
        state, _ = self.profile(theta, rotations)
        self.use_rotations(state.rotations)
        sums = model.sums()
        sums.add(self, state, np.zeros((1, 2, self.frames.n_stars)), slice(None))
        self._sums, self._solved = sums, sums.solved(model.ratio(errors.tau_px**2, sigma))

    def conditioned(self, state: Profile, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Columns (q, 2, N) less what attitudes and offsets take of them, and those offsets (2 S,
        q), px.
        """
        projected = self.project_out(state, columns)
        z, q = self._sums.columns(self, state, slice(None)), len(columns)
        cross = np.zeros((self._sums.n_stars, 2, q))
        add_by_star(cross, np.einsum("ixn,qxn->iqn", z, projected), self._sums.numbers)
        offsets = self._solved.offsets(cross.reshape(-1, q))
        return projected - self.project_out(state, self.offset_shifts(state, offsets)), offsets

    def whitened(self, state: Profile, columns: FloatArray) -> FloatArray:
        rest, offsets = self.conditioned(state, columns)
        scaled = offsets / np.sqrt(self._solved.ratio)[:, None]
        return np.concatenate([rest.reshape(len(columns), -1), scaled.T], axis=1)

    def offset_shifts(self, state: Profile, offsets: FloatArray) -> FloatArray:
        """Whitened shifts (q, 2, N) of all images by offsets (2 S, q), px."""
        z = self._sums.columns(self, state, slice(None))
        by_image = offsets.reshape(self._sums.n_stars, 2, -1)[self._sums.numbers]
        return np.asarray(np.einsum("niq,ixn->qxn", by_image, z, optimize=True))

    def random_shifts(self, state: Profile, rng: np.random.Generator) -> FloatArray:
        """Whitened shifts (1, 2, N) of all images by random errors of their stars, in units of
        sigma.
        """
        return self.offset_shifts(
            state,
            (np.sqrt(self._solved.ratio) * rng.standard_normal(len(self._solved.ratio)))[:, None],
        )

    def log_likelihood(self, theta: FloatArray, sigma: float) -> float:
        state, cost = self.profile(theta, self._rotations)
        if not np.isfinite(cost):
            return -np.inf
        rest, offsets = self.conditioned(state, state.e[None])
        cost = float(np.sum(rest**2) + np.sum(offsets[:, 0] ** 2 / self._solved.ratio))
        return float(
            -0.5 * cost / sigma**2 - self.dof * np.log(sigma) - 0.5 * np.sum(state.log_determinant)
        )
