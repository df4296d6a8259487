"""The images of a run: kept with what became of them, and looked at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from starcal_uq.camera.camera import Camera
from starcal_uq.core.files import write_csv
from starcal_uq.core.types import PathLike
from starcal_uq.runs.stored import StoredRun, writing

if TYPE_CHECKING:
    from starcal_uq.identification.result import Identification
    from starcal_uq.images.centroids import Centroids
    from starcal_uq.pipeline.inspection import Frames
    from starcal_uq.pipeline.refine import ImageCalibration


@writing
def keep_images(
    run: StoredRun,
    /,
    centroids: Centroids,
    images: ImageCalibration | Identification | None,
    sources: Sequence[PathLike] = (),
    camera: Camera | None = None,
) -> None:
    """Keep centroids, matches and the record of every image that the run started from, and
    where these are.

    Where nothing is calibrated, `images` is the identification, if there is one, and the
    `camera` is kept too.
    """
    from starcal_uq.pipeline.images import CENTROIDS, IDENTIFICATION, MATCHED
    from starcal_uq.pipeline.record import IMAGES, record_images
    from starcal_uq.pipeline.refine import ImageCalibration

    with run._step("images", None, {}) as files:
        centroids.save(files.path / CENTROIDS)
        record_images(centroids, images, sources).save(files.path / IMAGES)
        if isinstance(images, ImageCalibration):
            identification: Identification | None = images.identification
        else:
            identification = images
        if identification is not None:
            write_csv(identification.to_dataframe(), files.path / IDENTIFICATION)
            if identification.n_identified:
                identification.observations.save(files.path / MATCHED)
        if camera is not None:
            camera.save(files.camera)
    run._forget("images", "frames")


def inspect(
    run: StoredRun, /, *which: int | str, most: int = 24, images: Sequence[PathLike] | None = None
) -> Frames:
    """Frames to be looked at: they show themselves in a notebook, and `starcal_uq.report`
    writes them as a page.

    Parameters
    ----------
    *which : int or str
        Numbers or names of frames; by default those that tell most (`Frames.telling`).
    most : int
        How many these are at most.
    images : sequence of path, optional
        Files or folders in which the images are, where they have moved.

    Raises
    ------
    RunFolderError
        If the run did not start from images.
    ImageError
        If there is no such frame.
    """
    frames = run.frames
    if images is not None:
        frames = replace(frames, images=tuple(map(Path, images)))
    return frames.select(*which, large=True) if which else frames.telling(most)


@writing
def keep_frames(run: StoredRun, /, frames: Frames, *, force: bool = False) -> Path:
    """Write frames as ``RUN/frames.html``, which goes when the run changes.

    Parameters
    ----------
    frames : Frames
        What `inspect` gave.
    force : bool
        Whether to replace the earlier page.
    """
    from starcal_uq.presentation.pages.gallery import write_frames

    run._keep("inspection", force)
    with run._step("inspect", None, {}) as files:
        write_frames(frames, files.inspection)
    return run.folder.inspection
