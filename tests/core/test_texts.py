"""Columns of texts as codes: used as arrays of text, exact, and small."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from starcal_uq.core.texts import Texts

CELLS = ["b", "", "a", "b", "ä 10", "a"]
PLAIN = np.array(CELLS)
TEXTS = Texts.of(CELLS)


def test_codes_are_in_the_order_of_the_texts():
    assert TEXTS.names.tolist() == sorted(set(CELLS))
    assert TEXTS.names[TEXTS.codes].tolist() == CELLS == TEXTS.tolist() == list(TEXTS)
    assert np.array_equal(np.argsort(TEXTS.codes, kind="stable"), np.argsort(PLAIN, kind="stable"))
    assert TEXTS.codes.dtype == np.int32


@pytest.mark.parametrize(
    "use",
    [
        np.asarray,
        len,
        np.shape,
        np.ndim,
        lambda column: column[3],
        lambda column: column[[4, 0]],
        lambda column: column[np.array([True, False, True, False, False, True])],
        lambda column: column[::-1],
        lambda column: column[:0],
        lambda column: column == "a",
        lambda column: column != "nowhere",
        lambda column: column > "b",
        lambda column: column == column[::-1],
        lambda column: column == PLAIN,
        lambda column: np.array(["a"] * 6) == column,
        lambda column: (column + "!")[2],
        lambda column: np.isin(column, ["a", "b"]),
        lambda column: np.unique(column, return_inverse=True)[1],
        lambda column: np.char.str_len(column),
        lambda column: np.concatenate([column, column]),
        lambda column: column.astype("U1"),
        lambda column: column.size,
        lambda column: set(column),
    ],
)
def test_a_column_is_used_as_an_array_of_text(use):
    found, expected = use(TEXTS), use(PLAIN)
    assert np.array_equal(found, expected)
    assert type(found) is not Texts or found.dtype.kind == expected.dtype.kind == "U"


def test_parts_keep_their_own_names_alone():
    assert TEXTS[2:4].names.tolist() == ["a", "b"]
    assert TEXTS[TEXTS != "ä 10"].names.tolist() == ["", "a", "b"]


def test_joined_and_mapped_columns_merge_equal_texts():
    joined = Texts.joined([TEXTS, Texts.of(["c", "a"]), Texts.unknown(1)])
    assert joined.tolist() == [*CELLS, "c", "a", ""]
    assert joined.names.tolist() == ["", "a", "b", "c", "ä 10"]
    short = TEXTS.map(lambda text: text[:0])
    assert short.names.tolist() == [""] and len(short) == 6
    assert Texts.placed([2, 0, 2], ["x", "never", "x"]).names.tolist() == ["x"]


def test_a_column_is_small_and_survives_a_pickle():
    many = Texts.placed(np.arange(100_000) % 7, [f"Gaia DR3 {i:019d}" for i in range(7)])
    stored = pickle.dumps(many)
    assert len(stored) < 0.05 * np.asarray(many).nbytes
    assert np.array_equal(pickle.loads(stored), many)
    assert len({id(text) for text in many.tolist()}) == 7


def test_it_cannot_be_written_to():
    for values in (TEXTS.codes, TEXTS.names, TEXTS):
        with pytest.raises((TypeError, ValueError)):
            values[0] = values[1]
    assert not hasattr(TEXTS, "isot") and not hasattr(TEXTS, "__array_interface__")


def test_missing_texts_of_objects_are_empty():
    objects = np.array(["a", None, np.nan, 7], dtype=object)
    assert Texts.of(objects).tolist() == ["a", "", "", "7"]
    assert Texts.of(np.array([3, 1])).tolist() == ["3", "1"]
    assert Texts.of([]).tolist() == []
