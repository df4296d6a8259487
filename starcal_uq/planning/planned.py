"""A planned calibration: forecasts, the frames that keep a target, and what is known afterwards."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from starcal_uq.core.constants import AXES
from starcal_uq.core.display import Shown
from starcal_uq.core.settings import bounded
from starcal_uq.maths.linear import scaled_inverse

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.camera.camera import Camera
    from starcal_uq.core.provenance import Provenance
    from starcal_uq.core.types import FloatArray
    from starcal_uq.planning.costs import EffectCosts
    from starcal_uq.planning.forecast import Forecast
    from starcal_uq.planning.open_distortion import DistortionRange
    from starcal_uq.planning.ties import PlannedTies

# Frames of sweeps, and of what is expected without a target.
SWEEP_FRAMES = 1000


@dataclass(frozen=True)
class Need(Shown):
    """Frames that keep a target, for one part of the attitude error.

    Attributes
    ----------
    scope : str
        Part of the error: ``common``, ``rest``, ``calibration`` or ``total``.
    frames : int or None
        Fewest frames that keep it on average over campaigns; None where no number does.
    frames_surely : int or None
        Fewest frames with which 95 % of the campaigns keep it.
    floor_arcsec : float
        Error that no number of frames goes below, arcsec.
    """

    scope: str
    frames: int | None
    frames_surely: int | None
    floor_arcsec: float


@dataclass(frozen=True, eq=False)
class Expected:
    """A calibration that is planned, for `coupling`, or for `after` of another plan; px units,
    attitudes in rad.

    `rotation_per_theta` (3, p) is the common rotation that a parameter causes, `attitude_noise` (3,
    3) the covariance of one frame's attitude due to centroid noise.
    """

    camera: Camera
    n_frames: int
    covariance: FloatArray
    information: FloatArray
    rotation_per_theta: FloatArray
    attitude_noise: FloatArray


@dataclass(frozen=True, eq=False)
class Plan(Shown):
    """Forecast of a calibration, before any data.

    Attributes
    ----------
    camera : Camera
        The sheet.
    sigma_px : float
        Centroid noise, px per axis; root mean square over the stars where it depends on magnitude.
    max_mag : float
        Faintest magnitude.
    min_stars : int
        Least stars in a frame.
    mean_stars : float
        Stars in a frame on average.
    sky_fraction : float
        Part of random attitudes that show `min_stars`.
    forecast : Forecast
        Against number of frames.
    nea_arcsec : (3,) array
        Noise-equivalent angle of single frames, 1 sigma per axis, root mean square over frames.
    confidence : float
        Probability of two-axis errors.
    scope : str
        Part of the attitude error that the radius of the forecast is of.
    target_arcsec : float or None
        Two-axis error across the boresight that is asked for.
    needs : tuple of Need
        Frames that keep the target, for each part of the error; empty without a target.
    sweeps : pandas.DataFrame or None
        Forecasts with another magnitude limit, noise or part of the detector.
    distortion : DistortionRange or None
        What the distortion does that the sheet leaves open; None where it is known.
    seed : int
        Seed of the drawn geometries.
    provenance : Provenance
        Versions, settings and time.
    effects : EffectCosts or None
        What effects cost; None for a calibration without any.
    frame_information : (q, q) array
        Mean information of a frame, its attitude eliminated, px units: on the parameters, and on
        the coefficients of effects behind them.
    start_information : (q, q) array or None
        Information that is there already.
    rotation_per_theta : (3, p) array
        Common rotation that a parameter causes, rad.
    attitude_noise : (3, 3) array
        Covariance of one frame's attitude due to centroid noise, rad^2.
    ties : PlannedTies or None
        Rotations between frames that will be known.
    without_ties : Forecast or None
        The forecast without them.
    """

    camera: Camera
    sigma_px: float
    max_mag: float
    min_stars: int
    mean_stars: float
    sky_fraction: float
    forecast: Forecast
    nea_arcsec: FloatArray
    confidence: float
    scope: str
    target_arcsec: float | None
    needs: tuple[Need, ...]
    sweeps: pd.DataFrame | None
    distortion: DistortionRange | None
    seed: int
    provenance: Provenance
    effects: EffectCosts | None
    frame_information: FloatArray
    start_information: FloatArray | None
    rotation_per_theta: FloatArray
    attitude_noise: FloatArray
    ties: PlannedTies | None = None
    without_ties: Forecast | None = None

    @bounded
    def expected(self, n_frames: int) -> Expected:
        """Forecast for n frames, with the information of n average frames."""
        total = n_frames * self.frame_information
        total = total if self.start_information is None else total + self.start_information
        covariance, p = scaled_inverse(total), len(self.camera.theta)
        if p < len(total):
            covariance = covariance[:p, :p]
            total = scaled_inverse(covariance)
        return Expected(
            self.camera,
            n_frames,
            covariance,
            total,
            self.rotation_per_theta,
            self.attitude_noise,
        )

    @cached_property
    def _expected(self) -> Expected:
        """After the frames that the target takes, or 1000."""
        return self.expected(self.frames_needed or SWEEP_FRAMES)

    @property
    def information(self) -> FloatArray:
        """Information (p, p) after the frames that the target takes, or 1000 where there is
        none.
        """
        return self._expected.information

    @property
    def covariance(self) -> FloatArray:
        """Covariance (p, p) after as many."""
        return self._expected.covariance

    @property
    def frames_range(self) -> tuple[float, float] | None:
        """Least and most frames for the target over the distortion that is open, in the scope asked
        for.

        Infinite where no number does; None without a target, or where the distortion is known.
        """
        if self.distortion is None or self.target_arcsec is None:
            return None
        return self.distortion.frames_range(self.scope)

    @property
    def frames_needed(self) -> int | None:
        """Fewest frames that keep the target on average, in the scope asked for; None without
        one.
        """
        return None if self.need is None else self.need.frames

    @property
    def need(self) -> Need | None:
        """Frames for the target in the scope asked for; None without a target."""
        return next((need for need in self.needs if need.scope == self.scope), None)

    def to_dataframe(self) -> pd.DataFrame:
        """One row per number of frames.

        Columns are ``n_frames``; 1 sigma of every parameter, of the displacement that its
        distortion error causes in the farthest corner, and per axis of common rotation, rest and
        NEA; ``noise_relative``, the relative standard error of the noise; and ``radius_arcsec``,
        the two-axis error at the confidence, with the range of 90 % of the campaigns, and its range
        over the distortion that is open (``radius_least_arcsec``, ``radius_most_arcsec``).
        """
        table = self.forecast.to_dataframe()
        if self.distortion is not None:
            radii = self.distortion.radius_arcsec
            table = table.assign(
                radius_least_arcsec=radii.min(axis=0), radius_most_arcsec=radii.max(axis=0)
            )
        place = int(table.columns.get_loc("noise_relative"))
        for axis, value in zip(AXES, self.nea_arcsec, strict=True):
            table.insert(place, f"nea_{axis}_arcsec", float(value))
            place += 1
        return table
