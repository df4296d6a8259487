"""The density that is sampled: its mode, and an independent estimate of its moments."""

import dataclasses

import numpy as np
import pytest

from starcal_uq.inference.priors import Priors
from starcal_uq.inference.target import importance_check, laplace_approximation, start_target
from tests.helpers.gaussian_camera import SD, gaussian_calibration


def test_newton_finds_a_mode_away_from_its_start() -> None:
    cal = gaussian_calibration()
    priors = Priors.default(cal.nominal)
    away = cal.theta + 20.0 * SD * np.array([1, -1, 1, 0, 0])
    start = start_target(
        cal.compressed.log_likelihood, priors, away, 3.0 * cal.information, 0.08, cal.dof, False
    )
    _, laplace = laplace_approximation(start)
    assert laplace.converged
    assert np.max(np.abs(laplace.mode[:5] - cal.theta) / SD) < 0.02
    # With theta at its optimum, the mode in log sigma is sigma0 up to the prior's negligible pull.
    assert np.exp(laplace.mode[5]) == pytest.approx(0.05, rel=1e-3)
    assert np.sqrt(laplace.covariance[5, 5]) == pytest.approx(1 / np.sqrt(2 * cal.dof), rel=1e-2)


def test_importance_sampling_knows_the_moments_and_its_own_limits() -> None:
    cal = gaussian_calibration()
    start = start_target(
        cal.compressed.log_likelihood,
        Priors.default(cal.nominal),
        cal.theta,
        cal.information,
        0.05,
        cal.dof,
        False,
    )
    target, laplace = laplace_approximation(start)
    check = importance_check(target, 20_000, 8.0, np.random.default_rng(1))
    assert check.khat < 0.5
    assert np.max(np.abs(check.mean - laplace.mean) / laplace.sd) < 0.05
    assert np.allclose(check.sd, laplace.sd, rtol=0.03)
    # A proposal three times too narrow in every direction does not pass for a good one.
    narrow = dataclasses.replace(target, transform=target.transform / 3.0)
    assert importance_check(narrow, 20_000, 50.0, np.random.default_rng(1)).khat > 0.7
