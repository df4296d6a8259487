"""`reproduce` and `filter` at the command line; fixtures as in the tests of the other commands."""

from __future__ import annotations

import pandas as pd
import pytest


@pytest.mark.slow
def test_reproduce_writes_a_report_and_tables(cli, tmp_path, monkeypatch):
    monkeypatch.setattr("starcal_uq.paper.reproduction.N_READING_DRAWS", 2)
    monkeypatch.setattr("starcal_uq.paper.show.pages.DPI", 60)
    words = "reproduce -o paper --replicates 8 --frames 20 --no-study --workers 1"
    document = cli.document(words)
    assert "The proposed method" in document["text"]
    assert len(document["published"]) == len(pd.read_csv(tmp_path / "paper" / "published.csv"))
    assert (tmp_path / "paper" / "reproduction.html").exists()
    cli.refuses("exists and is not empty", words)


@pytest.mark.slow
def test_reproduce_field_writes_a_page_and_tables(cli, tmp_path, monkeypatch):
    monkeypatch.setattr("starcal_uq.paper.field.experiment.TOLERANCES_PX", (0.5,))
    words = "reproduce-field -o field --replicates 20 --frames 20 --workers 1"
    document = cli.document(words)
    assert "are reproduced" in document["text"] and len(document["table_3"]) == 16
    assert len(pd.read_csv(tmp_path / "field" / "table_3.csv")) == 16
    assert (tmp_path / "field" / "field.html").exists()
    cli.refuses("exists and is not empty", words)


def test_filter_names_what_is_wrong(cli, inputs, tmp_path):
    cli("simulate inputs/camera.toml -o obs.parquet --frames 5")
    for options, said in (
        ("--method kalman", "samaan, griffith"),
        ("--forgetting 1.5", "forgetting"),
        ("--method samaan --process-noise 0.1", "noise"),
        ("--pair-covariance none", "full, diagonal"),
    ):
        cli.refuses(said, f"filter obs.parquet inputs/camera.toml -o run {options}")
    assert not (tmp_path / "run").exists()
