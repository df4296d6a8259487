"""Tables of other libraries: the same rows from each, and the same messages."""

from datetime import UTC, datetime

import astropy.units as u
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
import xarray as xr
from astropy.table import MaskedColumn, QTable, Table
from astropy.time import Time

import starcal_uq as sc

START = "2026-11-21T03:04:05.500"


class Arrows:
    """A table of a library that offers its columns to Arrow, and nothing else."""

    def __init__(self, frame):
        self._table = pa.Table.from_pandas(frame)

    def __arrow_c_stream__(self, requested_schema=None):
        return self._table.__arrow_c_stream__(requested_schema)


@pytest.fixture
def frame():
    rng = np.random.default_rng(5)
    return pd.DataFrame(
        {
            "frame": np.repeat([2, 1], 4),
            "x_px": rng.uniform(0, 900, 8),
            "y_px": rng.uniform(0, 900, 8),
            "ra_deg": rng.uniform(10, 20, 8),
            "dec_deg": rng.uniform(-5, 5, 8),
            "star_id": [f"HIP {n}" for n in range(8)],
            "mag": [5.0, None, 4.5, 3.0, 2.0, 1.5, 6.0, 5.5],
        }
    )


def with_units(frame):
    """The same as a QTable in other units, with times."""
    table = QTable()
    table["frame"] = frame["frame"].to_numpy()
    for name in ("x_px", "y_px"):
        table[name] = frame[name].to_numpy() * u.pix
    table["ra_deg"] = (frame["ra_deg"].to_numpy() / 15.0) * u.hourangle
    table["dec_deg"] = np.radians(frame["dec_deg"].to_numpy()) * u.rad
    table["star_id"] = frame["star_id"].to_numpy().astype(str)
    table["mag"] = MaskedColumn(frame["mag"].fillna(0.0), mask=frame["mag"].isna())
    table["time_utc"] = Time([START] * 8, scale="utc").tai
    return table


KINDS = {
    "pandas": lambda frame: frame,
    "a part of pandas": lambda frame: pd.concat([frame, frame])[8:].iloc[np.arange(8)],
    "arrow": Arrows,
    "xarray": lambda frame: xr.Dataset.from_dataframe(frame),
    "astropy": lambda frame: Table.from_pandas(frame),
    "units": with_units,
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_library_gives_the_rows_of_the_file(frame, kind, tmp_path):
    frame.to_csv(tmp_path / "stars.csv", index=False)
    wanted = sc.load_observations(tmp_path / "stars.csv")
    found = sc.Observations.from_dataframe(KINDS[kind](frame), directions="apparent")
    assert found.origin.apparent and not wanted.origin.apparent
    for name, values in wanted.columns.items():
        if values.dtype.kind == "f":
            np.testing.assert_allclose(found.columns[name], values, rtol=1e-14)
        else:
            assert np.array_equal(found.columns[name], values)
    assert (found.time_utc is not None) == (kind == "units")
    if kind == "units":
        assert set(found.time_utc) == {START}


def test_columns_by_other_names_and_a_time_of_all_rows(frame):
    zone = datetime(2026, 11, 21, 3, 4, 5, 500000, tzinfo=UTC)
    for time in (START, zone, Time(START, scale="utc").tt):
        found = sc.Observations.from_table(
            frame.rename(columns={"mag": "V"}), columns={"mag": "V"}, time=time
        )
        assert {text.rstrip("0") for text in found.time_utc} == {"2026-11-21T03:04:05.5"}
        assert np.nanmax(found.mag) == 6.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda frame: frame.drop(columns="dec_deg"), "table: column dec_deg is missing"),
        (lambda frame: frame.assign(ra_deg=400.0), "table, row 1, column ra_deg: 400.0 is outside"),
        (lambda frame: frame.assign(x_px="left"), "table, row 1, column x_px: 'left' is not a num"),
        (
            lambda frame: with_units(frame)["x_px", "y_px"],
            "columns frame, ra_deg, dec_deg are missing",
        ),
        (lambda frame: QTable({**with_units(frame), "x_px": np.ones(8) * u.s}), "has the unit 's'"),
        (lambda frame: 5, "table: is not a readable table"),
    ],
)
def test_mistakes_are_named_as_in_a_file(frame, change, words):
    with pytest.raises(sc.errors.ObservationError, match=words):
        sc.Observations.from_table(change(frame))
