"""Both generations of ArviZ give the same answers through the compatibility module."""

import numpy as np
import pytest
import xarray as xr

from starcal_uq.inference import arviz as arviz_compat


@pytest.mark.parametrize("k", [0.3, 0.9])
def test_psis_finds_the_shape_of_a_pareto_tail(k: float) -> None:
    # exp(k x) with x exponential is Pareto of shape k exactly.
    log_weights = k * np.random.default_rng(1).exponential(size=20_000)
    khat = arviz_compat.psis(log_weights)[1]
    assert khat == pytest.approx(k, abs=0.12)
    # Their reciprocals are bounded, and harmless: a flipped sign swaps the two.
    assert arviz_compat.psis(-log_weights)[1] < 0.3


def test_psis_weights_estimate_a_mean() -> None:
    # Proposal N(0, 1.3^2), target N(0.3, 1).
    x = 1.3 * np.random.default_rng(3).standard_normal(50_000)
    log_weights, khat = arviz_compat.psis(-0.5 * (x - 0.3) ** 2 + 0.5 * (x / 1.3) ** 2)
    weights = np.exp(log_weights)
    assert np.sum(weights) == pytest.approx(1.0)
    assert khat < 0.5
    assert weights @ x == pytest.approx(0.3, abs=0.02)
    assert weights @ (x - 0.3) ** 2 == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("shift", [0.0, -1e5])
def test_equal_weights_are_no_failure(shift: float) -> None:
    log_weights, khat = arviz_compat.psis(np.full(300, shift))
    assert khat == 0.0
    assert np.allclose(np.exp(log_weights), 1 / 300)


def test_rows_are_smoothed_one_by_one() -> None:
    rows = np.random.default_rng(9).exponential(size=(4, 2000)) * np.array(
        [[0.1], [0.4], [0.8], [0.0]]
    )
    together, khats = arviz_compat.psis(rows)
    apart = [arviz_compat.psis(row) for row in rows]
    assert np.array_equal(together, [weights for weights, _ in apart])
    assert khats.tolist() == [khat for _, khat in apart]
    assert khats[3] == 0.0


def test_psis_accepts_zero_weights_and_leaves_its_input_alone() -> None:
    given = np.random.default_rng(4).standard_normal(1000)
    given[:10] = -np.inf
    before = given.copy()
    log_weights, khat = arviz_compat.psis(given)
    assert np.all(np.exp(log_weights[:10]) == 0.0)
    assert np.isfinite(khat)
    assert np.array_equal(given, before)


def test_independent_draws_have_full_effective_size() -> None:
    draws = np.random.default_rng(5).standard_normal((4, 2000))
    assert arviz_compat.rhat(draws) < 1.01
    assert arviz_compat.ess_bulk(draws) == pytest.approx(8000, rel=0.1)
    assert arviz_compat.ess_tail(draws) == pytest.approx(8000, rel=0.15)
    assert arviz_compat.mcse_mean(draws) == pytest.approx(1 / np.sqrt(8000), rel=0.1)


def test_correlated_draws_are_counted_as_fewer() -> None:
    rng = np.random.default_rng(6)
    noise = rng.standard_normal((4, 20_000))
    draws = np.empty_like(noise)
    draws[:, 0] = noise[:, 0]
    for i in range(1, draws.shape[1]):
        draws[:, i] = 0.8 * draws[:, i - 1] + 0.6 * noise[:, i]
    # An AR(1) process with coefficient a has (1 - a) / (1 + a) independent draws per draw.
    assert arviz_compat.ess_bulk(draws) == pytest.approx(80_000 / 9, rel=0.15)


def test_chains_that_disagree_are_caught() -> None:
    draws = np.random.default_rng(7).standard_normal((4, 1000)) + np.array(
        [[0.0], [0.0], [0.0], [0.5]]
    )
    assert arviz_compat.rhat(draws) > 1.01


def test_container_holds_the_groups() -> None:
    dataset = xr.Dataset(
        {"f": (("chain", "draw"), np.zeros((2, 3)), {"units": "px"})}, attrs={"made_by": "test"}
    )
    data = arviz_compat.to_arviz({"posterior": dataset})
    import arviz

    # By its own version, not by what the module under test says.
    assert type(data) is (
        arviz.InferenceData if arviz.__version__.startswith("0.") else xr.DataTree
    )
    assert data.posterior["f"].shape == (2, 3)
    assert data.posterior["f"].attrs["units"] == "px"
    assert data.posterior.attrs["made_by"] == "test"


def test_tails_are_those_of_five_per_cent() -> None:
    # A chain that sticks below its 7 % quantile: tails of ten per cent would not tell.
    rng = np.random.default_rng(5)
    draws = rng.standard_normal((4, 1000))
    draws[:, :40] = -3.0
    found = arviz_compat.ess_tail(draws)

    def ess(share: float) -> float:
        """Of the indicator of a quantile, by its own words (Vehtari et al. 2021)."""
        return arviz_compat._diagnostic(
            "ess", (draws <= np.quantile(draws, share)).astype(float), method="mean"
        )

    assert found == pytest.approx(min(ess(0.05), ess(0.95)), rel=0.05)
    assert found < 0.8 * min(ess(0.1), ess(0.9))


@pytest.mark.parametrize(("equal", "fitted"), [(51, False), (50, True)])
def test_a_tail_of_equal_weights_has_no_shape(equal: int, fitted: bool) -> None:
    """Of 300 weights the 51 largest are the tail."""
    low = np.random.default_rng(1).uniform(-3.0, -1.0, 300 - equal)
    weights, khat = arviz_compat.psis(np.append(low, np.zeros(equal)))
    assert (khat != 0.0) == fitted
    assert np.exp(weights).sum() == pytest.approx(1.0, rel=1e-12)
