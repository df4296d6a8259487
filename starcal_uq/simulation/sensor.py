"""The sensor behind the optics: how a star's light becomes counts, and how well it can be located
in them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.errors import SensorError
from starcal_uq.core.toml import Section, Stated
from starcal_uq.core.types import AnyDict, AnyMapping, FloatArray, IntArray, floats
from starcal_uq.simulation.psf import profiles

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera

_ZERO_POINT_E_S = 2.6e6
# Light of a star of G = 0: 3631 Jy of the AB system, of which Vega's system is 0.1137 mag away in G
# (Riello et al. 2021, A&A 649, A3: zero points 25.6874 and 25.8010), over Planck's constant; photons
# per second and m^2, for each unit of the logarithm of the wavelength.
_PHOTONS_S_M2 = 3631e-26 * 10.0 ** (-0.4 * (25.8010 - 25.6874)) / 6.62607015e-34
_BAND_M = (400e-9, 900e-9)
_BAND = math.log(_BAND_M[1] / _BAND_M[0])
# Root mean square of 1 / wavelength over the photons of the band, 1/m.
_PER_WAVELENGTH = math.sqrt(0.5 * (_BAND_M[0] ** -2 - _BAND_M[1] ** -2) / _BAND)
# Places of a star along one axis of its pixel, and the step of magnitudes that noise is computed at.
_PLACES, _MAG_STEP = 4, 0.1
# Keys that say how a sensor is used, and that are done with once their effects are in the others.
_OF_USE = (
    *("aperture_mm", "transmission", "quantum_efficiency", "rate_deg_s", "age_years"),
    *("transmission_loss_per_year", "dark_growth_e_px_s"),
    *("sun_exclusion_deg", "moon_exclusion_deg", "earth_exclusion_deg"),
)


def _zero_point_e_s(table: AnyMapping, where: str) -> float:
    """Electrons per second of a star of magnitude 0: as stated, or through the aperture."""
    stated, aperture_mm = table.get("zero_point_e_s", _ZERO_POINT_E_S), table.get("aperture_mm", 0)
    share = table.get("transmission", 1.0) * table.get("quantum_efficiency", 1.0)
    if not aperture_mm:
        if share < 1.0:
            raise SensorError(
                f"{where}: transmission and quantum_efficiency need aperture_mm; add it, or state "
                "zero_point_e_s in their place."
            )
        return float(stated)
    area_m2 = 0.25 * math.pi * (aperture_mm / 1000.0) ** 2
    found = float(_PHOTONS_S_M2 * _BAND * area_m2 * share)
    if stated != _ZERO_POINT_E_S and not math.isclose(stated, found, rel_tol=1e-9):
        raise SensorError(
            f"{where}: zero_point_e_s is {stated:g}, but aperture_mm, transmission and "
            f"quantum_efficiency make it {found:.6g}; leave zero_point_e_s or aperture_mm out."
        )
    return found


@dataclass(frozen=True)
class Sensor(Stated):
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
        Electrons per second of a star of magnitude 0, in the catalogue's band; where the aperture
        is stated, what follows from it: 4.00e10 photons per second and m^2 from 400 to 900 nm.
    aperture_mm : float
        Diameter of the entrance pupil, mm; 0 where it is not stated.
    transmission, quantum_efficiency : float
        Shares of the light that pass the optics, and that become electrons, means over the band.
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
    rate_deg_s : float
        Rate of turn across the boresight during exposures, degrees per second.
    age_years : float
        Years in orbit.
    transmission_loss_per_year : float
        Share of the light that each year takes from what is left.
    dark_growth_e_px_s : float
        What each year adds to the dark current, electrons per pixel and second.
    sun_exclusion_deg, moon_exclusion_deg, earth_exclusion_deg : float
        Least angle of the boresight from the centres of Sun and Moon and from the limb of the
        Earth; 0 for none.

    Raises
    ------
    SensorError
        If a value is not a number or out of its range.
    """

    SECTION = Section.of_data(__package__, "sensor", SensorError)

    psf_sigma_px: float = 1.0
    psf: str = "gaussian"
    zero_point_e_s: float = _ZERO_POINT_E_S
    aperture_mm: float = 0.0
    transmission: float = 1.0
    quantum_efficiency: float = 1.0
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
    rate_deg_s: float = 0.0
    age_years: float = 0.0
    transmission_loss_per_year: float = 0.0
    dark_growth_e_px_s: float = 0.0
    sun_exclusion_deg: float = 0.0
    moon_exclusion_deg: float = 0.0
    earth_exclusion_deg: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "zero_point_e_s", _zero_point_e_s(vars(self), "sensor"))

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
    def now(self) -> Sensor:
        """A new sensor at rest that sees and measures what this one does at its age."""
        changed: AnyDict = {
            "zero_point_e_s": self._zero_point_now_e_s,
            "dark_e_px_s": self._dark_now_e_px_s,
        }
        own = {name: value for name, value in vars(self).items() if name not in _OF_USE}
        return Sensor(**own | changed)

    @property
    def _zero_point_now_e_s(self) -> float:
        """The zero point at the sensor's age."""
        kept: float = (1.0 - self.transmission_loss_per_year) ** self.age_years
        return self.zero_point_e_s * kept

    @property
    def _dark_now_e_px_s(self) -> float:
        """The dark current at the sensor's age."""
        return self.dark_e_px_s + self.dark_growth_e_px_s * self.age_years

    def _smeared_sigma_px(self, smear_px: float) -> float:
        """Standard deviation along the motion of a star that moves by `smear_px` in an exposure."""
        return math.hypot(self.psf_sigma_px, smear_px / math.sqrt(12.0))

    @property
    def uniform_e_px(self) -> float:
        """Electrons of sky and dark current in every pixel of one exposure."""
        return (self.background_e_px_s + self._dark_now_e_px_s) * self.exposure_s

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
        return self.uniform_e_px + self.read_noise_e**2 + self.gain_e_per_count**2 / 12.0

    def electrons(self, mag: FloatArray | float) -> FloatArray:
        """Electrons of stars of these magnitudes in one exposure."""
        return np.asarray(self._zero_point_now_e_s * self.exposure_s * 10.0 ** (-0.4 * floats(mag)))

    def hot_pixels(self, width_px: int, height_px: int) -> tuple[IntArray, FloatArray]:
        """Flat indices (row by row, ascending) and mean extra electrons in one exposure of the hot
        pixels.
        """
        rng = np.random.default_rng(self.hot_pixel_seed)
        n_pixels = width_px * height_px
        where = rng.choice(n_pixels, size=round(self.hot_pixel_fraction * n_pixels), replace=False)
        level = self.hot_pixel_e_s * self.exposure_s * rng.standard_exponential(len(where))
        return np.sort(where).astype(np.int64), level

    def star_accuracy(
        self, mag: FloatArray | float, smear_px: float = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """Signal-to-noise ratio of a star's flux, and the smallest possible centroid noise per axis
        in px.

        Both are Cramér-Rao bounds in an unsaturated stamp, with position and flux unknown and the
        background known, noise taken as Gaussian with the variance of the mean image; averaged over
        4 x 4 places of the star in its pixel. Without sky, dark current and read noise the second
        is sigma_psf / sqrt(electrons). A star that moves by `smear_px` along x during the exposure
        has a Gaussian image of the same variance; the noise is the root mean square of both axes.
        """
        flux = self.electrons(mag)
        along = self._smeared_sigma_px(smear_px)
        snr2, variance = np.zeros(flux.shape), np.zeros(flux.shape)
        for ey, dy in self._profiles(self.psf_sigma_px):
            for ex, dx in self._profiles(along):
                shape = np.outer(ey, ex)
                # Of the flux, and of the position for a flux of one electron.
                gradient = np.stack([shape, np.outer(ey, dx), np.outer(dy, ex)]).reshape(3, -1)
                weight = 1.0 / (flux[..., None] * shape.ravel() + self.pixel_variance_e2)
                covariance = np.linalg.inv((gradient * weight[..., None, :]) @ gradient.T)
                snr2 += flux**2 / covariance[..., 0, 0] / _PLACES**2
                both = 0.5 * (covariance[..., 1, 1] + covariance[..., 2, 2])
                variance += both / flux**2 / _PLACES**2
        return np.sqrt(snr2), np.sqrt(variance)

    def _profiles(self, sigma_px: float) -> list[tuple[FloatArray, FloatArray]]:
        """Light along one axis, and its slope, for a star at some places in its pixel."""
        step, found = 1e-4, []
        for phase in (np.arange(_PLACES) - 0.5 * (_PLACES - 1)) / _PLACES:
            low, middle, high = (
                profiles(np.array([phase + shift]), sigma_px, self.psf)[1][0]
                for shift in (-step, 0.0, step)
            )
            found.append((middle, (high - low) / (2.0 * step)))
        return found

    def noise(self, camera: Camera) -> SensorNoise:
        """Centroid noise by magnitude behind the optics of a camera, as `sigma_px` of `simulate`
        and `plan`.

        Raises
        ------
        SensorError
            If sky and dark current alone fill the pixels.
        """
        return SensorNoise(self, camera.focal_px)

    def replace(self, **changes: Any) -> Sensor:
        """A copy with some attributes changed."""
        table = vars(self) | changes
        if table["aperture_mm"] and "zero_point_e_s" not in changes:
            del table["zero_point_e_s"]
        return self.from_dict(table)

    @classmethod
    def from_dict(cls, table: AnyMapping, where: str = "sensor") -> Sensor:
        """A sensor from the [sensor] table, which `where` names in messages; what is left out has
        its default. SensorError for an unknown key or a value that does not fit.
        """
        _zero_point_e_s(cls.SECTION.check(table, where), where)
        return super().from_dict(table, where)


@dataclass(frozen=True)
class SensorNoise:
    """Centroid noise of a sensor behind optics of some focal length, px per axis, by magnitude.

    The bound of `Sensor.star_accuracy`, smeared by the rate; no star is located better than the
    brightest one that does not saturate, and, where the aperture is stated, than diffraction allows
    its photons: lambda / (pi aperture sqrt(electrons)) per axis (Lindegren 1978; Fialho & Mortari
    2019, Sensors 19, 5355).
    """

    sensor: Sensor
    focal_px: float

    def __post_init__(self) -> None:
        if self._room_e <= 0.0:
            raise SensorError(
                f"sensor: background and dark current bring {self.sensor.uniform_e_px:.4g} "
                "electrons to every pixel, which fills it: shorten exposure_s, or raise "
                "full_well_e."
            )

    @property
    def smear_px(self) -> float:
        """Motion of a star's image near the boresight during one exposure, px."""
        turn_rad = math.radians(self.sensor.rate_deg_s) * self.sensor.exposure_s
        return self.focal_px * turn_rad

    @property
    def _room_e(self) -> float:
        """Electrons of starlight that fit into a pixel."""
        sensor = self.sensor
        most = (sensor.max_counts - sensor.offset_counts) * sensor.gain_e_per_count
        return min(sensor.full_well_e, most) - sensor.uniform_e_px

    @property
    def brightest_mag(self) -> float:
        """Magnitude at which a star in the centre of a pixel fills it."""
        sensor = self.sensor
        along = sensor._smeared_sigma_px(self.smear_px)
        peak = 1.0
        for sigma_px in (along, sensor.psf_sigma_px):
            peak *= float(profiles(np.zeros(1), sigma_px, sensor.psf)[1].max())
        return 2.5 * math.log10(float(sensor.electrons(0.0)) * peak / self._room_e)

    def photon_limit_px(self, mag: FloatArray) -> FloatArray:
        """Least noise per axis that diffraction at the aperture allows; 0 where none is stated."""
        if not self.sensor.aperture_mm:
            return np.zeros(np.shape(mag))
        diameter_m = self.sensor.aperture_mm / 1000.0
        width_rad = 1.0 / (math.pi * diameter_m * _PER_WAVELENGTH)
        return self.focal_px * width_rad / np.sqrt(self.sensor.electrons(mag))

    def __call__(self, mag: FloatArray) -> FloatArray:
        """Noise (n,) of stars with magnitudes (n,)."""
        used = np.maximum(floats(mag), self.brightest_mag)
        low, high = np.min(used, initial=np.inf), np.max(used, initial=-np.inf)
        if not low <= high:
            return np.zeros(0)
        # Interpolated: the logarithm bends upwards, so that no value lies below the bound.
        grid = low + _MAG_STEP * np.arange(int((high - low) / _MAG_STEP) + 2)
        bound = np.log(self.sensor.star_accuracy(grid, self.smear_px)[1])
        noise = np.exp(np.interp(used, grid, bound))
        return np.maximum(noise, self.photon_limit_px(used))
