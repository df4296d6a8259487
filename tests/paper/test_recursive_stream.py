"""Frames from files larger than memory: the same stars, the same complaints, and no more memory
than a batch.
"""

import tracemalloc

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import ObservationError
from starcal_uq.paper.recursive.frames import stream_frames
from tests.helpers.scenes import camera, observations, with_sigmas

COLUMNS = ("frame", "x_px", "y_px", "ra_deg", "dec_deg", "sigma_px")


def write(obs, path, **columns):
    """A file with some columns replaced; Parquet as it is, CSV as text."""
    table = obs.to_dataframe()
    for name, values in columns.items():
        table[name] = values
    if path.suffix == ".csv":
        table.to_csv(path, index=False)
    else:
        table.to_parquet(path)
    return path


@pytest.mark.parametrize(
    ("ending", "batch_rows", "stated"),
    [
        (".parquet", 1, False),
        (".parquet", 100, True),
        (".csv", 7, True),
        (".csv", 10_000, False),
    ],
)
def test_frames_come_one_by_one_and_whole(tmp_path, ending, batch_rows, stated):
    """Whatever the batches cut."""
    obs = with_sigmas(observations()) if stated else observations()
    path = tmp_path / f"table{ending}"
    obs.save(path)
    stream = stream_frames(path, camera(), batch_rows=batch_rows)
    frames = list(stream)
    assert [f.n_frames for f in frames] == [1] * obs.n_frames
    assert [f.n_stars for f in frames] == obs.stars_per_frame.tolist()
    for name in COLUMNS:
        if getattr(obs, name) is None:
            assert all(getattr(f, name) is None for f in frames)
        else:
            assert np.array_equal(
                np.concatenate([getattr(f, name) for f in frames]), getattr(obs, name)
            )
    assert frames[0].meta["directions"] == ("apparent" if ending == ".parquet" else "undeclared")
    assert frames[0].meta["source"] == ("simulated" if ending == ".parquet" else str(path))
    # Reads again from the start.
    assert len(list(stream)) == obs.n_frames


@pytest.mark.parametrize("ending", [".parquet", ".csv"])
def test_columns_in_other_units_are_those_of_a_whole_table(tmp_path, ending):
    obs = observations(n_frames=4)
    table = obs.to_dataframe()[list(COLUMNS[:5])]
    table["X"], table["RA [h]"] = table.pop("x_px") + 1.0, table.pop("ra_deg") / 15.0
    path = tmp_path / f"table{ending}"
    columns = {"x_px": "X - 1", "ra_deg": "RA [h] * 15"}
    table.to_parquet(path) if ending == ".parquet" else table.to_csv(
        path, index=False, sep=";", decimal=","
    )
    whole = sc.load_observations(path, columns=columns)
    found = [stream_frames(path, camera(), columns, batch_rows=7)]
    if ending == ".parquet":
        found.append(sc.observations.open_partitions(tmp_path, camera(), columns))
        with pytest.raises(ObservationError, match="column RA is missing; the file has "):
            sc.observations.open_partitions(tmp_path, camera(), columns | {"ra_deg": "RA * 15"})
    for frames in found:
        frames = list(frames)
        for name in COLUMNS[:5]:
            np.testing.assert_array_equal(
                np.concatenate([getattr(f, name) for f in frames]), getattr(whole, name)
            )
    np.testing.assert_allclose(whole.ra_deg, obs.ra_deg, rtol=1e-14)


def test_a_folder_of_files_is_one_stream(tmp_path):
    obs = observations()
    parts = (obs.select(obs.frame < 25), obs.select(obs.frame >= 25))
    parts[0].save(tmp_path / "a.parquet")
    write(parts[1], tmp_path / "b.csv")
    (tmp_path / "notes.txt").write_text("not a table")
    frames = list(stream_frames(tmp_path, batch_rows=50))
    assert [int(f.frame[0]) for f in frames] == obs.frame_ids.tolist()
    write(parts[1].select_frames([30]), tmp_path / "c.csv")
    with pytest.raises(
        ObservationError, match=r"c\.csv, line 2: frame 30 comes back after other frames; sort"
    ):
        list(stream_frames(tmp_path))


@pytest.mark.parametrize("ending", [".parquet", ".csv"])
@pytest.mark.parametrize("batch_rows", [5, 10_000])
def test_a_frame_in_two_places_is_named(tmp_path, ending, batch_rows):
    obs = observations()
    frame = obs.frame.copy()
    frame[-4:] = frame[0]
    row = obs.n_stars - 3 + (ending == ".csv")
    path = write(obs, tmp_path / f"mixed{ending}", frame=frame)
    with pytest.raises(
        ObservationError, match=f"{row}: frame 0 comes back after other frames; sort the table"
    ) as caught:
        list(stream_frames(path, batch_rows=batch_rows))
    assert caught.value.row == row


@pytest.mark.parametrize("ending", [".parquet", ".csv"])
@pytest.mark.parametrize("batch_rows", [20, 10_000])
def test_bad_rows_are_named_with_their_place_in_the_file(tmp_path, ending, batch_rows):
    obs, bad = observations(), 500
    number = bad + 1 if ending == ".parquet" else bad + 2
    cases = {"x_px": 5000.0, "dec_deg": 91.0, "ra_deg": float("nan"), "y_px": float("inf")}
    for column, value in cases.items():
        values = getattr(obs, column).copy()
        values[bad] = value
        path = write(obs, tmp_path / f"bad{ending}", **{column: values})
        with pytest.raises(ObservationError) as caught:
            list(stream_frames(path, camera(), batch_rows=batch_rows))
        assert (caught.value.row, caught.value.column) == (number, column)
        with pytest.raises(ObservationError) as loaded:
            sc.load_observations(path, camera())
        assert str(loaded.value) == str(caught.value)


def test_frames_before_a_bad_row_are_given_out(tmp_path):
    obs = observations()
    values = obs.x_px.copy()
    values[-1] = 5000.0
    stream = iter(
        stream_frames(write(obs, tmp_path / "bad.parquet", x_px=values), camera(), batch_rows=100)
    )
    given = 0
    with pytest.raises(ObservationError):
        for _ in stream:
            given += 1
    assert given > 40


def test_other_complaints_are_those_of_the_loader(tmp_path):
    obs = observations()
    two = obs.select(np.arange(obs.n_stars) != 0).select(
        np.arange(obs.n_stars - 1) >= obs.stars_per_frame[0] - 3
    )
    twice = {name: getattr(obs, name).copy() for name in ("ra_deg", "dec_deg")}
    for values in twice.values():
        values[1] = values[0]
    head = b"frame,x_px,y_px,ra_deg,dec_deg\n"
    files = {
        "short.csv": b"frame,x_px,y_px,ra_deg\n0,1,2,3\n",
        "ragged.csv": head + b"0,1,2,3\n",
        "empty.csv": b"",
        "quoted.csv": head + b'0,"1,2,3,4\n',
        "broken.parquet": b"PAR1 and then nothing",
    }
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    paths = [
        write(two, tmp_path / "two.parquet"),
        write(obs, tmp_path / "twice.parquet", **twice),
        *(tmp_path / name for name in files),
    ]
    for path in paths:
        with pytest.raises(ObservationError) as streamed:
            list(stream_frames(path, batch_rows=9))
        with pytest.raises(ObservationError) as loaded:
            sc.load_observations(path)
        assert str(streamed.value) == str(loaded.value)
    # A stream knows neither whether rows follow nor the line of what it cannot decode.
    for content, words in ((head, "has no rows"), (head + b"0,\xff,2,3,4\n", "UTF-8")):
        (tmp_path / "odd.csv").write_bytes(content)
        with pytest.raises(ObservationError, match=words):
            list(stream_frames(tmp_path / "odd.csv"))
    text = ["0.1" if k < 400 else "" for k in range(obs.n_stars)]
    path = write(obs, tmp_path / "gaps.csv", sigma_px=text)
    with pytest.raises(ObservationError) as caught:
        list(stream_frames(path, batch_rows=50))
    assert (caught.value.row, caught.value.column) == (402, "sigma_px")


@pytest.mark.extra("images")
def test_what_cannot_be_streamed_is_refused_at_once(tmp_path):
    observations().save(tmp_path / "table.ecsv")
    path = write(observations(), tmp_path / "table.parquet")
    (tmp_path / "empty").mkdir()
    for source, options, words in (
        (tmp_path / "empty", {}, r"holds no \.parquet or \.csv file"),
        (tmp_path / "table.ecsv", {}, r"\.ecsv cannot be streamed; save the table as \.parquet or"),
        (path, {"columns": {"x": "u"}}, "'x' is no column of observations"),
        (path, {"batch_rows": 0}, "batch_rows is 0"),
    ):
        with pytest.raises(ObservationError, match=words):
            stream_frames(source, **options)


def test_frame_numbers_need_not_be_in_order(tmp_path):
    """They need only stay together: 60 frames numbered at random."""
    obs = observations()
    numbers = np.random.default_rng(0).permutation(1000)[: obs.n_frames]
    path = write(obs, tmp_path / "table.parquet", frame=np.repeat(numbers, obs.stars_per_frame))
    assert [int(f.frame[0]) for f in stream_frames(path, batch_rows=64)] == numbers.tolist()


def test_memory_is_that_of_a_batch(tmp_path):
    """150,000 rows in row groups of 4096, read 2048 at a time; the whole table would be 6 MB."""
    import pyarrow as pa
    from pyarrow import parquet

    obs = observations()
    copies = 150_000 // obs.n_stars
    frame = np.concatenate([obs.frame + k * 1000 for k in range(copies)])
    columns = {
        name: np.tile(getattr(obs, name), copies) for name in ("x_px", "y_px", "ra_deg", "dec_deg")
    }
    table = pa.table({"frame": frame} | columns)
    path = tmp_path / "large.parquet"
    parquet.write_table(table, path, row_group_size=4096)
    whole = table.nbytes
    assert whole > 5.5e6
    del table, frame, columns
    pool = pa.default_memory_pool()
    before = pool.bytes_allocated()
    most = 0
    tracemalloc.start()
    try:
        for count, _ in enumerate(stream_frames(path, batch_rows=2048)):
            if count % 50 == 0:
                most = max(most, pool.bytes_allocated() - before)
        python = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert count + 1 == copies * obs.n_frames
    assert most < 0.15 * whole
    assert python < 0.15 * whole
