"""Effects against the dense covariance of the data that they stand for."""

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.likelihood.effect_likelihood import EffectLikelihood
from starcal_uq.likelihood.effect_sums import EffectSums
from starcal_uq.likelihood.effects import effects_of
from starcal_uq.likelihood.frame_products import FrameProducts
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.observations.frames import StarFrames
from tests.helpers.effects import sheet, table
from tests.helpers.outside import campaign

RATIO = {"field": 3.0, "frame": 0.7, "phase": 0.2, "star": 0.4}


@pytest.fixture(scope="module")
def scene() -> tuple[sc.Observations, sc.Calibration]:
    c = campaign(np.random.default_rng(3), n_frames=6, stars_per_frame=9, patch_stars=60)
    obs = table(c)
    return obs, sc.calibrate(obs, sheet(c))


def dense(
    obs: sc.Observations, cal: sc.Calibration, settled: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals and derivatives (p + 1, 2 N), all attitude columns (3 K, 2 N), and C rho C^T.

    `settled`: at attitudes that are the best ones to rounding, which waves over a pixel tell from
    those to a nanoradian.
    """
    likelihood = MarginalLikelihood(obs, cal.camera.distortion)
    ((_, state, _),) = likelihood.pieces(cal.theta, None, obs.n_stars)
    if not settled:
        state, _ = likelihood.profile(cal.theta)
    frames = likelihood.frames
    h = state.slopes * cal.sigmas[:, None, None]
    x = np.concatenate([state.e[None], h]).reshape(6, -1)
    member = np.repeat(np.arange(frames.n_frames), frames.sizes)
    own = [np.where(member == k, state.attitude, 0.0) for k in range(frames.n_frames)]
    a = np.concatenate(own).reshape(-1, x.shape[1])
    covariance = np.eye(x.shape[1])
    from starcal_uq.likelihood.shapes import View

    view = View.of(likelihood, state, cal.theta, slice(None))
    for name, effect in effects_of(obs, cal.camera).items():
        if effect.stars is not None:
            z = effect.stars.term().columns(likelihood, state, slice(None))
            groups = effect.stars.numbers
            own = [np.where(groups == s, z, 0.0).reshape(2, -1) for s in np.unique(groups)]
            covariance += RATIO["star"] * sum(one.T @ one for one in own)
            continue
        columns = effect.columns.columns(view)
        if effect.grouping == "frame":
            columns = np.concatenate(
                [np.where(member == k, columns, 0.0) for k in range(frames.n_frames)]
            )
        prior = np.tile(effect.prior, len(columns) // len(effect.prior)) ** 2
        flat = columns.reshape(len(columns), -1)
        covariance += RATIO.get(name, 0.0) * flat.T @ (prior[:, None] * flat)
    return x, a, covariance


def test_sums_are_products_with_the_inverse_of_the_dense_covariance(scene):
    obs, cal = scene
    x, a, covariance = dense(obs, cal, True)
    inverse = np.linalg.inv(covariance)
    w = inverse - inverse @ a.T @ np.linalg.inv(a @ inverse @ a.T) @ a @ inverse
    likelihood = MarginalLikelihood(obs, cal.camera.distortion)
    sums = EffectSums(list(effects_of(obs, cal.camera).values()), cal.theta)
    for part, state, rows in likelihood.pieces(cal.theta, None, 20):
        h = state.slopes * cal.sigmas[:, None, None]
        columns = part.project_out(state, np.concatenate([state.e[None], h]))
        sums.add(part, state, columns, rows)
    solved = sums.solved(RATIO)
    wanted = x @ w @ x.T
    unit = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
    assert np.abs((solved.gram - wanted) / unit).max() < 1e-9
    # Determinants: of the covariance seen by what attitudes leave.
    plain = np.linalg.slogdet(a @ a.T)[1]
    volume = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(a @ inverse @ a.T)[1] - plain
    assert solved.log_determinant == pytest.approx(volume, abs=1e-8)
    # Control: other scales give other products.
    other = sums.solved({**RATIO, "field": 2.0}).gram
    assert np.abs((other - wanted) / unit).max() > 1e-3


def test_the_exact_likelihood_is_that_of_the_dense_covariance(scene):
    obs, cal = scene
    x, a, covariance = dense(obs, cal, False)
    inverse = np.linalg.inv(covariance)
    w = inverse - inverse @ a.T @ np.linalg.inv(a @ inverse @ a.T) @ a @ inverse
    frames = StarFrames.from_observations(obs)
    rotations = MarginalLikelihood(obs, cal.camera.distortion).start_rotations(cal.theta)
    exact = EffectLikelihood(
        frames,
        cal.camera.distortion,
        list(effects_of(obs, cal.camera).values()),
        RATIO,
        cal.theta,
        rotations,
    )
    state, _ = exact.profile(cal.theta, exact.rotations)
    left = exact.whitened(state, state.e[None])
    assert float(np.sum(left**2)) == pytest.approx(float(x[0] @ w @ x[0]), rel=1e-9)


def test_frames_are_summed_up_at_any_scale() -> None:
    """Of many frames the sums take what these take one by one, whatever the scale."""
    rng = np.random.default_rng(8)
    size = np.exp(rng.uniform(-2.0, 1.0, (3000, 1, 1)))
    columns = size * rng.standard_normal((3000, 12, 3))
    others = rng.standard_normal((3000, 12, 5))
    own = np.einsum("kni,knj->kij", columns, columns)
    cross = np.einsum("kni,knw->kiw", columns, others)
    halves = [FrameProducts.of(own[some], cross[some]) for some in (slice(1000), slice(1000, None))]
    summed = FrameProducts.joined(halves)
    assert summed.rows.size < 0.1 * cross.size
    for ratio in np.exp([-14.0, -3.0, 0.0, 5.0, 14.0]):
        inner = np.linalg.inv(np.eye(3) / ratio + own)
        wanted = np.einsum("kiw,kij,kjv->wv", cross, inner, cross, optimize=True)
        taken, volume = summed.taken(float(ratio))
        assert np.abs(taken - wanted).max() < 1e-11 * np.abs(wanted).max()
        determinants = np.linalg.slogdet(np.eye(3) + ratio * own)[1]
        assert volume == pytest.approx(determinants.sum(), rel=1e-11)
    # Control: at a scale that is a hundredth off, it would be seen.
    wrong = summed.taken(1.01)[0]
    assert np.abs(wrong - summed.taken(1.0)[0]).max() > 1e-4 * np.abs(wrong).max()
