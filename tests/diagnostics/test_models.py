"""Comparison of distortion models."""

import dataclasses

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.diagnostics.models import closed_form, compare_models
from starcal_uq.estimation.normals import FrameNormals
from tests.helpers.scenes import camera, nominal, observations


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
    """p(y_k | others) = p(y) / p(others)."""
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
