"""Checks of the data, and of what the model leaves over, in words."""

from __future__ import annotations

from collections.abc import Sequence

from starcal_uq.attitude.earth import DENSITY_SPREAD
from starcal_uq.camera.camera import Camera
from starcal_uq.core.findings import Finding
from starcal_uq.core.formatting import fixed, percent, plural, plus_minus, significant
from starcal_uq.core.remedy import RUN, Remedy
from starcal_uq.core.status import Code, Note
from starcal_uq.core.times import TIMES_IN_NAMES
from starcal_uq.diagnostics.verdict.observed import aberration_size
from starcal_uq.likelihood.fitted_effects import FoundAir
from starcal_uq.likelihood.noise_model import NoiseModel
from starcal_uq.presentation.sentences.estimate import effect_sentence
from starcal_uq.presentation.sentences.table import SENTENCES, Told, entry
from starcal_uq.sky.site import Site

_UNITS = {"epoch": "years", "date": "days", "hour": "hours"}
# Notes as they are, with places for their values.
_NOTES = {
    Note.LIKE_REFRACTION: (
        "The residuals hold what refraction would leave if the zenith kept its place in the "
        "camera, and so would axes of different scale, skewed axes or a drift of f: these cannot "
        "be told apart here."
    ),
    Note.WITHOUT_REFRACTION: "Aberration is in the directions, refraction is not.",
    Note.NOISE_IS_THE_MAGNITUDES: "Column sigma_px holds the magnitudes.",
    Note.NOISE_LIKE_MAGNITUDES: (
        "Column sigma_px ({least:.3g} to {most:.3g}) looks like magnitudes."
    ),
}
SENTENCES |= {code: note.format for code, note in _NOTES.items()}


@entry(Code.CATALOGUE_DIRECTIONS)
def _directions(good: bool, declared: str, parts: Sequence[Finding]) -> Told:
    wrong = [value for part in parts if (value := _wrong(part))]
    return "; ".join(wrong) or declared, "apparent", " ".join(part.sentence for part in parts)


def _wrong(part: Finding) -> str:
    """What is wrong with the directions by a finding, in few words; empty where nothing is."""
    if part.code is Note.WITHOUT_REFRACTION:
        return "without refraction"
    if part.code is Note.REFRACTION_IN_THE_RESIDUALS:
        return f"refraction, p = {significant(part.values['p_value'])}"
    if part.code is not Note.WRONG_TIMES:
        return ""
    cause = str(part.values["cause"])
    if cause not in _UNITS:
        return cause
    later = _later(cause, part.values["later"], part.values["later_std"])
    return f"{'epoch' if cause == 'epoch' else 'times'} {later}"


def _later(cause: str, later: float, later_std: float) -> str:
    size = f"{significant(abs(later))} ± {significant(later_std)} {_UNITS[cause]}"
    return f"{size} {'later' if later > 0.0 else 'earlier'}"


@entry(Note.WRONG_TIMES)
def _times(
    cause: str,
    later: float,
    later_std: float,
    moves: str,
    moves_sigma: float,
    east_deg: float = 0.0,
) -> str:
    effect = f"it moves {moves} by {significant(moves_sigma)} sigma"
    if cause == "no aberration":
        return f"The residuals hold annual aberration that the directions do not: {effect}."
    if cause == "aberration twice":
        return f"The directions hold annual aberration twice: {effect}."
    size = _later(cause, later, later_std)
    if cause == "epoch":
        return (
            f"By proper motion the stars are those of an epoch {size} than that of the "
            f"directions: {effect}."
        )
    what, other = "Annual aberration", ""
    if cause == "hour":
        side = "east" if east_deg > 0.0 else "west"
        what, other = (
            "Refraction",
            f", or a site {significant(abs(east_deg))}° further {side}",
        )
    return f"{what} in the residuals is that of times {size} than stated{other}: {effect}."


@entry(Note.REFRACTION_IN_THE_RESIDUALS)
def _air(
    p_value: float,
    f_px: float,
    f_sigma: float,
    place: Site | None,
    place_std_deg: tuple[float, float],
    from_images: bool,
    air: str,
) -> str:
    first = (
        "The residuals hold refraction that the directions do not: f is too short by "
        f"{significant(f_px)} px ({significant(f_sigma)} sigma)."
    )
    if place is None:
        times = f"--time, or {TIMES_IN_NAMES if from_images else 'column time_utc'}"
        return f"{first} The frames have no times: state the site (--site) and the times ({times})."
    ends = " and ".join(f"± {significant(error)}°" for error in place_std_deg)
    asked = {
        "corrected": "Check site, pressure and times",
        "none": "They are declared to hold all there is: check that",
    }.get(air, "State the site (--site)")
    return f"{first} {asked}; the residuals point to {place.words} ({ends})."


@entry(Note.CONDITIONAL_ON_REFRACTION)
def _conditional(zenith_px: float, middle_px: float, f_sigma_px: float) -> str:
    high, middle = (
        f"{significant(size)} px ({significant(size / f_sigma_px)} sigma)"
        for size in (zenith_px, middle_px)
    )
    return (
        "The focal length f is conditional on refraction: if the stars were seen through air, f "
        f"is too short by {high} at the zenith and by {middle} at 45° of altitude."
    )


@entry(Note.REFRACTION_ESTIMATED)
def air_words(found: FoundAir) -> str:
    """The air that was found, where, and what was assumed."""
    distances = f"{fixed(found.least_deg, 0)}° to {fixed(found.most_deg, 0)}°"
    if found.kind == "frames":
        where = (
            f"the frames look {distances} away from zeniths of their own, which are known to "
            f"{significant(found.zenith_std_deg)}°"
        )
    else:
        latitude = plus_minus(found.latitude_deg, found.latitude_std_deg)
        where = f"the frames look {distances} away from the zenith of latitude {latitude}°"
    if found.kind == "place":
        where += f" and longitude {plus_minus(found.longitude_deg, found.longitude_std_deg)}°"
    moment = "that all frames are of one moment, and " if found.kind == "moment" else ""
    return (
        f"Refraction is estimated: {where}, through air of "
        f"{plus_minus(found.density, found.density_std)} times the standard density at sea level. "
        f"Assumed is {moment}air of 1 ± {DENSITY_SPREAD} times that density before any data."
    )


@entry(Note.REFRACTION_CORRECTED)
def _corrected(
    site: Site,
    altitudes_deg: tuple[float, float],
    f_px: float,
    f_sigma: float,
    weather: float,
    weather_matters: bool,
) -> str:
    assumed = " and ".join(site.assumed)
    source = f" ({assumed} of the standard atmosphere)" if assumed else ""
    low, high = (fixed(altitude, 0) for altitude in altitudes_deg)
    sentence = (
        f"Site: {site}. Refraction in air of {fixed(site.air_pressure_hpa, 0)} hPa and "
        f"{fixed(site.air_temperature_c, 0)} °C{source} is in the directions, at altitudes of "
        f"{low}° to {high}°. Without it f would come out {significant(f_px)} px "
        f"({significant(f_sigma)} sigma) shorter; each per cent of the air’s density (10 hPa, "
        f"3 °C) counts {significant(0.01 * f_px)} px."
    )
    if not weather_matters:
        return sentence
    return (
        f"{sentence} The weather may differ from the standard atmosphere by {weather * 100:.0f} "
        "%, which is more than the sigma of f: state pressure and temperature."
    )


@entry(Note.APPARENT_DIRECTIONS)
def _apparent(in_space: bool, site: Site | None) -> str:
    if site is not None:
        return f"Aberration and refraction at the site ({site}) are in the directions."
    if in_space:
        return "Aberration is in the directions; the camera was in space."
    return "The directions are declared as apparent: aberration is in them."


@entry(Note.DIRECTIONS_WITHOUT_ABERRATION)
def _undeclared(declared: bool, timed: bool) -> str:
    if declared:
        return "The directions come straight from a catalogue."
    if not timed:
        return (
            "Neither time nor observer velocity was declared, so it is not known whether "
            "aberration is in the directions."
        )
    return "The table has times, but it was not declared whether aberration is in the directions."


@entry(Note.RESTS_ON_ABERRATION)
def _rests(f_px: float, f_sigma: float, dated: bool) -> str:
    return (
        "The focal length f rests on annual aberration being in the directions, once: left out "
        f"or applied twice, it would move f by {'' if dated else 'up to '}{significant(f_px)} px "
        f"({significant(f_sigma)} sigma), and the residuals of these frames would not show it."
    )


def _size(corners_arcsec: float, f_px: float) -> str:
    return (
        f"changes angles by up to {fixed(corners_arcsec, 1)} arcsec from corner to corner of this "
        f"field and can move f by up to {significant(f_px)} px"
    )


def aberration_words(camera: Camera) -> str:
    """What annual aberration can do to a camera of this field, as the end of a sentence."""
    return _size(**aberration_size(camera))


@entry(Note.ABERRATION)
def _aberration(corners_arcsec: float, f_px: float, f_sigma: float) -> str:
    size = _size(corners_arcsec, f_px)
    return f"Annual aberration {size}, {significant(f_sigma)} times its sigma."


@entry(Code.PATTERN_IN_THE_RESIDUALS)
def _pattern(
    good: bool,
    p_value: float,
    pattern_px: float,
    pattern_arcsec: float,
    n_cells: int,
    p_least: float,
    effect_on: str = "",
    effect_sigma: float = 0.0,
) -> Told:
    if good:
        sentence = f"Mean residuals in {plural(n_cells, 'cell')} of the field are what noise gives."
    else:
        sentence = (
            f"The residuals show a pattern of {significant(pattern_px)} px per axis "
            f"({significant(pattern_arcsec)} arcsec) that the model does not explain; it is not "
            f"in any interval of this report. {effect_sentence(effect_on, effect_sigma)}"
        )
    size = f", pattern {significant(pattern_px)} px" if pattern_px > 0.0 else ""
    return f"p = {significant(p_value)}{size}", f"p ≥ {p_least:g}", sentence


@entry(Code.OUTLIERS)
def _outliers(
    good: bool,
    n_beyond: int,
    largest_sigma: float,
    frame: int,
    beyond_sigma: float,
    expected: float,
) -> Told:
    place = f"largest {fixed(largest_sigma, 1)} sigma, in frame {frame}"
    sentence = (
        f"As many as Gaussian noise gives ({place})."
        if good
        else f"More than Gaussian noise gives ({place}): look for wrong identifications and "
        "disturbed centroids."
    )
    value = f"{plural(n_beyond, 'star')} beyond {beyond_sigma:g} sigma"
    return value, f"about {significant(expected)} expected", sentence


@entry(Note.MODEL_IS_WRONG)
def _model_is_wrong(
    near: int, allowed: int, n_rounds: int, stable: bool, robust: bool, follows_place: bool
) -> str:
    found = [f"the rejections did not settle in {plural(n_rounds, 'round')}"] if not stable else []
    if near > allowed:
        found.append(
            f"{plural(near, 'star')} just beyond the limit were to be rejected, where noise and "
            f"wrong identifications leave {allowed} at most"
        )
    tails = ", with the heavy tails of a Student t" if robust else ""
    remedy = "Fit noise that varies (--effects noise), or another distortion"
    if follows_place:
        remedy = "Their residuals follow the place on the detector: fit another distortion"
    return (
        f"the model is wrong, not the stars: {' and '.join(found)}. They are kept{tails}. "
        f"{remedy} (--model; `{Remedy('diagnose', (RUN,)).words}` compares them)."
    )


@entry(Code.SCREENING)
def _screening(good: bool, rejected: int, of: int, blame: Finding | str) -> Told:
    sentence = blame.sentence if isinstance(blame, Finding) else blame
    sentence = sentence[0].upper() + sentence[1:]
    return f"{plural(rejected, 'star')} of {of} rejected", "wrong stars alone", sentence


@entry(Code.CENTROID_NOISE_PER_AXIS)
def _noise(good: bool, noise_px: float, least_px: float, most_px: float) -> Told:
    if good:
        sentence = "Usual for star centroids."
    elif noise_px > most_px:
        sentence = _MUCH_SCATTER
    else:
        sentence = "Less scatter than centroids have: the data are not measurements."
    return f"{significant(noise_px, 3)} px", f"{least_px:g} to {most_px:g} px", sentence


_MUCH_SCATTER = (
    "Far more scatter than centroids have: identifications, camera file or distortion model may "
    "be wrong."
)


@entry(Code.FACTOR_ON_THE_STATED_NOISE, Code.FACTOR_ON_THE_FITTED_NOISE)
def _factor(
    good: bool,
    noise: float,
    least: float,
    most: float,
    fitted: NoiseModel | None = None,
    unlike: Finding | None = None,
) -> Told:
    if unlike is not None:
        sentence = unlike.sentence
    elif fitted is not None:
        sentence = f"The noise was fitted: {fitted}."
    elif good:
        sentence = "The stated noise of the stars is confirmed."
    elif noise > most:
        sentence = _MUCH_SCATTER
    else:
        sentence = "Less scatter than is stated: the stated noise is too large."
    return significant(noise, 3), f"{least:g} to {most:g}", sentence


@entry(Note.ADDED_NOISE_TOO_LARGE)
def _added(added_px: float) -> str:
    return (
        f"Less scatter than the stars state: the {significant(added_px)} px that were added to "
        "each are too many."
    )


@entry(Note.NOISE_LIKE_ARCSECONDS)
def _arcseconds(arcsec_per_px: float) -> str:
    per = significant(arcsec_per_px, 3)
    return f"Column sigma_px looks like arcseconds, of which a pixel has {per}."


@entry(Code.NOISE_OF_THE_FILES)
def _files(
    good: bool, p_value: float, file: int, n_files: int, times: float, p_least: float
) -> Told:
    place = (
        f"file {file} of {n_files}, by frame number, has {significant(times, 3)} times the "
        "common noise"
    )
    sentence = (
        f"The files scatter as alike as noise of one size lets them ({place})."
        if good
        else f"The files scatter unequally ({place})."
    )
    return f"p = {significant(p_value)}", f"p ≥ {p_least:g}", sentence


@entry(Code.TERMS_OF_THE_DISTORTION)
def _terms(good: bool, p_value: float, model: str, p_least: float) -> Told:
    sentence = (
        f"No richer distortion model fits all stars better than chance lets it ({model!r} comes "
        "nearest)."
        if good
        else f"All stars together ask for the terms of the distortion model {model!r}."
    )
    return f"p = {significant(p_value)}", f"p ≥ {p_least:g}", sentence


@entry(Code.COVERAGE_OF_THE_FIELD)
def _coverage(
    good: bool, share: float, n_frames: int, share_least: float, n_frames_least: int
) -> Told:
    if good:
        sentence = "Stars covered the field, so that no part of it is extrapolated."
    elif share < share_least:
        sentence = "Parts of the field hold no stars: the distortion is extrapolated there."
    else:
        sentence = "Few frames: errors common to a whole frame cannot be told from the camera."
    value = f"{percent(share, 3)} of the field, {plural(n_frames, 'frame')}"
    return value, f"≥ {percent(share_least)}, ≥ {n_frames_least} frames", sentence
