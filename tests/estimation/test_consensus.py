"""Stars that agree on attitudes before any calibration."""

import numpy as np
import pytest

from starcal_uq.estimation.consensus import focal_lengths, ideal_frames, pre_screen
from starcal_uq.observations.frames import StarFrames
from starcal_uq.simulation.contamination import contaminate
from tests.calibration.test_screening import TRUTH, deep_catalogue, uncalibrated
from tests.helpers import scenes


@pytest.mark.parametrize("focal", [0.9, 1.1])
def test_pre_screen_with_an_uncalibrated_camera(focal: float) -> None:
    obs = scenes.observations()
    nominal = uncalibrated(focal=focal)
    for kind in ("random", "neighbour"):
        dirty = contaminate(obs, deep_catalogue(), TRUTH, 0.1, kind, seed=1)
        frames = StarFrames.from_observations(dirty.observations)
        found = focal_lengths(ideal_frames(nominal, frames), nominal.focal_px)
        assert found / nominal.focal_px * focal == pytest.approx(1.0, abs=2e-3)
        agree, _ = pre_screen(nominal, frames)
        assert not np.any(~agree & ~dirty.wrong)
        missed = dirty.wrong & agree
        distance = (
            np.linalg.norm(dirty.observations.directions_icrs - obs.directions_icrs, axis=1)
            * TRUTH.focal_px
        )
        # Only neighbours nearer than what an uncalibrated camera can tell.
        assert np.all(distance[missed] < 4.0)
