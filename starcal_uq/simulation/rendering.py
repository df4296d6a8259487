"""Frames of the sky as a sensor delivers them: the way from a catalogue to pixels."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from starcal_uq.attitude.rotations import exp_rotation
from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import SensorError
from starcal_uq.core.settings import Seed, bounded, seed_of
from starcal_uq.core.types import FloatArray, IntArray, floats
from starcal_uq.simulation.frames import Sky
from starcal_uq.simulation.psf import half_width_px, profiles
from starcal_uq.simulation.sensor import Sensor
from starcal_uq.simulation.truth import FrameTruth, RenderedFrame

if TYPE_CHECKING:
    from starcal_uq.sky.catalogue import StarCatalogue

# Gauss-Legendre nodes along a smeared image: this many, and more for each sigma of its length. The
# exposure integral of a Gaussian is then exact to 2e-9 of its peak.
_NODES = 9
_NODES_PER_SIGMA = 1.5
# Values of stamps that are held at once.
_MAX_VALUES = 2_000_000


class Scene:
    """A catalogue, down to its faintest star, in front of a camera with a sensor, prepared for many
    frames.
    """

    def __init__(self, stars: StarCatalogue, camera: Camera, sensor: Sensor) -> None:
        self.stars = stars
        self.camera = camera
        self.sensor, self.rate_rad_s = sensor.now, np.radians([0.0, sensor.rate_deg_s, 0.0])
        self.electrons = sensor.electrons(stars.mag)
        # Stars outside whose light still reaches the detector.
        self.sky = Sky(stars, camera, -float(half_width_px(sensor.psf_sigma_px) + 1))
        self.hot = sensor.hot_pixels(camera.width_px, camera.height_px)

    def render(
        self,
        rotation: ArrayLike,
        rng: np.random.Generator | None,
        *,
        rate_rad_s: ArrayLike | None = None,
        noise: bool = True,
        quantise: bool = True,
        frame: int = 0,
        seed: int | None = None,
        time_utc: str | None = None,
    ) -> RenderedFrame:
        """One frame; the arguments are those of `render`."""
        centre = floats(rotation)
        rate = self.rate_rad_s if rate_rad_s is None else floats(rate_rad_s)
        if centre.shape != (3, 3) or not np.allclose(centre @ centre.T, np.eye(3), atol=1e-6):
            raise SensorError(
                "rendering: the attitude is no rotation; give R_cam_icrs as an orthogonal 3 x 3 "
                "matrix."
            )
        if rate.shape != (3,) or not np.isfinite(rate).all():
            raise SensorError(
                f"rendering: the rate is {rate_rad_s!r}; give three finite numbers in rad/s."
            )
        pixel, light, seen, xy = self._starlight(centre, rate)
        data = self._counts(pixel, light, rng if noise else None, quantise)
        truth = FrameTruth(
            self.camera,
            self.sensor,
            centre,
            rate,
            **self.stars.named(seen),
            x_px=xy[:, 0],
            y_px=xy[:, 1],
            electrons=self.electrons[seen],
            frame=frame,
            seed=seed if noise else None,
            time_utc=time_utc,
        )
        return RenderedFrame(data, truth)

    def _starlight(
        self, centre: FloatArray, rate: FloatArray
    ) -> tuple[IntArray, FloatArray, IntArray, FloatArray]:
        """Lit pixels (flat, ascending), their expected electrons, catalogue indices and pixels of
        the true stars.
        """
        sigma, camera = self.sensor.psf_sigma_px, self.camera
        # The fastest star is in a corner: the boresight's motion is stretched there, and the roll
        # adds to it.
        f, radius = camera.focal_px, camera.corner_radius_px
        across, around = float(np.hypot(rate[0], rate[1])), abs(float(rate[2]))
        length_px = self.sensor.exposure_s * (
            across * f * (1.0 + (radius / f) ** 2) + around * radius
        )
        if length_px > np.hypot(camera.width_px, camera.height_px):
            raise SensorError(
                f"rendering: at {float(np.linalg.norm(rate)):.3g} rad/s a star moves up to "
                f"{length_px:.0f} px in one "
                "exposure, more than the detector: lower the rate or the exposure time."
            )
        if length_px:
            count = _NODES + int(np.ceil(_NODES_PER_SIGMA * length_px / sigma))
            node, weight = np.polynomial.legendre.leggauss(count | 1)
        else:
            node, weight = np.zeros(1), np.array([2.0])
        # The sky turns against the camera.
        time_s = 0.5 * self.sensor.exposure_s * node
        views = self.sky.views(exp_rotation(-time_s[:, None] * rate) @ centre)
        seen, xy = views[len(node) // 2]
        on = camera.contains(xy)
        index = np.concatenate([indices for indices, _ in views])
        place = np.concatenate([pixels for _, pixels in views])
        share = np.repeat(0.5 * weight, [len(indices) for indices, _ in views])
        pixel, light = self._deposit(place, self.electrons[index] * share)
        return pixel, light, seen[on], xy[on]

    def _deposit(self, place: FloatArray, electrons: FloatArray) -> tuple[IntArray, FloatArray]:
        """Flat indices (ascending) of the pixels lit by points at `place` (n, 2), and their
        expected electrons.
        """
        sensor, width, height = self.sensor, self.camera.width_px, self.camera.height_px
        offset = np.arange(2 * half_width_px(sensor.psf_sigma_px) + 1)
        step = max(1, _MAX_VALUES // offset.size**2)
        pixels: list[IntArray] = [np.zeros(0, dtype=np.int64)]
        lights: list[FloatArray] = [np.zeros(0)]
        for start in range(0, len(place), step):
            chunk = slice(start, start + step)
            first_x, ex = profiles(place[chunk, 0], sensor.psf_sigma_px, sensor.psf)
            first_y, ey = profiles(place[chunk, 1], sensor.psf_sigma_px, sensor.psf)
            light = (electrons[chunk, None] * ey)[:, :, None] * ex[:, None, :]
            x = np.broadcast_to((first_x[:, None] + offset)[:, None, :], light.shape)
            y = np.broadcast_to((first_y[:, None] + offset)[:, :, None], light.shape)
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            pixel, place_of = np.unique(y[inside] * width + x[inside], return_inverse=True)
            pixels.append(pixel.astype(np.int64))
            amount = np.bincount(place_of.ravel(), weights=light[inside], minlength=len(pixel))
            lights.append(amount.astype(np.float64))
        pixel, place_of = np.unique(np.concatenate(pixels), return_inverse=True)
        total = np.bincount(place_of.ravel(), weights=np.concatenate(lights), minlength=len(pixel))
        return pixel.astype(np.int64), total.astype(np.float64)

    def _counts(
        self, pixel: IntArray, light: FloatArray, rng: np.random.Generator | None, quantise: bool
    ) -> np.ndarray[Any, Any]:
        """The detector (height_px, width_px): uniform electrons, stars and hot pixels, then the
        electronics.
        """
        sensor, shape = self.sensor, (self.camera.height_px, self.camera.width_px)
        uniform = sensor.uniform_e_px
        hot, level = self.hot
        electrons: np.ndarray[Any, Any]
        if rng is None:
            electrons = np.full(shape, uniform)
        else:
            # Sums of Poisson numbers are Poisson numbers: only the uniform part is drawn for every
            # pixel.
            electrons = uniform_shot_noise(uniform, shape, rng)
            light = rng.poisson(light).astype(np.float64)
            level = rng.poisson(level).astype(np.float64)
        flat = electrons.reshape(-1)
        flat[pixel] += light
        flat[hot] += level
        np.minimum(electrons, sensor.full_well_e, out=electrons)
        if rng is not None and sensor.read_noise_e:
            read_noise = rng.standard_normal(shape, dtype=np.float32)
            read_noise *= np.float32(sensor.read_noise_e)
            electrons += read_noise
        electrons /= sensor.gain_e_per_count
        electrons += sensor.offset_counts
        if not quantise:
            return electrons.astype(np.float64)
        np.rint(electrons, out=electrons)
        np.clip(electrons, 0.0, float(sensor.max_counts), out=electrons)
        return electrons.astype(np.uint16)


@bounded
def render(
    stars: StarCatalogue,
    camera: Camera,
    rotation: ArrayLike,
    sensor: Sensor | None = None,
    *,
    seed: Seed = 0,
    rate_rad_s: ArrayLike | Sequence[float] | None = None,
    noise: bool = True,
    quantise: bool = True,
    frame: int = 0,
    time_utc: str | None = None,
) -> RenderedFrame:
    """Render one frame.

    Parameters
    ----------
    stars : StarCatalogue
        Stars with the directions that the camera sees (proper motion and aberration applied, where
        they matter).
    camera : Camera
        Optics and distortion.
    rotation : (3, 3) array
        R_cam_icrs at the middle of the exposure: b = R r.
    sensor : Sensor, optional
        Detector and PSF; ``Sensor()`` by default.
    seed : int or Generator
        Seed of the noise: the same seed and frame number repeat the frame bit for bit.
    rate_rad_s : (3,) array, optional
        Angular rate of the camera in its own axes (x right, y down, z along the boresight),
        constant over the exposure, rad/s. A positive rate about y turns the boresight towards +x,
        and the stars move towards -x. By default the sensor's rate, about y.
    noise : bool
        False: expected values, without shot and read noise.
    quantise : bool
        False: counts before rounding and before the ends of the converter, as float64; the full
        well holds.
    frame : int
        Frame number, which also enters the seed.
    time_utc : str, optional
        Middle of the exposure, to be recorded.

    Raises
    ------
    SensorError
        For an attitude that is no rotation, or a rate that smears over more than the detector.
    DistortionError
        When the camera's distortion folds over inside the field.

    Notes
    -----
    There is no blooming, no difference in response between pixels, and no rolling shutter. The PSF
    is the same over the field. The smear is the exposure integral of the PSF along the star's path,
    by Gauss-Legendre quadrature.
    """
    seed = seed_of(seed)
    if frame < 0:
        raise SensorError(f"rendering: frame is {frame}; give a whole number of 0 or more.")
    return Scene(stars, camera, Sensor() if sensor is None else sensor).render(
        rotation,
        np.random.default_rng([seed, frame]),
        rate_rad_s=rate_rad_s,
        noise=noise,
        quantise=quantise,
        frame=frame,
        seed=seed,
        time_utc=time_utc,
    )


# The unit interval is cut into this many buckets. Nearly all of them lie within one step of the
# distribution function, so that 16 random bits decide; in the others a further uniform number does.
_BUCKETS = 1 << 16
# Beyond, the steps become as narrow as the buckets, and NumPy's own method takes over.
_MAX_MEAN = 1000.0


@lru_cache(maxsize=8)
def _table(mean: float) -> tuple[FloatArray, np.ndarray[Any, Any]]:
    """Distribution function of 0, 1, ..., and the value of each bucket (-1: undecided)."""
    from scipy.special import gammaln

    k = np.arange(int(mean + 12.0 * np.sqrt(mean)) + 40)
    cumulative = np.cumsum(np.exp(k * np.log(mean) - mean - gammaln(k + 1.0)))
    cumulative /= cumulative[-1]
    edges = np.arange(_BUCKETS + 1) / _BUCKETS
    low = np.searchsorted(cumulative, edges[:-1], side="right")
    high = np.searchsorted(cumulative, edges[1:], side="left")
    return cumulative, np.where(low == high, low, -1).astype(np.float32)


def uniform_shot_noise(
    mean: float, shape: tuple[int, int], rng: np.random.Generator
) -> np.ndarray[Any, Any]:
    """Independent Poisson numbers of one mean; single precision holds whole numbers exactly up to
    16 million.
    """
    if mean == 0.0:
        return np.zeros(shape, dtype=np.float32)
    if mean > _MAX_MEAN:
        return rng.poisson(mean, shape).astype(np.float32)
    cumulative, values = _table(mean)
    bucket = rng.integers(0, _BUCKETS, shape, dtype=np.uint16).reshape(-1)
    drawn: np.ndarray[Any, Any] = values[bucket]
    undecided = np.flatnonzero(drawn < 0.0)
    u = (bucket[undecided] + rng.random(len(undecided))) / _BUCKETS
    drawn[undecided] = np.searchsorted(cumulative, u, side="right")
    return drawn.reshape(shape)
