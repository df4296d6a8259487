"""Simulated cells: do estimates scatter and intervals cover as a study says, and does it show where
they do not?
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom

import starcal_uq as sc
from starcal_uq.paper import paper_camera
from starcal_uq.sky.positions import ra_dec_deg
from starcal_uq.studies import Study, StudyDefinition
from tests.helpers.outside import campaign

ROOT = Path(__file__).resolve().parents[2]


def definition(**changes: object) -> StudyDefinition:
    usual: dict[str, object] = {"camera": paper_camera(), "mode": "simulate", "seed": 1}
    return StudyDefinition(**{**usual, **changes})  # type: ignore[arg-type]


def test_a_simulated_cell_is_a_calibration_and_its_posterior() -> None:
    made = definition(
        sweep={"likelihood": ("marginal", "pairs"), "prior": ("flat", "ground")},
        observation={"frames": 20, "min_stars": 10},
        priors={"ground": {"focal_fraction": 1e-5}},
    )
    found = sc.study(made, workers=0)
    assert found.ok.all(), found.problems
    data = found.data
    np.testing.assert_allclose(data["sigma"][0], data["sigma_predicted"][0], rtol=0.15)
    # Likelihood and prior come after the frames: the data, and what does not depend on either, are
    # the same.
    np.testing.assert_array_equal(data["estimate"][0], data["estimate"][2])
    np.testing.assert_array_equal(data["sigma_data"][0], data["sigma_data"][3])
    sigma_f = data["sigma"].sel(parameter="f").values
    assert sigma_f[1] < 0.06 < 0.1 < sigma_f[0]
    # A covariance of pairs is larger than the bound that the efficient one reaches.
    ratio = (data["posterior_sigma"] / data["sigma"]).values
    np.testing.assert_allclose(ratio[:2], 1.0, atol=0.12)
    assert np.all(ratio[2] > 1.05)
    assert np.all(data["khat"] < 0.7)
    again = sc.study(made, workers=0).data
    same = [name for name in data.data_vars if name != "seconds"]
    assert again[same].equals(data[same])


def test_what_a_method_does_not_estimate_has_no_numbers() -> None:
    sweep = {"method": ("griffith", "efficient"), "noise_per_mag": (0.0, 0.2)}
    found = sc.study(
        definition(sweep=sweep, observation={"frames": 12, "min_stars": 10}, posterior="none"),
        workers=0,
    )
    assert found.ok.all(), found.problems
    missing = np.isnan(found.data["sigma"].values)
    assert missing[:2, 3:].all() and not missing[:2, :3].any() and not missing[2:].any()
    assert np.isnan(found.data["correlation"].values[0, 3]).all()
    assert "posterior_sigma" not in found.data


@pytest.mark.slow
def test_intervals_cover_and_sigmas_are_the_scatter_and_naive_pairs_are_found_out() -> None:
    n = 80
    made = definition(
        sweep={"likelihood": ("marginal", "pairs_naive")},
        observation={"frames": 50, "min_stars": 10},
        seeds=tuple(range(n)),
    )
    found = sc.study(made)
    assert found.ok.all(), found.problems
    low, high = binom.ppf([0.0005, 0.9995], n, 0.95) / n
    good, naive = (
        found.data.isel(cell=np.flatnonzero(found.data["likelihood"].values == name))
        for name in ("marginal", "pairs_naive")
    )
    covered = good["covered_95"].mean("cell").values
    assert np.all((covered >= low) & (covered <= high)), covered
    # The controls: naive pairs, and sigmas that are too small by half.
    assert np.all(naive["covered_95"].mean("cell").values < low - 0.2)
    small = (np.abs(good["z"].values) < 1.96 * 0.5).mean(axis=0)
    assert np.all(small < low)
    scatter = (good["estimate"] - good["truth"]).std("cell", ddof=1)
    # One standard error of a scatter is 1 / sqrt(2 n), 8 %.
    np.testing.assert_allclose(good["sigma_predicted"].mean("cell") / scatter, 1.0, atol=0.26)
    np.testing.assert_allclose(good["sigma"].mean("cell") / scatter, 1.0, atol=0.26)
    # Information from other frames of the same sky.
    fisher = sc.study(
        definition(
            mode="fisher", sweep={"frames": (50,)}, observation={"min_stars": 10}, seeds=(0, 1, 2)
        )
    )
    np.testing.assert_allclose(
        fisher.data["sigma"].median("cell"), good["sigma_predicted"].median("cell"), rtol=0.12
    )


SCRIPT = """
import sys
import starcal_uq as sc
from starcal_uq.paper import paper_camera
from starcal_uq.studies import StudyDefinition

if __name__ == "__main__":
    made = StudyDefinition(
        paper_camera(), {"sigma_px": (0.05, 0.1)}, {"frames": 30, "min_stars": 10},
        mode="simulate", seeds=tuple(range(40)), seed=3,
    )
    sc.study(made, out=sys.argv[1], workers=2)
"""


@pytest.mark.slow
def test_a_study_that_is_killed_goes_on_to_the_same_result(tmp_path: Path) -> None:
    (tmp_path / "run.py").write_text(SCRIPT, "utf-8")
    command = [sys.executable, str(tmp_path / "run.py"), str(tmp_path / "out")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(command, env=environment, start_new_session=True)
    cells = tmp_path / "out" / "cells"
    while not (cells.is_dir() and len(list(cells.glob("part-*"))) >= 2):
        assert process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    kept = len(list(cells.glob("part-*")))
    assert not (tmp_path / "out" / "study.nc").exists()
    subprocess.run(command, env=environment, check=True)
    found = Study.load(tmp_path / "out")
    assert found.complete and found.ok.all()
    assert len(list(cells.glob("[!.]*"))) == 1
    whole = sc.study(found.definition, workers=0)
    same = [name for name in whole.data.data_vars if name != "seconds"]
    assert found.data[same].equals(whole.data[same])
    assert kept >= 2


@pytest.mark.slow
def test_dasks_workers_compute_the_same_cells(tmp_path: Path) -> None:
    from distributed import LocalCluster

    made = definition(
        mode="fisher",
        sweep={"fov_deg": tuple(np.linspace(8.0, 16.0, 30).tolist()), "frames": (50, 200)},
        observation={"min_stars": 5},
    )
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as processes:
        found = sc.study(made, out=tmp_path, scheduler=processes.scheduler_address)
    here = sc.study(made, workers=0)
    assert here.ok.all()
    same = [name for name in here.data.data_vars if name != "seconds"]
    assert found.data[same].equals(here.data[same])


@pytest.mark.slow
def test_cells_foretell_the_scatter_of_calibrations_of_another_make_of_sensor() -> None:
    """Stars, frames and noise by NumPy alone; frames of 15 stars that lie anywhere in the field."""
    n, theta = 100, None
    estimates = []
    for seed in range(n):
        seen = campaign(
            np.random.default_rng([6, seed]), n_frames=40, stars_per_frame=15, sigma_px=0.08
        )
        sheet = sc.Camera(**seen.camera_toml(), coefficients=(0.0, 0.0))
        estimates.append(sc.calibrate(sc.Observations(**seen.columns), sheet).theta)
        theta = seen.theta
    assert theta is not None
    rng = np.random.default_rng(9)
    directions = rng.standard_normal((14_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ra, dec = ra_dec_deg(directions)
    known = sc.load_catalogue(6.0).select(np.zeros(len(ra), dtype=np.int64))
    # The fifteen brightest of a frame lie anywhere in it, too.
    stars = replace(known, ra_deg=ra, dec_deg=dec, mag=rng.uniform(0.0, 6.0, len(ra)))
    made = definition(
        camera=sheet.with_theta(theta),
        mode="fisher",
        sweep={"frames": (40,)},
        observation={"sigma_px": 0.08, "stars": 15, "min_stars": 15},
        seeds=tuple(range(20)),
    )
    foretold = sc.study(made, stars=stars, workers=0).data
    assert np.all(foretold["status"].values == "ok")
    scatter = np.std(estimates, axis=0, ddof=1)
    # One standard error of the scatter is 7 %.
    np.testing.assert_allclose(scatter / foretold["sigma"].mean("cell").values, 1.0, atol=0.25)
    found, wanted = np.corrcoef(np.array(estimates).T), foretold["correlation"].mean("cell").values
    # Fisher's transform of a correlation of n has a standard error of 1 / sqrt(n - 3), 0.1.
    i, j = np.array([2, 2, 3]), np.array([3, 4, 4])
    np.testing.assert_allclose(np.arctanh(found[i, j]), np.arctanh(wanted[i, j]), atol=0.4)
