"""Tables of any subject, as they stand in files."""

import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from starcal_uq.core.errors import ObservationError
from starcal_uq.core.tables import in_unit, read_cells, write_parquet
from starcal_uq.core.texts import Texts

PATH = Path("mine.csv")


def test_rows_keep_their_lines_and_say_what_does_not_fit_the_header() -> None:
    text = b'# "a comment\n\na, b\n1,2\n# another\n3\n4,"5\n6"\n'
    table = read_cells(PATH, text, ".csv")
    assert table.names == ["a", "b"]
    assert table.columns == {"a": ["1", "", "4"], "b": ["2", "", "5\n6"]}
    assert table.numbers.tolist() == [4, 6, 8]
    assert table.uneven == {1: "1 value under a header of 2 columns"}
    assert read_cells(PATH, b"a;b\n0,5;1\n", ".csv").decimal_comma
    with pytest.raises(ObservationError, match=r"line 2: the row cannot be read"):
        read_cells(PATH, b'a,b\n1,"2\n', ".csv")


def test_parquet_gives_wanted_columns_and_chosen_rows(tmp_path: Path) -> None:
    path = tmp_path / "mine.parquet"
    columns = {
        "frame": np.array([1, 2, 2]),
        "x": np.array([0.5, 1.5, 2.5]),
        "name": ["a", None, "c"],
    }
    write_parquet(columns, path, '{"key": 7}')
    table = read_cells(path, path.read_bytes(), ".parquet", {"x", "name", "frame"})
    assert table.meta == {"key": 7}
    assert table.columns["name"].tolist() == ["a", "", "c"]
    chosen = read_cells(
        path, path.read_bytes(), ".parquet", {"x", "frame"}, ("frame", np.array([2]))
    )
    assert chosen.columns["x"].tolist() == [1.5, 2.5]
    assert chosen.numbers.tolist() == [2, 3]
    assert chosen.names == ["frame", "x", "name"]


def test_texts_of_arrow_become_codes_whatever_their_type(tmp_path: Path) -> None:
    path = tmp_path / "mine.parquet"
    names = pa.array(["b", None, "a", "b"])
    when = datetime(2026, 11, 21, 1, 2, 3, 500_000, tzinfo=UTC)
    columns = {
        "text": names,
        "codes": names.dictionary_encode(),
        "large": names.cast(pa.large_string()),
        "whole": pa.array([7, None, 7, 8]),
        "flag": pa.array([True, False, True, True]),
        "time": pa.array([when, None, when, when]),
        "lists": pa.array([[1], [], [2, 3], None]),
        "number": pa.array([0.5, 1.5, np.nan, -0.0]),
    }
    parquet.write_table(pa.table(columns), path, row_group_size=3)
    found = read_cells(path, path.read_bytes(), ".parquet").columns
    for name in ("text", "codes", "large"):
        assert isinstance(found[name], Texts)
        assert found[name].tolist() == ["b", "", "a", "b"]
        assert found[name].names.tolist() == ["", "a", "b"]
    assert found["whole"].tolist() == ["7", "", "7", "8"]
    assert found["flag"].tolist() == ["True", "False", "True", "True"]
    assert found["time"].tolist()[:2] == ["2026-11-21 01:02:03.500000000", ""]
    assert found["lists"] == ["[1]", "[]", "[2, 3]", ""]
    assert found["number"].dtype == np.float64
    np.testing.assert_array_equal(found["number"], [0.5, 1.5, np.nan, -0.0])


def test_texts_are_written_as_texts_for_other_programs(tmp_path: Path) -> None:
    path = tmp_path / "mine.parquet"
    write_parquet({"name": Texts.of(["b", "", "a", "b"])}, path, "{}")
    assert parquet.read_table(path).schema.field("name").type == pa.string()
    assert parquet.read_table(path)["name"].to_pylist() == ["b", "", "a", "b"]


def test_reading_numbers_and_texts_does_not_load_pandas(tmp_path: Path) -> None:
    path = tmp_path / "mine.parquet"
    write_parquet({"x": np.arange(3.0), "name": Texts.of(["a", "b", "a"])}, path, "{}")
    code = (
        "import sys, pathlib; from starcal_uq.core.tables import read_cells; "
        f"path = pathlib.Path({str(path)!r}); "
        "print(read_cells(path, path.read_bytes(), '.parquet').columns['name'].tolist()); "
        "sys.exit('pandas' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "['a', 'b', 'a']"


def test_units_are_converted_where_they_can_be() -> None:
    pytest.importorskip("astropy")
    values = np.array([60.0])
    assert in_unit(PATH, values, "arcmin", "deg") == pytest.approx(np.array([1.0]))
    assert in_unit(PATH, values, "", "deg") is values
    assert in_unit(PATH, values, "m", "deg") is None
