"""Checks of the data and of what the model leaves over."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.camera.distortion import get_model, next_richer
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.findings import Finding
from starcal_uq.core.remedy import (
    PLAN,
    SITE,
    UTC,
    Near,
    Remedies,
    calibrated,
    identified,
    with_model,
)
from starcal_uq.core.status import (
    MORE,
    Advice,
    Check,
    Code,
    Level,
    Note,
    Order,
    judged,
)
from starcal_uq.core.types import AnyDict
from starcal_uq.diagnostics.residuals import bin_residuals, normalised_residuals
from starcal_uq.diagnostics.verdict.effect import on_directions
from starcal_uq.estimation.residual_map import OUTLIER_SIGMA
from starcal_uq.sky.refraction import refraction_constants, shrinking
from starcal_uq.sky.site import HOUR_DEG, Site

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.diagnostics.air import AirTest
    from starcal_uq.diagnostics.times import TimeTest, UnseenAberration
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.partitions import PartitionedObservations
    from starcal_uq.observations.table import Observations

# Earth's orbital speed over that of light: the constant of annual aberration, rad.
ABERRATION_RAD = 9.94e-5
PLAUSIBLE_NOISE_PX = (0.003, 0.5)
PLAUSIBLE_SCALE = (0.7, 1.5)
PATTERN_P, OUTLIER_P = 1e-3, 1e-3
# Probability that right stars alone have one that their fitted tails do not explain.
TAILS_P = 0.05
COVERED_SHARE = 0.85
# Stated noise that is magnitudes: a small factor on it, its range, and what it stays below.
_FAR_BELOW, _MAGNITUDES = 0.2, (1.5, 20.0)
_SAME_UNIT = 1.3
MIN_FRAMES = 5
# What a wrong time may move parameters by and the numbers be used.
_SMALL_SIGMA = 1.0
# Remedies that several checks give.
SCREEN = calibrated(screening=True)
ROBUST = calibrated("command", effects="tails")
NOISE = calibrated(effects="noise")
EFFECTS = calibrated(effects="auto")
# Effects that bend directions where they keep their place in the field.
_OF_THE_FIELD = {"axes", "field", "radial"}


def directions(
    obs: Observations,
    cal: Calibration,
    found: AirTest | None = None,
    times: TimeTest | None = None,
    rests: Finding | None = None,
) -> Check:
    """Is annual aberration in the directions, and refraction where there is air? `rests` is what f
    rests on.
    """
    declared, code = obs.origin.directions, Code.CATALOGUE_DIRECTIONS
    seen = obs.origin.air
    estimated = _estimated(cal)
    wrong = [] if times is None else [_of_times(obs, times)]
    if found is not None and found.is_air:
        orders = (Order(Advice.GIVE_THE_DIRECTIONS),) if seen == "none" else ()
        wrong.append((_of_air(obs, found), _with_site(obs, found), orders))
    if wrong:
        parts, remedies, orders_of_each = zip(*wrong, strict=True)
        small = times is not None and len(wrong) == 1 and times.moves_sigma < _SMALL_SIGMA
        return Check(
            code,
            {"declared": declared, "parts": parts},
            Level.WARN if small else Level.FAIL,
            remedies=next(filter(None, remedies), ()),
            orders=sum(orders_of_each, ()),
        )
    if declared == "apparent" and seen == "unknown" and estimated is None:
        first = (Finding(Note.WITHOUT_REFRACTION), rests, *_unsure(cal, found))
        parts = (*filter(None, first), Order(Advice.STATE_THE_SITE))
        facts = {"declared": declared, "parts": parts}
        return Check(code, facts, Level.WARN, remedies=_about_air(obs))
    if declared == "apparent":
        site = Site.from_dict(obs.origin.site or {}) if seen == "corrected" else None
        held = {"in_space": obs.origin.observer == "space", "site": site}
        parts = tuple(filter(None, (Finding(Note.APPARENT_DIRECTIONS, held), estimated, rests)))
        facts = {"declared": declared, "parts": parts}
        if estimated is not None and seen == "none":
            # The frames contradict what was declared.
            orders = (Order(Advice.GIVE_THE_DIRECTIONS),)
            return Check(code, facts, Level.WARN, remedies=_with_site(obs, found), orders=orders)
        return Check(code, facts)
    stated = {"declared": obs.directions_declared, "timed": obs.time_utc is not None}
    parts = (Finding(Note.DIRECTIONS_WITHOUT_ABERRATION, stated), _of_aberration(cal))
    time = _time_of(obs) if obs.origin.from_images else {}
    remedies = _again(obs, **(time or {"directions": "apparent"}))
    if estimated is not None:
        # Apparent directions would hold the air as well.
        parts, wanted = (*parts, estimated), {} if time else {"directions": "catalogue"}
        remedies = _again(obs, **wanted, **_time_of(obs))
    elif seen == "unknown":
        parts = (*parts, *_unsure(cal, found), Order(Advice.STATE_THE_SITE))
        remedies += _about_air(obs)
    return Check(code, {"declared": declared, "parts": parts}, Level.WARN, remedies=remedies)


def rests_on_aberration(obs: Observations, found: UnseenAberration | None) -> Finding | None:
    """That f is conditional on aberration being in the directions once, where no residual can show
    that.
    """
    made = obs.origin.simulated or obs.origin.observer == "rendered"
    if found is None or made or not obs.origin.apparent:
        return None
    return Finding(Note.RESTS_ON_ABERRATION, asdict(found))


def _of_air(obs: Observations, found: AirTest) -> Finding:
    """That refraction is in the residuals, what it does to f, and where the camera would have
    stood.
    """
    known = bool(np.isfinite(found.latitude_deg))
    return Finding(
        Note.REFRACTION_IN_THE_RESIDUALS,
        {
            "p_value": found.p_value,
            "f_px": found.f_px,
            "f_sigma": found.f_sigma,
            "place": Site(found.latitude_deg, found.longitude_deg) if known else None,
            "place_std_deg": (found.latitude_std_deg, found.longitude_std_deg),
            "from_images": obs.origin.from_images,
            "air": obs.origin.air,
        },
    )


def _unsure(cal: Calibration, found: AirTest | None) -> tuple[Finding, ...]:
    """That f is conditional on refraction, and where the residuals leave open whether there is
    any.
    """
    like = found is not None and found.like_others
    return (conditional(cal), *((Finding(Note.LIKE_REFRACTION),) if like else ()))


def _of_times(obs: Observations, found: TimeTest) -> tuple[Finding, Remedies, tuple[Order, ...]]:
    """A time, or an epoch, that is not that of the stars: fact, remedies and orders."""
    facts = asdict(found)
    if found.cause == "hour":
        facts["east_deg"] = HOUR_DEG * found.later
    wrong, remedies = Finding(Note.WRONG_TIMES, facts), ()
    if found.cause == "epoch":
        return wrong, (), (Order(Advice.CORRECT_THE_EPOCH),)
    if found.cause == "no aberration":
        unknown = obs.origin.from_images and obs.time_utc is None
        kind = {} if unknown else {"directions": "catalogue"}
        return wrong, _again(obs, **kind, **_time_of(obs)), ()
    if found.cause == "aberration twice":
        return wrong, _again(obs, directions="apparent"), ()
    return wrong, remedies, (Order(Advice.CORRECT_THE_TIMES),)


def wrong_time(obs: Observations, cal: Calibration) -> str | None:
    """The wrong time that the residuals of a calibration show, with its remedy, as the end of a
    sentence.
    """
    from starcal_uq.diagnostics.times import time_test

    try:
        found = time_test(obs, cal)
    except np.linalg.LinAlgError:
        return None
    if found is None or not np.isfinite(found.moves_sigma):
        return None
    wrong, remedies, orders = _of_times(obs, found)
    sentence = wrong.sentence
    order = f"Use `{remedies[0].words}`." if remedies else ""
    said = (sentence[1:], *(one.sentence for one in orders), order)
    return sentence[0].lower() + " ".join(filter(None, said))


def _time_of(obs: Observations) -> dict[str, str]:
    """The option that gives a time to what has none."""
    return {} if obs.timed else {"time": UTC}


def _again(obs: Observations, **options: Any) -> Remedies:
    """What makes the directions of these stars: of images they are made while they are
    identified.
    """
    return identified(**options) if obs.origin.from_images else calibrated("command", **options)


def _with_site(obs: Observations, found: AirTest | None = None) -> Remedies:
    """A site: the one that the residuals point to, where they do, else one that is not known."""
    site: str | Near = SITE
    if found is not None and np.isfinite(found.latitude_deg):
        site = Near(found.latitude_deg, found.longitude_deg)
    return _again(obs, site=site, **_time_of(obs))


def _about_air(obs: Observations) -> Remedies:
    return _with_site(obs) + _again(obs, in_space=True)


def _of_aberration(cal: Calibration) -> Finding:
    """What annual aberration can do to this camera if it is not in the directions."""
    ratio = ABERRATION_RAD * cal.camera.focal_px / float(cal.sigmas[2])
    return Finding(Note.ABERRATION, aberration_size(cal.camera) | {"f_sigma": ratio})


def aberration_size(camera: Camera) -> dict[str, float]:
    """What annual aberration can do to a camera of this field: from corner to corner, and to f."""
    angle = get_model(camera.distortion).plane.angle
    diagonal_rad = 2.0 * angle(camera.half_diagonal_px / camera.focal_px)
    return {
        "corners_arcsec": float(ABERRATION_RAD * diagonal_rad * ARCSEC),
        "f_px": ABERRATION_RAD * camera.focal_px,
    }


def residual_pattern(
    obs: Observations,
    cal: Calibration,
    better: str | None = None,
    effects: Sequence[str] = (),
) -> Check:
    """Do mean residuals over the field show more than noise? `better` as for `lens_remedy`;
    `effects` are those that the data would take up.
    """
    binned = bin_residuals(cal, obs)
    pattern = binned.pattern_px
    facts: AnyDict = {
        "p_value": binned.p_value,
        "pattern_px": pattern,
        "pattern_arcsec": pattern / cal.camera.focal_px * ARCSEC,
        "n_cells": len(binned.counts),
    }
    code, bounds = Code.PATTERN_IN_THE_RESIDUALS, {"p_value_least": PATTERN_P}
    if binned.p_value >= PATTERN_P:
        return Check(code, facts, bounds=bounds)
    seen = 2.0 * float(binned.counts.sum()) * (pattern / _noise_px(obs, cal)) ** 2
    effect = on_directions(seen, len(cal.theta))
    remedies, orders = lens_remedy(cal.camera.distortion, better)
    if _OF_THE_FIELD & set(effects):
        remedies, orders = EFFECTS + remedies, ()
    return Check(code, facts | effect.facts, effect.level, bounds, remedies, orders)


def lens_remedy(fitted: str, better: str | None = None) -> tuple[Remedies, tuple[Order, ...]]:
    """Remedies and orders where the residuals hold a pattern of the field.

    `better` is the model that a comparison prefers, empty if none; without a comparison, one with
    further terms.
    """
    model = better if better is not None else next_richer(fitted)
    return (with_model(model), ()) if model else ((), (Order(Advice.COUNT_THE_PATTERN),))


def outliers(obs: Observations, cal: Calibration) -> Check:
    """Are there more large residuals than Gaussian noise gives?"""
    from scipy.special import erfc, pdtrc

    if cal.partitions is not None:
        n_stars, found, largest = cal.n_stars, cal.partitions.n_beyond, cal.partitions.largest
        frame = cal.partitions.largest_frame
    else:
        z = np.abs(normalised_residuals(cal, obs))
        n_stars = obs.n_stars
        found = int(np.count_nonzero(np.any(z > OUTLIER_SIGMA, axis=1)))
        largest = float(z.max())
        frame = int(obs.frame[int(np.argmax(z.max(axis=1)))])
    expected = n_stars * 2.0 * float(erfc(OUTLIER_SIGMA / np.sqrt(2.0)))
    # Probability of at least `found` where `expected` are expected (Poisson).
    p_value = 1.0 if found == 0 else float(pdtrc(found - 1, expected))
    facts: AnyDict = {
        "n_beyond": found,
        "largest_sigma": largest,
        "frame": frame,
        "p_value": p_value,
    }
    facts |= {"beyond_sigma": OUTLIER_SIGMA, "expected": expected}
    facts["beyond_tails"] = _beyond_tails(obs, cal)
    return judged(Code.OUTLIERS, facts, {"p_value_least": OUTLIER_P}, SCREEN)


def _beyond_tails(obs: Observations, cal: Calibration) -> list[AnyDict]:
    """Stars that even the fitted tails do not explain, the farthest first.

    Their weights are (nu + 2) / (nu + r^2), so that a residual of r scales has the probability
    (1 + r^2 / nu)^(-nu / 2). Weighted residuals of any star stay below sqrt(nu + 2).
    """
    record, weights = cal.provenance.student_t, cal.star_weights
    if not record or cal.partitions is not None:
        return []
    nu = float(record["dof"])
    if weights is None:
        weights = (nu + 2.0) / (nu + np.sum(normalised_residuals(cal, obs) ** 2, axis=1))
    beyond = obs.n_stars * (nu / (nu + 2.0) * weights) ** (0.5 * nu) < TAILS_P
    distance = np.hypot(*cal.residuals_px.T)
    rows = sorted(np.flatnonzero(beyond), key=lambda row: -distance[row])
    names = obs.named
    return [
        {"frame": int(obs.frame[i]), "star": str(names[i]), "x_px": float(obs.xy[i, 0]),
         "y_px": float(obs.xy[i, 1]), "residual_px": float(distance[i])}
        for i in rows
    ]  # fmt: skip


def screening(obs: Observations) -> Check | None:
    """Did screening find stars to blame, or the model?"""
    record = obs.origin.screening
    if not isinstance(record, dict) or "blame" not in record:
        return None
    facts = {
        "rejected": int(record["rejected"]),
        "of": int(record["of"]),
        # A table of an earlier version has words alone.
        "blame": Finding(Note.MODEL_IS_WRONG, record["blamed"])
        if "blamed" in record
        else str(record["blame"]),
    }
    remedies = calibrated("command", effects="noise")
    return Check(Code.SCREENING, facts, Level.WARN, remedies=remedies)


def noise(obs: Observations, cal: Calibration) -> Check:
    """Is the estimated noise that of star centroids?"""
    scaled = cal.sigma_name == "sigma_scale"
    low, high = PLAUSIBLE_SCALE if scaled else PLAUSIBLE_NOISE_PX
    fitted = cal.fitted_noise if scaled else None
    good = low <= cal.sigma <= high
    if fitted is not None and not fitted.multiplies:
        good = PLAUSIBLE_NOISE_PX[0] <= cal.sigma * fitted.level_px <= PLAUSIBLE_NOISE_PX[1]
    code, unit = Code.CENTROID_NOISE_PER_AXIS, "_px"
    if scaled:
        code, unit = Code.FACTOR_ON_THE_STATED_NOISE, ""
        if fitted is not None:
            code = Code.FACTOR_ON_THE_FITTED_NOISE
    facts: AnyDict = {f"noise{unit}": cal.sigma}
    remedies: Remedies = ()
    orders: tuple[Order, ...] = ()
    if good:
        facts |= {} if fitted is None else {"fitted": fitted}
    elif cal.sigma > high:
        remedies = SCREEN
    elif scaled:
        remedies = NOISE
    else:
        orders = (Order(Advice.GIVE_MEASURED_CENTROIDS),)
    if not good and scaled and fitted is None and (unlike := _stated_unit(obs, cal)):
        facts["unlike"], orders = unlike
        remedies = ()
    bounds = {f"least{unit}": low, f"most{unit}": high}
    return judged(code, facts, bounds, remedies, orders, good=good)


def _stated_unit(obs: Observations, cal: Calibration) -> tuple[Finding, tuple[Order, ...]] | None:
    """What the column of stated noise holds, where it is not px, and what to do; None if that
    cannot be told.
    """
    stated, in_px = obs.sigma_px, (Order(Advice.STATE_NOISE_IN_PX),)
    if stated is None:
        return None
    if floor := obs.origin.noise_floor_px:  # The column is not the user's.
        less = Finding(Note.ADDED_NOISE_TOO_LARGE, {"added_px": floor})
        return (less, (Order(Advice.ACCEPT_THE_FACTOR),)) if cal.sigma < 1.0 else None
    arcsec_per_px = ARCSEC / cal.camera.focal_px
    if obs.mag is not None and np.array_equal(stated, obs.mag):
        return Finding(Note.NOISE_IS_THE_MAGNITUDES), in_px
    if cal.sigma < _FAR_BELOW and np.ptp(stated) > _MAGNITUDES[0] and stated.max() < _MAGNITUDES[1]:
        ends = {"least": float(stated.min()), "most": float(stated.max())}
        return Finding(Note.NOISE_LIKE_MAGNITUDES, ends), in_px
    if 1.0 / _SAME_UNIT < cal.sigma * arcsec_per_px < _SAME_UNIT:
        like = Finding(Note.NOISE_LIKE_ARCSECONDS, {"arcsec_per_px": arcsec_per_px})
        return like, (Order(Advice.DIVIDE_THE_NOISE),)
    return None


def partitions(cal: Calibration) -> Check | None:
    """Is the noise of all files of a folder the same?"""
    from scipy.special import erfc

    if cal.partitions is None:
        return None
    found = cal.partitions
    dof = (2.0 * found.n_stars - 3.0 * found.n_frames) * cal.dof / (cal.dof + len(cal.theta))
    # Wilson and Hilferty (1931): the cube root of a mean square is normal, in the tails too.
    spread = 2.0 / (9.0 * dof)
    z = (np.cbrt(found.chi2 / cal.sigma**2 / dof) - (1.0 - spread)) / np.sqrt(spread)
    worst = int(np.argmax(np.abs(z)))
    p_value = min(1.0, len(z) * float(erfc(abs(z[worst]) / np.sqrt(2.0))))
    return judged(
        Code.NOISE_OF_THE_FILES,
        {
            "p_value": p_value,
            "file": worst + 1,
            "n_files": len(z),
            "times": float(np.sqrt(found.chi2[worst] / dof[worst])) / cal.sigma,
        },
        {"p_value_least": PATTERN_P},
        orders=(Order(Advice.LOOK_AT_THE_FILE),),
    )


def terms(cal: Calibration) -> Check | None:
    """Do all stars of partitioned observations ask for terms that the distortion model lacks?"""
    from scipy.special import gammaincc

    if cal.partitions is None or not cal.partitions.richer:
        return None
    richer = cal.partitions.richer
    single = [float(gammaincc(0.5 * other.n_terms, 0.5 * max(other.gain, 0.0))) for other in richer]
    best = int(np.argmin(single))
    name = richer[best].model
    return judged(
        Code.TERMS_OF_THE_DISTORTION,
        {"p_value": min(1.0, len(single) * single[best]), "model": name},
        {"p_value_least": PATTERN_P},
        calibrated("command", model=name),
    )


def coverage(obs: Observations, cal: Calibration) -> Check:
    """Did the stars cover the field, and how many frames were there?"""
    binned = bin_residuals(cal, obs)
    share = len(binned.counts) / max(len(binned.counts) + binned.n_empty, 1)
    n_frames = obs.n_frames if cal.partitions is None else cal.n_frames
    return judged(
        Code.COVERAGE_OF_THE_FIELD,
        {"share": share, "n_frames": n_frames},
        {"share_least": COVERED_SHARE, "n_frames_least": MIN_FRAMES},
        PLAN,
        MORE,
    )


def _noise_px(obs: Observations, cal: Calibration) -> float:
    stated = 1.0 if obs.sigma_px is None else float(np.sqrt(np.mean(obs.sigma_px**2)))
    return cal.sigma * stated


_HIGH_DEG, _MIDDLE_DEG = 90.0, 45.0
# What pressure and temperature of a place may differ from the standard atmosphere: 1.5 % and 4 %.
_WEATHER = 0.04


def _estimated(cal: Calibration) -> Finding | None:
    """The air that the calibration has estimated, and where; None where it has not."""
    found = cal.known_effects.air
    return None if found is None else Finding(Note.REFRACTION_ESTIMATED, {"found": found})


def refraction(obs: Observations | PartitionedObservations, cal: Calibration) -> Finding | None:
    """What refraction does to f: as it is in the directions, as it was estimated, or what f is
    conditional on; None where there is none.
    """
    if obs.origin.air == "corrected":
        return corrected(obs, cal)
    unknown = obs.origin.air == "unknown"
    return _estimated(cal) or (conditional(cal) if unknown else None)


def conditional(cal: Calibration) -> Finding:
    """That f is conditional on refraction, with the size of the effect on this camera in standard
    air at sea level.
    """
    constants = refraction_constants(Site(latitude_deg=45.0, longitude_deg=0.0))
    focal, sigma = cal.camera.focal_px, float(cal.sigmas[2])
    high, middle = (
        float(shrinking(altitude, constants)) * focal for altitude in (_HIGH_DEG, _MIDDLE_DEG)
    )
    return Finding(
        Note.CONDITIONAL_ON_REFRACTION,
        {"zenith_px": high, "middle_px": middle, "f_sigma_px": sigma},
    )


def corrected(obs: Observations | PartitionedObservations, cal: Calibration) -> Finding:
    """Which air was taken at which site, and what it does to f."""
    site, atmosphere = Site.from_dict(obs.origin.site or {}), obs.origin.atmosphere or {}
    size = float(atmosphere["shrinking"]) * cal.camera.focal_px
    sigma = float(cal.sigmas[2])
    return Finding(
        Note.REFRACTION_CORRECTED,
        {
            "site": site,
            "altitudes_deg": tuple(
                float(atmosphere[f"altitude_{end}_deg"]) for end in ("min", "max")
            ),
            "f_px": size,
            "f_sigma": size / sigma,
            "weather": _WEATHER,
            "weather_matters": bool(site.assumed and _WEATHER * size > sigma),
        },
    )
