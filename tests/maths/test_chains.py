"""Convergence of chains and smoothed weights: known answers, and those of ArviZ."""

from __future__ import annotations

import numpy as np
import pytest
from arviz_stats.base import array_stats

from starcal_uq.maths.chains import convergence, psis


@pytest.mark.parametrize("k", [0.3, 0.9])
def test_psis_finds_the_shape_of_a_pareto_tail(k: float) -> None:
    # exp(k x) with x exponential is Pareto of shape k exactly.
    log_weights = k * np.random.default_rng(1).exponential(size=20_000)
    khat = psis(log_weights)[1]
    assert khat == pytest.approx(k, abs=0.12)


def test_psis_has_the_right_sign() -> None:
    # Bounded weights are harmless; their reciprocals are not. A flipped sign swaps the two.
    log_weights = -0.9 * np.random.default_rng(2).exponential(size=20_000)
    assert psis(log_weights)[1] < 0.3
    assert psis(-log_weights)[1] > 0.7


def test_psis_weights_estimate_a_mean() -> None:
    # Proposal N(0, 1.3^2), target N(0.3, 1).
    x = 1.3 * np.random.default_rng(3).standard_normal(50_000)
    log_weights, khat = psis(-0.5 * (x - 0.3) ** 2 + 0.5 * (x / 1.3) ** 2)
    weights = np.exp(log_weights)
    assert np.sum(weights) == pytest.approx(1.0)
    assert khat < 0.5
    assert weights @ x == pytest.approx(0.3, abs=0.02)
    assert weights @ (x - 0.3) ** 2 == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("shift", [0.0, -1e5])
def test_equal_weights_are_no_failure(shift: float) -> None:
    log_weights, khat = psis(np.full(300, shift))
    assert khat == 0.0
    assert np.allclose(np.exp(log_weights), 1 / 300)


def test_rows_are_smoothed_one_by_one() -> None:
    rows = np.random.default_rng(9).exponential(size=(4, 2000)) * np.array([[0.1], [0.4], [0.8], [0.0]])
    together, khats = psis(rows)
    apart = [psis(row) for row in rows]
    assert np.array_equal(together, [weights for weights, _ in apart])
    assert khats.tolist() == [khat for _, khat in apart]
    assert khats[3] == 0.0


def test_psis_accepts_zero_weights_and_leaves_its_input_alone() -> None:
    given = np.random.default_rng(4).standard_normal(1000)
    given[:10] = -np.inf
    before = given.copy()
    log_weights, khat = psis(given)
    assert np.all(np.exp(log_weights[:10]) == 0.0)
    assert np.isfinite(khat)
    assert np.array_equal(given, before)


def test_independent_draws_have_full_effective_size() -> None:
    draws = np.random.default_rng(5).standard_normal((4, 2000))
    found = convergence(draws)
    assert found.rhat < 1.01
    assert found.ess_bulk == pytest.approx(8000, rel=0.1)
    assert found.ess_tail == pytest.approx(8000, rel=0.15)
    assert found.mcse == pytest.approx(1 / np.sqrt(8000), rel=0.1)


def test_correlated_draws_are_counted_as_fewer() -> None:
    rng = np.random.default_rng(6)
    noise = rng.standard_normal((4, 20_000))
    draws = np.empty_like(noise)
    draws[:, 0] = noise[:, 0]
    for i in range(1, draws.shape[1]):
        draws[:, i] = 0.8 * draws[:, i - 1] + 0.6 * noise[:, i]
    # An AR(1) process with coefficient a has (1 - a) / (1 + a) independent draws per draw.
    assert convergence(draws).ess_bulk == pytest.approx(80_000 / 9, rel=0.15)


def test_chains_that_disagree_are_caught() -> None:
    draws = np.random.default_rng(7).standard_normal((4, 1000)) + np.array([[0.0], [0.0], [0.0], [0.5]])
    assert convergence(draws).rhat > 1.01


@pytest.mark.parametrize(
    ("chains", "n", "memory"), [(4, 1000, 0.0), (4, 999, 0.9), (2, 7, 0.0), (1, 4, 0.0), (4, 300, -0.7)]
)
def test_the_numbers_are_those_of_arviz(chains: int, n: int, memory: float) -> None:
    rng = np.random.default_rng(n)
    draws = rng.standard_normal((chains, n))
    for i in range(1, n):
        draws[:, i] += memory * draws[:, i - 1]
    # Proposals that were refused.
    draws[:, n // 2 : n // 2 + n // 10] = draws[:, n // 2 : n // 2 + 1]
    found = convergence(draws)
    if chains > 1:
        assert found.rhat == pytest.approx(float(array_stats.rhat(draws)), rel=1e-12)
    assert found.ess_bulk == pytest.approx(float(array_stats.ess(draws, method="bulk")), rel=1e-12)
    assert found.ess_tail == pytest.approx(float(array_stats.ess(draws, method="tail", prob=(0.05, 0.95))), rel=1e-12)
    assert found.mcse == pytest.approx(float(array_stats.mcse(draws, method="mean")), rel=1e-12)
    log_weights = 0.7 * rng.exponential(size=(2, 30 * n))
    for ours, theirs in zip(psis(log_weights), array_stats.psislw(-log_weights), strict=True):
        assert ours == pytest.approx(theirs, abs=1e-12)


def test_what_cannot_be_told_is_nan() -> None:
    draws = np.random.default_rng(8).standard_normal((4, 50))
    assert np.isnan(convergence(draws[:1]).rhat)
    assert np.isfinite(convergence(draws[:1]).ess_bulk)
    draws[2, 7] = np.nan
    assert np.isnan([convergence(draws).rhat, convergence(draws).ess_tail, convergence(draws[:, :3]).mcse]).all()


def test_tails_are_those_of_five_per_cent() -> None:
    # A chain that sticks below its 7 % quantile: tails of ten per cent would not tell.
    rng = np.random.default_rng(5)
    draws = rng.standard_normal((4, 1000))
    draws[:, :40] = -3.0
    found = convergence(draws).ess_tail

    def ess(share: float) -> float:
        """Of the indicator of a quantile, by its own words (Vehtari et al. 2021)."""
        return float(array_stats.ess((draws <= np.quantile(draws, share)).astype(float), method="mean"))

    assert found == pytest.approx(min(ess(0.05), ess(0.95)), rel=0.05)
    assert found < 0.8 * min(ess(0.1), ess(0.9))
