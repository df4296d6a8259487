"""The moves leave the target as it is, and the order of draws lets R-hat see what it should."""

from typing import Any

import numpy as np
import pytest

from starcal_uq.inference import arviz as arviz_compat
from starcal_uq.inference.checks import chain_order, step_order
from starcal_uq.inference.ensemble import (
    EnsembleSettings,
    make_moves,
    run_ensembles,
    student_t_proposal,
)


def _variance_z(moves: list[tuple[Any, float]] | None) -> float:
    """Largest deviation of a variance from one in Monte Carlo errors, on a standard normal
    target.
    """
    seeds = np.random.SeedSequence(11).spawn(4)
    settings = EnsembleSettings(40, 150, 50, "mixture")
    chains = run_ensembles(lambda u: -0.5 * np.sum(u * u, axis=1), 5, seeds, settings, moves=moves)
    squares = chain_order(chains.u) ** 2
    z = [(squares[..., i].mean() - 1.0) / arviz_compat.mcse_mean(squares[..., i]) for i in range(5)]
    return float(np.max(np.abs(z)))


@pytest.mark.slow
def test_variance_is_right_and_the_test_can_tell() -> None:
    import emcee

    assert _variance_z(None) < 4.0
    # Negative control: this move of emcee 3.1 is biased, to 0.7 of the variance.
    assert _variance_z([(emcee.moves.DESnookerMove(), 1.0)]) > 6.0


def test_independence_proposal_needs_its_hastings_factor() -> None:
    import emcee

    def density(u: np.ndarray) -> np.ndarray:
        # Wider than the proposal, so that leaving out the factor would show.
        return -0.5 * np.sum(u * u, axis=1) / 1.5**2

    def without_factor(u: np.ndarray, random: Any) -> tuple[np.ndarray, np.ndarray]:
        new, factor = student_t_proposal(8.0)(u, random)
        return new, np.zeros_like(factor)

    seeds, settings = np.random.SeedSequence(2).spawn(2), EnsembleSettings(64, 400, 50, "mixture")
    variances = [
        run_ensembles(density, 3, seeds, settings, moves=moves).u.var(axis=(0, 1, 2))
        for moves in (make_moves("mixture"), [(emcee.moves.MHMove(without_factor), 1.0)])
    ]
    assert np.all(np.abs(variances[0] / 1.5**2 - 1.0) < 0.08)
    assert np.all(np.abs(variances[1] / 1.5**2 - 1.0) > 0.2)


def test_chain_order_and_back() -> None:
    values = np.arange(2 * 6 * 3 * 2).reshape(2, 6, 3, 2).astype(float)
    ordered = chain_order(values)
    assert np.array_equal(step_order(ordered, 6, 3), values)
    # First half in time first; then by walker; then by step.
    assert np.array_equal(ordered[0, :3], values[0, :3, 0])
    assert np.array_equal(ordered[0, 3:6], values[0, :3, 1])
    assert np.array_equal(ordered[0, 9:12], values[0, 3:, 0])


def test_split_rhat_sees_a_drift_in_time() -> None:
    rng = np.random.default_rng(1)
    steps = rng.standard_normal((4, 200, 16))
    assert arviz_compat.rhat(chain_order(steps)) < 1.01
    drifting = steps + np.linspace(-0.5, 0.5, 200)[:, None]
    assert arviz_compat.rhat(chain_order(drifting)) > 1.01
