"""The paper's experiment over seeds: every method on the same data, again and again, against what it claims.

A replicate draws new attitudes and new noise, and all methods calibrate the same stars. What is stored is raw:
estimates, the sigmas that each method gives, and the Cramer-Rao bound of the design at the truth.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from starcal_uq.core.errors import CalibrationError, DistortionError, SamplingError, StarcalError
from starcal_uq.core.provenance import provenance
from starcal_uq.core.tasks import Progress, run_tasks
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.estimation.marginal import MarginalLikelihood
from starcal_uq.estimation.pairs import PairObjective
from starcal_uq.maths.linear import inverse_diagonal
from starcal_uq.observations.frames import StarFrames
from starcal_uq.paper.camera import paper_camera, paper_start
from starcal_uq.paper.errors import map_error, reprojection_error_px
from starcal_uq.paper.methods import METHODS, Method
from starcal_uq.paper.replicates_result import Replicates
from starcal_uq.simulation.frames import simulate

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.estimation.calibration import Calibration
    from starcal_uq.observations.table import Observations
    from starcal_uq.sky.catalogue import StarCatalogue

# A replicate takes about half a second at a thousand frames.
_CHUNK = 2


@dataclass(frozen=True)
class Experiment:
    """What all replicates share; sent once to every process.

    Attributes
    ----------
    stars : StarCatalogue
        Sky.
    methods : tuple of Method
        Who calibrates.
    truth, start : Camera
        What is simulated, and where every method starts.
    n_frames, min_stars, sigma_px
        As in `simulate`.
    seed : int
        Replicate i depends on the seed and on i alone.
    """

    stars: StarCatalogue
    methods: tuple[Method, ...]
    truth: Camera
    start: Camera
    n_frames: int
    min_stars: int
    sigma_px: float
    seed: int


class Outcome(NamedTuple):
    """One replicate, for M methods and p parameters.

    Attributes
    ----------
    replicate : int
        Its number.
    estimates, claimed, classical : (M, p) arrays
        Estimates, their claimed standard deviations, and those of textbooks; NaN where there is none.
    crlb : (p,) array
        Cramer-Rao bound on the standard deviations, for this design at the truth.
    map_px, map_arcsec, reprojection_px : (M,) arrays
        Errors of the estimated cameras over the field (see `Replicates`); NaN where there is none.
    failures : tuple of str
        Why a method has no result; empty where it has.
    """

    replicate: int
    estimates: FloatArray
    claimed: FloatArray
    classical: FloatArray
    crlb: FloatArray
    map_px: FloatArray
    map_arcsec: FloatArray
    reprojection_px: FloatArray
    failures: tuple[str, ...]


def replicate(
    *,
    methods: Sequence[Method] = METHODS,
    truth: Camera | None = None,
    start: Camera | None = None,
    n_replicates: int = 200,
    n_frames: int = 1000,
    min_stars: int = 10,
    sigma_px: float = 0.05,
    max_mag: float = 6.0,
    seed: int = 2017,
    workers: int | None = None,
    progress: Progress | None = None,
    stars: StarCatalogue | None = None,
) -> Replicates:
    """Calibrate many simulated data sets with every method, and set their errors against their claims.

    Parameters
    ----------
    methods : sequence of Method
        Methods to compare, each with a label of its own.
    truth, start : Camera, optional
        The camera that is simulated, and the start of every method; the paper's by default.
    n_replicates : int
        Data sets; 200 know a spread to 5 % and a coverage of 95 % to 1.5 %.
    n_frames, min_stars, sigma_px, max_mag
        Data of one calibration: frames, least stars in each, centroid noise in px per axis, and limiting magnitude.
    seed : int
        The same seed gives the same result, bit for bit, for any number of processes; the first replicates of a longer
        run are those of a shorter one.
    workers : int, optional
        Processes; as many as there are processors by default. With 0, everything happens in this process, where a BLAS
        with several threads can change the last digits.
    progress : callable, optional
        Called as ``progress(done, total)``.
    stars : StarCatalogue, optional
        The sky, instead of the embedded catalogue to `max_mag`.

    Returns
    -------
    Replicates
        After Ctrl-C, with the replicates that were complete by then.

    Raises
    ------
    SamplingError
        For settings that cannot work, or processes that cannot be started.
    CatalogueError
        When the field is too narrow for the catalogue to show `min_stars`.
    CalibrationError
        When a method never gave a result.
    """
    from starcal_uq.sky.catalogue import load_catalogue

    methods = tuple(methods)
    truth = paper_camera() if truth is None else truth
    start = paper_start() if start is None else start
    _check(methods, truth, start, n_replicates, n_frames, min_stars, sigma_px, workers)
    sky = load_catalogue(max_mag=max_mag) if stars is None else stars
    experiment = Experiment(sky, methods, truth, start, n_frames, min_stars, sigma_px, seed)
    outcomes, interrupted = run_tasks(
        partial(run_replicate, experiment),
        n_replicates,
        caller="replicate",
        chunk=_CHUNK,
        workers=workers,
        progress=progress,
    )
    failures = tuple(zip(*(outcome.failures for outcome in outcomes), strict=True))
    for method, reasons in zip(methods, failures, strict=True):
        if all(reasons):
            raise CalibrationError(f"the method {method.label!r} never gave a result; first reason: {reasons[0]}")
    settings: AnyDict = {
        "n_replicates": n_replicates,
        "n_frames": n_frames,
        "min_stars": min_stars,
        "sigma_px": sigma_px,
        "max_mag": max_mag,
        "stars": "embedded" if stars is None else stars.source,
    }
    return Replicates(
        methods=methods,
        truth=truth,
        start=start,
        replicate=np.array([outcome.replicate for outcome in outcomes]),
        estimates=np.stack([outcome.estimates for outcome in outcomes], axis=1),
        claimed=np.stack([outcome.claimed for outcome in outcomes], axis=1),
        classical=np.stack([outcome.classical for outcome in outcomes], axis=1),
        crlb=np.stack([outcome.crlb for outcome in outcomes]),
        map_px=np.stack([outcome.map_px for outcome in outcomes], axis=1),
        map_arcsec=np.stack([outcome.map_arcsec for outcome in outcomes], axis=1),
        reprojection_px=np.stack([outcome.reprojection_px for outcome in outcomes], axis=1),
        failures=failures,
        n_requested=n_replicates,
        interrupted=interrupted,
        provenance=provenance(seed, settings, None),
    )


def run_replicate(experiment: Experiment, index: int) -> Outcome:
    """Replicate number `index`; a calibration that fails is an outcome, a sky without stars an error."""
    noise = np.random.SeedSequence(experiment.seed, spawn_key=(index,))
    truth = experiment.truth
    obs = simulate(
        experiment.stars,
        truth,
        n_frames=experiment.n_frames,
        min_stars=experiment.min_stars,
        sigma_px=experiment.sigma_px,
        seed=int(noise.generate_state(1, np.uint64)[0]),
    )
    frames = StarFrames.from_observations(obs)
    p, m = len(truth.theta), len(experiment.methods)
    estimates, claimed, classical = (np.full((m, p), np.nan) for _ in range(3))
    errors = np.full((3, m), np.nan)
    failures = [""] * m
    for i, solved in enumerate(solve_all(experiment.methods, obs, frames, experiment.start)):
        if isinstance(solved, StarcalError):
            failures[i] = str(solved)
            continue
        # Methods that leave the distortion out have the optics only.
        q = len(solved.sigmas)
        estimates[i, :q], claimed[i, :q], classical[i, :q] = solved.theta, solved.sigmas, solved.classical
        errors[:, i] = field_errors(truth, solved.camera)
    crlb = crlb_sigmas(frames, truth, experiment.sigma_px)
    map_px, map_arcsec, reprojection_px = errors
    return Outcome(
        index, estimates, claimed, classical, crlb, map_px, map_arcsec, reprojection_px, failures=tuple(failures)
    )


def field_errors(truth: Camera, estimate: Camera) -> tuple[float, float, float]:
    """Root mean square errors over the detector without noise; NaN where the estimated distortion folds over.

    Returns
    -------
    map_px, map_arcsec : float
        Of the directions, best common rotation removed (`map_error`).
    reprojection_px : float
        Eq. 16 of the paper (`reprojection_error_px`).
    """
    try:
        directions = map_error(truth, estimate)
        points = reprojection_error_px(truth, estimate, directions.xy_px)
    except DistortionError:
        return np.nan, np.nan, np.nan
    mean_square = np.sum(directions.weight * np.sum(points.error_px**2, axis=1))
    return directions.rms_px, directions.rms_arcsec, float(np.sqrt(mean_square))


def crlb_sigmas(frames: StarFrames, truth: Camera, sigma_px: float) -> FloatArray:
    """Cramer-Rao bound (p,) on the standard deviations: all parameters unknown, and the attitude of every frame."""
    likelihood = MarginalLikelihood(frames, truth.distortion)
    return np.sqrt(inverse_diagonal(likelihood.evaluate(truth.theta).matrix)) * sigma_px


def _check(
    methods: tuple[Method, ...],
    truth: Camera,
    start: Camera,
    n_replicates: int,
    n_frames: int,
    min_stars: int,
    sigma_px: float,
    workers: int | None,
) -> None:
    labels = [method.label for method in methods]
    twice = sorted({label for label in labels if labels.count(label) > 1})
    for good, text in (
        (bool(methods), "there are no methods to compare: give at least one."),
        (not twice, f"several methods have the label {' and '.join(map(repr, twice))}: give each its own."),
        (
            truth.distortion == start.distortion,
            f"the truth has distortion {truth.distortion!r} and the start {start.distortion!r}: give both the same.",
        ),
        (n_replicates >= 2, f"n_replicates is {n_replicates}: a spread needs at least 2."),
        (n_frames >= 1, f"n_frames is {n_frames}: give at least 1."),
        (min_stars >= 3, f"min_stars is {min_stars}: an attitude needs at least 3."),
        (0.0 < sigma_px < np.inf, f"sigma_px is {sigma_px:g}: give a noise above zero."),
        (workers is None or workers >= 0, f"workers is {workers}: give at least 1, or 0 for this process."),
    ):
        if not good:
            raise SamplingError(text)


@dataclass(frozen=True)
class Solved:
    """What a method found.

    Attributes
    ----------
    camera : Camera
        The estimate.
    theta : (p,) array
        Its parameters, px units.
    sigmas : (p,) array
        Its standard deviations, as the method claims them.
    classical : (p,) array
        Those of textbooks: for least squares over pairs ``(J^T J)^-1 s^2``, which presumes that pairs are independent,
        although the m (m - 1) / 2 pairs of m stars hold 2 m - 3 independent numbers; for a filter its own, which
        presume that its model holds. NaN where there is none, or where it is what the method claims anyway.
    """

    camera: Camera
    theta: FloatArray
    sigmas: FloatArray
    classical: FloatArray


def solve_all(
    methods: Sequence[Method], obs: Observations, frames: StarFrames, start: Camera
) -> list[Solved | StarcalError]:
    """Every method's result, or why it has none; `frames` are those of `obs`.

    The first stage of the efficient method is least squares, and its third is the paper's method: where it is among the
    methods and converges, they are taken from it.
    """
    found: dict[Method, Solved | StarcalError] = {}
    efficient = [method for method in methods if method.method == "efficient"]
    others = [method for method in methods if method.method != "efficient"]
    whole: Calibration | None = None
    for method in (*efficient, *others):
        try:
            if whole is not None and method.method in _STAGES:
                found[method] = _STAGES[method.method](whole, frames)
                continue
            cal = method.calibrate(obs, start)
            found[method] = _solved(cal, frames)
            whole = cal if method.method == "efficient" else whole
        except StarcalError as error:
            found[method] = error
    return [found[method] for method in methods]


def _solved(cal: Calibration, frames: StarFrames) -> Solved:
    classical = np.full(len(cal.theta), np.nan)
    if cal.method in _STAGES:
        classical = textbook_sigmas(PairObjective(frames, cal.camera.distortion), cal.theta)
    for stage in cal.stages:
        if stage.sigmas is not None:
            classical = np.where(stage.sigmas[-1] > 0.0, stage.sigmas[-1], np.nan)
    return Solved(cal.camera, cal.theta, cal.sigmas, classical)


def _first_stage(whole: Calibration, frames: StarFrames) -> Solved:
    theta = whole.stages[0].theta[:3]
    pairs = PairObjective(frames, "none")
    camera = whole.nominal.replace(distortion="none", coefficients=()).with_theta(theta)
    return Solved(camera, theta, np.sqrt(np.diag(pairs.godambe(theta))), textbook_sigmas(pairs, theta))


def _third_stage(whole: Calibration, frames: StarFrames) -> Solved:
    theta = whole.pair_theta
    pairs = PairObjective(frames, whole.nominal.distortion)
    sigmas = np.sqrt(np.diag(whole.pair_covariance))
    return Solved(whole.nominal.with_theta(theta), theta, sigmas, textbook_sigmas(pairs, theta))


_STAGES = {"least_squares": _first_stage, "three_stage": _third_stage}


def textbook_sigmas(pairs: PairObjective, theta: FloatArray) -> FloatArray:
    """Standard deviations (p,) of least squares over pairs, ``(J^T J)^-1 s^2``, as if pairs were independent."""
    normal = pairs.evaluate(theta)
    variance = normal.cost / (pairs.n_pairs - len(theta))
    return np.sqrt(inverse_diagonal(normal.matrix) * variance)


# One in so many replicates for options of a method, which are there to show what they claim.
SHARE = 4


_LEAST = 8


def is_slow(method: Method) -> bool:
    """Whether a method takes part in one of `SHARE` replicates only: the filter that forms every pair."""
    return method.recursion is not None and method.recursion.pair_covariance == "diagonal"


def replicate_shared(
    truth: Camera,
    start: Camera,
    *,
    n_replicates: int,
    n_frames: int,
    seed: int,
    workers: int | None,
    progress: Progress | None,
    methods: Sequence[Method] = METHODS,
) -> Replicates:
    """As `replicate`, but with slow methods in the first replicates only; the others hold NaN for them.

    Raises
    ------
    SamplingError
        If processes cannot be used.
    CalibrationError
        When a method never gave a result.
    """
    fast, slow = (tuple(m for m in methods if is_slow(m) is kind) for kind in (False, True))
    options: AnyDict = {"truth": truth, "start": start, "n_frames": n_frames, "seed": seed, "workers": workers}
    n_few = min(n_replicates, max(_LEAST, n_replicates // SHARE)) if slow else 0
    total = n_replicates + n_few

    def part(before: int) -> Progress | None:
        return None if progress is None else lambda done, _: progress(before + done, total)

    most = replicate(methods=fast, n_replicates=n_replicates, progress=part(0), **options)
    if not slow or most.interrupted:
        return most
    few = replicate(methods=slow, n_replicates=n_few, progress=part(n_replicates), **options)
    return joined(most, few, methods)


def joined(most: Replicates, few: Replicates, methods: Sequence[Method]) -> Replicates:
    """Two sets of replicates with different methods as one.

    Parameters
    ----------
    most, few : Replicates
        Of the same seed, truth and start; the replicates of `few` are the first ones of `most`, with the same data.
    methods : sequence of Method
        Those of both, in the order of the result.

    Raises
    ------
    ValueError
        When the replicates of `few` are not the first ones of `most`.
    """
    n, k = most.n_replicates, few.n_replicates
    if not np.array_equal(most.replicate[:k], few.replicate) or not np.allclose(most.crlb[:k], few.crlb):
        raise ValueError("the replicates to join are not of the same data: give both the same seed and settings.")

    def one(name: str, method: Method) -> FloatArray:
        if method in most.methods:
            return np.asarray(getattr(most, name)[most.methods.index(method)])
        values = getattr(few, name)[few.methods.index(method)]
        padding = np.full((n - k, *values.shape[1:]), np.nan)
        return np.concatenate([values, padding])

    arrays = ("estimates", "claimed", "classical", "map_px", "map_arcsec", "reprojection_px")
    none = ("",) * (n - k)
    failures = tuple(
        most.failures[most.methods.index(m)] if m in most.methods else (*few.failures[few.methods.index(m)], *none)
        for m in methods
    )
    changes: AnyDict = {name: np.stack([one(name, method) for method in methods]) for name in arrays}
    interrupted = most.interrupted or few.interrupted
    return dataclasses.replace(most, methods=tuple(methods), failures=failures, interrupted=interrupted, **changes)
