"""Whatever a file holds, its loader lets out a result or the package's own error of one sentence."""

from __future__ import annotations

import inspect
import random
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import starcal_uq as sc
from tests.helpers.mutants import SAMPLES, Bench

BY_FILE = {sample.file: sample for sample in SAMPLES}
# What reads files and is tested elsewhere: images, and folders of runs.
ELSEWHERE = {
    *(
        "studies.StudyDefinition.from_dict",
        "images.read_image",
        "images.extract_centroids",
        "simulation.read_truth",
        "report",
        "runs.compare_runs",
    ),
    *("runs.merge_runs", "runs.prior_from_run", "runs.compare_split", "Run", "runs.RunFolder"),
}


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return Bench(tmp_path_factory.mktemp("mutants"))


@pytest.mark.parametrize("name", BY_FILE)
def test_no_damage_escapes_a_loader(bench: Bench, name: str) -> None:
    sample = BY_FILE[name]

    @given(st.randoms(use_true_random=False))
    @settings(max_examples=12, suppress_health_check=list(HealthCheck))
    def check(rng: random.Random) -> None:
        made, outcome = bench.damaged(sample, rng)
        assert outcome.kind in ("same", "other", "refused"), (outcome.detail, made[:200])

    check()


def readers() -> Iterator[str]:
    """Public functions and class methods of all typed stubs that are named as readers, or take a path."""
    wings = {"": sc} | {name: getattr(sc, name) for name in sc.__all__ if inspect.ismodule(getattr(sc, name))}
    for wing, module in wings.items():
        for name in getattr(module, "__all__", ()):
            value = getattr(module, name)
            prefix = f"{wing}." if wing else ""
            if inspect.isclass(value):
                for own, method in vars(value).items():
                    if isinstance(method, classmethod | staticmethod) and _reads(own, method.__func__):
                        yield f"{prefix}{name}.{own}"
            elif inspect.isfunction(value) and _reads(name, value):
                yield f"{prefix}{name}"


def _reads(name: str, function: Callable[..., Any]) -> bool:
    if not name.startswith(("load", "read", "open", "from_", "stream")):
        return False
    return any(
        "path" in str(p.annotation).lower() or "pathlike" in str(p.annotation).lower()
        for p in inspect.signature(function).parameters.values()
    )


def test_every_public_reader_is_in_the_table() -> None:
    known = {name for sample in SAMPLES for name in sample.reads} | ELSEWHERE
    found = set(readers())
    assert found - known == set()
    assert len(found) > 20 and "Posterior.load" in found
