"""The commands that question results, as a user meets them."""

from __future__ import annotations

import pandas as pd

import starcal_uq as sc
from tests.helpers.commands import files
from tests.helpers.scenes import camera


def test_validate_writes_figure_table_and_verdict(cli, inputs, tmp_path, monkeypatch):
    camera().save(tmp_path / "truth.toml")
    words = "validate truth.toml -o val --replicates 20 --frames 12 --workers 1"
    found = cli.document(words, among=(0, 1))
    quantities = {row["quantity"] for row in found["quantities"]}
    assert quantities >= {"x0", "f", "k2", "sigma", "pitch", "roll"}
    assert found["ok"] is (found["exit_status"] == 0)
    for name in ("validation.npz", "validation.csv", "validation.png"):
        assert (tmp_path / "val" / name).stat().st_size > 0
    before = files(tmp_path)
    cli.refuses("--force", "validate truth.toml -o val")
    assert files(tmp_path) == before
    # Without a folder nothing is written, neither results nor replicates to go on from.
    kept = sc.diagnostics.Validation.load(tmp_path / "val" / "validation.npz")
    monkeypatch.setattr(sc, "validate", lambda *_, keep, **__: kept if keep is None else None)
    assert cli.document("validate truth.toml", among=(int(not kept.ok),))["folder"] is None
    assert files(tmp_path) == before


def test_diagnose_stores_its_tables_and_the_report_shows_them(cli, inputs, tmp_path):
    cli("calibrate inputs/obs.csv inputs/camera.toml -o run --directions apparent")
    diagnosis = cli.document("diagnose run --starts 1")["diagnosis"]
    assert all(diagnosis[part] for part in ("misfit", "jackknife", "models", "predictive"))
    assert diagnosis["starts"]["n"] == 1
    names = {"diagnosis.json", "misfit.csv", "jackknife.csv", "comparison.csv", "predictive.csv"}
    assert names <= {path.name for path in (tmp_path / "run").iterdir()}
    cli("report run")
    assert "Misfit" in (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    # Another calibration in the same folder takes the old questions with it.
    cli("calibrate inputs/obs.csv inputs/camera.toml -o run --force")
    assert not (tmp_path / "run" / "diagnosis.json").exists()


def test_a_table_that_holds_its_frames_twice_is_refused(cli, inputs, tmp_path):
    table = pd.read_csv(inputs / "obs.csv")
    again = table.assign(frame=table["frame"] + 5000, x_px=table["x_px"] + 0.001).drop(
        index=[3, 50]
    )
    pd.concat([table, again]).to_csv(inputs / "twice.csv", index=False)
    call = "calibrate inputs/twice.csv inputs/camera.toml -o run"
    cli.refuses("holds the same measurement as frame 0", call)
    assert not (tmp_path / "run").exists()
    cli.ok(f"{call} --duplicates drop")
    assert sc.Run(tmp_path / "run").observations.n_frames == table["frame"].nunique()
    cli.refuses("perhaps", f"{call} --duplicates perhaps --force")
