"""The forecast of known rotations, against calibrations of data from a simulator of NumPy alone."""

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import PlanningError
from starcal_uq.observations.frames import StarFrames
from starcal_uq.planning import PlannedTies
from starcal_uq.planning.forecast import Forecaster, Outlook
from starcal_uq.planning.information import FrameSet, frame_matrices
from tests.helpers.effects import sheet, table
from tests.helpers.outside import campaign
from tests.helpers.ties import gyro, known_of

N, POINT = 30, ("x0_px", "y0_px")


@pytest.fixture(scope="module")
def mission() -> FrameSet:
    """Frames of the simulated sensor that could be taken, without noise."""
    c = campaign(np.random.default_rng(40), n_frames=300, sigma_px=0.0)
    obs = table(c)
    frames = StarFrames.from_observations(obs)
    frames = StarFrames(frames.pixel, frames.r, np.full(obs.n_stars, 1.0 / 0.05), frames.starts)
    camera = sheet(c).with_theta(c.theta)
    matrices = frame_matrices(camera, frames, c.attitudes)
    return FrameSet(camera, c.attitudes, frames, c.columns["mag"], *matrices)


def forecast(mission: FrameSet, n: int = N, ties: PlannedTies | None = None) -> np.ndarray:
    found = Forecaster(mission, Outlook(ties=ties)).forecast((n,))
    return np.array([found.of(name)[0] for name in POINT])


@pytest.mark.parametrize("arcsec", [1.0, 10.0])
def test_the_forecast_is_what_calibrations_state(mission: FrameSet, arcsec: float) -> None:
    stated = []
    for seed in range(4):
        rng = np.random.default_rng(50 + seed)
        c = campaign(rng, n_frames=N)
        known = known_of(gyro(rng, c, arcsec))
        cal = sc.calibrate(table(c), sheet(c), relative_attitudes=known)
        # The noise is estimated to 2.5 % in each.
        stated.append(cal.sigmas[:2] * 0.05 / cal.sigma)
    expected = forecast(mission, ties=PlannedTies(arcsec))
    np.testing.assert_allclose(np.mean(stated, axis=0), expected, rtol=0.1)
    # Control: without the rotations far more is expected.
    assert np.all(forecast(mission) > 5.0 * expected)


def test_unknown_axes_and_a_mount_tell_no_principal_point(mission: FrameSet) -> None:
    free = forecast(mission)
    for ties in (PlannedTies(1.0, alignment_arcsec=60.0), PlannedTies(1.0, of_mount=True)):
        found = forecast(mission, ties=ties)
        assert np.all((found < free) & (found > 0.8 * free))


def test_long_campaigns_are_proportional(mission: FrameSet) -> None:
    long, longer = (forecast(mission, n, PlannedTies(5.0)) for n in (1000, 4000))
    np.testing.assert_allclose(longer, 0.5 * long, rtol=1e-6)
    shorter = forecast(mission, 250, PlannedTies(5.0))
    np.testing.assert_allclose(long, 0.5 * shorter, rtol=0.03)


def test_an_error_of_zero_is_refused() -> None:
    with pytest.raises(PlanningError):
        PlannedTies(0.0)
