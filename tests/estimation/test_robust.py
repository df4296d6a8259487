"""Estimates with tails."""

import numpy as np
import pytest

from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.core.errors import CalibrationError, SamplingError
from starcal_uq.estimation.robust import star_scores, subset
from starcal_uq.inference.sample import sample
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.observations.frames import StarFrames
from starcal_uq.simulation.frames import simulate
from starcal_uq.sky.catalogue import load_catalogue
from tests.helpers.scenes import camera, nominal, observations, with_sigmas
from tests.likelihood.test_student import QUICK, spoil


@pytest.mark.parametrize("kind", ["random", "neighbour"])
def test_wrong_stars_have_high_scores(kind: str) -> None:
    obs, wrong = spoil(observations(n_frames=40), 0.1, kind)
    scores = star_scores(StarFrames.from_observations(obs), "brown", camera().theta)
    right = np.setdiff1d(np.arange(obs.n_stars), wrong)
    assert np.min(scores[wrong]) > 5.0 * np.median(scores)
    assert np.mean(scores[right] > 5.0 * np.median(scores)) < 0.01


def test_subset_keeps_whole_frames() -> None:
    frames = StarFrames.from_observations(with_sigmas(observations(n_frames=20)))
    kept = np.ones(frames.n_stars, dtype=bool)
    kept[: frames.starts[1] - 2] = False
    kept[frames.starts[3]] = False
    used = subset(frames, kept)
    assert used.n_frames == 19
    assert used.n_stars == frames.n_stars - frames.sizes[0] - 1
    assert used.weight is not None
    assert np.array_equal(
        used.pixel[:, : used.starts[1]], frames.pixel[:, frames.starts[1] : frames.starts[2]]
    )


@pytest.mark.parametrize("model", ["brown", "inverse"])
def test_robust_estimates(model: str) -> None:
    clean = observations(model, n_frames=40)
    obs, _ = spoil(clean, 0.05)
    truth = camera(model)
    reference = calibrate(clean, nominal(truth))
    cal = calibrate(obs, nominal(truth), effects="tails")
    assert cal.status.ok
    assert [stage.name for stage in cal.stages][-1] == "refinement"
    # Of right stars the two make different use, so that they differ by less than a sigma or two of
    # either.
    assert np.max(np.abs(cal.theta - reference.theta) / reference.sigmas) < 2.0
    assert np.all((cal.sigmas / reference.sigmas > 0.9) & (cal.sigmas / reference.sigmas < 1.6))
    assert cal.provenance["settings"]["likelihood"] == "student_t"
    # Wrong stars that cannot be in the field are no tail: the degrees of freedom are those of noise.
    assert cal.provenance["student_t"]["dof"] > 10.0
    assert np.isfinite(cal.compressed.gram).all()
    if model == "brown":
        with pytest.raises(CalibrationError):
            calibrate(obs, nominal(truth))


def test_free_degrees_of_freedom_tell_clean_data_from_spoilt() -> None:
    clean = observations(n_frames=60)
    near = spoil(clean, 0.05, "neighbour")[0]
    found = [
        calibrate(obs, nominal(camera()), effects="tails", dof=dof)
        for obs, dof in ((clean, None), (near, "free"), (near, None))
    ]
    dofs = [cal.provenance["student_t"]["dof"] for cal in found]
    assert dofs[0] > 20.0
    assert 2.0 < dofs[1] < 2.3
    # By default they go down to 4, which keeps the intervals shorter.
    assert dofs[2] == 4.0 and np.all(found[2].sigmas < 0.95 * found[1].sigmas)


def test_robust_estimates_are_sampled_with_their_own_likelihood() -> None:
    obs, _ = spoil(with_sigmas(observations(n_frames=30)), 0.05)
    cal = calibrate(obs, nominal(camera()), effects="tails")
    assert cal.sigma_name == "sigma_scale"
    with pytest.raises(SamplingError, match="sample with the same"):
        sample(obs, cal, **QUICK)
    with pytest.raises(SamplingError, match=r"minimum of the pair objective|do not determine"):
        sample(obs, cal, **QUICK, likelihood="pairs")


def test_nothing_but_wrong_stars_is_refused() -> None:
    obs, _ = spoil(observations(n_frames=20), 0.8)
    with pytest.raises(CalibrationError):
        calibrate(obs, nominal(camera()), effects="tails")


@pytest.mark.slow
def test_wrong_identifications_do_not_move_the_estimate() -> None:
    stars, truth = load_catalogue(max_mag=6.0, epoch=2026.9), camera()
    scaled, robust, gaussian = [], [], []
    for seed in range(25):
        clean = simulate(stars, truth, n_frames=40, min_stars=8, sigma_px=0.05, seed=80_000 + seed)
        obs, _ = spoil(clean, 0.05, "neighbour", seed)
        reference = calibrate(clean, nominal(truth))
        cal = calibrate(obs, nominal(truth), effects="tails")
        scaled.append((cal.theta - truth.theta) / cal.sigmas)
        robust.append((cal.theta - truth.theta) / reference.sigmas)
        likelihood = MarginalLikelihood(obs, "brown")
        normal = likelihood.evaluate(truth.theta)
        step = np.linalg.solve(
            normal.matrix * np.outer(reference.sigmas, reference.sigmas),
            normal.gradient * reference.sigmas,
        )
        # One Gauss-Newton step of least squares from the truth: where wrong stars pull it.
        gaussian.append(-step if np.isfinite(normal.cost) else np.full(5, np.inf))
    z = np.array(scaled)
    assert np.all(np.abs(np.mean(robust, axis=0)) < 0.5)
    assert 0.9 < np.mean(np.abs(z) < 1.96) < 0.995
    assert np.all(np.mean(np.abs(z) < 1.96, axis=0) > 0.8)
    assert np.median(np.abs(gaussian)) > 5.0
