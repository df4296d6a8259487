"""Jackknife, comparison of models, replicated data and other starts."""

import csv
import dataclasses
import json

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.records import to_plain
from starcal_uq.diagnostics.diagnose import (
    Diagnosis,
    LeftOut,
    diagnose,
    diagnose_apart,
    multi_start,
)
from starcal_uq.diagnostics.jackknife import Jackknife
from starcal_uq.diagnostics.models import ModelComparison
from starcal_uq.diagnostics.predictive import PredictiveCheck
from starcal_uq.diagnostics.residuals import of_some_frames
from starcal_uq.diagnostics.stars import star_test
from starcal_uq.estimation.normals import StarNormals
from starcal_uq.estimation.weights import weighed
from starcal_uq.likelihood.star_errors import star_numbers
from starcal_uq.presentation.words.diagnostics import misfit_table
from starcal_uq.runs.folder import DIAGNOSIS_TABLES
from tests.helpers.scenes import observations


def test_other_starts_find_the_same_optimum_or_say_so(obs, cal):
    found = multi_start(obs, cal, 3, seed=1)
    assert (found.same, found.better, found.failed) == (3, 0, 0)
    assert found.largest_sigma < 0.01
    # The control: an estimate that is not the optimum.
    wrong = dataclasses.replace(cal, theta=cal.theta + 3 * cal.sigmas, chi2=cal.chi2 * 1.01)
    assert multi_start(obs, wrong, 2, seed=1).better == 2


def test_some_frames_tell_whether_other_starts_find_the_same_optimum(obs, cal, monkeypatch):
    for name in ("_START_STARS", "_FEWEST_FRAMES"):
        monkeypatch.setattr(f"starcal_uq.diagnostics.diagnose.{name}", 20)
    found = multi_start(obs, cal, 3, seed=1)
    assert (found.same, found.better, found.n_frames, found.of_frames) == (3, 0, 20, obs.n_frames)
    # The control: an estimate farther from the optimum than twenty frames could be.
    wrong = dataclasses.replace(cal, theta=cal.theta + 15 * cal.sigmas, camera=cal.camera)
    assert multi_start(obs, wrong, 2, seed=1).better == 2


def test_half_of_a_diagnosis_may_be_found_elsewhere(obs, cal):
    obs = weighed(obs, cal)
    apart = dataclasses.replace(diagnose_apart(obs, cal, n_starts=1, seed=3), cameras=None)

    def plain(found):
        # NaN is not NaN.
        return json.dumps(
            to_plain(
                [found.misfit, found.starts, found.stars, found.air, found.cameras, found.times]
            )
        )

    options = {"models": (), "n_starts": 1, "seed": 3}
    assert plain(diagnose(obs, cal, **options, apart=lambda: None)) == plain(apart)
    # The control: what came from elsewhere is what stands there.
    other = dataclasses.replace(apart, starts=None)
    assert diagnose(obs, cal, **options, apart=lambda: other).starts is None
    left = LeftOut(None, None)
    found = diagnose(obs, cal, **options, apart=lambda: other, left_out=lambda: left)
    assert found.jackknife is None


def test_diagnosis_of_a_run_is_stored_and_belongs_to_its_calibration(obs, cal, tmp_path):
    run = sc.runs.RunFolder(tmp_path / "run").create()
    obs.save(run.observations)
    cal.save(run.calibration)
    assert sc.Run(run.path).diagnosis is None
    steps = []
    whole = sc.Run(run.path)
    found = whole.diagnose(
        models=("k1",), n_starts=1, progress=lambda done, total: steps.append((done, total))
    )
    assert steps == [(i, 4) for i in range(1, 5)]
    assert {path.name for path in run.path.iterdir()} >= {
        run.diagnosis.name,
        *DIAGNOSIS_TABLES.values(),
    }
    again = whole.diagnosis
    assert json.dumps(to_plain(again)) == json.dumps(to_plain(found))
    assert isinstance(again, Diagnosis) and isinstance(again.jackknife, Jackknife)
    assert isinstance(again.comparison, ModelComparison) and isinstance(
        again.predictive, PredictiveCheck
    )
    assert all(
        word in again._repr_html_() for word in ("Misfit", "Jackknife", "Models", "predictive")
    )
    with (run.path / DIAGNOSIS_TABLES["comparison"]).open() as stream:
        assert {row["model"] for row in csv.DictReader(stream)} == {"k1", "brown"}
    # The control: the diagnosis of another estimate is not shown with this one.
    (run.path / "run.json").unlink()
    dataclasses.replace(cal, theta=cal.theta + 1e-9).save(run.calibration)
    assert sc.Run(run.path).diagnosis is None
    run.diagnosis.write_text("{}")
    with pytest.raises(sc.errors.RunFolderError, match="diagnose"):
        _ = sc.Run(run.path).diagnosis
    observations(n_frames=60, seed=4).save(run.observations, force=True)
    with pytest.raises(sc.errors.RunFolderError, match="other observations"):
        sc.Run(run.path).diagnose(force=True)


def test_two_frames_have_no_jackknife_but_a_diagnosis(obs):
    few = obs.select_frames(obs.frame_ids[:2])
    found = diagnose(few, sc.calibrate(few, sc.paper.paper_start()), models=(), n_starts=0)
    assert found.jackknife is None and found.comparison is None and found.starts is None


def test_real_stars_need_no_k2_and_show_the_phase_of_the_pixels(real_data, capsys):
    start = sc.Camera.load(real_data / "esa_tetra3_camera.toml")
    path = real_data / "esa_tetra3_observations.csv"
    columns = {"ra_deg": "ra_apparent_deg", "dec_deg": "dec_apparent_deg"}
    obs = sc.load_observations(path, start, columns=columns).with_meta(directions="apparent")
    with path.open() as stream:
        snr = np.array([float(row["snr"]) for row in csv.DictReader(stream)])
    obs = obs.select(snr >= 10)
    cal = sc.calibrate(obs, start)
    found = diagnose(obs, cal, n_starts=0)
    with capsys.disabled():
        print(f"\njackknife / formal sigma: {np.round(found.jackknife.ratio, 2)}")
    assert found.jackknife.ratio.min() == pytest.approx(0.60, abs=0.03)
    assert found.jackknife.ratio.max() == pytest.approx(1.29, abs=0.03)
    low, high = found.jackknife.expected()
    assert np.all((found.jackknife.ratio > low) & (found.jackknife.ratio < high))
    assert found.comparison.simplest.model == "k1"
    assert found.comparison.text.startswith("k2 is not needed")
    assert found.comparison.of("none").rejected
    assert found.misfit.found()[0].name == "error with the pixel phase in x"
    smooth = [t for t in found.misfit.tests if t.dof and not t.against.startswith("pixel phase")]
    assert all(t.p_holm > 0.05 for t in smooth)
    # The control: with neither refraction nor aberration in the directions, the shape of the field
    # is wrong too.
    raw = sc.load_observations(path, start)
    wrong = diagnose(raw, sc.calibrate(raw, start), models=(), n_starts=0).misfit
    assert next(t for t in wrong.tests if t.name == "scale and skew of the axes").p_holm < 1e-4


def test_starts_are_compared_with_all_frames_where_some_have_no_optimum(obs, cal, monkeypatch):
    from starcal_uq.diagnostics import diagnose as module

    real = module._optimum

    def failing(some, *others):
        if some.n_frames < obs.n_frames:
            raise sc.errors.CalibrationError("these frames have no optimum.")
        return real(some, *others)

    monkeypatch.setattr(module, "_few", lambda whole: whole.select_frames(range(10)))
    assert multi_start(obs, cal, 2).n_frames == 10
    monkeypatch.setattr(module, "_optimum", failing)
    found = multi_start(obs, cal, 2)
    assert (found.n_frames, found.same, found.failed) == (obs.n_frames, 2, 0)


def test_starts_reach_the_optimum_of_noise_and_tails_together(obs):
    """Both are estimated in turns, and a start in one search."""
    some = obs.select(obs.frame < 20)
    rng = np.random.default_rng(7)
    noise = rng.standard_t(6, (2, len(some))) * np.array([[0.2], [0.02]])
    data = dataclasses.replace(some, x_px=some.x_px + noise[0], y_px=some.y_px + noise[1])
    cal = sc.calibrate(data, sc.paper.paper_start(), effects="noise,tails")
    assert multi_start(data, cal, 2).same == 2


def test_of_many_frames_some_are_asked_and_the_checks_say_so(obs, cal, monkeypatch):
    options = {"models": ("brown", "k1"), "n_starts": 0, "seed": 3}
    every = diagnose(obs, cal, **options)
    for name, n in (("_FRAMES", 30), ("_STAR_FRAMES", 40)):
        monkeypatch.setattr(f"starcal_uq.diagnostics.diagnose.{name}", n)
    some = diagnose(obs, cal, **options)
    assert (some.comparison.n_frames, some.jackknife.n_frames, some.stars.n_frames) == (30, 30, 40)
    assert {test.share for test in some.misfit.tests if test.is_of_noise} == {0.5}
    # Sigmas are those of all frames.
    for name in ("jackknife", "stars"):
        covariances = (getattr(found, name).formal_covariance for found in (some, every))
        assert np.divide(*map(np.diag, covariances)) == pytest.approx(1.0, abs=0.25)
    for found in (some.jackknife, some.comparison):
        assert "30 of 60 frames" in found.text
    assert "40 of 60 frames" in some.stars.text
    assert "30 of 60 frames" in misfit_table(some.misfit).title
    assert some.better is None
    # The control: all frames are no sample.
    assert "0 of 60 frames" not in every.text + misfit_table(every.misfit).title
    assert every.better == ""


def test_stars_that_err_widen_sigma_in_a_sample_as_in_all_frames():
    obs = observations(n_frames=60)
    stars, place = np.unique(obs.star_id, return_inverse=True)
    shifts = np.random.default_rng(4).normal(0.0, 0.01, (2, len(stars)))[:, place]
    obs = dataclasses.replace(obs, ra_deg=obs.ra_deg + shifts[0], dec_deg=obs.dec_deg + shifts[1])
    cal = sc.calibrate(obs, sc.paper.paper_start())
    every = star_test(obs, cal)
    some = star_test(*of_some_frames(obs, cal, 40, 1))
    assert every.p_value < 1e-3
    assert some.widening == pytest.approx(every.widening, abs=0.06)
    # What an error does to single images averages out: with each a star of its own, all of it.
    normals = StarNormals.at(obs, cal, np.arange(obs.n_stars))
    single = normals.response.reshape(-1, len(cal.theta))
    assert single.T @ single == pytest.approx(normals.of_images)
    # The control: in stars that are seen again, errors have a part in common.
    numbers = star_numbers(obs, float(cal.theta[2]))
    again = StarNormals.at(obs, cal, numbers).response.reshape(-1, len(cal.theta))
    assert np.trace(again.T @ again) != pytest.approx(np.trace(normals.of_images))
