"""Results that are kept while a command is under way."""

import pickle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from starcal_uq.core.store import UNFINISHED, Kept, finished
from starcal_uq.core.tasks import run_tasks


class Found(NamedTuple):
    number: int
    values: Any
    words: tuple[str, ...]


def result(number: int) -> Found:
    rng = np.random.default_rng(number)
    rest = [np.nan, float(rng.random()), np.arange(3) > 1, None]
    values = {Found(0, 1, ("a",)): rng.standard_normal((2, 3)), "n": rest}
    return Found(number, values, (f"é{number}", ""))


def same(found: list[Found], wanted: list[Found]) -> bool:
    """Equal to the last bit, and of the same kinds."""
    return pickle.dumps(_parts(found)) == pickle.dumps(_parts(wanted))


def _parts(found: list[Found]) -> list[Any]:
    return [
        [
            one.number,
            one.words,
            type(one),
            array.tobytes(),
            str(array.dtype),
            array.shape,
            repr(rest),
        ]
        for one in found
        for array, rest in (one.values.values(),)
    ]


def test_an_interrupted_call_goes_on_and_computes_nothing_twice(tmp_path: Path) -> None:
    done: list[int] = []

    def task(number: int) -> Found:
        done.append(number)
        if len(done) == 4:
            raise KeyboardInterrupt
        return result(number)

    def call(identity: object, n_tasks: int = 6) -> tuple[list[Found], bool]:
        kept = Kept(tmp_path, identity, (Found,))
        return run_tasks(task, n_tasks, caller="call", chunk=2, workers=0, kept=kept)

    found, interrupted = call({"seed": 1})
    assert interrupted and len(found) == 3
    whole, interrupted = call({"seed": 1})
    assert not interrupted
    assert same(whole, [result(number) for number in range(6)])
    assert done == [0, 1, 2, 3, 3, 4, 5]
    # More of the same; then of something else, of which nothing is there.
    assert same(call({"seed": 1}, 8)[0], [result(number) for number in range(8)])
    assert done[7:] == [6, 7]
    call({"seed": 2})
    assert done[9:] == [0, 1, 2, 3, 4, 5]
    finished(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("workers", [2])
def test_other_processes_get_what_is_left(workers: int, tmp_path: Path) -> None:
    kept = Kept(tmp_path, [], (Found,))
    kept.keep([(number, result(number)) for number in (0, 3)])
    found, _ = run_tasks(result, 5, caller="call", chunk=1, workers=workers, kept=kept)
    assert same(found, [result(number) for number in range(5)])


def test_a_damaged_part_is_made_again(tmp_path: Path) -> None:
    Kept(tmp_path, [], (Found,)).keep([(0, result(0))])
    (part,) = (tmp_path / UNFINISHED).iterdir()
    for content in (b"", part.read_bytes()[:-30]):
        part.write_bytes(content)
        assert Kept(tmp_path, [], (Found,)).results(1) == {}


def test_a_part_that_names_other_code_is_passed_over(tmp_path: Path) -> None:
    kept = Kept(tmp_path, [], (Found,))
    kept.keep([(0, result(0)), (1, Path("elsewhere")), (2, print)])
    assert list(Kept(tmp_path, [], (Found,)).results(3)) == [0]
    assert list(Kept(tmp_path, []).results(3)) == []
