"""Attitude-marginalised Student-t likelihood: a wrong star costs a little, not everything.

The two whitened residuals of a star are one draw from a bivariate t with nu degrees of freedom and
scale sigma,

    log p(e) = -(nu + 2) / 2 log(1 + |e|^2 / (nu sigma^2)) - 2 log sigma + const,

whose constant does not depend on nu in two dimensions. It is bivariate and not one t per axis,
because a wrong identification spoils both axes, and because the result must not depend on how the
axes are turned. Equivalently, each star has its own noise with a gamma-distributed precision; the
mean precision given the residual is the weight ``w = (nu + 2) / (nu + |e|^2 / sigma^2)`` of
iteratively reweighted least squares (Lange, Little & Taylor 1989).

Attitudes are integrated out by Laplace's method at the best attitude of every frame, with the
observed curvature ``Omega = w (1 - 2 e e^T / (nu sigma^2 + |e|^2))`` of every star.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from starcal_uq.attitude.rotations import exp_rotation
from starcal_uq.camera.distortion import get_model
from starcal_uq.camera.projection import forward_kernel, forward_root
from starcal_uq.core.types import BoolArray, FloatArray
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.maths.linear import COLUMNS, ROWS, inverse_symmetric
from starcal_uq.observations.frames import StarFrames

# Below two degrees of freedom a t has no variance, and attitudes of frames with doubtful stars have
# no curvature.
DOF_RANGE = (2.0, 200.0)
# Wrong stars may lie a thousand sigma away, which no t distribution worth the name produces: free
# degrees of freedom go down to 2 to take them in, and intervals widen by a third. With 4 they widen
# by 15 %, whatever the stars are.
DEFAULT_DOF = 4.0
_ATTITUDE_STEPS = 60
# Expected gain of a further attitude step in any frame, nat; it is added to the value, so that its
# square remains.
_GAIN = 1e-7
# What is good enough after so many steps: where one maximum is about to vanish into another, they
# get very slow.
_ENOUGH, _SLOW_STEPS = 1e-4, 12
# A frame takes Newton's step where that promises less than this, nat, and the slower step that
# never overshoots before.
_NEWTON_GAIN = 1.0
# Share of the reweighted determinant below which the observed curvature is not one (few stars, all
# of them doubtful).
_CURVED = 1e-2
# Stars whose ideal place lies this many times farther out than any measured one cannot be in the
# field: they are no tail of the noise, a polynomial distortion knows nothing of them, and they are
# left out.
_OUT_OF_FIELD = 1.5
# Points are evaluated together as long as their stars are no more than these: their columns then
# stay in the cache.
_STARS_AT_ONCE = 8192


def parse_dof(dof: float | str | None, error: type[Exception]) -> float | None:
    """The degrees of freedom of a setting: None for "free", `DEFAULT_DOF` for None, else a number
    in `DOF_RANGE`.
    """
    low, high = DOF_RANGE
    if dof is None:
        return DEFAULT_DOF
    if dof == "free":
        return None
    if isinstance(dof, int | float) and low <= dof <= high:
        return float(dof)
    raise error(f"dof is {dof!r}: use 'free' or a number from {low:g} to {high:g}.")


def log_excess_prior(log_excess: FloatArray) -> FloatArray:
    """Log prior density of log(nu - 2), where nu - 2 is gamma: shape 2, rate 0.1 (after Juarez &
    Steel 2010).
    """
    return 2.0 * log_excess - 0.1 * np.exp(log_excess)


@dataclass(frozen=True)
class StudentState:
    """The model at the best attitude of every frame."""

    value: float  # Log likelihood; -inf where no attitude is a maximum
    # The part of it that is the volume of the attitudes, ``-1/2 sum_k log |A^T Omega A|``
    log_volume: float
    rotations: FloatArray  # (K, 3, 3): R_cam_icrs
    b: FloatArray  # (3, N): catalogue directions in the camera frame
    e: FloatArray  # (2, N): residuals, divided by the stated noise where there is one
    # (3, 2, N): derivative of the whitened prediction with respect to the frame's rotation vector
    attitude: FloatArray
    weight: FloatArray  # (N,): w
    # (N,): ``2 w / (nu sigma^2 + |e|^2)``: what Omega lacks along e, per squared residual
    radial: FloatArray
    inverse: FloatArray  # (3, 3, K): inverse of ``A^T Omega A`` per frame
    # (N,): false for stars that cannot be in the field, and in frames without two that can
    seen: BoolArray

    @property
    def dof(self) -> int:
        """Independent numbers in the data after the attitudes: ``sum_k (2 m_k - 3)`` over the stars
        seen.
        """
        return 2 * int(np.sum(self.seen)) - 3 * int(np.sum(self.inverse[0, 0] > 0.0))


class StudentLikelihood:
    """Exact log likelihood of a table of observations.

    `theta` (p,): parameters near to the ones to evaluate, px units; they say how wide the field is.
    `rotations` (K, 3, 3): attitudes to start from: good to a fraction of a degree, and not led
    astray by wrong stars. `usable` (N,): stars of frames that have an attitude; all by default.
    """

    def __init__(
        self,
        frames: StarFrames,
        model_name: str,
        theta: FloatArray,
        rotations: FloatArray,
        usable: BoolArray | None = None,
    ) -> None:
        self.frames, self.model_name = frames, model_name
        offset = frames.pixel - theta[:2, None]
        far = _OUT_OF_FIELD * float(np.max(np.hypot(offset[0], offset[1])))
        # Decided once: a star that came and went with theta would make the likelihood jump.
        plane = get_model(model_name).plane
        edge_rad = min(plane.angle(far / theta[2]), plane.limit_rad)
        self._seen = frames.rotated(rotations)[2] > np.cos(edge_rad)
        if usable is not None:
            self._seen &= usable
        self._origin, self._rotations, self._turns = (
            theta,
            rotations,
            np.zeros((3, len(theta), frames.n_frames)),
        )
        self._copies = frames

    def follow(self, theta: FloatArray, state: StudentState, information: Information) -> None:
        """Start later searches at the attitudes that follow, to first order, from those of a state
        at theta.

        A frame with doubtful stars can have several attitudes that are maxima: searches from afar
        end now in one and now in another, and the likelihood jumps.
        """
        self._origin, self._rotations, self._turns = theta, state.rotations, information.turns

    def state(self, theta: FloatArray, sigma: float, nu: float) -> StudentState:
        """Find the best attitudes at theta (p,), sigma (px or factor) and nu."""
        values, state = self._search(theta[None], np.array([sigma]), np.array([nu]))
        return replace(state, value=float(np.sum(values)))

    def log_likelihood(self, theta: FloatArray, sigma: float, nu: float) -> float:
        """Log likelihood at one point."""
        return self.state(theta, sigma, nu).value

    def by_frame(self, theta: FloatArray, sigma: float, nu: float) -> FloatArray:
        """Log likelihood (K,) of every frame at one point; their sum is `log_likelihood`."""
        values: FloatArray = self._search(theta[None], np.array([sigma]), np.array([nu]))[0][0]
        return values

    def many(self, theta: FloatArray, sigma: FloatArray, nu: FloatArray) -> FloatArray:
        """Log likelihood (n,) at theta (n, p), sigma (n,) and nu (n,)."""
        n = max(1, _STARS_AT_ONCE // self.frames.n_stars)
        parts = [slice(i, i + n) for i in range(0, len(theta), n)]
        return np.concatenate(
            [self._search(theta[i], sigma[i], nu[i])[0].sum(axis=1) for i in parts]
        )

    def _search(
        self, theta: FloatArray, sigma: FloatArray, nu: FloatArray
    ) -> tuple[FloatArray, StudentState]:
        """Log likelihood (n, K) at the best attitudes of n points, and the model of the points that
        took longest.
        """
        k, left = self.frames.n_frames, np.arange(len(theta))
        values = np.full((len(theta), k), -np.inf)
        # Squares of sigma may overflow.
        with np.errstate(all="ignore"):
            turn = np.einsum("ipk,np->nki", self._turns, theta - self._origin).reshape(-1, 3)
            rotations = exp_rotation(turn) @ np.tile(self._rotations, (len(left), 1, 1))
            for number in range(_ATTITUDE_STEPS):
                value, state, step, gain = self._step(theta[left], sigma[left], nu[left], rotations)
                largest = gain.reshape(-1, k).max(axis=1)
                good = largest < (_GAIN if number < _SLOW_STEPS else _ENOUGH)
                values[left[good]] = value.reshape(-1, k)[good]
                on = np.isfinite(largest) & ~good
                if not on.any():
                    break
                moving = np.repeat(on, k)
                left, rotations = left[on], exp_rotation(step.T[moving]) @ rotations[moving]
        return values, state

    def _copied(self, n: int) -> StarFrames:
        """The frames n times over."""
        k = self.frames.n_frames
        if self._copies.n_frames < n * k:
            self._copies = StarFrames.joined([self.frames] * n)
        return self._copies if self._copies.n_frames == n * k else self._copies.part(0, n * k)

    def _step(
        self, theta: FloatArray, sigma: FloatArray, nu: FloatArray, rotations: FloatArray
    ) -> tuple[FloatArray, StudentState, FloatArray, FloatArray]:
        """Log likelihood (nK,) and model of n points at given attitudes, the next step (3, nK), the
        gain (nK,) of it.

        Stars and frames are those of the first point, then those of the second, and so on.
        """
        n, k, frames = len(theta), self.frames.n_frames, self._copied(len(theta))
        if n == 1:
            # Numbers that all stars share keep arithmetic cheap.
            point, scale, frame_scale, freedom = theta[0], sigma[0], sigma[0], nu[0]
        else:
            point, scale, freedom = (
                np.repeat(x.T, self.frames.n_stars, axis=-1) for x in (theta, sigma, nu)
            )
            frame_scale = np.repeat(sigma, k)
        b = frames.rotated(rotations)
        xy, a = forward_kernel(self.model_name, "attitude")(
            frames.n_stars, point, b, forward_root(self.model_name, point, b)
        )
        e = frames.pixel - xy
        seen = np.tile(self._seen, n) & np.isfinite(e).all(axis=0)
        if not seen.all():
            e[:, ~seen], a[..., ~seen] = 0.0, 0.0
        frames.whiten(e)
        frames.whiten(a)
        square = _dot(e, e)
        scaled = square / scale**2
        weight = (freedom + 2.0) / (freedom + scaled)
        radial = 2.0 * weight / (freedom * scale**2 + square)
        d = np.einsum("ixn,xn->in", a, e)
        slope = frames.sum(weight * d)
        reweighted = frames.sum(
            np.stack([weight * _dot(a[i], a[j]) for i, j in zip(ROWS, COLUMNS, strict=True)])
        )
        observed = reweighted - frames.sum(_lacking(radial, d))
        safe, safe_determinant = inverse_symmetric(reweighted)
        inverse, determinant = inverse_symmetric(observed)
        xx, xy_, _, yy, _, _ = observed
        curved = (xx > 0.0) & (xx * yy > xy_ * xy_) & (determinant > _CURVED * safe_determinant)
        if not curved.all():
            # Doubtful stars bend the cost the other way: they are counted as flat, in frames that
            # need it.
            flat = np.minimum(radial, weight / np.maximum(square, np.finfo(float).tiny))
            milder, milder_determinant = inverse_symmetric(
                reweighted - frames.sum(_lacking(flat, d))
            )
            usable = ~curved & (milder_determinant > _CURVED * safe_determinant)
            inverse = np.where(usable, milder, inverse)
            determinant = np.where(usable, milder_determinant, determinant)
            curved |= usable
        # A frame without two stars in the field has no attitude, and nothing to say.
        fixed = safe_determinant > 0.0
        inverse = np.where(fixed, np.where(curved, inverse, safe), 0.0)
        step = np.einsum("ijk,jk->ik", inverse, slope)
        gain = 0.5 * np.sum(step * slope, axis=0) / frame_scale**2
        wild = fixed & ~(gain < _NEWTON_GAIN)
        if wild.any():
            step[:, wild] = np.einsum("ijk,jk->ik", safe[..., wild], slope[:, wild])
        seen &= frames.spread(fixed.astype(np.float64)) > 0.0
        weight, radial = np.where(seen, weight, 0.0), np.where(seen, radial, 0.0)
        loss = frames.sum(np.where(seen, 0.5 * (freedom + 2.0) * np.log1p(scaled / freedom), 0.0))
        log_volume = -0.5 * np.log(
            np.where(fixed, np.where(curved, determinant, safe_determinant), 1.0)
        )
        dof = 2.0 * frames.sum(seen.astype(np.float64)) - 3.0 * fixed
        value: FloatArray = gain - loss - dof * np.log(frame_scale) + log_volume
        state = StudentState(
            0.0, float(np.sum(log_volume)), rotations, b, e, a, weight, radial, inverse, seen
        )
        return value, state, step, gain

    def derivatives(self, theta: FloatArray, state: StudentState) -> FloatArray:
        """Derivative (p, 2, N) of the whitened prediction with respect to theta at fixed
        attitudes.
        """
        _, h, _ = MarginalLikelihood(self.frames, self.model_name).first(theta, state.b)
        h[..., ~state.seen] = 0.0
        return h

    def information(self, theta: FloatArray, state: StudentState, sigma: float) -> Information:
        """Score and observed information of theta with the attitudes eliminated."""
        h = self.derivatives(theta, state)
        p = len(h)
        along = np.sum(h * state.e, axis=1)
        curved = state.weight * h - (state.radial * along)[:, None] * state.e
        cross = self.frames.sum(np.einsum("ixn,axn->ian", state.attitude, curved))
        response = np.einsum("ijk,jak->iak", state.inverse, cross)
        matrix = np.einsum("axn,bxn->ab", h, curved, optimize=True)
        matrix -= np.einsum("iak,ibk->ab", cross, response, optimize=True)
        spread = self.frames.spread(response)
        profiled = h - np.einsum("ian,ixn->axn", spread, state.attitude)
        star_scores = np.sum(profiled * (state.weight * state.e), axis=1)
        reweighted = (state.weight * profiled).reshape(p, -1) @ profiled.reshape(p, -1).T
        return Information(
            score=np.sum(star_scores, axis=1) / sigma**2,
            matrix=0.5 * (matrix + matrix.T) / sigma**2,
            reweighted=reweighted / sigma**2,
            variability=star_scores @ star_scores.T / sigma**4,
            turns=-response,
            attitude_noise=np.mean(state.inverse, axis=2) * sigma**2,
        )


@dataclass(frozen=True)
class Information:
    """Derivatives of the log likelihood at one point, attitudes eliminated."""

    score: FloatArray  # (p,): gradient
    matrix: FloatArray  # (p, p): observed information
    # (p, p): information if the weights were known; never smaller, and always positive
    reweighted: FloatArray
    variability: FloatArray  # (p, p): sum over stars of the outer products of their scores
    turns: FloatArray  # (3, p, K): d(best attitude) / d(theta) of every frame, rad per px unit
    attitude_noise: FloatArray  # (3, 3): mean over frames of the attitude covariance, rad^2

    @property
    def rotation_per_theta(self) -> FloatArray:
        """Mean (3, p) of `turns` over the frames."""
        return np.asarray(np.mean(self.turns, axis=2))


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[0] * b[0] + a[1] * b[1])


def _lacking(radial: FloatArray, d: FloatArray) -> FloatArray:
    """What the observed curvature of attitudes lacks of the reweighted one, per star (6, N)."""
    return np.stack([radial * d[i] * d[j] for i, j in zip(ROWS, COLUMNS, strict=True)])
