"""Errors that stars bring along, held against a star sensor of a second make."""

import dataclasses

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.attitude.rotations import quaternion_to_rotation
from starcal_uq.core.status import Level
from starcal_uq.diagnostics import stars as diagnostics_stars
from starcal_uq.diagnostics.stars import star_test
from starcal_uq.diagnostics.verdict.estimate import stars as check
from starcal_uq.estimation.normals import StarNormals
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.star_errors import StarModel, star_numbers
from tests.helpers.outside import campaign


def patch(seed, star_sigma_px, **options):
    """Sixty frames on one patch of forty stars, calibrated as if stars had no errors of their
    own.
    """
    rng = np.random.default_rng([seed, 5])
    c = campaign(rng, n_frames=60, patch_stars=40, star_sigma_px=star_sigma_px, **options)
    obs = sc.Observations(**c.columns, meta={"directions": "apparent"})
    return c, obs, sc.calibrate(obs, sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0)))


def squared(c, cal, covariance):
    """Squared error over what a covariance says, 1 on average where it is right."""
    error = (c.theta - cal.theta) / cal.sigmas
    return float(
        error @ np.linalg.solve(covariance / np.outer(cal.sigmas, cal.sigmas), error)
    ) / len(error)


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
        assert steps[star] / cal.sigmas == pytest.approx(
            (rest.theta - cal.theta) / cal.sigmas, abs=0.02
        )
        assert np.max(np.abs(steps[star] / cal.sigmas)) > 0.1


def test_stars_are_told_apart_by_direction_or_by_name():
    c, obs, _ = patch(1, 0.03)
    named = star_numbers(obs, c.theta[2])
    # Apparent places drift by a quarter of a pixel from the first frame to the last.
    drift = np.degrees(0.004 / c.theta[2]) * obs.frame
    columns = {k: v for k, v in c.columns.items() if k != "star_id"} | {
        "dec_deg": obs.dec_deg + drift
    }
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
def test_false_alarms_and_power_are_as_stated():
    """On one geometry, refitted linearly."""
    _, obs, cal = patch(7, 0.0)
    rng = np.random.default_rng(7)
    likelihood = MarginalLikelihood(obs, "brown")
    state, _ = likelihood.profile(cal.theta, quaternion_to_rotation(cal.quaternions))
    z = StarModel(obs, cal.theta[2]).term()
    shift = z.columns(likelihood, state, slice(None))
    model = obs.xy - state.e.T
    h = likelihood.project_out(state, state.slopes).reshape(5, -1) * cal.sigmas[:, None]
    p_values = {0.0: [], 0.01: [], 0.03: []}
    for tau in p_values:
        for _ in range(400 if tau == 0.0 else 40):
            u = tau * rng.standard_normal((z.n_groups, 2))[z.groups]
            noise = 0.05 * rng.standard_normal((2, obs.n_stars)) + np.einsum("nj,jxn->xn", u, shift)
            step = np.linalg.solve(h @ h.T, h @ likelihood.project_out(state, noise[None]).ravel())
            x, y = model.T + noise
            table = dataclasses.replace(obs, x_px=x, y_px=y)
            fitted = dataclasses.replace(cal, theta=cal.theta + step * cal.sigmas)
            p_values[tau].append(diagnostics_stars._likeness(table, fitted, z.groups).p_value)
    share = {tau: np.mean(np.array(p) < 0.05) for tau, p in p_values.items()}
    assert 0.025 < share[0.0] < 0.08
    assert np.mean(np.array(p_values[0.0]) < 0.5) == pytest.approx(0.5, abs=0.1)
    assert share[0.01] > 0.8
    assert share[0.03] > 0.9


@pytest.mark.slow
def test_the_size_found_gives_the_right_covariance():
    found = [
        (c, cal, star_test(obs, cal)) for c, obs, cal in (patch(200 + i, 0.03) for i in range(20))
    ]
    # The control: the stated covariance is far too small.
    assert np.mean([squared(c, cal, test.formal_covariance) for c, cal, test in found]) > 1.6
    assert 0.5 < np.mean([squared(c, cal, test.model_covariance) for c, cal, test in found]) < 1.5


def test_traces_of_a_sparse_matrix_are_those_of_a_dense_one():
    from scipy import sparse

    from starcal_uq.diagnostics.stars import _sparse_traces

    rng = np.random.default_rng(1)
    rest = sparse.random_array((800, 800), density=0.01, rng=rng, format="csr")
    matrix = sparse.csr_array(rest + rest.T + sparse.diags_array(rng.uniform(5.0, 15.0, 800)))
    dense = matrix.toarray()
    square = dense @ dense
    exact = (np.trace(dense), np.trace(square), np.sum(square * dense), np.sum(square**2))
    found = _sparse_traces(matrix)
    np.testing.assert_allclose(found[:2], exact[:2], rtol=1e-12)
    np.testing.assert_allclose(found[2:], exact[2:], rtol=5e-4)
    # The control: without what random signs find, they would be farther off.
    rest = dense - np.diag(np.diag(dense))
    assert np.sum((rest @ rest) ** 2) > 1e-3 * exact[3]
