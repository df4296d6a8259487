"""What totals depend on, beside budgets of other data and hand calculations."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.budgeting.sensitivity import sensitivities
from starcal_uq.core.errors import BudgetError

FILE = """
[budget]
frame_seconds = 0.2

[[contributor]]
name = "thermo-elastic distortion"
axis = "all"
sigma_arcsec = 0.3
period_seconds = 5880.0
provenance = "test"

[[index]]
kind = "RKE"
window_seconds = 300.0
"""


@lru_cache
def made(n_frames: int = 60, sigma_px: float = 0.05, max_stars: int = 12) -> tuple[Any, Any, Any]:
    """Budget, posterior and frames of a simulated calibration; every frame has as many stars."""
    truth = sc.paper.paper_camera()
    sky = sc.load_catalogue(max_mag=6.5, epoch=2026.9)
    obs = sc.simulate(
        sky,
        truth,
        n_frames=n_frames,
        min_stars=max_stars,
        max_stars=max_stars,
        sigma_px=sigma_px,
        seed=3,
    )
    cal = sc.calibrate(obs, sc.paper.paper_start())
    post = sc.sample(obs, cal, n_steps=150, seed=1)
    attitude = sc.propagate(post, obs, n_draws=50, seed=1)
    return sc.budget(post, obs, attitude, n_samples=10_000), post, obs


def with_file(tmp_path: Path) -> tuple[Any, Path]:
    path = tmp_path / "budget.toml"
    path.write_text(FILE)
    _, post, obs = made()
    attitude = sc.propagate(post, obs, n_draws=50, seed=1)
    return sc.budget(post, obs, attitude, file=path, n_samples=10_000), path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "changed", "factor"),
    [
        ("frames", {"n_frames": 240}, 4.0),
        ("noise", {"sigma_px": 0.1}, 2.0),
        ("stars", {"max_stars": 18}, 1.5),
    ],
)
def test_elasticities_are_those_of_other_calibrations(
    name: str, changed: dict[str, Any], factor: float
) -> None:
    """From one budget to another, totals change by the mean elasticity of both."""
    one, other = made(), made(**changed)
    for scope in ("before alignment", "after alignment"):
        axes = ("pitch", "yaw") if scope == "before alignment" else ("pitch", "yaw", "roll")
        for axis in axes:
            found = [sensitivities(*each).of(name, axis, scope).elasticity for each in (one, other)]
            totals = [each[0].total(axis, scope).sigma_arcsec for each in (one, other)]
            measured = np.log(totals[1] / totals[0]) / np.log(factor)
            # The geometry of other frames differs by some per cent.
            assert np.mean(found) == pytest.approx(measured, abs=0.12)


def test_noise_after_alignment_is_all_of_a_bare_budget() -> None:
    found = sensitivities(*made())
    assert found.of("noise", "pitch").elasticity == pytest.approx(1.0, abs=0.01)
    assert found.of("frames", "pitch", "before alignment").elasticity == pytest.approx(
        -0.5, abs=0.02
    )
    # Control: centroid noise, which is what is left after alignment, knows no number of frames.
    assert abs(found.of("frames", "pitch").elasticity) < 0.02
    entry = found.of("noise", "pitch")
    total = made()[0].total("pitch")
    assert entry.per_unit_arcsec == pytest.approx(total.rule_arcsec / 0.05, rel=0.05)


def test_shares_of_parameters_are_those_of_their_covariance() -> None:
    budget, post, obs = made()
    found = sensitivities(budget, post, obs)
    names = post.camera_names
    response = post.rotation_per_theta[0]
    moved = post.covariance @ response
    wanted = response * moved / (response @ moved)
    common = budget.total("pitch", "before alignment").sigma_arcsec
    row = next(r for r in budget.rows if r.name == "calibration, common rotation")
    share = (row.sigma_arcsec / common) ** 2
    own = [found.of(name, "pitch", "before alignment").elasticity for name in names]
    assert own == pytest.approx(share * wanted, abs=0.02)
    assert sum(own) == pytest.approx(share, abs=0.02)
    # The error of one unit is that of the propagation's table.
    other = sc.propagation.sensitivities(post.calibrated_camera, obs)
    assert found.of("x0", "yaw", "before alignment").error_per_unit_arcsec == pytest.approx(
        other.error_arcsec("x0", "yaw")
    )


def test_temperature_and_windows(tmp_path: Path) -> None:
    budget, path = with_file(tmp_path)
    _, post, obs = made()
    found = sensitivities(budget, post, obs, file=path, temperature_k=5.0)
    total = budget.total("pitch").sigma_arcsec
    entry = found.of("temperature", "pitch")
    assert entry.elasticity == pytest.approx((0.3 / total) ** 2, rel=1e-4)
    assert entry.per_unit_arcsec == pytest.approx(
        budget.total("pitch").factor * total * entry.elasticity / 5.0, rel=1e-4
    )
    # Within a window of 300 s, little of an orbit's oscillation is left.
    assert found.of("temperature", "pitch", index="RKE 300 s").elasticity < 0.2 * entry.elasticity
    assert len(found.to_dataframe()) == len(found.table)
    with pytest.raises(BudgetError, match="RKE 300 s rest on how rows behave in time"):
        sensitivities(budget, post, obs)


def test_sobol_shares_are_those_of_an_integral(tmp_path: Path) -> None:
    budget, path = with_file(tmp_path)
    _, post, obs = made()
    vary = {"noise": 0.3, "stars": 0.3, "temperature": 0.5}
    found = sensitivities(budget, post, obs, file=path, vary=vary, seed=2)
    rows = {r.name: r.sigma_arcsec for r in budget.rows if r.axis == "pitch" and r.assessed}
    white = rows["centroid noise (NEA)"] ** 2 + rows["alignment calibration in flight"] ** 2
    node, weight = np.polynomial.legendre.leggauss(24)
    a, b, t = (1.0 + width * node for width in vary.values())
    w = 0.5 * weight
    grid = np.sqrt(
        white * a[:, None, None] ** 2 / b[None, :, None]
        + rows["thermo-elastic distortion"] ** 2 * t[None, None, :] ** 2
    )
    mean = np.einsum("ijk,i,j,k", grid, w, w, w)
    variance = np.einsum("ijk,i,j,k", grid**2, w, w, w) - mean**2
    for place, name in enumerate(vary):
        given = np.moveaxis(grid, place, 0).reshape(24, -1) @ np.outer(w, w).ravel()
        share = (np.sum(w * given**2) - mean**2) / variance
        entry = found.of(name, "pitch")
        assert entry.first_order == pytest.approx(share, abs=0.06)
        assert entry.total_order >= entry.first_order - 0.06
    assert np.isnan(found.of("frames", "pitch").first_order)
    # Control: a temperature that hardly varies has no share.
    calm = sensitivities(budget, post, obs, file=path, vary=vary | {"temperature": 0.01})
    assert (
        calm.of("temperature", "pitch").first_order
        < 0.05
        < found.of("temperature", "pitch").first_order
    )


def test_wrong_inputs_are_refused() -> None:
    with pytest.raises(BudgetError, match="an input"):
        sensitivities(*made(), vary={"colour": 0.1})
    with pytest.raises(BudgetError, match=r"noise is 2\.0; give a share below 1"):
        sensitivities(*made(), vary={"noise": 2.0})
