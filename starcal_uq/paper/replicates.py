"""The paper's experiment over seeds: every method on the same data, again and again, against what
it claims.

A replicate draws new attitudes and new noise, and all methods calibrate the same stars. What is
stored is raw: estimates, the sigmas that each method gives, and the Cramer-Rao bound of the design
at the truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, ClassVar, NamedTuple, Unpack

import numpy as np

from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import parameters
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import (
    CalibrationError,
    DistortionError,
    SamplingError,
    StarcalError,
    require,
)
from starcal_uq.core.provenance import Provenance, provenance
from starcal_uq.core.records import Saved
from starcal_uq.core.remedy import Remedy
from starcal_uq.core.settings import Seed, bounded, seed_of
from starcal_uq.core.types import AnyDict, FloatArray, IntArray
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.pairs import PairObjective
from starcal_uq.maths.intervals import holm
from starcal_uq.maths.linear import inverse_diagonal, root_diagonal
from starcal_uq.observations.frames import StarFrames
from starcal_uq.paper.camera import paper_camera, paper_start
from starcal_uq.paper.errors import map_error, reprojection_error_px
from starcal_uq.paper.recursive.start import RECURSIVE_METHODS, RecursionOptions
from starcal_uq.paper.statistics import FAMILY_LEVEL, classical_words, summarise, words
from starcal_uq.simulation.frames import Campaign
from starcal_uq.simulation.replicates import ReplicateOptions, Trials, campaign_of
from starcal_uq.sky.catalogue import load_catalogue

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations
    from starcal_uq.sky.catalogue import StarCatalogue

# A replicate takes about half a second at a thousand frames.
_CHUNK = 2
# Methods whose textbook claim takes pairs as independent.
_OF_PAIRS = ("least_squares", "three_stage")
# A slow option of a method, which is there to show what it claims, takes part in one of so many
# replicates.
SHARE = 4
_LEAST = 8
_TESTS = ("bias_p", "claimed_p", "coverage95_p", "claimed_classical_p")
# Arrays with one entry for each method and replicate.
_BY_METHOD = ("estimates", "claimed", "classical", "map_px", "map_arcsec", "reprojection_px")
_ARRAYS = ("replicate", "crlb", *_BY_METHOD)


@dataclass(frozen=True)
class Method:
    """A way to calibrate: its label in tables and figures, what it does in one line, and arguments
    of `calibrate`.
    """

    label: str
    description: str
    method: str
    recursion: RecursionOptions | None = None

    def calibrate(self, obs: Observations, start: Camera) -> Calibration:
        """Calibrate observations; recursive methods as a stream.

        A stream gives them the same estimate and covariance, and no residuals and attitudes, which
        take time.
        """
        source = [obs] if self.method in RECURSIVE_METHODS else obs
        return calibrate(source, start, method=self.method, recursion=self.recursion)


METHODS = (
    Method(
        "least squares",
        "optics by least squares on interstar angles, distortion ignored",
        "least_squares",
    ),
    Method(
        "samaan",
        (
            "optics by a Kalman filter on interstar angles with their full covariance, distortion "
            "linearly afterwards"
        ),
        "samaan",
    ),
    Method(
        "samaan, diagonal",
        "the same with the angles of a frame taken as independent, as in the historical filters",
        "samaan",
        RecursionOptions(pair_covariance="diagonal"),
    ),
    Method(
        "griffith",
        (
            "optics by recursive least squares on interstar angles, one frame at a time, "
            "distortion "
            "ignored"
        ),
        "griffith",
    ),
    Method(
        "griffith, all",
        "the same for optics and distortion together",
        "griffith",
        RecursionOptions(parameters="all"),
    ),
    Method(
        "three stages",
        "optics and distortion together by least squares on interstar angles (Ye & Yang 2017)",
        "three_stage",
    ),
    Method(
        "efficient",
        "three stages, then the likelihood of the star positions with the attitudes eliminated",
        "efficient",
    ),
)


@dataclass(frozen=True, eq=False)
class Replicates(Shown, Saved):
    """Estimates and claims of M methods over n replicates, for p parameters of the truth.

    Attributes
    ----------
    methods : tuple of Method
        Who calibrated; all of them the same data.
    truth, start : Camera
        What was simulated, and where every method started.
    replicate : (n,) array of int
        Numbers of the replicates.
    estimates : (M, n, p) array
        Estimates, px units; NaN for parameters that a method leaves out, and where it failed.
    claimed : (M, n, p) array
        The standard deviation that the method gives with each.
    classical : (M, n, p) array
        Standard deviations by the formula of the textbooks: ``(J^T J)^-1 s^2`` with pairs taken as
        independent for least squares over pairs, and a filter's own for filters. NaN where there is
        none.
    crlb : (n, p) array
        Cramer-Rao bound on the standard deviations for each design, at the truth, all p parameters
        and the attitudes unknown.
    map_px, map_arcsec : (M, n) arrays
        Root mean square error over the detector of the directions that an estimated camera gives,
        the best common rotation removed (`starcal_uq.paper.errors.map_error`); NaN where the
        estimated distortion folds over.
    reprojection_px : (M, n) array
        Eq. 16 of the paper over the detector, without noise
        (`starcal_uq.paper.errors.reprojection_error_px`): blind to a wrong focal length.
    failures : tuple of tuple of str
        For each method and replicate why there is no result; empty where there is one.
    n_requested : int
        Replicates asked for.
    interrupted : bool
        Stopped by the user before the last one.
    provenance : Provenance
        Seed, settings, versions and time.
    """

    methods: tuple[Method, ...]
    truth: Camera
    start: Camera
    replicate: IntArray
    estimates: FloatArray
    claimed: FloatArray
    classical: FloatArray
    crlb: FloatArray
    map_px: FloatArray
    map_arcsec: FloatArray
    reprojection_px: FloatArray
    failures: tuple[tuple[str, ...], ...]
    n_requested: int
    interrupted: bool
    provenance: Provenance

    KIND = "starcal_uq replicates 1"
    FILE = "a set of replicates", Remedy("reproduce", purpose="to write it")
    SHAPES: ClassVar = """
        m: methods failures
        n: replicate
        n p: crlb
        m n p: estimates claimed classical
        m n: map_px map_arcsec reprojection_px
    """

    @property
    def n_replicates(self) -> int:
        """Number of replicates."""
        return len(self.replicate)

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the methods."""
        return tuple(method.label for method in self.methods)

    @property
    def bound(self) -> FloatArray:
        """Cramer-Rao bound (p,) on the spread over replicates: root mean square over the
        designs.
        """
        return np.asarray(np.sqrt(np.mean(self.crlb**2, axis=0)))

    def _at(self, label: str) -> int:
        if label not in self.labels:
            raise ValueError(f"there is no method {label!r}: use one of {', '.join(self.labels)}.")
        return self.labels.index(label)

    @cached_property
    def _rows(self) -> list[AnyDict]:
        """Statistics of every method and parameter, with verdicts."""
        rows: list[AnyDict] = []
        for i, method in enumerate(self.methods):
            good = np.isfinite(self.estimates[i, :, 0])
            for j, parameter in enumerate(parameters(self.truth.distortion)):
                error = self.estimates[i, good, j] - self.truth.theta[j]
                if not np.isfinite(error).all():
                    continue
                found = summarise(
                    error,
                    self.claimed[i, good, j],
                    self.classical[i, good, j],
                    float(self.bound[j]),
                )
                head = {"method": method.label, "parameter": parameter.name, "unit": parameter.unit}
                rows.append(head | {"truth": float(self.truth.theta[j])} | found)
        # One family: whoever reads the table looks at every test in it.
        rejected = (holm([row[test] for row in rows for test in _TESTS]) <= FAMILY_LEVEL).reshape(
            -1, len(_TESTS)
        )
        for row, (bias, claim, coverage, classical) in zip(rows, rejected.tolist(), strict=True):
            row["biased"], row["claim_wrong"], row["classical_wrong"] = bias, claim, classical
            row["verdict"] = words(row, bias, claim, coverage)
            row["verdict_classical"] = classical_words(row, classical)
        return rows

    def table(self) -> pd.DataFrame:
        """One row per method and parameter, in px units.

        Columns
        -------
        method, parameter, unit, truth, n
            What, and over how many replicates.
        bias, spread, rmse
            Mean error, standard deviation and root mean square error, ``_se``, ``_over_spread``,
            ``_over_crlb``.
        crlb, efficiency
            Cramer-Rao bound on the spread, and its variance over that of the estimates, with 95 %
            interval. It can exceed one for methods that are biased, or that leave parameters out.
        claimed, claimed_over_spread, claimed_over_rmse
            Root mean square of the method's own standard deviations; over the spread, with 95 %
            interval, and over the root mean square error, bias included.
        coverage95
            How often the claimed 95 % interval holds the truth, with Wilson interval.
        claimed_classical, ...
            The same eight for the formula of the textbooks: pairs taken as independent, or a
            filter's own covariance.
        bias_p, claimed_p, coverage95_p, claimed_classical_p, coverage95_classical_p
            p-values of single tests.
        biased, claim_wrong, classical_wrong, verdict, verdict_classical
            What Holm's procedure over all of them rejects at 1 %: that the mean error is zero, that
            the spread is as claimed, and that it is as the textbooks claim; and in words.
        """
        import pandas as pd

        return pd.DataFrame(self._rows)

    def row(self, label: str, parameter: str) -> AnyDict:
        """The row of the table of one method and parameter."""
        for row in self._rows:
            if (row["method"], row["parameter"]) == (label, parameter):
                return row
        raise ValueError(f"the method {label!r} has no estimate of {parameter!r}.")

    def n_failed(self, label: str) -> int:
        """Number of replicates in which a method gave no result."""
        return sum(map(bool, self.failures[self._at(label)]))


class Experiment(NamedTuple):
    """What all replicates share, as in `replicate`, and in how many slow methods take part; sent to
    every process.
    """

    stars: StarCatalogue
    methods: tuple[Method, ...]
    truth: Camera
    start: Camera
    campaign: Campaign
    n_slow: int


def is_slow(method: Method) -> bool:
    """Whether a method is a filter that forms every pair."""
    return method.recursion is not None and method.recursion.pair_covariance == "diagonal"


@bounded
def replicate(
    *,
    methods: Sequence[Method] = METHODS,
    truth: Camera | None = None,
    start: Camera | None = None,
    n_replicates: int = 200,
    n_frames: int = 1000,
    seed: Seed = 2017,
    stars: StarCatalogue | None = None,
    share_slow: bool = False,
    **options: Unpack[ReplicateOptions],
) -> Replicates:
    """Calibrate many simulated data sets with every method, and set their errors against their
    claims.

    Parameters
    ----------
    methods : sequence of Method
        Methods to compare, each with a label of its own.
    truth, start : Camera, optional
        The camera that is simulated, and the start of every method; the paper's by default.
    n_replicates : int
        Data sets; 200 know a spread to 5 % and a coverage of 95 % to 1.5 %.
    n_frames, seed, min_stars, sigma_px, max_mag, workers, progress, keep
        As in `starcal_uq.validate`, and with the same defaults but for the first two.
    stars : StarCatalogue, optional
        The sky, instead of the embedded catalogue to `max_mag`.
    share_slow : bool
        Run the filter that forms every pair in the first quarter of the replicates only, at least
        8; the others hold NaN for it.

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
    seed = seed_of(seed)
    methods = tuple(methods)
    truth = paper_camera() if truth is None else truth
    start = paper_start() if start is None else start
    labels = [method.label for method in methods]
    twice = sorted({label for label in labels if labels.count(label) > 1})
    campaign, run = campaign_of(n_frames, **options)
    check_settings(
        (bool(methods), "there are no methods to compare: give at least one."),
        (
            not twice,
            f"several methods have the label {' and '.join(map(repr, twice))}: give each its own.",
        ),
        cameras=(truth, start),
        n_replicates=n_replicates,
        campaign=campaign,
    )
    sky = load_catalogue(max_mag=campaign.max_mag) if stars is None else stars
    n_slow = max(_LEAST, n_replicates // SHARE) if share_slow else n_replicates
    experiment = Experiment(sky, methods, truth, start, campaign, n_slow)
    trial = partial(run_replicate, experiment)
    found = Trials(trial, "replicate", _CHUNK, fatal=(StarcalError,)).run(n_replicates, seed, **run)
    outcomes = found.good
    arrays = {
        name: np.stack([one[name] for one in outcomes], axis=int(name in _BY_METHOD))
        for name in _ARRAYS
    }
    failures = tuple(zip(*(outcome["failures"] for outcome in outcomes), strict=True))
    for method, values, reasons in zip(methods, arrays["estimates"], failures, strict=True):
        if not np.isfinite(values[:, 0]).any():
            raise CalibrationError(
                f"the method {method.label!r} never gave a result; first reason: {reasons[0]}"
            )
    settings: AnyDict = {"n_replicates": n_replicates, **campaign.settings(stars)}
    return Replicates(
        methods=methods,
        truth=truth,
        start=start,
        failures=failures,
        n_requested=n_replicates,
        interrupted=found.interrupted,
        provenance=provenance(seed, settings, None),
        **arrays,
    )


def check_settings(
    *others: tuple[bool, str],
    cameras: tuple[Camera, Camera],
    n_replicates: int,
    campaign: Campaign,
) -> None:
    """Refuse settings of a study over seeds that cannot work; `others` are conditions and what to
    say without them.
    """
    models = [camera.distortion for camera in cameras]
    require(
        SamplingError,
        *others,
        (
            models[0] == models[1],
            (
                f"the truth has distortion {models[0]!r} and the start {models[1]!r}: give both "
                "the "
                "same model."
            ),
        ),
        (n_replicates >= 2, f"n_replicates is {n_replicates}: a spread needs at least 2."),
    )
    campaign.check(SamplingError)


def run_replicate(experiment: Experiment, index: int, seeds: np.random.SeedSequence) -> AnyDict:
    """Replicate number `index`, by the names of the arrays of `Replicates`.

    A calibration that fails is an outcome, a sky without stars an error.
    """
    truth, noise = experiment.truth, seeds.generate_state(1, np.uint64)[0]
    obs = experiment.campaign.simulate(experiment.stars, truth, noise)
    frames = StarFrames.from_observations(obs)
    p, m = len(truth.theta), len(experiment.methods)
    estimates, claimed, classical = (np.full((m, p), np.nan) for _ in range(3))
    errors = np.full((3, m), np.nan)
    failures = [""] * m
    chosen = [
        i
        for i, method in enumerate(experiment.methods)
        if index < experiment.n_slow or not is_slow(method)
    ]
    methods = [experiment.methods[i] for i in chosen]
    for i, solved in zip(chosen, solve_all(methods, obs, frames, experiment.start), strict=True):
        if isinstance(solved, StarcalError):
            failures[i] = str(solved)
            continue
        # Methods that leave the distortion out have the optics only.
        q = len(solved.sigmas)
        estimates[i, :q], claimed[i, :q], classical[i, :q] = (
            solved.theta,
            solved.sigmas,
            solved.classical,
        )
        errors[:, i] = field_errors(truth, solved.camera)
    crlb = crlb_sigmas(frames, truth, experiment.campaign.sigma_px)
    arrays = (estimates, claimed, classical, *errors)
    found: AnyDict = {"replicate": index, "crlb": crlb, "failures": tuple(failures)}
    return found | dict(zip(_BY_METHOD, arrays, strict=True))


def field_errors(truth: Camera, estimate: Camera) -> tuple[float, float, float]:
    """Root mean square errors over the detector without noise; NaN where the estimated distortion
    folds over.

    Of the directions in px and arcsec, best common rotation removed (`map_error`), and by eq. 16 of
    the paper.
    """
    try:
        directions = map_error(truth, estimate)
        points = reprojection_error_px(truth, estimate, directions.xy_px)
    except DistortionError:
        return np.nan, np.nan, np.nan
    mean_square = np.sum(directions.weight * np.sum(points.error_px**2, axis=1))
    return directions.rms_px, directions.rms_arcsec, float(np.sqrt(mean_square))


def crlb_sigmas(frames: StarFrames, truth: Camera, sigma_px: float) -> FloatArray:
    """Cramer-Rao bound (p,) on the standard deviations: all parameters unknown, and the attitude of
    every frame.
    """
    likelihood = MarginalLikelihood(frames, truth.distortion)
    return np.sqrt(inverse_diagonal(likelihood.evaluate(truth.theta).matrix)) * sigma_px


class Solved(NamedTuple):
    """What a method found: camera, parameters, and standard deviations as claimed and by textbooks,
    (p,) px units.

    Least squares over pairs presumes there that pairs are independent, although the m (m - 1) / 2
    pairs of m stars hold 2 m - 3 independent numbers; a filter that its model holds. NaN where
    there is none, or none but the claim.
    """

    camera: Camera
    theta: FloatArray
    sigmas: FloatArray
    classical: FloatArray


def solve_all(
    methods: Sequence[Method], obs: Observations, frames: StarFrames, start: Camera
) -> list[Solved | StarcalError]:
    """Every method's result, or why it has none; `frames` are those of `obs`.

    The stages of the efficient method on interstar angles end in the paper's estimate: where it is
    among the methods and converges, that is taken from it.
    """
    found: dict[Method, Solved | StarcalError] = {}
    efficient = [method for method in methods if method.method == "efficient"]
    others = [method for method in methods if method.method != "efficient"]
    whole: Calibration | None = None
    for method in (*efficient, *others):
        try:
            if whole is not None and method.method == "three_stage":
                found[method] = _three_stages(whole, frames)
                continue
            cal = method.calibrate(obs, start)
            found[method] = _solved(cal, frames)
            whole = cal if method.method == "efficient" else whole
        except StarcalError as error:
            found[method] = error
    return [found[method] for method in methods]


def _solved(cal: Calibration, frames: StarFrames) -> Solved:
    classical = np.full(len(cal.theta), np.nan)
    if cal.method in _OF_PAIRS:
        classical = textbook_sigmas(PairObjective(frames, cal.camera.distortion), cal.theta)
    for stage in cal.stages:
        if stage.sigmas is not None:
            classical = np.where(stage.sigmas[-1] > 0.0, stage.sigmas[-1], np.nan)
    return Solved(cal.camera, cal.theta, cal.sigmas, classical)


def _three_stages(whole: Calibration, frames: StarFrames) -> Solved:
    camera = whole.nominal.with_theta(whole.pair_theta)
    classical = textbook_sigmas(PairObjective(frames, camera.distortion), whole.pair_theta)
    return Solved(camera, whole.pair_theta, root_diagonal(whole.pair_covariance), classical)


def pinhole(camera: Camera, theta: FloatArray) -> Camera:
    """A camera without distortion, of the first three parameters."""
    return camera.replace(distortion="none", coefficients=()).with_theta(theta[:3])


def textbook_sigmas(pairs: PairObjective, theta: FloatArray) -> FloatArray:
    """Standard deviations (p,) of least squares over pairs, ``(J^T J)^-1 s^2``, as if pairs were
    independent.
    """
    normal = pairs.evaluate(theta)
    variance = normal.cost / (pairs.n_pairs - len(theta))
    return np.sqrt(inverse_diagonal(normal.matrix) * variance)
