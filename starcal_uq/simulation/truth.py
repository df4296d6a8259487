"""A rendered frame, and what it shows."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from starcal_uq.attitude.rotations import quaternion_to_rotation, rotation_to_quaternion
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model
from starcal_uq.core.errors import ImageError, SensorError, StarcalError
from starcal_uq.core.extras import extra
from starcal_uq.core.files import atomic_write_bytes, ensure_new
from starcal_uq.core.provenance import NAME, installed_version
from starcal_uq.core.types import FloatArray, PathLike, StrArray
from starcal_uq.images.image import Image
from starcal_uq.observations.table import Observations, joined_columns
from starcal_uq.simulation.sensor import Sensor


def check_time(text: str) -> str:
    """A UTC time in ISO 8601, with microseconds; `SensorError` if it cannot be read or has a time
    zone other than Z.
    """
    try:
        time = datetime.fromisoformat(text.removesuffix("Z"))
    except (AttributeError, ValueError):
        raise SensorError(
            f"rendering: {text!r} is no time; write UTC such as 2026-11-21T01:02:03.5."
        ) from None
    if time.tzinfo is not None:
        raise SensorError(f"rendering: {text!r} has a time zone; write UTC without one.")
    return time.isoformat(timespec="microseconds")


@dataclass(frozen=True, eq=False)
class FrameTruth:
    """Truth of a rendered frame.

    Attributes
    ----------
    camera : Camera
        The camera.
    sensor : Sensor
        The sensor.
    rotation : (3, 3) array
        R_cam_icrs at the middle of the exposure.
    rate_rad_s : (3,) array
        Angular rate of the camera in its own axes, rad/s.
    star_id : (n,) array of str
        Names of the stars whose noise-free position at the middle of the exposure lies on the
        detector.
    ra_deg, dec_deg : (n,) array
        Directions as the camera saw them, deg.
    mag : (n,) array
        Magnitudes of the stars.
    x_px, y_px : (n,) array
        Positions at mid-exposure, px; (0, 0) is the centre of the first pixel, y grows downwards.
    electrons : (n,) array
        Expected electrons of each star in the exposure, those beyond the edge or the full well
        included.
    frame : int
        Frame number.
    seed : int or None
        Seed of the noise, with the frame number; None if the noise came from a generator, or there
        is none.
    time_utc : str or None
        Middle of the exposure, UTC.
    """

    camera: Camera
    sensor: Sensor
    rotation: FloatArray
    rate_rad_s: FloatArray
    star_id: StrArray
    ra_deg: FloatArray
    dec_deg: FloatArray
    mag: FloatArray
    x_px: FloatArray
    y_px: FloatArray
    electrons: FloatArray
    frame: int = 0
    seed: int | None = None
    time_utc: str | None = None

    def __post_init__(self) -> None:
        if self.time_utc is not None:
            object.__setattr__(self, "time_utc", check_time(self.time_utc))

    def __len__(self) -> int:
        return len(self.x_px)

    @property
    def observations(self) -> Observations:
        """Table for perfect centroids and a perfect identification."""
        return Observations(
            frame=np.full(len(self), self.frame),
            x_px=self.x_px,
            y_px=self.y_px,
            ra_deg=self.ra_deg,
            dec_deg=self.dec_deg,
            star_id=self.star_id,
            mag=self.mag,
            time_utc=None if self.time_utc is None else np.full(len(self), self.time_utc),
            meta={
                "source": "rendered",
                "directions": "apparent",
                "seed": self.seed,
                "truth": self.camera.to_dict(),
            },
        )


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """A rendered frame and its truth.

    Attributes
    ----------
    data : (height_px, width_px) array
        Counts, uint16; float64 if they were not quantised. ``data[y, x]`` is the pixel whose centre
        is (x, y).
    truth : FrameTruth
        Truth of what the frame shows.
    """

    data: np.ndarray[Any, Any]
    truth: FrameTruth

    @property
    def image(self) -> Image:
        """The frame as `read_image` returns it."""
        sensor = self.truth.sensor
        return Image(
            self.data,
            f"frame_{self.truth.frame:05d}",
            time_utc=self.truth.time_utc,
            exposure_s=sensor.exposure_s,
            saturation=sensor.saturation_counts,
            gain_e_per_count=sensor.gain_e_per_count,
        )


SENSOR_KEYS = {
    "psf_sigma_px": ("PSFSIG", "[px] standard deviation of the PSF"),
    "psf": ("PSF", "integrated over pixels, or sampled"),
    "zero_point_e_s": ("ZEROPT", "[electron/s] of a star of magnitude 0"),
    "exposure_s": ("EXPTIME", "[s] exposure time"),
    "background_e_px_s": ("BKG_E_S", "[electron/s] background per pixel"),
    "dark_e_px_s": ("DARK_E_S", "[electron/s] dark current per pixel"),
    "read_noise_e": ("RDNOISE", "[electron] read noise, RMS"),
    "gain_e_per_count": ("EGAIN", "[electron/adu] gain"),
    "offset_counts": ("OFFSET", "[adu] counts without electrons"),
    "bits": ("BITS", "resolution of the converter"),
    "full_well_e": ("FULLWELL", "[electron] that a pixel holds"),
    "hot_pixel_fraction": ("HOTFRAC", "part of all pixels that are hot"),
    "hot_pixel_e_s": ("HOT_E_S", "[electron/s] mean dark current of hot pixels"),
    "hot_pixel_seed": ("HOTSEED", "seed of the hot pixels"),
}

# Of the lengths, those that a camera has.
_CAMERA_KEYS = {
    "pixel_um": ("PIXUM", "[um] pixel pitch"),
    "focal_mm": ("FOCALMM", "[mm] focal length"),
    "focal_px": ("FOCALPX", "[px] focal length; the pixel pitch is unknown"),
    "x0_px": ("X0PX", "[px] principal point; 0 = centre of first pixel"),
    "y0_px": ("Y0PX", "[px] principal point, y downwards"),
}

_TRUTH_COLUMNS = {
    "x_px": "pix",
    "y_px": "pix",
    "electrons": "electron",
    "ra_deg": "deg",
    "dec_deg": "deg",
    "mag": "mag",
}


def write_frame(frame: RenderedFrame, path: PathLike, force: bool = False) -> None:
    """Write a rendered frame and its truth as FITS; the same frame gives the same bytes.

    Quantised counts become 16-bit integers (``BZERO`` = 32768), others 64-bit floats.
    RunFolderError if the file exists and `force` is false, or cannot be written.
    """
    with extra("images", "FITS images"):
        from astropy.io import fits

    ensure_new(path, force)
    image = fits.PrimaryHDU(frame.data)
    image.header.extend(_cards(frame.truth))
    truth = frame.truth
    # FITS knows ASCII only; other letters become escapes such as \u03b1.
    star_id = np.char.encode(truth.star_id, "ascii", "backslashreplace")
    names = fits.Column("star_id", f"{max(1, star_id.dtype.itemsize)}A", array=star_id)
    columns = [
        fits.Column(key, "D", unit, array=getattr(truth, key))
        for key, unit in _TRUTH_COLUMNS.items()
    ]
    stream = io.BytesIO()
    fits.HDUList([image, fits.BinTableHDU.from_columns([names, *columns], name="TRUTH")]).writeto(
        stream
    )
    atomic_write_bytes(path, stream.getvalue())


def _cards(truth: FrameTruth) -> list[tuple[str, Any, str]]:
    camera, sensor = truth.camera, truth.sensor
    cards: list[tuple[str, Any, str]] = [
        ("BUNIT", "adu", "unit of the pixels"),
        ("ROWORDER", "TOP-DOWN", "the first row is y = 0, the top of the image"),
        ("FRAME", truth.frame, "frame number"),
    ]
    if truth.seed is not None:
        cards.append(("SEED", truth.seed, "seed of the noise, with FRAME"))
    if truth.time_utc is not None:
        start = datetime.fromisoformat(truth.time_utc) - timedelta(seconds=0.5 * sensor.exposure_s)
        cards += [
            ("TIMESYS", "UTC", "time scale"),
            ("DATE-OBS", start.isoformat(timespec="microseconds"), "start of the exposure"),
            ("DATE-AVG", truth.time_utc, "middle of the exposure"),
        ]
    quaternion = rotation_to_quaternion(truth.rotation)
    table, model = camera.to_dict(), get_model(camera.distortion)
    return [
        *cards,
        *_numbered("Q", "XYZW", quaternion, "attitude R_cam_icrs, scalar-last quaternion"),
        *_numbered("RATE", "XYZ", truth.rate_rad_s, "[rad/s] angular rate in camera axes"),
        ("CAMNAME", camera.name.encode("ascii", "replace").decode("ascii"), "camera"),
        *((card, table[key], text) for key, (card, text) in _CAMERA_KEYS.items() if key in table),
        ("DISTORT", camera.distortion, "distortion model"),
        *((c.name.upper(), table[c.name], f"[{c.unit}] distortion") for c in model.coefficients),
        *((card, getattr(sensor, key), text) for key, (card, text) in SENSOR_KEYS.items()),
        ("SATURATE", sensor.saturation_counts, "[adu] a pixel with this or more is saturated"),
        ("CREATOR", f"{NAME} {installed_version(NAME)}", "program that rendered the frame"),
        ("NUMPY", np.__version__, "version of NumPy, which draws the noise"),
    ]


def _numbered(name: str, axes: str, values: FloatArray, text: str) -> list[tuple[str, Any, str]]:
    """A card for each axis."""
    return [(name + axis, float(value), text) for axis, value in zip(axes, values, strict=True)]


def read_truth(path: PathLike) -> FrameTruth:
    """Read the truth of a rendered frame from its file.

    Raises
    ------
    ImageError
        If the file cannot be read, or does not carry a truth.
    """
    with extra("images", "FITS images"):
        from astropy.io import fits

    try:
        with warnings.catch_warnings():
            # Astropy only warns of a truncated file.
            warnings.simplefilter("error")
            with fits.open(io.BytesIO(Path(path).read_bytes()), memmap=False) as hdus:
                header = hdus[0].header
                table = hdus["TRUTH"].data
                columns = {key: np.array(table[key], dtype=np.float64) for key in _TRUTH_COLUMNS}
                star_id = np.array(table["star_id"], dtype=np.str_)
                size = header["NAXIS1"], header["NAXIS2"]
        model = get_model(header["DISTORT"])
        optics = {key: header[card] for key, (card, _) in _CAMERA_KEYS.items() if card in header}
        camera = Camera(
            *size,
            **{"pixel_um": None, "focal_mm": None, **optics},
            distortion=model.name,
            coefficients=tuple(header[c.name.upper()] for c in model.coefficients),
            name=header["CAMNAME"],
        )
        sensor = Sensor(**{key: header[card] for key, (card, _) in SENSOR_KEYS.items()})
        quaternion = np.array([header[f"Q{axis}"] for axis in "XYZW"])
        rate = np.array([header[f"RATE{axis}"] for axis in "XYZ"])
        frame = int(header["FRAME"])
    except FileNotFoundError:
        raise ImageError(f"{path}: the file does not exist; check the path.") from None
    except KeyError as error:
        what = str(error.args[0]).rstrip(".")
        raise ImageError(
            f"{path}: the file carries no truth ({what}); name a frame that was rendered."
        ) from None
    except (OSError, ValueError, TypeError, Warning, StarcalError) as error:
        reason = str(error).rstrip(".")
        raise ImageError(
            f"{path}: the truth cannot be read ({reason}); render the frame again."
        ) from error
    return FrameTruth(
        camera,
        sensor,
        quaternion_to_rotation(quaternion),
        rate,
        star_id=star_id,
        **columns,
        frame=frame,
        seed=header.get("SEED"),
        time_utc=header.get("DATE-AVG"),
    )


def truth_table(paths: Iterable[PathLike]) -> Observations:
    """Table for perfect centroids and a perfect identification of these frames.

    Raises
    ------
    ImageError
        If there is no file, or one cannot be read.
    """
    tables = [read_truth(path).observations for path in paths]
    if not tables:
        raise ImageError("rendered frames: no file was named; give at least one.")
    return Observations(**joined_columns(tables), meta=tables[0].meta)
