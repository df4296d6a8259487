"""Centroids of the stars in images: background and detection by SExtractor's code (`sep`), then a fit of each star.

A frame that cannot be used is left out with its reason; the others go on.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.errors import ImageError
from starcal_uq.core.formatting import plural
from starcal_uq.core.settings import bounded
from starcal_uq.core.tasks import Progress, processors, run_tasks
from starcal_uq.core.types import AnyDict
from starcal_uq.images.centroids import COLUMNS, FRAME_COLUMNS, Centroids
from starcal_uq.images.detection import DetectionOptions, FrameStars, find_stars
from starcal_uq.images.image import IMAGE_ENDINGS, Image, read_any_size
from starcal_uq.images.pixel_phase import phase_error, without_phase_error

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

Source = Image | str | os.PathLike[str]


@bounded
def extract_centroids(
    images: Source | Iterable[Source],
    *,
    camera: Camera | None = None,
    gain_e_per_count: float | None = None,
    read_noise_e: float | None = None,
    saturation: float | None = None,
    threshold_sigma: float = 5.0,
    min_pixels: int = 1,
    psf_sigma_px: float | None = None,
    max_stars: int | None = None,
    correct_pixel_phase: bool = True,
    workers: int | None = 0,
    progress: Progress | None = None,
) -> Centroids:
    """Find the stars in images and measure their positions with covariances.

    Parameters
    ----------
    images
        An image, a file, a folder of image files (in the order of their names), or several of them. The first frame
        has the number 0.
    camera
        If given, every image must be the size of its detector.
    gain_e_per_count
        Electrons per count; by default what the file says. Without it, it is read off the noise of the background
        where that is bright and uneven enough, for `sigma_px` only. Where it is not, the photon noise of the stars
        themselves is left away, so that `sigma_px` of bright stars comes out too small. A message says which.
    read_noise_e
        Read noise, electrons per pixel: a floor for the measured noise (needs the gain).
    saturation
        Counts at and above which a pixel is saturated; by default what the file says, or the full scale of its
        integers. Saturated pixels are not used.
    threshold_sigma
        Detection threshold in the image filtered by the PSF, in standard deviations of that image.
    min_pixels
        Pixels above the threshold that a star needs, in the filtered image.
    psf_sigma_px
        Width of the star images before integration over pixels; by default it is measured in each image.
    max_stars
        Keep at most so many stars per frame, the brightest.
    correct_pixel_phase
        Centroids of undersampled star images that are no Gaussians are drawn to the centres of the pixels. Where the
        places of many stars show it (4 standard deviations), it is taken out, and a message says how much it was. All
        images are then taken to be of one camera.
    workers
        Processes, with the same results for any number of them; 0 stays in this one. None takes as many as there are
        processors from a hundred images on; fewer are measured before a process has started.
    progress
        Called with (frames done, frames in all).

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
    sources = _sources(images)
    options = DetectionOptions(
        gain_e_per_count=gain_e_per_count,
        read_noise_e=read_noise_e,
        saturation=saturation,
        threshold_sigma=float(threshold_sigma),
        min_pixels=int(min_pixels),
        psf_sigma_px=psf_sigma_px,
        max_stars=max_stars,
    )
    task = _Measure(sources, camera, options)
    if workers is None:
        workers = processors() if len(sources) >= _WORTH_PROCESSES else 0
    table = _Table()
    frames, interrupted = run_tasks(
        task,
        len(sources),
        caller="starcal_uq.images.extract_centroids",
        chunk=_CHUNK,
        workers=workers,
        progress=progress,
    )
    if interrupted:
        raise KeyboardInterrupt
    for frame in frames:
        table.add(frame)
    return table.centroids(options, correct_pixel_phase)


@dataclass(frozen=True)
class _Frame:
    """What became of one image: its entry in the table, messages, hash of its pixels, and its stars, if it has any."""

    entry: AnyDict
    messages: list[str]
    sha256: bytes = b""
    stars: FrameStars | None = None


@dataclass(frozen=True)
class _Measure:
    """From the number of an image to its stars."""

    sources: list[Source]
    camera: Camera | None
    options: DetectionOptions

    def __call__(self, number: int) -> _Frame:
        # glibc gives memory back to the system when arrays the size of an image are freed, and gets it again page by
        # page, until a larger one has been freed. This one is never written to.
        np.empty(_KEPT_BYTES, dtype=np.uint8)
        source = self.sources[number]
        name = (source.name or f"image {number}") if isinstance(source, Image) else Path(source).name
        entry: AnyDict = {
            "frame_ids": number,
            "image": name,
            "time_utc": "",
            "background": np.nan,
            "noise": np.nan,
            "psf_sigma_px": np.nan,
            "problem": "",
        }
        sha256: Any = hashlib.sha256()
        try:
            image = source if isinstance(source, Image) else read_any_size(source, self.camera)
            entry["time_utc"] = image.time_utc or ""
            sha256.update(f"{image.data.dtype}{image.data.shape}".encode())
            sha256.update(np.ascontiguousarray(image.data))
            if self.camera is not None:
                image.check_size(self.camera)
            found = find_stars(image, self.options)
        except ImageError as error:
            text = str(error)
            message = f"Frame {number} was left out: {text}"
            # Reasons are counted over frames, so the name of this one is taken off.
            prefixes = [f"{source}: "] if not isinstance(source, Image) else []
            for prefix in (*prefixes, f"{name}: ", "image: "):
                text = text.removeprefix(prefix)
            entry["problem"] = text.partition(";")[0].rstrip(".")
            return _Frame(entry, [message], sha256.digest())
        entry.update(background=found.background, noise=found.noise, psf_sigma_px=found.psf_sigma_px)
        messages = [*image.messages, *(f"{name}: {text}" for text in found.messages)]
        return _Frame(entry, messages, sha256.digest(), found)


@dataclass
class _Table:
    """The table while it grows, frame by frame."""

    frames: list[AnyDict] = field(default_factory=list)
    stars: list[FrameStars] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    messages: list[str] = field(default_factory=list)
    gains: list[float | None] = field(default_factory=list)
    digest: Any = field(default_factory=hashlib.sha256)

    def add(self, frame: _Frame) -> None:
        self.frames.append(frame.entry)
        self.messages += frame.messages
        self.digest.update(frame.sha256)
        if frame.stars is not None:
            self.stars.append(frame.stars)
            self.numbers += [frame.entry["frame_ids"]] * len(frame.stars.columns["x_px"])
            self.gains.append(frame.stars.gain_e_per_count)

    def centroids(self, options: DetectionOptions, correct_pixel_phase: bool) -> Centroids:
        columns: AnyDict = {"frame": np.array(self.numbers, dtype=np.int64)}
        for name, (kind, _) in COLUMNS.items():
            if name != "frame":
                parts = [stars.columns[name] for stars in self.stars]
                columns[name] = np.concatenate(parts) if parts else np.zeros(0, dtype=kind)
        amplitudes = self._correct_pixel_phase(columns) if correct_pixel_phase else (0.0, 0.0)
        known = [gain for gain in self.gains if gain is not None]
        if known and len(known) < len(self.gains):
            # One unit for the whole table: counts are what every frame has.
            self.messages.append("The gain is known for some frames only; give one for all to get comparable fluxes.")
        measured = [s.measured_gain_e_per_count for s in self.stars if s.measured_gain_e_per_count is not None]
        if measured:
            self.messages.append(
                f"The gain is not given; the noise of the background says {float(np.median(measured)):.3g} electrons "
                f"per count in {plural(len(measured), 'frame')}, which was taken for the photon noise of the stars."
            )
        n_without = len(self.gains) - len(known) - len(measured)
        if n_without:
            self.messages.append(
                "The gain is unknown for "
                f"{plural(n_without, 'frame')}, so the photon noise of the stars is not in their "
                "sigma, which is too small for bright stars; give the gain in electrons per count."
            )
        meta = {
            "settings": asdict(options),
            "gain_e_per_count": known[0] if len(set(known)) == 1 and len(known) == len(self.gains) else None,
            "gain_from_noise_e_per_count": float(np.median(measured)) if measured else None,
            "flux_unit": "electrons" if known and len(known) == len(self.gains) else "counts",
            "pixel_phase_px": list(amplitudes),
            "images_sha256": self.digest.hexdigest(),
        }
        if known and len(known) < len(self.gains):
            per_star = np.repeat([g or 1.0 for g in self.gains], [len(s.columns["x_px"]) for s in self.stars])
            columns["flux"] = columns["flux"] / per_star
        frames: AnyDict = {name: [entry[name] for entry in self.frames] for name in FRAME_COLUMNS}
        return Centroids(**columns, **frames, messages=tuple(self.messages), meta=meta)

    def _correct_pixel_phase(self, columns: AnyDict) -> tuple[float, float]:
        """Take errors by pixel phase out of `columns`, and give their amplitudes in x and y, pixels."""
        sharp = [stars.windowed and stars.psf_sigma_px < _UNDERSAMPLED_PX for stars in self.stars]
        rows = np.repeat(np.array(sharp, dtype=np.bool_), [len(stars.columns["x_px"]) for stars in self.stars])
        clear = rows & (columns["snr"] > _PHASE_SNR) & ~(columns["blended"] | columns["saturated"] | columns["edge"])
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
                f"Centroids crowd at the centres of the pixels in {plural(sum(sharp), 'frame')}, because the star "
                f"images are too sharp for the pixels; errors of up to {' and '.join(moved)} were taken out."
            )
        return found[0].amplitude_px, found[1].amplitude_px


def _sources(images: Source | Iterable[Source]) -> list[Source]:
    given = [images] if isinstance(images, Image | str | os.PathLike) else list(images)
    sources: list[Source] = []
    for source in given:
        if isinstance(source, Image) or not os.path.isdir(source):
            sources.append(source)
            continue
        inside = sorted(p for p in Path(source).iterdir() if p.name.lower().endswith(IMAGE_ENDINGS))
        if not inside:
            raise ImageError(
                f"{source}: the folder holds no image ({', '.join(IMAGE_ENDINGS)}); name the folder that does, as "
                "subfolders are not searched."
            )
        sources += inside
    if not sources:
        raise ImageError("images: there is none; give files, a folder or Image objects.")
    return sources
