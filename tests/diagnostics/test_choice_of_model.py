"""A richer model that the data do not prefer is a choice, no misfit: campaigns of a second make,
with and without.
"""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

import starcal_uq as sc
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.types import FloatArray
from starcal_uq.diagnostics.inflation import with_misfit
from starcal_uq.diagnostics.jackknife import jackknife_frames
from starcal_uq.diagnostics.misfit import misfit_tests
from starcal_uq.diagnostics.models import compare_models
from starcal_uq.diagnostics.verdict.limits import limits
from starcal_uq.propagation.alignment import alignment_weights
from starcal_uq.propagation.attitude_error import AttitudeError
from starcal_uq.propagation.geometry import FrameGeometry
from tests.helpers.outside import Campaign, attitude_errors, campaign
from tests.helpers.posteriors import normal_posterior

CORNER = 512.0 * np.sqrt(2.0)


def decentring(uv: FloatArray, xy: FloatArray, mag: FloatArray, frame: int) -> FloatArray:
    """0.15 px at the corner across, 0.45 px along x."""
    u, v = uv / CORNER
    return 0.15 * np.array([3.0 * u**2 + v**2, 2.0 * u * v])


def assessed(seed: int, n_frames: int, **options: Any) -> SimpleNamespace:
    """A campaign, and its attitude error of first order with what every test of the model found."""
    c = campaign(np.random.default_rng(seed), n_frames=n_frames, **options)
    obs = sc.Observations(**c.columns, meta={"directions": "apparent"})
    cal = sc.calibrate(obs, sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0)))  # type: ignore[arg-type]
    post = normal_posterior(cal)
    frames = FrameGeometry.of(post, obs)
    weights, _ = alignment_weights(frames.noise_covariance)
    together = np.einsum("nij,njp->ip", weights, frames.response)
    parts = (together[None], frames.response - together)
    common, rest = (
        np.sqrt(np.mean(np.einsum("kip,pq,kiq->ki", r, cal.covariance, r), axis=0)) * ARCSEC
        for r in parts
    )
    zero, nothing = np.zeros(3), np.full((5, 4), np.nan)
    error = AttitudeError(
        zero, common, rest, nothing, nothing, zero, common, rest, 2, n_frames, seen=obs, aligned=obs
    )
    diagnosis: Any = SimpleNamespace(
        misfit=misfit_tests(obs, cal),
        jackknife=jackknife_frames(obs, cal),
        comparison=compare_models(obs, cal, n_draws=200),
        theta=cal.theta.tolist(),
    )
    made = with_misfit(error, diagnosis, post, obs)
    return SimpleNamespace(
        c=c, obs=obs, cal=cal, post=post, diagnosis=diagnosis, bare=error, error=made
    )


def inflation(error: AttitudeError) -> float:
    """Headline over the model's figure, the largest of common rotation and rest about any axis."""
    return float(
        np.max(error.with_misfit_found_arcsec[1:3, :3] / error.if_model_holds_arcsec[1:3, :3])
    )


def with_every_model(run: SimpleNamespace) -> AttitudeError:
    """The error if every model that is not rejected counted in full, as if the data preferred
    it.
    """
    found = run.diagnosis.comparison
    scores = tuple(dataclasses.replace(s, preferred=1.0) for s in found.scores)
    diagnosis = SimpleNamespace(
        **{**vars(run.diagnosis), "comparison": dataclasses.replace(found, scores=scores)}
    )
    return with_misfit(run.bare, diagnosis, run.post, run.obs)  # type: ignore[arg-type]


def check(runs: list[SimpleNamespace]) -> None:
    above = sum(inflation(run.error) > 1.05 for run in runs)
    every = sum(inflation(with_every_model(run)) > 1.05 for run in runs)
    print(
        f"\n{runs[0].obs.n_frames} frames: {above} of {len(runs)} inflated, {every} if every "
        "model counted"
    )
    # At most so many as 5 % give in 99 of 100 cases.
    assert above <= stats.binom.ppf(0.99, len(runs), 0.05), above
    # Control: the noise of terms that nothing asks for inflates most runs.
    assert every > 0.6 * len(runs)
    # It is stated beside the headline.
    assert sum(bool(run.error.misfit.choice_models) for run in runs) > 0.6 * len(runs)


def test_noise_of_a_richer_model_is_no_misfit() -> None:
    check([assessed(1000 + seed, 20) for seed in range(12)])


@pytest.mark.slow
@pytest.mark.parametrize(("n_frames", "seeds"), [(20, 60), (60, 40), (300, 20)])
def test_headlines_of_clean_campaigns_are_those_of_the_model(n_frames: int, seeds: int) -> None:
    check([assessed(2000 + seed, n_frames) for seed in range(seeds)])


def true_common(c: Campaign, theta: FloatArray) -> FloatArray:
    return np.asarray(attitude_errors(c, theta).mean(axis=0))


def test_a_richer_model_that_is_needed_counts() -> None:
    run = assessed(3, 60, displaced=decentring)
    score = run.diagnosis.comparison.of("brown_tangential")
    assert score.preferred == 1.0 and run.diagnosis.comparison.of("brown").rejected
    assert "predicts better" in " ".join(run.error.misfit.common_reasons)
    # Yaw: the shift of the principal point that the decentring made the calibration find.
    true, held = true_common(run.c, run.cal.theta)[1], run.error.common_arcsec[1]
    assert abs(true) > 20.0 * held
    assert run.error.misfit.common_arcsec[1] == pytest.approx(abs(true), rel=0.2)
    assert "brown_tangential" not in run.error.misfit.choice_models


def test_the_choice_is_stated_wherever_the_error_is() -> None:
    run = assessed(1000, 20)
    found = run.error.misfit
    assert found.choice_models == ("brown_tangential",) and not found.reasons
    sentence = "'brown_tangential' predicts about as well as the fitted model"
    assert sentence in run.error.text and sentence in " ".join(
        one.sentence for one in limits(run.obs, run.cal, attitude=run.error)
    )
    table = run.error.to_dataframe().set_index(["contributor", "axis"])["choice_of_model_arcsec"]
    np.testing.assert_array_equal(
        table.loc["calibration, common rotation"].to_numpy()[:3], found.choice_common_arcsec
    )
    assert "choice of model" in str(run.error._repr_html_())
    untested = dataclasses.replace(run.error, misfit=None)
    assert np.isnan(untested.choice_of_model_arcsec).all() and sentence not in untested.text
