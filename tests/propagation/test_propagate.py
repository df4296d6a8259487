"""Attitude errors from the posterior: against attitudes solved one by one, and against simulated
campaigns.
"""

import dataclasses
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

import starcal_uq as sc
from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.core.errors import DistortionError, ObservationError, RunFolderError, SamplingError
from starcal_uq.estimation.result import Calibration
from starcal_uq.observations.table import Observations
from starcal_uq.paper.camera import paper_start
from starcal_uq.propagation.attitude_error import AttitudeError
from starcal_uq.propagation.geometry import FrameGeometry
from starcal_uq.propagation.onboard_error import OnboardError
from starcal_uq.propagation.propagate import propagate as propagate_aligned
from starcal_uq.simulation.mission import mission_frames, noise_by_magnitude
from starcal_uq.sky.catalogue import load_catalogue
from tests.helpers.attitude_campaigns import (
    clean_frames,
    failures,
    fly,
    linear_estimator,
    some_frames,
    with_noise,
)
from tests.helpers.gaussian_camera import gaussian_posterior
from tests.helpers.scenes import camera, nominal, observations, with_sigmas

ARCSEC = 648_000.0 / np.pi


@lru_cache
def scene(model: str = "brown", stated: bool = False) -> tuple[Observations, Calibration]:
    obs = observations(model)
    obs = with_sigmas(obs) if stated else obs
    return obs, calibrate(obs, nominal(camera(model)))


def propagate(post: Any, obs: Observations, **options: Any) -> AttitudeError:
    """With an alignment on the same frames, by which common rotation and rest are parts of one
    table.
    """
    return propagate_aligned(post, obs, **{"alignment": "observed", **options})


@lru_cache
def error(n_draws: int = 300) -> AttitudeError:
    obs, cal = scene()
    return propagate(gaussian_posterior(cal), obs, n_draws=n_draws, seed=1)


@pytest.mark.parametrize(
    ("model", "stated"),
    [("none", True), ("brown", False), ("brown_tangential", True), ("inverse", False)],
)
def test_sampled_and_first_order_agree(model: str, stated: bool) -> None:
    obs, cal = scene(model, stated)
    post = gaussian_posterior(cal)
    found = propagate(post, obs, n_draws=50)
    assert found.agreement.largest < 5e-3
    assert found.agreement.ratio.shape == (3, 3)
    assert "agree within" in found.agreement.text
    # The likelihood's own linearisation weights pixels, QUEST directions: across the boresight
    # hardly a difference.
    common = ARCSEC * np.sqrt(
        np.diag(post.rotation_per_theta @ post.covariance @ post.rotation_per_theta.T)
    )
    np.testing.assert_allclose(found.common_arcsec[:2], common[:2], rtol=0.01)
    K = FrameGeometry.of(post, obs).response.mean(axis=0)
    # About it, frames count alike there, and by their noise in an alignment.
    mean = ARCSEC * np.sqrt(np.diag(K @ post.covariance @ K.T))
    np.testing.assert_allclose(mean[2], common[2], rtol=0.15)
    np.testing.assert_allclose(
        found.nea_arcsec, ARCSEC * np.sqrt(np.diag(post.attitude_noise)), rtol=0.02
    )


@pytest.mark.parametrize("alignment", ["random", "observed"])
def test_a_sample_of_the_frames_says_what_all_do(
    monkeypatch: pytest.MonkeyPatch, alignment: str
) -> None:
    """With a posterior so wide that first order alone is off by a tenth."""
    obs, cal = scene()
    post = gaussian_posterior(cal, n=500, scale=100.0)
    every = propagate(post, obs, n_draws=100, alignment=alignment)
    monkeypatch.setattr("starcal_uq.propagation.sampled._SAMPLED_FRAMES", 30)
    some = propagate(post, obs, n_draws=100, alignment=alignment)
    assert (every.n_sampled_frames, some.n_sampled_frames) == (obs.n_frames, 30)
    assert f"30 of {obs.n_frames} frames" in some.told_frames
    for name, within in (("nea", 1e-4), ("common", 0.1), ("rest", 0.03), ("total", 0.03)):
        sampled, all_of_them = (getattr(error, f"{name}_arcsec") for error in (some, every))
        np.testing.assert_allclose(sampled, all_of_them, rtol=within)
    assert np.max(np.abs(every.analytic_rest_arcsec / every.rest_arcsec - 1.0)) > 0.1
    # Draw by draw as well, to first order in what the sample's mean response lacks.
    off = np.std(some.common_draws_arcsec - every.common_draws_arcsec, axis=0)
    assert np.all(off < [1.5e-4, 1.5e-4, 0.3] * every.common_arcsec)


def test_frames_of_a_mission_count_and_not_those_of_the_calibration() -> None:
    obs, cal = scene()
    post = gaussian_posterior(cal)
    stars = load_catalogue(max_mag=7.0, epoch=2026.9)
    deep = mission_frames(stars, cal.camera, n_frames=150, seed=2)
    found, observed = propagate(post, deep, n_draws=20), propagate(post, obs, n_draws=20)
    assert found.frames.startswith("random attitudes, ")
    assert "magnitude 7.0" in found.frames
    assert observed.frames == "observed frames"
    # Noise falls with the root of the stars; the common rotation stays, because it is the camera's.
    ratio = (deep.n_stars / deep.n_frames) / (obs.n_stars / obs.n_frames)
    np.testing.assert_allclose(
        observed.nea_arcsec[:2] / found.nea_arcsec[:2], np.sqrt(ratio), rtol=0.1
    )
    np.testing.assert_allclose(found.common_arcsec[:2], observed.common_arcsec[:2], rtol=0.01)
    assert (found.rest_arcsec < observed.rest_arcsec).all()
    assert found.agreement.largest < 2e-3


def test_stated_noise_is_carried_over_by_magnitude() -> None:
    obs, cal = scene(stated=True)
    post = gaussian_posterior(cal)
    stars = load_catalogue(max_mag=6.0, epoch=2026.9)
    with pytest.raises(ObservationError, match="noise_like=observations"):
        propagate(post, mission_frames(stars, cal.camera, n_frames=20), n_draws=5)
    frames = mission_frames(stars, cal.camera, n_frames=100, noise_like=obs)
    found, own = propagate(post, frames, n_draws=20), propagate(post, obs, n_draws=20)
    # The median of the stated noise says less than all of it: stars of little noise carry an
    # attitude.
    assert np.all((found.nea_arcsec > own.nea_arcsec) & (found.nea_arcsec < 3.0 * own.nea_arcsec))
    with pytest.raises(ObservationError):
        mission_frames(stars, cal.camera, n_frames=20, noise_like=scene()[0])

    mag = np.linspace(2.0, 6.0, 2000)
    like = SimpleNamespace(mag=mag, sigma_px=0.01 * 10 ** (0.2 * (mag - 2.0)))
    asked = np.array([1.0, 3.0, 5.0, 7.0, np.nan])
    values = noise_by_magnitude(like, asked)
    np.testing.assert_allclose(values[1:4], 0.01 * 10 ** (0.2 * (asked[1:4] - 2.0)), rtol=0.02)
    assert values[0] == pytest.approx(0.01, rel=0.1)
    assert values[4] == np.median(like.sigma_px)


def test_batches_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    obs, cal = scene()
    post = gaussian_posterior(cal)
    whole = propagate(post, obs, n_draws=10)
    monkeypatch.setattr("starcal_uq.propagation.geometry._STARS_AT_ONCE", 3 * obs.n_stars)
    parts = propagate(post, obs, n_draws=10)
    np.testing.assert_array_equal(whole.common_draws_arcsec, parts.common_draws_arcsec)
    np.testing.assert_allclose(whole.rest_arcsec, parts.rest_arcsec, rtol=1e-10)


def test_what_the_model_misses_is_added_to_the_calibration() -> None:
    """Equal errors of pitch and yaw make the angle across a Rayleigh variable, whose quantiles are
    known.
    """
    held = dataclasses.replace(
        error(), nea_arcsec=np.array([3.0, 3.0, 9.0]), common_arcsec=np.array([1.0, 1.0, 2.0]),
        rest_arcsec=np.array([0.5, 0.5, 1.0]), total_arcsec=np.array([1.1, 1.1, 2.2]),
        interaction_arcsec=np.array([0.1, 0.1, 0.2]),
    )  # fmt: skip
    sigma = held.if_model_holds_arcsec
    np.testing.assert_array_equal(sigma[:, 3], sigma[:, 0])
    quantiles = [
        np.array([norm.isf(0.5 * (1.0 - share))] * 3 + [np.sqrt(-2.0 * np.log(1.0 - share))])
        for share in (0.95, 0.997)
    ]
    # The rest and the total have tails a fifth longer than Gaussian ones, the noise a tenth; none
    # is Gaussian.
    longer = np.array([1.1, 1.15, 1.2, 1.2, 1.3])[:, None]
    p95, p997 = (quantile * longer * sigma for quantile in quantiles)
    held = dataclasses.replace(held, p95_arcsec=p95, p997_arcsec=p997)
    assert (
        np.isnan(held.with_misfit_found_arcsec).all()
        and held.headline_arcsec is not held.with_misfit_found_arcsec
    )
    np.testing.assert_array_equal(held.headline_arcsec, sigma)
    common = np.hypot(sigma[1, :3], [0.3, 0.4, 0.5])
    rest = np.hypot(sigma[2, :3], [0.6, 0.6, 0.8])
    # Effects may also leave less: then the tail is that of the draws.
    both = np.array([2.0, 1.9, 0.5 * sigma[3, 2]])
    found = dataclasses.replace(held, misfit=OnboardError("model", common, rest, both, ()))
    expected = np.array([sigma[0, :3], common, rest, both, sigma[4, :3]])
    np.testing.assert_allclose(found.with_misfit_found_arcsec[:, :3], expected, rtol=1e-12)
    across = np.sqrt(0.5 * (expected[:, 0] ** 2 + expected[:, 1] ** 2))
    np.testing.assert_allclose(found.with_misfit_found_arcsec[:, 3], across, rtol=1e-12)
    np.testing.assert_array_equal(found.headline_arcsec, found.with_misfit_found_arcsec)
    # The excess of a tail shrinks with the share that has it.
    share = 0.5**2 / (0.5**2 + 0.6**2)
    for widths, quantile, own in zip(
        found.half_widths_with_misfit_found_arcsec, quantiles, (p95, p997), strict=True
    ):
        np.testing.assert_allclose(widths[[0, 4]], own[[0, 4]], rtol=1e-6)
        # Of all of the total, that part is the model's own tail, whatever the noise has.
        share_of_both = (sigma[3, 0] / both[0]) ** 2
        np.testing.assert_allclose(
            widths[3, 0], quantile[0] * (1.0 + 0.2 * share_of_both) * both[0], rtol=1e-6
        )
        np.testing.assert_allclose(widths[3, 2], quantile[0] * 1.2 * both[2], rtol=1e-6)
        share_of_common = (sigma[1, :3] / common) ** 2
        np.testing.assert_allclose(
            widths[1, :3], quantile[:3] * (1.0 + 0.15 * share_of_common) * common, rtol=1e-6
        )
        np.testing.assert_allclose(
            widths[2, 0], quantile[0] * (1.0 + 0.2 * share) * rest[0], rtol=1e-6
        )
        np.testing.assert_allclose(
            widths[2, 3], quantile[3] * (1.0 + 0.2 * share) * rest[0], rtol=1e-6
        )


def test_file_of_an_earlier_version_is_read_and_the_interaction_not_known(tmp_path: Path) -> None:
    import pandas as pd

    from starcal_uq.presentation.words.propagation import attitude_rows

    found, path = error(), tmp_path / "attitude.csv"
    found.save(path)
    table = pd.read_csv(path, dtype=str, keep_default_na=False)
    table[~table["contributor"].str.startswith("interaction")].drop(columns="frames").to_csv(
        path, index=False
    )
    loaded = AttitudeError.load(path)
    np.testing.assert_array_equal(loaded.rest_arcsec, found.rest_arcsec)
    np.testing.assert_array_equal(loaded.p95_arcsec[:4], found.p95_arcsec[:4])
    # Not zero, which would read as assessed.
    assert np.isnan(loaded.interaction_arcsec).all()
    assert np.isnan(loaded.p95_arcsec[4]).all()
    assert "not known" in loaded._repr_html_()
    row = attitude_rows(loaded)[-1]
    assert row["figures"][1]["sigma"] == ["—"] * 4
    assert row["note"].startswith("not sampled by the version")
    assert attitude_rows(found)[-1]["figures"][1]["sigma"][2] == "<\N{NO-BREAK SPACE}0.001"
    loaded.save(path)
    assert np.isnan(AttitudeError.load(path).interaction_arcsec).all()
    # Control: a missing number elsewhere is not excused.
    table.loc[0, "if_model_holds_arcsec"] = np.nan
    table.to_csv(path, index=False)
    with pytest.raises(RunFolderError):
        AttitudeError.load(path)


def test_one_number_is_taken_apart() -> None:
    found = error()
    assert "what remains in flight is" in found.text
    # A figure that nobody has assessed is not one.
    assert (
        found.text.count("with the misfit found: not assessed") == 2
        and "starcal-uq diagnose" in found.text
    )
    swapped = dataclasses.replace(
        found, common_arcsec=found.rest_arcsec, rest_arcsec=found.common_arcsec
    )
    assert "no alignment absorbs it" in swapped.text
    none = dataclasses.replace(found, rest_arcsec=np.zeros(3))
    assert "is a common rotation of" in none.text


def test_what_cannot_be_propagated_is_said() -> None:
    obs, cal = scene()
    post = gaussian_posterior(cal)
    with pytest.raises(SamplingError):
        propagate(post, obs, n_draws=1)
    folded = gaussian_posterior(cal)
    folded.theta_draws[::2, 3] = folded.draws[::2, 3] = -1e-5
    with pytest.raises(
        DistortionError, match="at 3 of 10 posterior draws the distortion 'brown' folds over"
    ):
        propagate(folded, obs, n_draws=10)
    scaled = gaussian_posterior(scene(stated=True)[1])
    with pytest.raises(ObservationError, match="no sigma_px"):
        propagate(scaled, obs, n_draws=10)


@pytest.mark.slow
def test_propagated_posterior_against_campaigns_with_known_attitudes() -> None:
    """A thousand frames: one campaign from pixels to its posterior, 2,500 others that it must
    foretell.

    Attitudes are those of every third frame: they are more than `propagate` takes through QUEST,
    and what they leave open is nothing beside what the number of campaigns does.
    """
    clean = clean_frames(1000)
    rng = np.random.default_rng(0)
    obs = with_noise(clean, 0.05 * rng.standard_normal(clean.xy.shape))
    cal = calibrate(obs, paper_start())
    post = sc.sample(obs, cal, seed=1)
    seen = some_frames(obs, 3)
    found = propagate(post, seen)

    # The linear estimator of the campaigns is what `calibrate` does.
    G, truth, sd = (
        linear_estimator(clean, camera("brown")),
        camera("brown").theta,
        np.sqrt(np.diag(cal.covariance)),
    )
    for _ in range(3):
        e = 0.05 * rng.standard_normal(clean.xy.shape)
        linear = truth + np.einsum("na,pna->p", e, G)
        assert (
            np.abs((calibrate(with_noise(clean, e), paper_start()).theta - linear) / sd).max()
            < 0.05
        )

    narrow = dataclasses.replace(post, draws=post.draws.copy())
    narrow.draws[:, :-1] += 0.1 * (post.mean - post.draws[:, :-1])
    quiet = dataclasses.replace(post, draws=post.draws * np.append(np.ones(5), 0.9))
    rows = [0, 2, 1, 3, 4]
    confused = dataclasses.replace(
        found,
        common_arcsec=found.rest_arcsec,
        rest_arcsec=found.common_arcsec,
        p95_arcsec=found.p95_arcsec[rows],
    )
    errors = (found, propagate(narrow, seen), propagate(quiet, seen), confused)
    flown = fly(clean, errors, n=2500, every=3)
    # A spread of 2,500 campaigns is known to 1.4 %.
    slack = 0.05
    assert failures(flown[0], errors[0], slack) == set()
    # Controls: a posterior 10 % too narrow, noise 10 % too small, and the two parts of the
    # calibration confused.
    assert failures(flown[1], errors[1], slack) == {"common", "rest"}
    assert failures(flown[2], errors[2], slack) == {"nea"}
    assert failures(flown[3], errors[3], slack) == {"common", "rest"}

    # Noise and calibration are uncorrelated even on the calibration's own frames, so that squares
    # add up.
    assert np.abs(flown[0].correlation).max() < 0.016
    parts = np.sqrt(sum(values**2 for values in flown[0].rms.values()))
    np.testing.assert_allclose(flown[0].together, parts, rtol=0.008)
    np.testing.assert_allclose(flown[0].interaction, found.interaction_arcsec, rtol=0.2)

    # The set-up of Ye & Yang (2017): noise, a constant ten times as large, and next to nothing that
    # remains.
    nea, common, rest = found.nea_arcsec, found.common_arcsec, found.rest_arcsec
    assert np.all((nea[:2] > 0.43) & (nea[:2] < 0.5)) and 6.0 < nea[2] < 7.2
    assert np.all((common[:2] > 4.3) & (common[:2] < 5.6))
    assert rest.max() < 0.1
