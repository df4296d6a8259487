"""Centroids of the stars in images: background and detection by SExtractor's code (`sep`), then a
fit of each star.

A frame that cannot be used is left out with its reason; the others go on.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.errors import ImageError, MissingExtraError
from starcal_uq.core.formatting import plural
from starcal_uq.core.provenance import NAME
from starcal_uq.core.settings import Bayer, bounded
from starcal_uq.core.store import Kept
from starcal_uq.core.tasks import one_thread, run_tasks
from starcal_uq.core.types import AnyDict, PathLike, Progress
from starcal_uq.images.centroids import COLUMNS, FRAME_COLUMNS, Centroids
from starcal_uq.images.detection import DetectionOptions, FrameStars, find_stars
from starcal_uq.images.image import Image
from starcal_uq.images.optics import common_optics, common_place, optics_of, other_sizes, place_of
from starcal_uq.images.pixel_phase import phase_error, without_phase_error
from starcal_uq.images.read import IMAGE_ENDINGS, read_images

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera

# Images whose Gaussian is wider, sharper cores and all, are sampled well enough.
_UNDERSAMPLED_PX = 0.85
# Fainter stars are more easily found where the light falls into one pixel.
_PHASE_SNR = 10.0

# Starting processes takes as long as measuring this many images; so many are sent to one at once.
_WORTH_PROCESSES, _CHUNK = 100, 16
# Just below the most that glibc keeps.
_KEPT_BYTES = 31 << 20

Source = Image | PathLike


@bounded
@one_thread()
def extract_centroids(
    images: Source | Iterable[Source],
    *,
    camera: Camera | None = None,
    correct_pixel_phase: bool = True,
    bayer: Bayer | None = None,
    workers: int | None = 0,
    progress: Progress | None = None,
    keep: PathLike | None = None,
    **options: Any,
) -> Centroids:
    """Find the stars in images and measure their positions with covariances.

    Parameters
    ----------
    images
        An image, a file, a folder of image files (in the order of their names), or several of them.
        The first frame has the number 0; a file may hold several (see `read_images`). Files of a
        folder that are none are named in `messages`.
    camera
        If given, every image must be the size of its detector.
    correct_pixel_phase
        Centroids of undersampled star images that are no Gaussians are drawn to the centres of the
        pixels. Where the places of many stars show it (4 standard deviations), it is taken out, and
        a message says how much it was. All images are then taken to be of one camera.
    bayer
        Colours of the 2 x 2 pixels in the first corner, row by row, of images whose pixels see one
        colour each; by default what the file says (``BAYERPAT``, raw files), "none" for none. The
        green pixels alone are then measured, each at its place, so that positions are those of the
        whole detector.
    workers
        Processes, with the same results for any number of them; 0 stays in this one. None takes as
        many as there are processors from a hundred images on; fewer are measured before a process
        has started.
    progress
        Called with (files done, files in all).
    keep
        Folder in which the stars of a hundred files and more are kept as they are measured; a later
        call with the same files and options resumes from them (`starcal_uq.core.store.finished`
        removes them).
    **options
        Those of `DetectionOptions`, such as ``threshold_sigma``.

    Returns
    -------
    Centroids
        Brightest star first in each frame. `messages` and `summary` say what was left out and why.

    Raises
    ------
    ImageError
        If an option is out of range, or there is no image at all.
    SamplingError
        If processes cannot be used.
    """
    sources, messages = _sources(images)
    detection = DetectionOptions(**options)
    task = _Measure(sources, camera, detection, bayer)
    kept = None
    many = len(sources) >= _WORTH_PROCESSES
    if keep is not None and many:
        kept = Kept(
            keep, ["centroids", _files(sources), camera, detection, bayer], (_Frame, FrameStars)
        )
    table = _Table(messages=messages)
    frames, _ = run_tasks(
        task,
        len(sources),
        caller="starcal_uq.images.extract_centroids",
        chunk=_CHUNK,
        workers=workers if many or workers is not None else 0,
        progress=progress,
        kept=kept,
        whole=True,
    )
    for found in frames:
        table.add(found)
    return table.centroids(detection, correct_pixel_phase)


def _files(sources: Sequence[Source]) -> list[list[str | int]]:
    """What tells images from others: names, sizes and times of files; hashes of arrays."""
    found: list[list[str | int]] = []
    for source in sources:
        if isinstance(source, Image):
            found.append([source.name, hashlib.sha256(source.data.tobytes()).hexdigest()])
            continue
        path = os.path.abspath(source)
        state = os.stat(path) if os.path.exists(path) else None
        found.append([path] if state is None else [path, state.st_size, state.st_mtime_ns])
    return found


@dataclass(frozen=True)
class _Frame:
    """What became of one frame: its entry in the table, messages, hash of its pixels, and its
    stars, if it has any.
    """

    entry: AnyDict
    messages: list[str]
    sha256: bytes = b""
    stars: FrameStars | None = None


@dataclass(frozen=True)
class _Measure:
    """From the number of a file to the stars of its frames."""

    sources: list[Source]
    camera: Camera | None
    options: DetectionOptions
    bayer: Bayer | None = None

    def __call__(self, number: int) -> list[_Frame]:
        # glibc gives memory back to the system when arrays the size of an image are freed, and gets
        # it again page by page, until a larger one has been freed. This one is never written to.
        np.empty(_KEPT_BYTES, dtype=np.uint8)
        source = self.sources[number]
        if isinstance(source, Image):
            return [self._measured(source, source.name or f"image {number}")]
        try:
            images = read_images(source, self.camera)
        except (ImageError, MissingExtraError) as error:
            return [_left_out(error, Path(source).name, source)]
        return [self._measured(image, image.name) for image in images]

    def _measured(self, image: Image, name: str) -> _Frame:
        sha256: Any = hashlib.sha256(f"{image.data.dtype}{image.data.shape}".encode())
        sha256.update(np.ascontiguousarray(image.data))
        try:
            image = image.as_mosaic(self.bayer)
            if self.camera is not None:
                image.check_size(self.camera)
            found = find_stars(image, self.options)
        except (ImageError, MissingExtraError) as error:
            return _left_out(error, name, None, image.time_utc or "", sha256.digest())
        entry = _entry(name, image.time_utc or "")
        entry.update(
            background=found.background, noise=found.noise, psf_sigma_px=found.psf_sigma_px
        )
        entry["rendered"] = str(image.header.get("CREATOR", "")).startswith(NAME)
        entry["optics"] = optics_of(image.header, image.width_px, image.height_px)
        entry["place"] = place_of(image.header)
        messages = [*image.messages, *(f"{name}: {text}" for text in found.messages)]
        return _Frame(entry, messages, sha256.digest(), found)


def _entry(name: str, time_utc: str = "", problem: str = "") -> AnyDict:
    return {
        "image": name,
        "time_utc": time_utc,
        "background": np.nan,
        "noise": np.nan,
        "psf_sigma_px": np.nan,
        "problem": problem,
    }


def _left_out(
    error: ImageError | MissingExtraError,
    name: str,
    source: Any,
    time_utc: str = "",
    sha256: bytes | None = None,
) -> _Frame:
    """The entry of an image that cannot be used, with its reason."""
    text = str(error)
    message = f"was left out: {text}"
    # Reasons are counted over frames, so the name of this one is taken off.
    for prefix in (f"{source}: ", f"{name}: ", "image: "):
        text = text.removeprefix(prefix)
    entry = _entry(name, time_utc, text.partition(";")[0].rstrip("."))
    return _Frame(entry, [message], hashlib.sha256().digest() if sha256 is None else sha256)


@dataclass
class _Table:
    """The table while it grows, frame by frame."""

    frames: list[AnyDict] = field(default_factory=list)
    stars: list[FrameStars] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    messages: list[str] = field(default_factory=list)
    gains: list[float | None] = field(default_factory=list)
    digest: Any = field(default_factory=hashlib.sha256)

    def add(self, frames: list[_Frame]) -> None:
        for frame in frames:
            number = len(self.frames)
            self.frames.append({"frame_ids": number, **frame.entry})
            self.digest.update(frame.sha256)
            if frame.stars is None:
                self.messages += [f"Frame {number} {text}" for text in frame.messages]
                continue
            self.messages += frame.messages
            self.stars.append(frame.stars)
            self.numbers += [number] * len(frame.stars)
            self.gains.append(frame.stars.gain_e_per_count)

    def centroids(self, options: DetectionOptions, correct_pixel_phase: bool) -> Centroids:
        columns: AnyDict = {"frame": np.array(self.numbers, dtype=np.int64)}
        for name, (kind, _) in COLUMNS.items():
            if name != "frame":
                parts = [stars.columns[name] for stars in self.stars]
                columns[name] = np.concatenate(parts) if parts else np.zeros(0, dtype=kind)
        amplitudes = self._correct_pixel_phase(columns) if correct_pixel_phase else (0.0, 0.0)
        known = [gain for gain in self.gains if gain is not None]
        all_known = bool(known) and len(known) == len(self.gains)
        if known and not all_known:
            # One unit for the whole table: counts are what every frame has.
            self.messages.append(
                "The gain is known for some frames only; give one for all to get comparable fluxes."
            )
        gains = (stars.measured_gain_e_per_count for stars in self.stars)
        measured = [gain for gain in gains if gain is not None]
        from_noise = float(np.median(measured)) if measured else None
        sizes = list(map(len, self.stars))
        if measured:
            self.messages.append(
                f"The gain is not given; the noise of the background says {from_noise:.3g} electrons "
                f"per count in {plural(len(measured), 'frame')}, which was taken for the photon "
                "noise of the stars."
            )
        n_without = len(self.gains) - len(known) - len(measured)
        if n_without:
            self.messages.append(
                "The gain is unknown for "
                f"{plural(n_without, 'frame')}, so the photon noise of the stars is not in their "
                "sigma, which is too small for bright stars; give the gain in electrons per count."
            )
        said = {entry["frame_ids"]: entry["optics"] for entry in self.frames if "optics" in entry}
        optics = common_optics(list(said.values()))
        meta = {
            "settings": asdict(options),
            "gain_e_per_count": known[0] if all_known and len(set(known)) == 1 else None,
            "gain_from_noise_e_per_count": from_noise,
            "flux_unit": "electrons" if all_known else "counts",
            "pixel_phase_px": list(amplitudes),
            "images_sha256": self.digest.hexdigest(),
            # Whether all come from `render_frames`, whose stars shine through no air.
            "rendered": all(frame.get("rendered", bool(frame["problem"])) for frame in self.frames),
            "optics": optics,
            "other_sizes": other_sizes(said, optics),
            "place": common_place([entry.get("place", {}) for entry in self.frames]),
        }
        if known and not all_known:
            columns["flux"] = columns["flux"] / np.repeat([g or 1.0 for g in self.gains], sizes)
        frames: AnyDict = {name: [entry[name] for entry in self.frames] for name in FRAME_COLUMNS}
        return Centroids(**columns, **frames, messages=tuple(self.messages), meta=meta)

    def _correct_pixel_phase(self, columns: AnyDict) -> tuple[float, float]:
        """Take errors by pixel phase out of `columns`, and give their amplitudes in x and y,
        pixels.
        """
        sharp = [stars.windowed and stars.psf_sigma_px < _UNDERSAMPLED_PX for stars in self.stars]
        rows = np.repeat(np.array(sharp, dtype=np.bool_), list(map(len, self.stars)))
        clear = (
            rows
            & (columns["snr"] > _PHASE_SNR)
            & ~(columns["blended"] | columns["saturated"] | columns["edge"])
        )
        x, y = columns["x_px"].copy(), columns["y_px"].copy()
        found = phase_error(x[clear], y[clear]), phase_error(y[clear], x[clear])
        moved = []
        for name, place, error in zip("xy", (x, y), found, strict=True):
            if error.amplitude_px:
                variance = columns[f"var_{name}_px2"]
                true, factor = without_phase_error(place[rows], variance[rows], error.amplitude_px)
                columns[f"{name}_px"][rows] = true
                variance[rows] *= factor**2
                columns["cov_xy_px2"][rows] *= factor
                moved.append(f"{error.amplitude_px:.3f} \u00b1 {error.sigma_px:.3f} px in {name}")
        if moved:
            self.messages.append(
                f"Centroids crowd at the centres of the pixels in {plural(sum(sharp), 'frame')}, "
                "because the star "
                f"images are too sharp for the pixels; errors of up to {' and '.join(moved)} "
                "were taken out."
            )
        return found[0].amplitude_px, found[1].amplitude_px


# So many names of files that are not read are listed.
_MOST_NAMES = 20


def _sources(images: Source | Iterable[Source]) -> tuple[list[Source], list[str]]:
    """Images and files, and what is to be said of those in folders that are not among them."""
    given = [images] if isinstance(images, Image | str | os.PathLike) else list(images)
    sources: list[Source] = []
    messages: list[str] = []
    for source in given:
        if isinstance(source, Image) or not os.path.isdir(source):
            sources.append(source)
            continue
        inside = sorted(Path(source).iterdir())
        folders = [path for path in inside if path.is_dir()]
        files = [p for p in inside if p.name.lower().endswith(IMAGE_ENDINGS) and p not in folders]
        if not files:
            raise ImageError(
                f"{source}: the folder holds no image ({', '.join(IMAGE_ENDINGS)}); name the "
                "folder that does, as "
                "subfolders are not searched."
            )
        sources += files
        others = [path for path in inside if path not in files and path not in folders]
        for reason, paths in (
            ("subfolders are not searched", folders),
            ("the ending is of no image that is read", others),
        ):
            if names := [path.name for path in paths if not path.name.startswith(".")]:
                more = [f"and {len(names) - _MOST_NAMES} more"] if len(names) > _MOST_NAMES else []
                listed = ", ".join([*names[:_MOST_NAMES], *more])
                messages.append(f"{source}: not read, because {reason}: {listed}.")
    if not sources:
        raise ImageError("images: there is none; give files, a folder or Image objects.")
    return sources, messages
