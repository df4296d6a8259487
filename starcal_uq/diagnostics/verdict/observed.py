"""Checks of the data and of what the model leaves over."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from starcal_uq.camera.distortion import get_model
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.formatting import fixed, percent, plural, significant
from starcal_uq.core.remedy import (
    MORE,
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
    Check,
    Code,
    Level,
    pass_or_warn,
)
from starcal_uq.core.times import TIMES_IN_NAMES
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
COVERED_SHARE = 0.85
# Stated noise that is magnitudes: a small factor on it, its range, and what it stays below.
_FAR_BELOW, _MAGNITUDES = 0.2, (1.5, 20.0)
_SAME_UNIT = 1.3
MIN_FRAMES = 5
# What a wrong time may move parameters by and the numbers be used.
_SMALL_SIGMA = 1.0
# Remedies that several checks give.
SCREEN = calibrated(screening=True)
_RICHEST = "brown_tangential"
_NO_MODEL = (
    "Count the pattern as an error of the directions, as the attitude error with the misfit "
    "found does: no distortion "
    "model here follows it."
)
ROBUST = calibrated("command", likelihood="student_t")
NOISE = calibrated(noise="model")


def directions(
    obs: Observations,
    cal: Calibration,
    found: AirTest | None = None,
    times: TimeTest | None = None,
    rests: str = "",
) -> Check:
    """Is annual aberration in the directions, and refraction where there is air? `rests` is what f
    rests on.
    """
    declared = obs.origin.directions
    name, bound = Code.CATALOGUE_DIRECTIONS, "apparent"
    seen = air(obs)
    wrong = [] if times is None else [_time_words(obs, times)]
    if found is not None and found.is_air:
        order = (
            "Give the directions of a catalogue, or apparent ones that hold refraction."
            if seen == "none"
            else ""
        )
        wrong.append(
            (
                f"refraction, p = {significant(found.p_value)}",
                air_words(obs, found),
                _with_site(obs, found),
                order,
            )
        )
    if wrong:
        values, sentences, remedies, orders = zip(*wrong, strict=True)
        first, advice = next(filter(None, remedies), ()), " ".join(filter(None, orders))
        small = times is not None and len(wrong) == 1 and times.moves_sigma < _SMALL_SIGMA
        level = Level.WARN if small else Level.FAIL
        return Check(
            name,
            level,
            "; ".join(values),
            bound,
            " ".join(sentences),
            first,
            advice,
        )
    if declared == "apparent" and seen == "unknown":
        words = (
            "Aberration is in the directions, refraction is not.",
            rests,
            _unsure(cal, found),
            REMEDY,
        )
        sentence = " ".join(filter(None, words))
        return Check(
            name,
            Level.WARN,
            "without refraction",
            bound,
            sentence,
            _about_air(obs),
        )
    if declared == "apparent":
        sentence = "The directions are declared as apparent: aberration is in them."
        if obs.origin.observer == "space":
            sentence = "Aberration is in the directions; the camera was in space."
        if seen == "corrected":
            sentence = (
                f"Aberration and refraction at the site ({Site.from_dict(obs.origin.site or {})}) are "
                "in the directions."
            )
        sentence = f"{sentence} {rests}".rstrip()
        return Check(name, Level.PASS, declared, bound, sentence)
    sentence = f"{_undeclared(obs)} {aberration_words(cal)}"
    time = _time_of(obs) if obs.origin.from_images else {}
    remedies = _again(obs, **(time or {"directions": "apparent"}))
    if seen == "unknown":
        sentence = f"{sentence} {_unsure(cal, found)} {REMEDY}"
        remedies += _about_air(obs)
    return Check(name, Level.WARN, declared, bound, sentence, remedies)


def rests_on_aberration(obs: Observations, found: UnseenAberration | None) -> str:
    """That f is conditional on aberration being in the directions once, where no residual can show
    that.
    """
    made = obs.origin.simulated or obs.origin.observer == "rendered"
    if found is None or made or not obs.origin.apparent:
        return ""
    size = f"{significant(found.f_px)} px ({significant(found.f_sigma)} sigma)"
    return (
        "The focal length f rests on annual aberration being in the directions, once: left out "
        "or applied twice, it "
        f"would move f by {'' if found.dated else 'up to '}{size}, and the residuals of these "
        "frames would not show it."
    )


def air_words(obs: Observations, found: AirTest) -> str:
    """That refraction is in the residuals, what it does to f, and where the camera would have
    stood.
    """
    first = (
        "The residuals hold refraction that the directions do not: f is too short by "
        f"{significant(found.f_px)} px ({significant(found.f_sigma)} sigma)."
    )
    if not np.isfinite(found.latitude_deg):
        times = f"--time, or {TIMES_IN_NAMES if obs.origin.from_images else 'column time_utc'}"
        return f"{first} The frames have no times: state the site (--site) and the times ({times})."
    place = Site(found.latitude_deg, found.longitude_deg)
    errors = (significant(error) for error in (found.latitude_std_deg, found.longitude_std_deg))
    ends = " and ".join(f"± {error}°" for error in errors)
    seen = {
        "corrected": "Check site, pressure and times",
        "none": "They are declared to hold all there is: check that",
    }
    asked = seen.get(air(obs), "State the site (--site)")
    return f"{first} {asked}; the residuals point to {place.words} ({ends})."


def _unsure(cal: Calibration, found: AirTest | None) -> str:
    """That f is conditional on refraction, and where the residuals leave open whether there is
    any.
    """
    if found is None or not found.like_others:
        return conditional_words(cal)
    return (
        f"{conditional_words(cal)} The residuals hold what refraction would leave if the zenith "
        "kept its place in the "
        "camera, and so would axes of different scale, skewed axes or a drift of f: these cannot "
        "be told apart here."
    )


def _time_words(obs: Observations, found: TimeTest) -> tuple[str, str, Remedies, str]:
    """Value, sentence, remedies and advice of a time, or an epoch, that is not that of the stars."""
    effect = f"it moves {found.moves} by {significant(found.moves_sigma)} sigma"
    unit = {"epoch": "years", "date": "days", "hour": "hours"}.get(found.cause, "")
    later = f"{significant(abs(found.later))} ± {significant(found.later_std)} {unit}"
    later += " later" if found.later > 0.0 else " earlier"
    if found.cause == "epoch":
        sentence = (
            f"By proper motion the stars are those of an epoch {later} than that of the "
            f"directions: {effect}."
        )
        return (
            f"epoch {later}",
            sentence,
            (),
            "Correct the times, or give directions of the epoch of the images.",
        )
    if found.cause == "no aberration":
        sentence = f"The residuals hold annual aberration that the directions do not: {effect}."
        unknown = obs.origin.from_images and obs.time_utc is None
        kind = {} if unknown else {"directions": "catalogue"}
        return "no aberration", sentence, _again(obs, **kind, **_time_of(obs)), ""
    if found.cause == "aberration twice":
        sentence = f"The directions hold annual aberration twice: {effect}."
        return "aberration twice", sentence, _again(obs, directions="apparent"), ""
    what, other = "Annual aberration", ""
    if found.cause == "hour":
        east = HOUR_DEG * found.later
        what, other = (
            "Refraction",
            f", or a site {significant(abs(east))}° further {'east' if east > 0.0 else 'west'}",
        )
    sentence = f"{what} in the residuals is that of times {later} than stated{other}: {effect}."
    return f"times {later}", sentence, (), "Correct the times, which are UTC (column time_utc)."


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
    _, sentence, remedies, advice = _time_words(obs, found)
    order = f"Use `{remedies[0].words}`." if remedies else ""
    return sentence[0].lower() + " ".join(filter(None, (sentence[1:], advice, order)))


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


def aberration_words(cal: Calibration) -> str:
    """What annual aberration can do to this camera if it is not in the directions."""
    ratio = significant(ABERRATION_RAD * cal.camera.focal_px / float(cal.sigmas[2]))
    return f"Annual aberration {aberration_size(cal.camera)}, {ratio} times its sigma."


def aberration_size(camera: Camera) -> str:
    """What annual aberration can do to a camera of this field, as the end of a sentence."""
    diagonal_rad = 2.0 * np.arctan(camera.half_diagonal_px / camera.focal_px)
    angle = fixed(ABERRATION_RAD * diagonal_rad * ARCSEC, 1)
    return (
        f"changes angles by up to {angle} arcsec from corner to corner of this field and can "
        "move f by up to "
        f"{significant(ABERRATION_RAD * camera.focal_px)} px"
    )


def residual_pattern(obs: Observations, cal: Calibration, better: str | None = None) -> Check:
    """Do mean residuals over the field show more than noise? `better` as for `lens_remedy`."""
    binned = bin_residuals(cal, obs)
    p_value, pattern = binned.p_value, binned.pattern_px
    cells = len(binned.counts)
    if p_value >= PATTERN_P:
        level, sentence = (
            Level.PASS,
            f"Mean residuals in {plural(cells, 'cell')} of the field are what noise gives.",
        )
    else:
        seen = 2.0 * float(binned.counts.sum()) * (pattern / _noise_px(obs, cal)) ** 2
        effect = on_directions(seen, len(cal.theta))
        level = effect.level
        arcsec = pattern / cal.camera.focal_px * ARCSEC
        sentence = (
            f"The residuals show a pattern of {significant(pattern)} px per axis "
            f"({significant(arcsec)} arcsec) that "
            f"the model does not explain; it is not in any interval of this report. {effect}"
        )
    value = f"p = {significant(p_value)}" + (
        f", pattern {significant(pattern)} px" if pattern > 0.0 else ""
    )
    remedies: Remedies = ()
    advice = ""
    if level is not Level.PASS:
        remedies, advice = lens_remedy(cal.camera.distortion, better)
    name, bound = Code.PATTERN_IN_THE_RESIDUALS, f"p ≥ {PATTERN_P:g}"
    return Check(name, level, value, bound, sentence, remedies, advice)


def lens_remedy(fitted: str, better: str | None = None) -> tuple[Remedies, str]:
    """Remedies and advice where the residuals hold a pattern of the field.

    `better` is the model that a comparison prefers, empty if none; without a comparison, one with
    further terms.
    """
    has_all = {coefficient.name for coefficient in get_model(_RICHEST).coefficients}
    further = {coefficient.name for coefficient in get_model(fitted).coefficients} < has_all
    model = better if better is not None else _RICHEST if further else ""
    return (with_model(model), "") if model else ((), _NO_MODEL)


def outliers(obs: Observations, cal: Calibration) -> Check:
    """Are there more large residuals than Gaussian noise gives?"""
    from scipy.special import erfc, pdtrc

    if cal.partitions is not None:
        n_stars, found, largest = cal.n_stars, cal.partitions.n_beyond, cal.partitions.largest
        frame = cal.partitions.largest_frame
    else:
        z = np.abs(normalised_residuals(cal, obs))
        n_stars, found, largest = (
            obs.n_stars,
            int(np.count_nonzero(np.any(z > OUTLIER_SIGMA, axis=1))),
            float(z.max()),
        )
        frame = int(obs.frame[int(np.argmax(z.max(axis=1)))])
    expected = n_stars * 2.0 * float(erfc(OUTLIER_SIGMA / np.sqrt(2.0)))
    # Probability of at least `found` where `expected` are expected (Poisson).
    p_value = 1.0 if found == 0 else float(pdtrc(found - 1, expected))
    good = p_value >= OUTLIER_P
    place = f"largest {fixed(largest, 1)} sigma, in frame {frame}"
    sentence = (
        f"As many as Gaussian noise gives ({place})."
        if good
        else (
            f"More than Gaussian noise gives ({place}): look for wrong identifications and "
            "disturbed centroids."
        )
    )
    value = f"{plural(found, 'star')} beyond {OUTLIER_SIGMA:g} sigma"
    bound = f"about {significant(expected)} expected"
    remedies = () if good else SCREEN
    return Check(Code.OUTLIERS, pass_or_warn(good), value, bound, sentence, remedies)


def screening(obs: Observations) -> Check | None:
    """Did screening find stars to blame, or the model?"""
    record = obs.origin.screening
    if not isinstance(record, dict) or "blame" not in record:
        return None
    value = f"{plural(int(record['rejected']), 'star')} of {int(record['of'])} rejected"
    sentence, remedies = str(record["blame"]), calibrated("command", noise="model")
    sentence = sentence[0].upper() + sentence[1:]
    return Check(
        Code.SCREENING,
        Level.WARN,
        value,
        "wrong stars alone",
        sentence,
        remedies,
    )


def noise(obs: Observations, cal: Calibration) -> Check:
    """Is the estimated noise that of star centroids?"""
    scaled = cal.sigma_name == "sigma_scale"
    low, high = PLAUSIBLE_SCALE if scaled else PLAUSIBLE_NOISE_PX
    fitted = cal.fitted_noise if scaled else None
    good = low <= cal.sigma <= high
    if fitted is not None and not fitted.multiplies:
        good = PLAUSIBLE_NOISE_PX[0] <= cal.sigma * fitted.level_px <= PLAUSIBLE_NOISE_PX[1]
    unit, advice = "" if scaled else " px", ""
    remedies: Remedies = ()
    value = f"{significant(cal.sigma, 3)}{unit}"
    if good:
        sentence = (
            "The stated noise of the stars is confirmed." if scaled else "Usual for star centroids."
        )
        if fitted is not None:
            sentence = f"The noise was fitted: {fitted}."
    elif cal.sigma > high:
        sentence = (
            "Far more scatter than centroids have: identifications, camera file or distortion "
            "model may be wrong."
        )
        remedies = SCREEN
    elif scaled:
        sentence = "Less scatter than is stated: the stated noise is too large."
        remedies = NOISE
    else:
        sentence = "Less scatter than centroids have: the data are not measurements."
        advice = (
            "Give centroids as they were measured, not positions that were computed or smoothed."
        )
    if not good and scaled and fitted is None and (unlike := _stated_unit(obs, cal)):
        (sentence, advice), remedies = unlike, ()
    name = Code.CENTROID_NOISE_PER_AXIS
    if scaled:
        name = Code.FACTOR_ON_THE_STATED_NOISE
        if fitted is not None:
            name = Code.FACTOR_ON_THE_FITTED_NOISE
    bound = f"{low:g} to {high:g}{unit}"
    return Check(name, pass_or_warn(good), value, bound, sentence, remedies, advice)


def _stated_unit(obs: Observations, cal: Calibration) -> tuple[str, str] | None:
    """What the column of stated noise holds, where it is not px, and what to do; None if that
    cannot be told.
    """
    stated, in_px = obs.sigma_px, "Give the noise in px, or leave the column out."
    if stated is None:
        return None
    if floor := obs.origin.noise_floor_px:  # The column is not the user's.
        less = (
            f"Less scatter than the stars state: the {significant(floor)} px that were added to "
            "each are too many."
        )
        return (less, "Accept it: the factor is in every interval.") if cal.sigma < 1.0 else None
    arcsec_per_px = ARCSEC / cal.camera.focal_px
    if obs.mag is not None and np.array_equal(stated, obs.mag):
        return "Column sigma_px holds the magnitudes.", in_px
    if cal.sigma < _FAR_BELOW and np.ptp(stated) > _MAGNITUDES[0] and stated.max() < _MAGNITUDES[1]:
        ends = f"{stated.min():.3g} to {stated.max():.3g}"
        return f"Column sigma_px ({ends}) looks like magnitudes.", in_px
    if 1.0 / _SAME_UNIT < cal.sigma * arcsec_per_px < _SAME_UNIT:
        per = significant(arcsec_per_px, 3)
        return (
            f"Column sigma_px looks like arcseconds, of which a pixel has {per}.",
            "Divide it by that.",
        )
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
    good = p_value >= PATTERN_P
    factor = float(np.sqrt(found.chi2[worst] / dof[worst])) / cal.sigma
    place = (
        f"file {worst + 1} of {len(z)}, by frame number, has {significant(factor, 3)} times the "
        "common noise"
    )
    sentence = (
        f"The files scatter as alike as noise of one size lets them ({place})."
        if good
        else f"The files scatter unequally ({place})."
    )
    value, bound, name = (
        f"p = {significant(p_value)}",
        f"p ≥ {PATTERN_P:g}",
        Code.NOISE_OF_THE_FILES,
    )
    advice = (
        ""
        if good
        else "Look for what changed in that file, or calibrate each by itself and compare the runs."
    )
    return Check(name, pass_or_warn(good), value, bound, sentence, advice=advice)


def terms(cal: Calibration) -> Check | None:
    """Do all stars of partitioned observations ask for terms that the distortion model lacks?"""
    from scipy.special import gammaincc

    if cal.partitions is None or not cal.partitions.richer:
        return None
    richer = cal.partitions.richer
    single = [float(gammaincc(0.5 * other.n_terms, 0.5 * max(other.gain, 0.0))) for other in richer]
    best = int(np.argmin(single))
    name, p_value = richer[best].model, min(1.0, len(single) * single[best])
    good = p_value >= PATTERN_P
    sentence = (
        (
            f"No richer distortion model fits all stars better than chance lets it ({name!r} comes "
            "nearest)."
        )
        if good
        else f"All stars together ask for the terms of the distortion model {name!r}."
    )
    value, bound = f"p = {significant(p_value)}", f"p ≥ {PATTERN_P:g}"
    remedies = () if good else calibrated("command", model=name)
    return Check(
        Code.TERMS_OF_THE_DISTORTION,
        pass_or_warn(good),
        value,
        bound,
        sentence,
        remedies,
    )


def coverage(obs: Observations, cal: Calibration) -> Check:
    """Did the stars cover the field, and how many frames were there?"""
    binned = bin_residuals(cal, obs)
    share = len(binned.counts) / max(len(binned.counts) + binned.n_empty, 1)
    n_frames = obs.n_frames if cal.partitions is None else cal.n_frames
    value = f"{percent(share, 3)} of the field, {plural(n_frames, 'frame')}"
    bound = f"≥ {percent(COVERED_SHARE)}, ≥ {MIN_FRAMES} frames"
    remedies, advice = PLAN, MORE
    if share < COVERED_SHARE:
        level, sentence = (
            Level.WARN,
            "Parts of the field hold no stars: the distortion is extrapolated there.",
        )
    elif n_frames < MIN_FRAMES:
        level, sentence = (
            Level.WARN,
            "Few frames: errors common to a whole frame cannot be told from the camera.",
        )
    else:
        level, sentence = (
            Level.PASS,
            "Stars covered the field, so that no part of it is extrapolated.",
        )
        remedies, advice = (), ""
    return Check(
        Code.COVERAGE_OF_THE_FIELD,
        level,
        value,
        bound,
        sentence,
        remedies,
        advice,
    )


def _noise_px(obs: Observations, cal: Calibration) -> float:
    stated = 1.0 if obs.sigma_px is None else float(np.sqrt(np.mean(obs.sigma_px**2)))
    return cal.sigma * stated


def _undeclared(obs: Observations) -> str:
    if obs.directions_declared:
        return "The directions come straight from a catalogue."
    if obs.time_utc is None:
        return (
            "Neither time nor observer velocity was declared, so it is not known whether "
            "aberration is in the "
            "directions."
        )
    return "The table has times, but it was not declared whether aberration is in the directions."


REMEDY = "State the site (--site) and the times, or that the camera was in space (--in-space)."
Air: TypeAlias = Literal["corrected", "none", "unknown"]
_HIGH_DEG, _MIDDLE_DEG = 90.0, 45.0
# What pressure and temperature of a place may differ from the standard atmosphere: 1.5 % and 4 %.
_WEATHER = 0.04


def air(obs: Observations | PartitionedObservations) -> Air:
    """Whether refraction is in the directions, is out of the question, or is not known.

    Directions that the user declared as apparent are what the camera saw, with all there is to it.
    """
    origin = obs.origin
    if origin.observer == "ground":
        return "corrected"
    declared = origin.apparent and origin.observer != "unknown"
    return "none" if origin.without_air or origin.simulated or declared else "unknown"


def conditional_words(cal: Calibration) -> str:
    """That f is conditional on refraction, with the size of the effect on this camera in standard
    air at sea level.
    """
    constants = refraction_constants(Site(latitude_deg=45.0, longitude_deg=0.0))
    focal, sigma = cal.camera.focal_px, float(cal.sigmas[2])
    sizes = [float(shrinking(altitude, constants)) * focal for altitude in (_HIGH_DEG, _MIDDLE_DEG)]
    high, middle = (f"{significant(size)} px ({significant(size / sigma)} sigma)" for size in sizes)
    return (
        "The focal length f is conditional on refraction: if the stars were seen through air, f "
        "is too short by "
        f"{high} at the zenith and by {middle} at 45° of altitude."
    )


def corrected_words(obs: Observations, cal: Calibration) -> str:
    """Which air was taken at which site, and what it does to f."""
    site, atmosphere = Site.from_dict(obs.origin.site or {}), obs.origin.atmosphere or {}
    size = float(atmosphere["shrinking"]) * cal.camera.focal_px
    sigma = float(cal.sigmas[2])
    assumed = " and ".join(site.assumed)
    source = f" ({assumed} of the standard atmosphere)" if assumed else ""
    low, high = (fixed(float(atmosphere[f"altitude_{end}_deg"]), 0) for end in ("min", "max"))
    per_cent = (
        f"each per cent of the air’s density (10 hPa, 3 °C) counts {significant(0.01 * size)} px"
    )
    weather = ""
    if site.assumed and _WEATHER * size > sigma:
        weather = (
            f" The weather may differ from the standard atmosphere by {_WEATHER * 100:.0f} %, "
            "which is more than the "
            "sigma of f: state pressure and temperature."
        )
    return (
        f"Site: {site}. Refraction in air of {fixed(site.air_pressure_hpa, 0)} hPa and "
        f"{fixed(site.air_temperature_c, 0)} °C{source} is in the directions, at altitudes of "
        f"{low}° to {high}°. "
        f"Without it f would come out {significant(size)} px ({significant(size / sigma)} sigma) "
        "shorter; "
        f"{per_cent}.{weather}"
    )
