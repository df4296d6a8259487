"""What a run gives to other programs."""

from __future__ import annotations

import importlib
import json
import sys
import warnings
from typing import get_args

import numpy as np
import pandas as pd
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.settings import ExportFormat
from starcal_uq.inference.groups import GROUPS
from starcal_uq.runs.exchange import FORMATS
from tests.helpers.scenes import observations


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    made = sc.Run(tmp_path_factory.mktemp("runs") / "run")
    made.calibrate(observations(n_frames=12), sc.paper.paper_start())
    made.sample(seed=1, n_ensembles=2, n_walkers=14, n_steps=30, n_burn=10)
    return made


def test_a_run_holds_its_calibrated_camera(run):
    assert sc.Camera.load(run.folder.calibrated) == run.posterior.calibrated_camera
    assert np.allclose(run.posterior.calibrated_camera.theta, run.posterior.mean, rtol=1e-14)


def test_covariance_draws_and_tables(run, tmp_path):
    stated = json.loads(sc.export(run, "covariance", tmp_path / "c.json").path.read_text())
    assert stated["source"] == "posterior"
    assert stated["parameter_names"] == list(run.posterior.camera_names)
    assert np.array_equal(stated["covariance"], run.posterior.covariance)
    draws = pd.read_csv(sc.export(run.path, "csv", tmp_path / "d.csv").path)
    assert np.array_equal(draws.to_numpy(), run.posterior.draws)
    assert draws.columns[0] == "x0 [px]"
    again = sc.Posterior.load(sc.export(run, "netcdf", tmp_path / "d.nc").path)
    assert np.array_equal(again.draws, run.posterior.draws)
    for to, name in (("netcdf", "d.nc"), ("csv", "d.csv"), ("covariance", "c.json")):
        sc.export(run, to, tmp_path / name, force=True)
    lines = sc.export(run, "markdown", tmp_path / "t.md").path.read_text().splitlines()
    assert len(lines) == 2 + len(run.posterior.parameter_names)
    assert {line.count("|") for line in lines} == {10}
    assert (
        sc.export(run, "latex", tmp_path / "t.tex").path.read_text().startswith(r"\begin{tabular}")
    )


@pytest.mark.slow
def test_arviz_reads_what_is_written_for_it(run, tmp_path):
    made = sc.export(run, "arviz", tmp_path / "a.nc")
    assert "log_likelihood" in made.note and made.note.endswith("for `az.from_netcdf`.")
    expected = run.arviz()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        again = importlib.import_module("arviz").from_netcdf(made.path)
    for group in ("posterior", "sample_stats", *GROUPS):
        one, other = (
            data[group].to_dataset() if hasattr(data[group], "to_dataset") else data[group]
            for data in (again, expected)
        )
        assert set(one.variables) == set(other.variables) and set(one.coords) == set(
            other.coords
        ), group
        for name in other.variables:
            assert np.array_equal(one[name].values, other[name].values), (group, name)
            assert one[name].attrs.get("units") == other[name].attrs.get("units")
    with pytest.raises(RunFolderError):
        sc.export(run.posterior, "arviz")


def test_a_calibration_alone_and_a_camera_alone(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stated = json.loads(sc.export(run.calibration, "covariance").path.read_text())
    assert (stated["source"], stated["mean"]) == ("estimate", run.calibration.theta.tolist())
    with pytest.raises(RunFolderError):
        sc.export(run.calibration, "csv")
    made = sc.export(run.folder.camera, "opencv")
    assert (made.path.name, made.error_px) == ("camera-opencv.yaml", 0.0)
    with pytest.raises(RunFolderError):
        sc.export(run.camera, "covariance")
    with pytest.raises(RunFolderError):
        sc.export(run, "word")


def test_the_command_line_has_every_format():
    assert tuple(FORMATS) == get_args(ExportFormat)


@pytest.mark.parametrize("library", ["uncertainties", "gtc"])
def test_parameters_are_correlated_numbers_of_other_libraries(run, library):
    """Derivatives and correlations count."""
    pytest.importorskip({"gtc": "GTC"}.get(library, library))
    values = sc.uncertain_values(run.path, library)
    assert list(values) == list(run.posterior.camera_names)
    mean, covariance = run.posterior.mean, run.posterior.covariance
    made = values["f"] * values["k1"] ** 2 + values["x0"]
    gradient = np.zeros(len(mean))
    gradient[[0, 2, 3]] = 1.0, mean[3] ** 2, 2.0 * mean[2] * mean[3]
    expected = np.sqrt(gradient @ covariance @ gradient)
    shown = (made.x, made.u) if library == "gtc" else (made.nominal_value, made.std_dev)
    assert shown == pytest.approx((mean[2] * mean[3] ** 2 + mean[0], expected), rel=1e-9)
    # Their correlation counts: of two numbers without it the sum would have sqrt(2).
    sd = np.sqrt(np.diag(covariance))
    both = values["f"] / sd[2] + values["k1"] / sd[3]
    found = both.u if library == "gtc" else both.std_dev
    rho = covariance[2, 3] / (sd[2] * sd[3])
    assert found == pytest.approx(np.sqrt(2.0 + 2.0 * rho), rel=1e-9) and abs(rho) > 0.1


def test_uncertain_numbers_name_the_extra(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "GTC", None)
    with pytest.raises(sc.errors.MissingExtraError):
        sc.uncertain_values(run, "gtc")
