"""Tables of any subject, as they stand in files."""

from pathlib import Path

import numpy as np
import pytest

from starcal_uq.core.errors import ObservationError
from starcal_uq.core.tables import in_unit, read_cells, write_parquet

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


def test_units_are_converted_where_they_can_be() -> None:
    pytest.importorskip("astropy")
    values = np.array([60.0])
    assert in_unit(PATH, values, "arcmin", "deg") == pytest.approx(np.array([1.0]))
    assert in_unit(PATH, values, "", "deg") is values
    assert in_unit(PATH, values, "m", "deg") is None
