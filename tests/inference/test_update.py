"""A posterior as the next prior."""

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import PriorError
from starcal_uq.estimation.merging import merge
from starcal_uq.estimation.result import Calibration
from starcal_uq.inference.posterior import Posterior
from starcal_uq.inference.priors import GaussianPriors, Priors
from starcal_uq.inference.sample import sample
from starcal_uq.inference.update import AllowedShift, check_chain, prior_from, shift_test
from starcal_uq.runs.priors import load_priors
from starcal_uq.simulation.frames import simulate
from starcal_uq.sky.catalogue import load_catalogue
from tests.helpers import scenes

NOMINAL = scenes.nominal(scenes.camera())


def fresh(seed: int, n_frames: int = 12, shift_f_px: float = 0.0) -> Calibration:
    camera = scenes.camera()
    theta = camera.theta.copy()
    theta[2] += shift_f_px
    stars = load_catalogue(max_mag=6.0, epoch=2026.9)
    obs = simulate(stars, camera.with_theta(theta), n_frames=n_frames, min_stars=8, seed=seed)
    return calibrate(obs, NOMINAL)


@lru_cache(maxsize=16)
def calibrated(seed: int, n_frames: int = 40, shift_f_px: float = 0.0) -> Calibration:
    return fresh(seed, n_frames, shift_f_px)


@lru_cache(maxsize=16)
def ground() -> Posterior:
    return sample(None, calibrated(1), seed=1)


def gaussian(**changes: object) -> GaussianPriors:
    values = {"theta_mean": ground().mean, "theta_covariance": ground().covariance}
    return GaussianPriors(**{**values, "sigma_median": 0.05, "sigma_log_sd": 0.1, **changes})


def test_density_and_draws_are_scipys() -> None:
    priors = gaussian()
    draws = priors.draw(100_000, np.random.default_rng(3))
    sd = ground().sd[:5]
    reference = stats.multivariate_normal(np.zeros(5), priors.theta_covariance / np.outer(sd, sd))
    expected = reference.logpdf((draws[:50, :5] - priors.theta_mean) / sd) - np.sum(np.log(sd))
    assert np.allclose(priors.log_density_theta(draws[:50, :5]), expected, rtol=1e-9)
    assert np.allclose(
        np.corrcoef(draws[:, :5].T), priors.theta_covariance / np.outer(sd, sd), atol=0.02
    )
    assert np.allclose(
        priors.precision(priors.names[:-1]) @ priors.theta_covariance * np.outer(sd, 1 / sd),
        np.eye(5),
    )
    # Without the others, a parameter's precision is that of its marginal.
    assert priors.precision(["f"])[0, 0] == pytest.approx(sd[2] ** -2)
    assert np.allclose(priors.sd(["x0", "k2"]), sd[[0, 4]])


def test_gaussian_priors_survive_files(tmp_path: Path) -> None:
    priors = gaussian(source={"name": "ground"})
    again = Priors.from_dict(priors.to_dict())
    assert isinstance(again, GaussianPriors)
    assert again.to_dict() == priors.to_dict()
    assert "from ground" in priors.to_dataframe()["statement"].iloc[0]
    post = sample(None, calibrated(2), priors, seed=1, n_steps=20)
    post.save(tmp_path / "posterior.nc")
    assert Posterior.load(tmp_path / "posterior.nc").priors.to_dict() == priors.to_dict()


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"theta_mean": np.zeros(3)}, "5 parameters"),
        ({"theta_covariance": -np.eye(5)}, "above zero"),
        ({"theta_covariance": np.eye(5) + np.eye(5, k=1)}, "symmetric"),
        ({"theta_covariance": np.ones((5, 5))}, "positive definite"),
        ({"sigma_log_sd": 0.0}, "above zero"),
    ],
)
def test_improper_priors_are_refused(change: dict[str, object], match: str) -> None:
    with pytest.raises(PriorError, match=match):
        gaussian(**change)


@pytest.mark.slow
def test_two_runs_in_a_row_are_both_at_once() -> None:
    second = calibrated(2)
    chained = sample(None, second, prior_from(ground(), noise="posterior"), seed=2)
    both = sample(None, merge([calibrated(1), second]), seed=3)
    assert chained.diagnostics.psis_khat < 0.7
    assert np.all(np.abs(chained.mean - both.mean) < 0.08 * both.sd[:5])
    assert np.allclose(chained.sd, both.sd, rtol=0.06)
    # The control: without the chain, the second run alone is wider and elsewhere.
    alone = sample(None, second, seed=2)
    assert np.all(alone.sd[:5] > 1.2 * both.sd[:5])
    # Nor would independent priors of the same widths do: the coupling is in the correlations.
    diagonal = gaussian(theta_covariance=np.diag(np.diag(ground().covariance)))
    apart = sample(None, second, diagonal, seed=2)
    assert not np.allclose(apart.sd, both.sd, rtol=0.06)


def test_prior_widens_by_inflation_and_allowed_shift() -> None:
    plain = prior_from(ground())
    assert np.allclose(plain.theta_covariance, ground().covariance)
    assert plain.sigma_median == Priors.default(NOMINAL).sigma_median
    assert np.allclose(
        prior_from(ground(), inflation=2.0).sd(("x0", "k1")), 2.0 * plain.sd(("x0", "k1"))
    )
    shift = AllowedShift(principal_point_px=5.0, focal_fraction=1e-3, distortion_corner_px=0.5)
    wide = prior_from(ground(), shift=shift)
    extra = np.sqrt(wide.sd(wide.names[:-1]) ** 2 - plain.sd(plain.names[:-1]) ** 2)
    camera = ground().camera
    expected = [
        5.0,
        5.0,
        1e-3 * camera.focal_px,
        0.5 / camera.corner_radius_px**3,
        0.5 / camera.corner_radius_px**5,
    ]
    assert np.allclose(extra, expected, rtol=1e-6)
    noise = prior_from(ground(), noise="posterior")
    assert noise.sigma_median == pytest.approx(np.median(ground().sigma_draws), rel=0.01)
    for options, match in (
        ({"inflation": 0.5}, "1 or more"),
        ({"noise": "some"}, "unknown"),
        ({"noise": "posterior", "per_star_sigma": True}, "another kind"),
    ):
        with pytest.raises(PriorError, match=match):
            prior_from(ground(), **options)
    with pytest.raises(PriorError):
        AllowedShift(principal_point_px=-1.0)


def write_run(folder: Path) -> Path:
    folder.mkdir()
    ground().save(folder / "posterior.nc")
    calibrated(1).save(folder / "calibration.json")
    return folder


def test_toml_takes_the_prior_from_a_run(tmp_path: Path) -> None:
    write_run(tmp_path / "ground")
    path = tmp_path / "priors.toml"
    path.write_text(
        '[priors]\nprior_from = "ground"\ninflation = 1.5\nnoise = "posterior"\n'
        "[priors.shift]\nfocal_fraction = 1e-4\n",
        encoding="utf-8",
    )
    priors = load_priors(path, NOMINAL, data_sha256=[calibrated(2).provenance["data_sha256"]])
    assert isinstance(priors, GaussianPriors)
    assert priors.source["name"] == "ground"
    assert priors.sd(["x0"])[0] == pytest.approx(1.5 * ground().sd[0])
    # Physical terms still work from the same function.
    path.write_text("[priors]\nfocal_fraction = 0.001\n", encoding="utf-8")
    assert load_priors(path, NOMINAL).to_dict()["focal_fraction"] == 0.001


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ('prior_from = "ground"\nfocal_fraction = 0.1\n', "key focal_fraction is unknown"),
        ('prior_from = "ground"\ninflation = 0.1\n', "1 or more"),
        ('prior_from = "ground"\nshift = 3\n', "shift is 3; write a table"),
    ],
)
def test_bad_toml_names_file_and_key(tmp_path: Path, text: str, match: str) -> None:
    write_run(tmp_path / "ground")
    path = tmp_path / "priors.toml"
    path.write_text(f"[priors]\n{text}", encoding="utf-8")
    with pytest.raises(PriorError, match=match) as caught:
        load_priors(path, NOMINAL)
    assert str(path) in str(caught.value)


def test_the_same_data_do_not_count_twice(tmp_path: Path) -> None:
    write_run(tmp_path / "ground")
    path = tmp_path / "priors.toml"
    path.write_text('[priors]\nprior_from = "ground"\n', encoding="utf-8")
    with pytest.raises(PriorError, match="count twice"):
        load_priors(path, NOMINAL, data_sha256=[calibrated(1).provenance["data_sha256"]])
    # The history is kept over two links of a chain.
    second = sample(None, calibrated(2), prior_from(ground()), seed=2, n_steps=20)
    third = prior_from(second)
    for cal in (calibrated(1), calibrated(2)):
        with pytest.raises(PriorError):
            check_chain(third, NOMINAL, [cal.provenance["data_sha256"]])
    check_chain(third, NOMINAL, [calibrated(3).provenance["data_sha256"]])
    # The sampler itself asks.
    with pytest.raises(PriorError):
        sample(None, calibrated(1), prior_from(ground()))


def test_a_prior_of_another_camera_is_refused() -> None:
    priors = prior_from(ground())
    with pytest.raises(PriorError, match="distortion model"):
        check_chain(priors, scenes.camera("k1"))
    with pytest.raises(PriorError, match="another detector"):
        check_chain(priors, Camera(2048, 1024, 12.0, 72.0, 511.5, 511.5))
    check_chain(Priors.default(NOMINAL), NOMINAL, ["0"])


def test_shift_test_sees_what_moved() -> None:
    still = shift_test(calibrated(1), calibrated(2))
    assert not still.significant
    assert "Nothing shows" in still.text
    moved = shift_test(calibrated(1), calibrated(3, 40, 1.0))
    assert moved.significant
    assert "widen the prior" in moved._repr_html_()
    assert list(moved.to_dataframe()["parameter"]) == list(NOMINAL.parameter_names)
    # With that much allowed, it is no surprise.
    assert not shift_test(
        calibrated(1), calibrated(3, 40, 1.0), AllowedShift(focal_fraction=3e-4)
    ).significant
    # Posteriors with wide priors say the same as calibrations.
    posterior = shift_test(ground(), calibrated(2))
    assert posterior.p_value == pytest.approx(still.p_value, abs=0.1)


def test_shift_test_refuses_what_is_not_independent() -> None:
    chained = sample(None, calibrated(2), prior_from(ground()), seed=2, n_steps=20)
    other = calibrate(scenes.observations("k1"), scenes.nominal(scenes.camera("k1")))
    for before, after, words in (
        (calibrated(1), calibrated(1), "same observations"),
        (calibrated(3), chained, "test its calibration"),
        (calibrated(1), other, "do not compare"),
    ):
        with pytest.raises(PriorError, match=words):
            shift_test(before, after)
