"""Numbers of chains and weights are those of the installed ArviZ, and right where the truth is known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from starcal_uq.inference.arviz import is_legacy
from starcal_uq.maths.draws import chain_statistics, psis, psis_rows


def arviz() -> Any:
    """ArviZ 0.23, or the array interface of 1.x, of the same names."""
    if is_legacy():
        import arviz as legacy

        return legacy
    from arviz_stats.base import array_stats

    return array_stats


@pytest.mark.parametrize("shape", [(4, 1000), (3, 37), (2, 9)])
@pytest.mark.parametrize("memory", [0.0, 0.9, -0.6])
def test_chains_as_in_arviz(shape: tuple[int, int], memory: float) -> None:
    draws = np.random.default_rng(3).standard_normal(shape)
    for i in range(1, shape[1]):
        draws[:, i] += memory * draws[:, i - 1]
    # Rejected proposals repeat a draw.
    draws[:, 1::3] = draws[:, : shape[1] - 1 : 3]
    found, stats = chain_statistics(draws), arviz()
    assert found.rhat == pytest.approx(float(stats.rhat(draws)), rel=1e-12)
    assert found.ess_bulk == pytest.approx(float(stats.ess(draws, method="bulk")), rel=1e-10)
    assert found.ess_tail == pytest.approx(float(stats.ess(draws, method="tail", prob=(0.05, 0.95))), rel=1e-10)
    assert found.mcse_mean == pytest.approx(float(stats.mcse(draws, method="mean")), rel=1e-10)


def test_chains_of_tiny_numbers_as_of_large_ones() -> None:
    draws = np.random.default_rng(4).standard_normal((4, 500)).cumsum(axis=1)
    large, small = chain_statistics(draws), chain_statistics(1e-18 * draws)
    assert small.ess_bulk == pytest.approx(large.ess_bulk)
    assert small.mcse_mean == pytest.approx(1e-18 * large.mcse_mean)
    # ArviZ takes a range below 1e-15 for a constant and calls every draw independent.
    assert float(arviz().mcse(1e-18 * draws, method="mean")) < 0.2 * small.mcse_mean


@pytest.mark.parametrize("n", [60, 400])
@pytest.mark.parametrize("k", [-0.5, 0.4, 2.0, 20.0])
def test_weights_as_in_arviz(n: int, k: float) -> None:
    # Numbers whose tail has one length in 0.23, which rounds it up, and in 1.x, which rounds it down.
    log_weights = k * np.random.default_rng(5).exponential(size=(40, n))
    log_weights[::4, 1] = -np.inf
    smoothed, khat = psis_rows(log_weights)
    for row, ours, shape in zip(log_weights, smoothed, khat, strict=True):
        with np.errstate(over="ignore"):
            theirs, theirs_shape = arviz().psislw(row.copy()) if is_legacy() else arviz().psislw(-row)
        assert shape == pytest.approx(float(theirs_shape), abs=1e-11)
        assert np.allclose(np.exp(ours), np.exp(theirs), rtol=1e-9, atol=1e-15)


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
    assert chain_statistics(draws).rhat < 1.01
    assert chain_statistics(draws).ess_bulk == pytest.approx(8000, rel=0.1)
    assert chain_statistics(draws).ess_tail == pytest.approx(8000, rel=0.15)
    assert chain_statistics(draws).mcse_mean == pytest.approx(1 / np.sqrt(8000), rel=0.1)


def test_correlated_draws_are_counted_as_fewer() -> None:
    rng = np.random.default_rng(6)
    noise = rng.standard_normal((4, 20_000))
    draws = np.empty_like(noise)
    draws[:, 0] = noise[:, 0]
    for i in range(1, draws.shape[1]):
        draws[:, i] = 0.8 * draws[:, i - 1] + 0.6 * noise[:, i]
    # An AR(1) process with coefficient a has (1 - a) / (1 + a) independent draws per draw.
    assert chain_statistics(draws).ess_bulk == pytest.approx(80_000 / 9, rel=0.15)


def test_chains_that_disagree_are_caught() -> None:
    draws = np.random.default_rng(7).standard_normal((4, 1000)) + np.array([[0.0], [0.0], [0.0], [0.5]])
    assert chain_statistics(draws).rhat > 1.01
