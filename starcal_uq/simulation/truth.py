"""A rendered frame, and what it shows."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import SensorError
from starcal_uq.core.types import FloatArray, StrArray
from starcal_uq.images.image import Image
from starcal_uq.observations.table import Observations
from starcal_uq.simulation.sensor import Sensor


def check_time(text: str) -> str:
    """A UTC time in ISO 8601, with microseconds.

    Raises
    ------
    SensorError
        If it cannot be read, or names a time zone other than Z.
    """
    try:
        time = datetime.fromisoformat(text.removesuffix("Z"))
    except (AttributeError, ValueError):
        raise SensorError(f"rendering: {text!r} is no time; write UTC such as 2026-11-21T01:02:03.5.") from None
    if time.tzinfo is not None:
        raise SensorError(f"rendering: {text!r} has a time zone; write UTC without one.")
    return time.isoformat(timespec="microseconds")


@dataclass(frozen=True, eq=False)
class FrameTruth:
    """What a rendered frame shows.

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
        Names of the stars whose noise-free position at the middle of the exposure lies on the detector.
    ra_deg, dec_deg : (n,) array
        Their directions, as the camera saw them.
    mag : (n,) array
        Their magnitudes.
    x_px, y_px : (n,) array
        Those positions; (0, 0) is the centre of the first pixel, y grows downwards.
    electrons : (n,) array
        Expected electrons of each star in the exposure, those beyond the edge or the full well included.
    frame : int
        Frame number.
    seed : int or None
        Seed of the noise, with the frame number; None if the noise came from a generator, or there is none.
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
        """The table that perfect centroids and a perfect identification would give."""
        return Observations(
            frame=np.full(len(self), self.frame),
            x_px=self.x_px,
            y_px=self.y_px,
            ra_deg=self.ra_deg,
            dec_deg=self.dec_deg,
            star_id=self.star_id,
            mag=self.mag,
            time_utc=None if self.time_utc is None else np.full(len(self), self.time_utc),
            meta={"source": "rendered", "directions": "apparent", "seed": self.seed, "truth": self.camera.to_dict()},
        )


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """A rendered frame and its truth.

    Attributes
    ----------
    data : (height_px, width_px) array
        Counts, uint16; float64 if they were not quantised. ``data[y, x]`` is the pixel whose centre is (x, y).
    truth : FrameTruth
        What the frame shows.
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
