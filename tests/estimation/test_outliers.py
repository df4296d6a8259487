"""What a star adds to the sum of squares, and its distribution."""

import numpy as np
import pytest
from scipy import stats

import starcal_uq as sc
from starcal_uq.estimation.outliers import (
    star_residuals,
    star_threshold,
    truncated_variance,
)
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.observations.frames import StarFrames
from tests.calibration.test_screening import TRUTH, noise_free, with_noise
from tests.helpers import scenes


def test_statistic_is_the_change_of_the_sum_of_squares() -> None:
    """Against refits of attitude and camera without the star."""
    obs = scenes.observations(n_frames=12, seed=3)
    frames = StarFrames.from_observations(obs)
    theta = sc.calibrate(obs, scenes.nominal(TRUTH)).theta
    everything = np.ones(len(obs), dtype=bool)
    found = star_residuals(frames, "brown", theta, everything)

    def best(mask: np.ndarray) -> tuple[float, np.ndarray]:
        likelihood, at = MarginalLikelihood(obs.select(mask), "brown"), theta
        for _ in range(3):
            normal = likelihood.evaluate(at)
            scale = 1.0 / np.sqrt(np.diag(normal.matrix))
            at = at - scale * np.linalg.solve(
                normal.matrix * np.outer(scale, scale), scale * normal.gradient
            )
        return likelihood.evaluate(at).cost, at

    whole = best(everything)[0]
    assert found.cost == pytest.approx(whole, rel=1e-3)
    for row in (0, 7, 40, 90):
        without = everything.copy()
        without[row] = False
        cost, refit = best(without)
        assert found.t[row] == pytest.approx(whole - cost, rel=2e-2)
        # A star out of use is judged by the same number.
        again = star_residuals(frames, "brown", refit, without)
        assert again.t[row] == pytest.approx(found.t[row], rel=2e-2)
        assert again.residual_px[row] == pytest.approx(found.residual_px[row], rel=2e-2)


@pytest.mark.slow
def test_statistic_follows_its_distribution_and_raw_residuals_do_not() -> None:
    base = noise_free(8, 5)
    p_values, raw = [], []
    for seed in range(40):
        obs = with_noise(base, seed)
        cal = sc.calibrate(obs, scenes.nominal(TRUTH))
        found = star_residuals(
            StarFrames.from_observations(obs), "brown", cal.theta, np.ones(len(obs), dtype=bool)
        )
        statistic, dof = found.studentised()
        # One star per frame: those of a frame are not independent.
        one = obs.frame_starts[:-1]
        p_values.append(stats.f.sf(statistic[one] / 2.0, 2, dof[one]))
        raw.append(stats.chi2.sf(np.sum(cal.residuals_px[one] ** 2, axis=1) / cal.sigma**2, 2))
    assert stats.kstest(np.concatenate(p_values), "uniform").pvalue > 0.01
    # The control: leaving out leverage makes stars of small frames look better than they are.
    assert stats.kstest(np.concatenate(raw), "uniform").pvalue < 1e-6


@pytest.mark.slow
def test_taste_follows_its_distribution() -> None:
    base = noise_free(50, 6)
    p_values = []
    for seed in range(12):
        obs = with_noise(base, seed)
        cal = sc.calibrate(obs, scenes.nominal(TRUTH))
        found = star_residuals(
            StarFrames.from_observations(obs), "brown", cal.theta, np.ones(len(obs), dtype=bool)
        )
        p_values.append(found.taste()[1])
    assert stats.kstest(np.concatenate(p_values), "uniform").pvalue > 0.01


def test_thresholds_are_those_of_scipy() -> None:
    for p_value, dof in ((0.01, 20.0), (1e-5, 800.0), (1e-6, 3e4)):
        assert star_threshold(p_value, dof) == pytest.approx(
            2.0 * stats.f.isf(p_value, 2, dof), rel=1e-8
        )
    cut = stats.chi2.isf(0.05, 2)
    mean = stats.chi2(2).expect(lambda x: x, lb=0.0, ub=cut, conditional=True)
    assert truncated_variance(0.05) == pytest.approx(mean / 2.0, rel=1e-6)
