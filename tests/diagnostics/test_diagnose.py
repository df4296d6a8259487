"""Jackknife, comparison of models, replicated data and other starts; each with a case that must
turn out otherwise.
"""

from __future__ import annotations

import csv
import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

import starcal_uq as sc
from starcal_uq.core.records import to_plain
from starcal_uq.core.status import Level
from starcal_uq.diagnostics.diagnose import Diagnosis, diagnose, diagnose_apart, multi_start
from starcal_uq.diagnostics.jackknife import Jackknife, jackknife_frames
from starcal_uq.diagnostics.models import ModelComparison, closed_form, compare_models
from starcal_uq.diagnostics.predictive import PredictiveCheck, predictive_check
from starcal_uq.diagnostics.verdict import estimate
from starcal_uq.diagnostics.verdict.observed import EFFECTS
from starcal_uq.estimation.normals import FrameNormals
from starcal_uq.estimation.weights import weighed
from starcal_uq.runs.folder import DIAGNOSIS_TABLES
from tests.helpers.scenes import camera, nominal, observations, with_sigmas


@pytest.fixture(scope="module")
def obs():
    return observations(n_frames=60)


@pytest.fixture(scope="module")
def cal(obs):
    return sc.calibrate(obs, sc.paper.paper_start())


def clustered(obs, seed=0):
    """Every frame with an error of its own in scale and shape, which independent noise does not
    have.
    """
    rng = np.random.default_rng(seed)
    offset = obs.xy - camera().theta[:2]
    stretch = np.repeat(3e-4 * rng.standard_normal((obs.n_frames, 3)), obs.stars_per_frame, axis=0)
    quadratic = 0.4 * (offset / 512.0) ** 2 * stretch[:, 1:] * 512.0
    shift = offset * stretch[:, :1] + quadratic
    return dataclasses.replace(obs, x_px=obs.x_px + shift[:, 0], y_px=obs.y_px + shift[:, 1])


# --- jackknife
# --------------------------------------------------------------------------------------------------


def test_one_step_equals_refitting_without_a_frame(obs, cal):
    found = jackknife_frames(obs, cal)
    for k in (0, 17, 41, 59):
        rest = obs.select(obs.frame != obs.frame_ids[k])
        refit = sc.calibrate(rest, sc.paper.paper_start())
        assert np.max(np.abs(found.left_out[k] - refit.theta) / cal.sigmas) < 0.02, k
    # The control: leaving a frame out moves the estimate by much more than that.
    assert np.sqrt(np.mean(((found.left_out - cal.theta) / cal.sigmas) ** 2)) > 0.05


def test_one_step_equals_refitting_with_stated_noise_and_few_frames():
    obs = with_sigmas(observations(n_frames=60, sigma_px=0.0)).select_frames(range(12))
    cal = sc.calibrate(obs, sc.paper.paper_start())
    found = jackknife_frames(obs, cal)
    refits = [
        sc.calibrate(obs.select(obs.frame != k), sc.paper.paper_start()).theta
        for k in obs.frame_ids
    ]
    scatter = np.array(refits) - np.mean(refits, axis=0)
    exact = np.sqrt(np.sum(scatter**2, axis=0) * 11 / 12)
    assert np.sqrt(np.diag(found.jackknife_covariance)) == pytest.approx(exact, rel=0.05)


def test_formal_errors_are_those_of_the_calibration(obs, cal):
    found = jackknife_frames(obs, cal)
    assert np.sqrt(np.diag(found.formal_covariance)) == pytest.approx(cal.sigmas, rel=1e-3)


def test_jackknife_p_values_are_nominal_and_clusters_are_found():
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    p, wrong, ratios = [], [], []
    for i in range(60):
        one = sc.simulate(stars, camera(), n_frames=30, min_stars=10, sigma_px=0.05, seed=300 + i)
        p.append(jackknife_frames(one, sc.calibrate(one, sc.paper.paper_start())).p_values)
        if i < 10:
            found = jackknife_frames(
                bad := clustered(one, i), sc.calibrate(bad, sc.paper.paper_start())
            )
            wrong.append(found.p_values.min())
            ratios.append(found.ratio[2])
    p = np.array(p)
    n = len(p)
    assert np.all(np.abs(np.mean(p < 0.05, axis=0) - 0.05) < 4.0 * np.sqrt(0.05 * 0.95 / n))
    assert all(stats.kstest(column, "uniform").pvalue > 1e-3 for column in p.T)
    assert np.mean(np.array(wrong) < 0.01) > 0.7
    assert np.mean(ratios) > 1.3


def linear_frames(rng, designs):
    """Normal equations of frames (n_k, p) under independent noise; no camera, no code of the
    package.
    """
    p = designs[0].shape[1]
    e = [rng.standard_normal(len(h)) for h in designs]
    return FrameNormals(
        theta=np.zeros(p),
        scale=np.ones(p),
        matrices=np.array([h.T @ h for h in designs]),
        slopes=np.array([h.T @ r for h, r in zip(designs, e, strict=True)]),
        squares=np.array([r @ r for r in e]),
        log_determinant=np.zeros(len(designs)),
        rotations=np.tile(np.eye(3), (len(designs), 1, 1)),
        dof=np.array([len(h) for h in designs]),
    )


def uncorrected_alarm(found):
    """The test of before: the leave-one-out scatter against chi-square, as if the fit took nothing
    up.
    """
    ratio, dof = found.jackknife_ratio, np.maximum(found.effective_frames - 1.0, 1.0)
    return np.any((stats.chi2.sf(dof * ratio**2, dof) * len(ratio) < 0.01) & (ratio > 1.1))


@pytest.mark.parametrize("k", [3, 5, 20])
def test_frame_scatter_is_nominal_with_few_uneven_frames(k):
    rng = np.random.default_rng(k)
    spread = np.array([1.0, 1.0, 1.0, 0.5, 0.2])
    designs = [
        rng.standard_normal((rng.integers(9, 30), 5)) * spread * rng.uniform(0.5, 1.5)
        for _ in range(k)
    ]
    names = SimpleNamespace(parameter_names=tuple("abcde"))
    data = SimpleNamespace(n_frames=k, frame_ids=np.arange(k))
    found = [jackknife_frames(data, names, linear_frames(rng, designs)) for _ in range(400)]
    p = np.array([f.p_values for f in found])
    # Three moments are right, so that the tail, not each quantile, is nominal.
    assert np.all(np.abs(np.mean(p < 0.05, axis=0) - 0.05) < 4.0 * np.sqrt(0.05 * 0.95 / 400))
    assert np.mean(p.min(axis=1) * 5 < 0.01) < 0.01 + 3.0 * np.sqrt(0.01 * 0.99 / 400)
    assert np.mean([f.ratio**2 for f in found], axis=0) == pytest.approx(
        1.0, abs=6.0 * np.sqrt(2.0 / (k - 1) / 400)
    )
    # The control: without the correction of leverage, alarms are several times as frequent as
    # stated.
    assert np.mean([uncorrected_alarm(f) for f in found]) > (0.03 if k < 20 else 0.015)


def test_frames_that_disagree_are_warned_of_and_need_three(obs, cal):
    checks = [estimate.jackknife(jackknife_frames(o, cal)) for o in (obs, clustered(obs))]
    assert [check.level for check in checks] == [Level.PASS, Level.WARN]
    assert "--only-frames" in checks[1].advice and "too small by a factor" in checks[1].sentence
    effects = estimate.jackknife(jackknife_frames(clustered(obs), cal), EFFECTS)
    assert "--effects auto" in effects.remedy
    with pytest.raises(sc.errors.CalibrationError, match="three or more"):
        two = obs.select_frames(obs.frame_ids[:2])
        jackknife_frames(two, sc.calibrate(two, sc.paper.paper_start()))


# --- comparison of models
# --------------------------------------------------------------------------------------------


def test_importance_sampling_and_the_closed_form_agree(obs, cal):
    found = compare_models(obs, cal, ("k1", "brown"))
    for score in found.scores:
        assert score.elpd == pytest.approx(score.closed_form, abs=0.5)
        assert score.max_khat < 0.7 and score.n_replaced == 0
        assert 2.0 < score.effective_parameters < 25.0


def test_a_sample_of_frames_beside_the_closed_form_compares_as_all_do(obs, cal, monkeypatch):
    every = compare_models(obs, cal, ("k1", "brown"))
    monkeypatch.setattr("starcal_uq.diagnostics.models._SAMPLED_FRAMES", 10)
    some = compare_models(obs, cal, ("k1", "brown"))
    assert (every.n_sampled_frames, some.n_sampled_frames) == (obs.n_frames, 10)
    for one, other in zip(every.scores, some.scores, strict=True):
        assert (one.model, one.rejected) == (other.model, other.rejected)
        assert other.difference == pytest.approx(one.difference, abs=0.5)
        assert other.effective_parameters == pytest.approx(one.effective_parameters, abs=1.0)


def test_closed_form_is_the_ratio_of_evidences(obs, cal):
    """p(y_k | others) = p(y) / p(others): evidences of the linear model, computed without any of
    its formulas.
    """
    from scipy.special import gammaln

    own = dataclasses.replace(cal, quaternions=cal.quaternions[:12])
    normals = FrameNormals.at(obs.select_frames(range(12)), own)

    def log_evidence(kept):
        matrix, slope = normals.matrices[kept].sum(axis=0), normals.slopes[kept].sum(axis=0)
        rss = normals.squares[kept].sum() - slope @ np.linalg.solve(matrix, slope)
        half = 0.5 * (normals.dof[kept].sum() - len(slope))
        volume = -0.5 * np.linalg.slogdet(matrix)[1] - 0.5 * normals.log_determinant[kept].sum()
        return gammaln(half) - half * np.log(np.pi * rss) + volume

    everything = np.ones(12, dtype=bool)
    for k in range(12):
        expected = log_evidence(everything) - log_evidence(np.arange(12) != k)
        assert closed_form(normals)[k] == pytest.approx(expected, abs=1e-6)


def test_the_right_model_wins_and_richer_ones_are_not_rejected():
    obs = observations("brown", n_frames=200)
    found = compare_models(obs, sc.calibrate(obs, sc.paper.paper_start()))
    outcome = {score.model: score.rejected for score in found.scores}
    assert outcome["none"] and outcome["k1"]
    assert not any(outcome[m] for m in ("brown", "brown3", "brown_tangential"))
    assert found.simplest.model == "brown"
    assert found.failed == {}
    poor = compare_models(obs, sc.calibrate(obs, nominal(camera("k1"))), ("k1", "brown"))
    assert poor.of("k1").rejected
    assert "use 'brown'" in poor.text


def test_a_superfluous_term_is_called_so_and_the_shift_is_stated():
    obs = observations("k1", n_frames=60)
    found = compare_models(obs, sc.calibrate(obs, nominal(camera("brown"))))
    assert found.simplest.model == "k1"
    assert found.text.startswith("k2 is not needed")
    assert "in common and" in found.text
    mine = found.of("brown")
    assert np.hypot(*mine.common_arcsec[:2]) < 1e-3
    # A principal point that moves by a pixel turns every attitude by the angle of a pixel.
    other = found.of("brown_tangential")
    fit = sc.calibrate(obs, nominal(camera("brown_tangential")))
    base = sc.calibrate(obs, nominal(camera("brown")))
    moved = np.hypot(*(fit.theta[:2] - base.theta[:2])) / base.theta[2] * 206_265.0
    assert np.hypot(*other.common_arcsec[:2]) == pytest.approx(moved, rel=0.05)


# --- replicated data, other starts, the whole
# -------------------------------------------------------------------------


def test_replicates_look_like_data_of_the_model_and_unlike_others(obs, cal):
    good = predictive_check(obs, cal, n_draws=200)
    assert not any(s.extreme for s in good.statistics)
    residuals = np.random.default_rng(1).standard_t(3, (2, obs.n_stars)) * 0.05
    tails = dataclasses.replace(obs, x_px=obs.x_px + residuals[0], y_px=obs.y_px + residuals[1])
    bad = predictive_check(tails, sc.calibrate(tails, sc.paper.paper_start()), n_draws=300)
    assert {s.name for s in bad.statistics if s.extreme} >= {"excess kurtosis"}
    truth = camera("brown3").replace(
        coefficients=(2e-10, -3.5e-15, 8.0 / camera().corner_radius_px ** 7)
    )
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    bent = sc.simulate(stars, truth, n_frames=300, min_stars=10, sigma_px=0.05, seed=1)
    ring = predictive_check(bent, sc.calibrate(bent, sc.paper.paper_start()), n_draws=200)
    assert (
        ring.statistics[3].name.startswith("radial pattern") and ring.statistics[3].p_value < 0.05
    )


def test_replicates_on_some_frames_say_so(obs, cal, monkeypatch):
    monkeypatch.setattr("starcal_uq.diagnostics.predictive._MAX_STARS", 500)
    some = predictive_check(obs, cal, n_draws=100)
    assert some.of_frames == obs.n_frames and some.n_frames == pytest.approx(
        500 * obs.n_frames / obs.n_stars, abs=1
    )
    assert f"on {some.n_frames} of {obs.n_frames} frames" in some.text
    assert not any(s.extreme for s in some.statistics)


def test_replicates_use_the_posterior(obs, cal):
    post = sc.sample(obs, cal, seed=1, n_steps=50)
    assert not any(s.extreme for s in predictive_check(obs, cal, post, n_draws=100).statistics)
    # The control: a posterior with noise that is too small cannot have made these data.
    draws = post.draws.copy()
    draws[:, -1] *= 0.8
    small = predictive_check(obs, cal, dataclasses.replace(post, draws=draws), n_draws=100)
    assert small.statistics[0].extreme


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


# --- real stars
# --------------------------------------------------------------------------------------------------


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
