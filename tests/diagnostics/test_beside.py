"""Tests of the model beside effects."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy import stats

import starcal_uq as sc
from starcal_uq.diagnostics.beside import Freed, normals_beside, without_effects
from starcal_uq.diagnostics.misfit import ALPHA, Misfit, misfit_tests
from starcal_uq.estimation.normals import FrameNormals
from starcal_uq.likelihood.shapes import FRAME_BY_FRAME
from tests.helpers.effects import breathing, bump, sheet, smooth, table, together
from tests.helpers.outside import Displacement, campaign

N_CAMPAIGNS = 30


@lru_cache(maxsize=1)
def planted() -> tuple[sc.Observations, dict[str, sc.Calibration]]:
    """One campaign with a bent field and frames that breathe, and calibrations of it."""
    rng = np.random.default_rng(12)
    c = campaign(rng, n_frames=12, displaced=together(bump(0.5), breathing(rng, 12, 0.2)))
    obs = table(c)
    wanted = ("none", "auto", "field")
    return obs, {effects: sc.calibrate(obs, sheet(c), effects=effects) for effects in wanted}


def test_what_effects_hold_is_found_no_longer() -> None:
    obs, cals = planted()
    found = {effects: misfit_tests(obs, cal) for effects, cal in cals.items()}
    assert found["auto"].found() == ()
    assert FRAME_BY_FRAME not in [test.name for test in found["auto"].tests]
    assert found["auto"].sigma == pytest.approx(0.05, rel=0.1)
    # Control: without effects tests of the field and of the frames reject, and beside the field
    # alone that of the frames still does.
    rejected = {test.name for test in found["none"].found()}
    assert FRAME_BY_FRAME in rejected
    assert any(name.startswith("smooth pattern") for name in rejected)
    assert found["field"].found()[0].name == FRAME_BY_FRAME


def test_noise_is_looked_at_where_effects_are_free() -> None:
    """What is left does not know how large the effects were."""
    obs, cals = planted()
    cal = cals["auto"]
    free = Freed.of(obs, cal)
    shifted = replace(obs, x_px=obs.x_px + 1e-4 * (obs.x_px / 1024.0) ** 2)
    again = Freed.of(shifted, cal)
    np.testing.assert_allclose(again.e, free.e, atol=1e-6)
    dof = free.frame_dof.sum() - len(free.h)
    scatter = float(np.sqrt(np.sum(free.e**2) / dof))
    assert scatter == pytest.approx(0.05, rel=4.0 / np.sqrt(2.0 * dof))
    # Control: a shift of as much that no effect holds shows in full.
    rough = replace(obs, x_px=obs.x_px + 1e-4 * np.sin(7.0 * obs.x_px))
    assert np.abs(Freed.of(rough, cal).e - free.e).max() > 5e-5


def test_images_without_effects_have_the_same_optimum() -> None:
    obs, cals = planted()
    cal = cals["auto"]
    clean = FrameNormals.at(without_effects(obs, cal), cal)
    step = np.linalg.solve(clean.matrix, clean.slopes.sum(axis=0)) * clean.scale
    assert np.abs(step / cal.sigmas).max() < 0.02
    # Control: the images as they are lead elsewhere.
    plain = FrameNormals.at(obs, cal)
    step = np.linalg.solve(plain.matrix, plain.slopes.sum(axis=0)) * plain.scale
    assert np.abs(step / cal.sigmas).max() > 0.5
    assert without_effects(obs, cals["none"]) is obs


def test_frames_say_as_much_as_their_effects_leave() -> None:
    obs, cals = planted()
    beside, plain = normals_beside(obs, cals["auto"]), FrameNormals.at(obs, cals["auto"])
    unit = np.outer(beside.scale, beside.scale)
    said = beside.matrix / unit
    assert np.all(np.diag(said) < np.diag(plain.matrix / np.outer(plain.scale, plain.scale)))
    # What the field takes of the noise is not given back.
    assert 0.7 < beside.variance / 0.05**2 < 1.1
    ratio = sc.diagnostics.jackknife_frames(obs, cals["auto"]).ratio
    assert np.all((ratio > 0.5) & (ratio < 1.6))


def _campaigns(displaced: bool, effects: str, n: int = N_CAMPAIGNS) -> list[Misfit]:
    found = []
    for seed in range(n):
        rng = np.random.default_rng(5000 + seed)
        shifts: Displacement | None = None
        if displaced:
            shifts = together(smooth(rng, 0.4), breathing(rng, 30, 0.2))
        c = campaign(rng, n_frames=30, displaced=shifts)
        obs = table(c)
        found.append(misfit_tests(obs, sc.calibrate(obs, sheet(c), effects=effects)))
    return found


def _p_values(found: list[Misfit]) -> dict[str, np.ndarray]:
    """Those of the tests that most campaigns allow."""
    p: dict[str, list[float]] = {}
    for one in found:
        for test in one.tests:
            p.setdefault(test.name, []).append(test.p_value)
    return {name: np.array(values) for name, values in p.items() if len(values) > 0.8 * len(found)}


@pytest.mark.slow
def test_false_alarms_are_nominal_beside_effects_of_their_prior() -> None:
    found = _campaigns(True, "auto")
    alarms = sum(bool(one.found()) for one in found)
    print("alarms of all tests together", alarms, "of", len(found))
    # 1 % on average: more than 2 of 30 has a probability of 3e-3.
    assert alarms <= 2
    p_values = _p_values(found)
    assert len(p_values) >= 12
    for name, p in p_values.items():
        uniform = stats.kstest(p, "uniform").pvalue
        print(f"{name:56s} KS {uniform:.3f}, below 5 %: {np.mean(p < 0.05):.3f}")
        assert uniform > 1e-3, name
    # Control: without effects hardly a campaign passes.
    rejected = [bool(one.found(ALPHA)) for one in _campaigns(True, "none", 10)]
    assert np.mean(rejected) > 0.9


@pytest.mark.slow
def test_effects_that_clean_data_do_not_need_raise_no_alarm() -> None:
    found = _campaigns(False, "field,frame")
    assert sum(bool(one.found()) for one in found) <= 2
    for name, p in _p_values(found).items():
        above, below = (
            stats.kstest(p, "uniform", alternative=side).pvalue for side in ("less", "greater")
        )
        print(f"{name:56s} KS above {above:.3f}, below {below:.3f}, 5 %: {np.mean(p < 0.05):.3f}")
        # Scales that the data give to nothing take a little of what a test looks for: it errs to
        # the safe side.
        assert below > 1e-3, name
        if name.startswith(("noise", "error with the pixel phase", "shift and scale")):
            assert above > 1e-3, name
