"""Errors of centroids by the place of the star in its pixel, found from the stars' places alone.

Stars fall everywhere in their pixels alike. Where the light of a star is too sharp for the pixels,
centroids are drawn to the pixels' centres, and measured places crowd there: a displacement by -A
sin(2 pi x) makes the mean of cos(2 pi x) pi A. Neither a catalogue nor a model of the star image is
needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from starcal_uq.core.types import FloatArray

_SIGNIFICANT, _FEWEST_PLACES = 4.0, 100
# Stars in the same square of this size may be the same star again.
_PLACE_PX = 4.0
# Beyond, the places measured no longer tell the true ones apart.
_LARGEST_PX = 0.12
_ITERATIONS = 30


@dataclass(frozen=True)
class PhaseError:
    """Displacement of centroids along one axis by -amplitude sin(2 pi x).

    The amplitude is 0 where it is not significant; its standard deviation is infinite with too few
    stars.
    """

    amplitude_px: float
    sigma_px: float


def phase_error(along_px: FloatArray, across_px: FloatArray) -> PhaseError:
    """Measure the error along an axis from many positions (n,) along it and along the other one.

    Stars that come back to the same place, as in a camera that stares, count as one.
    """
    # Complex numbers are sorted several times faster than rows.
    places = np.floor(along_px / _PLACE_PX) + 1j * np.floor(across_px / _PLACE_PX)
    unique, index = np.unique(places, return_inverse=True)
    if len(unique) < _FEWEST_PLACES:
        return PhaseError(0.0, np.inf)
    cosine = np.cos(2.0 * np.pi * along_px)
    mean = float(cosine.mean())
    sums = np.bincount(index, cosine - mean)
    amplitude, error = mean / np.pi, float(np.sqrt(np.sum(sums**2))) / len(along_px) / np.pi
    # Crowding away from the centres has other causes, such as sharp stars taken for hot pixels.
    return PhaseError(
        min(amplitude, _LARGEST_PX) if amplitude > _SIGNIFICANT * error else 0.0, error
    )


def without_phase_error(
    along_px: FloatArray, variance_px2: FloatArray, amplitude_px: float
) -> tuple[FloatArray, FloatArray]:
    """Positions (n,) put back where they were, and what their standard deviations are multiplied
    by.

    Noise blurs the phase, so noisy ones are moved less.
    """
    amplitude = amplitude_px * np.exp(-2.0 * np.pi**2 * variance_px2)
    turn = 2.0 * np.pi
    true = along_px.copy()
    for _ in range(_ITERATIONS):
        true = along_px + amplitude * np.sin(turn * true)
    return true, 1.0 / (1.0 - turn * amplitude * np.cos(turn * true))
