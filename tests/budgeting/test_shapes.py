"""Shapes of errors: deviates, half-widths, quantiles on two axes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from starcal_uq.budgeting.rows import DISTRIBUTIONS, GAUSSIAN_997
from starcal_uq.budgeting.shapes import (
    deviates,
    half_width,
    mixture_spread,
    one_axis_factor,
    two_axis_radius,
)


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_deviates_have_unit_moments_and_the_stated_half_width(name: str) -> None:
    rng = np.random.default_rng(2)
    sampled = deviates(name, rng.random(400_000), rng.standard_normal(400_000), GAUSSIAN_997)
    if name == "constant":
        assert not sampled.any()
        return
    assert sampled.mean() == pytest.approx(0.0, abs=0.01)
    assert sampled.std() == pytest.approx(1.0, abs=0.005)
    reference = {
        "gaussian": stats.norm(),
        "uniform": stats.uniform(-math.sqrt(3.0), 2.0 * math.sqrt(3.0)),
        "arcsine": stats.arcsine(-math.sqrt(2.0), 2.0 * math.sqrt(2.0)),
        "rayleigh": stats.rayleigh(
            -stats.rayleigh.mean() / stats.rayleigh.std(), 1.0 / stats.rayleigh.std()
        ),
    }
    assert stats.kstest(sampled[:20_000], reference[name].cdf).pvalue > 1e-3
    # Negative control: another shape of the same moments is told apart.
    other = "uniform" if name != "uniform" else "gaussian"
    assert stats.kstest(sampled[:20_000], reference[other].cdf).pvalue < 1e-6
    if name in ("uniform", "arcsine"):
        assert np.abs(sampled).max() <= half_width(name, 0.997) + 1e-12
    elif name == "gaussian":
        assert np.mean(np.abs(sampled) < half_width(name, 0.997)) == pytest.approx(0.997, abs=5e-4)


@pytest.mark.parametrize("tail", [2.5, 3.2, 4.55])
def test_a_sigma_that_varies_keeps_variance_and_reaches_the_stated_tail(tail: float) -> None:
    rng = np.random.default_rng(4)
    sampled = deviates("gaussian", rng.random(1_000_000), rng.standard_normal(1_000_000), tail)
    assert sampled.std() == pytest.approx(1.0, abs=0.006)
    reached = max(tail, GAUSSIAN_997)
    assert np.mean(np.abs(sampled) > reached) == pytest.approx(0.003, abs=3e-4)
    assert half_width("gaussian", 0.997, tail) == pytest.approx(reached, rel=1e-6)
    plane = np.exp(
        mixture_spread(tail) * rng.standard_normal(1_000_000) - mixture_spread(tail) ** 2
    )
    size = plane * np.hypot(rng.standard_normal(1_000_000), rng.standard_normal(1_000_000))
    radius = two_axis_radius(0.997, 1.0, 1.0, mixture_spread(tail))
    assert np.mean(size > radius) == pytest.approx(0.003, abs=3e-4)


def test_a_tail_beyond_all_mixtures_is_cut_and_finite() -> None:
    assert math.isfinite(half_width("gaussian", 0.997, 50.0))


@pytest.mark.parametrize("confidence", [0.9999999, 1.0 - 1e-12])
def test_quantiles_of_the_heaviest_tails_are_found(confidence: float) -> None:
    assert one_axis_factor(confidence) == pytest.approx(
        stats.norm.isf(0.5 * (1.0 - confidence)), rel=1e-12
    )
    spread = mixture_spread(50.0)
    reach = half_width("gaussian", confidence, 50.0)
    assert math.isfinite(reach) and two_axis_radius(confidence, 1.0, 1.0, spread) >= reach
