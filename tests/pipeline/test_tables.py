"""What is said of a table beside it: the time of rows that have none."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.pipeline.tables import observations_from_table, partitions_from_folder

TIME = "2026-11-25T02:00:00"


def test_a_time_beside_the_table_is_that_of_its_rows(tmp_path: Path) -> None:
    camera, place = sc.paper.paper_start(), np.linspace(10.0, 40.0, 12)
    obs = sc.Observations(
        frame=np.repeat(np.arange(4), 3),
        x_px=place,
        y_px=place,
        ra_deg=place,
        dec_deg=place,
        time_utc=np.full(12, TIME),
    )
    (tmp_path / "parts").mkdir()
    bare, timed = dataclasses.replace(obs, time_utc=None), tmp_path / "timed.parquet"
    obs.save(timed)
    for path in (tmp_path / "bare.parquet", tmp_path / "parts" / "a.parquet"):
        bare.save(path)
    wanted = observations_from_table(timed, camera, directions="catalogue")
    assert wanted.ra_deg[0] != obs.ra_deg[0]
    for found in (
        observations_from_table(
            tmp_path / "bare.parquet", camera, directions="catalogue", time_utc=f"{TIME}Z"
        ),
        next(
            iter(
                partitions_from_folder(
                    tmp_path / "parts", camera, directions="catalogue", time_utc=TIME
                )
            )
        ),
    ):
        np.testing.assert_array_equal(found.ra_deg, wanted.ra_deg)
    undeclared = partitions_from_folder(tmp_path / "parts", camera, time_utc=TIME)
    assert undeclared.meta["directions"] == "undeclared" and set(undeclared.sample().time_utc) == {
        TIME
    }
    # With a file beside it whose rows have times a folder is as it was; where all have, the time
    # means nothing.
    full = tmp_path / "full"
    full.mkdir()
    for number, folder in enumerate((full, full, tmp_path / "parts"), 1):
        dataclasses.replace(obs, frame=obs.frame + 100 * number).save(folder / f"{number}.parquet")
    assert partitions_from_folder(tmp_path / "parts", camera, time_utc=TIME).n_stars == 24
    for path, read in ((timed, observations_from_table), (full, partitions_from_folder)):
        with pytest.raises(
            sc.errors.ObservationError,
            match=rf"{path}: every row has a time \(column time_utc\): leave out --time",
        ):
            read(path, camera, time_utc=TIME)
