"""Files of observations, and the report of every bad row."""

import csv
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import ObservationError, RunFolderError
from starcal_uq.observations.columns import COLUMNS
from starcal_uq.observations.table import Observations, load_observations
from tests.helpers.outside import campaign
from tests.helpers.speed import sort_a_million, times_as_long

CAMERA = Camera(1024, 768, 6.9, 35.0, 511.5, 383.5)
TIME = "2026-11-21T01:02:03"
ENDINGS = (".csv", pytest.param(".ecsv", marks=pytest.mark.extra("images")), ".parquet")

HEADER = ["frame", "x_px", "y_px", "ra_deg", "dec_deg"]
ROWS = [
    ["3", "10.5", "20.5", "1.0", "-5.0"],
    ["3", "11.5", "21.5", "2.0", "-6.0"],
    ["3", "12.5", "22.5", "3.0", "-7.0"],
    ["4", "10.5", "20.5", "1.0", "-5.0"],
    ["4", "11.5", "21.5", "2.0", "-6.0"],
    ["4", "12.5", "22.5", "3.0", "-7.0"],
]


def write_csv(
    path: Path, rows: list[list[str]] = ROWS, header: list[str] = HEADER, comment: str = ""
) -> Path:
    with path.open("w", newline="", encoding="utf-8") as file:
        file.write(comment)
        csv.writer(file).writerows([header, *rows])
    return path


def changed(**cells: str) -> list[list[str]]:
    """ROWS with cells replaced: ``x_px_2="abc"`` sets column x_px of the row with index 2."""
    rows = [list(row) for row in ROWS]
    for key, value in cells.items():
        column, _, row = key.rpartition("_")
        rows[int(row)][HEADER.index(column)] = value
    return rows


def extended(column: str, values: list[str]) -> tuple[list[list[str]], list[str]]:
    """ROWS and HEADER with one more column."""
    return [[*row, value] for row, value in zip(ROWS, values, strict=True)], [*HEADER, column]


def random_table(n_frames: int = 4, m: int = 5, seed: int = 0, **changes: object) -> Observations:
    """A table with every column, and no number that has a short decimal form."""
    rng = np.random.default_rng(seed)
    n = n_frames * m
    times = [
        f"2026-11-21T{k // 3600:02d}:{k // 60 % 60:02d}:{k % 60:02d}.123456789"
        for k in range(n_frames)
    ]
    columns: dict[str, object] = {
        "frame": np.repeat(np.arange(n_frames) * 3 - 1, m),
        "x_px": rng.uniform(-0.5, 1023.5, n),
        "y_px": rng.uniform(-0.5, 767.5, n),
        "ra_deg": rng.uniform(0.0, 360.0, n),
        "dec_deg": rng.uniform(-90.0, 90.0, n),
        "sigma_px": rng.uniform(0.01, 0.2, n),
        "star_id": np.array([f'Gaia DR3 {10**15 + i}, "{i}" é' for i in range(n)]),
        "mag": np.where(np.arange(n) % 4 == 1, np.nan, rng.normal(5.0, 1.0, n)),
        "direction_mas": np.where(np.arange(n) % 5 == 2, np.nan, np.linspace(0.01, 1.0 / 0.3, n)),
        "time_utc": np.repeat(times, m),
        "temperature_c": rng.normal(10.0, 5.0, n),
        "meta": {
            "directions": "catalogue",
            "observer_velocity_km_s": [1e-10, -7.5, 1 / 3],
            "source": "made up",
            "seed": 12345678901234567890,
            "ignored_columns": ["snr"],
            "nested": {"none": None, "yes": True},
        },
    }
    return Observations(**{**columns, **changes})  # type: ignore[arg-type]


def assert_same(a: Observations, b: Observations) -> None:
    assert list(a.columns) == list(b.columns)
    for name, values in a.columns.items():
        np.testing.assert_array_equal(values, b.columns[name], err_msg=name)
        assert values.dtype.kind == b.columns[name].dtype.kind
    assert a.data_hash == b.data_hash


def caught(path: Path, **options: object) -> ObservationError:
    with pytest.raises(ObservationError) as info:
        load_observations(path, **options)  # type: ignore[arg-type]
    assert "\n" not in str(info.value)
    return info.value


@pytest.mark.parametrize("ending", ENDINGS)
def test_file_round_trip_is_lossless(tmp_path, ending):
    obs = random_table()
    path = tmp_path / f"obs{ending}"
    obs.save(path)
    back = load_observations(path, CAMERA)
    assert_same(obs, back)
    if ending != ".csv":
        assert back.meta == obs.meta
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("ending", ENDINGS)
def test_required_columns_alone_are_enough(tmp_path, ending):
    obs = Observations(*(getattr(random_table(), name) for name in HEADER))
    obs.save(tmp_path / f"obs{ending}")
    back = load_observations(tmp_path / f"obs{ending}")
    assert_same(obs, back)
    assert back.meta["directions"] == "undeclared"
    assert back.meta["ignored_columns"] == []


@pytest.mark.extra("images")
def test_meta_with_numpy_values_is_saved_as_plain_values(tmp_path):
    obs = random_table(
        meta={
            "seed": np.int64(3),
            "observer_velocity_km_s": np.array([1.0, 2.0, 3.0]),
            "p": Path("a"),
        }
    )
    for ending in (".ecsv", ".parquet"):
        obs.save(tmp_path / f"obs{ending}")
        meta = load_observations(tmp_path / f"obs{ending}").meta
        assert (meta["seed"], meta["observer_velocity_km_s"], meta["p"]) == (
            3,
            [1.0, 2.0, 3.0],
            "a",
        )


def test_csv_is_plain(tmp_path):
    obs = random_table()
    obs.save(tmp_path / "obs.csv")
    lines = (tmp_path / "obs.csv").read_text(encoding="utf-8").split("\n")
    assert lines[0] == ",".join(COLUMNS)
    assert len(lines) == 22  # header, 20 rows, end of the last line
    with (tmp_path / "obs.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert rows[1]["mag"] == ""
    assert float(rows[1]["x_px"]) == obs.x_px[1]


def test_csv_from_elsewhere(tmp_path):
    text = (
        '\ufeff# made by "hand\r\n'
        "frame, x_px ,y_px,ra_deg,dec_deg,star_id\r\n"
        "1.0, 5,6,7,8 ,32349\r\n\r\n# 1,5,6,7,9,3\r\n1,6,7,8,9,\r\n1,7,8,9,1e1,\r\n,,,,,\r\n"
    )
    path = tmp_path / "obs.CSV"
    path.write_bytes(text.encode())
    obs = load_observations(path)
    np.testing.assert_array_equal(obs.frame, [1, 1, 1])
    np.testing.assert_array_equal(obs.dec_deg, [8.0, 9.0, 10.0])
    assert obs.star_id.tolist() == ["32349", "", ""]
    path.write_bytes(text.replace("1,6,7", "1,6,x").encode())
    error = caught(path)
    assert (error.row, error.column) == (6, "y_px")


def test_times_are_read_in_one_spelling(tmp_path):
    times = [
        "2026-11-21T01:02:03Z",
        "2026-11-21 01:02:03.1234567891",
        "2026-11-21T01:02",
        "2016-12-31T23:59:60",
        "2026-11-21T01:02:03+00:00",
        "2024-02-29T00:00:00",
    ]
    path = write_csv(tmp_path / "obs.csv", *extended("time_utc", times))
    assert load_observations(path).time_utc.tolist() == [
        "2026-11-21T01:02:03",
        "2026-11-21T01:02:03.1234567891",
        "2026-11-21T01:02:00",
        "2016-12-31T23:59:60",
        "2026-11-21T01:02:03",
        "2024-02-29T00:00:00",
    ]


def test_optional_columns_may_be_empty(tmp_path):
    for column in ("mag", "temperature_c", "sigma_px", "time_utc", "star_id"):
        path = write_csv(tmp_path / "obs.csv", *extended(column, ["", " ", "", "", "", ""]))
        assert getattr(load_observations(path), column) is None
    path = write_csv(tmp_path / "obs.csv", *extended("mag", ["", "nan", "1", "2", "3", "4"]))
    np.testing.assert_array_equal(load_observations(path).mag, [np.nan, np.nan, 1, 2, 3, 4])


@pytest.mark.extra("images")
def test_ecsv_written_by_astropy_in_other_units(tmp_path):
    from astropy import units as u
    from astropy.table import QTable

    obs = random_table()
    table = QTable(
        {
            "frame": obs.frame,
            "x_px": obs.x_px * u.pix,
            "y_px": obs.y_px,
            "ra_deg": (obs.ra_deg * u.deg).to(u.hourangle),
            "dec_deg": obs.dec_deg * u.deg,
            "temperature_c": (obs.temperature_c + 273.15) * u.K,
        },
        meta={"directions": "apparent", "observer": "me"},
    )
    for delimiter in (" ", ","):
        table.write(tmp_path / "obs.ecsv", format="ascii.ecsv", delimiter=delimiter, overwrite=True)
        back = load_observations(tmp_path / "obs.ecsv")
        np.testing.assert_allclose(back.ra_deg, obs.ra_deg, rtol=1e-14)
        np.testing.assert_allclose(back.temperature_c, obs.temperature_c, atol=1e-12)
        np.testing.assert_array_equal(back.x_px, obs.x_px)
        assert (back.meta["directions"], back.meta["observer"]) == ("apparent", "me")
    table["dec_deg"] = obs.dec_deg * u.m
    table.write(tmp_path / "obs.ecsv", format="ascii.ecsv", overwrite=True)
    assert "column dec_deg has the unit 'm'; give it in deg." in str(caught(tmp_path / "obs.ecsv"))


@pytest.mark.extra("images")
def test_our_ecsv_is_read_by_astropy(tmp_path):
    from astropy.table import Table

    obs = random_table()
    obs.save(tmp_path / "obs.ecsv")
    table = Table.read(tmp_path / "obs.ecsv")
    np.testing.assert_array_equal(table["ra_deg"], obs.ra_deg)
    assert table.meta["observer_velocity_km_s"] == [1e-10, -7.5, 1 / 3]


def test_parquet_written_by_pandas(tmp_path):
    import pandas as pd

    obs = random_table()
    frame = obs.to_dataframe().drop(columns=["sigma_px"])
    frame.attrs.clear()
    frame["frame"] = frame["frame"].astype("int16")
    frame["star_id"] = np.arange(20)
    frame["time_utc"] = pd.to_datetime(frame["time_utc"], utc=True)
    frame["x_px"] = np.arange(20)
    frame["snr"] = 3.0
    frame.to_parquet(tmp_path / "obs.parquet", index=False)
    back = load_observations(tmp_path / "obs.parquet")
    np.testing.assert_array_equal(back.time_utc, obs.time_utc)
    np.testing.assert_array_equal(back.mag, obs.mag)
    assert back.star_id.tolist()[:2] == ["0", "1"]
    assert back.x_px[2] == 2.0
    assert back.meta["ignored_columns"] == ["snr"]
    frame.loc[4, "frame"] = None
    frame.loc[7, "dec_deg"] = 100.0
    frame.to_parquet(tmp_path / "bad.parquet", index=False)
    error = caught(tmp_path / "bad.parquet")
    assert str(error).endswith(
        "bad.parquet, row 5, column frame: the value is missing; fill it in or remove the row (1 "
        "more bad row)."
    )
    assert "row 8, column dec_deg: 100.0 is outside -90..90 deg" in error.problems[1]


def test_columns_of_other_names(tmp_path):
    path = write_csv(tmp_path / "obs.csv", header=["image", "x_px", "y_px", "alpha", "dec_deg"])
    obs = load_observations(path, columns={"frame": "image", "ra_deg": "alpha"})
    np.testing.assert_array_equal(obs.frame_ids, [3, 4])
    assert obs.meta["columns"] == {"frame": "image", "ra_deg": "alpha"}
    # Messages name the column as it is called in the file.
    bad = write_csv(
        tmp_path / "bad.csv", changed(ra_deg_1="400"), ["image", "x_px", "y_px", "alpha", "dec_deg"]
    )
    assert "line 3, column alpha: 400.0 is outside" in str(
        caught(bad, columns={"frame": "image", "ra_deg": "alpha"})
    )
    assert "column beta is missing" in str(
        caught(path, columns={"frame": "image", "ra_deg": "beta"})
    )
    assert "column snr is missing" in str(
        caught(path, columns={"mag": "snr", "frame": "image", "ra_deg": "alpha"})
    )
    assert "'ra' is no column of observations; use frame" in str(
        caught(path, columns={"ra": "alpha"})
    )


@pytest.mark.extra("images")
def test_other_directions_are_undeclared(tmp_path):
    """What a file declares of its ra_deg and dec_deg does not hold for other columns."""
    table = random_table().to_table()
    table["ra_apparent_deg"] = table["ra_deg"] * 1.0
    table.write(tmp_path / "obs.ecsv", format="ascii.ecsv")
    assert load_observations(tmp_path / "obs.ecsv").directions_declared
    assert not load_observations(
        tmp_path / "obs.ecsv", columns={"ra_deg": "ra_apparent_deg"}
    ).directions_declared
    table.meta["directions"] = "nice"
    table.write(tmp_path / "bad.ecsv", format="ascii.ecsv")
    assert "bad.ecsv: its metadata say directions = 'nice'" in str(caught(tmp_path / "bad.ecsv"))


@pytest.mark.parametrize(
    ("cells", "line", "column", "reason"),
    [
        ({"y_px_2": "abc"}, 4, "y_px", "'abc' is not a number; correct or remove the row."),
        ({"y_px_2": "1_000"}, 4, "y_px", "'1_000' is not a number"),
        ({"x_px_0": ""}, 2, "x_px", "the value is missing; fill it in or remove the row."),
        ({"x_px_0": "nan"}, 2, "x_px", "nan is not a finite number; correct or remove the row."),
        ({"ra_deg_0": "-inf"}, 2, "ra_deg", "-inf is not a finite number"),
        ({"frame_1": "3.5"}, 3, "frame", "'3.5' is not a whole number"),
        ({"frame_1": "three"}, 3, "frame", "'three' is not a whole number"),
        ({"frame_1": "nan"}, 3, "frame", "'nan' is not a whole number"),
        ({"frame_1": "9" * 30}, 3, "frame", "is not a whole number"),
        ({"x_px_3": "1023.51"}, 5, "x_px", "1023.51 is outside the detector, -0.5..1023.5 px;"),
        ({"y_px_3": "-0.6"}, 5, "y_px", "-0.6 is outside the detector, -0.5..767.5 px"),
        ({"dec_deg_4": "91"}, 6, "dec_deg", "91.0 is outside -90..90 deg; correct or remove the"),
        ({"ra_deg_4": "-1"}, 6, "ra_deg", "-1.0 is outside 0..360 deg"),
        ({"frame_5": "5"}, 5, "frame", "frame 4 has 2 stars, and 3 are needed; add stars or"),
        ({"ra_deg_5": "2.0", "dec_deg_5": "-6.0"}, 7, "ra_deg", "the same direction occurs twice"),
        ({"x_px_4": "10.5", "y_px_4": "20.5"}, 6, "x_px", "position occurs twice in frame 4"),
    ],
)
def test_bad_row_is_named(tmp_path, cells, line, column, reason):
    path = write_csv(tmp_path / "obs.csv", changed(**cells))
    error = caught(path, camera=CAMERA)
    assert str(error).startswith(f"{path}, line {line}, column {column}: ")
    assert reason in str(error)
    assert (error.row, error.column) == (line, column)


@pytest.mark.parametrize(
    ("column", "values", "line", "reason"),
    [
        ("sigma_px", ["0.1", "0", "0.1", "0.1", "0.1", "0.1"], 3, "0.0 is not above 0"),
        ("sigma_px", ["0.1", "0.1", "", "0.1", "0.1", "0.1"], 4, "the value is missing"),
        ("mag", ["1", "inf", "1", "1", "1", "1"], 3, "inf is not a finite number"),
        ("mag", ["1", "bright", "1", "1", "1", "1"], 3, "'bright' is not a number"),
        ("star_id", ["a", "b", "a", "a", "", ""], 4, "the same star occurs twice in frame 3"),
        ("time_utc", [""] + [TIME] * 5, 2, "the value is missing"),
    ],
)
def test_bad_optional_value_is_named(tmp_path, column, values, line, reason):
    error = caught(write_csv(tmp_path / "obs.csv", *extended(column, values)))
    assert f"line {line}, column {column}: " in str(error)
    assert reason in str(error)
    assert len(error.problems) == 1


@pytest.mark.parametrize(
    "text",
    [
        "noon",
        "2026-02-29T01:02:03",
        "2026-11-21T01:02:03+02:00",
        "2026-11-21",
        "2026-11-21T12:59:60",
        "20261121",
    ],
)
def test_bad_time_is_named(tmp_path, text):
    error = caught(write_csv(tmp_path / "obs.csv", *extended("time_utc", [TIME] * 5 + [text])))
    reason = f"{text!r} is not an ISO 8601 time in UTC; write UTC as in 2026-11-21T01:02:03.5."
    assert str(error).endswith(f"line 7, column time_utc: {reason}")


def test_all_bad_rows_are_found(tmp_path):
    rows = changed(y_px_2="abc", dec_deg_2="x", ra_deg_4="999", x_px_0="nan")
    path = write_csv(
        tmp_path / "obs.csv", [*rows[:3], ["4", "1"], *rows[3:]], comment="# a comment\n\n"
    )
    error = caught(path)
    assert str(error).startswith(f"{path}, line 4, column x_px: nan is not a finite number; ")
    assert str(error).endswith("; correct or remove the row (3 more bad rows).")
    assert error.row == 4
    assert [p.removeprefix(f"{path}, ") for p in error.problems] == [
        "line 4, column x_px: nan is not a finite number; correct or remove the row.",
        "line 6, column y_px: 'abc' is not a number; correct or remove the row.",
        "line 6, column dec_deg: 'x' is not a number; correct or remove the row.",
        "line 7: 2 values under a header of 5 columns; correct or remove the row.",
        "line 9, column ra_deg: 999.0 is outside 0..360 deg; correct or remove the row.",
    ]


@pytest.mark.parametrize("ending", ENDINGS)
def test_each_format_names_the_place(tmp_path, ending):
    obs = random_table()
    dec = obs.dec_deg.copy()
    dec[[2, 17]] = 91.0
    path = tmp_path / f"obs{ending}"
    random_table(dec_deg=dec).save(path)
    error = caught(path)
    place = "row 3" if ending == ".parquet" else f"line {error.row}"
    assert str(error).startswith(f"{path}, {place}, column dec_deg: 91.0 is outside -90..90 deg; ")
    assert str(error).endswith("(1 more bad row).")
    if ending != ".parquet":
        assert ",91.0," in path.read_text(encoding="utf-8").splitlines()[error.row - 1]


def test_frames_are_not_counted_while_a_frame_number_is_unknown(tmp_path):
    """The row with the slip belongs to a frame that then seems short of a star."""
    error = caught(write_csv(tmp_path / "obs.csv", changed(frame_5="4x")))
    assert len(error.problems) == 1
    assert "'4x' is not a whole number" in str(error)


def test_same_star_in_two_frames_is_no_duplicate(tmp_path):
    obs = load_observations(
        write_csv(tmp_path / "obs.csv", *extended("star_id", ["a", "b", "c"] * 2))
    )
    assert obs.n_stars == 6
    assert (
        load_observations(write_csv(tmp_path / "obs.csv", changed(ra_deg_0="360.0"))).ra_deg[0]
        == 360.0
    )


def test_columns_in_other_units_frames_by_name_and_semicolons(tmp_path):
    path, plain = tmp_path / "mine.csv", load_observations(write_csv(tmp_path / "obs.csv", ROWS))
    lines = [
        f"night {r[0]}.tif;{float(r[1]) + 1!r};{r[2]};{float(r[3]) / 15!r};{r[4]}".replace(".", ",")
        for r in ROWS
    ]
    path.write_text("\n".join(["Image;X - 1;X [px];RA [h];Dec", *lines]))
    columns = {
        "frame": "Image",
        "x_px": "X - 1 - 1",
        "y_px": "X [px]",
        "ra_deg": "RA [h] * 15",
        "dec_deg": "Dec",
    }
    obs = load_observations(path, columns=columns)
    for name in ("x_px", "y_px", "ra_deg", "dec_deg"):
        np.testing.assert_allclose(obs.columns[name], plain.columns[name], rtol=1e-14)
    np.testing.assert_array_equal(obs.frame, np.searchsorted(plain.frame_ids, plain.frame))
    assert obs.meta["frame_names"].startswith("0 is 'night ") and obs.meta["ignored_columns"] == []
    # A column that is called so goes before what could be reckoned.
    assert (
        load_observations(path, columns=columns | {"x_px": "X - 1"}).x_px[0] == plain.x_px[0] + 1.0
    )
    with pytest.raises(ObservationError, match="column star_id holds no quantities"):
        load_observations(path, columns=columns | {"star_id": "RA [h] * 15"})


def test_missing_columns(tmp_path):
    path = write_csv(tmp_path / "obs.csv", [row[:3] for row in ROWS], ["frame", "x_px", "why"])
    error = caught(path)
    assert str(error) == (
        f"{path}: columns y_px, ra_deg, dec_deg are missing; the file has frame, x_px, why: give "
        '--column "y_px=NAME" --column "ra_deg=NAME" --column "dec_deg=NAME", or columns={...} in '
        "Python, with names from the file."
    )
    assert (error.row, error.column, len(error.problems)) == (None, "y_px", 3)
    near = write_csv(tmp_path / "near.csv", [row[:3] for row in ROWS], ["frame", "Xpix", "RA"])
    assert '--column "x_px=Xpix" --column "y_px=NAME" --column "ra_deg=RA"' in str(caught(near))
    # The guess for hours and radians can be followed as it stands.
    rows = [[*r[:3], float(r[3]) / 15.0, np.radians(float(r[4]))] for r in ROWS]
    others = write_csv(tmp_path / "units.csv", rows, [*HEADER[:3], "RA [h]", "dec_rad"])
    given = dict(re.findall(r'--column "(\w+)=([^"]+)"', str(caught(others))))
    plain = load_observations(write_csv(tmp_path / "obs.csv", ROWS))
    obs = load_observations(others, columns=given)
    np.testing.assert_allclose(obs.ra_deg, plain.ra_deg, rtol=1e-14)
    np.testing.assert_allclose(obs.dec_deg, plain.dec_deg, rtol=1e-14)
    twice = write_csv(tmp_path / "twice.csv", [[*row, "1"] for row in ROWS], [*HEADER, "x_px"])
    assert "column x_px occurs twice" in str(caught(twice))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("blank.csv", b" \n\n", "the file is empty"),
        ("comment.csv", b"# nothing\n", "comments only"),
        ("header.csv", b"frame,x_px,y_px,ra_deg,dec_deg\n", "a header but no rows"),
        ("latin.csv", b"frame,x_px,y_px,ra_deg,dec_deg\n1,2,3,4,\xe9\n", "line 2: the text is not"),
        ("quote.csv", b'frame,x_px,y_px,ra_deg,dec_deg\n1,2,3,4,"5\n', "check its quotation marks"),
        ("binary.parquet", b"frame,x_px\n1,2\n", "is not a readable table"),
        ("plain.ecsv", b"frame,x_px\n1,2\n", "line 1: '# %ECSV 1.0' is missing"),
        ("yaml.ecsv", b"# %ECSV 1.0\n# ---\n# a: [\nframe\n1\n", "the ECSV header is not valid"),
        ("obs.xlsx", b"PK", "the ending .xlsx is unknown; use .csv, .ecsv, .parquet, .fits,"),
        ("obs", b"frame", "the ending (none) is unknown"),
    ],
)
def test_bad_file_is_named(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_bytes(content)
    error = caught(path)
    assert str(error).startswith(str(path))
    assert message in str(error)
    assert path.read_bytes() == content


@pytest.mark.parametrize("ending", ENDINGS)
def test_save_asks_before_it_overwrites(tmp_path, ending):
    path = tmp_path / f"obs{ending}"
    path.write_bytes(b"mine")
    with pytest.raises(RunFolderError, match=r"exists already; .*--force"):
        random_table().save(path)
    assert path.read_bytes() == b"mine"
    random_table().save(path, force=True)
    assert_same(load_observations(path), random_table())


@pytest.mark.slow
def test_large_table_is_read_quickly(tmp_path):
    """15,000 rows, the paper's experiment."""
    obs = Observations(*(getattr(random_table(1000, 15), name) for name in HEADER))
    for ending, sorts in ((".csv", 2.4), (".parquet", 0.36)):
        path = tmp_path / f"obs{ending}"
        obs.save(path)
        load_observations(path)  # imports
        assert times_as_long(partial(load_observations, path, CAMERA), sort_a_million) < sorts


def test_columns_that_look_exchanged_are_said_so():
    c = campaign(np.random.default_rng(1), n_frames=4)
    sheet = Camera(**c.camera_toml(), coefficients=(0.0, 0.0))
    good = c.columns | {
        "ra_deg": 200.0 + 0.1 * c.columns["ra_deg"],
        "dec_deg": 0.5 * np.abs(c.columns["dec_deg"]),
    }
    swapped = {"ra_deg": good["dec_deg"], "dec_deg": good["ra_deg"]}
    wide, tall = (
        sheet.replace(height_px=700, y0_px=350.0),
        {"x_px": 0.6 * good["x_px"], "y_px": good["y_px"]},
    )
    far = {"x_px": np.append(good["x_px"][:-1], 5000.0)}
    pitch_mm = 1e-3 * sheet.pixel_um
    millimetres = {"x_px": pitch_mm * good["x_px"], "y_px": pitch_mm * good["y_px"]}
    hours_twice = {"ra_deg": 15.0 * good["ra_deg"]}
    for columns, used, words in (
        (swapped, sheet, "exchange ra_deg and dec_deg, which look swapped"),
        (tall, wide, "exchange x_px and y_px, which look swapped"),
        (far, sheet, "check the camera file"),
        (millimetres, sheet, f"divide both columns by the pixel pitch, {pitch_mm:g} mm"),
        (hours_twice, sheet, "check the unit of the whole column, or its factor"),
        (
            {"dec_deg": np.where(good["frame"] == 0, 95.0, good["dec_deg"])},
            sheet,
            "correct or remove the row",
        ),
    ):
        with pytest.raises(ObservationError, match=words):
            Observations(**(good | columns)).check(used)
