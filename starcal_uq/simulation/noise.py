"""How well a star is located: one noise for all, one by magnitude, or the model of a calibration."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.errors import SettingError
from starcal_uq.core.types import FloatArray, floats
from starcal_uq.likelihood.noise_model import NoiseModel

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera

# Centroid noise, px per axis: one number, a function from magnitudes (n,) to (n,), or the model of
# a calibration.
Noise = float | Callable[[FloatArray], FloatArray] | NoiseModel


def one_noise(noise: Noise) -> float | None:
    """The noise of all stars, px per axis; None where it differs from star to star."""
    return None if callable(noise) or isinstance(noise, NoiseModel) else float(noise)


def noise_of(noise: Noise, mag: FloatArray, pixel: FloatArray) -> FloatArray:
    """Noise of stars with magnitudes (n,) at pixels (2, n), px per axis, (n,).

    SettingError for a negative noise, or for a function that gives none above zero.
    """
    if isinstance(noise, NoiseModel):
        return noise.at(pixel[0], pixel[1], mag)
    values = floats(noise(mag)) if callable(noise) else np.full(mag.shape, float(noise))
    good = values > 0.0 if callable(noise) else values >= 0.0
    if values.shape != mag.shape or not np.all(good & np.isfinite(values)):
        raise SettingError(
            "sigma_px must be a noise above zero in px, or a function that gives one for every "
            "magnitude of an array."
        )
    return values


def largest_noise(noise: Noise, mag: FloatArray, camera: Camera) -> float:
    """The noise of the faintest star at the edge, px per axis: stars this near to the edge are left
    out.
    """
    edge = np.array([[camera.width_px - 1.0], camera.centre_px[1:]]) * np.ones(len(mag))
    return float(np.max(noise_of(noise, mag, edge), initial=0.0))
