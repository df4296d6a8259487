"""Is a forecast right? Campaigns simulated and calibrated in full, against what was forecast of
them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, Unpack

import numpy as np

from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import CalibrationError, PlanningError
from starcal_uq.core.settings import Seed, bounded, seed_of
from starcal_uq.core.types import AnyDict, BoolArray, FloatArray
from starcal_uq.maths.intervals import chi_square_both_sides
from starcal_uq.maths.linear import inverses
from starcal_uq.planning.forecast import N_FRAMES, Forecast, Forecaster, Outlook, spreads
from starcal_uq.planning.information import random_frames
from starcal_uq.simulation.frames import Tracker, TrackerOptions, simulate
from starcal_uq.simulation.replicates import TrialOptions, Trials

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.camera.camera import Camera
    from starcal_uq.sky.catalogue import StarCatalogue


class CheckOptions(TrackerOptions, TrialOptions, total=False):
    """The tracker, and how trials are run."""


_CHUNK = 5
_INTERVAL = (0.025, 0.975)
_TOLERANCE, _FAMILY_LEVEL = 0.05, 0.01


@dataclass(frozen=True, eq=False)
class ForecastCheck(Shown):
    """Forecast and simulation, for G numbers of frames, C campaigns of each, Q quantities and p
    parameters.

    Attributes
    ----------
    forecast : Forecast
        Forecast that was checked.
    n_parameters : int
        p.
    stated : (G, C, Q) array
        1 sigma that the calibration of each campaign states; NaN where one failed.
    error : (G, C, p) array
        Estimate minus truth.
    nees : (G, C) array
        Normalised squared error of the parameters with the covariance that the calibration states.
    nees_forecast : (G, C) array
        Squared error with the mean covariance that was forecast.
    dof : (G, C) array
        Degrees of freedom of the calibrations.
    failures : tuple of str
        Reasons of the campaigns without a result.
    """

    forecast: Forecast
    n_parameters: int
    stated: FloatArray
    error: FloatArray
    nees: FloatArray
    nees_forecast: FloatArray
    dof: FloatArray
    failures: tuple[str, ...]

    @property
    def n_campaigns(self) -> int:
        """Campaigns C of each number of frames."""
        return int(self.nees.shape[1])

    @property
    def ratio(self) -> FloatArray:
        """Mean of what the campaigns state over the forecast, (G, Q)."""
        ratio: FloatArray = np.nanmean(self.stated, axis=1) / self.forecast.sigma
        return ratio

    @property
    def ratio_se(self) -> FloatArray:
        """Standard error of `ratio` from the scatter of the campaigns, (G, Q)."""
        n = np.sum(np.isfinite(self.nees), axis=1)[:, None]
        error: FloatArray = (
            np.nanstd(self.stated, axis=1, ddof=1) / np.sqrt(n) / self.forecast.sigma
        )
        return error

    def nees_ratio(self, of_forecast: bool = False) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Pooled squared z: mean squared error over its expectation (G,), 1 if the covariance is
        right.

        Also the interval that holds 95 % of such ratios if it is.
        """
        from scipy.stats import chi2

        values = self.nees_forecast if of_forecast else self.nees
        n = np.sum(np.isfinite(values), axis=1) * self.n_parameters
        nu = np.nanmean(self.dof, axis=1)
        expected = np.ones_like(nu) if of_forecast else nu / (nu - 2.0)
        low, high = (chi2.ppf(level, n) / n for level in _INTERVAL)
        return np.nanmean(values, axis=1) / self.n_parameters / expected, low, high

    @property
    def nees_rejected(self) -> BoolArray:
        """Numbers of frames (G,) whose squared errors are not what they should be: Bonferroni over
        all, at 1 %.
        """
        ratio, _, _ = self.nees_ratio()
        n = np.sum(np.isfinite(self.nees), axis=1) * self.n_parameters
        p = chi_square_both_sides(ratio * n, n)
        return p < _FAMILY_LEVEL / len(n)

    @property
    def largest_difference(self) -> float:
        """Largest relative difference of a forecast from the mean of the campaigns."""
        return float(np.max(np.abs(self.ratio - 1.0)))

    @property
    def ok(self) -> bool:
        """Every forecast is within 5 % of the campaigns, and no test of squared errors objects."""
        return self.largest_difference < _TOLERANCE and not bool(np.any(self.nees_rejected))

    def to_dataframe(self) -> pd.DataFrame:
        """One row per number of frames and quantity.

        Columns are ``n_frames``, ``quantity``, ``forecast`` and ``stated`` (mean over campaigns),
        ``ratio`` with its standard error ``ratio_se``; and, the same for all quantities of a number
        of frames, ``nees_ratio`` with the interval ``nees_low`` to ``nees_high``.
        """
        import pandas as pd

        ratio, low, high = self.nees_ratio()
        n_quantities = len(self.forecast.names)

        def repeated(values: Any) -> Any:
            return np.repeat(values, n_quantities)

        return pd.DataFrame(
            {
                "n_frames": repeated(self.forecast.n_frames),
                "quantity": list(self.forecast.names) * len(self.forecast.n_frames),
                "forecast": self.forecast.sigma.ravel(),
                "stated": np.nanmean(self.stated, axis=1).ravel(),
                "ratio": self.ratio.ravel(),
                "ratio_se": self.ratio_se.ravel(),
                "nees_ratio": repeated(ratio),
                "nees_low": repeated(low),
                "nees_high": repeated(high),
            }
        )


@bounded
def check_forecast(
    camera: Camera,
    stars: StarCatalogue,
    *,
    n_frames: Sequence[int] = N_FRAMES,
    n_campaigns: int = 50,
    n_geometries: int = 3000,
    seed: Seed = 0,
    **options: Unpack[CheckOptions],
) -> ForecastCheck:
    """Simulate and calibrate campaigns, and compare what they state and how far they err with the
    forecast of `plan`.

    The attitudes of the simulation are not those of the forecast, and every calibration starts from
    a data sheet: principal point in the centre, no distortion.

    Parameters
    ----------
    camera, stars, n_frames, n_geometries
        Sheet, sky and settings as `plan` takes them.
    n_campaigns : int
        Campaigns of each number of frames.
    seed : int or Generator
        The same seed gives the same result for any number of processes.
    sigma_px, min_stars, max_stars, exclusion
        As `plan` takes them.
    workers, progress, keep
        As in `validate`.

    Raises
    ------
    PlanningError
        For fewer than two campaigns.
    CatalogueError
        When the field is too narrow for the catalogue to show `min_stars`.
    CalibrationError
        When no campaign of some number of frames gave a result.
    KeyboardInterrupt
        After Ctrl-C before the last one.
    """
    seed = seed_of(seed)
    if n_campaigns < 2 or not n_frames:
        raise PlanningError(
            f"n_campaigns is {n_campaigns}: give at least 2, and at least one number of frames."
        )
    given: AnyDict = {**options}
    run = {name: given.pop(name) for name in TrialOptions.__annotations__ if name in given}
    tracker = Tracker.of(camera, **given)
    mission = random_frames(stars, tracker, n_frames=n_geometries, seed=seed)
    forecaster = Forecaster(mission, Outlook(seed=seed))
    trial = partial(_campaign, camera, stars, n_frames, n_campaigns, given)
    trials = Trials(trial, "check_forecast", _CHUNK, (_Calibrated,))
    # Other streams than those of the forecast.
    outcomes = trials.run(len(n_frames) * n_campaigns, [seed, 4], whole=True, **run)
    shape, p = (len(n_frames), n_campaigns), len(camera.theta)
    none = _Calibrated(np.full(p, np.nan), np.full((p, p), np.nan), np.nan)
    found = [none if result is None else result for result in outcomes.results]
    error = np.array([one.error for one in found]).reshape(*shape, p)
    covariance = np.array([one.covariance for one in found]).reshape(*shape, p, p)
    if np.isnan(error[..., 0]).all(axis=1).any():
        raise CalibrationError(outcomes.failures[0])
    forms = np.stack([q.form for q in forecaster.quantities])
    expected = inverses(np.stack([forecaster.covariances(n).mean(axis=0) for n in n_frames]))
    return ForecastCheck(
        forecast=forecaster.forecast(n_frames),
        n_parameters=p,
        stated=np.where(np.isnan(error[..., :1]), np.nan, spreads(forms, covariance)),
        error=error,
        nees=np.einsum("gci,gcij,gcj->gc", error, inverses(covariance), error),
        nees_forecast=np.einsum("gci,gij,gcj->gc", error, expected, error),
        dof=np.array([one.dof for one in found]).reshape(shape),
        failures=outcomes.failures,
    )


class _Calibrated(NamedTuple):
    """One campaign: error (p,), covariance (p, p), degrees of freedom."""

    error: FloatArray
    covariance: FloatArray
    dof: float


def _campaign(
    camera: Camera,
    stars: StarCatalogue,
    n_frames: Sequence[int],
    n_campaigns: int,
    options: AnyDict,
    number: int,
    seeds: np.random.SeedSequence,
) -> _Calibrated:
    """Simulate and calibrate a campaign of that number."""
    seed = int(seeds.generate_state(1, np.uint64)[0])
    size = n_frames[number // n_campaigns]
    obs = simulate(stars, camera, n_frames=size, seed=seed, **options)
    cal = calibrate(obs, camera.data_sheet(), model=camera.model)
    return _Calibrated(cal.theta - camera.theta, cal.covariance, float(cal.dof))
