"""What the tests of the command line share."""

from __future__ import annotations

import json
import shlex
import sys
from contextlib import nullcontext
from functools import partial

import jsonschema
import pytest

import starcal_uq as sc
from starcal_uq.budgeting import budget
from starcal_uq.cli.app import main
from starcal_uq.cli.schemas import PREFIX, json_schema
from starcal_uq.diagnostics import diagnose
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


class Commands:
    """Runs commands: one text as it is typed, or its words."""

    def __init__(self, monkeypatch, capsys):
        self.monkeypatch, self.capsys = monkeypatch, capsys

    def __call__(self, *words):
        """Status, standard output and standard error; documents are held against their schema."""
        words = shlex.split(words[0]) if len(words) == 1 else [*map(str, words)]
        self.monkeypatch.setattr(sys, "argv", ["starcal-uq", *words])
        with pytest.raises(SystemExit) as stop:
            main()
        captured = self.capsys.readouterr()
        code = stop.value.code or 0
        if "--json" in words:
            check_document(captured.out, code)
        return code, captured.out, captured.err

    def ok(self, *words, among=(0,)):
        """Standard output and standard error of a command that ends well."""
        status, out, err = self(*words)
        assert status in among, (words, status, err)
        return out, err

    def document(self, *words, among=(0,)):
        """The document with which it answers."""
        words = [*(shlex.split(words[0]) if len(words) == 1 else words), "--json"]
        return json.loads(self.ok(*words, among=among)[0])

    def refuses(self, said, *words):
        """Standard error of a command that ends with one sentence, and says this."""
        status, _, err = self(*words)
        assert status == 2 and "Traceback" not in err, (words, status, err)
        assert err.splitlines()[-1].startswith("error: ") and err.count("error: ") == 1, err
        assert said in " ".join(err.split()), (words, err)
        return err


@pytest.fixture
def painting_cli(one_process, monkeypatch, capsys, tmp_path):
    """Commands in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return Commands(monkeypatch, capsys)


@pytest.fixture
def cli(unpainted, painting_cli, monkeypatch):
    """The same, without the figures, and with less chance work: few samples for half-widths, and
    for budgets as many as resolve 99.7 %; two other starts.
    """
    monkeypatch.setattr("starcal_uq.propagation.propagate._SAMPLES", 4000)
    small = partial(budget.budget, n_samples=10_000)
    monkeypatch.setattr(budget, "budget", small)
    starts = diagnose.multi_start
    monkeypatch.setattr(
        diagnose, "multi_start", lambda obs, cal, n, seed=0: starts(obs, cal, min(n, 2), seed)
    )
    return painting_cli


@pytest.fixture
def inputs(tmp_path):
    """Good observations and camera files, in a folder of their own."""
    folder = tmp_path / "inputs"
    folder.mkdir()
    observations().save(folder / "obs.csv")
    sc.paper.paper_start().save(folder / "camera.toml")
    return folder
