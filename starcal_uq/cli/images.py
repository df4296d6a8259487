"""Commands from images to observations: centroid, identify."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import starcal_uq as sc
from starcal_uq.cli.answers import Answer
from starcal_uq.cli.console import (
    note,
    print_table,
    progress_bar,
    say,
    tell,
    warn_undeclared,
    working,
)
from starcal_uq.cli.options import check_same_sensor
from starcal_uq.cli.settings import (
    DetectionSettings,
    IdentificationSettings,
    PlaceSettings,
)
from starcal_uq.core import settings
from starcal_uq.core.files import UNFINISHED, ensure_new, table_ending
from starcal_uq.core.formatting import plural

if TYPE_CHECKING:
    from starcal_uq.images.centroids import Centroids
    from starcal_uq.observations.table import Observations
    from starcal_uq.pipeline.refine import ImageCalibration
    from starcal_uq.runs.whole import Watch


def centroid_command(
    images: list[Path],
    out: Path,
    detection: DetectionSettings,
    camera: Path | None = None,
    time: str | None = None,
    bayer: settings.Bayer | None = None,
    workers: int | None = None,
    force: bool = False,
) -> Answer:
    """Find the stars in images, with a covariance for each; a frame that cannot be used is named
    and left out.

    An interrupted command over a hundred images or more resumes.
    """
    from starcal_uq.core.times import utc_text
    from starcal_uq.pipeline.images import counted, with_time

    table_ending(out)
    ensure_new(out, force)
    if time is not None:
        time = utc_text(time)
    sensor = None if camera is None else sc.Camera.load(camera)
    keep = out.with_name(f".{out.name}{UNFINISHED}")
    with progress_bar("images") as progress:
        found = sc.images.extract_centroids(
            images,
            camera=sensor,
            **vars(detection),
            bayer=bayer,
            workers=workers,
            progress=progress,
            keep=keep,
        )
    found = with_time(found, time)
    found.save(out, force=force)
    shutil.rmtree(keep, ignore_errors=True)
    for message in counted(found.messages):
        note(message)
    say(f"{found.text} Table: {out}")
    results = {"table": out, "frames": found.frames_dataframe(), "text": found.text}
    return Answer(results, int(found.n_left_out == found.n_frames))


def identify_command(
    centroids: Path,
    out: Path,
    camera: Path | None = None,
    max_mag: float | None = None,
    epoch: float | None = None,
    calibration: Path | None = None,
    *,
    identification: IdentificationSettings,
    place: PlaceSettings,
    force: bool = False,
) -> Answer:
    """Identify the stars of every frame without knowing where the camera pointed; frames that do
    not fit are named.

    The stars are identified with the nominal camera and again with what they tell of it, as `run`
    does.
    """
    from starcal_uq.observations.files import WRITTEN
    from starcal_uq.pipeline.images import observations_from_centroids, of_one_size
    from starcal_uq.presentation.words.images import MOST_FRAMES
    from starcal_uq.presentation.words.sentences import rows

    table_ending(out, WRITTEN)
    ensure_new(out, force)
    sheet = out.with_suffix(".toml")
    table = sc.images.Centroids.load(centroids)
    nominal = None if camera is None else sc.Camera.load(camera)
    if nominal is None:
        table = of_one_size(table)
        ensure_new(sheet, force)
    known = None if calibration is None else sc.Run(calibration).best
    if calibration is not None and known is not None and nominal is not None and camera is not None:
        check_same_sensor(known.camera, calibration, nominal, camera)
    _say_epoch(table, epoch)
    with progress_bar("frames") as progress:
        obs, found, images = observations_from_centroids(
            table,
            nominal,
            place=tuple(place.options().values()),
            epoch=epoch,
            search={
                **vars(identification),
                "max_mag": max_mag,
                "calibration": known,
                "progress": progress,
            },
            lenient=True,
            tell=tell,
        )
    if obs is not None:
        _say_disturbed(obs)
        best = images.calibration if images is not None else known
        obs.save(out, force=force, camera=found.nominal if best is None else best.camera)
        if images is None and known is None:
            note(
                "the stars do not determine the camera, so they were identified once: give more "
                "frames."
            )
        kind = obs.origin.directions
        if out.suffix == ".csv" and obs.directions_declared:
            note(
                f"{out} does not say that its directions are {kind}: calibrate it with "
                f"--directions {kind}."
            )
        start = found.nominal if images is None else images.rounds[0][0].nominal
        if start is not nominal and known is None:
            start.save(sheet, force=force)
            note(f"the camera to calibrate these stars with is {sheet}.")
    if len(found.frames) <= MOST_FRAMES:
        print_table(rows("identification", found))
    several = out.suffix == ".corr" and obs is not None and obs.n_frames > 1
    written = None if obs is None else out.with_name(f"{out.stem}_*.corr") if several else out
    say(f"{found.text}{'' if written is None else f' Table: {written}'}")
    return Answer(
        {"table": written, "frames": found.frames, "text": found.text}, int(not found.n_identified)
    )


def inspect_command(
    run: Path,
    frames: list[str] | None = None,
    out: Path | None = None,
    most: int = 24,
    images: list[Path] | None = None,
    force: bool = False,
) -> Answer:
    """Look at the frames of a run: their stars identified, rejected, expected and missed, and what
    to do next.
    """

    if out is not None:
        ensure_new(out, force)
    held = sc.Run(run, tell=note)
    chosen = held.inspect(*(frames or ()), most=most, images=images)
    page = held.keep_frames(chosen, force=force) if out is None else sc.report(chosen, out)
    for frame in chosen if frames else ():
        say(frame.text)
    say(f"{chosen.text} Page: {page}")
    return Answer({"run": run, "page": page, "frames": chosen.to_dataframe(), "text": chosen.text})


def watching(epoch: float | None = None) -> Watch:
    """What a terminal shows while a run is made, of images whose stars are of an `epoch`, if one is
    stated.
    """
    from starcal_uq.runs.whole import Watch

    def identified(centroids: Centroids, found: ImageCalibration, obs: Observations) -> None:
        _say_epoch(centroids, epoch)
        for words in (found.identification.text, found.text):
            tell(words)
        _say_disturbed(obs)

    return Watch(tell, working, identified, warn_undeclared)


def _say_epoch(centroids: Centroids, epoch: float | None) -> None:
    if epoch is None and not (centroids.time_utc != "").any():
        note(
            "the images have no time: the stars are taken where they were in 2016; --epoch says "
            "when it was."
        )


def _say_disturbed(obs: Observations) -> None:
    if left_out := obs.origin.disturbed_stars:
        tell(
            f"{plural(left_out, 'star')} left out, because the light of a neighbour displaces them."
        )
