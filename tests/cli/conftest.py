"""What the tests of the command line share."""

from __future__ import annotations

from contextlib import nullcontext
from functools import partial

import pytest

import starcal_uq as sc
from starcal_uq.budgeting import budget
from starcal_uq.diagnostics import diagnose
from tests.helpers.commands import Commands
from tests.helpers.scenes import observations


@pytest.fixture
def one_process(monkeypatch):
    """Tasks stay in this process: that others compute the same is seen where the tasks are."""

    for module in ("tasks", "cluster"):
        monkeypatch.setattr(
            f"starcal_uq.core.{module}.processes", lambda _workers, _caller: nullcontext()
        )


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
    # The package keeps what it has once looked up: its name is replaced, and given back, too.
    small = partial(sc.budget, n_samples=10_000)
    for place in (sc, budget):
        monkeypatch.setattr(place, "budget", small)
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
