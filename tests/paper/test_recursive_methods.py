"""Least squares, Samaan's and Griffith's method: same call, same result, covariances that hold, and
streams.
"""

import dataclasses
import re
from functools import lru_cache

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.calibration.calibrate import METHODS
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.status import Status
from starcal_uq.paper.recursive.start import RecursionOptions
from starcal_uq.paper.recursive.stream import RecursiveCalibration
from tests.helpers.scenes import USUAL, camera, nominal, observations, with_sigmas

ALL = RecursionOptions(parameters="all")
BASELINES = [("least_squares", None), ("samaan", None), ("griffith", None), ("griffith", ALL)]


def run(obs, start, method, options=None, **keywords):
    if options is not None:
        keywords["recursion"] = options
    return sc.calibrate(obs, start, method=method, **keywords)


def one_by_one(obs):
    return [obs.select_frames([k]) for k in obs.frame_ids]


@pytest.mark.parametrize(
    ("method", "options", "stated", "model"),
    [
        (*one, stated, model)
        for one, stated in zip(BASELINES, [True, False, False, True], strict=True)
        # Of those that ignore or decouple the distortion one kind of each shows it.
        for model in (USUAL if one[1] is ALL else ("none", "brown_tangential", "inverse"))
    ],
)
def test_every_method_on_every_model(model, stated, method, options):
    truth, obs = camera(model), observations(model, max_mag=6.5)
    obs = with_sigmas(obs) if stated else obs
    cal = run(obs, nominal(truth), method, options)
    assert cal.status is Status.CONVERGED
    keeps = method == "samaan" or options is ALL
    assert cal.camera.distortion == (model if keeps else "none")
    assert cal.method == method
    assert cal.parameter_names == cal.nominal.parameter_names
    assert cal.residuals_px.shape == (obs.n_stars, 2)
    assert (cal.n_stars, cal.n_frames) == (obs.n_stars, obs.n_frames)
    assert cal.sigma_name == ("sigma_scale" if stated else "sigma")
    np.linalg.cholesky(cal.correlation)
    if options is ALL or model == "none":
        # Nothing is ignored: the truth is within the sigmas, and the noise is the noise.
        assert np.max(np.abs(cal.theta - truth.theta) / cal.sigmas) < 4.5
        reference = sc.calibrate(obs, nominal(truth))
        assert cal.sigma == pytest.approx(reference.sigma, rel=0.03)
        if method != "least_squares":
            assert np.max(np.abs(cal.theta - reference.theta) / reference.sigmas) < 0.3
            assert np.allclose(cal.sigmas, reference.sigmas, rtol=0.5 if model == "none" else 0.03)
    if method == "samaan":
        assert [stage.name for stage in cal.stages] == (
            ["optics", "filter"] if model == "none" else ["optics", "filter", "distortion"]
        )
    elif method == "griffith":
        assert [stage.name for stage in cal.stages] == ["filter"]
        assert (
            cal.stages[0].trajectory.shape
            == cal.stages[0].sigmas.shape
            == (obs.n_frames + 1, len(cal.theta))
        )


def test_least_squares_is_stage_one():
    obs = observations(n_frames=200)
    cal = sc.calibrate(obs, sc.paper.paper_start(), method="least_squares")
    efficient = sc.calibrate(obs, sc.paper.paper_start())
    assert np.array_equal(cal.theta, efficient.stages[0].theta[:3])
    assert np.array_equal(cal.stages[0].trajectory, efficient.stages[0].trajectory[:, :3])
    assert np.array_equal(cal.covariance, cal.pair_covariance)
    assert cal.provenance["settings"]["ignored_distortion"] == "brown"
    # Ignored distortion looks like noise.
    assert cal.sigma > 1.3 * efficient.sigma


def test_samaan_decouples_what_griffith_with_all_parameters_couples():
    obs = observations(n_frames=300)
    samaan, griffith = (
        run(obs, sc.paper.paper_start(), "samaan"),
        run(obs, sc.paper.paper_start(), "griffith", ALL),
    )
    truth = camera().theta
    assert np.max(np.abs(griffith.theta - truth) / griffith.sigmas) < 4.0
    # The optics have absorbed the distortion, and k1 comes out several times too large, by any
    # sigma.
    assert 3.0 < samaan.theta[3] / truth[3] < 16.0
    assert np.abs(samaan.theta[3] - truth[3]) / samaan.sigmas[3] > 20.0
    optics = run(obs, sc.paper.paper_start(), "griffith")
    assert np.max(np.abs(samaan.theta[:3] - optics.theta) / optics.sigmas) < 0.01


@pytest.mark.parametrize(
    ("method", "options", "stated"),
    [("samaan", None, True), ("griffith", None, False), ("griffith", ALL, True)],
)
def test_a_stream_gives_what_the_table_gives(method, options, stated):
    obs = observations(n_frames=200)
    obs = with_sigmas(obs) if stated else obs
    table = run(obs, sc.paper.paper_start(), method, options)
    frames = one_by_one(obs)
    for source, twice in ((frames, True), (iter(frames), False), ([obs], True)):
        cal = run(source, sc.paper.paper_start(), method, options)
        assert np.array_equal(cal.theta[:3], table.theta[:3])
        # An iterator is read once: its sums come to the final optics to first order.
        bound = 1e-6 if twice or method == "griffith" else 0.5
        assert np.max(np.abs(cal.theta - table.theta) / table.sigmas) < bound
        assert np.allclose(
            cal.sigmas, table.sigmas, rtol=1e-6 if twice or method == "griffith" else 0.03
        )
        assert cal.sigma == pytest.approx(table.sigma, rel=2e-3)
        assert cal.chi2 == pytest.approx(table.chi2, rel=4e-3)
        assert (cal.dof, cal.n_stars, cal.n_frames) == (table.dof, table.n_stars, table.n_frames)
        assert cal.frame_ids.shape == (0,)
        assert cal.residuals_px.shape == (0, 2)
        assert not cal.has_residuals
        if method == "griffith":
            unit = np.sqrt(np.diag(table.information))
            assert np.max(np.abs(cal.information - table.information) / np.outer(unit, unit)) < 0.03
        turned = table.rotation_per_theta * table.sigmas
        assert np.max(np.abs(cal.rotation_per_theta * table.sigmas - turned)) < 0.02 * np.max(
            np.abs(turned)
        )
        assert np.allclose(np.diag(cal.attitude_noise), np.diag(table.attitude_noise), rtol=5e-3)
    with pytest.raises(CalibrationError, match="kept no residuals"):
        cal.plot.residuals(obs)


def test_the_likelihood_of_a_stream_is_that_of_the_table():
    obs = observations(n_frames=200)
    table, stream = (
        run(source, sc.paper.paper_start(), "griffith", ALL)
        for source in (obs, iter(one_by_one(obs)))
    )
    rng = np.random.default_rng(0)
    z = rng.normal(size=(50, 5))
    theta = table.theta + z @ table.compressed.whitening.T
    ours, theirs = (c.compressed.log_likelihood(theta, table.sigma) for c in (stream, table))
    assert np.std(ours - theirs) < 0.15
    # Control: without the frames' gradients the likelihood would stand elsewhere.
    assert np.std(ours) > 1.0
    post = sc.sample(None, stream, seed=1, n_steps=100)
    reference = sc.sample(obs, table, seed=1, n_steps=100)
    sigmas = np.sqrt(np.diag(reference.covariance))
    assert np.max(np.abs(post.mean[:5] - reference.mean[:5]) / sigmas[:5]) < 0.15


@pytest.mark.parametrize("method", ["samaan", "griffith"])
def test_a_mirror_is_seen(method):
    obs = observations(n_frames=30)
    mirrored = dataclasses.replace(obs, y_px=1023.0 - obs.y_px)
    with pytest.raises(CalibrationError) as caught:
        run(mirrored, sc.paper.paper_start(), method)
    assert caught.value.status is Status.INCONSISTENT
    # Of a list of frames the first ones are looked at.
    with pytest.raises(CalibrationError):
        run(one_by_one(mirrored), sc.paper.paper_start(), method)
    assert (
        run(one_by_one(mirrored), sc.paper.paper_start(), method, throw=False).status
        is Status.INCONSISTENT
    )
    rng = np.random.default_rng(0)
    mixed = rng.permutation(obs.n_stars)
    wrong = dataclasses.replace(obs, ra_deg=obs.ra_deg[mixed], dec_deg=obs.dec_deg[mixed])
    with pytest.raises(CalibrationError):
        run(wrong, sc.paper.paper_start(), method)


def test_what_is_refused():
    obs = observations()
    three = obs.select(np.isin(np.arange(obs.n_stars), [0, 1, 2]))
    for source, options, words in (
        (one_by_one(obs), {}, "needs all frames at once"),
        (["frames.parquet"], {"method": "griffith"}, "holds a str"),
        ([], {"method": "griffith"}, "no frame yet"),
        *((three, {"method": name}, "3 stars in 1 frames") for name in ("least_squares", "samaan")),
    ):
        with pytest.raises(CalibrationError, match=words):
            sc.calibrate(source, sc.paper.paper_start(), **options)


def test_a_source_that_changes_is_found_out():
    frames = one_by_one(observations())

    class Leaking:
        reads = 0

        def __iter__(self):
            self.reads += 1
            return iter(frames if self.reads == 1 else frames[:-1])

    with pytest.raises(
        CalibrationError, match="gave 60 frames at first and 59 when it was read again"
    ):
        sc.calibrate(Leaking(), sc.paper.paper_start(), method="samaan")


@lru_cache(maxsize=1)
def drifting(px_per_frame, n_frames=120, seed=5):
    """Frames of a camera whose focal length grows."""
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    truth = camera("none")
    step = np.array([0.0, 0.0, px_per_frame])
    cameras = [truth.with_theta(truth.theta + k * step) for k in range(n_frames)]
    return [
        sc.simulate(stars, now, n_frames=1, min_stars=10, sigma_px=0.05, seed=seed * 1000 + k)
        for k, now in enumerate(cameras)
    ]


@pytest.mark.parametrize(
    ("method", "options"),
    [
        ("samaan", RecursionOptions(process_noise=(0.0, 0.0, 0.1), sigma_px=0.05)),
        ("griffith", RecursionOptions(forgetting=0.9)),
    ],
)
def test_a_drifting_focal_length_is_followed(method, options):
    final = camera("none").theta[2] + 0.08 * 119
    steps = RecursiveCalibration(nominal(camera("none")), method, options)
    for frame in drifting(0.08):
        step = steps.update(frame)
    assert abs(step.theta[2] - final) < 4.0 * step.sigmas[2] + 0.5
    # Control: a filter that takes the camera as constant stays behind by half of the drift, and
    # does not know it.
    still = RecursiveCalibration(nominal(camera("none")), method)
    for frame in drifting(0.08):
        stays = still.update(frame)
    assert final - stays.theta[2] > 3.0
    assert (final - stays.theta[2]) / stays.sigmas[2] > 10.0


@pytest.mark.slow
def test_the_filter_is_right_where_its_model_is():
    """Samaan's without distortion, full covariance: estimate, sigmas and the filter's own claim
    agree with the spread. Of the others `test_replicates` says so, and of the diagonal covariance
    that it claims too little.
    """
    truth, stars = camera("none"), sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    found = []
    for seed in range(100):
        obs = sc.simulate(stars, truth, n_frames=100, min_stars=10, sigma_px=0.05, seed=seed)
        cal = run(obs, nominal(truth), "samaan")
        claimed = next(stage.sigmas[-1] for stage in cal.stages if stage.name == "filter")
        found.append((cal.theta - truth.theta, cal.sigmas, claimed))
    errors, *both = np.array(found).transpose(1, 0, 2)
    # A right variance ratio strays by 0.14, a right coverage by 2.2 %; bounds are four times that.
    for widths in both:
        ratio = np.mean(errors**2, axis=0) / np.mean(widths**2, axis=0)
        assert np.all(np.abs(ratio - 1.0) < 0.55), ratio
        coverage = np.mean(np.abs(errors / widths) < 1.96, axis=0)
        assert (coverage > 0.85).all(), coverage
    assert (np.abs(np.mean(errors / both[0], axis=0)) < 4.0 / np.sqrt(len(errors))).all()


def test_methods_are_those_that_the_documentation_names():
    assert METHODS == ("efficient", "three_stage", "least_squares", "samaan", "griffith")
    assert all(f"``{method}``" in (sc.calibrate.__doc__ or "") for method in METHODS)


class TestDownstream:
    """What a posterior may be made of, and what is refused."""

    def test_ignored_distortion_fails_the_posterior(self) -> None:
        truth = camera()
        obs = observations(n_frames=20)
        cal = sc.calibrate(obs, nominal(truth), method="least_squares")
        for likelihood in ("marginal", "pairs"):
            posterior = sc.sample(obs, cal, seed=1, n_steps=40, likelihood=likelihood)
            assert not posterior.diagnostics.ok
            assert any(
                "ignores the distortion" in check.sentence for check in posterior.diagnostics.checks
            )
        honest = sc.sample(obs, sc.calibrate(obs, nominal(truth)), seed=1, n_steps=40)
        assert not any(
            "ignores the distortion" in check.sentence for check in honest.diagnostics.checks
        )

    @pytest.mark.parametrize(
        ("method", "stream", "given", "likelihood", "words"),
        [
            ("samaan", True, False, "marginal", "by griffith with all parameters"),
            ("samaan", False, True, "pairs", "method='three_stage'"),
            ("griffith", True, True, "student_t", "a stream does not keep"),
        ],
    )
    def test_refusals_name_the_remedy(
        self, method: str, stream: bool, given: bool, likelihood: str, words: str
    ) -> None:
        obs = observations(n_frames=20)
        cal = sc.calibrate(iter([obs]) if stream else obs, nominal(camera()), method=method)
        with pytest.raises(sc.errors.SamplingError, match=re.escape(words)):
            sc.sample(obs if given else None, cal, seed=1, likelihood=likelihood)
