"""One frame: its pixels and what its file says of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from starcal_uq.core.display import public_names
from starcal_uq.core.errors import ImageError
from starcal_uq.core.settings import Bayer, Mosaic
from starcal_uq.core.types import AnyDict

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera

# What the 2 x 2 pixels in the corner of a mosaic of colours see, row by row.
MOSAICS = get_args(Mosaic)


@dataclass(frozen=True, eq=False)
class Image:
    """One frame.

    Attributes
    ----------
    data : array, shape (height, width)
        Counts; ``data[y, x]`` is the pixel whose centre is (x, y). Integers as the file holds them,
        or floating-point numbers, where NaN marks a pixel without a value.
    name : str
        Name, in messages and tables; of a file its name without the folder.
    time_utc : str or None
        Middle of the exposure, UTC, ISO 8601; where the file does not say it, the time in its name.
    exposure_s : float or None
        Exposure time, seconds.
    saturation : float or None
        Counts at and above which a pixel is saturated.
    header : dict
        Keywords of the file and their plain values.
    gain_e_per_count : float or None
        Electrons per count.
    messages : tuple of str
        Notes on what was done to the pixels in reading, one sentence each.
    mosaic : {"", "RGGB", "BGGR", "GRBG", "GBRG"}
        Colours of the 2 x 2 pixels in the first corner, row by row, where each pixel sees one
        colour; empty where all see the same.
    of_colours : bool
        Whether each pixel was put together from several colours in reading.
    """

    __dir__ = public_names

    data: np.ndarray[Any, Any]
    name: str = ""
    time_utc: str | None = None
    exposure_s: float | None = None
    saturation: float | None = None
    header: AnyDict = field(default_factory=dict)
    gain_e_per_count: float | None = None
    messages: tuple[str, ...] = ()
    mosaic: str = ""
    of_colours: bool = False

    def __post_init__(self) -> None:
        data = np.asarray(self.data)
        if self.mosaic and self.mosaic not in MOSAICS:
            raise ImageError(
                f"{self._label}: the mosaic is {self.mosaic!r}; give one of {', '.join(MOSAICS)}."
            )
        if data.ndim != 2 or data.dtype.kind not in "buif":
            raise ImageError(
                f"{self._label}: the pixels are {data.dtype} of shape {data.shape}; give numbers "
                "in rows and columns."
            )
        if not data.size:
            raise ImageError(f"{self._label}: the image has no pixels; leave it out.")
        object.__setattr__(self, "data", data)

    @property
    def _label(self) -> str:
        return self.name or "image"

    @property
    def height_px(self) -> int:
        """Number of rows."""
        return int(self.data.shape[0])

    @property
    def width_px(self) -> int:
        """Number of columns."""
        return int(self.data.shape[1])

    @property
    def green_parity(self) -> int | None:
        """Remainder of (x + y) / 2 of the pixels that see green in a mosaic; None where there is
        none.
        """
        return (self.mosaic[0] != "G") if self.mosaic else None

    def as_mosaic(self, bayer: Bayer | None) -> Image:
        """The image with the mosaic that the user declares, "none" for none; as it is where that is
        None.
        """
        if bayer is None:
            return self
        if self.of_colours:
            raise ImageError(
                f"{self._label}: the colours of its mosaic were put together before; leave out "
                "bayer."
            )
        return replace(self, mosaic="" if bayer == "none" else bayer)

    def check_size(self, camera: Camera) -> None:
        """Refuse an image that is not the size of the camera's detector.

        Raises
        ------
        ImageError
            If width or height differ.
        """
        if (self.width_px, self.height_px) != (camera.width_px, camera.height_px):
            raise ImageError(
                f"{self._label}: the image is {self.width_px} x {self.height_px} px and the "
                "camera has "
                f"{camera.width_px} x {camera.height_px} px; give the camera file that belongs "
                "to it."
            )

    def __repr__(self) -> str:
        size = f"{self.width_px} x {self.height_px} px, {self.data.dtype}"
        return f"Image({self.name!r}, {size}{', ' + self.time_utc if self.time_utc else ''})"
