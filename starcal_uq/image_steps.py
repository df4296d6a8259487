"""The steps of a run that starts from images: centroids, identification, bootstrapping."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.apparent import julian_year, make_apparent
from starcal_uq.runfolder import RunFolder, atomic_path

if TYPE_CHECKING:
    from starcal_uq.bootstrapping import Bootstrap
    from starcal_uq.camera import Camera
    from starcal_uq.centroids import Centroids
    from starcal_uq.observations import Observations
    from starcal_uq.progress import Progress

CENTROIDS, IDENTIFICATION = "centroids.parquet", "identification.csv"
# Where the embedded catalogue has its stars; images without a time are compared with these.
_CATALOGUE_EPOCH = 2016.0


def are_images(paths: Sequence[Path]) -> bool:
    """Whether paths name images or folders of them, rather than one table of observations."""
    from starcal_uq.image_files import IMAGE_ENDINGS

    def is_image(path: Path) -> bool:
        name = path.name.lower()
        return name.endswith(IMAGE_ENDINGS) or (path.is_dir() and not name.endswith((".csv", ".ecsv", ".parquet")))

    return any(is_image(path) for path in paths)


def epoch_of(centroids: Centroids) -> float:
    """Julian year of the images, or that of the embedded catalogue where no image has a time."""
    times = centroids.time_utc[centroids.time_utc != ""]
    return julian_year(times) if len(times) else _CATALOGUE_EPOCH


def counted(messages: Sequence[str]) -> list[str]:
    """Messages about many images, each sentence once with the number of images it stands for."""
    sentences = Counter(message.partition(": ")[2] or message for message in messages)
    first = {message.partition(": ")[2] or message: message for message in reversed(messages)}
    return [first[sentence] if count == 1 else f"{count} images: {sentence}" for sentence, count in sentences.items()]


def observations_from_images(
    images: Sequence[Path],
    camera: Camera,
    *,
    max_mag: float,
    epoch: float | None = None,
    gain_e_per_count: float | None = None,
    directions: str | None = None,
    progress: Progress | None = None,
) -> tuple[Observations, Centroids, Bootstrap]:
    """Find, identify and calibrate with the nominal camera, then identify again with what was learnt.

    Parameters
    ----------
    images : sequence of Path
        Image files or folders of them.
    camera : Camera
        The nominal camera.
    max_mag : float
        Magnitude limit of the embedded catalogue, Gaia G.
    epoch : float, optional
        Julian year of the star positions; that of the images by default (`epoch_of`).
    gain_e_per_count : float, optional
        Where the files do not say it.
    directions : {"apparent", "undeclared", "catalogue"}, optional
        By default annual aberration is applied where every image has a time, and nothing is declared where not.
        ``apparent`` takes the catalogue's directions for what the camera saw, as in rendered images.
    progress : callable, optional
        Called with (images done, images in all).

    Raises
    ------
    ImageError, IdentificationError, CalibrationError
        When nothing can be made of the images.
    """
    from starcal_uq.bootstrapping import bootstrap
    from starcal_uq.catalogue import load_catalogue
    from starcal_uq.centroiding import extract_centroids
    from starcal_uq.double_stars import without_disturbed

    centroids = extract_centroids(list(images), camera=camera, gain_e_per_count=gain_e_per_count, progress=progress)
    stars = load_catalogue(max_mag=max_mag, epoch=epoch_of(centroids) if epoch is None else epoch)

    width = centroids.psf_sigma_px[np.isfinite(centroids.psf_sigma_px)]
    psf_sigma_px = float(np.median(width)) if len(width) else 1.0

    def prepare(obs: Observations) -> Observations:
        obs = without_disturbed(obs, stars, camera, psf_sigma_px)
        timed = obs.time_utc is not None and bool((obs.time_utc != "").all())
        if directions == "catalogue" or (directions is None and timed):
            return make_apparent(obs.with_meta(directions="catalogue"))
        return obs.with_meta(directions=directions or "undeclared")

    found = bootstrap(centroids, camera, stars, prepare=prepare)
    return found.observations, centroids, found


def save_image_results(run: RunFolder, centroids: Centroids, found: Bootstrap) -> None:
    """Keep the centroids and the record of every frame in the run folder."""
    centroids.save(run.path / CENTROIDS, force=True)
    with atomic_path(run.path / IDENTIFICATION) as temporary:
        found.identification.to_dataframe().to_csv(temporary, index=False)
