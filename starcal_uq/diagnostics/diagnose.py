"""Everything that questions the model of a run, in one result that is stored with it.

The tests for misfit and for errors of the stars, the jackknife, the comparison of distortion
models, the posterior predictive check and fits from other starts take seconds; the report reads
what is stored, and leaves out what was made from another calibration.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from starcal_uq.calibration.calibrate import METHODS, calibrate
from starcal_uq.calibration.cameras import MixedCameras
from starcal_uq.camera.distortion import rivals
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import StarcalError
from starcal_uq.core.provenance import Provenance, provenance
from starcal_uq.core.records import Saved
from starcal_uq.core.remedy import RUN, Remedy
from starcal_uq.core.settings import Seed, bounded, seed_of
from starcal_uq.core.status import Level
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.types import FloatArray, Progress
from starcal_uq.diagnostics.air import AirTest, air_test
from starcal_uq.diagnostics.beside import without_effects
from starcal_uq.diagnostics.jackknife import Jackknife, jackknife_frames, jackknife_of_all
from starcal_uq.diagnostics.misfit import ALPHA, Misfit, misfit_tests
from starcal_uq.diagnostics.models import ModelComparison, compare_models
from starcal_uq.diagnostics.predictive import PredictiveCheck, predictive_check
from starcal_uq.diagnostics.residuals import of_heard, of_some_frames
from starcal_uq.diagnostics.stars import StarTest, star_test
from starcal_uq.diagnostics.times import (
    TimeTest,
    UnseenAberration,
    remainder,
    time_test,
    unseen_aberration,
)
from starcal_uq.diagnostics.verdict.observed import terms
from starcal_uq.estimation.assemble import raise_unless_good
from starcal_uq.estimation.effects import with_effects
from starcal_uq.estimation.normals import FrameNormals
from starcal_uq.estimation.result import Calibration
from starcal_uq.estimation.ties import without_ties
from starcal_uq.estimation.weights import by_noise_model, weighed
from starcal_uq.observations.splits import frame_sample
from starcal_uq.propagation.onboard import Extended

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.partitions import PartitionedObservations
    from starcal_uq.observations.table import Observations

# Most frames that tests use whose sample of so many shows all that matters; more for errors of the
# stars, whose effect grows beside the noise of more frames.
_FRAMES, _STAR_FRAMES = 10_000, 20_000
# How far the other starts are from the nominal camera: of its focal length, and of the detector's
# longer side.
_START_FOCAL, _START_CENTRE = 0.05, 0.1
_SAME_SIGMA, _BETTER = 0.1, 1e-6
# Stars and frames that fits from other starts need, and how far chance puts their optimum from that
# of all.
_START_STARS, _FEWEST_FRAMES, _NEAR_SIGMA = 3000, 200, 6.0


@dataclass(frozen=True)
class MultiStart:
    """Fits from other starts.

    Attributes
    ----------
    n : int
        Starts.
    same : int
        Starts that reached the same optimum, within a tenth of a standard deviation of every
        parameter.
    better : int
        Starts that reached a better one.
    failed : int
        Starts that did not converge.
    largest_sigma : float
        Largest difference among those that reached the same optimum, standard deviations.
    n_frames : int
        Frames that were fitted, of `of_frames`; 0 in a diagnosis of a version that took all.
    of_frames : int
        Frames of the calibration.
    start : tuple of float
        Start that reached the best optimum, where that is a better one: focal length, principal
        point (px); else empty.
    focal_unit : str
        Unit of its focal length: "mm", or "px" where the pixel pitch is unknown.
    """

    n: int
    same: int
    better: int
    failed: int
    largest_sigma: float
    n_frames: int = 0
    of_frames: int = 0
    start: tuple[float, ...] = ()
    focal_unit: str = "mm"


@dataclass(frozen=True)
class Diagnosis(Shown, Saved):
    """Results of all tests of the model of a run.

    Attributes
    ----------
    misfit : Misfit
        Tests for structure in the residuals.
    predictive : PredictiveCheck
        Statistics of the residuals against data that the model makes.
    jackknife : Jackknife or None
        None for fewer than three frames.
    comparison : ModelComparison or None
        None if it was not asked for.
    starts : MultiStart or None
        None if it was not asked for.
    theta : tuple of float
        The estimate that all this is about.
    provenance : Provenance
        Seed, settings, versions, time and data hash.
    stars : StarTest or None
        Errors that stars bring along; None in a diagnosis of an earlier version.
    air : AirTest or None
        Refraction in the residuals; None where there cannot be any, or in a diagnosis of an earlier
        version.
    cameras : MixedCameras or None
        Several cameras, where the frames' own focal lengths ask for them.
    times : TimeTest or None
        Another time or epoch, where the residuals ask for one.
    aberration : UnseenAberration or None
        What aberration that is left out or applied twice would do to f unseen; None where it would
        be seen, or in a diagnosis of an earlier version.
    extended : Extended or None
        The calibration with the effects that the data would take up: of one without any in whose
        residuals the tests find structure.
    assessed : bool
        Whether it is known what the structure that was found does to attitudes: it was looked which
        effects the data would take up, or there was no need to. False in a diagnosis of an earlier
        version.
    """

    misfit: Misfit
    predictive: PredictiveCheck
    jackknife: Jackknife | None
    comparison: ModelComparison | None
    starts: MultiStart | None
    theta: tuple[float, ...]
    provenance: Provenance
    stars: StarTest | None = None
    air: AirTest | None = None
    cameras: MixedCameras | None = None
    times: TimeTest | None = None
    aberration: UnseenAberration | None = None
    extended: Extended | None = None
    assessed: bool = False

    FILE = "a diagnosis", Remedy("diagnose", (RUN,), {"force": True}, "to write it again")

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects that the data support."""
        return () if self.extended is None else self.extended.effects.names

    @property
    def better(self) -> str | None:
        """The model that the comparison prefers, empty if none; None without a comparison."""
        found = self.comparison
        # What some frames do not show, all may.
        return None if found is None else found.better or (None if found.of_frames else "")

    def is_of(self, cal: Calibration) -> bool:
        """True if this calibration is the one that was diagnosed."""
        same_data = self.provenance.data_sha256 == cal.provenance.data_sha256
        return same_data and list(self.theta) == cal.theta.tolist()


@dataclass(frozen=True)
class Apart:
    """The part of a `Diagnosis` that takes data and estimate alone, and little to load: what can be
    found beside.
    """

    misfit: Misfit
    starts: MultiStart | None
    stars: StarTest
    air: AirTest | None
    cameras: MixedCameras | None
    times: TimeTest | None
    aberration: UnseenAberration | None
    extended: Extended | None
    assessed: bool


class LeftOut(NamedTuple):
    """The part of a `Diagnosis` that leaves frames out."""

    jackknife: Jackknife | None
    comparison: ModelComparison | None


@one_thread()
def diagnose_apart(
    obs: Observations,
    cal: Calibration,
    *,
    n_starts: int = 5,
    seed: int = 0,
    whole: Calibration | None = None,
) -> Apart:
    """Half of what `diagnose` finds, of stars with the noise that the estimate gives them.

    `whole` is the calibration that partitioned observations have, where `cal` is that of their
    sample.
    """
    cal, whole = without_ties(obs, cal), whole if whole is None else without_ties(obs, whole)
    stars = star_test(*of_some_frames(weighed(obs, cal), cal, _STAR_FRAMES, seed))
    rest = remainder(obs, cal, seed)
    misfit = misfit_tests(obs, whole or cal, most_frames=_FRAMES, seed=seed)
    asked, assessed = extended(obs, whole or cal, misfit)
    return Apart(
        misfit=misfit,
        # Where the stars alone leave parameters open, starts without rotations end anywhere.
        starts=multi_start(obs, cal, n_starts, seed) if n_starts > 0 and not cal.ties else None,
        stars=stars,
        air=air_test(obs, cal, seed=seed, stars=stars),
        cameras=MixedCameras.of(obs, cal.camera),
        times=time_test(obs, cal, seed=seed, rest=rest),
        aberration=unseen_aberration(obs, cal, seed=seed, rest=rest),
        extended=asked,
        assessed=assessed,
    )


def extended(obs: Observations, cal: Calibration, misfit: Misfit) -> tuple[Extended | None, bool]:
    """The calibration with the effects that the data would take up, where tests find structure
    beside none, and whether that is known.
    """
    found = misfit.found(ALPHA)
    of_files = terms(cal)
    bent = any(not test.is_of_noise for test in found)
    if of_files is not None and of_files.level is not Level.PASS:
        bent = True
    looked = cal.known_effects.fitted or cal.known_effects.selected
    if looked or not (found or bent):
        return None, True
    if cal.method != "efficient" or cal.partitions is not None:
        return None, not bent
    try:
        made = with_effects(*of_heard(obs, cal))
    except StarcalError:
        return None, not bent
    if not made.known_effects.fitted:
        return None, True
    effects = made.known_effects.about(made.compressed, np.zeros(len(made.theta)), made.covariance)
    return Extended(made.camera, made.covariance, effects, made.provenance), True


@bounded
@one_thread()
def diagnose(
    obs: Observations | PartitionedObservations,
    cal: Calibration,
    post: Posterior | None = None,
    *,
    models: Sequence[str] | None = None,
    n_starts: int = 5,
    seed: Seed = 0,
    progress: Progress | None = None,
    apart: Callable[[], Apart | None] | None = None,
    left_out: Callable[[], LeftOut | None] | None = None,
) -> Diagnosis:
    """Test the model of a calibration in every available way.

    Parameters
    ----------
    obs, cal
        The data and the estimate. Of partitioned observations the sample of frames that the
        calibration has kept is questioned, and what compares estimates starts from that of the
        sample.
    post : Posterior, optional
        For the posterior predictive check; the calibration's normal approximation otherwise.
    models : sequence of str, optional
        Distortion models to compare, by default `starcal_uq.camera.distortion.rivals`; none to
        leave the comparison out.
    n_starts : int
        Fits from other starts; 0 leaves them out.
    seed : int or Generator
        Seed of everything random.
    progress : callable, optional
        Called with the number of steps done and their total.
    apart, left_out : callable, optional
        Calls that wait for `diagnose_apart` and `leave_frames_out` of the same arguments, which run
        elsewhere; what gives None is computed here.
    """
    seed = seed_of(seed)
    step = progress or (lambda done, total: None)
    models = rivals(cal.camera.distortion) if models is None else models
    obs = weighed(obs, cal)
    theta = cal.theta
    # What stars say of their model they say without rotations that others measured.
    cal = whole = without_ties(obs, cal)
    if obs.n_frames < whole.n_frames and whole.partitions is not None:
        effects = whole.known_effects.names
        model = whole.nominal.model
        cal = calibrate(obs, whole.nominal, model=model, effects=effects, duplicates="keep")
    predictive = predictive_check(obs, whole, post, seed=seed)
    step(1, 4)
    frames = None if left_out is None else left_out()
    if frames is None:
        frames = leave_frames_out(obs, cal, models=models, seed=seed)
    step(2, 4)
    rest = None if apart is None else apart()
    step(3, 4)
    if rest is None:
        rest = diagnose_apart(obs, cal, n_starts=n_starts, seed=seed, whole=whole)
    step(4, 4)
    settings = {"models": list(models), "n_starts": n_starts}
    return Diagnosis(
        predictive=predictive,
        jackknife=jackknife_of_all(whole) or frames.jackknife,
        comparison=frames.comparison,
        theta=tuple(theta.tolist()),
        provenance=provenance(seed, settings, whole.data_hash_of(obs)),
        **vars(rest),
    )


@one_thread()
def leave_frames_out(
    obs: Observations,
    cal: Calibration,
    *,
    models: Sequence[str] | None = None,
    seed: int = 0,
) -> LeftOut:
    """The two tests that leave frames out, which share what the frames say about the parameters."""
    cal = without_ties(obs, cal)
    models = rivals(cal.camera.distortion) if models is None else models
    obs, cal, of_frames = of_some_frames(weighed(obs, cal), cal, _FRAMES, seed)
    normals = None if cal.known_effects.fitted else FrameNormals.at(obs, cal)
    comparison = None
    # A single frame cannot be left out, and a field holds what other models would add to the lens.
    if models and obs.n_frames > 1 and "field" not in cal.known_effects.names:
        comparison = compare_models(
            obs, cal, models, seed=seed, normals=normals, of_frames=of_frames
        )
    return LeftOut(_jackknife(obs, cal, normals, of_frames), comparison)


def _jackknife(
    obs: Observations, cal: Calibration, normals: FrameNormals | None, of_frames: int
) -> Jackknife | None:
    try:
        return jackknife_frames(obs, cal, normals, of_frames)
    except StarcalError:
        # Too few frames: the report then says that there is none.
        return None


def multi_start(obs: Observations, cal: Calibration, n: int, seed: int = 0) -> MultiStart:
    """Calibrate from n starts scattered around the nominal camera, and count the optima.

    One standard deviation of the starts is 5 % of the focal length and a tenth of the detector.
    Where there are many frames, a few hundred of them have the same optima: the starts are then
    compared with the optimum of these, if the estimate is as near to it as chance has it.
    """
    rng = np.random.default_rng((seed, 11))
    nominal = cal.nominal
    side = _START_CENTRE * max(nominal.width_px, nominal.height_px)
    same = better = failed = 0
    largest = 0.0
    best: tuple[float, tuple[float, ...]] = (np.inf, ())
    # Effects, and the tails and noise beside them, are those of images that are freed of them.
    obs = without_effects(by_noise_model(obs, cal), cal)
    some = _few(obs)
    sigmas = cal.sigmas * np.sqrt(obs.n_stars / some.n_stars)
    reference, lowest = cal.theta, cal.chi2
    # Tails beside a noise model are estimated in turns, which end a little beside this optimum.
    if some is not obs or cal.has_tails or cal.known_effects.fitted:
        try:
            optimum, found = _optimum(some, cal, cal.camera)
        except StarcalError:
            some, sigmas = obs, cal.sigmas
        else:
            # An estimate that is not the optimum of all is not near that of some, and every start
            # finds a better one.
            near = bool(np.max(np.abs(optimum - reference) / sigmas) < _NEAR_SIGMA)
            reference, lowest = (optimum, found) if near else (reference, np.inf)
    for _ in range(n):
        shift = rng.standard_normal(3)
        start = nominal.replace(
            focal_px=nominal.focal_px * float(np.exp(_START_FOCAL * shift[0])),
            x0_px=float(np.clip(nominal.x0_px + side * shift[1], 0.0, nominal.width_px - 1.0)),
            y0_px=float(np.clip(nominal.y0_px + side * shift[2], 0.0, nominal.height_px - 1.0)),
        )
        try:
            theta, chi2 = _optimum(some, cal, start)
        except StarcalError:
            failed += 1
            continue
        difference = float(np.max(np.abs(theta - reference) / sigmas))
        if difference < _SAME_SIGMA:
            same += 1
            largest = max(largest, difference)
        elif chi2 < lowest * (1.0 - _BETTER):
            better += 1
            best = min(best, (chi2, (start.focal_mm or start.focal_px, start.x0_px, start.y0_px)))
    unit = "px" if nominal.focal_mm is None else "mm"
    return MultiStart(n, same, better, failed, largest, some.n_frames, obs.n_frames, best[1], unit)


def _few(obs: Observations) -> Observations:
    """All frames, or so many of them that they hold enough stars for an optimum."""
    return frame_sample(obs, max(_FEWEST_FRAMES, _START_STARS * obs.n_frames // obs.n_stars))[0]


def _optimum(obs: Observations, cal: Calibration, start: Camera) -> tuple[FloatArray, float]:
    """Estimate and sum of squares that a calibration like this one reaches from a start."""
    method = cal.method if cal.method in METHODS else "efficient"
    effects = "tails" if cal.has_tails else "none"
    found = calibrate(
        obs,
        start,
        model=start.model,
        method=method,
        duplicates="keep",
        effects=effects,
        throw=False,
    )
    if not found.undetermined:
        raise_unless_good(found.status)
    return found.theta, found.chi2
