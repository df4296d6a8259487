"""Studies: cells against analytic scalings, the paper's set-up, plans and derivatives made by hand;
definitions.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import RunFolderError, StudyError
from starcal_uq.paper import paper_camera
from starcal_uq.simulation.sensor import Sensor
from starcal_uq.studies import TEMPLATES, Study, StudyDefinition, cells, write_study_template
from starcal_uq.studies.axes import camera_of
from starcal_uq.studies.geometry import Geometry, GeometryKey, Heaven, statements, take_frames

ARCSEC = 648_000.0 / np.pi


def definition(**changes: object) -> StudyDefinition:
    """Fisher cells of the paper's camera."""
    usual: dict[str, object] = {
        "camera": paper_camera(),
        "sweep": {"frames": (250, 1000), "sigma_px": (0.05, 0.1, 0.2)},
        "observation": {"min_stars": 10},
        "seed": 1,
    }
    return StudyDefinition(**{**usual, **changes})  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def small() -> Study:
    """Six cells."""
    return sc.study(definition(), workers=0)


def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A list that grows by one with every cell that is computed."""
    calls: list[int] = []
    compute = cells.FisherCells.numbers
    monkeypatch.setattr(
        cells.FisherCells, "numbers", lambda self, cell: calls.append(1) or compute(self, cell)
    )
    return calls


# --- what a cell says


def test_parameters_of_a_study_have_their_own_units(small: Study, tmp_path: Path) -> None:
    import xarray as xr

    small.save(tmp_path)
    units = {"x0": "px", "y0": "px", "f": "px", "k1": "px^-2", "k2": "px^-4"}
    with xr.open_dataset(tmp_path / "study.nc", engine="h5netcdf") as file:
        assert (
            dict(zip(file["parameter"].values, file["parameter_unit"].values, strict=True)) == units
        )
        along = [
            name
            for name, array in file.data_vars.items()
            if "parameter" in array.dims and "units" in array.attrs
        ]
        assert {file[name].units for name in along} == {", ".join(units.values())}
        assert {"truth", "sigma", "sigma_curve"} <= set(along)
    table = small.table()
    assert dict(zip(table["parameter"], table["unit"], strict=True)) == units
    # A file of before, without that coordinate, is read.
    small.data.drop_vars("parameter_unit").pipe(Study, small.definition).save(tmp_path)
    assert Study.load(tmp_path).table()["unit"].tolist() == table["unit"].tolist()


def test_a_sensor_ages_as_its_photons_do() -> None:
    """With photons alone, ten years that take 3 % of the light each cost the root of 0.97^-10."""
    quiet = Sensor(
        background_e_px_s=0.0,
        dark_e_px_s=0.0,
        read_noise_e=0.0,
        gain_e_per_count=0.5,
        full_well_e=1e9,
        bits=16,
        transmission_loss_per_year=0.03,
    )
    wanted = definition(sweep={"age_years": (0.0, 10.0)}, sensor=quiet)
    nea = sc.study(wanted, workers=0).data["nea_arcsec"].squeeze().values
    places = nea if nea.shape[0] == 2 else nea.T
    assert places[1] / places[0] == pytest.approx(np.full(3, 0.97**-5.0), rel=0.02)
    # Control: dark current grows as well, and costs more.
    darker = definition(
        sweep={"age_years": (0.0, 10.0)}, sensor=quiet.replace(dark_growth_e_px_s=500.0)
    )
    nea = sc.study(darker, workers=0).data["nea_arcsec"].squeeze().values
    places = nea if nea.shape[0] == 2 else nea.T
    assert np.all(places[1] / places[0] > 1.1 * 0.97**-5.0)


def test_a_sensor_and_its_axes_belong_together() -> None:
    with pytest.raises(StudyError, match=r"add a section \[sensor\]"):
        definition(sweep={"age_years": (0.0, 10.0)}).check()
    with pytest.raises(StudyError, match="sigma_px and the sensor both set the noise"):
        definition(sensor=Sensor()).check()
    kept = definition(sweep={"age_years": (0.0, 10.0)}, sensor=Sensor(bits=14)).to_dict()
    assert StudyDefinition.from_dict(kept).sensor == Sensor(bits=14)


def test_sigma_follows_noise_exactly_and_frames_by_the_root(small: Study) -> None:
    sigma = small.data["sigma"].values
    assert sigma.shape == (6, 5)
    np.testing.assert_allclose(sigma[1], 2.0 * sigma[0], rtol=1e-9)
    # Stars near the edge are left out, and more of them where the noise is larger; with them go
    # some frames.
    np.testing.assert_allclose(sigma[2], 4.0 * sigma[0], rtol=0.1)
    # Another campaign of four times the frames: the root but for the choice of frames.
    np.testing.assert_allclose(sigma[0] / sigma[3], 2.0, rtol=0.15)
    assert small.ok.all()
    assert small.axes == ("frames", "sigma_px")


def test_a_cell_agrees_with_a_plan(small: Study) -> None:
    plan = sc.plan(
        paper_camera(),
        sc.load_catalogue(6.0, 2026.9),
        n_frames=(1000,),
        sweeps=False,
        n_geometries=600,
        seed=3,
    )
    names = ("x0_px", "y0_px", "f_px", "k1_per_px2", "k2_per_px4")
    expected = [plan.forecast.of(name)[0] for name in names]
    np.testing.assert_allclose(small.data["sigma"].values[3], expected, rtol=0.08)
    cell = small.data.isel(cell=3)
    # The roll that is common to all frames is a mean of rolls of either sign: chance, for any
    # number of frames.
    for name, axis in (("pitch", 0), ("yaw", 1)):
        assert cell["common_rotation_arcsec"].values[axis] == pytest.approx(
            plan.forecast.of(f"common_{name}_arcsec")[0], rel=0.1
        )
        assert cell["frame_error_arcsec"].values[axis] == pytest.approx(
            plan.forecast.of(f"rest_{name}_arcsec")[0], rel=0.15
        )
    np.testing.assert_allclose(cell["nea_arcsec"].values, plan.nea_arcsec, rtol=0.1)


def frames_by_hand(n: int) -> Geometry:
    key = GeometryKey(paper_camera(), 6.0, 10, 1.0, "random", n, (1, 0))
    return take_frames(key, Heaven(sc.load_catalogue(6.0)), 300)


def test_information_and_response_by_differences_of_a_formula_of_our_own() -> None:
    """Nothing of the package but the frames: Brown's formula, derivatives by differences, attitudes
    eliminated.
    """
    geometry = frames_by_hand(4)
    found = statements(geometry, np.full(len(geometry.star), 0.05), False)
    theta = paper_camera().theta
    steps = np.array([1e-3, 1e-3, 1e-3, 1e-13, 1e-19])
    responses = []
    for k in range(4):
        stars = slice(geometry.starts[k], geometry.starts[k + 1])
        b = geometry.depth.directions[geometry.star[stars]] @ geometry.rotations[k].T

        def seen(phi: np.ndarray, t: np.ndarray, b: np.ndarray = b) -> np.ndarray:
            turned = b + np.cross(phi, b)
            u, v = t[2] * turned[:, 0] / turned[:, 2], t[2] * turned[:, 1] / turned[:, 2]
            grown = 1.0 + t[3] * (u * u + v * v) + t[4] * (u * u + v * v) ** 2
            return np.concatenate([t[0] + u * grown, t[1] + v * grown])

        zero = np.zeros(3)
        np.testing.assert_allclose(seen(zero, theta), geometry.pixel[stars].T.ravel(), atol=1e-7)
        h = np.stack(
            [
                (seen(zero, theta + d) - seen(zero, theta - d)) / (2.0 * d.sum())
                for d in np.diag(steps)
            ],
            1,
        )
        a = np.stack([(seen(d, theta) - seen(-d, theta)) / 2e-6 for d in 1e-6 * np.eye(3)], 1)
        response = np.linalg.lstsq(a, h, rcond=None)[0]
        responses.append(-response)
        remainder = (h - a @ response) / 0.05
        information = remainder.T @ remainder
        scale = np.sqrt(np.diag(information))
        np.testing.assert_allclose(
            found.information[k] / np.outer(scale, scale),
            information / np.outer(scale, scale),
            atol=1e-5,
        )
    size = np.abs(np.mean(responses, axis=0)).max(axis=0)
    np.testing.assert_allclose(found.common / size, np.mean(responses, axis=0) / size, atol=1e-5)


def test_a_prior_narrows_what_it_is_about() -> None:
    """The covariance is the inverse of the sum of both informations; a set's other entries stay
    free.
    """
    priors = {"ground": {"focal_fraction": 1e-6}, "axis": {"principal_point_px": 0.01}}
    found = sc.study(
        definition(
            sweep={"prior": ("flat", "ground", "axis")}, priors=priors, observation={"frames": 100}
        ),
        workers=0,
    )
    sigma, data = found.data["sigma"].values, found.data["sigma_data"].values
    np.testing.assert_allclose(data, np.broadcast_to(data[0], data.shape))
    np.testing.assert_allclose(sigma[0], data[0])
    focal = 1e-6 * paper_camera().focal_px
    correlation, s = found.data["correlation"].values[0], data[0]
    # Conditioning on f by a measurement of its own.
    gain = s[2] ** 2 / (s[2] ** 2 + focal**2)
    np.testing.assert_allclose(
        sigma[1], s * np.sqrt(1.0 - correlation[:, 2] ** 2 * gain), rtol=1e-6
    )
    assert sigma[2, 0] < 0.01 < data[2, 0]
    assert sigma[2, 2] == pytest.approx(data[2, 2], rel=0.01)


def test_what_only_a_prior_determines_has_no_sigma_of_the_data() -> None:
    """One attitude with three stars says three numbers about five parameters."""
    priors = {
        "all": {"principal_point_px": 1.0, "focal_fraction": 1e-4, "distortion_corner_px": 1.0}
    }
    sweep = {"prior": ("flat", "all")}
    observation = {"pointing": "stare", "stars": 3}
    found = sc.study(definition(sweep=sweep, priors=priors, observation=observation), workers=0)
    assert list(found.ok) == [False, True]
    assert found.data["status"].values[0].startswith("the frames do not determine every parameter")
    assert np.isinf(found.data["sigma_data"].values[1]).all()
    assert np.isfinite(found.data["sigma"].values[1]).all()
    assert np.isnan(found.data["model_bias_arcsec"].sel(simpler="k1").values[1])


def test_frames_that_a_target_takes_give_it() -> None:
    made = definition(target_arcsec=0.02, target_sigma={"f": 0.05}, geometries=100)
    first = sc.study(made, workers=0)
    needed = int(first.data["frames_needed"].values[0])
    error = first.values("frame_error_arcsec", axis="cross")
    np.testing.assert_allclose(needed, np.ceil(250 * (error[0] / 0.02) ** 2), atol=1)
    np.testing.assert_allclose(
        first.data["frames_needed_sigma"].sel(parameter="f").values[0],
        np.ceil(250 * (first.values("sigma", parameter="f")[0] / 0.05) ** 2),
        atol=1,
    )
    assert first.needed("sigma_px")["median"].is_monotonic_increasing
    assert np.isnan(first.data["frames_needed_sigma"].sel(parameter="x0").values).all()
    assert first.met("sigma_px", float(np.sqrt(error[3] * error[4])), at={"frames": 1000})[
        0
    ] == pytest.approx(0.075, abs=0.01)


def test_errors_of_the_stars_leave_a_floor() -> None:
    """A staring camera sees the same errors in every frame: no number of frames averages them."""
    sweep = {"direction_mas": (0.0, 500.0), "frames": (50, 5000)}
    found = sc.study(
        definition(sweep=sweep, observation={"pointing": "stare"}, target_arcsec=0.001), workers=0
    )
    sigma = found.values("sigma", parameter="f")
    assert sigma[0] / sigma[1] == pytest.approx(10.0, rel=1e-6)
    assert sigma[2] / sigma[3] < 1.5
    assert np.isfinite(found.data["frames_needed"].values[0])
    assert np.isinf(found.data["frames_needed"].values[3])


def test_fewer_stars_of_a_frame_are_its_brightest() -> None:
    geometry = frames_by_hand(5)
    few = geometry.brightest(4)
    for k in range(5):
        own = slice(geometry.starts[k], geometry.starts[k + 1])
        kept = few.star[few.starts[k] : few.starts[k + 1]]
        assert sorted(kept) == sorted(geometry.star[own][np.argsort(geometry.mag[own])[:4]])


@pytest.mark.parametrize("pointing", ["stare", "roll", "raster", "scan"])
def test_patterns_look_where_they_say(pointing: str) -> None:
    key = GeometryKey(paper_camera(), 6.0, 5, 1.0, pointing, 25, (1, 0))
    boresight = take_frames(key, Heaven(sc.load_catalogue(6.0)), 300).rotations[:, 2]
    apart = np.rad2deg(np.arccos(np.clip(boresight @ boresight[0], -1.0, 1.0)))
    field = paper_camera().fov_deg[0]
    assert apart.max() == pytest.approx(
        {"stare": 0.0, "roll": 0.0, "raster": np.sqrt(2.0) * field, "scan": 2.4 * field}[pointing],
        rel=0.03,
        abs=1e-5,
    )


def test_a_simpler_model_is_biased_as_a_fit_of_it_is() -> None:
    """Noise-free frames of a lens with k1 alone, fitted without: the estimate moves by what was
    foretold.
    """
    camera = paper_camera().replace(distortion="k1", coefficients=(2.0e-9,))
    made = definition(camera=camera, sweep={"frames": (50,)}, observation={"min_stars": 10})
    bias = sc.study(made, workers=0).data.isel(cell=0)
    fitted, shift = [], []
    for seed in range(3):
        obs = sc.simulate(sc.load_catalogue(6.0), camera, n_frames=50, sigma_px=1e-6, seed=seed)
        cal = sc.calibrate(obs, camera.replace(distortion="none", coefficients=()))
        fitted.append(np.sqrt(np.mean(cal.residuals_px**2)) / camera.focal_px * ARCSEC)
        shift.append((cal.theta[2] - camera.focal_px) / float(bias["sigma"].sel(parameter="f")))
    assert float(bias["model_bias_arcsec"].sel(simpler="none")) == pytest.approx(
        np.mean(fitted), rel=0.15
    )
    # In sigmas of the simpler model, which knows f better.
    stated = float(bias["model_bias_sigma"].sel(simpler="none", parameter="f"))
    ratio = float(bias["sigma"].sel(parameter="f") / bias["sigma_conditional"].sel(parameter="f"))
    assert stated == pytest.approx(np.mean(shift) * ratio, rel=0.2)


# --- cameras


def test_other_pixels_are_the_same_optics() -> None:
    """A detector with half the pixels: the image of a direction is at half the place."""
    base = paper_camera().replace(coefficients=(2.0e-8, -3.5e-14))
    half = camera_of(base, {"pixels": 512})
    b = np.array([[0.03, -0.05, 1.0], [-0.06, 0.01, 1.0]])
    place = sc.camera.project(base, b) - base.centre_px
    np.testing.assert_allclose(sc.camera.project(half, b) - half.centre_px, 0.5 * place, rtol=1e-12)
    assert half.fov_deg == pytest.approx(base.fov_deg)
    coarse = camera_of(base, {"pixel_um": 24.0})
    np.testing.assert_allclose(
        sc.camera.project(coarse, b) - coarse.centre_px, 0.5 * place, rtol=1e-12
    )
    assert coarse.width_px == base.width_px


@pytest.mark.parametrize("model", ["k1", "brown", "brown3", "brown_tangential", "inverse"])
@pytest.mark.parametrize("size", [-5.0, 8.0])
def test_the_corner_moves_as_far_as_asked_for(model: str, size: float) -> None:
    camera = camera_of(
        paper_camera().data_sheet(), {"distortion": model, "distortion_px": size, "fov_deg": 12.0}
    )
    assert camera.fov_deg[0] == pytest.approx(12.0)
    corner = np.array([0.5 * camera.width_px, 0.5 * camera.height_px, camera.focal_px])
    moved = sc.camera.project(camera, corner[None])[0] - camera.centre_px
    assert np.hypot(*moved) - np.hypot(*corner[:2]) == pytest.approx(
        size, rel=0.03 if model != "inverse" else 0.05
    )


# --- cells that have no numbers, cells that are there already


def test_what_cannot_be_is_said_of_its_cell_and_the_study_goes_on() -> None:
    sweep = {"fov_deg": (1.0, 10.0), "distortion_px": (1.0, -400.0)}
    found = sc.study(definition(sweep=sweep), workers=0)
    status = found.data["status"].values
    assert list(found.ok) == [False, False, True, False]
    assert status[0].startswith("only 0 of 2")
    assert (
        "random attitudes show 10 stars to magnitude 6: raise max_mag, widen the field, or lower"
        in status[0]
    )
    assert status[3] == "the distortion folds over inside the field: make it smaller."
    assert sum(found.problems.values()) == 3
    assert np.isnan(found.data["sigma"].values[0]).all()


def test_only_new_cells_are_computed_and_results_come_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = counted(monkeypatch)
    first = sc.study(definition(), out=tmp_path, workers=0)
    assert len(calls) == 6
    wider = definition(
        name="Another name",
        target_arcsec=0.1,
        sweep={"frames": (250, 1000, 500), "sigma_px": (0.05, 0.1, 0.2)},
    )
    again = sc.study(wider, out=tmp_path, workers=0)
    assert len(calls) == 9
    np.testing.assert_array_equal(again.data["sigma"][:6], first.data["sigma"])
    other = sc.study(definition(seed=2), out=tmp_path, workers=0, force=True)
    assert len(calls) == 15
    assert not np.array_equal(other.data["sigma"], first.data["sigma"])
    loaded = Study.load(tmp_path)
    assert loaded.data.identical(other.data)
    assert loaded.definition.axes == definition().axes
    assert len(loaded.table()) == 30


def test_an_interrupted_study_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("starcal_uq.studies.study._BATCH_S", 1e-9)
    whole = sc.study(definition(), workers=0)
    calls = counted(monkeypatch)

    def stop(done: int, _total: int) -> None:
        if done == 4:
            raise KeyboardInterrupt

    part = sc.study(definition(), out=tmp_path, workers=0, progress=stop)
    assert not part.complete
    assert part.ok.sum() == 4
    assert len(list((tmp_path / "cells").iterdir())) == 4
    # A part that was being written when the power failed.
    (tmp_path / "cells" / ".0123456789abcdef.tmp.parquet").write_bytes(b"PAR1 but")
    found = sc.study(definition(), out=tmp_path, workers=0)
    assert len(calls) == 6
    assert found.complete
    same = [name for name in whole.data.data_vars if name != "seconds"]
    assert found.data[same].equals(whole.data[same])
    damaged = next((tmp_path / "cells").glob("all-*"))
    damaged.write_bytes(damaged.read_bytes()[:500])
    with pytest.raises(
        RunFolderError, match=r"all-.*is not a part of a study .*; delete it, and its cells"
    ):
        sc.study(definition(), out=tmp_path, workers=0)


def test_cells_that_differ_in_noise_frames_or_prior_share_their_frames(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What makes a cell of a grid cost a millisecond."""
    taken: list[int] = []
    stated: list[int] = []
    take, state = cells.take_frames, cells.statements
    monkeypatch.setattr(cells, "take_frames", lambda *given: taken.append(1) or take(*given))
    monkeypatch.setattr(cells, "statements", lambda *given: stated.append(1) or state(*given))
    sweep = {
        "prior": ("flat", "ground"),
        "sigma_px": (0.05, 0.1),
        "fov_deg": (9.0, 12.0),
        "stars": (5, 8, 10),
    }
    priors = {"ground": {"focal_fraction": 1e-5}}
    found = sc.study(definition(sweep=sweep, priors=priors, seeds=(0, 1), geometries=60), workers=0)
    assert found.n_cells == 48 and found.ok.all()
    assert (len(taken), len(stated)) == (2, 6)


# --- definitions

CAMERA = paper_camera().to_dict()


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"sweep": {"fov": [1]}}, r"section \[sweep\]: key fov is unknown; did you mean fov_deg\?"),
        ({"sweep": {"frames": []}}, "frames is an empty list; give at least one value"),
        ({"sweep": {"frames": [10, 10]}}, "frames holds a value twice"),
        ({"sweep": {"frames": [10.5]}}, "frames is 10.5; write a whole number"),
        ({"sweep": {"frames": 10}}, r"frames is 10; write a list, or \{start"),
        (
            {"sweep": {"sigma_px": {"start": 0, "stop": 1, "n": 3}}},
            "sigma_px, start: sigma_px is 0.0; write a number from 1e-06 to 20",
        ),
        ({"sweep": {"fov_deg": {"start": 5, "stop": 9}}}, "fov_deg: key n is missing"),
        ({"sweep": {"pointing": ["up"]}}, "pointing is 'up'; write one of random, stare"),
        (
            {"sweep": {"prior": ["ground"]}},
            r"prior 'ground' is not defined; add a section \[priors.ground\]",
        ),
        (
            {"sweep": {"method": ["efficient"]}},
            "method makes no difference to Fisher information; set mode",
        ),
        ({"sweep": {"k3": [0.0]}}, "k3 is no coefficient of distortion 'brown'"),
        (
            {"sweep": {"fov_deg": [5]}, "observation": {"focal_mm": 50.0}},
            "fov_deg and focal_mm set the same thing",
        ),
        ({"sweep": {}}, "nothing is varied"),
        ({"sweep": {"latin": {"n": 5}}}, r"section \[sweep.latin\]: write n, a number of points"),
        ({"sweep": {"latin": {"n": 5, "frames": 3}}}, "frames is 3; write a range of numbers"),
        (
            {"study": {"mode": "guess"}},
            r"section \[study\]: mode is 'guess'; write one of fisher, simulate",
        ),
        ({"study": {"target_sigma": {"k9": 1.0}}}, "target_sigma of k9"),
        (
            {"camera": {**CAMERA, "k1": -1e-5}},
            r"section \[camera\]: the distortion folds over inside the field",
        ),
    ],
)
def test_a_bad_definition_is_one_sentence(tables: dict[str, object], words: str) -> None:
    content = {"camera": CAMERA, "sweep": {"frames": [10, 20]}, **tables}
    with pytest.raises(StudyError, match=words) as caught:
        StudyDefinition.from_dict(content, "my.toml")
    assert str(caught.value).startswith("my.toml")
    assert str(caught.value).count("..") == 0


def test_a_definition_comes_back_from_its_tables(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    paper_camera().save(tmp_path / "sub" / "camera.toml")
    text = '[study]\ncamera = "sub/camera.toml"\nseeds = [3, 5]\n[sweep]\nframes = [10]\n'
    text += (
        "[sweep.latin]\nn = 4\nsigma_px = {start = 0.02, stop = 0.3, spacing = 'log'}\nstars = "
        "{start = 4, stop = 9}\n"
    )
    (tmp_path / "study.toml").write_text(text, "utf-8")
    made = StudyDefinition.load(tmp_path / "study.toml")
    again = StudyDefinition.from_dict(made.to_dict())
    assert made.cells() == again.cells()
    assert len(made.cells()) == made.n_cells == 8
    assert [cell.seed_index for cell in made.cells()[:2]] == [3, 5]
    values = np.array(made.axes["sigma_px"])
    # One point in every fourth of the range.
    assert sorted(np.floor(4.0 * np.log(values / 0.02) / np.log(15.0))) == [0, 1, 2, 3]
    shutil.rmtree(tmp_path / "sub")
    with pytest.raises(StudyError):
        StudyDefinition.load(tmp_path / "study.toml")


@pytest.mark.parametrize("name", TEMPLATES)
def test_templates_are_definitions_with_a_question(name: str, tmp_path: Path) -> None:
    write_study_template(name, tmp_path / "study.toml")
    made = StudyDefinition.load(tmp_path / "study.toml")
    assert made.question.endswith("?")
    assert len(made.axes) >= 2
    assert 50 < made.n_cells < 500
    with pytest.raises(RunFolderError):
        write_study_template(name, tmp_path / "study.toml")


def test_a_hypercube_is_grouped_along_its_axes() -> None:
    span = {"start": 0.02, "stop": 0.3, "spacing": "log"}
    found = sc.study(
        definition(sweep={}, latin={"sigma_px": span}, latin_n=60, geometries=100), workers=0
    )
    band = found.band("sigma", "sigma_px", parameter="f")
    assert len(band) == 6
    assert band["n"].sum() == 60
    assert band["median"].is_monotonic_increasing


def test_questions_that_have_no_answer(small: Study) -> None:
    for ask, words in (
        (lambda: small.values("sigma"), "sigma needs parameter=: give one of x0, y0, f, k1, k2"),
        (lambda: small.values("sigmas"), "no variable 'sigmas'"),
        (lambda: small.band("sigma", "fov_deg", parameter="f"), "'fov_deg' was not swept"),
        (lambda: small.needed("frames"), "no target is set"),
        (lambda: small.met("frames", 1.0, at={"sigma_px": 3.0}), "sigma_px has no value 3.0"),
    ):
        with pytest.raises(StudyError, match=words):
            ask()
