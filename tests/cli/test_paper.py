"""`reproduce` and `filter` at the command line; fixtures as in the tests of the other commands."""

from __future__ import annotations

import json

import pandas as pd
import pytest


@pytest.mark.slow
def test_reproduce_writes_a_report_and_tables(cli, tmp_path, monkeypatch):
    monkeypatch.setattr("starcal_uq.paper.reproduction.N_READING_DRAWS", 2)
    monkeypatch.setattr("starcal_uq.paper.show.pages.DPI", 60)
    size = ("--replicates", 8, "--frames", 20, "--no-study", "--workers", 1)
    status, out, _ = cli("reproduce", "-o", "paper", *size, "--json")

    assert status == 0
    document = json.loads(out)
    assert "The proposed method" in document["text"]
    assert len(document["published"]) == len(pd.read_csv(tmp_path / "paper" / "published.csv"))
    assert (tmp_path / "paper" / "reproduction.html").exists()

    status, _, err = cli("reproduce", "-o", "paper", *size)
    assert status == 2
    assert "exists and is not empty" in err


@pytest.mark.slow
def test_reproduce_field_writes_a_page_and_tables(cli, tmp_path, monkeypatch):
    monkeypatch.setattr("starcal_uq.paper.field.experiment.TOLERANCES_PX", (0.5,))
    size = ("--replicates", 20, "--frames", 20, "--workers", 1)
    status, out, _ = cli("reproduce-field", "-o", "field", *size, "--json")
    assert status == 0
    assert "are reproduced" in json.loads(out)["text"] and len(json.loads(out)["table_3"]) == 16
    assert len(pd.read_csv(tmp_path / "field" / "table_3.csv")) == 16
    assert (tmp_path / "field" / "field.html").exists()
    status, _, err = cli("reproduce-field", "-o", "field", *size)
    assert status == 2
    assert "exists and is not empty" in err


def test_filter_names_what_is_wrong(cli, inputs, tmp_path):
    cli("simulate", inputs / "camera.toml", "-o", "obs.parquet", "--frames", 5)
    for options, words in (
        (("--method", "kalman"), "samaan, griffith"),
        (("--forgetting", 1.5), "forgetting"),
        (("--method", "samaan", "--process-noise", 0.1), "noise"),
        (("--pair-covariance", "none"), "full, diagonal"),
    ):
        status, _, err = cli("filter", "obs.parquet", inputs / "camera.toml", "-o", "run", *options)
        assert status == 2, err
        assert words in err
    assert not (tmp_path / "run").exists()
