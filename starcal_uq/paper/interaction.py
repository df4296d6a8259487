"""Optics against distortion (section 3.1 of Ye & Yang 2017): what it costs to ignore, decouple or
couple the two.

The paper's experiment is varied along four axes, one at a time: size of the distortion, field of
view, number of frames, stars in a frame. Each data set is simulated twice with the same attitudes
and stars:

- without noise, where an estimate is the method's pseudo-true value: its error is the *bias*, known
  almost without scatter, and averaged over designs;
- with noise, by Monte Carlo: the standard deviation of these estimates is the *spread*, and that of
  their difference to those without noise is what *noise* alone does. The two differ where the bias
  depends on where the stars are.

All methods see the same data, and so, as far as the axis allows, do all points of an axis (common
random numbers).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple, Unpack

import numpy as np

from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.camera.distortion import get_model
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import SamplingError, StarcalError
from starcal_uq.core.files import cell_content, reading, write_csv
from starcal_uq.core.provenance import Provenance, provenance
from starcal_uq.core.remedy import Remedy
from starcal_uq.core.settings import Seed, bounded, seed_of
from starcal_uq.core.types import AnyDict, FloatArray, PathLike
from starcal_uq.maths.intervals import mean_and_sd
from starcal_uq.observations.frames import StarFrames
from starcal_uq.paper.camera import paper_camera, paper_start
from starcal_uq.paper.recursive.start import RecursionOptions
from starcal_uq.paper.replicates import check_settings, crlb_sigmas
from starcal_uq.paper.statistics import chi_interval
from starcal_uq.simulation.frames import Campaign
from starcal_uq.simulation.replicates import ReplicateOptions, Trials, campaign_of
from starcal_uq.sky.catalogue import load_catalogue

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.camera.camera import Camera
    from starcal_uq.observations.table import Observations
    from starcal_uq.sky.catalogue import StarCatalogue

# Methods of the study, and what they do about the distortion while they estimate the optics.
HANDLING = {
    "least squares": "ignores",
    "samaan": "decouples",
    "three stages": "couples",
    "efficient": "couples",
}
REFERENCE = "efficient"
OPTICS = ("x0", "y0", "f")
# Axes, and the column that each is drawn and judged against.
AXES = {
    "distortion": "corner_size_px",
    "field": "field_deg",
    "frames": "n_frames",
    "stars": "stars_per_frame",
}
# Times the paper's 0.7 px at the corner; the largest is 6 % of the radius there, as for a
# wide-angle lens.
DISTORTION_SCALES = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0, 4.0, 15.0, 60.0)
FIELDS_DEG = (5.0, 7.0, 10.0, 15.0, 25.0, 40.0)
FRAMES = (10, 30, 100, 300, 1000)
MAX_MAGS = (5.0, 5.5, 6.0, 6.5, 7.0)
# An attitude needs a few stars whatever the axis says.
LEAST_STARS = 4
_TEXT = ("axis", "method", "handling", "parameter", "unit")
_WHOLE = ("n_frames", "min_stars", "seed", "n", "failed")


class Threshold(NamedTuple):
    """Where along an axis a ratio of a method passes one: |bias| over noise, or the error over the
    efficient method's.

    The kind is ``bias`` or ``rmse``; the side says where the ratio exceeds one (``above`` or
    ``below`` the value, ``always``, ``never``). The value is in the unit of the axis (px at the
    corner, deg, frames, stars in a frame), interpolated, with an interval from the 95 % interval of
    the noise; NaN where there is none.
    """

    kind: str
    axis: str
    method: str
    parameter: str
    side: str
    value: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class InteractionStudy(Shown):
    """Bias and spread of the optics along four axes; `interrupted` if the user stopped it before
    the last data set.

    The table has a row per point, method and parameter. The provenance is empty when it was read
    from a file.

    Columns
    -------
    axis, value
        ``distortion`` (factor on the coefficients), ``field`` (deg), ``frames``, ``stars``
        (magnitude limit).
    corner_px, corner_size_px
        What the distortion displaces at the farthest corner, px outwards, and its size.
    field_deg, n_frames, stars_per_frame, max_mag, min_stars, sigma_px, seed
        The data: `stars_per_frame` is what was found, the others what was asked for.
    method, handling, parameter, unit, n, failed
        Who, what it does about the distortion, of what, and replicates with and without a result.
    bias, bias_se, design_spread
        Mean error without noise with its standard error, and the standard deviation of that error
        over designs.
    noise, noise_se, noise_shift, noise_shift_se
        Standard deviation and mean of the difference between the estimates with and without noise:
        what noise alone does, with their standard errors.
    spread, spread_se, rmse, crlb
        Standard deviation of the estimates with noise, over designs and noise, with its standard
        error; root mean square error; Cramer-Rao bound with all parameters unknown.
    bias_over_noise, bias_over_noise_low, bias_over_noise_high
        Size of the bias over `noise`, with the 95 % interval that comes from the latter.
    """

    table: pd.DataFrame
    interrupted: bool = False
    provenance: Provenance = field(default_factory=Provenance)

    def points(self, axis: str, method: str, parameter: str) -> pd.DataFrame:
        """Rows of one curve, in the order of the axis."""
        t = self.table
        some = t[(t["axis"] == axis) & (t["method"] == method) & (t["parameter"] == parameter)]
        return some.sort_values(AXES[axis], kind="stable")

    @cached_property
    def thresholds(self) -> tuple[Threshold, ...]:
        """Where the bias is one standard deviation of the noise, and where a method falls behind
        the efficient one.
        """
        found = []
        for axis, method, parameter in product(AXES, HANDLING, OPTICS):
            rows = self.points(axis, method, parameter)
            rows = rows[np.isfinite(rows["noise"])]
            if len(rows) < 2:
                continue
            ratios = (rows[f"bias_over_noise{end}"].to_numpy() for end in ("", "_low", "_high"))
            (side, value), *ends = (
                crossing(rows[AXES[axis]].to_numpy(), ratio) for ratio in ratios
            )
            low, high = (np.nan, np.nan) if np.isnan(value) else sorted(place for _, place in ends)
            found.append(Threshold("bias", axis, method, parameter, side, value, low, high))
            if method != REFERENCE:
                reference = self.points(axis, REFERENCE, parameter)[["value", "rmse"]]
                both = rows.merge(reference, on="value", suffixes=("", "_reference"))
                ratio = (both["rmse"] / both["rmse_reference"]).to_numpy()
                side, value = crossing(both[AXES[axis]].to_numpy(), ratio)
                found.append(
                    Threshold("rmse", axis, method, parameter, side, value, np.nan, np.nan)
                )
        return tuple(found)

    def threshold(self, axis: str, method: str, parameter: str, kind: str = "bias") -> Threshold:
        """One of `thresholds`."""
        for one in self.thresholds:
            if (one.axis, one.method, one.parameter, one.kind) == (axis, method, parameter, kind):
                return one
        raise ValueError(
            f"the study has no {kind!r} threshold of {parameter!r} by {method!r} along {axis!r}."
        )

    def save_csv(self, path: PathLike) -> None:
        """Write the table, atomically; overwritten. Numbers keep all digits."""
        write_csv(self.table, path)

    @classmethod
    def load_csv(cls, path: PathLike) -> InteractionStudy:
        """Read what `save_csv` wrote.

        Raises
        ------
        RunFolderError
            If the file is missing or does not hold an interaction study.
        """
        import pandas as pd

        remedy = Remedy("reproduce", purpose="to write it again")
        with reading(path, "an interaction study", remedy):
            # As text first: the fast parser of numbers loses the last digit.
            text = pd.read_csv(path, dtype=str, keep_default_na=False)
            missing = sorted({*_TEXT, "bias", "spread"} - set(text.columns))
            if missing:
                raise ValueError(f"it lacks the column {missing[0]!r}")
            return cls(
                pd.DataFrame({name: _column(name, text[name].tolist()) for name in text.columns})
            )


def _column(name: str, values: list[str]) -> list[str] | list[int] | list[float]:
    if name in _TEXT:
        return list(map(cell_content, values))
    return (
        [int(v) for v in values] if name in _WHOLE else [float(v) if v else np.nan for v in values]
    )


def crossing(at: FloatArray, ratio: FloatArray) -> tuple[str, float]:
    """Where a ratio passes one for good: ``above``, ``below``, ``always`` or ``never``, and the
    place.

    Interpolated between logarithms, linearly in `at` next to zero.
    """
    over = ratio >= 1.0
    if over.all() or not over.any():
        return "always" if over.all() else "never", float("nan")
    i = int(np.flatnonzero(over != over[-1])[-1])
    side = "above" if over[-1] else "below"
    x, y = at[[i, i + 1]], ratio[[i, i + 1]]
    if x[0] > 0.0 and y.min() > 0.0:
        share = np.log(y[0]) / (np.log(y[0]) - np.log(y[1]))
        return side, float(np.exp(np.log(x[0]) + share * (np.log(x[1]) - np.log(x[0]))))
    share = (1.0 - y[0]) / (y[1] - y[0])
    return side, float(x[0] + share * (x[1] - x[0]))


@dataclass(frozen=True)
class Condition:
    """What is simulated, where every method starts, and how much data there is."""

    truth: Camera
    start: Camera
    campaign: Campaign

    @property
    def field_deg(self) -> float:
        """Full horizontal field of view."""
        return float(self.truth.fov_deg[0])

    @property
    def corner_px(self) -> float:
        """What the distortion displaces at the corner farthest from the principal point, px
        outwards.
        """
        model, radius = get_model(self.truth.distortion), self.truth.corner_radius_px
        return float(model.displacement(radius, 0.0, self.truth.coefficients)[0])


class Point(NamedTuple):
    """A point of an axis; `value` is a factor on the distortion, a field in deg, frames, or a
    limiting magnitude.
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
        *(
            Point("distortion", float(scale), _distorted(base, scale))
            for scale in distortion_scales
        ),
        *(Point("field", float(field), _with_field(base, field, sky)) for field in fields_deg),
        *(Point("frames", float(k), _with_campaign(base, n_frames=int(k))) for k in frames),
        *(Point("stars", float(mag), _with_mag(base, mag, sky)) for mag in max_mags),
    )


def _with_campaign(base: Condition, **changes: Any) -> Condition:
    return dataclasses.replace(base, campaign=dataclasses.replace(base.campaign, **changes))


def _distorted(base: Condition, scale: float) -> Condition:
    truth = base.truth.replace(coefficients=tuple(scale * k for k in base.truth.coefficients))
    return dataclasses.replace(base, truth=truth)


def _with_field(base: Condition, field_deg: float, sky: StarCatalogue) -> Condition:
    """The same detector with another focal length, and as many stars in a frame."""
    truth = _focal_for(base.truth, field_deg)
    if np.isclose(truth.focal_px, base.truth.focal_px, rtol=1e-6):
        return base
    start = base.start.replace(focal_px=truth.focal_px * base.start.focal_px / base.truth.focal_px)
    n_stars = (
        _count(sky, base.campaign.max_mag) * solid_angle_sr(base.truth) / solid_angle_sr(truth)
    )
    limit = float(np.sort(sky.mag)[round(n_stars) - 1])
    return _with_campaign(dataclasses.replace(base, truth=truth, start=start), max_mag=limit)


def _with_mag(base: Condition, max_mag: float, sky: StarCatalogue) -> Condition:
    """Another magnitude limit; frames hold at least the same fraction of the mean number of
    stars.
    """
    least = round(
        base.campaign.min_stars * _count(sky, max_mag) / _count(sky, base.campaign.max_mag)
    )
    return _with_campaign(base, max_mag=float(max_mag), min_stars=max(LEAST_STARS, least))


def _focal_for(camera: Camera, field_deg: float) -> Camera:
    return camera.replace(
        focal_px=float(0.5 * camera.width_px / np.tan(np.radians(0.5 * field_deg)))
    )


def solid_angle_sr(camera: Camera) -> float:
    """Solid angle of the ideal field, sr."""
    h, v = np.radians(camera.fov_deg)
    return float(4.0 * np.arcsin(np.sin(0.5 * h) * np.sin(0.5 * v)))


def _count(sky: StarCatalogue, max_mag: float) -> int:
    return int(np.sum(sky.mag <= max_mag))


def deep_catalogue(
    truth: Camera, max_mag: float, base_mag: float, fields_deg: Sequence[float]
) -> StarCatalogue:
    """One catalogue of which every condition takes the bright part."""
    sky = load_catalogue(max_mag=max_mag)
    smallest = min(
        [solid_angle_sr(truth), *(solid_angle_sr(_focal_for(truth, field)) for field in fields_deg)]
    )
    needed = _count(sky, base_mag) * solid_angle_sr(truth) / smallest
    while len(sky) < needed:
        max_mag += 0.5
        deeper = load_catalogue(max_mag=max_mag)
        if len(deeper) == len(sky):
            raise SamplingError(
                f"the catalogue has {len(sky)} stars, too few for a field of {min(fields_deg):g} "
                "deg with as many "
                "stars as the others: leave the narrowest fields out, or give a smaller max_mag."
            )
        sky = deeper
    return sky


class Plan(NamedTuple):
    """What all tasks share; sent once to every process."""

    stars: StarCatalogue
    conditions: tuple[Condition, ...]


class Outcome(NamedTuple):
    """One replicate of one condition: estimates minus truth (methods, 3), bound (3,), px; NaN where
    a method failed.
    """

    condition: int
    noise_free: FloatArray
    noisy: FloatArray
    crlb: FloatArray
    stars_per_frame: float


@bounded
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
    seed: Seed = 2017,
    **options: Unpack[ReplicateOptions],
) -> InteractionStudy:
    """Bias and spread of x0, y0 and f for methods that ignore, decouple or couple optics and
    distortion.

    Parameters
    ----------
    truth, start : Camera, optional
        The camera around which the study is made, and the start of every method; the paper's by
        default.
    distortion_scales : sequence of float
        Factors on all distortion coefficients.
    fields_deg : sequence of float
        Full fields of view: the same detector behind another focal length. The distortion keeps its
        displacement in px, and the magnitude limit is moved so that a frame holds as many stars.
    frames : sequence of int
        Numbers of frames.
    max_mags : sequence of float
        Magnitude limits; the least number of stars in a frame follows the density of the catalogue.
    n_replicates : int
        Designs at every point; 16 know a spread to 18 %, 50 to 10 %.
    n_frames, min_stars, sigma_px, max_mag
        Data of one calibration where an axis does not say otherwise, as in `starcal_uq.validate`.
    seed, workers, progress, keep
        As there; the seed repeats the study bit for bit for any number of processes.

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
    seed = seed_of(seed)
    import pandas as pd

    truth = paper_camera() if truth is None else truth
    start = paper_start() if start is None else start
    campaign, run = campaign_of(n_frames, **options)
    least, max_mag = campaign.min_stars, campaign.max_mag
    check_settings(
        (
            bool(truth.coefficients),
            "the truth has no distortion: give both the same model, with coefficients.",
        ),
        (least >= LEAST_STARS, f"min_stars is {least}: give at least {LEAST_STARS}."),
        cameras=(truth, start),
        n_replicates=n_replicates,
        campaign=campaign,
    )
    sky = deep_catalogue(truth, max([max_mag, *max_mags]), max_mag, fields_deg)
    base = Condition(truth, start, campaign)
    points = study_points(base, sky, distortion_scales, fields_deg, frames, max_mags)
    # Where the axes cross they share their data.
    conditions = tuple(dict.fromkeys(point.condition for point in points))
    n, trial = len(conditions), partial(run_one, Plan(sky, conditions))
    # All conditions of one replicate come before the next replicate, so that a study that is
    # interrupted has every point, and have common random numbers.
    trials = Trials(trial, "interaction_study", 1, (Outcome,), common=n, fatal=(StarcalError,))
    found = trials.run(n_replicates * n, seed, **run)
    rows: list[AnyDict] = []
    for point in points:
        some = [one for one in found.good if conditions[one.condition] == point.condition]
        if some:
            rows += summary_rows(_head(point, some, seed), some)
    settings = {"n_replicates": n_replicates, **campaign.settings(None)}
    return InteractionStudy(pd.DataFrame(rows), found.interrupted, provenance(seed, settings, None))


def run_one(plan: Plan, index: int, seeds: np.random.SeedSequence) -> Outcome:
    """Task number `index`: condition ``index % n`` of n."""
    number = index % len(plan.conditions)
    condition = plan.conditions[number]
    campaign, sigma_px = condition.campaign, condition.campaign.sigma_px
    design, noise = seeds.spawn(2)
    stars = plan.stars.select(plan.stars.mag <= campaign.max_mag)
    exact = dataclasses.replace(campaign, sigma_px=0.0)
    clean = exact.simulate(stars, condition.truth, design.generate_state(1, np.uint64)[0])
    dx, dy = sigma_px * np.random.default_rng(noise).standard_normal((clean.n_stars, 2)).T
    noisy = dataclasses.replace(clean, x_px=clean.x_px + dx, y_px=clean.y_px + dy)
    optics = condition.truth.theta[:3]
    return Outcome(
        condition=number,
        noise_free=estimates(clean, condition.start, sigma_px) - optics,
        noisy=estimates(noisy, condition.start, sigma_px) - optics,
        crlb=crlb_sigmas(StarFrames.from_observations(clean), condition.truth, sigma_px)[:3],
        stars_per_frame=clean.n_stars / clean.n_frames,
    )


def estimates(obs: Observations, start: Camera, sigma_px: float) -> FloatArray:
    """Optics (M, 3) by every method of the study; NaN where one fails."""
    found = np.full((len(HANDLING), 3), np.nan)
    with suppress(StarcalError):
        found[0] = calibrate(obs, start, method="least_squares").theta[:3]
    with suppress(StarcalError):
        cal = calibrate(obs, start, method="efficient")
        found[2], found[3] = cal.pair_theta[:3], cal.theta[:3]
    with suppress(StarcalError):
        options = RecursionOptions(sigma_px=sigma_px)
        found[1] = calibrate([obs], start, method="samaan", recursion=options).theta[:3]
    return found


def _head(point: Point, outcomes: Sequence[Outcome], seed: int) -> AnyDict:
    """The columns that say what a row is about."""
    condition = point.condition
    return {
        "axis": point.axis,
        "value": point.value,
        "corner_px": condition.corner_px,
        "corner_size_px": abs(condition.corner_px),
        "field_deg": condition.field_deg,
        "n_frames": condition.campaign.n_frames,
        "stars_per_frame": float(np.mean([outcome.stars_per_frame for outcome in outcomes])),
        "max_mag": condition.campaign.max_mag,
        "min_stars": condition.campaign.min_stars,
        "sigma_px": condition.campaign.sigma_px,
        "seed": seed,
    }


def summary_rows(head: AnyDict, outcomes: Sequence[Outcome]) -> list[AnyDict]:
    """Rows of one point of an axis: every method and parameter."""
    noise_free = np.stack([outcome.noise_free for outcome in outcomes], axis=1)
    noisy = np.stack([outcome.noisy for outcome in outcomes], axis=1)
    bound = np.sqrt(np.mean(np.stack([outcome.crlb for outcome in outcomes]) ** 2, axis=0))
    rows = []
    for (method, handling), clean, full in zip(HANDLING.items(), noise_free, noisy, strict=True):
        good = np.isfinite(clean[:, 0]) & np.isfinite(full[:, 0])
        for j, parameter in enumerate(OPTICS):
            body: AnyDict = {
                "method": method,
                "handling": handling,
                "parameter": parameter,
                "unit": "px",
            }
            body |= {"n": int(np.sum(good)), "failed": int(np.sum(~good))}
            rows.append(
                head | body | _summary(clean[good, j], full[good, j]) | {"crlb": float(bound[j])}
            )
    return rows


def _summary(clean: FloatArray, full: FloatArray) -> AnyDict:
    n = len(clean)
    if n < 2:
        return {}
    bias, design = mean_and_sd(clean)
    change = full - clean
    noise, spread = float(np.std(change, ddof=1)), float(np.std(full, ddof=1))
    low, high = chi_interval(n)
    free = np.sqrt(2.0 * (n - 1))
    ratio = abs(bias) / noise
    found = {
        "bias": bias,
        "bias_se": design / np.sqrt(n),
        "design_spread": design,
        "noise": noise,
        "noise_se": noise / free,
        "spread": spread,
        "spread_se": spread / free,
        "noise_shift": np.mean(change),
        "noise_shift_se": noise / np.sqrt(n),
        "rmse": np.sqrt(np.mean(full**2)),
        "bias_over_noise": ratio,
        "bias_over_noise_low": ratio * low,
        "bias_over_noise_high": ratio * high,
    }
    return {name: float(value) for name, value in found.items()}
