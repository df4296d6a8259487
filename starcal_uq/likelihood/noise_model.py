"""Centroid noise that varies, as a part of a likelihood: its variance as a smooth function of radius and
magnitude, times a factor per frame, with axes that may differ.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.display import public_names
from starcal_uq.core.findings import clause
from starcal_uq.core.records import from_plain, to_plain
from starcal_uq.core.types import AnyDict, FloatArray, IntArray

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.observations.table import Observations


QUANTITIES = ("radius", "magnitude")
Noise = Enum("Noise", "MODEL")


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Variance per axis of a star: ``level_px^2 exp(terms)``, times the factor of its frame, times
    its stated variance.

    Attributes
    ----------
    terms : tuple of str
        Powers of ``radius`` (distance from the principal point over the half diagonal) and of
        ``magnitude`` (less the reference) in the log variance, such as ``radius`` and ``radius^2``.
    coefficients, errors : (q,) array
        Coefficients of the terms, and their standard errors.
    level_px : float
        Noise at radius zero and the reference magnitude, px per axis; a factor where the stars
        state their noise.
    multiplies : bool
        Whether the model multiplies a noise that the stars state.
    centre_px : (2,) array
        Principal point, px.
    corner_px : float
        Half diagonal, px.
    radius_range, mag_range : (2,) array
        Where stars were seen; beyond, the noise is that of the end.
    mag_reference : float
        Mean magnitude, which stands for a magnitude that is not known.
    frame_dof : float or None
        Degrees of freedom of the inverse chi-square distribution of the frames' variances; None
        where frames are alike.
    frame_ids, frame_factors : (K,) array
        Frames, and the factor of each on the variance; empty where frames are alike, and in a
        posterior.
    frame_mean : float
        Mean of the factors, which stands for frames that were not observed.
    axis_ratio : float
        Noise along x over that along y; 1 where they are alike. The variance above is their
        geometric mean.
    axis_correlation : float
        Correlation of the errors of x and y.
    """

    __dir__ = public_names

    terms: tuple[str, ...]
    coefficients: FloatArray
    errors: FloatArray
    level_px: float
    multiplies: bool
    centre_px: FloatArray
    corner_px: float
    radius_range: FloatArray
    mag_range: FloatArray
    mag_reference: float
    frame_dof: float | None
    frame_ids: IntArray
    frame_factors: FloatArray
    frame_mean: float
    axis_ratio: float = 1.0
    axis_correlation: float = 0.0

    @property
    def varies(self) -> bool:
        """True if the noise is not uniform."""
        return bool(self.terms) or self.frame_dof is not None or self.axes is not None

    @property
    def axes(self) -> FloatArray | None:
        """Covariance (2, 2) of the noise of x and y, of determinant one; None where the axes are
        alike.
        """
        if self.axis_ratio == 1.0 and self.axis_correlation == 0.0:
            return None
        matrix = np.array(
            [
                [self.axis_ratio, self.axis_correlation],
                [self.axis_correlation, 1.0 / self.axis_ratio],
            ]
        )
        return np.asarray(matrix / np.sqrt(1.0 - self.axis_correlation**2))

    def __str__(self) -> str:
        ends = self.mag_range if "magnitude" in self.terms else ()
        mags = [(self._noise(0.0, float(mag)), float(mag)) for mag in ends]
        shares = np.quantile(self.frame_factors, (0.05, 0.95)) if len(self.frame_factors) else ()
        return clause(
            Noise.MODEL,
            it=self,
            middle=self._noise(0.0),
            edge=self._noise(self.radius_range[1]),
            mags=mags,
            factors=np.sqrt(np.asarray(shares) / self.frame_mean),
        )

    def _noise(self, radius: float, mag: float | None = None) -> float:
        x = np.array([self.centre_px[0] + radius * self.corner_px])
        return float(self.at(x, self.centre_px[1:], None if mag is None else np.array([mag]))[0])

    def to_dataframe(self) -> pd.DataFrame:
        """One row per term: coefficient of the log variance and its standard error."""
        import pandas as pd

        columns = {"term": list(self.terms), "coefficient": self.coefficients, "error": self.errors}
        return pd.DataFrame(columns)

    def at(self, x_px: FloatArray, y_px: FloatArray, mag: FloatArray | None = None) -> FloatArray:
        """Noise of stars at pixels (n,) with magnitudes (n,), px per axis or a factor; frames
        apart, their mean.
        """
        radius = np.hypot(x_px - self.centre_px[0], y_px - self.centre_px[1]) / self.corner_px
        centred = np.zeros_like(radius)
        if mag is not None:
            centred = np.nan_to_num(np.clip(mag, *self.mag_range) - self.mag_reference)
        columns = log_variance_columns(self.terms, np.clip(radius, *self.radius_range), centred)
        sigma: FloatArray = (
            self.level_px * np.sqrt(self.frame_mean) * np.exp(0.5 * (columns @ self.coefficients))
        )
        return sigma

    def sigma_px(self, obs: Observations) -> FloatArray:
        """Noise of every star, (N,) px per axis; frames of a mission get the mean variance of those
        observed.
        """
        stated = obs.unweighted.sigma_px
        sigma = self.at(obs.x_px, obs.y_px, obs.mag)
        if len(self.frame_ids) and obs.origin.frames is None:
            place = np.clip(np.searchsorted(self.frame_ids, obs.frame), 0, len(self.frame_ids) - 1)
            own = np.where(
                self.frame_ids[place] == obs.frame, self.frame_factors[place], self.frame_mean
            )
            sigma = sigma * np.sqrt(own / self.frame_mean)
        return sigma if stated is None or not self.multiplies else sigma * stated

    def record(self, frames: bool = True) -> AnyDict:
        """The model as plain values, for a provenance, with or without the factors of frames."""
        kept = (
            self
            if frames
            else replace(self, frame_ids=self.frame_ids[:0], frame_factors=self.frame_factors[:0])
        )
        plain: AnyDict = to_plain(kept)
        return plain


def noise_model_of(result: Any) -> NoiseModel | None:
    """The noise model of a calibration or posterior; None where there is one noise for all."""
    record = result.provenance.noise_model
    return None if record is None else from_plain(NoiseModel, record)


def log_variance_columns(terms: tuple[str, ...], radius: FloatArray, mag: FloatArray) -> FloatArray:
    """Columns (n, q) of the log variance."""
    values = dict(zip(QUANTITIES, (radius, mag), strict=True))
    found = [
        values[name] ** int(power or 1)
        for name, _, power in (term.partition("^") for term in terms)
    ]
    return np.stack(found, axis=-1) if found else np.zeros((len(radius), 0))
