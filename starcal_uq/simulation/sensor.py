"""The sensor behind the optics: how a star's light becomes counts, and how well it can be located
in them.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from starcal_uq.core.errors import SensorError
from starcal_uq.core.toml import Key, Section, read_section, write_section
from starcal_uq.core.types import AnyDict, AnyMapping, FloatArray, IntArray, PathLike, floats
from starcal_uq.simulation.psf import KINDS, profiles

_HEADER = """\
# Sensor of a star camera.
#
# psf_sigma_px: standard deviation of the Gaussian image of a star, pixels. psf: "gaussian" (integrated over each pixel)
# or "sampled" (density at the pixel's centre). zero_point_e_s: electrons per second of a star of magnitude 0.
# exposure_s: seconds. background_e_px_s, dark_e_px_s: electrons per pixel and second. read_noise_e: electrons, RMS.
# gain_e_per_count: electrons per count. offset_counts: counts without light. bits: 1 to 16. full_well_e: electrons.
# hot_pixel_fraction: part of all pixels. hot_pixel_e_s: their mean dark current, electrons per second.
# hot_pixel_seed: which pixels they are.

"""


_E = "a number of electrons"
_SECTION = Section(
    {
        "psf_sigma_px": Key(float, "a number of pixels from 0.1 to 100", ge=0.1, le=100.0),
        "psf": Key.choice(KINDS),
        "zero_point_e_s": Key(float, f"{_E} per second above 0", gt=0.0),
        "exposure_s": Key(float, "a number of seconds above 0", gt=0.0),
        "background_e_px_s": Key(float, f"{_E} per pixel and second, 0 or more", ge=0.0),
        "dark_e_px_s": Key(float, f"{_E} per pixel and second, 0 or more", ge=0.0),
        "read_noise_e": Key(float, f"{_E}, 0 or more", ge=0.0),
        "gain_e_per_count": Key(float, f"{_E} per count above 0", gt=0.0),
        "offset_counts": Key(float, "a number of counts, 0 or more", ge=0.0),
        "bits": Key(int, "a whole number from 1 to 16", ge=1, le=16),
        "full_well_e": Key(float, f"{_E} above 0", gt=0.0),
        "hot_pixel_fraction": Key(float, "a number from 0 to 1", ge=0.0, le=1.0),
        "hot_pixel_e_s": Key(float, f"{_E} per second, 0 or more", ge=0.0),
        "hot_pixel_seed": Key(int, "a whole number, 0 or more", ge=0),
    },
    SensorError,
)


@dataclass(frozen=True)
class Sensor:
    """A detector with a Gaussian point spread function and the same response in every pixel.

    The defaults are those of a small star tracker: behind `paper_camera`, a star of G = 6 has 1035
    electrons, a signal-to-noise ratio of 25, and can be located to 0.05 px per axis; stars brighter
    than magnitude 0.9 saturate.

    Attributes
    ----------
    psf_sigma_px : float
        Standard deviation of the Gaussian, px. `from_psf_radius` takes a radius: the default of 1
        px is that of a PSF with a radius of 2 px, when the radius is that of the circle with 86.5 %
        of the light.
    psf : {"gaussian", "sampled"}
        Integrated over each pixel (by differences of the error function), or the density at its
        centre.
    zero_point_e_s : float
        Electrons per second of a star of magnitude 0, in the catalogue's band.
    exposure_s : float
        Exposure time, s.
    background_e_px_s, dark_e_px_s : float
        Sky (with stray light) and dark current, electrons per pixel and second.
    read_noise_e : float
        Read noise, electrons RMS per pixel.
    gain_e_per_count : float
        Electrons per count.
    offset_counts : float
        Counts of a pixel without electrons.
    bits : int
        Resolution of the converter, 1 to 16; it ends at ``2**bits - 1`` counts.
    full_well_e : float
        Electrons that a pixel holds; the rest is lost, it does not spill into the neighbours.
    hot_pixel_fraction : float
        Part of all pixels that are hot, 0 to 1.
    hot_pixel_e_s : float
        Mean dark current of the hot pixels, electrons per second; single ones are distributed
        exponentially.
    hot_pixel_seed : int
        Seed of the places and levels of the hot pixels: they stay the same from frame to frame.

    Raises
    ------
    SensorError
        If a value is not a number or out of its range.
    """

    psf_sigma_px: float = 1.0
    psf: str = "gaussian"
    zero_point_e_s: float = 2.6e6
    exposure_s: float = 0.1
    background_e_px_s: float = 80.0
    dark_e_px_s: float = 20.0
    read_noise_e: float = 5.0
    gain_e_per_count: float = 4.0
    offset_counts: float = 64.0
    bits: int = 12
    full_well_e: float = 16000.0
    hot_pixel_fraction: float = 0.0
    hot_pixel_e_s: float = 5000.0
    hot_pixel_seed: int = 0

    def __post_init__(self) -> None:
        given = {
            key: value.item() if isinstance(value, np.generic) else value
            for key, value in vars(self).items()
        }
        for name, value in _SECTION.check(given, "sensor").items():
            object.__setattr__(self, name, value)

    @classmethod
    def from_psf_radius(
        cls, radius_px: float, *, fraction: float = 1.0 - math.exp(-2.0), **values: Any
    ) -> Sensor:
        """A sensor whose PSF is given as the radius of the circle that holds a fraction of the
        light.

        Parameters
        ----------
        radius_px : float
            Radius, px.
        fraction : float
            Part of the light inside; 1 - exp(-2) = 86.5 % by default, which makes the radius two
            sigma.
        **values
            The other attributes.
        """
        numbers = all(isinstance(value, int | float | np.number) for value in (radius_px, fraction))
        if not (numbers and 0.0 < radius_px < math.inf and 0.0 < fraction < 1.0):
            raise SensorError(
                f"sensor: a PSF of radius {radius_px!r} px that holds {fraction!r} of the light "
                "is impossible; "
                "give a radius above 0 and a fraction between 0 and 1."
            )
        return cls(psf_sigma_px=radius_px / math.sqrt(-2.0 * math.log1p(-fraction)), **values)

    @property
    def max_counts(self) -> int:
        """The largest count of the converter."""
        return int(2**self.bits - 1)

    @property
    def saturation_counts(self) -> float:
        """A pixel that shows at least this many counts is saturated: full to within three sigma of
        read noise.
        """
        noise = 3.0 * math.hypot(self.read_noise_e / self.gain_e_per_count, math.sqrt(1.0 / 12.0))
        return min(
            float(self.max_counts),
            self.offset_counts + self.full_well_e / self.gain_e_per_count - noise,
        )

    @property
    def pixel_variance_e2(self) -> float:
        """Variance of a pixel without a star, electrons^2: sky, dark current, read noise and
        quantisation.
        """
        shot = (self.background_e_px_s + self.dark_e_px_s) * self.exposure_s
        return shot + self.read_noise_e**2 + self.gain_e_per_count**2 / 12.0

    def electrons(self, mag: FloatArray | float) -> FloatArray:
        """Electrons of stars of these magnitudes in one exposure."""
        return np.asarray(self.zero_point_e_s * self.exposure_s * 10.0 ** (-0.4 * floats(mag)))

    def hot_pixels(self, width_px: int, height_px: int) -> tuple[IntArray, FloatArray]:
        """Flat indices (row by row, ascending) and mean extra electrons in one exposure of the hot
        pixels.
        """
        rng = np.random.default_rng(self.hot_pixel_seed)
        n_pixels = width_px * height_px
        where = rng.choice(n_pixels, size=round(self.hot_pixel_fraction * n_pixels), replace=False)
        level = self.hot_pixel_e_s * self.exposure_s * rng.standard_exponential(len(where))
        return np.sort(where).astype(np.int64), level

    def star_accuracy(self, mag: float) -> tuple[float, float]:
        """Signal-to-noise ratio of a star's flux, and the smallest possible centroid noise per axis
        in px.

        Both are Cramér-Rao bounds for a star at rest in an unsaturated stamp, with position and
        flux unknown and the background known, noise taken as Gaussian with the variance of the mean
        image; averaged over 4 x 4 places of the star in its pixel.
        """
        flux = float(self.electrons(mag))
        step = 1e-4
        phase = (np.arange(4) - 1.5) / 4.0
        value, slope = [], []
        for centre in phase:
            (_, low), (_, middle), (_, high) = (
                profiles(np.array([centre + shift]), self.psf_sigma_px, self.psf)
                for shift in (-step, 0.0, step)
            )
            value.append(middle[0])
            slope.append((high[0] - low[0]) / (2.0 * step))
        snr2, variance = [], []
        for ey, dy in zip(value, slope, strict=True):
            for ex, dx in zip(value, slope, strict=True):
                shape = np.outer(ey, ex)
                gradient = np.stack(
                    [shape, flux * np.outer(ey, dx), flux * np.outer(dy, ex)]
                ).reshape(3, -1)
                weight = 1.0 / (flux * shape.ravel() + self.pixel_variance_e2)
                covariance = np.linalg.inv((gradient * weight) @ gradient.T)
                snr2.append(flux**2 / covariance[0, 0])
                variance.append(0.5 * (covariance[1, 1] + covariance[2, 2]))
        return float(np.sqrt(np.mean(snr2))), float(np.sqrt(np.mean(variance)))

    def replace(self, **changes: Any) -> Sensor:
        """A copy with some attributes changed."""
        return self.from_dict(asdict(self) | changes)

    def to_dict(self) -> AnyDict:
        """The [sensor] table: plain values."""
        return asdict(self)

    @classmethod
    def from_dict(cls, table: AnyMapping) -> Sensor:
        """A sensor from the [sensor] table; what is left out has its default.

        Raises
        ------
        SensorError
            For an unknown key or a value that does not fit.
        """
        return cls(**_SECTION.check(table, "sensor"))

    @classmethod
    def load(cls, path: PathLike) -> Sensor:
        """Read a sensor from a TOML file with a [sensor] section.

        Raises
        ------
        SensorError
            If the file cannot be read or its content does not fit; the message names file, key and
            remedy.
        """
        return cls(
            **_SECTION.check(read_section(path, "sensor", SensorError), f"{path}, section [sensor]")
        )

    def save(self, path: PathLike, force: bool = False) -> None:
        """Write the sensor to a TOML file without loss of digits; `force` allows to write over
        one.
        """
        write_section(path, "sensor", self.to_dict(), _HEADER, force)
