"""Errors that stars bring along, held against a star sensor of a second make; the control has none."""

from __future__ import annotations

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.status import Level
from starcal_uq.diagnostics.stars import star_test
from starcal_uq.diagnostics.verdict.estimate import stars as check
from starcal_uq.estimation.normals import StarNormals
from starcal_uq.estimation.star_errors import star_numbers
from tests.helpers.outside import campaign


def patch(seed, star_sigma_px, **options):
    """Sixty frames on one patch of forty stars, calibrated as if stars had no errors of their own."""
    rng = np.random.default_rng([seed, 5])
    c = campaign(rng, n_frames=60, patch_stars=40, star_sigma_px=star_sigma_px, **options)
    obs = sc.Observations(**c.columns, meta={"directions": "apparent"})
    return c, obs, sc.calibrate(obs, sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0)))


def squared(c, cal, covariance):
    """Squared error over what a covariance says, 1 on average where it is right."""
    error = (c.theta - cal.theta) / cal.sigmas
    return float(error @ np.linalg.solve(covariance / np.outer(cal.sigmas, cal.sigmas), error)) / len(error)


def test_errors_of_stars_are_found_and_none_where_there_are_none():
    _, obs, cal = patch(1, 0.03)
    found = star_test(obs, cal)
    assert found.p_value < 1e-6
    assert abs(found.tau_px - 0.03) < 3.0 * found.tau_px_std
    assert found.widening.max() > 1.5
    ratio = np.sqrt(np.diag(found.jackknife_covariance) / np.diag(found.formal_covariance))
    assert ratio.max() > 1.3
    assert check(found).level is Level.FAIL
    # The control: independent noise.
    _, obs, cal = patch(1, 0.0)
    found = star_test(obs, cal)
    assert found.p_value > 0.05
    assert check(found).level is Level.PASS


def test_the_jackknife_leaves_a_star_out_as_another_fit_would():
    _, obs, cal = patch(2, 0.03)
    numbers = star_numbers(obs, cal.theta[2])
    normals = StarNormals.at(obs, cal, numbers)
    steps = normals.left_out() * normals.scale
    for star in np.argsort(np.bincount(numbers))[[-1, -5]]:
        # Frames keep three stars or more without it.
        rest = sc.calibrate(obs.select(numbers != star), cal.nominal)
        assert steps[star] / cal.sigmas == pytest.approx((rest.theta - cal.theta) / cal.sigmas, abs=0.02)
        assert np.max(np.abs(steps[star] / cal.sigmas)) > 0.1


def test_stars_are_told_apart_by_direction_or_by_name():
    c, obs, _ = patch(1, 0.03)
    named = star_numbers(obs, c.theta[2])
    # Apparent places drift by a quarter of a pixel from the first frame to the last.
    drift = np.degrees(0.004 / c.theta[2]) * obs.frame
    columns = {k: v for k, v in c.columns.items() if k != "star_id"} | {"dec_deg": obs.dec_deg + drift}
    nameless = star_numbers(sc.Observations(**columns), c.theta[2])
    assert np.array_equal(named[:, None] == named, nameless[:, None] == nameless)
    # Numbers that start again in every frame are no names of stars.
    count = np.concatenate([np.arange(n) for n in obs.stars_per_frame]).astype(str)
    again = star_numbers(sc.Observations(**(c.columns | {"star_id": count})), c.theta[2])
    assert not np.any((again[:, None] == again) & (named[:, None] != named))


def test_without_recurring_stars_the_test_says_so():
    c = campaign(np.random.default_rng(3), n_frames=12)
    obs = sc.Observations(**c.columns)
    found = star_test(obs, sc.calibrate(obs, sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0))))
    assert not found.applicable
    assert "Too few stars" in check(found).sentence


@pytest.mark.slow
def test_the_test_is_nominal_and_powerful():
    clean = [star_test(*patch(100 + i, 0.0)[1:]).p_value for i in range(60)]
    assert np.mean(np.array(clean) < 0.05) < 0.15
    tested = [patch(200 + i, 0.03) for i in range(30)]
    found = [(c, cal, star_test(obs, cal)) for c, obs, cal in tested]
    assert np.mean([test.p_value < 0.05 for *_, test in found]) > 0.9
    formal = np.mean([squared(c, cal, test.formal_covariance) for c, cal, test in found])
    model = np.mean([squared(c, cal, test.model_covariance) for c, cal, test in found])
    # The control: the stated covariance is far too small.
    assert formal > 1.8
    assert 0.6 < model < 1.4
