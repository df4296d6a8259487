"""A folder of partitions: what is read of it, and what is refused."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

import starcal_uq as sc
from starcal_uq.core.errors import ObservationError
from starcal_uq.observations.partitions import open_partitions


def table(frames: list[int], n: int = 4, **more: object) -> sc.Observations:
    rng = np.random.default_rng(frames[0])
    frame = np.repeat(frames, n)
    size = len(frame)
    xy = rng.uniform(0.0, 100.0, (2, size))
    columns = {
        "ra_deg": rng.uniform(0.0, 360.0, size),
        "dec_deg": rng.uniform(-90.0, 90.0, size),
        **more,
    }
    return sc.Observations(frame=frame, x_px=xy[0], y_px=xy[1], **columns)  # type: ignore[arg-type]


def test_opening_reads_metadata_only(tmp_path: Path) -> None:
    table([5, 6, 9]).save(tmp_path / "a.parquet")
    table([1, 2]).save(tmp_path / "b.parquet")
    found = open_partitions(tmp_path)
    assert [part.path.name for part in found.parts] == ["b.parquet", "a.parquet"]
    assert (found.n_stars, found.n_frames, len(found)) == (20, 5, 20)
    assert [obs.frame_ids.tolist() for obs in found] == [[1, 2], [5, 6, 9]]
    before = found.data_hash
    (tmp_path / "b.parquet").rename(tmp_path / "z.parquet")
    assert open_partitions(tmp_path).data_hash == before


def test_sample_is_spread_over_the_files_with_all_columns(tmp_path: Path) -> None:
    for i in range(20):
        frames = list(range(100 * i, 100 * i + 10))
        names = np.array([f"star {k}" for k in range(40)])
        table(frames, star_id=names).save(tmp_path / f"{i:02d}.parquet")
    found = open_partitions(tmp_path)
    sample = found.sample(32)
    assert sample.n_frames == 32 and sample.star_id is not None
    assert {0, 19} <= set((sample.frame_ids // 100).tolist())
    whole = sc.load_observations(tmp_path / "00.parquet")
    first = sample.select(sample.frame < 100)
    np.testing.assert_array_equal(first.x_px, whole.select_frames(first.frame_ids).x_px)
    assert found.sample(1000).n_frames == 160


@pytest.mark.parametrize("statistics", [True, False])
def test_frame_numbers_of_two_files(tmp_path: Path, statistics: bool) -> None:
    for name, frames in (("a", [1, 3, 5]), ("b", [2, 4, 5])):
        columns = {key: pa.array(values) for key, values in table(frames).columns.items()}
        parquet.write_table(
            pa.table(columns), tmp_path / f"{name}.parquet", write_statistics=statistics
        )
    with pytest.raises(ObservationError, match=r"b.parquet: frame 5 is in a.parquet too"):
        open_partitions(tmp_path)
    table([2, 4, 6]).save(tmp_path / "b.parquet", force=True)
    assert open_partitions(tmp_path).n_frames == 6


def test_damaged_or_mismatched_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ObservationError, match=r"holds no .parquet file"):
        open_partitions(tmp_path)
    with pytest.raises(ObservationError, match="is no directory"):
        open_partitions(tmp_path / "nothing")
    table([1]).save(tmp_path / "a.parquet")
    with pytest.raises(ObservationError, match="open_partitions"):
        sc.load_observations(tmp_path)
    path = tmp_path / "b.parquet"
    path.write_bytes(b"PAR1 no more")
    with pytest.raises(ObservationError, match=r"b.parquet: is not a readable table"):
        open_partitions(tmp_path)
    table([2], sigma_px=np.full(4, 0.1)).save(path, force=True)
    with pytest.raises(ObservationError, match=r"a.parquet: column sigma_px is missing, and"):
        open_partitions(tmp_path)
    table([2]).with_meta(directions="apparent").save(path, force=True)
    with pytest.raises(ObservationError, match=r"b.parquet: its directions are apparent, those of"):
        open_partitions(tmp_path)
    parquet.write_table(pa.table({"frame": [1], "x_px": [1.0]}), path)
    with pytest.raises(ObservationError, match=r"b.parquet: column y_px is missing"):
        open_partitions(tmp_path)
    with pytest.raises(ObservationError, match="'rat' is no column"):
        open_partitions(tmp_path, columns={"rat": "ra"})
