"""What a calibration leaves until somebody asks for it."""

import pickle
from concurrent.futures import ThreadPoolExecutor
from copy import copy, deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import CalibrationError
from starcal_uq.estimation import assemble, fit
from starcal_uq.estimation.settings import ITERATIONS, EstimationSettings
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.observations.table import Observations


def _given(n_frames: int, **options: float) -> Observations:
    stars = sc.load_catalogue(max_mag=5.5, epoch=2026.9)
    camera = sc.paper.paper_camera()
    return sc.simulate(stars, camera, n_frames=n_frames, sigma_px=0.05, seed=5, **options)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What was made, in order."""
    names: list[str] = []

    def counted(module: object, name: str) -> None:
        own = getattr(module, name)

        def call(*words: object, **more: object) -> object:
            names.append(name)
            return own(*words, **more)

        monkeypatch.setattr(module, name, call)

    counted(fit, "_stages")
    counted(assemble, "compress")
    return names


def test_stages_and_compression_are_made_once_when_they_are_asked_for(
    made: list[str], tmp_path: Path
) -> None:
    cal = sc.calibrate(_given(60), sc.paper.paper_start())
    assert np.isfinite(cal.covariance).all() and cal.n_frames == 60
    assert not made
    copied = copy(cal)
    assert not made
    assert np.isfinite(copied.pair_theta).all() and len(cal.stages) == 4
    assert made == ["_stages"]
    assert cal.compressed is copied.compressed
    assert made == ["_stages", "compress"]
    cal.save(tmp_path / "calibration.json")
    again = sc.Calibration.load(tmp_path / "calibration.json")
    for other in (again, pickle.loads(pickle.dumps(cal)), deepcopy(cal), replace(cal)):
        assert np.array_equal(other.compressed.gram, cal.compressed.gram)
        assert np.array_equal(other.stages[2].trajectory, cal.stages[2].trajectory)
        assert np.array_equal(other.pair_covariance, cal.pair_covariance)
    assert made == ["_stages", "compress"]


def test_a_pickle_holds_what_was_not_made_yet(made: list[str]) -> None:
    cal = pickle.loads(pickle.dumps(sc.calibrate(_given(20), sc.paper.paper_start())))
    assert made == ["_stages", "compress"] or made == ["compress", "_stages"]
    assert [stage.name for stage in cal.stages][-1] == "refinement"
    assert len(made) == 2


@pytest.mark.parametrize("n_frames", [30, 500])
def test_the_estimate_is_that_of_the_stages(n_frames: int, made: list[str]) -> None:
    """With a sample of the frames to start from, and without one."""
    obs, camera = _given(n_frames), sc.paper.paper_start()
    cal = sc.calibrate(obs, camera)
    assert not made
    # A limit of the iterations is one of every stage: all of them are gone.
    eager = sc.calibrate(obs, camera, max_iterations=ITERATIONS - 1)
    assert made == ["_stages"]
    assert np.max(np.abs(cal.theta - eager.theta) / eager.sigmas) < 1e-8
    assert np.allclose(cal.covariance, eager.covariance, rtol=1e-6, atol=0.0)
    assert abs(cal.sigma / eager.sigma - 1.0) < 1e-9
    assert np.max(np.abs(cal.residuals_px - eager.residuals_px)) < 1e-6
    assert np.array_equal(cal.pair_theta, eager.pair_theta)
    # Attitudes are searched from the estimate, or from the end of the stages.
    assert np.allclose(cal.pair_covariance, eager.pair_covariance, rtol=1e-9, atol=0.0)
    for one, other in zip(cal.stages, eager.stages, strict=True):
        assert one.name == other.name and one.status is other.status
        assert np.array_equal(one.trajectory, other.trajectory)
    z = cal.compressed.whiten(eager.compressed.theta_hat)
    assert np.max(np.abs(z)) < 1e-8
    assert np.allclose(
        cal.log_likelihood(cal.theta[None] + cal.sigmas, cal.sigma),
        eager.log_likelihood(cal.theta[None] + cal.sigmas, cal.sigma),
        rtol=0.0,
        atol=1e-4,
    )


def test_wrong_stars_go_through_the_stages(made: list[str]) -> None:
    """Positions of no star are explained by no camera, however the search begins."""
    obs = _given(12)
    rng = np.random.default_rng(1)
    wrong = replace(obs, x_px=rng.permutation(obs.x_px), y_px=rng.permutation(obs.y_px))
    with pytest.raises(CalibrationError):
        fit.fit_weighed(wrong, sc.paper.paper_start(), EstimationSettings())
    assert made == ["_stages"]


def test_threads_that_ask_together_get_one_answer() -> None:
    cal = sc.calibrate(_given(30), sc.paper.paper_start())
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: (cal.compressed, cal.stages), range(8)))
    for compressed, stages in found:
        assert np.array_equal(compressed.gram, cal.compressed.gram)
        assert np.array_equal(stages[-1].trajectory, cal.stages[-1].trajectory)


def test_other_methods_and_limits_go_through_the_stages_first(made: list[str]) -> None:
    obs, camera = _given(30), sc.paper.paper_start()
    three = sc.calibrate(obs, camera, method="three_stage")
    assert made == ["_stages"] and np.array_equal(three.theta, three.stages[-1].theta)
    assert np.array_equal(three.covariance, three.pair_covariance)
    sc.calibrate(obs, camera, solver="minpack")
    assert made == ["_stages"] * 2
    ended = fit.fit_weighed(obs, camera, EstimationSettings(max_iterations=2))
    assert not ended.status.ok and made == ["_stages"] * 3


def test_the_slope_is_that_of_the_log_likelihood() -> None:
    """By differences of the likelihood, whose attitudes are searched anew at every point."""
    obs, sigma = _given(12), 0.05
    noise = np.random.default_rng(2).uniform(0.03, 0.2, len(obs))
    tilted = np.array([[1.25, 0.3], [0.3, 0.872]])
    uneven = replace(obs, sigma_px=noise, stated_px=noise, noise_axes=tilted)
    for model in ("brown", "inverse", "fisheye", "k1+axes"):
        camera = sc.paper.paper_camera().replace(distortion=model)
        for table in (obs, replace(obs, sigma_px=noise), uneven):
            likelihood = MarginalLikelihood(table, model)
            sums, attitudes = likelihood.sums(camera.theta)
            likelihood.use_sums(sums, attitudes)
            widths = sigma / np.sqrt(np.diag(sums.matrix))
            found = likelihood.slope(camera.theta, sigma, attitudes) / sigma**2
            for i, step in enumerate(np.diag(widths)):
                ends = [likelihood.log_likelihood(camera.theta + s * step, sigma) for s in (1, -1)]
                slope = -0.5 * (ends[0] - ends[1]) / widths[i]
                assert found[i] * widths[i] == pytest.approx(slope * widths[i], abs=2e-3), (
                    model,
                    i,
                )
