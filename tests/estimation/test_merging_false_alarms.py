"""Tests of runs against each other."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from scipy import stats

from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.estimation.merging import consistency_of, merge
from starcal_uq.estimation.result import Calibration
from starcal_uq.inference.update import shift_test
from starcal_uq.simulation.frames import simulate
from tests.helpers import scenes

NOMINAL = scenes.nominal(scenes.camera())


@lru_cache(maxsize=640)
def calibrated(seed: int, n_frames: int = 12, shift_f_px: float = 0.0) -> Calibration:
    camera = scenes.camera()
    theta = camera.theta.copy()
    theta[2] += shift_f_px
    obs = simulate(
        scenes.catalogue(), camera.with_theta(theta), n_frames=n_frames, min_stars=8, seed=seed
    )
    return calibrate(obs, NOMINAL)


def shift_p_values(n: int, shift_f_px: float = 0.0, n_frames: int = 12) -> np.ndarray:
    """Two runs each, of which the second may have moved."""
    pairs = (
        (calibrated(5000 + 2 * i, n_frames), calibrated(5001 + 2 * i, n_frames, shift_f_px))
        for i in range(n)
    )
    return np.array([shift_test(before, after).p_value for before, after in pairs])


def merge_p_values(n: int, shift_f_px: float = 0.0, n_frames: int = 12) -> np.ndarray:
    """Three runs each, of which the last may have moved: all together, the second against the
    others, the noise.
    """
    found = []
    for i in range(n):
        runs = [calibrated(5000 + 3 * i + k, n_frames, shift_f_px * (k == 2)) for k in range(3)]
        compared = consistency_of(merge(runs, allow_inconsistent=True))
        found.append((compared.p_value, compared.run_p_value[1], compared.noise_p_value))
    return np.array(found)


@pytest.mark.slow
def test_a_shift_is_seen_where_there_is_one() -> None:
    assert stats.kstest(shift_p_values(40), "uniform").pvalue > 1e-3
    # The control: a focal length that moved by one of its marginal sigmas.
    assert stats.kstest(shift_p_values(10, 0.3), "uniform").pvalue < 1e-3


@pytest.mark.slow
def test_runs_to_be_merged_differ_where_they_do() -> None:
    for column in merge_p_values(25).T:
        assert stats.kstest(column, "uniform").pvalue > 1e-3
    # The control: a focal length off by 0.3 px, one marginal sigma, in one of three runs.
    assert stats.kstest(merge_p_values(8, 0.3)[:, 0], "uniform").pvalue < 1e-3
