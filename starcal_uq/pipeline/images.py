"""The steps of a run that starts from images: centroids, identification, bootstrapping."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.calibration.noise_floor import settle_noise
from starcal_uq.core.errors import CalibrationError, IdentificationError, ObservationError
from starcal_uq.core.findings import clause
from starcal_uq.core.formatting import plural
from starcal_uq.core.settings import Bayer, bounded
from starcal_uq.core.times import TIMES_IN_NAMES, julian_year, utc_text
from starcal_uq.core.types import AnyDict
from starcal_uq.observations.matches import is_fits_table
from starcal_uq.sky.apparent import catalogue_directions, make_apparent, without_low_stars
from starcal_uq.sky.site import check_sky

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.core.types import FloatArray, Progress, StrArray
    from starcal_uq.identification.result import Identification
    from starcal_uq.images.centroids import Centroids
    from starcal_uq.observations.table import Observations
    from starcal_uq.pipeline.refine import ImageCalibration
    from starcal_uq.sky.site import Site

CENTROIDS, IDENTIFICATION, MATCHED = "centroids.parquet", "identification.csv", "matched.parquet"
# Where the embedded catalogue has its stars; images without a time are compared with these.
_CATALOGUE_EPOCH = 2016.0
# What a terminal shows while images are identified.
Told = Enum("Told", "SITE DEPTH")
_NUMBER = re.compile(r"\d+(?:\.\d+)?")
# Magnitudes; the embedded catalogue ends at the second.
FAINTER_NEIGHBOURS, FAINTEST = 1.5, 10.0


def are_images(paths: Sequence[Path]) -> bool:
    """Whether paths name images or folders of them, rather than one table of observations."""
    from starcal_uq.images.read import IMAGE_ENDINGS

    def is_image(path: Path) -> bool:
        name = path.name.lower()
        if name.endswith(".fits") and is_fits_table(path):
            return False
        return name.endswith(IMAGE_ENDINGS) or (
            path.is_dir() and not name.endswith((".csv", ".ecsv", ".parquet"))
        )

    return any(is_image(path) for path in paths)


def epoch_of(centroids: Centroids) -> float:
    """Julian year of the images, or that of the embedded catalogue where no image has a time."""
    times = centroids.time_utc[centroids.time_utc != ""]
    return julian_year(times) if len(times) else _CATALOGUE_EPOCH


def counted(messages: Sequence[str]) -> list[str]:
    """Messages about many images, each sentence once with the number of images it stands for.

    Sentences that differ in their numbers only are one, with the range of each number.
    """
    alike: dict[str, list[str]] = {}
    for message in messages:
        alike.setdefault(_NUMBER.sub("#", message.partition(": ")[2] or message), []).append(
            message
        )
    return [group[0] if len(group) == 1 else _together(group) for group in alike.values()]


def _together(messages: Sequence[str]) -> str:
    sentences = [message.partition(": ")[2] or message for message in messages]
    ranges = []
    for column in zip(*(_NUMBER.findall(sentence) for sentence in sentences), strict=True):
        low, high = min(column, key=float), max(column, key=float)
        ranges.append(low if low == high else f"{low} to {high}")
    pieces = _NUMBER.split(sentences[0])
    words = "".join(piece + number for piece, number in zip(pieces, [*ranges, ""], strict=True))
    return f"{len(messages)} images: {words}"


@bounded
def observations_from_images(
    images: Sequence[Path],
    camera: Camera | None,
    *,
    max_mag: float | None = None,
    focal_tolerance: float = 0.03,
    epoch: float | None = None,
    gain_e_per_count: float | None = None,
    directions: str | None = None,
    site: Site | None = None,
    in_space: bool = False,
    time_utc: str | None = None,
    bayer: Bayer | None = None,
    engine: str = "pyramid",
    model: str | None = None,
    workers: int | None = 0,
    tell: Callable[[str], None] | None = None,
    seen: Callable[[Centroids, Identification | None], None] | None = None,
    progress: Progress | None = None,
    keep: Path | None = None,
) -> tuple[Observations, Centroids, ImageCalibration]:
    """Find, identify and calibrate with the nominal camera, then identify again with what was
    learnt.

    Parameters
    ----------
    images : sequence of Path
        Image files or folders of them.
    camera : Camera or None
        The nominal camera. Without one, it is what the images say of it, and the focal length is
        found from the stars.
    max_mag : float, optional
        Magnitude limit of the embedded catalogue, Gaia G; chosen by default (`depth_for`).
    focal_tolerance : float
        Relative error of the focal length that is looked for first.
    epoch : float, optional
        Julian year of the star positions; that of the images by default (`epoch_of`).
    gain_e_per_count : float, optional
        Electrons per count, where the files do not say it.
    directions : {"apparent", "undeclared", "catalogue"}, optional
        By default annual aberration is applied where every image has a time, and nothing is
        declared where not. ``apparent`` takes the catalogue's directions for what the camera saw,
        as in rendered images.
    site : Site, optional
        Where on the ground the camera stood: diurnal aberration and refraction are applied too, and
        stars lower than ten degrees left out.
    in_space : bool
        Whether the camera was above the air, so that nothing need be said of refraction.
    time_utc : str, optional
        Middle of the exposure of all images whose files do not say it; it goes before a time in a
        file's name.
    bayer : {"RGGB", "BGGR", "GRBG", "GBRG", "none"}, optional
        Mosaic of colours of the images, as in `extract_centroids`.
    engine : str
        Solver that finds attitudes.
    model : str, optional
        Distortion model that the stars will be calibrated with, as in `identify_and_calibrate`.
    workers : int, optional
        Processes that measure the images, as in `extract_centroids`.
    tell : callable, optional
        Gets what a user should know of the images, one sentence each, before anything is made of
        them.
    seen : callable, optional
        Gets the centroids when they are measured, and once more with the first identification: what
        is there to be looked at if an error follows.
    progress : callable, optional
        Called with (images done, images in all).
    keep : path, optional
        Folder in which stars are kept as they are measured, as in `extract_centroids`.

    Raises
    ------
    ImageError, IdentificationError, CalibrationError
        When nothing can be made of the images.
    ObservationError
        When a site is given and an image has no time, or shows stars that were below the horizon
        there.
    CatalogueError
        When the time is not readable.
    """
    from starcal_uq.images.extract import extract_centroids

    check_sky(directions, site, in_space)
    if time_utc is not None:
        time_utc = utc_text(time_utc)
    centroids = extract_centroids(
        list(images),
        camera=camera,
        gain_e_per_count=gain_e_per_count,
        bayer=bayer,
        workers=workers,
        progress=progress,
        keep=keep,
    )
    centroids = with_time(centroids, time_utc)
    if camera is None:
        centroids = of_one_size(centroids)
    if seen is not None:
        seen(centroids, None)
    if centroids.n_left_out == centroids.n_frames and centroids.messages:
        raise IdentificationError(f"no image can be used: {counted(centroids.messages)[0]}")
    if tell is not None:
        for message in counted(centroids.messages):
            tell(f"note: {message}")
        tell(centroids.text)
    asked = centroids

    def noted(of_camera: Centroids, identification: Identification) -> None:
        nonlocal centroids
        centroids = of_camera
        if seen is not None:
            seen(of_camera, identification)

    obs, identification, found = observations_from_centroids(
        asked,
        camera,
        place=(directions, site, in_space),
        epoch=epoch,
        search={"max_mag": max_mag, "engine": engine, "focal_tolerance": focal_tolerance},
        model=model,
        tell=tell,
        seen=noted,
    )
    if obs is None or found is None:
        raise IdentificationError(f"no frame is identified: {identification.text}")
    return obs, centroids, found


def observations_from_centroids(
    centroids: Centroids,
    camera: Camera | None,
    *,
    place: tuple[str | None, Site | None, bool] = (None, None, False),
    epoch: float | None = None,
    search: AnyDict | None = None,
    model: str | None = None,
    lenient: bool = False,
    tell: Callable[[str], None] | None = None,
    seen: Callable[[Centroids, Identification], None] | None = None,
) -> tuple[Observations | None, Identification, ImageCalibration | None]:
    """What `observations_from_images` does with the centroids of its images.

    `place` is directions, site and whether in space; `search` has the options of
    `identify_to_depth`. With a calibration among them the stars are identified once. If `lenient`,
    stars that do not determine the camera are taken as they were identified first, and none is no
    error. The last identification is returned; the observations are None where no star was
    identified, the calibration where they were identified once.
    """
    from starcal_uq.pipeline.cameras import of_one_camera
    from starcal_uq.pipeline.depth import identify_to_depth, stars_in_field
    from starcal_uq.pipeline.refine import identify_and_calibrate
    from starcal_uq.sky.catalogue import load_catalogue
    from starcal_uq.sky.neighbours import without_disturbed

    directions, site, in_space = place
    check_sky(directions, site, in_space)
    stated = None
    if site is not None:
        _check_times(centroids)
    elif directions in (None, "catalogue") and not in_space:
        stated = stated_site(centroids)
    year = epoch_of(centroids) if epoch is None else epoch
    options = dict(search or {})
    max_mag, known = options.pop("max_mag", None), options.pop("calibration", None)
    progress = options.pop("progress", None)
    stars, first = identify_to_depth(
        centroids, camera, year, max_mag, calibration=known, progress=progress, **options
    )
    if known is None:

        def alone(table: Centroids) -> Identification:
            return identify_to_depth(
                table, None, year, max_mag, engine=options.get("engine", "pyramid")
            )[1]

        kept = of_one_camera(centroids, first, camera, options.get("focal_tolerance", 0.03), alone)
        if kept is not centroids:
            centroids = kept
            stars, first = identify_to_depth(
                centroids, camera, year, max_mag, progress=progress, **options
            )
    if seen is not None:
        seen(centroids, first)
    limit = float(stars.mag.max())
    if tell is not None and max_mag is None:
        n_stars = stars_in_field(first.nominal, limit)
        tell(clause(Told.DEPTH, mag=limit, n_stars=n_stars))
    # A neighbour need not be bright enough to be identified to displace a star.
    neighbours = load_catalogue(
        max_mag=max(limit, min(limit + FAINTER_NEIGHBOURS, FAINTEST)), epoch=year
    )
    motion = directions in (None, "catalogue")
    width = centroids.psf_sigma_px[np.isfinite(centroids.psf_sigma_px)]
    psf_sigma_px = float(np.median(width)) if len(width) else 1.0

    def prepare(obs: Observations) -> Observations:
        nonlocal site, stated
        obs = without_disturbed(obs, neighbours, first.nominal, psf_sigma_px)
        if in_space or centroids.origin.rendered:
            obs = obs.with_origin(observer="space" if in_space else "rendered")
        if not motion or (directions is None and not obs.timed):
            return obs.with_origin(directions=directions or "undeclared")
        obs = obs.with_origin(directions="catalogue")
        if stated is not None:
            # What a header says of the place is believed as long as the stars are above its
            # horizon.
            said, stated = stated, None
            facts: AnyDict = {"site": said, "keys": (centroids.origin.place or {})["keys"]}
            try:
                low = without_low_stars(obs, said)
            except ObservationError as error:
                facts["error"] = error
            else:
                site, facts["n_low"] = said, low.origin.low_stars or 0
            if tell is not None:
                tell(clause(Told.SITE, **facts))
        return make_apparent(obs if site is None else without_low_stars(obs, site), site=site)

    def to_catalogue(apparent: FloatArray, times: StrArray) -> FloatArray:
        return catalogue_directions(apparent, times, site=site)

    if lenient and not first.n_identified:
        return None, first, None
    if known is not None:
        return prepare(first.observations), first, None
    try:
        found = identify_and_calibrate(
            centroids,
            camera,
            stars,
            first=first,
            prepare=prepare,
            to_catalogue=to_catalogue if motion else None,
            # The calibration of the run will ask which frames repeat others.
            method={"duplicates": "keep"},
            model=model,
            identification=options,
        )
    except CalibrationError:
        if lenient:
            return prepare(first.observations), first, None
        raise
    return settle_noise(found.observations, found.calibration), found.identification, found


def stated_site(centroids: Centroids) -> Site | None:
    """The site that the headers of the images state, where all frames with stars have times."""
    from starcal_uq.sky.site import Site

    place = centroids.origin.place
    used = (centroids.problem == "") & (centroids.stars_per_frame > 0)
    if not place or (centroids.time_utc[used] == "").any():
        return None
    return Site(place["latitude_deg"], place["longitude_deg"], place["height_m"])


def with_time(centroids: Centroids, time_utc: str | None) -> Centroids:
    """Centroids with a time (UTC) for all frames whose images do not say it in their header; none
    for None.

    Times from the names of files give way. An offset such as "+02:00" is taken out.
    """
    from starcal_uq.images.read import time_in_name_message

    if time_utc is None:
        return centroids
    time_utc = utc_text(time_utc)
    named = {time_in_name_message(str(name)) for name in centroids.image}
    said = named & set(centroids.messages)
    times = [
        time_utc if time == "" or time_in_name_message(str(name)) in said else str(time)
        for name, time in zip(centroids.image, centroids.time_utc, strict=True)
    ]
    kept = tuple(message for message in centroids.messages if message not in said)
    return replace(centroids, time_utc=np.array(times, dtype=np.str_), messages=kept)


def of_one_size(centroids: Centroids) -> Centroids:
    """The frames of the size that most images have; the others are left out, with their reason."""
    sizes, common = centroids.origin.other_sizes, centroids.origin.optics
    if not sizes or common is None:
        return centroids
    most = f"most are {common['width_px']} x {common['height_px']} px"
    problem = [
        f"the image is {sizes[str(k)][0]} x {sizes[str(k)][1]} px and {most}"
        if str(k) in sizes and not why
        else why
        for k, why in zip(centroids.frame_ids.tolist(), centroids.problem.tolist(), strict=True)
    ]
    odd = [int(k) for k in sizes]
    kept = centroids.select(~np.isin(centroids.frame, odd))
    names = centroids.image[np.isin(centroids.frame_ids, odd)]
    said = [
        f"{n}: the image was left out, because it is not of the size of most; run it by itself."
        for n in names
    ]
    return replace(kept, problem=np.array(problem, dtype=np.str_), messages=(*kept.messages, *said))


def _check_times(centroids: Centroids) -> None:
    used = (centroids.problem == "") & (centroids.stars_per_frame > 0)
    untimed = centroids.image[used & (centroids.time_utc == "")]
    if len(untimed):
        others = f" (and {plural(len(untimed) - 1, 'other')})" if len(untimed) > 1 else ""
        raise ObservationError(
            f"{untimed[0]}{others}: the image has no time, without which the site does not say "
            "where the stars stood; "
            f"give the time (--time, UTC, such as 2026-11-21T03:04:05), or {TIMES_IN_NAMES}.",
            column="time_utc",
        )
