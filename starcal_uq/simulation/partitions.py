"""Simulated observations of any size: a folder of partitions, each of them made by itself."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.core.cluster import ClusterOptions, Scheduler, cluster
from starcal_uq.core.errors import ObservationError, RunFolderError, SettingError
from starcal_uq.core.files import UNFINISHED, new_folder
from starcal_uq.core.manifest import alone, making, read_manifest
from starcal_uq.core.settings import Seed, bounded, seed_of
from starcal_uq.core.types import AnyDict, PathLike, Progress
from starcal_uq.observations.files import parquet_summary
from starcal_uq.observations.partitions import PartitionedObservations, open_partitions
from starcal_uq.simulation.frames import Tracker, TrackerOptions, simulated_meta
from starcal_uq.simulation.noise import one_noise

if TYPE_CHECKING:
    from starcal_uq.sky.catalogue import StarCatalogue

# Of 17 stars each: a file of 4 MB, and half a gigabyte while it is linearised.
PARTITION_FRAMES = 10_000
_FRAMES_WORTH_PROCESSES = 100_000
_NAME = "part-{:06d}.parquet"


class PartitionOptions(TrackerOptions, ClusterOptions, total=False):
    """What takes the frames, and where the files are made."""


@bounded
def simulate_partitions(
    stars: StarCatalogue,
    camera: Camera,
    folder: PathLike,
    *,
    n_frames: int,
    partition_frames: int = PARTITION_FRAMES,
    seed: Seed = 0,
    force: bool = False,
    **options: Unpack[PartitionOptions],
) -> PartitionedObservations:
    """Simulate identified stars, as `simulate` does, into a folder of Parquet files.

    A file depends on the seed and its number alone. The files take their places when all are made:
    an interrupted call resumes, and until its end the folder holds what it held before. What the
    same call has made stays.

    Parameters
    ----------
    stars, camera
        As for `simulate`.
    folder : path
        Folder, made if it does not exist.
    n_frames : int
        Number of frames in all.
    partition_frames : int
        Frames of one file.
    seed : int or Generator
        Seed; each file is drawn from it and its number.
    force : bool
        Whether to replace what another call has made there.

    Returns
    -------
    PartitionedObservations
        The folder.

    Raises
    ------
    RunFolderError
        If the folder holds other files.
    CatalogueError, DistortionError
        As for `simulate`.

    Other Parameters
    ----------------
    min_stars, sigma_px, max_stars, exclusion
        As for `simulate`, with the same defaults.
    scheduler : str or distributed.Client, optional
        Dask scheduler whose workers make the files; processes of this machine otherwise.
    workers : int, optional
        Number of these processes: as many as processors by default; 0 stays in this one.
    progress : callable, optional
        Called with (files done, files).
    """
    seed = seed_of(seed)
    tracker, run = _taker(camera, **options)
    least = tracker.min_stars
    if least < 3:
        raise SettingError(f"min_stars is {least}: a frame needs at least 3 stars.")
    folder = Path(folder).resolve()
    known = {
        "min_stars": least,
        "stars": stars.source,
        "n_stars": len(stars),
        "epoch": stars.epoch,
    }
    if tracker.max_stars is not None:
        known["max_stars"] = tracker.max_stars
    if tracker.exclusion is not None:
        known["exclusion"] = repr(tracker.exclusion)
    if one_noise(tracker.noise) is None:
        known["noise"] = repr(tracker.noise)
    meta = simulated_meta(camera, tracker.noise, seed) | known
    unfinished = folder / UNFINISHED
    make = _Maker(stars, tracker, unfinished, n_frames, partition_frames, seed, meta)
    names = [_NAME.format(number) for number in range(-(-n_frames // partition_frames))]
    with alone(folder):
        others = _others(folder, names)
        if (
            not force
            and not others
            and all(make.is_made(folder, number) for number in range(len(names)))
        ):
            return open_partitions(folder)
        with making(folder, "simulate", names[0], force=force) as stage:
            if others:
                raise RunFolderError(
                    f"{others[0]}: the folder holds {len(others)} other files that would mix "
                    "with the new ones; choose "
                    "an empty folder or remove them."
                )
            new_folder(unfinished)
            missing = [
                number for number in range(len(names)) if not make.is_made(unfinished, number)
            ]
            _make_all(make, missing, **run)
            for name in names:
                os.replace(unfinished / name, stage / name)
    return open_partitions(folder)


def _taker(
    camera: Camera,
    *,
    scheduler: Scheduler = None,
    workers: int | None = None,
    progress: Progress | None = None,
    **options: Unpack[TrackerOptions],
) -> tuple[Tracker, ClusterOptions]:
    """What takes the frames, and where the files are made."""
    run: ClusterOptions = {"scheduler": scheduler, "workers": workers, "progress": progress}
    return Tracker.of(camera, **options), run


@dataclass(frozen=True)
class _Maker:
    """Makes the file of a number."""

    stars: StarCatalogue
    tracker: Tracker
    folder: Path
    n_frames: int
    partition_frames: int
    seed: int
    meta: AnyDict

    def _meta(self, number: int) -> AnyDict:
        first = number * self.partition_frames
        return {
            **self.meta,
            "first_frame": first,
            "n_frames": min(self.partition_frames, self.n_frames - first),
        }

    def is_made(self, folder: Path, number: int) -> bool:
        """Whether a folder holds the file as this would make it."""
        try:
            return parquet_summary(folder / _NAME.format(number), "frame").meta == self._meta(
                number
            )
        except ObservationError:
            return False

    def __call__(self, number: int) -> None:
        meta = self._meta(number)
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(number,)))
        obs = self.tracker.observe(self.stars, rng, meta["n_frames"], meta)
        obs = replace(obs, frame=obs.frame + meta["first_frame"])
        obs.save(self.folder / _NAME.format(number), force=True)


def _make_all(
    make: _Maker,
    numbers: list[int],
    *,
    scheduler: Scheduler = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> None:
    few = len(numbers) * make.partition_frames < _FRAMES_WORTH_PROCESSES
    if few and workers is None and scheduler is None:
        # Starting processes takes as long as making a few files.
        workers = 0
    with cluster(scheduler, workers=workers, caller="simulate_partitions") as processes:
        processes.map(make, numbers, progress=progress)


def _others(folder: Path, names: list[str]) -> list[Path]:
    """Files in a folder that would be read with those of these names, and that no call before has
    made.
    """
    record = read_manifest(folder)
    own = {*names, *(record.files if record else ())}
    return sorted(
        path for path in folder.iterdir() if path.suffix == ".parquet" and path.name not in own
    )
