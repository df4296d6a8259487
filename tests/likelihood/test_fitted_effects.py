"""Effects beside a compressed likelihood."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import logsumexp

from starcal_uq.likelihood.fitted_effects import _log_sum_exp


@pytest.mark.parametrize("n", [1, 4, 17])
@pytest.mark.parametrize("spread", [0.1, 30.0, 800.0])
def test_sums_over_nodes_are_those_of_scipy_to_the_bit(n: int, spread: float) -> None:
    values = np.random.default_rng(n).normal(0.0, spread, (n, 500))
    values[:, :10] = values[0, :10]
    values[:, 20:25], values[0, 25:30], values[0, 30] = -np.inf, np.inf, np.nan
    found = _log_sum_exp(values)
    assert np.array_equal(found, logsumexp(values, axis=0), equal_nan=True)
    assert np.isfinite(found).sum() == 489
