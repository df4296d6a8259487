"""Many rendered frames in a folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import numpy as np
from numpy.typing import ArrayLike

from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import RunFolderError, SensorError
from starcal_uq.core.files import ensure_new
from starcal_uq.core.manifest import alone
from starcal_uq.core.settings import Seed, bounded, seed_of
from starcal_uq.core.types import FloatArray, PathLike, Progress, floats
from starcal_uq.simulation.frames import Tracker, TrackerOptions
from starcal_uq.simulation.rendering import Scene
from starcal_uq.simulation.sensor import Sensor
from starcal_uq.simulation.truth import check_time, write_frame

if TYPE_CHECKING:
    from starcal_uq.sky.catalogue import StarCatalogue

_PATTERN = "frame_*.fits"


@bounded
def render_frames(
    stars: StarCatalogue,
    camera: Camera,
    out_dir: PathLike,
    *,
    n_frames: int = 100,
    sensor: Sensor | None = None,
    seed: Seed = 0,
    attitudes: FloatArray | None = None,
    rates_rad_s: ArrayLike | None = None,
    times_utc: Sequence[str] | None = None,
    force: bool = False,
    progress: Progress | None = None,
    **options: Unpack[TrackerOptions],
) -> list[Path]:
    """Render frames at random attitudes into FITS files ``frame_00000.fits``, ``frame_00001.fits``,
    ...

    The attitudes are those of `simulate` with the same catalogue, camera, `seed`, `min_stars`,
    `max_stars`, `exclusion` and `sigma_px`.

    Parameters
    ----------
    stars : StarCatalogue
        Stars with the directions that the camera sees; all of them shine, and all count for
        `min_stars`.
    camera : Camera
        The truth.
    out_dir : str or path
        Folder, made if it does not exist.
    n_frames : int
        Number of frames.
    sensor : Sensor, optional
        Detector and PSF; ``Sensor()`` by default.
    seed : int or Generator
        Repeats bit for bit. The noise of a frame depends on the seed and the frame number only.
    attitudes : (n, 3, 3) array, optional
        R_cam_icrs at the middle of the exposures, instead of random ones; `n_frames` is then
        ignored.
    rates_rad_s : (3,) or (n, 3) array, optional
        Angular rate of the camera in its own axes, rad/s, of all frames or of each; the sensor's
        by default.
    times_utc : sequence of str, optional
        Middle of each exposure, UTC, ISO 8601; recorded only, the stars are not moved.
    sigma_px, min_stars, max_stars, exclusion
        Noise, stars of a frame and exclusion of the `simulate` to be matched: stars within six times the noise
        of the edge do not count for `min_stars`. They add no noise, and leave out no star.
    force : bool
        Whether existing files may be replaced.
    progress : callable, optional
        Called with (done, total) after every frame.

    Returns
    -------
    list of Path
        The files, in order.

    Raises
    ------
    RunFolderError
        If frames are in the folder already and `force` is false, or would remain among the new
        ones.
    CatalogueError
        When too few attitudes show `min_stars` stars.
    SensorError
        For arguments that do not fit together.
    """
    seed = seed_of(seed)
    given = None if attitudes is None else floats(attitudes).reshape(-1, 3, 3)
    rng = np.random.default_rng(seed)
    rotations, _ = Tracker.of(camera, **options).frames(stars, rng, n_frames, given)
    n = len(rotations)
    scene = Scene(stars, camera, Sensor() if sensor is None else sensor)
    rates = scene.rate_rad_s if rates_rad_s is None else floats(rates_rad_s)
    if rates.shape not in ((3,), (n, 3)):
        raise SensorError(
            f"rendering: the rates have shape {rates.shape}; give (3,) or ({n}, 3) in rad/s."
        )
    times = [None] * n if times_utc is None else [check_time(text) for text in times_utc]
    if len(times) != n:
        raise SensorError(
            f"rendering: there are {len(times)} times for {n} frames; give one for each."
        )
    with alone(out_dir):
        paths = _targets(Path(out_dir), n, force)
        for number, path in enumerate(paths):
            frame = scene.render(
                rotations[number],
                np.random.default_rng([seed, number]),
                rate_rad_s=np.broadcast_to(rates, (n, 3))[number],
                frame=number,
                seed=seed,
                time_utc=times[number],
            )
            write_frame(frame, path, force)
            if progress is not None:
                progress(number + 1, n)
    return paths


def _targets(folder: Path, n: int, force: bool) -> list[Path]:
    """The files to write, in a folder where no other frames would be taken for theirs."""
    paths = [folder / f"frame_{number:05d}.fits" for number in range(n)]
    present = sorted(folder.glob(_PATTERN))
    others = sorted(set(present) - set(paths))
    if others:
        raise RunFolderError(
            f"{others[0]}: the folder holds {len(others)} other frames that would mix with the "
            "new ones; "
            "choose an empty folder or remove them."
        )
    if present:
        ensure_new(present[0], force)
    return paths
