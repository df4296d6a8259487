"""Priors are the distributions they say they are, in the units they say."""

from pathlib import Path

import numpy as np
import pytest
from scipy import integrate, stats

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import parameter_names
from starcal_uq.core.errors import PriorError
from starcal_uq.inference.priors import Priors
from tests.helpers.scenes import USUAL

CAMERA = Camera(1024, 1024, 12.0, 72.0, 511.5, 511.5)


def test_log_density_is_scipys() -> None:
    priors = Priors.default(CAMERA)
    names = priors.names[:-1]
    rng = np.random.default_rng(1)
    theta = priors.mean(names) + priors.sd(names) * rng.standard_normal((50, 5))
    sigma = rng.uniform(0.01, 1.0, 50)
    expected = np.sum(stats.norm.logpdf(theta, priors.mean(names), priors.sd(names)), axis=1)
    expected += stats.lognorm.logpdf(sigma, priors.sigma_log_sd, scale=priors.sigma_median)
    assert np.allclose(priors.log_density(theta, sigma), expected, rtol=1e-12)


def test_density_of_log_sigma_and_of_sigma_differ_by_the_jacobian() -> None:
    priors = Priors.default(CAMERA)
    sigma = np.array([0.02, 0.1, 0.7])
    expected = stats.norm.logpdf(np.log(sigma), np.log(priors.sigma_median), priors.sigma_log_sd)
    assert np.allclose(priors.log_density_log_sigma(np.log(sigma)), expected)


@pytest.mark.parametrize("name", ["x0", "f", "k2", "sigma"])
def test_marginal_densities_integrate_to_one(name: str) -> None:
    priors = Priors.default(CAMERA)
    mean, sd = priors.mean([name])[0], priors.sd([name])[0]
    low, high = (1e-12, 200.0) if name == "sigma" else (mean - 9 * sd, mean + 9 * sd)
    grid = np.geomspace(low, high, 20_001) if name == "sigma" else np.linspace(low, high, 20_001)
    assert integrate.trapezoid(priors.marginal_density(name, grid), grid) == pytest.approx(
        1.0, abs=1e-4
    )


def test_draws_have_the_stated_moments() -> None:
    priors = Priors.default(CAMERA).replace(sigma_log_sd=0.3)
    draws = priors.draw(200_000, np.random.default_rng(2))
    sd = priors.sd(priors.names)
    assert np.all(np.abs(draws.mean(axis=0) - priors.mean(priors.names)) < 0.02 * sd)
    assert np.allclose(draws.std(axis=0), sd, rtol=0.02)


@pytest.mark.parametrize("model", USUAL)
def test_distortion_prior_is_a_displacement_at_the_corner(model: str) -> None:
    priors = Priors.default(CAMERA.replace(distortion=model)).replace(distortion_corner_px=10.0)
    radius = priors.corner_radius_px
    powers = {"k1": 3, "k2": 5, "k3": 7, "p1": 2, "p2": 2}
    for name in parameter_names(model)[3:]:
        assert priors.sd([name])[0] * radius ** powers[name] == pytest.approx(10.0)
        assert priors.mean([name])[0] == 0.0


def test_defaults_are_wide_and_centred_on_the_nominal_camera() -> None:
    priors = Priors.default(CAMERA)
    assert priors.principal_point_centre_px == (511.5, 511.5)
    assert priors.focal_px == pytest.approx(6000.0)
    assert priors.principal_point_px == pytest.approx(102.4)
    assert priors.names == ("x0", "y0", "f", "k1", "k2", "sigma")
    assert Priors.default(CAMERA, per_star_sigma=True).names[-1] == "sigma_scale"


def test_noise_must_be_positive_to_have_a_density() -> None:
    priors = Priors.default(CAMERA)
    theta = np.tile(CAMERA.theta, (3, 1))
    assert np.array_equal(
        np.isfinite(priors.log_density(theta, np.array([0.1, 0.0, -1.0]))), [True, False, False]
    )
    assert np.array_equal(priors.marginal_density("sigma", np.array([-1.0, 0.0])), [0.0, 0.0])


def test_dictionary_round_trip() -> None:
    priors = Priors.default(CAMERA, per_star_sigma=True).replace(focal_fraction=1 / 3)
    assert Priors.from_dict(priors.to_dict()) == priors


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"sigma_log_sd": 0.0}, "above zero"),
        ({"principal_point_px": float("inf")}, "finite"),
        ({"focal_px": float("nan")}, "finite"),
        ({"principal_point_centre_px": (1.0, float("nan"))}, "two finite numbers"),
        ({"k1": 1.0}, "no prior named 'k1'"),
        ({"corner_radius_px": 1e300}, "leave no number"),
        ({"corner_radius_px": 1e-300}, "leave no number"),
    ],
)
def test_improper_priors_are_refused(change: dict[str, object], match: str) -> None:
    with pytest.raises(PriorError, match=match):
        Priors.default(CAMERA).replace(**change)


def test_priors_of_another_model_are_refused() -> None:
    with pytest.raises(PriorError):
        Priors.default(CAMERA).mean(["x0", "p1"])


def test_toml_overrides_defaults(tmp_path: Path) -> None:
    path = tmp_path / "priors.toml"
    path.write_text(
        "[priors]\nfocal_fraction = 0.001\nprincipal_point_centre_px = [500, 530.5]\n",
        encoding="utf-8",
    )
    priors = Priors.from_toml(path, CAMERA)
    assert priors.focal_fraction == 0.001
    assert priors.principal_point_centre_px == (500.0, 530.5)
    assert priors.sigma_median == Priors.default(CAMERA).sigma_median


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("[priors]\nfocal_frac = 0.1\n", "key focal_frac is unknown; did you mean focal_fraction"),
        ("[priors]\nprincipal_point_centre_px = 500\n", "principal_point_centre_px is 500; write"),
        ("[priors]\nfocal_fraction = -0.1\n", "above zero"),
        ("[priors]\ndistortion_corner_px = 1e-300\n", "leave no number"),
    ],
)
def test_bad_toml_names_file_and_key(tmp_path: Path, text: str, match: str) -> None:
    path = tmp_path / "priors.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(PriorError, match=match) as caught:
        Priors.from_toml(path, CAMERA)
    assert str(path) in str(caught.value)


def test_table_states_every_prior() -> None:
    priors = Priors.default(CAMERA)
    table = priors.to_dataframe()
    assert list(table["parameter"]) == list(priors.names)
    assert "displacement" in table["statement"].iloc[3]
    assert "<table" in priors._repr_html_()
