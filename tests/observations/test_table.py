"""The observations table in memory."""

import numpy as np
import pytest

from starcal_uq.core.errors import ObservationError
from starcal_uq.observations.columns import COLUMNS
from starcal_uq.observations.table import Observations
from tests.observations.test_files import CAMERA, assert_same, random_table


def test_rows_are_sorted_by_frame_and_keep_their_order_within():
    a = np.arange(5.0)
    obs = Observations([7, 2, 7, 2, 2], a, a, a, a, mag=[1, 2, 3, 4, 5])
    np.testing.assert_array_equal(obs.frame, [2, 2, 2, 7, 7])
    np.testing.assert_array_equal(obs.x_px, [1, 3, 4, 0, 2])
    np.testing.assert_array_equal(obs.mag, [2, 4, 5, 1, 3])
    np.testing.assert_array_equal(obs.frame_ids, [2, 7])
    np.testing.assert_array_equal(obs.frame_starts, [0, 3, 5])
    np.testing.assert_array_equal(obs.stars_per_frame, [3, 2])
    assert (obs.n_stars, obs.n_frames, len(obs)) == (5, 2, 5)
    assert (obs.frame.dtype, obs.frame_starts.dtype, obs.mag.dtype) == (
        np.int64,
        np.int64,
        np.float64,
    )


def test_arrays_are_copies_that_cannot_be_changed():
    x = np.arange(20.0)
    obs = random_table(x_px=x)
    x[0] = 99.0
    assert obs.x_px[0] == 0.0
    for values in (
        *obs.columns.values(),
        obs.xy,
        obs.directions_icrs,
        obs.frame_ids,
        obs.frame_starts,
    ):
        with pytest.raises((TypeError, ValueError)):
            values[0] = values[1]


def test_directions_are_unit_vectors():
    obs = Observations(
        [0] * 4, np.zeros(4), np.arange(4), [0.0, 90.0, 45.0, 10.0], [0.0, 0.0, 45.0, -90.0]
    )
    expected = [[1, 0, 0], [0, 1, 0], [0.5, 0.5, np.sqrt(0.5)], [0, 0, -1]]
    np.testing.assert_allclose(obs.directions_icrs, expected, atol=1e-16)
    np.testing.assert_array_equal(obs.xy, np.column_stack([np.zeros(4), np.arange(4)]))


def test_declared_directions():
    assert not random_table(meta={}).directions_declared
    assert random_table(meta={}).meta["directions"] == "undeclared"
    obs = random_table(meta={"seed": 1})
    assert obs.with_meta(directions="apparent").directions_declared
    assert obs.with_meta(directions="apparent").meta["seed"] == 1
    assert not obs.directions_declared
    with pytest.raises(ObservationError, match="'true'; use apparent, catalogue or undeclared"):
        obs.with_meta(directions="true")


def test_hash_depends_on_values_alone():
    obs = random_table()
    assert obs.data_hash == random_table(meta={}).data_hash
    assert len(obs.data_hash) == 64
    x = obs.x_px.copy()
    x[3] = np.nextafter(x[3], np.inf)
    changes = [
        {"x_px": x},
        {"mag": None},
        {"star_id": obs.star_id[::-1]},
        {"x_px": obs.y_px, "y_px": obs.x_px},
    ]
    assert len({obs.data_hash, *(random_table(**c).data_hash for c in changes)}) == 5
    assert random_table(x_px=np.zeros(20)).data_hash == random_table(x_px=-np.zeros(20)).data_hash


def test_select():
    obs = random_table()
    picked = obs.select(obs.x_px > 500.0)
    np.testing.assert_array_equal(picked.star_id, obs.star_id[obs.x_px > 500.0])
    assert picked.meta == obs.meta
    two = obs.select_frames([5, -1])
    np.testing.assert_array_equal(two.frame_ids, [-1, 5])
    assert two.n_stars == 10
    assert obs.select(np.zeros(20, dtype=bool)).n_frames == 0
    with pytest.raises(ObservationError, match="true or false for each of the 20 rows"):
        obs.select([0, 1])
    with pytest.raises(ObservationError, match="no frame 77"):
        obs.select_frames([-1, 77])


@pytest.mark.extra("images")
def test_to_dataframe_and_table():
    obs = random_table()
    frame = obs.to_dataframe()
    assert list(frame.columns) == list(COLUMNS)
    assert frame.attrs == obs.meta
    frame.loc[0, "x_px"] = 3.0
    assert_same(Observations(**{name: obs.to_dataframe()[name] for name in COLUMNS}), obs)
    assert len(obs.head(3)) == 3
    table = obs.to_table()
    assert str(table["ra_deg"].unit) == "deg"
    assert str(table["temperature_c"].unit) == "deg_C"
    assert table.meta["directions"] == "catalogue"


def test_html_escapes_names():
    page = random_table(star_id=np.array(["<b>"] * 20))._repr_html_()
    assert "&lt;b&gt;" in page
    assert "20 stars in 4 frames" in page
    assert repr(random_table()).startswith("Observations(20 stars, 4 frames")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"y_px": np.zeros(3)}, "y_px has 3 rows and frame has 20"),
        ({"frame": np.full(20, 1.5)}, "frame holds fractions"),
        ({"frame": np.full(20, np.nan)}, "frame holds fractions"),
        ({"x_px": ["a"] * 20}, "column x_px holds other things than numbers"),
        ({"x_px": np.zeros((20, 2))}, r"column x_px has shape \(20, 2\)"),
    ],
)
def test_columns_that_do_not_fit(changes, message):
    with pytest.raises(ObservationError, match=message):
        random_table(**changes)


def test_a_column_without_any_value_is_absent():
    obs = random_table(mag=np.full(20, np.nan), star_id=[None] * 20)
    assert obs.mag is None
    assert obs.star_id is None
    # Missing names from pandas become empty, not the words None and nan.
    names = np.array(["a", None, np.nan] + ["b"] * 17, dtype=object)
    assert random_table(star_id=names).star_id[:4].tolist() == ["a", "", "", "b"]


def test_check_of_a_table_in_memory():
    obs = random_table()
    obs.check()
    obs.check(CAMERA)
    x = obs.x_px.copy()
    x[[6, 9]] = 2000.0
    random_table(x_px=x).check()
    with pytest.raises(ObservationError, match=r"^observations, row 7, column x_px: 2000.0 .*"):
        random_table(x_px=x).check(CAMERA)
    with pytest.raises(ObservationError, match="row 1, column time_utc"):
        random_table(time_utc=["noon"] * 20).check()
