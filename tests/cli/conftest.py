"""What the tests of the command line share."""

from __future__ import annotations

import json
import sys
from contextlib import nullcontext

import jsonschema
import pytest

import starcal_uq as sc
from starcal_uq.cli.app import main
from starcal_uq.cli.schemas import PREFIX, json_schema
from tests.helpers.scenes import observations


@pytest.fixture
def one_process(monkeypatch):
    """Tasks stay in this process: that others compute the same is seen where the tasks are."""

    for module in ("tasks", "cluster"):
        monkeypatch.setattr(
            f"starcal_uq.core.{module}.processes", lambda _workers, _caller: nullcontext()
        )


def check_document(text, status):
    """A document, alone, with the numbers that JSON has, as its schema says."""

    def refuse(word):
        raise AssertionError(f"{word} is no JSON")

    document = json.loads(text, parse_constant=refuse)
    jsonschema.validate(document, json_schema(document["schema"].removeprefix(PREFIX)))
    assert document["exit_status"] == status
    return document


@pytest.fixture
def painting_cli(one_process, monkeypatch, capsys, tmp_path):
    """Run a command in an empty folder; returns (status, standard output, standard error)."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["starcal-uq", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            main()
        captured = capsys.readouterr()
        code = stop.value.code or 0
        if "--json" in arguments:
            check_document(captured.out, code)
        return code, captured.out, captured.err

    return call


@pytest.fixture
def cli(unpainted, painting_cli, monkeypatch):
    """The same, without the figures and with few samples for half-widths."""
    monkeypatch.setattr("starcal_uq.propagation.propagate._SAMPLES", 4000)
    return painting_cli


@pytest.fixture
def inputs(tmp_path):
    """Good observations and camera files, in a folder of their own."""
    folder = tmp_path / "inputs"
    folder.mkdir()
    observations().save(folder / "obs.csv")
    sc.paper.paper_start().save(folder / "camera.toml")
    return folder
