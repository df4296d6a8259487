"""What the posterior of the camera means for attitude: draws through QUEST on frames.

Every draw of the camera turns the measured pixels into directions, and QUEST turns these into one
attitude per frame. Its difference from the attitude at the posterior mean is a left rotation vector
phi (pitch, yaw, roll), split into

- the *common rotation*: what an alignment calibration with the same parameters finds on its own
  frames, and removes,
- the *rest*: what remains on the frames of the mission, and is absorbed by nothing.

Alignment and mission see different frames: a mission that stares at one field keeps the error of
that field. Centroid noise (the noise-equivalent angle, NEA) stands beside them: it is new in every
frame. What noise and a wrong camera do together, phi(camera, noise) - phi(camera, 0) - phi(0,
noise), is their *interaction*, of second order.

A few hundred draws give a standard deviation to 4 % only. But phi is linear in the parameters to
high accuracy, and its first-order response K is known, so it serves as a control variate: to the
variance of the sampled phi is added K (Sigma - Sigma_d) K^T, with Sigma the covariance of all draws
and Sigma_d that of the draws that went through QUEST. What is sampled is then only the difference
from linearity. Quantiles are those of K applied to all draws, scaled to that standard deviation.
The same holds for noise, whose first-order response is known as well.

For the same reason not every frame has to go through QUEST: what is sampled hardly varies between
frames, so that a few hundred of them, one of each stretch of the run, tell it for all, while first
order is that of every frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.attitude.rotations import left_error
from starcal_uq.attitude.wahba import quest
from starcal_uq.camera.projection import unproject_jacobian, unproject_theta
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.errors import DistortionError, ObservationError, SamplingError
from starcal_uq.core.settings import bounded
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.estimation.weights import weighed
from starcal_uq.observations.splits import frame_sample
from starcal_uq.propagation.alignment import alignment_frames as _alignment_frames
from starcal_uq.propagation.alignment import alignment_weights
from starcal_uq.propagation.attitude_error import OBSERVED, AttitudeError

if TYPE_CHECKING:
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.table import Observations


_LEVELS = (0.95, 0.997)
_STARS_AT_ONCE = 1_000_000
_SAMPLES = 400_000
# Draws that are given noise as well: the interaction is averaged over frames, and its size is what
# counts.
_NOISY_DRAWS = 40
# Frames that go through QUEST, of more: so many, or fewer that hold so many stars, but not fewer
# than the last.
_SAMPLED_FRAMES, _SAMPLED_STARS, _FEWEST_FRAMES = 300, 20_000, 30
# Half a pixel: the map is so smooth that the central difference errs by (h / f)^2, while rounding
# stays below 1e-12.
_STEP_PX = 0.5


@bounded
@one_thread()
def propagate(
    post: Posterior,
    obs: Observations,
    *,
    n_draws: int = 300,
    seed: int = 0,
    alignment: Observations | str | None = None,
    alignment_frames: int | None = None,
) -> AttitudeError:
    """Attitude error of single frames: centroid noise, calibration as common rotation and rest, and
    their interaction.

    QUEST weights stars equally, or by their stated noise where the posterior scales it.

    Parameters
    ----------
    post : Posterior
        Draws of the camera and the noise.
    obs : Observations
        The frames whose star geometry counts: those of the calibration, or those of a mission
        (`starcal_uq.simulation.mission_frames`, `starcal_uq.simulation.profile_frames`).
    n_draws : int
        Draws that go through QUEST; all if there are fewer.
    seed : int
        Chooses them, the noise, and a random sky.
    alignment : Observations or str, optional
        Frames on which alignment is calibrated in flight: ``random`` (by default) for a random sky
        with as many stars a frame as `obs`, ``observed`` for `obs` itself, or a table.
    alignment_frames : int, optional
        Number of frames of the random sky; 100 by default.

    Raises
    ------
    SamplingError
        For fewer than two draws.
    DistortionError
        When a draw folds the distortion within the observed pixels.
    ObservationError
        When the posterior scales stated noises that the observations lack, or the alignment is none
        of these.
    DegenerateFrameError
        When a frame does not determine an attitude.
    """
    draws = post.thin(n_draws, seed)[:, :-1]
    count = len(draws)
    if count < 2:
        raise SamplingError("propagation needs at least two posterior draws: raise n_draws.")
    frames = FrameGeometry.of(post, obs)
    aligning, told = _alignment_frames(post, obs, alignment, alignment_frames, seed)
    aligned = frames if aligning is obs else FrameGeometry.of(post, aligning)
    weights, alignment_covariance = alignment_weights(aligned.noise_covariance)
    together = np.einsum("nij,njp->ip", weights, aligned.response)
    apart = frames.response - together
    sampled = _sampled(post, frames, aligned, draws, seed)
    shift = draws - post.mean
    # First order is that of all frames; what is beyond it, that of the sample.
    common = sampled.common + shift @ (together - sampled.together).T
    nea = frames.noise_covariance
    common_variance = np.maximum(spread(together, post.covariance) + sampled.beyond_common, 0.0)
    constant_variance = np.maximum(
        spread(apart.mean(axis=0), post.covariance) + sampled.beyond_constant, 0.0
    )
    rest_variance = np.maximum(
        spread(apart, post.covariance) + sampled.over(obs.n_frames, sampled.beyond_rest), 0.0
    )
    whole = spread(frames.response, post.covariance) + sampled.over(
        obs.n_frames, sampled.beyond_whole
    )
    whole_variance = np.maximum(whole, 0.0).mean(axis=0)
    interaction = sampled.interaction
    half_widths = [_noise_half_widths(nea, seed)]
    sigmas = (np.sqrt(common_variance), _rms(rest_variance))
    half_widths += [
        *_calibration_half_widths(post, together, apart, sigmas, seed),
        _half_widths(interaction),
    ]
    p95, p997 = np.swapaxes(half_widths, 0, 1) * ARCSEC
    noise_sigma = np.sqrt(np.maximum(_diagonal(nea).mean(axis=0) + sampled.noise_excess, 0.0))
    met = interaction.reshape(-1, 3)
    covariances = [
        _with_sigmas(nea.mean(axis=0), noise_sigma),
        _with_sigmas(together @ post.covariance @ together.T, sigmas[0]),
        _with_sigmas((apart @ post.covariance @ np.swapaxes(apart, 1, 2)).mean(axis=0), sigmas[1]),
        _with_sigmas(
            (frames.response @ post.covariance @ np.swapaxes(frames.response, 1, 2)).mean(axis=0),
            np.sqrt(whole_variance),
        ),
        met.T @ met / len(met),
    ]
    return AttitudeError(
        nea_arcsec=noise_sigma * ARCSEC,
        common_arcsec=sigmas[0] * ARCSEC,
        rest_arcsec=sigmas[1] * ARCSEC,
        p95_arcsec=p95,
        p997_arcsec=p997,
        analytic_nea_arcsec=_rms(_diagonal(nea)) * ARCSEC,
        analytic_common_arcsec=np.sqrt(spread(together, post.covariance)) * ARCSEC,
        analytic_rest_arcsec=_rms(spread(apart, post.covariance)) * ARCSEC,
        n_draws=count,
        n_frames=obs.n_frames,
        n_sampled_frames=len(sampled.places),
        common_draws_arcsec=common * ARCSEC,
        rest_rms_per_frame_arcsec=np.sqrt(rest_variance) * ARCSEC,
        nea_per_frame_arcsec=np.sqrt(_diagonal(nea)) * ARCSEC,
        interaction_arcsec=_rms(interaction.reshape(-1, 3) ** 2) * ARCSEC,
        frames=str(obs.origin.frames or OBSERVED),
        seen=obs,
        total_arcsec=np.sqrt(whole_variance) * ARCSEC,
        analytic_total_arcsec=_rms(spread(frames.response, post.covariance)) * ARCSEC,
        rest_constant_arcsec=np.sqrt(constant_variance) * ARCSEC,
        covariance_arcsec2=np.stack(covariances) * ARCSEC**2,
        alignment=told,
        alignment_covariance_arcsec2=alignment_covariance * ARCSEC**2,
        aligned=aligning,
    )


@dataclass(frozen=True, eq=False)
class _Sampled:
    """What draws through QUEST say, and what of it first order does not, on k of the frames
    (`places`).

    Variances beyond first order, rad^2, are those of the draws less those that the responses give
    for the same draws: of the common rotation and of the mean of the rest (3,), of the rest and of
    the whole rotation in each frame (k, 3), and of noise (3,). `common` (D, 3) is the common
    rotation of every draw, rad, `together` (3, p) its first-order response on these frames, and
    `interaction` (d, k, 3) that of noise and camera, rad.
    """

    places: IntArray
    common: FloatArray
    together: FloatArray
    beyond_common: FloatArray
    beyond_constant: FloatArray
    beyond_rest: FloatArray
    beyond_whole: FloatArray
    noise_excess: FloatArray
    interaction: FloatArray

    def over(self, n_frames: int, values: FloatArray) -> FloatArray:
        """Values (n_frames, 3) of all frames: those of the sample (k, 3), and their mean
        elsewhere.
        """
        every = np.tile(values.mean(axis=0), (n_frames, 1))
        every[self.places] = values
        return every


def _few(obs: Observations, seed: int) -> tuple[Observations, IntArray]:
    """Frames that draws are taken through, and their places: fewer of those with very many stars,
    which are alike.
    """
    limit = int(
        np.clip(_SAMPLED_STARS * obs.n_frames // obs.n_stars, _FEWEST_FRAMES, _SAMPLED_FRAMES)
    )
    return frame_sample(obs, limit, seed)


def _sampled(
    post: Posterior,
    every: FrameGeometry,
    every_aligned: FrameGeometry,
    draws: FloatArray,
    seed: int,
) -> _Sampled:
    """Take draws (D, p) through QUEST on some of the frames and of those of the alignment."""
    some, places = _few(every.obs, seed)
    frames = every if some is every.obs else FrameGeometry.of(post, some)
    if every_aligned is every:
        aligned = frames
    else:
        aligning, _ = _few(every_aligned.obs, seed)
        aligned = (
            every_aligned if aligning is every_aligned.obs else FrameGeometry.of(post, aligning)
        )
    weights, _ = alignment_weights(aligned.noise_covariance)
    common, constant = np.empty((len(draws), 3)), np.empty((len(draws), 3))
    # Where the same frames align and are propagated to, their attitudes are found once.
    if aligned is not frames:
        for part, phi in aligned.rotations(draws):
            common[part] = np.einsum("nij,dnj->di", weights, phi)
    rest, whole = _Moments(some.n_frames), _Moments(some.n_frames)
    quiet: list[FloatArray] = []
    for part, phi in frames.rotations(draws):
        if aligned is frames:
            common[part] = np.einsum("nij,dnj->di", weights, phi)
        if part.start < _NOISY_DRAWS:
            quiet.append(phi[: _NOISY_DRAWS - part.start])
        whole.add(phi)
        rest.add(phi - common[part, None])
        constant[part] = phi.mean(axis=1) - common[part]
    together = np.einsum("nij,njp->ip", weights, aligned.response)
    apart = frames.response - together
    own = np.cov(draws, rowvar=False).reshape(draws.shape[1], -1)
    noise_excess, interaction = _with_noise(
        frames, draws[:_NOISY_DRAWS], np.concatenate(quiet), seed
    )
    return _Sampled(
        places=places,
        common=common,
        together=together,
        beyond_common=common.var(axis=0, ddof=1) - spread(together, own),
        beyond_constant=constant.var(axis=0, ddof=1) - spread(apart.mean(axis=0), own),
        beyond_rest=rest.variance - spread(apart, own),
        beyond_whole=whole.variance - spread(frames.response, own),
        noise_excess=noise_excess,
        interaction=interaction,
    )


class _Moments:
    """Variance (K, 3) over draws that come in parts (d, K, 3)."""

    def __init__(self, n_frames: int) -> None:
        self._count = 0
        self._total, self._squares = np.zeros((n_frames, 3)), np.zeros((n_frames, 3))

    def add(self, values: FloatArray) -> None:
        self._count += len(values)
        self._total += values.sum(axis=0)
        self._squares += np.sum(values * values, axis=0)

    @property
    def variance(self) -> FloatArray:
        found: FloatArray = (self._squares - self._total**2 / self._count) / (self._count - 1)
        return found


@dataclass(frozen=True, eq=False)
class FrameGeometry:
    """Frames as QUEST sees them at the posterior mean, with its first-order responses.

    Displacements db of the directions turn the attitude by phi = [sum w (I - b b^T)]^-1 sum w b x
    db; weights (N,) are None where all stars count alike. `noise_px` (N,) is the centroid noise per
    axis; `response` (K, 3, p) is d phi / d theta, rad per px unit, `noise_response` (2, N, 3) the
    turns of a star's frame by one standard deviation of its x and of its y, or of two independent
    parts where a noise model has its axes correlate, rad, and `noise_covariance` (K, 3, 3) the
    covariance of phi from centroid noise, rad^2.
    """

    post: Posterior
    obs: Observations
    weights: FloatArray | None
    noise_px: FloatArray
    response: FloatArray
    noise_response: FloatArray
    noise_covariance: FloatArray

    @classmethod
    def of(cls, post: Posterior, obs: Observations) -> FrameGeometry:
        """Linearise QUEST on these frames."""
        obs = weighed(obs, post)
        noise_px, weights = _noise(post, obs)
        model, xy, starts = post.camera.distortion, obs.xy, obs.frame_starts
        b, per_theta = unproject_jacobian(model, post.mean, xy)
        steps = _STEP_PX * np.eye(2)
        per_pixel = [
            (
                unproject_theta(model, post.mean, xy + step)
                - unproject_theta(model, post.mean, xy - step)
            )
            / (2.0 * _STEP_PX)
            for step in steps
        ]
        w = np.ones(obs.n_stars) if weights is None else weights
        inverse = np.linalg.inv(
            _frame_sums(w[:, None, None] * (np.eye(3) - b[:, :, None] * b[:, None, :]), starts)
        )
        by_theta = _frame_sums(
            w[:, None, None] * np.cross(b[:, None], np.swapaxes(per_theta, 1, 2)), starts
        )
        root = np.eye(2) if obs.noise_axes is None else np.linalg.cholesky(obs.noise_axes)
        torque = np.stack([(w * noise_px)[:, None] * np.cross(b, column) for column in per_pixel])
        torque = np.einsum("anj,ab->bnj", torque, root)
        turns = np.einsum("nij,anj->ani", np.repeat(inverse, np.diff(starts), axis=0), torque)
        return cls(
            post=post,
            obs=obs,
            weights=weights,
            noise_px=noise_px,
            response=inverse @ np.swapaxes(by_theta, 1, 2),
            noise_response=turns,
            noise_covariance=_frame_sums(np.einsum("ani,anj->nij", turns, turns), starts),
        )

    def attitudes(self, thetas: FloatArray, xy: FloatArray) -> FloatArray:
        """Quaternions (d, K, 4) by QUEST for parameters (d, p) and pixels (N, 2), or (d, N, 2)."""
        model = self.post.camera.distortion
        pixels = np.broadcast_to(xy, (len(thetas), *xy.shape[-2:]))
        b = np.stack(
            [unproject_theta(model, theta, own) for theta, own in zip(thetas, pixels, strict=True)]
        )
        folded = ~np.isfinite(b).all(axis=(1, 2))
        if folded.any():
            raise DistortionError(
                f"at {int(folded.sum())} of {len(b)} posterior draws the distortion {model!r} "
                "folds over within the "
                "observed field: use more frames, a tighter prior or a model with fewer "
                "coefficients."
            )
        obs = self.obs
        return quest(
            b, obs.directions_icrs, obs.frame_starts, self.weights, covariance=False
        ).quaternions

    def rotations(self, draws: FloatArray) -> Iterator[tuple[slice, FloatArray]]:
        """Left rotations (d, K, 3) rad of the attitudes at some draws from those at the posterior
        mean.
        """
        xy = self.obs.xy
        reference = self.attitudes(self.post.mean[None], xy)
        for part in self.batches(len(draws)):
            yield part, left_error(self.attitudes(draws[part], xy), reference)

    def batches(self, count: int) -> Iterator[slice]:
        """Ranges of draws whose stars fit into memory."""
        step = max(1, _STARS_AT_ONCE // self.obs.n_stars)
        return (slice(first, min(first + step, count)) for first in range(0, count, step))


def _with_noise(
    frames: FrameGeometry, draws: FloatArray, quiet: FloatArray, seed: int
) -> tuple[FloatArray, FloatArray]:
    """What noise does beyond first order: excess variance (3,) of noise alone, and the interaction
    (d, K, 3), rad.

    `quiet` (d, K, 3) are the rotations at the draws without noise.
    """
    rng = np.random.default_rng(seed)
    xy, starts, mean = frames.obs.xy, frames.obs.frame_starts, frames.post.mean[None]
    reference = frames.attitudes(mean, xy)
    excess, interactions = np.zeros(3), []
    for part in frames.batches(len(draws)):
        thetas = draws[part]
        e = rng.standard_normal((len(thetas), len(xy), 2))
        errors = (
            e if frames.obs.noise_axes is None else e @ np.linalg.cholesky(frames.obs.noise_axes).T
        )
        noisy = xy + frames.noise_px[:, None] * errors
        noise = left_error(frames.attitudes(np.repeat(mean, len(thetas), axis=0), noisy), reference)
        both = left_error(frames.attitudes(thetas, noisy), reference)
        linear = np.add.reduceat(
            np.einsum("dna,ani->dni", e, frames.noise_response), starts[:-1], axis=1
        )
        excess += np.sum(noise * noise - linear * linear, axis=(0, 1))
        interactions.append(both - quiet[part] - noise)
    return excess / (len(draws) * frames.obs.n_frames), np.concatenate(interactions)


def _noise(post: Posterior, obs: Observations) -> tuple[FloatArray, FloatArray | None]:
    """Noise of every star (N,) in px at the posterior mean, its own direction error included, and
    QUEST's weights.
    """
    sigma = float(np.mean(post.sigma_draws))
    if post.sigma_name != "sigma_scale":
        return np.full(obs.n_stars, np.hypot(sigma, post.star_error_px)), None
    if obs.sigma_px is None:
        raise ObservationError(
            "the posterior scales the stated noise of the stars, but these observations have no "
            "sigma_px: "
            "pass the observations that it was sampled from, or mission_frames(..., "
            "noise_like=observations).",
            column="sigma_px",
        )
    return np.hypot(sigma * obs.sigma_px, post.star_error_px), obs.sigma_px**-2.0


def _frame_sums(values: Any, starts: IntArray) -> FloatArray:
    sums: FloatArray = np.add.reduceat(values, starts[:-1], axis=0)
    return sums


def _noise_half_widths(covariance: FloatArray, seed: int) -> FloatArray:
    """Half-widths of Gaussian errors with the covariance (K, 3, 3) of a frame taken at random."""
    shape = (max(1, _SAMPLES // len(covariance)), len(covariance), 3, 1)
    return _half_widths(
        np.linalg.cholesky(covariance) @ np.random.default_rng(seed).standard_normal(shape)
    )


def _calibration_half_widths(
    post: Posterior,
    together: FloatArray,
    apart: FloatArray,
    sigmas: tuple[FloatArray, FloatArray],
    seed: int,
) -> list[FloatArray]:
    """Half-widths of common rotation, rest and total: first-order errors of draws and frames,
    scaled to `sigmas`.
    """
    shift = post.theta_draws - post.mean
    common = _scaled(shift @ together.T, sigmas[0])
    rng = np.random.default_rng(seed)
    draw, frame = rng.integers(len(shift), size=_SAMPLES), rng.integers(len(apart), size=_SAMPLES)
    rest = _scaled(np.einsum("np,nip->ni", shift[draw], apart[frame]), sigmas[1])
    return [_half_widths(errors) for errors in (common, rest, rest + common[draw])]


def _with_sigmas(covariance: FloatArray, sigma: FloatArray) -> FloatArray:
    """A first-order covariance (3, 3) with the correlations it has, and these standard
    deviations.
    """
    own = np.sqrt(np.diag(covariance))
    scale = np.divide(sigma, own, out=np.zeros(3), where=own > 0.0)
    scaled: FloatArray = covariance * np.outer(scale, scale)
    return scaled


def _scaled(errors: FloatArray, sigma: FloatArray) -> FloatArray:
    own = np.sqrt(np.mean(errors.reshape(-1, 3) ** 2, axis=0))
    scaled: FloatArray = errors * (sigma / np.where(own > 0.0, own, 1.0))
    return scaled


def _half_widths(errors: FloatArray) -> FloatArray:
    """Quantiles of the absolute errors (..., 3) over all leading axes: (2, 4), rad, the last across
    the boresight.
    """
    e = np.abs(errors.reshape(-1, 3))
    widths: FloatArray = np.quantile(
        np.column_stack((e, np.hypot(e[:, 0], e[:, 1]))), _LEVELS, axis=0
    )
    return widths


def spread(response: FloatArray, covariance: FloatArray) -> FloatArray:
    """Diagonal (..., 3) of ``response @ covariance @ response^T`` for responses (..., 3, p)."""
    diagonal: FloatArray = np.sum((response @ covariance) * response, axis=-1)
    return diagonal


def _diagonal(matrices: FloatArray) -> FloatArray:
    diagonal: FloatArray = np.diagonal(matrices, axis1=-2, axis2=-1)
    return diagonal


def _rms(variances: FloatArray) -> FloatArray:
    """Root of the mean over frames of variances (K, 3)."""
    root: FloatArray = np.sqrt(variances.mean(axis=0))
    return root
