"""Attitude-marginalised Student-t likelihood: a wrong star costs a little, not everything.

The two whitened residuals of a star are one draw from a bivariate t with nu degrees of freedom and scale sigma,

    log p(e) = -(nu + 2) / 2 log(1 + |e|^2 / (nu sigma^2)) - 2 log sigma + const,

whose constant does not depend on nu in two dimensions. It is bivariate and not one t per axis, because a wrong
identification spoils both axes, and because the result must not depend on how the axes are turned. Equivalently, each
star has its own noise with a gamma-distributed precision; the mean precision given the residual is the weight
``w = (nu + 2) / (nu + |e|^2 / sigma^2)`` of iteratively reweighted least squares (Lange, Little & Taylor 1989).

Attitudes are integrated out by Laplace's method at the best attitude of every frame, with the observed curvature
``Omega = w (1 - 2 e e^T / (nu sigma^2 + |e|^2))`` of every star.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from starcal_uq.attitude.rotations import exp_rotation
from starcal_uq.camera.projection import forward_kernel, forward_root
from starcal_uq.core.errors import StarcalError
from starcal_uq.core.types import BoolArray, FloatArray
from starcal_uq.maths.linear import COLUMNS, ROWS, inverse_symmetric
from starcal_uq.observations.frames import StarFrames

# Below two degrees of freedom a t has no variance, and attitudes of frames with doubtful stars have no curvature.
DOF_RANGE = (2.0, 200.0)
# Wrong stars may lie a thousand sigma away, which no t distribution worth the name produces: free degrees of freedom go
# down to 2 to take them in, and intervals widen by a third. With 4 they widen by 15 %, whatever the stars are.
DEFAULT_DOF = 4.0
_ATTITUDE_STEPS = 60
# Expected gain of a further attitude step in any frame, nat; it is added to the value, so that its square remains.
_GAIN = 1e-7
# What is good enough where doubtful stars make the steps slow, nat.
_ENOUGH = 1e-4
# A frame takes Newton's step where that promises less than this, nat, and the slower step that never overshoots before.
_NEWTON_GAIN = 1.0
# Share of the reweighted determinant below which the observed curvature is not one (few stars, all of them doubtful).
_CURVED = 1e-2
# Stars whose ideal place lies this many times farther out than any measured one cannot be in the field: they are no
# tail of the noise, a polynomial distortion knows nothing of them, and they are left out.
_OUT_OF_FIELD = 1.5


def parse_dof(dof: float | str | None, error: type[StarcalError]) -> float | None:
    """The degrees of freedom of a setting: None for "free", `DEFAULT_DOF` for None.

    Raises
    ------
    error
        For anything but "free" or a number in `DOF_RANGE`.
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
    """Log prior density of log(nu - 2), where nu - 2 is gamma: shape 2, rate 0.1 (after Juarez & Steel 2010)."""
    return np.asarray(2.0 * log_excess - 0.1 * np.exp(log_excess))


@dataclass(frozen=True)
class StudentState:
    """The model at the best attitude of every frame.

    Attributes
    ----------
    value : float
        Log likelihood; -inf where no attitude is a maximum.
    log_volume : float
        The part of it that is the volume of the attitudes, ``-1/2 sum_k log |A^T Omega A|``.
    rotations : (K, 3, 3) array
        R_cam_icrs.
    b : (3, N) array
        Catalogue directions in the camera frame.
    e : (2, N) array
        Residuals, divided by the stated noise where there is one.
    attitude : (3, 2, N) array
        Derivative of the whitened prediction with respect to the frame's rotation vector.
    weight : (N,) array
        w.
    radial : (N,) array
        ``2 w / (nu sigma^2 + |e|^2)``: what Omega lacks along e, per squared residual.
    inverse : (3, 3, K) array
        Inverse of ``A^T Omega A`` per frame.
    seen : (N,) array of bool
        False for stars that cannot be in the field, and in frames without two that can.
    """

    value: float
    log_volume: float
    rotations: FloatArray
    b: FloatArray
    e: FloatArray
    attitude: FloatArray
    weight: FloatArray
    radial: FloatArray
    inverse: FloatArray
    seen: BoolArray

    @property
    def dof(self) -> int:
        """Independent numbers in the data after the attitudes: ``sum_k (2 m_k - 3)`` over the stars seen."""
        return 2 * int(np.sum(self.seen)) - 3 * int(np.sum(self.inverse[0, 0] > 0.0))


class StudentLikelihood:
    """Exact log likelihood of a table of observations.

    Parameters
    ----------
    frames : StarFrames
        Data.
    model_name : str
        Distortion model.
    theta : (p,) array
        Parameters near to the ones to evaluate, px units; they say how wide the field is.
    rotations : (K, 3, 3) array
        Attitudes to start from: good to a fraction of a degree, and not led astray by wrong stars.
    usable : (N,) array of bool, optional
        Stars of frames that have an attitude; all by default.
    """

    def __init__(
        self,
        frames: StarFrames,
        model_name: str,
        theta: FloatArray,
        rotations: FloatArray,
        usable: BoolArray | None = None,
    ) -> None:
        self.frames, self.model_name, self.rotations = frames, model_name, rotations
        offset = frames.pixel - theta[:2, None]
        far = _OUT_OF_FIELD * float(np.max(np.hypot(offset[0], offset[1])))
        # Decided once: a star that came and went with theta would make the likelihood jump.
        self._seen = frames.rotated(rotations)[2] > 1.0 / np.hypot(1.0, far / theta[2])
        if usable is not None:
            self._seen &= usable

    def state(self, theta: FloatArray, sigma: float, nu: float) -> StudentState:
        """Find the best attitudes at theta (p,), sigma (px or factor) and nu."""
        # Its square may overflow, which NumPy's numbers do without an error.
        rotations, sigma = self.rotations, np.float64(sigma)
        with np.errstate(all="ignore"):
            for _ in range(_ATTITUDE_STEPS):
                state, step, gain = self._step(theta, sigma, nu, rotations)
                largest = float(np.max(gain))
                if not np.isfinite(largest):
                    break
                if largest < _GAIN:
                    return state
                rotations = exp_rotation(step.T) @ rotations
            if largest < _ENOUGH:
                return state
        return replace(state, value=-np.inf)

    def log_likelihood(self, theta: FloatArray, sigma: float, nu: float) -> float:
        """Log likelihood at one point."""
        return self.state(theta, sigma, nu).value

    def by_frame(self, theta: FloatArray, sigma: float, nu: float) -> FloatArray:
        """Log likelihood (K,) of every frame at one point; their sum is `log_likelihood`."""
        state = self.state(theta, sigma, nu)
        loss = np.log1p(np.sum(state.e * state.e, axis=0) / (nu * sigma**2))
        dof = 2.0 * self.frames.sum(state.seen.astype(np.float64)) - 3.0 * (state.inverse[0, 0] > 0.0)
        sign, log_volume = np.linalg.slogdet(np.moveaxis(state.inverse, 2, 0))
        values: FloatArray = -0.5 * (nu + 2.0) * self.frames.sum(np.where(state.seen, loss, 0.0)) - dof * np.log(sigma)
        return np.where(np.isfinite(state.value), values + 0.5 * np.where(sign > 0.0, log_volume, 0.0), -np.inf)

    def many(self, theta: FloatArray, sigma: FloatArray, nu: FloatArray) -> FloatArray:
        """Log likelihood (n,) at theta (n, p), sigma (n,) and nu (n,)."""
        points = zip(theta, sigma, nu, strict=True)
        return np.array([self.log_likelihood(t, float(s), float(v)) for t, s, v in points])

    def _step(
        self, theta: FloatArray, sigma: float, nu: float, rotations: FloatArray
    ) -> tuple[StudentState, FloatArray, FloatArray]:
        """The model at given attitudes, the next step (3, K), and the gain (K,) that it promises."""
        frames = self.frames
        b = frames.rotated(rotations)
        xy, a = forward_kernel(self.model_name, "attitude")(
            frames.n_stars, theta, b, forward_root(self.model_name, theta, b)
        )
        e = frames.pixel - xy
        seen = self._seen & np.isfinite(e).all(axis=0)
        if not seen.all():
            e[:, ~seen], a[..., ~seen] = 0.0, 0.0
        if frames.weight is not None:
            e *= frames.weight
            a *= frames.weight
        square = np.sum(e * e, axis=0)
        scaled = square / sigma**2
        weight = (nu + 2.0) / (nu + scaled)
        radial = 2.0 * weight / (nu * sigma**2 + square)
        d = np.sum(a * e, axis=1)
        slope = frames.sum(weight * d)
        full = np.stack([weight * np.sum(a[i] * a[j], axis=0) for i, j in zip(ROWS, COLUMNS, strict=True)])
        lacking = np.stack([radial * d[i] * d[j] for i, j in zip(ROWS, COLUMNS, strict=True)])
        reweighted = frames.sum(full)
        observed = reweighted - frames.sum(lacking)
        safe, safe_determinant = inverse_symmetric(reweighted)
        inverse, determinant = inverse_symmetric(observed)
        xx, xy_, _, yy, _, _ = observed
        curved = (xx > 0.0) & (xx * yy > xy_ * xy_) & (determinant > _CURVED * safe_determinant)
        if not curved.all():
            # Doubtful stars bend the cost the other way: they are counted as flat, in frames that need it.
            flat = np.minimum(radial, weight / np.maximum(square, np.finfo(float).tiny))
            lacking = np.stack([flat * d[i] * d[j] for i, j in zip(ROWS, COLUMNS, strict=True)])
            milder, milder_determinant = inverse_symmetric(reweighted - frames.sum(lacking))
            usable = ~curved & (milder_determinant > _CURVED * safe_determinant)
            inverse = np.where(usable, milder, inverse)
            determinant = np.where(usable, milder_determinant, determinant)
            curved |= usable
        # A frame without two stars in the field has no attitude, and nothing to say.
        fixed = safe_determinant > 0.0
        inverse = np.where(fixed, np.where(curved, inverse, safe), 0.0)
        step = np.einsum("ijk,jk->ik", inverse, slope)
        gain = 0.5 * np.sum(step * slope, axis=0) / sigma**2
        wild = fixed & ~(gain < _NEWTON_GAIN)
        if wild.any():
            step[:, wild] = np.einsum("ijk,jk->ik", safe[..., wild], slope[:, wild])
        seen &= frames.spread(fixed.astype(np.float64)) > 0.0
        weight, radial = np.where(seen, weight, 0.0), np.where(seen, radial, 0.0)
        loss = 0.5 * (nu + 2.0) * float(np.sum(np.log1p(scaled[seen] / nu)))
        volume = np.where(fixed, np.where(curved, determinant, safe_determinant), 1.0)
        log_volume = -0.5 * float(np.sum(np.log(volume)))
        state = StudentState(0.0, log_volume, rotations, b, e, a, weight, radial, inverse, seen)
        value = float(np.sum(gain)) - loss - state.dof * np.log(sigma) + log_volume
        return replace(state, value=value), step, gain

    def derivatives(self, theta: FloatArray, state: StudentState) -> FloatArray:
        """Derivative (p, 2, N) of the whitened prediction with respect to theta at fixed attitudes."""
        _, h, _ = forward_kernel(self.model_name, "first")(
            self.frames.n_stars, theta, state.b, forward_root(self.model_name, theta, state.b)
        )
        h[..., ~state.seen] = 0.0
        return h if self.frames.weight is None else h * self.frames.weight

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
            rotation_per_theta=-np.mean(response, axis=2),
            attitude_noise=np.mean(state.inverse, axis=2) * sigma**2,
        )


@dataclass(frozen=True)
class Information:
    """Derivatives of the log likelihood at one point, attitudes eliminated.

    Attributes
    ----------
    score : (p,) array
        Gradient.
    matrix : (p, p) array
        Observed information.
    reweighted : (p, p) array
        Information if the weights were known; never smaller, and always positive.
    variability : (p, p) array
        Sum over stars of the outer products of their scores.
    rotation_per_theta : (3, p) array
        Mean over frames of d(attitude) / d(theta), rad per px unit.
    attitude_noise : (3, 3) array
        Mean over frames of the attitude covariance, rad^2.
    """

    score: FloatArray
    matrix: FloatArray
    reweighted: FloatArray
    variability: FloatArray
    rotation_per_theta: FloatArray
    attitude_noise: FloatArray
