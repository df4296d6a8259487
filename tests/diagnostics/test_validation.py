"""Validation finds right uncertainties right and wrong ones wrong."""

import contextlib
import dataclasses
import signal

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import (
    PriorError,
    SamplingError,
    SettingError,
)
from starcal_uq.diagnostics.validation.replicates import LOG_LIKELIHOOD, Replication, run_replicate
from starcal_uq.diagnostics.validation.validate import narrow_priors, validate, validate_study
from starcal_uq.maths.ranks import (
    counts_below,
)
from starcal_uq.presentation.figures.diagnostics import plot_validation
from starcal_uq.presentation.figures.style import png_bytes
from starcal_uq.simulation.frames import Campaign
from tests.helpers import validation_controls as controls
from tests.helpers.scenes import camera, nominal

# Starts are draws of the Laplace approximation, which is nearly the posterior here: little has to
# be forgotten.
LIGHT = {"n_steps": 20, "n_burn": 10}
QUANTITIES = ("x0", "y0", "f", "k1", "k2", "sigma", "log_likelihood", "pitch", "yaw", "roll")


def study(model="brown", n_frames=12, seed=5, sigma_px=0.05, **options):
    truth = camera(model)
    start = nominal(truth)
    return Replication(
        truth,
        start,
        sc.Priors.default(start),
        "fixed",
        Campaign(n_frames, sigma_px=sigma_px),
        seed,
        **{**LIGHT, **options},
    )


@pytest.fixture(scope="module")
def stars():
    return sc.load_catalogue(max_mag=6.0)


def remembering(function):
    """A function that gives the earlier results for arguments of before."""
    known = {}

    def remembered(first, *arguments, **options):
        key = (getattr(first, "data_hash", None), arguments, tuple(options.items()))
        if key not in known:
            known[key] = function(first, *arguments, **options)
        return known[key]

    return remembered


@pytest.fixture(scope="module")
def remembered():
    """Studies of one camera and seed that differ in the likelihood only share their simulations and
    calibrations.
    """
    return {
        "starcal_uq.simulation.frames.simulate": remembering(sc.simulate),
        "starcal_uq.diagnostics.validation.replicates.calibrate": remembering(sc.calibrate),
    }


@contextlib.contextmanager
def data_made_once(remembered):
    with pytest.MonkeyPatch.context() as patch:
        for place, function in remembered.items():
            patch.setattr(place, function)
        yield


@pytest.fixture
def same_data(remembered):
    with data_made_once(remembered):
        yield


@pytest.fixture(scope="module")
def good(stars, remembered):
    with data_made_once(remembered):
        return validate_study(study(), stars, 100, workers=0, settings={"n_frames": 12})


def test_draws_are_those_that_users_get(stars):
    """A replicate's moments agree with those of `sample` on its data."""
    settings = study(n_frames=40, n_steps=200)
    seeds, again = (np.random.SeedSequence(settings.seed, spawn_key=(3,)) for _ in range(2))
    outcome = run_replicate(settings, stars, 3, seeds)
    noise = again.spawn(3)[1]
    obs = sc.simulate(
        stars,
        settings.camera,
        n_frames=40,
        min_stars=10,
        sigma_px=0.05,
        seed=int(noise.generate_state(1, np.uint64)[0]),
    )
    cal = sc.calibrate(obs, settings.nominal)
    post = sc.sample(obs, cal, seed=1)
    # 12,800 draws with an autocorrelation time near 2.4: 5300 independent ones.
    difference = (outcome.error[:6] + outcome.truth - post.draws.mean(axis=0)) / post.sd
    assert np.abs(difference).max() < 4 * np.sqrt(1 / 5300 + 1 / 20000)
    np.testing.assert_allclose(outcome.sd[:6], post.sd, rtol=0.06)
    quantiles = np.quantile(post.draws, [0.025, 0.975], axis=0)
    clear = np.min(np.abs(quantiles - outcome.truth), axis=0) > 0.1 * post.sd
    inside = (quantiles[0] <= outcome.truth) & (outcome.truth <= quantiles[1])
    assert (outcome.covered[:6] == inside)[clear].all()
    assert abs(outcome.compression_error) < 0.02


def test_right_uncertainties_pass(good):
    assert good.quantities == QUANTITIES
    assert good.n_replicates == 100
    assert good.failures == ()
    assert good.ok, good.text
    assert (np.abs(good.coverage - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 100)).all()
    assert abs(good.nees_ratio - 1.0) < 4 * np.sqrt(2 / 500)
    assert abs(good.nees_calibration.mean() / good.n_parameters - good.nees_ratio) < 0.05
    assert (good.rank_p_value > 1e-3).all()
    assert np.abs(good.compression_error).max() < 0.05
    assert "are right as far as" in good.text


@pytest.mark.slow
def test_another_model_passes_with_truths_from_the_prior(stars):
    model = "brown_tangential"
    truth = camera(model)
    # A tenth of the default: decentring of several px makes another minimum, in which a calibration
    # can end.
    priors = narrow_priors(truth, 0.05).replace(distortion_corner_px=0.1)
    settings = dataclasses.replace(study(model, n_frames=20), truth="prior", priors=priors)
    found = validate_study(settings, stars, 25, workers=0)
    assert found.quantities[:3] == ("x0", "y0", "f")
    assert len(found.quantities) == 3 + len(truth.coefficients) + 5
    assert not any(f.rejected for f in found.findings), found.text
    # The truths are what the priors say.
    expected = found.priors
    z = (found.truth[:, :-1] - expected.mean(expected.names[:-1])) / expected.sd(
        expected.names[:-1]
    )
    assert np.abs(z.mean(axis=0)).max() < 4 / np.sqrt(25)
    assert np.log(found.truth[:, -1] / 0.05).std() == pytest.approx(0.2, rel=0.45)


def test_attitudes_forgotten_in_the_degrees_of_freedom_are_found(stars, same_data):
    found = validate_study(study(likelihood=controls.forgets_attitudes), stars, 50, workers=0)
    assert not found.ok
    at = found.quantities.index("sigma")
    assert found.rank_p_value[at] < 1e-5
    assert found.z[:, at].mean() < -1.0
    assert "Estimates of sigma are too low" in found.text


def test_pairs_taken_as_independent_are_found(stars, same_data):
    found = validate_study(study(likelihood="pairs_naive"), stars, 25, workers=0)
    assert not found.ok
    assert found.coverage[0] < 0.8
    assert found.nees_ratio > 5.0
    assert found.nees_p_value < 1e-6
    assert "too narrow" in found.text


@pytest.mark.slow
def test_pairs_with_their_curvature_put_right_pass(stars):
    found = validate_study(study(likelihood="pairs", n_frames=20), stars, 25, workers=0)
    assert not any(f.rejected for f in found.findings), found.text
    assert np.isnan(found.compression_error).all()


def test_noise_understated_by_a_fifth_is_found(stars, same_data):
    found = validate_study(study(assumed_sigma_px=0.04), stars, 40, workers=0)
    assert "sigma" not in found.quantities
    assert not found.ok
    assert found.nees_p_value < 1e-3
    assert "too narrow" in found.text


def test_failed_replicates_are_counted_and_explained(good):
    reasons = ("the calibration did not end well (SINGULAR): add frames.",) * 2 + (
        "another reason.",
    )
    found = dataclasses.replace(good, failures=reasons)
    assert not found.ok
    assert (
        "3 of 103 replicates gave no result, 2 of them because the calibration did not end well"
        in found.text
    )


def _same(a, b, n=None):
    for name in (
        "replicate",
        "truth",
        "ranks",
        "covered",
        "error",
        "sd",
        "nees",
        "compression_error",
    ):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name)[:n])


def test_workers_do_not_change_a_bit_and_a_few_replicates_are_the_first_of_many(stars, good):
    calls = []
    few = validate_study(
        study(), stars, 6, workers=2, progress=lambda done, total: calls.append((done, total))
    )
    _same(few, good, 6)
    assert calls[-1] == (6, 6)
    assert [done for done, _ in calls] == sorted(done for done, _ in calls)
    assert not few.ok and "Too few replicates" in few.text
    # Another seed gives others.
    other = validate_study(study(seed=12), stars, 2, workers=0)
    assert not np.array_equal(other.ranks, few.ranks[:2])


def test_an_interrupted_validation_goes_on_with_what_it_kept(tmp_path):
    settings = {"n_frames": 4, "min_stars": 6, "seed": 11, "workers": 0}

    def press(done, total):
        if done == 2:
            signal.raise_signal(signal.SIGINT)

    part = sc.validate(camera(), n_replicates=4, keep=tmp_path, progress=press, **settings)
    assert part.interrupted and "interrupted after 2 of 4" in part.text
    told = []
    resumed = sc.validate(
        camera(),
        n_replicates=4,
        keep=tmp_path,
        progress=lambda done, _: told.append(done),
        **settings,
    )
    assert told == [3, 4]
    _same(resumed, sc.validate(camera(), n_replicates=4, **settings))
    with pytest.raises(SamplingError, match="leave out `keep`"):
        sc.validate(camera(), keep=tmp_path, likelihood=lambda obs, cal: cal.compressed)


def test_validate_from_the_camera_alone():
    found = validate(sc.paper.paper_camera(), n_replicates=2, n_frames=12, workers=0, seed=3)
    assert found.nominal.coefficients == (0.0, 0.0)
    assert (found.nominal.x0_px, found.nominal.y0_px) == (511.5, 511.5)
    assert found.provenance["seed"] == 3
    assert found.provenance["settings"]["n_frames"] == 12
    np.testing.assert_array_equal(
        found.truth[:, :-1], np.tile(sc.paper.paper_camera().theta, (2, 1))
    )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"truth": "posterior"}, "truth 'posterior' is unknown"),
        ({"likelihood": "student_t"}, "'student_t' cannot be validated"),
    ],
)
def test_bad_settings_are_one_sentence(options, words):
    with pytest.raises((SamplingError, SettingError), match=words):
        validate(sc.paper.paper_camera(), **options)


def test_priors_of_another_model_are_refused():
    with pytest.raises(PriorError):
        validate(sc.paper.paper_camera(), priors=sc.Priors.default(camera("none")))


def test_priors_that_make_no_camera_say_so(stars):
    priors = narrow_priors(camera(), 0.05).replace(principal_point_centre_px=(-5000.0, 0.0))
    with pytest.raises(PriorError):
        validate_study(
            dataclasses.replace(study(), truth="prior", priors=priors), stars, 1, workers=0
        )


def test_figure_shows_curves_bands_and_coverage(good):
    figure = plot_validation(good)
    assert png_bytes(figure, dpi=50).startswith(b"\x89PNG")
    panels = [ax for ax in figure.axes if ax.axison]
    assert len(panels) == len(QUANTITIES) + 2
    curve = panels[0].lines[1].get_ydata()
    expected = counts_below(good.ranks[:, 0], good.n_ranked + 1) / 100 - np.arange(1, 128) / 128
    np.testing.assert_allclose(curve[1:-1], expected)
    assert panels[-1].get_title(loc="left").startswith("NEES/5")


def test_log_likelihood_is_one_of_the_quantities(good):
    """The joint log likelihood lies half a chi-square of p + 1 below its maximum."""
    at = QUANTITIES.index(LOG_LIKELIHOOD)
    assert good.units[at] == "nat"
    assert good.sd[:, at].mean() == pytest.approx(np.sqrt(6 / 2), rel=0.05)
    assert abs(good.error[:, at].mean()) < 4 * np.sqrt(6 / 2 / 100)
