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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, get_args

import numpy as np

from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.errors import SamplingError
from starcal_uq.core.settings import OnboardModel, Seed, bounded, seed_of
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.types import FloatArray, PathLike
from starcal_uq.maths.linear import mean_weights, root_diagonal
from starcal_uq.propagation.alignment import alignment_frames as _alignment_frames
from starcal_uq.propagation.attitude_error import (
    OBSERVED,
    AttitudeError,
)
from starcal_uq.propagation.geometry import FrameGeometry
from starcal_uq.propagation.onboard import Aboard, Extended, Turns
from starcal_uq.propagation.onboard_error import PARAMETERS, EffectError, OnboardError
from starcal_uq.propagation.sampled import Sampled, spread, through_quest
from starcal_uq.propagation.thermal import TemperatureProfile, ThermalResponse, thermal_error

if TYPE_CHECKING:
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.table import Observations


_LEVELS = (0.95, 0.997)
_SAMPLES = 400_000
_COLUMNS = 10


@bounded
@one_thread()
def propagate(
    post: Posterior,
    obs: Observations,
    *,
    n_draws: int = 300,
    seed: Seed = 0,
    alignment: Observations | str | None = None,
    alignment_frames: int | None = None,
    onboard: OnboardModel = "model",
    calibrated: Observations | None = None,
    temperature_profile: TemperatureProfile | PathLike | None = None,
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
    seed : int or Generator
        Chooses them, the noise, and a random sky.
    alignment : Observations or str, optional
        Frames on which alignment is calibrated in flight: ``random`` (by default) for a random sky
        with as many stars a frame as `obs`, ``observed`` for `obs` itself, or a table.
    alignment_frames : int, optional
        Number of frames of the random sky; 100 by default.
    onboard : {"model", "effects"}
        What the mission's software uses, where the calibration holds effects. ``model``: the
        parameters of the camera alone, so that effects act on attitudes. ``effects``: what can be
        uploaded (field, axes, temperature, time, phase, magnitude) as well, and only its
        uncertainty is left. Frames and nights of the mission draw their own either way.
    calibrated : Observations, optional
        The table of the calibration, for frames of a mission, where effects change with what a
        table states; `obs` by default. What the mission does not state is drawn from it.
    temperature_profile : TemperatureProfile or path, optional
        Temperatures of the optics over an orbit, for `AttitudeError.thermal`.

    Raises
    ------
    SamplingError
        For fewer than two draws.
    DistortionError
        When a draw folds the distortion within the observed pixels.
    ObservationError
        When the posterior scales stated noises that the observations lack, or the alignment is none
        of these, or effects are those of another table than `calibrated`.
    DegenerateFrameError
        When a frame does not determine an attitude.
    AttitudeProfileError, CalibrationError
        When the temperature profile is wrong, or the calibration holds no effect of the
        temperature.
    """
    seed = seed_of(seed)
    draws = post.thin(n_draws, seed)[:, :-1]
    count = len(draws)
    if count < 2:
        raise SamplingError("propagation needs at least two posterior draws: raise n_draws.")
    frames = FrameGeometry.of(post, obs)
    aligning, told = _alignment_frames(post, obs, alignment, alignment_frames, seed)
    aligned = frames if aligning is obs else FrameGeometry.of(post, aligning)
    weights, alignment_covariance = mean_weights(aligned.noise_covariance)
    aboard = Aboard(post, obs if calibrated is None else calibrated)
    turns = aboard.turns(frames, obs)
    split = _Split.of(
        turns, None if aligned is frames else aboard.turns(aligned, aligning), weights
    )
    together, moments = split.together, aboard.moments(onboard)
    sampled = through_quest(post, frames, aligned, draws, seed)
    # First order is that of all frames; what is beyond it, that of the sample.
    shift, p = aboard.draws(draws, onboard, seed), len(post.mean)
    common = sampled.common + shift[:, :p] @ (together[:, :p] - sampled.together).T
    common = common + shift[:, p:] @ together[:, p:].T
    nea = frames.noise_covariance
    first = split.variances(moments)
    whole = first.with_sampled(sampled)
    sigmas = whole.sigmas
    interaction = sampled.interaction
    warmth = ThermalResponse.of(post, aboard.calibrated, frames.response, together)
    half_widths = [_noise_half_widths(nea, seed)]
    half_widths += [
        *_calibration_half_widths(
            aboard.draws(post.theta_draws, onboard, seed), split, sigmas, seed
        ),
        _half_widths(interaction),
    ]
    p95, p997 = np.swapaxes(half_widths, 0, 1) * ARCSEC
    noise_sigma = np.sqrt(np.maximum(_diagonal(nea).mean(axis=0) + sampled.noise_excess, 0.0))
    met = interaction.reshape(-1, 3)
    covariances = [
        _with_sigmas(nea.mean(axis=0), noise_sigma),
        *(
            _with_sigmas(own, sigma)
            for own, sigma in zip(split.covariances(moments), sigmas, strict=True)
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
        analytic_common_arcsec=first.sigmas[0] * ARCSEC,
        analytic_rest_arcsec=first.sigmas[1] * ARCSEC,
        n_draws=count,
        n_frames=obs.n_frames,
        n_sampled_frames=len(sampled.places),
        common_draws_arcsec=common * ARCSEC,
        rest_rms_per_frame_arcsec=np.sqrt(whole.rest) * ARCSEC,
        nea_per_frame_arcsec=np.sqrt(_diagonal(nea)) * ARCSEC,
        interaction_arcsec=_rms(interaction.reshape(-1, 3) ** 2) * ARCSEC,
        frames=str(obs.origin.frames or OBSERVED),
        seen=obs,
        total_arcsec=sigmas[2] * ARCSEC,
        analytic_total_arcsec=first.sigmas[2] * ARCSEC,
        rest_constant_arcsec=np.sqrt(whole.constant) * ARCSEC,
        covariance_arcsec2=np.stack(covariances) * ARCSEC**2,
        alignment=told,
        alignment_covariance_arcsec2=alignment_covariance * ARCSEC**2,
        aligned=aligning,
        onboard=onboard,
        variants=_variants(aboard, split, sampled, frames),
        effects_per_frame_arcsec=(
            np.sqrt(_diagonal(_total(turns.own))) * ARCSEC if turns.own else None
        ),
        thermal_response=warmth,
        thermal=(
            None if temperature_profile is None else thermal_error(warmth, temperature_profile)
        ),
    )


@dataclass(frozen=True, eq=False)
class _Split:
    """Turns of K frames as common rotation and rest.

    `response` (K, 3, q) are the turns, of which `together` (3, q) are common. `own` (K, 3, 3),
    `own_together` (3, 3) and `own_apart` (K, 3, 3), each by effect, are covariances of what frames
    draw for themselves.
    """

    response: FloatArray
    together: FloatArray
    own: Mapping[str, FloatArray]
    own_together: Mapping[str, FloatArray]
    own_apart: Mapping[str, FloatArray]

    @classmethod
    def of(cls, turns: Turns, aligned: Turns | None, weights: FloatArray) -> _Split:
        """Turns of frames, and those of the alignment (None: of the same ones), which weighs its
        frames by (n, 3, 3).
        """
        there = turns if aligned is None else aligned
        transposed = np.swapaxes(weights, 1, 2)
        own_together = {
            name: (weights @ own @ transposed).sum(axis=0) for name, own in there.own.items()
        }
        own_apart = {}
        for name, own in turns.own.items():
            # A frame of the alignment itself is part of the mean.
            shared = weights @ own if aligned is None else np.zeros_like(own)
            mean = own_together.get(name, np.zeros((3, 3)))
            own_apart[name] = own + mean - shared - np.swapaxes(shared, 1, 2)
        return cls(
            turns.response,
            np.einsum("nij,njp->ip", weights, there.response),
            turns.own,
            own_together,
            own_apart,
        )

    @cached_property
    def apart(self) -> FloatArray:
        """Turns (K, 3, q) less those in common."""
        return self.response - self.together

    def variances(self, moments: FloatArray) -> _Variances:
        """Variances to first order, for these second moments (q, q)."""
        common = _diagonal(_total(self.own_together))
        constant = spread(self.apart.mean(axis=0), moments) + common
        return _Variances(
            spread(self.together, moments) + common,
            constant,
            spread(self.apart, moments) + _diagonal(_total(self.own_apart)),
            spread(self.response, moments) + _diagonal(_total(self.own)),
        )

    def covariances(self, moments: FloatArray) -> list[FloatArray]:
        """Covariances (3, 3) of common rotation, and mean over frames of rest and whole."""
        return [
            self.together @ moments @ self.together.T + _total(self.own_together),
            (self.apart @ moments @ np.swapaxes(self.apart, 1, 2) + _total(self.own_apart)).mean(
                axis=0
            ),
            (self.response @ moments @ np.swapaxes(self.response, 1, 2) + _total(self.own)).mean(
                axis=0
            ),
        ]

    def share(
        self,
        name: str,
        root: FloatArray,
        expected: FloatArray,
        at: slice,
        sampled: Sampled | None,
    ) -> EffectError:
        """The share of a root (q, m) of the covariance, whose own columns `at` have expected values;
        with what draws show beyond first order.
        """
        spread_out, mean = self.apart @ root, self.apart[:, :, at] @ expected
        constant, drift = spread_out.mean(axis=0), mean - mean.mean(axis=0)
        common = self.together @ root
        covariances = [
            common @ common.T,
            np.einsum("kim,kjm->ij", spread_out, spread_out) / len(mean),
        ]
        if sampled is not None:
            beyond = sampled.beyond_common, sampled.beyond_rest.mean(axis=0)
            covariances = [
                _with_sigmas(own, np.sqrt(np.maximum(np.diag(own) + more, 0.0)))
                for own, more in zip(covariances, beyond, strict=True)
            ]
        covariances[1] += drift.T @ drift / len(mean)
        return EffectError.of(
            name,
            (self.together[:, at] @ expected * ARCSEC, covariances[0] * ARCSEC**2),
            (mean.mean(axis=0) * ARCSEC, covariances[1] * ARCSEC**2),
            np.sum(constant**2, axis=1) * ARCSEC**2,
        )


def _total(own: Mapping[str, FloatArray]) -> FloatArray:
    """Sum over effects of covariances (..., 3, 3); zero where there is none."""
    return sum(own.values(), np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class _Variances:
    """Variances, rad^2, of common rotation and of the mean of the rest (3,), and of rest and whole
    of every frame (K, 3).
    """

    common: FloatArray
    constant: FloatArray
    rest: FloatArray
    whole: FloatArray

    def with_sampled(self, sampled: Sampled) -> _Variances:
        """What draws through QUEST show beyond first order added."""
        n = len(self.rest)
        return _Variances(
            np.maximum(self.common + sampled.beyond_common, 0.0),
            np.maximum(self.constant + sampled.beyond_constant, 0.0),
            np.maximum(self.rest + sampled.over(n, sampled.beyond_rest), 0.0),
            np.maximum(self.whole + sampled.over(n, sampled.beyond_whole), 0.0),
        )

    @property
    def sigmas(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Root mean squares (3,) of common rotation, rest and whole."""
        return np.sqrt(self.common), _rms(self.rest), _rms(self.whole)


def _variants(
    aboard: Aboard, split: _Split, sampled: Sampled, frames: FrameGeometry
) -> tuple[OnboardError, ...]:
    """The calibration's part with every onboard model; none without effects."""
    stars = frames.of_stars
    if aboard.post.effects is None or not (aboard.places or split.own or stars is not None):
        return ()
    own, nothing = _own_effects(split), (np.zeros(3), np.zeros((3, 3)))
    if stars is not None:
        own.append(EffectError.of("star", nothing, (nothing[0], stars * ARCSEC**2), nothing[0]))
    return tuple(_variant(each, aboard, split, own, sampled) for each in get_args(OnboardModel))


def _own_effects(split: _Split) -> list[EffectError]:
    """Shares of effects that every frame draws for itself."""
    nothing = np.zeros(3), np.zeros((3, 3))
    return [
        EffectError.of(
            name,
            (nothing[0], split.own_together.get(name, nothing[1]) * ARCSEC**2),
            (nothing[0], apart.mean(axis=0) * ARCSEC**2),
            nothing[0],
        )
        for name, apart in split.own_apart.items()
    ]


def _variant(
    onboard: OnboardModel,
    aboard: Aboard,
    split: _Split,
    own: Sequence[EffectError],
    sampled: Sampled | None = None,
) -> OnboardError:
    """The calibration's part with one onboard model; to first order without a sample."""
    moments, expected = aboard.moments(onboard), aboard.expected(onboard)
    variances = split.variances(moments)
    sigmas = (variances if sampled is None else variances.with_sampled(sampled)).sigmas
    camera, *effects = (
        split.share(name, root, expected[at], at, sampled if name == PARAMETERS else None)
        for name, at, root in aboard.shares
    )
    common, rest, both = (sigma * ARCSEC for sigma in sigmas)
    return OnboardError(onboard, common, rest, both, (*effects, *own), camera)


def extended_error(
    error: AttitudeError, extended: Extended, post: Posterior, obs: Observations
) -> OnboardError:
    """The calibration's part of an attitude error beside effects that the calibration lacks.

    Aboard are the parameters of the posterior. They err by what the effects move them by, by their
    covariance beside these, and by the effects themselves, to first order.

    Parameters
    ----------
    error : AttitudeError
        The propagated posterior, with its frames.
    extended : Extended
        The calibration with the effects.
    post, obs : Posterior, Observations
        The posterior without them, and the table of the calibration.
    """
    seen = obs if error.seen is None else error.seen
    aligning = seen if error.aligned is None else error.aligned
    frames = FrameGeometry.of(post, seen)
    aligned = frames if aligning is seen else FrameGeometry.of(post, aligning)
    weights, _ = mean_weights(aligned.noise_covariance)
    aboard = Aboard(extended, obs, post.mean)
    turns = aboard.turns(frames, seen)
    there = None if aligned is frames else aboard.turns(aligned, aligning)
    split = _Split.of(turns, there, weights)
    return _variant("model", aboard, split, _own_effects(split))


def _noise_half_widths(covariance: FloatArray, seed: int) -> FloatArray:
    """Half-widths of Gaussian errors with the covariance (K, 3, 3) of a frame taken at random."""
    shape = (max(1, _SAMPLES // len(covariance)), len(covariance), 3, 1)
    return _half_widths(
        np.linalg.cholesky(covariance) @ np.random.default_rng(seed).standard_normal(shape)
    )


def _calibration_half_widths(
    shift: FloatArray, split: _Split, sigmas: Sequence[FloatArray], seed: int
) -> list[FloatArray]:
    """Half-widths of common rotation, rest and total: first-order errors of draws (n, q) and frames,
    scaled to `sigmas`.
    """
    apart = split.apart
    common = _scaled(shift @ split.together.T, sigmas[0])
    rng = np.random.default_rng(seed)
    draw, frame = rng.integers(len(shift), size=_SAMPLES), rng.integers(len(apart), size=_SAMPLES)
    # Few columns at once: there may be a hundred of effects.
    parts = np.array_split(np.arange(_SAMPLES), -(-shift.shape[1] // _COLUMNS))
    errors = np.concatenate(
        [np.einsum("np,nip->ni", shift[draw[part]], apart[frame[part]]) for part in parts]
    )
    if split.own_apart:
        values, vectors = np.linalg.eigh(_total(split.own_apart))
        root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
        errors = errors + np.einsum("nij,nj->ni", root[frame], rng.standard_normal(errors.shape))
    rest = _scaled(errors, sigmas[1])
    return [_half_widths(errors) for errors in (common, rest, rest + common[draw])]


def _with_sigmas(covariance: FloatArray, sigma: FloatArray) -> FloatArray:
    """A first-order covariance (3, 3) with the correlations it has, and these standard
    deviations.
    """
    own = root_diagonal(covariance)
    scale = np.divide(sigma, own, out=np.zeros(3), where=own > 0.0)
    scaled: FloatArray = covariance * np.outer(scale, scale)
    return scaled


def _scaled(errors: FloatArray, sigma: FloatArray) -> FloatArray:
    own = np.sqrt(np.mean(errors.reshape(-1, 3) ** 2, axis=0))
    return errors * (sigma / np.where(own > 0.0, own, 1.0))


def _half_widths(errors: FloatArray) -> FloatArray:
    """Quantiles of the absolute errors (..., 3) over all leading axes: (2, 4), rad, the last across
    the boresight.
    """
    e = np.abs(errors.reshape(-1, 3))
    widths: FloatArray = np.quantile(
        np.column_stack((e, np.hypot(e[:, 0], e[:, 1]))), _LEVELS, axis=0
    )
    return widths


def _diagonal(matrices: FloatArray) -> FloatArray:
    return np.diagonal(matrices, axis1=-2, axis2=-1)


def _rms(variances: FloatArray) -> FloatArray:
    """Root of the mean over frames of variances (K, 3)."""
    root: FloatArray = np.sqrt(variances.mean(axis=0))
    return root
