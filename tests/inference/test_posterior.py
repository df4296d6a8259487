"""A posterior keeps every bit in its file, and shows itself with units."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.formatting import pretty_unit
from starcal_uq.inference import arviz as arviz_compat
from starcal_uq.inference.posterior import DRAW_ORDER, Posterior
from starcal_uq.inference.sample import sample
from tests.helpers.gaussian_camera import gaussian_calibration
from tests.helpers.same import assert_same


@pytest.fixture(scope="module")
def post() -> Posterior:
    return sample(
        None, gaussian_calibration(), n_walkers=16, n_steps=100, seed=7, evaluation="compressed"
    )


@pytest.fixture(scope="module")
def given() -> Posterior:
    return sample(
        None,
        gaussian_calibration(),
        sigma=0.05,
        n_walkers=16,
        n_steps=20,
        seed=7,
        evaluation="compressed",
    )


@pytest.mark.parametrize("which", ["post", "given"])
def test_file_round_trip_is_lossless(which, tmp_path, request):
    original = request.getfixturevalue(which)
    path = tmp_path / "posterior.nc"
    original.save(path)
    assert_same(Posterior.load(path), original)
    with pytest.raises(RunFolderError):
        original.save(path)
    original.save(path, force=True)
    assert [p.name for p in tmp_path.iterdir()] == ["posterior.nc"]


def test_opening_a_file_needs_no_heavy_library(post: Posterior, tmp_path: Path) -> None:
    path = tmp_path / "posterior.nc"
    post.save(path)
    code = (
        "import sys; from starcal_uq.inference.posterior import Posterior; "
        f"p = Posterior.load({str(path)!r}); p.mean, p.covariance, p.sd, p.thin(5, 1); "
        "heavy = {'casadi', 'emcee', 'matplotlib', 'arviz', 'arviz_stats', 'scipy', 'pandas'} & "
        "set(sys.modules); "
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_every_place_of_the_draws_states_its_unit(post: Posterior, tmp_path: Path) -> None:
    """The same draws stand plain at the top of the file and in the data frame."""
    import xarray as xr

    post.save(tmp_path / "posterior.nc")
    units = {"x0": "px", "y0": "px", "f": "px", "k1": "px^-2", "k2": "px^-4", "sigma": "px"}
    with xr.open_dataset(tmp_path / "posterior.nc", engine="h5netcdf") as file:
        stated = dict(
            zip(file["draws"].columns.split(", "), file["draws"].units.split(", "), strict=True)
        )
        plain = file["draws"].values
    table = post.to_dataframe()
    assert stated == units == table.attrs["units"]
    assert np.array_equal(plain, table[list(units)].to_numpy())
    with xr.open_dataset(tmp_path / "posterior.nc", group="posterior", engine="h5netcdf") as file:
        assert all("units" in file[name].attrs for name in units)
        assert file["k1"].attrs["units"] == "1e-10 px^-2"
        # Control: by their units the two are the same number, and by their values alone they are
        # not.
        scale = float(file["k1"].units.split()[0])
        assert np.allclose(file["k1"].values.ravel() * scale, plain[:, 3], rtol=1e-12, atol=0.0)
        assert not np.allclose(file["k1"].values.ravel(), plain[:, 3])


def test_arviz_data_has_scaled_coefficients_units_and_provenance(post: Posterior) -> None:
    data = post.data
    assert data.posterior["k1"].shape == (4, 1600)
    assert data.posterior["k1"].attrs["units"] == "1e-10 px^-2"
    assert float(data.posterior["k1"].mean()) == pytest.approx(2.0, abs=0.1)
    assert data.posterior.attrs["draw_order"] == DRAW_ORDER
    assert '"seed": 7' in data.posterior.attrs["provenance"]
    assert data.sample_stats["lp"].shape == (4, 1600)
    assert np.array_equal(data.sample_stats["lp"].values.ravel(), post.log_posterior)
    assert np.array_equal(data.posterior["f"].values, post.draws[:, 2].reshape(4, -1))
    assert post.data is data


def test_scaling_saves_the_monte_carlo_error(post: Posterior) -> None:
    # ArviZ takes a range below 1e-15 for a constant and calls every draw independent.
    k2 = post.draws[:, 4].reshape(4, -1)
    assert np.ptp(k2) < 1e-15
    assert arviz_compat.mcse_mean(k2) == pytest.approx(k2.std() / np.sqrt(k2.size), rel=1e-3)
    assert post.diagnostics.mcse[4] > 1.2 * arviz_compat.mcse_mean(k2)


def test_given_noise_is_an_attribute_not_a_variable(given: Posterior) -> None:
    assert "sigma" not in given.data.posterior
    assert given.data.posterior.attrs["sigma_given"] == 0.05


def test_summary_has_plain_and_scaled_numbers(post: Posterior) -> None:
    table = post.summary().set_index("parameter")
    assert list(table.index) == ["x0", "y0", "f", "k1", "k2", "sigma"]
    row = table.loc["k1"]
    assert row["unit"] == "px^-2"
    assert row["scaled_unit"] == "1e-10 px^-2"
    for name in ("prior_mean", "prior_sd", "mean", "sd", "q2.5", "q50", "q97.5", "mcse"):
        assert row[f"scaled_{name}"] == pytest.approx(row[name] / 1e-10)
    assert row["q2.5"] < row["mean"] < row["q97.5"]
    assert {"rhat", "ess_bulk", "ess_tail"} <= set(table.columns)


def test_draws_table_knows_where_each_draw_came_from(post: Posterior) -> None:
    table = post.to_dataframe()
    assert len(table) == len(post.draws)
    assert np.array_equal(table["f"], post.draws[:, 2])
    first = table[(table["ensemble"] == 1) & (table["walker"] == 3)]
    assert sorted(first["step"]) == list(range(100))
    # The first half of the steps of all walkers comes before the second half of any.
    assert table["step"].iloc[: 16 * 50].max() == 49


def test_thinning_takes_each_draw_at_most_once(post: Posterior) -> None:
    some = post.thin(300, seed=1)
    assert some.shape == (300, 6)
    assert np.array_equal(some, post.thin(300, seed=1))
    assert set(map(bytes, some)) <= set(map(bytes, post.draws))
    assert len(post.thin(10**9, seed=1)) == len(post.draws)


def test_html_shows_verdict_and_table(post: Posterior) -> None:
    html = post._repr_html_()
    assert "passes every check" in html
    assert pretty_unit("1e-10 px^-2") in html
    assert "Importance sampling" in html
