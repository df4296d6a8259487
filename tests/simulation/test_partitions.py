"""Simulated partitions: each by itself, resumed, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.attitude.rotations import random_rotations
from starcal_uq.core.errors import ObservationError, RunFolderError
from starcal_uq.core.store import UNFINISHED
from starcal_uq.likelihood.noise_model import NoiseModel
from starcal_uq.simulation.frames import Sky
from starcal_uq.simulation.partitions import simulate_partitions
from tests.helpers.crashes import snapshots


@pytest.fixture(scope="module")
def sky() -> tuple[sc.sky.StarCatalogue, sc.Camera]:
    return sc.load_catalogue(max_mag=6.0), sc.paper.paper_camera()


def test_files_depend_on_seed_and_number_alone(sky, tmp_path: Path) -> None:
    stars, camera = sky
    options = {"partition_frames": 20, "seed": 4, "workers": 0}
    five = simulate_partitions(stars, camera, tmp_path / "five", n_frames=90, **options)
    two = simulate_partitions(stars, camera, tmp_path / "two", n_frames=40, **options)
    assert [obs.n_frames for obs in five] == [20, 20, 20, 20, 10] and five.n_frames == 90
    a, b = list(five), list(two)
    assert [obs.data_hash for obs in a[:2]] == [obs.data_hash for obs in b]
    whole = sc.load_observations(five.parts[0].path)
    again = sc.simulate(stars, camera, n_frames=20, seed=4)
    assert set(whole.columns) == set(again.columns) and whole.meta["directions"] == "apparent"
    # Not the table of the same seed, but one like it: another noise on the same pixels of the same
    # stars.
    assert not np.array_equal(whole.x_px[:10], again.x_px[:10])
    clean = sc.simulate(stars, camera, n_frames=20, seed=4, sigma_px=0.0)
    assert np.std(again.x_px - clean.x_px) == pytest.approx(0.05, rel=0.15)


def test_frames_of_partitions_are_those_observed(sky, tmp_path: Path) -> None:
    """Not those of a mission, for which the noise of each frame would be left out."""
    stars, camera = sky
    (obs,) = simulate_partitions(stars, camera, tmp_path, n_frames=3, workers=0)
    assert obs.origin.frames is None and obs.meta["n_frames"] == 3
    model = NoiseModel(
        terms=(),
        coefficients=np.zeros(0),
        errors=np.zeros(0),
        level_px=0.1,
        multiplies=False,
        centre_px=np.zeros(2),
        corner_px=1.0,
        radius_range=np.zeros(2),
        mag_range=np.zeros(2),
        mag_reference=0.0,
        frame_dof=4.0,
        frame_ids=obs.frame_ids,
        frame_factors=np.array([1.0, 4.0, 9.0]),
        frame_mean=1.0,
    )
    own = model.sigma_px(obs)
    assert own == pytest.approx(own[0] * (1.0 + obs.frame))
    mission = model.sigma_px(obs.with_origin(frames="a mission"))
    assert mission == pytest.approx(mission[0])


def test_interrupted_simulation_goes_on(sky, tmp_path: Path) -> None:
    stars, camera = sky
    options = {"n_frames": 60, "partition_frames": 20, "workers": 0}

    def stop(done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_partitions(stars, camera, tmp_path, progress=stop, **options)
    with pytest.raises(ObservationError):
        sc.observations.open_partitions(tmp_path)
    kept = {path.name: path.stat().st_mtime_ns for path in (tmp_path / UNFINISHED).iterdir()}
    assert len(kept) == 2
    made = simulate_partitions(stars, camera, tmp_path, **options)
    assert made.n_frames == 60
    whole = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.parquet")}
    assert whole | kept == whole and not (tmp_path / UNFINISHED).exists()
    simulate_partitions(stars, camera, tmp_path, **options)
    assert {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.parquet")} == whole
    with pytest.raises(RunFolderError):
        simulate_partitions(stars, camera, tmp_path, seed=1, **options)


def test_files_of_another_call_are_replaced_at_once(sky, tmp_path: Path) -> None:
    stars, camera = sky
    folder = tmp_path / "work" / "parts"
    options = {"partition_frames": 10, "workers": 0}
    old = simulate_partitions(stars, camera, folder, n_frames=40, **options).data_hash
    with snapshots(folder.parent, tmp_path / "states") as states:
        new = simulate_partitions(stars, camera, folder, n_frames=20, seed=1, force=True, **options)
    assert new.n_frames == 20 and len(list(folder.glob("*.parquet"))) == 2
    found = [sc.observations.open_partitions(state / "parts").data_hash for state in states]
    assert set(found) == {old, new.data_hash} and found == sorted(
        found, key=[old, new.data_hash].index
    )
    # What nobody has recorded would be read with the new ones.
    (folder / "mine.parquet").write_bytes((folder / "part-000000.parquet").read_bytes())
    with pytest.raises(RunFolderError, match="1 other files that would mix"):
        simulate_partitions(stars, camera, folder, n_frames=20, force=True, **options)
    assert (folder / "mine.parquet").exists() and not (folder / UNFINISHED).exists()


def test_tree_finds_the_stars_that_a_look_at_all_finds(
    sky, monkeypatch: pytest.MonkeyPatch
) -> None:
    stars, camera = sky
    rotations = random_rotations(200, np.random.default_rng(3))
    fast = Sky(stars, camera, 0.3).views(rotations)
    monkeypatch.setattr("starcal_uq.simulation.frames._TREE_COSINE", 2.0)
    slow = Sky(stars, camera, 0.3).views(rotations)
    for (a, xy_a), (b, xy_b) in zip(fast, slow, strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(xy_a, xy_b)
