"""What all tests share. It is read before any test imports NumPy, so thread counts can still be
set.
"""

from __future__ import annotations

import gc
import os
import tempfile

# One BLAS thread: the matrices here are too small to gain from more, sums come out in the same
# order on every machine, and the test processes that share the cores do not slow each other down.
for _library in ("OMP", "OPENBLAS", "MKL"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")
# Caches of the tests stay out of the home folder.
os.environ["XDG_CACHE_HOME"] = os.path.join(tempfile.gettempdir(), "starcal_uq-test-cache")

from collections.abc import Iterator
from datetime import date
from functools import cache
from importlib.metadata import distributions, requires, version
from pathlib import Path

import hypothesis
import pytest
from packaging.requirements import Requirement
from platformdirs import user_cache_dir

from starcal_uq.core import tasks

ROOT = Path(__file__).resolve().parents[1]

# The same examples on every run: a failure in CI is a failure at the desk.
hypothesis.settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("repeatable")


def pytest_configure(config: pytest.Config) -> None:
    """Divide the processors among the test processes: one that has a single processor starts no
    others, each of which takes seconds to load, unless a test gives their number.

    Write down that ArviZ 0.23 has given its notice of the day: it keeps the date in one file, and
    two processes that write it at the same moment fail.
    """
    share = tasks.processors() // int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    tasks.processors = lambda: max(share, 1)
    if not hasattr(config, "workerinput") and version("arviz").startswith("0."):
        noticed = Path(user_cache_dir("arviz", "arviz"), "daily_warning")
        noticed.parent.mkdir(parents=True, exist_ok=True)
        noticed.write_text(date.today().isoformat())


@pytest.fixture
def unpainted() -> Iterator[None]:
    """`without_painting` for one test."""
    from tests.helpers.painting import without_painting

    with without_painting():
        yield


@pytest.fixture(scope="session")
def known_centroids() -> dict[str, object]:
    """Centroids of images that stay as they are, by what they were extracted with."""
    return {}


@pytest.fixture
def centroids_once(monkeypatch: pytest.MonkeyPatch, known_centroids: dict[str, object]) -> None:
    """The same images are searched for stars once for all tests that use this, such as the real
    frames.
    """
    from starcal_uq.images import extract

    search = extract.extract_centroids

    def remembered(images: object, **options: object) -> object:
        key = repr((images, {name: value for name, value in options.items() if name != "progress"}))
        if key not in known_centroids:
            known_centroids[key] = search(images, **options)
        return known_centroids[key]

    monkeypatch.setattr(extract, "extract_centroids", remembered)


@pytest.fixture
def few_importance_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """Exact likelihoods, a millisecond each, are weighed with 200 draws instead of 2000; the chains
    are the same.
    """
    monkeypatch.setattr("starcal_uq.inference.sample._N_IMPORTANCE_SLOW", 200)


# Files that take long, so that no process is left with one of them at the end.
LONG = (
    *(
        "test_notebook.py",
        "paper/",
        "cli/",
        "diagnostics/",
        "planning/",
        "estimation/",
        "presentation/",
    ),
    *(
        "identification/",
        "inference/",
        "sky/",
        "budgeting/",
        "runs/",
        "comparison/",
        "propagation/",
    ),
)


@cache
def installed(extra: str) -> bool:
    """Whether every library of an extra is there."""
    needed = map(Requirement, requires("starcal-uq") or ())
    markers = [
        (one.name, one.marker)
        for one in needed
        if one.marker and one.marker.evaluate({"extra": extra})
    ]
    assert markers, f"{extra} is no extra of this package"
    return all(any(distributions(name=name)) for name, _ in markers)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip tests of an extra that is not installed; `make supply` runs them without any."""
    for mark in item.iter_markers("extra"):
        if not installed(mark.args[0]):
            pytest.skip(f"the extra {mark.args[0]} is not installed")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files first."""

    def rank(item: pytest.Item) -> int:
        name = item.path.relative_to(ROOT / "tests").as_posix()
        return next((i for i, start in enumerate(LONG) if name.startswith(start)), len(LONG))

    items.sort(key=rank)


def pytest_collection_finish() -> None:
    """Two thousand tests and the modules that they import are not searched for garbage again and
    again.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


@pytest.fixture(scope="session")
def root() -> Path:
    """The folder of the project."""
    return ROOT


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real observations, which is kept beside the project and not in it."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"the real observations are not present ({folder})")
    return folder
