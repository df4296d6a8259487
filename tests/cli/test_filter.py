"""The command `filter`: from a file to a run folder, interrupted and taken up again."""

from __future__ import annotations

import shutil

import numpy as np
import pandas as pd
import pytest

import starcal_uq as sc
from starcal_uq.paper.recursive import folder as filter_runs
from starcal_uq.paper.recursive.folder import STATE, filter_run
from starcal_uq.runs.folder import HISTORY
from tests.helpers.scenes import camera, nominal, observations

ALL = sc.paper.RecursionOptions(parameters="all")


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "stars.parquet"
    observations(n_frames=60).save(path)
    return path


def test_run_folder_holds_the_calibration_and_its_history(table, tmp_path):
    cal = filter_run(table, nominal(camera()), tmp_path / "run", options=ALL)

    run = sc.runs.RunFolder(tmp_path / "run")
    assert np.array_equal(sc.Calibration.load(run.calibration).theta, cal.theta)
    history = pd.read_csv(run.path / HISTORY)
    assert len(history) == 61
    assert history["f"].iloc[-1] == pytest.approx(cal.theta[2], rel=1e-12)
    assert (history["sigma_f"].diff().dropna() < 0).all()
    assert not (run.path / STATE).exists()


def test_posterior_and_couplings_follow_and_propagation_says_what_it_needs(table, tmp_path):
    filter_run(table, nominal(camera()), tmp_path / "run", options=ALL)
    run = sc.Run(tmp_path / "run")
    batch = sc.calibrate(observations(n_frames=60), nominal(camera()))

    assert run.couple().parameter_names == ("x0", "y0", "f", "k1", "k2")
    posterior = run.sample(seed=1)
    assert np.all(np.abs(posterior.mean - batch.theta) < 0.5 * batch.sigmas)
    with pytest.raises(sc.errors.RunFolderError, match="holds no observations"):
        run.propagate(n_draws=10, seed=1)


def test_an_interrupted_run_goes_on_bit_for_bit(table, tmp_path, monkeypatch):
    whole = filter_run(table, nominal(camera()), tmp_path / "whole", options=ALL)

    update = sc.paper.RecursiveCalibration.update

    def stop_at_20(self, frame):
        if self.n_frames == 20:
            raise KeyboardInterrupt
        return update(self, frame)

    monkeypatch.setattr(sc.paper.RecursiveCalibration, "update", stop_at_20)
    with pytest.raises(KeyboardInterrupt):
        filter_run(table, nominal(camera()), tmp_path / "run", options=ALL)
    monkeypatch.undo()
    assert sc.paper.RecursiveCalibration.load(tmp_path / "run" / STATE).n_frames == 20

    # With other settings it starts again, and nothing of the first goes in.
    shutil.copytree(tmp_path / "run", tmp_path / "other")
    other = filter_run(table, nominal(camera()), tmp_path / "other", method="samaan")
    assert np.array_equal(
        other.theta, filter_run(table, nominal(camera()), tmp_path / "o", method="samaan").theta
    )
    resumed = filter_run(table, nominal(camera()), tmp_path / "run", options=ALL)

    assert np.array_equal(resumed.theta, whole.theta)
    assert np.array_equal(resumed.covariance, whole.covariance)
    assert resumed.provenance["data_sha256"] == whole.provenance["data_sha256"]
    assert (tmp_path / "run" / HISTORY).read_text() == (tmp_path / "whole" / HISTORY).read_text()


def test_a_state_is_saved_on_the_way(table, tmp_path, monkeypatch):
    monkeypatch.setattr(filter_runs, "_SAVE_EVERY", 25)
    saved = []
    save = sc.paper.RecursiveCalibration.save
    monkeypatch.setattr(
        sc.paper.RecursiveCalibration,
        "save",
        lambda self, path: (saved.append(self.n_frames), save(self, path)),
    )

    filter_run(table, nominal(camera()), tmp_path / "run", options=ALL)

    assert saved == [25, 50]
