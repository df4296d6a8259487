"""The commands that question results, as a user meets them."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

import starcal_uq as sc
from tests.helpers.commands import SMALL, files
from tests.helpers.scenes import camera, observations


def test_validate_writes_figure_table_and_verdict(cli, inputs, tmp_path, monkeypatch):
    camera().save(tmp_path / "truth.toml")
    status, out, _ = cli(
        "validate",
        "truth.toml",
        "-o",
        "val",
        "--replicates",
        20,
        "--frames",
        12,
        "--workers",
        1,
        "--json",
    )
    assert status in (0, 1)
    found = json.loads(out)
    assert {row["quantity"] for row in found["quantities"]} >= {
        "x0",
        "f",
        "k2",
        "sigma",
        "pitch",
        "roll",
    }
    assert found["ok"] is (status == 0)
    for name in ("validation.npz", "validation.csv", "validation.png"):
        assert (tmp_path / "val" / name).stat().st_size > 0
    before = files(tmp_path)
    status, _, err = cli("validate", "truth.toml", "-o", "val")
    assert status == 2
    assert "--force" in err
    assert files(tmp_path) == before
    # Without a folder nothing is written, neither results nor replicates to go on from.
    kept = sc.diagnostics.Validation.load(tmp_path / "val" / "validation.npz")
    monkeypatch.setattr(sc, "validate", lambda *_, keep, **__: kept if keep is None else None)
    status, out, _ = cli("validate", "truth.toml", "--json")
    assert (json.loads(out)["folder"], status) == (None, int(not kept.ok))
    assert files(tmp_path) == before


def test_diagnose_stores_its_tables_and_the_report_shows_them(cli, inputs, tmp_path):
    cli(
        "calibrate",
        inputs / "obs.csv",
        inputs / "camera.toml",
        "-o",
        "run",
        "--directions",
        "apparent",
    )
    status, out, _ = cli("diagnose", "run", "--starts", 2, "--json")
    assert status == 0
    diagnosis = json.loads(out)["diagnosis"]
    assert all(diagnosis[part] for part in ("misfit", "jackknife", "models", "predictive"))
    assert diagnosis["starts"]["n"] == 2
    for name in (
        "diagnosis.json",
        "misfit.csv",
        "jackknife.csv",
        "comparison.csv",
        "predictive.csv",
    ):
        assert (tmp_path / "run" / name).exists()
    cli("report", "run")
    assert "Misfit" in (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    # Another calibration in the same folder takes the old questions with it.
    cli("calibrate", inputs / "obs.csv", inputs / "camera.toml", "-o", "run", "--force")
    assert not (tmp_path / "run" / "diagnosis.json").exists()


def test_merge_combines_two_halves(cli, inputs, tmp_path):
    obs = observations()
    for name, ids in (("a", obs.frame_ids[::2]), ("b", obs.frame_ids[1::2])):
        obs.select_frames(ids).save(inputs / f"{name}.parquet")
        cli("calibrate", inputs / f"{name}.parquet", inputs / "camera.toml", "-o", name)
    status, out, _ = cli("merge", "a", "b", "-o", "both")
    assert status == 0
    assert "The runs agree" in out
    merged = sc.Calibration.load(tmp_path / "both" / "calibration.json")
    whole = sc.calibrate(obs, sc.paper.paper_start())
    assert np.max(np.abs(merged.theta - whole.theta) / whole.sigmas) < 0.02
    status, _, err = cli("merge", "a", "b", "-o", "a")
    assert status == 2
    assert "error: " in err


def test_a_table_that_holds_its_frames_twice_is_refused(cli, inputs, tmp_path):
    table = pd.read_csv(inputs / "obs.csv")
    again = table.assign(frame=table["frame"] + 5000, x_px=table["x_px"] + 0.001).drop(
        index=[3, 50]
    )
    pd.concat([table, again]).to_csv(inputs / "twice.csv", index=False)
    status, _, err = cli("calibrate", inputs / "twice.csv", inputs / "camera.toml", "-o", "run")
    assert status == 2
    assert "holds the same measurement as frame 0" in " ".join(err.split())
    assert not (tmp_path / "run").exists()
    call = ("calibrate", inputs / "twice.csv", inputs / "camera.toml", "-o", "run", "--duplicates")
    assert cli(*call, "drop")[0] == 0
    assert sc.Run(tmp_path / "run").observations.n_frames == table["frame"].nunique()
    assert cli(*call, "perhaps", "--force")[0] == 2


def test_screen_lists_what_it_left_out(cli, inputs, tmp_path):
    table = pd.read_csv(inputs / "obs.csv")
    table.loc[5, ["ra_deg", "dec_deg"]] = [
        (table.loc[5, "ra_deg"] + 40.0) % 360.0,
        -table.loc[5, "dec_deg"],
    ]
    table.loc[5, "star_id"] = "wrong"
    table.to_csv(inputs / "wrong.csv", index=False)
    status, _, _ = cli(
        "calibrate", inputs / "wrong.csv", inputs / "camera.toml", "-o", "run", "--screen"
    )
    assert status == 0
    rejected = pd.read_csv(tmp_path / "run" / "rejected.csv")
    assert "wrong" in set(rejected["star_id"])
    assert rejected["reason"].notna().all()
    kept = sc.load_observations(tmp_path / "run" / "observations.parquet")
    assert kept.n_stars + len(rejected) == len(table)


@pytest.mark.parametrize("likelihood", ["pairs", "student_t"])
def test_other_likelihoods_from_the_command_line(cli, inputs, tmp_path, likelihood):
    cli("calibrate", inputs / "obs.csv", inputs / "camera.toml", "-o", "run")
    status, out, _ = cli("sample", "run", "--likelihood", likelihood, "--json", *SMALL)
    assert status in (0, 1)
    assert json.loads(out)["posterior"]["parameters"][0]["parameter"] == "x0"


def test_unknown_likelihood_is_named(cli, inputs):
    status, _, err = cli("sample", inputs, "--likelihood", "compressed")
    assert status == 2
    assert (
        "--likelihood 'compressed' is unknown: use one of marginal, pairs, pairs_naive, student_t."
        in err
    )


def test_robust_refinement(cli, inputs, tmp_path):
    status, _, _ = cli(
        "calibrate", inputs / "obs.csv", inputs / "camera.toml", "-o", "run", "--effects", "tails"
    )
    assert status == 0
    cal = sc.Calibration.load(tmp_path / "run" / "calibration.json")
    plain = sc.calibrate(observations(), sc.paper.paper_start())
    assert np.max(np.abs(cal.theta - plain.theta) / plain.sigmas) < 1.0
    # Sampling takes the likelihood of the calibration unless another is named.
    status, _, _ = cli("sample", "run", "--json", *SMALL)
    assert status in (0, 1)
    assert (
        sc.Posterior.load(tmp_path / "run" / "posterior.nc").diagnostics.likelihood == "student_t"
    )


def test_naive_pairs_warn_and_are_not_to_be_trusted(cli, inputs):
    cli("calibrate", inputs / "obs.csv", inputs / "camera.toml", "-o", "run")
    status, _, err = cli("sample", "run", "--likelihood", "pairs_naive", *SMALL)
    assert status == 1
    assert "warning: " in err
    assert "Traceback" not in err


def test_a_posterior_becomes_the_next_prior(cli, inputs, tmp_path):
    obs = observations()
    obs.select_frames(obs.frame_ids[:30]).save(inputs / "ground.parquet")
    obs.select_frames(obs.frame_ids[30:]).save(inputs / "orbit.parquet")
    for name in ("ground", "orbit"):
        cli("calibrate", inputs / f"{name}.parquet", inputs / "camera.toml", "-o", name)
    cli("sample", "ground", *SMALL)
    (tmp_path / "priors.toml").write_text('[priors]\nprior_from = "ground"\n')
    status, _, err = cli("sample", "orbit", "--priors", "priors.toml", *SMALL)
    assert status in (0, 1), err
    chained = sc.Posterior.load(tmp_path / "orbit" / "posterior.nc")
    ground = sc.Posterior.load(tmp_path / "ground" / "posterior.nc")
    assert (chained.sd[:5] < ground.sd[:5]).all()
    # The same data must not be used twice.
    status, _, err = cli("sample", "ground", "--force", "--priors", "priors.toml", *SMALL)
    assert status == 2
    assert "error: priors.toml" in err


def test_help_of_the_new_commands(cli):
    for command in ("validate", "diagnose", "merge"):
        status, out, _ = cli(command, "--help")
        assert status == 0
        assert "Usage" in out
