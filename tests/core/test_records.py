"""The codec of results: what goes in comes out to the last bit."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.records import from_plain, read, read_json, to_plain, write, write_json
from starcal_uq.core.status import Status
from starcal_uq.core.types import AnyDict, BoolArray, FloatArray, IntArray
from tests.helpers.scenes import camera

WORDS = {"what": "a record", "remedy": "make it"}


@dataclass(frozen=True)
class Part:
    name: str
    values: FloatArray
    status: Status = Status.CONVERGED


@dataclass(frozen=True, eq=False)
class Whole:
    parts: tuple[Part, ...]
    pair: tuple[int, str]
    kind: Literal["a", "b"]
    noise: float | tuple[float, ...] | None
    flags: BoolArray
    numbers: IntArray
    largest: float
    table: dict[str, tuple[float, float]]
    part: Part | None = None
    free: AnyDict = field(default_factory=dict)

    @property
    def n_parts(self) -> int:
        return len(self.parts)


def whole() -> Whole:
    rng = np.random.default_rng(1)
    parts = (
        Part("one", rng.normal(size=(2, 3)) * 1e-15),
        Part("two", np.array([np.nan, np.inf, -0.0]), Status.STALLED),
    )
    flags, numbers = np.array([True, False]), np.array([[2**62, -1]])
    free = {"seed": 7, "versions": {"numpy": "2"}, "none": None, "list": [1, 2.5, "x"]}
    table = {"x": (0.1 + 0.2, 1.0)}
    return Whole(
        parts,
        (3, "x"),
        "b",
        (0.1, 0.2),
        flags,
        numbers,
        float("nan"),
        table,
        Part("p", np.zeros(0)),
        free,
    )


def same(a: Whole, b: Whole) -> None:
    for one, other in zip((*a.parts, a.part), (*b.parts, b.part), strict=True):
        assert (one.name, one.status) == (other.name, other.status)
        assert (
            one.values.tobytes() == other.values.tobytes()
            and one.values.shape == other.values.shape
        )
    assert (a.pair, a.kind, a.noise, a.table, a.free) == (b.pair, b.kind, b.noise, b.table, b.free)
    assert np.isnan(b.largest)
    for name in ("flags", "numbers"):
        one, other = getattr(a, name), getattr(b, name)
        assert one.dtype == other.dtype and np.array_equal(one, other)


def test_records_go_through_text_and_through_archives_without_loss(tmp_path: Path) -> None:
    same(whole(), from_plain(Whole, json.loads(json.dumps(to_plain(whole())))))
    write_json(whole(), tmp_path / "whole.json")
    same(whole(), read_json(Whole, tmp_path / "whole.json", **WORDS))
    write(whole(), tmp_path / "whole.npz", "whole 1")
    same(whole(), read(Whole, tmp_path / "whole.npz", "whole 1", **WORDS))
    with np.load(tmp_path / "whole.npz") as archive:
        assert {"part0_values", "part1_values", "flags", "numbers"} < set(archive.files)


def test_strict_json_has_null_for_nan() -> None:
    plain = to_plain(whole(), null=True)
    assert plain["largest"] is None and plain["parts"][1]["values"][0] is None
    plain["parts"][1]["values"][1] = None
    json.dumps(plain, allow_nan=False)
    assert np.isnan(from_plain(Whole, to_plain(whole(), null=True)).largest)


def test_a_class_with_a_form_of_its_own_keeps_it() -> None:
    @dataclass(frozen=True)
    class Shot:
        name: str

    assert to_plain({"camera": camera()})["camera"] == camera().to_dict()
    assert from_plain(type(camera()), camera().to_dict()) == camera()
    assert from_plain(Shot, {"name": "s"}) == Shot("s")


@pytest.mark.parametrize("value", [object(), {1: 2}, {"a": {3}}, [b"x"], 1j])
def test_what_no_file_holds_is_refused(value: Any) -> None:
    with pytest.raises(TypeError, match="a file cannot hold"):
        to_plain(value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"colour": 1}, "Whole has no field 'colour'"),
        ({"pair": [3]}, "pair has 1 entries, not 2"),
        ({"pair": ["3", "x"]}, "pair0 is '3', not a whole number"),
        ({"pair": [True, "x"]}, "pair0 is True, not a whole number"),
        ({"kind": "c"}, "kind is 'c', not one of a, b"),
        ({"largest": "1"}, "largest is '1', not a number"),
        ({"parts": 3}, "parts is 3, not a list"),
        ({"part": 3}, "part is 3, not a table"),
        ({"numbers": None}, "numbers is missing"),
        ({"numbers": ["x"]}, "numbers does not hold what it should"),
        ({"table": {"x": [1.0]}}, "table_x has 1 entries, not 2"),
        ({"part": {"name": "p", "values": [], "status": "LOST"}}, "LOST"),
        ({"kind": ...}, "kind is missing"),
    ],
)
def test_what_is_wrong_in_a_document_is_named(change: AnyDict, words: str) -> None:
    plain = {**to_plain(whole()), "n_parts": 2}
    same(whole(), from_plain(Whole, plain))
    changed = {name: value for name, value in (plain | change).items() if value is not ...}
    with pytest.raises(ValueError, match=words):
        from_plain(Whole, changed)


def test_damaged_files_are_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "whole.npz"
    with pytest.raises(RunFolderError, match=r"whole\.npz: cannot be read \(No such file or"):
        read(Whole, path, "whole 1", **WORDS)
    write(whole(), path, "whole 1")
    data = path.read_bytes()
    for length in (0, 10, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:length])
        with pytest.raises(RunFolderError, match=r"whole\.npz: is not a record \(.*\); make it\.$"):
            read(Whole, path, "whole 1", **WORDS)
    path.write_bytes(data)
    with pytest.raises(RunFolderError, match="another format"):
        read(Whole, path, "whole 2", **WORDS)
    text = tmp_path / "whole.json"
    for content in ("", "[]", "{", '{"parts": []}', "\x00"):
        text.write_text(content, encoding="utf-8")
        with pytest.raises(RunFolderError, match=r"whole\.json: is not a record \(.*\); make"):
            read_json(Whole, text, **WORDS)
