"""Is a centroid as bright as the star it was matched with? A second opinion on matches at the edge
of their gate.

A false star on the place of a missing one lies anywhere in the gate and has any brightness; a right
star lies near the middle and has the brightness of its frame's other stars, up to colour and
variability. Neither is certain by itself: in real frames (12 bit, unfiltered, catalogue in G) one
right star in a hundred differs by more than 0.8 mag and one in a thousand by 1.5 mag. So both are
added up, with tails for the brightness like those frames' and a limit to what it may cost: a star
within two standard deviations of its place is refused only where it is brighter than any cause
makes it.
"""

from __future__ import annotations

import numpy as np

from starcal_uq.core.types import BoolArray, FloatArray
from starcal_uq.maths.intervals import median_of

# Colours, variability and the band of the sensor are not in the catalogue: brightness is never
# taken as better known.
_LEAST_SCATTER_MAG = 0.2
# Fewer stars say too little about zero point and scatter of their frame.
_LEAST_STARS = 6
# Student's t with so many degrees of freedom has tails like the real frames'.
_TAIL = 4.0
# Brightness within so many times the scatter is no reason.
_UNLIKE = 3.0
# Clouds, saturation and obstacles make a star fainter than it should be; nothing makes it so much
# brighter, mag.
_MUCH_BRIGHTER = 2.5
# The largest misfit, in units of chi-square: of position and brightness together, and of brightness
# alone.
_LIMIT, _MOST = 13.0, 9.0


def instrumental_mag(flux: FloatArray) -> FloatArray | None:
    """Magnitudes with an unknown zero point; NaN where a flux is not positive.

    None where all fluxes are equal and so say nothing.
    """
    positive = flux > 0.0
    if len(np.unique(flux[positive])) < 2:
        return None
    magnitudes = np.full(len(flux), np.nan)
    magnitudes[positive] = -2.5 * np.log10(flux[positive])
    return magnitudes


def unlike_brightness(difference_mag: FloatArray, misfit: FloatArray) -> BoolArray:
    """Which stars (m,) of a frame are refused: too far from their place for how wrong their
    brightness is.

    `difference_mag` (m,) is instrumental minus catalogue magnitude, NaN where brightness says
    nothing, as where the centroid is saturated; the zero point, that is the sensor's gain, does not
    matter. `misfit` (m,) is the squared distance from the predicted place over the variance per
    axis.
    """
    known = np.isfinite(difference_mag)
    m = int(known.sum())
    if m < _LEAST_STARS:
        return np.zeros(len(difference_mag), dtype=np.bool_)
    off = np.where(known, difference_mag - median_of(difference_mag[known]), 0.0)
    # The median deviation of few stars is often too small by chance.
    scatter = max(
        1.4826 * float(median_of(np.abs(off[known]))) * (1.0 + 2.0 / m), _LEAST_SCATTER_MAG
    )
    z = np.abs(off) / scatter
    cost = np.minimum((_TAIL + 1.0) * np.log1p(z * z / _TAIL), _MOST)
    much_brighter = (off < -_MUCH_BRIGHTER) & (z > 2.0 * _UNLIKE)
    return much_brighter | ((z > _UNLIKE) & (misfit + cost > _LIMIT))
