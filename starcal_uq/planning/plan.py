"""How many frames does a calibration need? From the camera sheet alone, before any data.

Frames are drawn at random attitudes as `simulate` draws them, each one's information is that of the
likelihood that calibrates (`starcal_uq.planning.information`), and campaigns of any number of
frames are forecast from them (`starcal_uq.planning.forecast`). No data are simulated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, NamedTuple, Protocol, Unpack

import numpy as np

from starcal_uq.attitude.rotations import random_rotations
from starcal_uq.camera.camera import Camera
from starcal_uq.core.constants import AXES
from starcal_uq.core.errors import PlanningError, require
from starcal_uq.core.provenance import provenance
from starcal_uq.core.records import to_plain
from starcal_uq.core.settings import Seed, bounded, seed_of
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.types import AnyDict, FloatArray, Progress, floats
from starcal_uq.maths.linear import scaled_inverse
from starcal_uq.planning.costs import effect_costs
from starcal_uq.planning.effects import PlannedEffects
from starcal_uq.planning.forecast import (
    N_CAMPAIGNS,
    N_FRAMES,
    SCOPES,
    Forecaster,
    Outlook,
    nea_arcsec,
    start_with,
)
from starcal_uq.planning.information import FrameSet, random_frames
from starcal_uq.planning.open_distortion import (
    distortion_range,
    open_range,
    with_distortion,
)
from starcal_uq.planning.planned import SWEEP_FRAMES, Need, Plan
from starcal_uq.planning.ties import PlannedTies
from starcal_uq.simulation.frames import Tracker, TrackerOptions
from starcal_uq.simulation.noise import noise_of
from starcal_uq.simulation.sensor import SensorNoise

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.sky.catalogue import StarCatalogue

_FIELD_GEOMETRIES, _FIELD_CAMPAIGNS = 600, 40
_SWEEP_GEOMETRIES, _SWEEP_CAMPAIGNS, _TRIED_ATTITUDES = 1000, 64, 1000
# With fewer attitudes than this that show enough stars, a magnitude limit is left out of the sweep.
_LEAST_SKY = 0.02
# More noise than this is a mistake in the units.
_WORST_NOISE_PX = 20.0
_MAG_STEPS = (-2.0, -1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0)
_NOISE_FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
_FIELD_PARTS = (0.1, 0.2, 0.4, 0.6, 0.8, 1.0)


class HasInformation(Protocol):
    """A `Calibration` or `Posterior`: what its data say about the parameters."""

    @property
    def information(self) -> FloatArray:
        """Fisher information (p, p)."""
        ...


@bounded
@one_thread()
def plan(
    camera: Camera,
    stars: StarCatalogue,
    *,
    n_frames: Sequence[int] = N_FRAMES,
    max_mag: float | None = None,
    target_arcsec: float | None = None,
    confidence: float = 0.997,
    scope: str = "common",
    after: HasInformation | None = None,
    distortion_percent: tuple[float, float] | None = None,
    ties: PlannedTies | None = None,
    effects: PlannedEffects | str | None = None,
    sweeps: bool = True,
    n_geometries: int = 3000,
    n_campaigns: int = N_CAMPAIGNS,
    seed: Seed = 0,
    progress: Progress | None = None,
    **options: Unpack[TrackerOptions],
) -> Plan:
    """Forecast parameter and attitude errors of a calibration, and the frames that it needs.

    Parameters
    ----------
    camera : Camera
        The sheet; optics and distortion are those that one expects.
    stars : StarCatalogue
        The sky.
    n_frames : sequence of int
        Sizes of campaigns to forecast.
    max_mag : float, optional
        The sensor's limit, where `stars` is deeper: the sweep then goes beyond it.
    target_arcsec : float, optional
        Two-axis error across the boresight that is to be kept.
    confidence : float
        Probability of that.
    scope : {"common", "rest", "calibration", "total"}
        Part of the attitude error that the target is for: the common rotation, the rest after
        alignment, both, or both with the centroid noise of a frame.
    after : Calibration or Posterior, optional
        Data that are there already, whose information counts.
    distortion_percent : (float, float), optional
        Least and largest displacement of the corner by the distortion, per cent of its distance
        from the centre (barrel is negative), that a sheet with zero coefficients leaves open:
        frames and errors are forecast over this range. By default from the barrel distortion of an
        f-theta lens to as much pincushion distortion, at most 30 % and short of a fold;
        coefficients that are not zero are known, and nothing is open.
    ties : PlannedTies, optional
        Rotations from each frame to the next that will be known, such as by a gyro, or a fixed
        mount. Sweeps over parts of the detector are then left out.
    effects : PlannedEffects or str, optional
        Effects that the calibration will hold, such as ``"field,temperature=0.2"`` with scales in
        px at the corner (1 px by default). Everything is then forecast with them, known to the
        mission's software; `Plan.effects` has what they cost. The effect ``field`` has 90
        coefficients: at most 600 geometries and 40 campaigns are then taken.
    sweeps : bool
        Also forecast 1000 frames with other magnitude limits, noise, and parts of the detector.
    n_geometries : int
        Random attitudes that campaigns are drawn from, and that the errors of attitude are taken
        over.
    n_campaigns : int
        Campaigns to average over.
    seed : int or Generator
        Repeats bit for bit.
    progress : callable, optional
        Called with the points of the sweeps that are done and all.

    Raises
    ------
    PlanningError
        For settings that cannot work.
    CatalogueError
        When the field is too narrow for the catalogue to show `min_stars`.

    Other Parameters
    ----------------
    sigma_px : float, callable or NoiseModel
        Centroid noise, px per axis, 0.05 by default; a function from magnitudes (n,) to noise (n,) where it depends
        on them; the noise model of a calibration where it depends on the place in the field as
        well.
    min_stars : int
        Frames with fewer stars are not used (at least 3; 10 by default).
    max_stars : int, optional
        Stars that the tracker uses of a frame, the brightest ones; all on the detector by default.
    exclusion : Exclusion, optional
        Cones around Sun, Moon and Earth that the boresight keeps out of.
    """
    seed = seed_of(seed)
    tracker = Tracker.of(camera, **options)
    sigma_px = tracker.noise
    _check(n_frames, tracker.min_stars, target_arcsec, n_geometries, n_campaigns)
    effects = PlannedEffects.parsed(effects) if isinstance(effects, str) else effects
    if effects is not None and ties is not None:
        raise PlanningError(
            "known rotations and effects are not planned together: leave out one of the two."
        )
    if effects is not None and "field" in effects.scales:
        n_geometries = min(n_geometries, _FIELD_GEOMETRIES)
        n_campaigns = min(n_campaigns, _FIELD_CAMPAIGNS)
    if isinstance(sigma_px, (int, float)) and not 0.0 < sigma_px <= _WORST_NOISE_PX:
        raise PlanningError(
            f"the centroid noise is {sigma_px:g} px: give a number above zero, at most "
            f"{_WORST_NOISE_PX:g} px per axis."
        )
    bounds = open_range(camera, distortion_percent, after is not None)
    if bounds is not None:
        camera = with_distortion(camera, min(max(0.0, bounds[0]), bounds[1]))
    start = start_information(after, camera)
    limit = float(np.max(stars.mag, initial=-np.inf)) if max_mag is None else float(max_mag)
    seen = stars.select(stars.mag <= limit)
    if len(seen) == 0:
        raise PlanningError(
            f"no star is brighter than max_mag={limit:g}: raise it or use another catalogue."
        )
    tracker = replace(tracker, camera=camera)
    frames = random_frames(seen, tracker, n_frames=n_geometries, seed=seed, effects=effects)
    # A posterior does not say how many data it rests on; its noise is then as uncertain as the new
    # frames make it.
    outlook = Outlook(
        confidence=confidence,
        scope=scope,
        start=start,
        start_dof=float(getattr(after, "dof", 0.0)),
        ties=ties,
        n_campaigns=n_campaigns,
        seed=seed,
    )
    forecaster = Forecaster(frames, outlook)
    forecast, frame_information = forecaster.forecast(n_frames), frames.information.mean(axis=0)
    free = None
    if ties is not None:
        free = Forecaster(frames, replace(outlook, ties=None)).forecast(n_frames)
        alone = Forecaster(frames, replace(outlook, start=None)).covariances(SWEEP_FRAMES)
        frame_information = scaled_inverse(alone.mean(axis=0)) / SWEEP_FRAMES
    noise = float(np.sqrt(np.mean(noise_of(sigma_px, frames.mag, frames.frames.pixel) ** 2)))
    settings = {
        "n_geometries": n_geometries,
        "n_campaigns": n_campaigns,
        "stars": stars.source,
        "band": stars.band,
        **({} if tracker.max_stars is None else {"max_stars": tracker.max_stars}),
        **({} if tracker.exclusion is None else {"exclusion": asdict(tracker.exclusion)}),
        **({"sensor": asdict(sigma_px.sensor)} if isinstance(sigma_px, SensorNoise) else {}),
        "after": None if after is None else type(after).__name__,
        **({} if ties is None else {"ties": asdict(ties)}),
        "distortion_percent": None if bounds is None else list(bounds),
        "effects": None if effects is None else to_plain(effects),
    }
    spread = None
    if bounds is not None and bounds[0] < bounds[1]:
        spread = distortion_range(
            frames,
            seen,
            tracker,
            bounds,
            outlook,
            n_frames=n_frames,
            target_arcsec=target_arcsec,
        )
    table = None
    if sweeps:
        base = _Base(stars, tracker, limit, seed, effects)
        table = _sweep(
            base,
            frames,
            noise,
            replace(outlook, n_campaigns=min(_SWEEP_CAMPAIGNS, n_campaigns)),
            target_arcsec,
            progress,
        )
    needs = () if target_arcsec is None else _needs(frames, target_arcsec, outlook)
    costs = None
    if effects is not None:
        after_frames = next((need.frames for need in needs if need.scope == scope), None)
        costs = effect_costs(frames, after_frames or SWEEP_FRAMES, start)
    return Plan(
        camera=camera,
        sigma_px=noise,
        max_mag=limit,
        min_stars=tracker.min_stars,
        mean_stars=frames.mean_stars,
        sky_fraction=_sky_fraction(seen, tracker, seed),
        forecast=forecast,
        nea_arcsec=nea_arcsec(frames),
        confidence=confidence,
        scope=scope,
        target_arcsec=target_arcsec,
        needs=needs,
        effects=costs,
        sweeps=table,
        distortion=spread,
        seed=seed,
        provenance=provenance(seed, settings, None),
        frame_information=frame_information,
        start_information=start_with(frames, start),
        rotation_per_theta=frames.common[:, : len(camera.theta)],
        attitude_noise=frames.noise.mean(axis=0),
        ties=ties,
        without_ties=free,
    )


class _Base(NamedTuple):
    """What the sweeps vary around."""

    stars: StarCatalogue
    tracker: Tracker
    max_mag: float
    seed: int
    effects: PlannedEffects | None


def _needs(frames: FrameSet, target_arcsec: float, outlook: Outlook) -> tuple[Need, ...]:
    needs = []
    for scope in SCOPES:
        forecaster = Forecaster(frames, replace(outlook, scope=scope))
        needs.append(
            Need(
                scope,
                forecaster.frames_needed(target_arcsec),
                forecaster.frames_needed(target_arcsec, share=0.95),
                forecaster.floor_arcsec(),
            )
        )
    return tuple(needs)


def _sweep(
    base: _Base,
    frames: FrameSet,
    noise_px: float,
    outlook: Outlook,
    target_arcsec: float | None,
    progress: Progress | None,
) -> pd.DataFrame:
    import pandas as pd

    rows: list[AnyDict] = []
    n_points = len(_MAG_STEPS) + len(_NOISE_FACTORS) + len(_FIELD_PARTS)
    for name, value, information, mission, sky in _points(base, frames, noise_px):
        if outlook.ties is not None and information is not mission.information:
            # Attitudes of frames with fewer stars are not those of the mission.
            continue
        forecaster = Forecaster(mission, outlook, information)
        row = {"sweep": name, "value": value, "sky_fraction": sky, "mean_stars": mission.mean_stars}
        row |= forecaster.forecast((SWEEP_FRAMES,)).to_dataframe().iloc[0].to_dict()
        row |= dict(zip((f"nea_{axis}_arcsec" for axis in AXES), nea_arcsec(mission), strict=True))
        if target_arcsec is not None:
            needed = forecaster.frames_needed(target_arcsec)
            row["frames_needed"] = np.inf if needed is None else float(needed)
        rows.append(row)
        if progress is not None:
            progress(len(rows), n_points)
    table = pd.DataFrame(rows)
    return table.astype({"n_frames": np.int64})


def _points(
    base: _Base, frames: FrameSet, noise_px: float
) -> Iterator[tuple[str, float, FloatArray, FrameSet, float]]:
    """Name, value, information, mission and part of the sky of every point of the sweeps."""
    deepest = float(np.max(base.stars.mag))
    for step in _MAG_STEPS:
        limit = base.max_mag + step
        # A catalogue ends at its faintest star, a little above the limit that it was cut at.
        if limit > deepest + 0.1:
            break
        stars = base.stars.select(base.stars.mag <= limit)
        sky = _sky_fraction(stars, base.tracker, base.seed)
        if sky < _LEAST_SKY:
            continue
        some = random_frames(
            stars,
            base.tracker,
            n_frames=min(_SWEEP_GEOMETRIES, frames.n_frames) if base.effects else _SWEEP_GEOMETRIES,
            seed=base.seed,
            effects=base.effects,
        )
        yield "magnitude limit", limit, some.information, some, sky
    seen = base.stars.select(base.stars.mag <= base.max_mag)
    sky = _sky_fraction(seen, base.tracker, base.seed)
    for factor in _NOISE_FACTORS:
        scaled = frames.with_noise(factor)
        yield "noise", factor * noise_px, scaled.information, scaled, sky
    for part in _FIELD_PARTS:
        yield "part of the detector", part, frames.seen_within(part), frames, sky


def _sky_fraction(stars: StarCatalogue, tracker: Tracker, seed: int) -> float:
    """Part of random attitudes that show enough stars."""
    if len(stars) == 0:
        return 0.0
    tried = random_rotations(_TRIED_ATTITUDES, np.random.default_rng([seed, 1]))
    views = tracker.sky(stars).views(tried)
    return float(np.mean([len(seen) >= tracker.min_stars for seen, _ in views]))


def start_information(after: HasInformation | None, camera: Camera) -> FloatArray | None:
    """Information (p, p) of data that are there already; None without. Refused if about other
    parameters.
    """
    if after is None:
        return None
    start = floats(after.information)
    if start.shape != (len(camera.theta),) * 2:
        raise PlanningError(
            f"the data that are there already are about {len(start)} parameters, but the camera "
            "has "
            f"{len(camera.theta)}: plan for the camera of that calibration."
        )
    return start


def _check(
    n_frames: Sequence[int],
    min_stars: int,
    target_arcsec: float | None,
    n_geometries: int,
    n_campaigns: int,
) -> None:
    require(
        PlanningError,
        (len(n_frames) > 0, "n_frames is empty: give some numbers of frames."),
        (min_stars >= 3, f"min_stars is {min_stars}: an attitude needs at least 3."),
        (
            target_arcsec is None or 0.0 < target_arcsec < np.inf,
            f"the target is {target_arcsec} arcsec: give an error above zero.",
        ),
        (n_geometries >= 50, f"n_geometries is {n_geometries}: give at least 50."),
        (n_campaigns >= 20, f"n_campaigns is {n_campaigns}: give at least 20."),
    )
