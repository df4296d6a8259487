"""Optics against distortion (section 3.1 of Ye & Yang 2017): what it costs to ignore, decouple or couple the two.

The paper's experiment is varied along four axes, one at a time: size of the distortion, field of view, number of
frames, stars in a frame. Each data set is simulated twice with the same attitudes and stars:

- without noise, where an estimate is the method's pseudo-true value: its error is the *bias*, known almost without
  scatter, and averaged over designs;
- with noise, by Monte Carlo: the standard deviation of these estimates is the *spread*, and that of their difference to
  those without noise is what *noise* alone does. The two differ where the bias depends on where the stars are.

All methods see the same data, and so, as far as the axis allows, do all points of an axis (common random numbers).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from starcal_uq.camera.distortion import get_model
from starcal_uq.core.errors import SamplingError, StarcalError
from starcal_uq.core.provenance import provenance
from starcal_uq.core.tasks import Progress, run_tasks
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.estimation.calibrate import calibrate
from starcal_uq.estimation.recursive.start import RecursionOptions
from starcal_uq.observations.frames import StarFrames
from starcal_uq.paper.camera import paper_camera, paper_start
from starcal_uq.paper.interaction_result import HANDLING, InteractionStudy, summary_rows
from starcal_uq.paper.replicates import crlb_sigmas
from starcal_uq.simulation.frames import simulate

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.observations.table import Observations
    from starcal_uq.sky.catalogue import StarCatalogue

# Times the paper's 0.7 px at the corner; the largest is 6 % of the radius there, as for a wide-angle lens.
DISTORTION_SCALES = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0, 4.0, 15.0, 60.0)


FIELDS_DEG = (5.0, 7.0, 10.0, 15.0, 25.0, 40.0)


FRAMES = (10, 30, 100, 300, 1000)


MAX_MAGS = (5.0, 5.5, 6.0, 6.5, 7.0)


# An attitude needs a few stars whatever the axis says.
LEAST_STARS = 4


@dataclass(frozen=True)
class Condition:
    """What is simulated.

    Attributes
    ----------
    truth, start : Camera
        What is simulated, and where every method starts.
    n_frames, min_stars : int
        As in `simulate`.
    max_mag : float
        Limiting magnitude.
    """

    truth: Camera
    start: Camera
    n_frames: int
    min_stars: int
    max_mag: float

    @property
    def field_deg(self) -> float:
        """Full horizontal field of view."""
        return float(self.truth.fov_deg[0])

    @property
    def corner_px(self) -> float:
        """What the distortion displaces at the corner farthest from the principal point, px outwards."""
        model, radius = get_model(self.truth.distortion), self.truth.corner_radius_px
        return float(model.displacement(radius, 0.0, self.truth.coefficients)[0])


@dataclass(frozen=True)
class Point:
    """A point of an axis.

    Attributes
    ----------
    axis : str
        ``distortion``, ``field``, ``frames`` or ``stars``.
    value : float
        Factor on the distortion, full field of view in deg, number of frames, or limiting magnitude.
    condition : Condition
        What is simulated there; the axes cross in one condition.
    """

    axis: str
    value: float
    condition: Condition


def study_points(
    base: Condition,
    sky: StarCatalogue,
    distortion_scales: Sequence[float],
    fields_deg: Sequence[float],
    frames: Sequence[int],
    max_mags: Sequence[float],
) -> tuple[Point, ...]:
    """All points; `sky` as from `deep_catalogue`."""
    return (
        *(Point("distortion", float(scale), _distorted(base, scale)) for scale in distortion_scales),
        *(Point("field", float(field), _with_field(base, field, sky)) for field in fields_deg),
        *(Point("frames", float(k), dataclasses.replace(base, n_frames=int(k))) for k in frames),
        *(Point("stars", float(mag), _with_mag(base, mag, sky)) for mag in max_mags),
    )


def _distorted(base: Condition, scale: float) -> Condition:
    coefficients = tuple(scale * k for k in base.truth.coefficients)
    truth = base.truth.replace(coefficients=coefficients)
    return dataclasses.replace(base, truth=truth)


def _with_field(base: Condition, field_deg: float, sky: StarCatalogue) -> Condition:
    """The same detector with another focal length, and as many stars in a frame."""
    truth = _focal_for(base.truth, field_deg)
    if np.isclose(truth.focal_mm, base.truth.focal_mm, rtol=1e-6):
        return base
    start = base.start.replace(focal_mm=truth.focal_mm * base.start.focal_mm / base.truth.focal_mm)
    n_stars = _count(sky, base.max_mag) * solid_angle_sr(base.truth) / solid_angle_sr(truth)
    limit = float(np.sort(sky.mag)[round(n_stars) - 1])
    return dataclasses.replace(base, truth=truth, start=start, max_mag=limit)


def _with_mag(base: Condition, max_mag: float, sky: StarCatalogue) -> Condition:
    """Another magnitude limit; frames hold at least the same fraction of the mean number of stars."""
    least = round(base.min_stars * _count(sky, max_mag) / _count(sky, base.max_mag))
    return dataclasses.replace(base, max_mag=float(max_mag), min_stars=max(LEAST_STARS, least))


def _focal_for(camera: Camera, field_deg: float) -> Camera:
    half_mm = 0.5e-3 * camera.width_px * camera.pixel_um
    return camera.replace(focal_mm=float(half_mm / np.tan(np.radians(0.5 * field_deg))))


def solid_angle_sr(camera: Camera) -> float:
    """Solid angle of the ideal field, sr."""
    h, v = np.radians(camera.fov_deg)
    return float(4.0 * np.arcsin(np.sin(0.5 * h) * np.sin(0.5 * v)))


def _count(sky: StarCatalogue, max_mag: float) -> int:
    return int(np.sum(sky.mag <= max_mag))


def deep_catalogue(truth: Camera, max_mag: float, base_mag: float, fields_deg: Sequence[float]) -> StarCatalogue:
    """One catalogue of which every condition takes the bright part."""
    from starcal_uq.sky.catalogue import load_catalogue

    sky = load_catalogue(max_mag=max_mag)
    smallest = min([solid_angle_sr(truth), *(solid_angle_sr(_focal_for(truth, field)) for field in fields_deg)])
    needed = _count(sky, base_mag) * solid_angle_sr(truth) / smallest
    while len(sky) < needed:
        max_mag += 0.5
        deeper = load_catalogue(max_mag=max_mag)
        if len(deeper) == len(sky):
            raise SamplingError(
                f"the catalogue has {len(sky)} stars, too few for a field of {min(fields_deg):g} deg with as many "
                "stars as the others: leave the narrowest fields out, or give a smaller max_mag."
            )
        sky = deeper
    return sky


@dataclass(frozen=True)
class Plan:
    """What all tasks share; sent once to every process."""

    stars: StarCatalogue
    conditions: tuple[Condition, ...]
    sigma_px: float
    seed: int


class Outcome(NamedTuple):
    """One replicate of one condition, for M methods and the three optical parameters.

    Attributes
    ----------
    condition : int
        Its number.
    noise_free, noisy : (M, 3) arrays
        Estimates minus truth, px; NaN where a method failed.
    crlb : (3,) array
        Cramer-Rao bound on the standard deviations of this design.
    stars_per_frame : float
        Mean number of stars.
    """

    condition: int
    noise_free: FloatArray
    noisy: FloatArray
    crlb: FloatArray
    stars_per_frame: float


def interaction_study(
    *,
    truth: Camera | None = None,
    start: Camera | None = None,
    distortion_scales: Sequence[float] = DISTORTION_SCALES,
    fields_deg: Sequence[float] = FIELDS_DEG,
    frames: Sequence[int] = FRAMES,
    max_mags: Sequence[float] = MAX_MAGS,
    n_replicates: int = 16,
    n_frames: int = 100,
    min_stars: int = 10,
    sigma_px: float = 0.05,
    max_mag: float = 6.0,
    seed: int = 2017,
    workers: int | None = None,
    progress: Progress | None = None,
) -> InteractionStudy:
    """Bias and spread of x0, y0 and f for methods that ignore, decouple or couple optics and distortion.

    Parameters
    ----------
    truth, start : Camera, optional
        The camera around which the study is made, and the start of every method; the paper's by default.
    distortion_scales : sequence of float
        Factors on all distortion coefficients.
    fields_deg : sequence of float
        Full fields of view: the same detector behind another focal length. The distortion keeps its displacement in px,
        and the magnitude limit is moved so that a frame holds as many stars.
    frames : sequence of int
        Numbers of frames.
    max_mags : sequence of float
        Magnitude limits; the least number of stars in a frame follows the density of the catalogue.
    n_replicates : int
        Designs at every point; 16 know a spread to 18 %, 50 to 10 %.
    n_frames, min_stars, sigma_px, max_mag
        Data of one calibration where an axis does not say otherwise.
    seed : int
        The same seed gives the same result, bit for bit, for any number of processes.
    workers : int, optional
        Processes; as many as there are processors by default. With 0, everything happens in this process, where a BLAS
        with several threads can change the last digits.
    progress : callable, optional
        Called as ``progress(done, total)``.

    Returns
    -------
    InteractionStudy
        After Ctrl-C, from the data sets that were complete by then.

    Raises
    ------
    SamplingError
        For settings that cannot work, or processes that cannot be started.
    CatalogueError
        When a field is too narrow for the catalogue to show enough stars.
    """
    truth = paper_camera() if truth is None else truth
    start = paper_start() if start is None else start
    _check(truth, start, n_replicates, n_frames, min_stars, sigma_px, workers)
    sky = deep_catalogue(truth, max([max_mag, *max_mags]), max_mag, fields_deg)
    base = Condition(truth, start, n_frames, min_stars, max_mag)
    points = study_points(base, sky, distortion_scales, fields_deg, frames, max_mags)
    # Where the axes cross they share their data.
    conditions = tuple(dict.fromkeys(point.condition for point in points))
    plan = Plan(sky, conditions, sigma_px, seed)
    outcomes, interrupted = run_tasks(
        partial(run_one, plan),
        n_replicates * len(conditions),
        caller="interaction_study",
        chunk=1,
        workers=workers,
        progress=progress,
    )
    rows: list[AnyDict] = []
    for point in points:
        some = [outcome for outcome in outcomes if conditions[outcome.condition] == point.condition]
        if some:
            rows += summary_rows(_head(point, some, sigma_px, seed), some)
    settings: AnyDict = {"n_replicates": n_replicates, "n_frames": n_frames, "min_stars": min_stars}
    settings |= {"sigma_px": sigma_px, "max_mag": max_mag}
    return InteractionStudy.from_rows(rows, interrupted, provenance(seed, settings, None))


def run_one(plan: Plan, index: int) -> Outcome:
    """Task number `index`: condition ``index % n`` of n, replicate ``index // n``.

    All conditions of one replicate come before the next replicate, so that a study that is interrupted has every point.
    """
    replicate, number = divmod(index, len(plan.conditions))
    condition = plan.conditions[number]
    design, noise = np.random.SeedSequence(plan.seed, spawn_key=(replicate,)).spawn(2)
    clean = simulate(
        plan.stars.select(plan.stars.mag <= condition.max_mag),
        condition.truth,
        n_frames=condition.n_frames,
        min_stars=condition.min_stars,
        sigma_px=0.0,
        seed=int(design.generate_state(1, np.uint64)[0]),
    )
    dx, dy = plan.sigma_px * np.random.default_rng(noise).standard_normal((clean.n_stars, 2)).T
    noisy = dataclasses.replace(clean, x_px=clean.x_px + dx, y_px=clean.y_px + dy)
    optics = condition.truth.theta[:3]
    return Outcome(
        condition=number,
        noise_free=estimates(clean, condition.start, plan.sigma_px) - optics,
        noisy=estimates(noisy, condition.start, plan.sigma_px) - optics,
        crlb=crlb_sigmas(StarFrames.from_observations(clean), condition.truth, plan.sigma_px)[:3],
        stars_per_frame=clean.n_stars / clean.n_frames,
    )


def estimates(obs: Observations, start: Camera, sigma_px: float) -> FloatArray:
    """Optics (M, 3) by every method of the study; NaN where one fails."""
    found = np.full((len(HANDLING), 3), np.nan)
    # The stages of one calibration are methods of their own: least squares without distortion, then the paper's.
    with suppress(StarcalError):
        cal = calibrate(obs, start, method="efficient")
        found[0], found[2], found[3] = cal.stages[0].theta[:3], cal.pair_theta[:3], cal.theta[:3]
    with suppress(StarcalError):
        options = RecursionOptions(sigma_px=sigma_px)
        found[1] = calibrate([obs], start, method="samaan", recursion=options).theta[:3]
    return found


def _head(point: Point, outcomes: Sequence[Outcome], sigma_px: float, seed: int) -> AnyDict:
    """The columns that say what a row is about."""
    condition = point.condition
    return {
        "axis": point.axis,
        "value": point.value,
        "corner_px": condition.corner_px,
        "corner_size_px": abs(condition.corner_px),
        "field_deg": condition.field_deg,
        "n_frames": condition.n_frames,
        "stars_per_frame": float(np.mean([outcome.stars_per_frame for outcome in outcomes])),
        "max_mag": condition.max_mag,
        "min_stars": condition.min_stars,
        "sigma_px": sigma_px,
        "seed": seed,
    }


def _check(
    truth: Camera,
    start: Camera,
    n_replicates: int,
    n_frames: int,
    min_stars: int,
    sigma_px: float,
    workers: int | None,
) -> None:
    for good, text in (
        (
            truth.distortion == start.distortion and bool(truth.coefficients),
            f"the truth has distortion {truth.distortion!r} and the start {start.distortion!r}: give both the same "
            "model, with coefficients.",
        ),
        (n_replicates >= 2, f"n_replicates is {n_replicates}: a spread needs at least 2."),
        (n_frames >= 1, f"n_frames is {n_frames}: give at least 1."),
        (min_stars >= LEAST_STARS, f"min_stars is {min_stars}: give at least {LEAST_STARS}."),
        (0.0 < sigma_px < np.inf, f"sigma_px is {sigma_px:g}: give a noise above zero."),
        (workers is None or workers >= 0, f"workers is {workers}: give at least 1, or 0 for this process."),
    ):
        if not good:
            raise SamplingError(text)
