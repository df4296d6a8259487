"""Leaving frames out, and the scatter between frames."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

import starcal_uq as sc
from starcal_uq.core.status import Level
from starcal_uq.diagnostics.jackknife import jackknife_frames
from starcal_uq.diagnostics.verdict import estimate
from starcal_uq.diagnostics.verdict.observed import EFFECTS
from starcal_uq.estimation.normals import FrameNormals
from tests.helpers.scenes import camera, observations, with_sigmas


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


@pytest.mark.slow
def test_jackknife_p_values_are_nominal_and_clusters_are_found():
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    p, wrong, ratios = [], [], []
    for i in range(40):
        one = sc.simulate(stars, camera(), n_frames=30, min_stars=10, sigma_px=0.05, seed=300 + i)
        p.append(jackknife_frames(one, sc.calibrate(one, sc.paper.paper_start())).p_values)
        if i < 8:
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
