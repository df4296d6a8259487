"""Each check of a posterior at both sides of its bound, with what it says and advises."""

import dataclasses
import re

import numpy as np
import pytest

from starcal_uq.core.remedy import PLAN, read_remedies, with_model
from starcal_uq.core.status import Check, Code, Level
from starcal_uq.inference import checks
from starcal_uq.inference.derived import derived_quantities
from starcal_uq.inference.posterior import Derived, Posterior
from starcal_uq.inference.sample import sample
from tests.helpers.gaussian_camera import gaussian_calibration

N_STEPS = 60


@pytest.fixture(scope="module")
def post() -> Posterior:
    return sample(
        None, gaussian_calibration(), n_walkers=16, n_steps=N_STEPS, seed=3, evaluation="compressed"
    )


def changed(post: Posterior, **changes: object) -> Posterior:
    return dataclasses.replace(post, diagnostics=dataclasses.replace(post.diagnostics, **changes))


def times_longer(check: checks.Check) -> float:
    """How many times as many steps the remedy takes."""
    (command,) = re.findall(r"--steps (\d+) ", check.remedy)
    assert f"n_steps={command}" in check.remedy
    return int(command) / N_STEPS


def test_ensembles_that_agree_and_that_do_not(post: Posterior) -> None:
    rhat = np.full(6, 1.005)
    good = checks._rhat(changed(post, rhat=rhat))
    assert good.level is Level.PASS and good.remedy == "" and good.value == "1.0050"
    rhat[2] = 1.02
    bad = checks._rhat(changed(post, rhat=rhat))
    assert bad.level is Level.FAIL and "disagree in f:" in bad.sentence and times_longer(bad) == 2.0


def test_too_few_effective_draws_take_as_many_more_steps(post: Posterior) -> None:
    many = np.full(6, 5000.0)
    assert checks._effective_draws(changed(post, ess_bulk=many, ess_tail=many)).level is Level.PASS
    few = many.copy()
    few[4] = 100.0
    for names in ({"ess_bulk": few, "ess_tail": many}, {"ess_bulk": many, "ess_tail": few}):
        check = checks._effective_draws(changed(post, **names))
        assert check.level is Level.FAIL and "of k2 for" in check.sentence
        # A fifth in reserve; at most 20 times as many, and twice at least.
        assert times_longer(check) == np.ceil(1.2 * checks.ESS_BOUND / 100.0)
    least = checks._effective_draws(changed(post, ess_bulk=many, ess_tail=np.full(6, 1.0)))
    assert times_longer(least) == 20.0


@pytest.mark.parametrize("late", ["rhat", "ess_bulk", "ess_tail", None])
def test_what_follows_from_the_parameters_converges_too(post, late) -> None:
    good = Derived("focal length", "mm", 1.0, 1.0, 0.01, 1.001, 9000.0, 9000.0)
    numbers = {"rhat": 1.2, "ess_bulk": 200.0, "ess_tail": 200.0}
    other = dataclasses.replace(
        good, name="common rotation", **({} if late is None else {late: numbers[late]})
    )
    check = checks._derived(post, [good, other])
    if late is None:
        assert (
            check.level is Level.PASS
            and "have converged too" in check.sentence
            and check.remedy == ""
        )
        return
    assert check.level is Level.FAIL and check.sentence.startswith(
        "Common rotation has not converged"
    )
    asked = 2.0 if late == "rhat" else np.ceil(1.2 * checks.ESS_BOUND / 200.0)
    assert times_longer(check) == max(asked, 2.0)


def test_derived_quantities_have_the_moments_of_their_draws(post: Posterior) -> None:
    # Kept with the posterior, so that nobody finds them again.
    assert post.diagnostics.derived == derived_quantities(post)
    mm = next(found for found in post.diagnostics.derived if found.unit == "mm")
    draws = post.theta_draws[:, 2] * post.camera.pixel_um * 1e-3
    assert mm.mean == pytest.approx(draws.mean(), rel=1e-12)
    assert mm.sd == pytest.approx(draws.std(ddof=1), rel=1e-9)


def test_degrees_of_freedom_are_stated_by_their_quantiles(post: Posterior) -> None:
    drawn = np.random.default_rng(0).permutation(np.linspace(4.0, 6.0, len(post.draws)))
    check = checks._degrees_of_freedom(dataclasses.replace(post, dof_draws=drawn))
    assert check.sentence == "dof has the median 5 and the 95 % interval 4.05 to 5.95."
    assert check.level is Level.PASS
    drifting = checks._degrees_of_freedom(dataclasses.replace(post, dof_draws=np.sort(drawn)))
    assert drifting.level is Level.FAIL and times_longer(drifting) == 20.0


def test_importance_sampling_agrees_or_not(post: Posterior) -> None:
    alike = {"agreement_mean": 0.01, "agreement_sd": 0.01, "psis_khat": 0.1, "psis_ess": 4000.0}
    good = checks._independent(changed(post, **alike))
    assert good.level is Level.PASS and good.remedy == "" and "gives the same" in good.sentence
    for name in ("agreement_mean", "agreement_sd"):
        bad = checks._independent(changed(post, **(alike | {name: 1.0})))
        assert (
            bad.level is Level.FAIL and "gives other" in bad.sentence and times_longer(bad) == 2.0
        )
    heavy = checks._independent(changed(post, **(alike | {"psis_khat": 0.9, "agreement_sd": 1.0})))
    assert (
        heavy.level is Level.FAIL
        and "says nothing" in heavy.sentence
        and "--model k1" in heavy.remedy
    )


def test_how_the_likelihood_was_evaluated(post: Posterior) -> None:
    def said(
        used: str, difference: float, khat: float = 0.0, frames: tuple[int, int] = (0, 0)
    ) -> checks.Check | None:
        words = {"compressed_khat": khat, "compressed_frames": frames}
        return checks._evaluation(
            changed(post, likelihood_used=used, compressed_max_difference=difference, **words)
        )

    assert said("exact", np.nan) is None
    tried = said("exact", 3.0)
    assert (
        tried.level is Level.PASS
        and tried.value == "exact"
        and "departs from it by 3.0 nat" in tried.sentence
    )
    unchecked = said("compressed", np.nan)
    assert unchecked.level is Level.WARN and unchecked.remedy == "sc.sample(obs, cal)"
    good = said("compressed", 0.01)
    assert (
        good.level is Level.PASS
        and good.remedy == ""
        and good.sentence.endswith("wherever the posterior is.")
    )
    assert "as 1000 of 5000 frames tell" in said(
        "compressed", 0.01, frames=(1000, 5000)
    ).sentence.replace("\u202f", "")
    for bad in (said("compressed", 5.0), said("compressed", 0.01, khat=0.9)):
        assert bad.level is Level.FAIL and "--evaluation exact" in bad.remedy
    whole = checks.CompressionCheck(0.1, 0.2)
    assert whole.good and (whole.n_frames, whole.of_frames) == (0, 0)


def test_points_around_the_mode_are_three_standard_deviations_out() -> None:
    points = checks._surface(5)
    assert points.shape == (20, 5)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 3.0)
    # Both ways along each axis, and two different bases.
    np.testing.assert_allclose(points[:10] + points[10:], 0.0, atol=1e-12)
    np.testing.assert_allclose(points[:5] @ points[:5].T, 9.0 * np.eye(5), atol=1e-12)
    assert np.abs(points[:5] @ points[5:10].T).max() < 8.99


def test_a_likelihood_that_is_known_to_be_wrong(post: Posterior) -> None:
    assert checks._likelihood(changed(post, likelihood="marginal"), {}) is None
    pairs = checks._likelihood(changed(post, likelihood="pairs"), {"variability": "empirical"})
    assert pairs.level is Level.PASS and pairs.remedy == ""
    assert pairs.sentence == (
        "The posterior is that of the likelihood 'pairs'. It is the composite one over pairs of "
        "stars, with Godambe's curvature; its variability comes from the scatter between frames. "
        "sigma is estimated from the pixel residuals at the best attitudes; pairs have no say in "
        "it."
    )
    naive = checks._likelihood(changed(post, likelihood="pairs_naive"), {})
    assert (
        naive.level is Level.FAIL
        and "which they are not" in naive.sentence
        and "likelihood='pairs'" in naive.remedy
    )


def test_sampling_again_keeps_the_settings(post: Posterior) -> None:
    (default,) = checks.resample(post, n_steps=900)
    assert (
        f"{default.command} or {default.call}"
        == "starcal-uq sample RUN --force --walkers 16 --steps 900 --evaluation compressed or "
        + ("sc.sample(obs, cal, n_walkers=16, n_steps=900, evaluation='compressed')")
    )
    # An object of one's own is evaluated as it is, and no command takes it.
    (own,) = checks.resample(post, likelihood="gaussian")
    assert own.call == "sc.sample(obs, cal, n_walkers=16, n_steps=60, likelihood=likelihood)"
    assert own.command == ""


def test_remedies_that_were_written_as_text_are_read(post: Posterior) -> None:
    own = checks.resample(post, likelihood="gaussian")
    for remedies in (checks.resample(post, n_steps=900), own, with_model("k1") + PLAN, PLAN, ()):
        bad = Check(Code.BOUNDS, remedies=remedies)
        assert read_remedies(bad.remedy) == remedies


def moved(post: Posterior, column: int, draws: np.ndarray) -> Posterior:
    """With other draws of one parameter."""
    return dataclasses.replace(
        post, draws=np.insert(np.delete(post.draws, column, axis=1), column, draws, axis=1)
    )


def test_a_sampler_that_hardly_moves(post: Posterior) -> None:
    rates = np.full_like(post.diagnostics.acceptance, 0.4)
    good = checks._acceptance(changed(post, acceptance=rates))
    assert good.level is Level.PASS and good.remedy == "" and good.value == "0.40 to 0.40"
    for rate in (0.05, 0.99):
        rates.flat[1] = rate
        bad = checks._acceptance(changed(post, acceptance=rates))
        assert bad.level is Level.FAIL and "hardly moves" in bad.sentence
        assert "moves='stretch'" in bad.remedy and f"n_steps={10 * N_STEPS}" in bad.remedy


@pytest.mark.parametrize("sd", [0.7, 5.3])
def test_monte_carlo_error_is_held_against_the_last_printed_digit(post, sd):
    """Means are printed to the second digit of sigma: to 0.01 px of 0.7, to 0.1 px of 5.3."""
    unit = 10.0 ** (np.floor(np.log10(sd)) - 1.0)
    z = post.draws[:, 2] - post.draws[:, 2].mean()
    at = moved(post, 2, 5800.0 + sd / z.std(ddof=1) * z)
    for share, level in ((0.9, Level.PASS), (1.8, Level.WARN)):
        mcse = np.zeros(6)
        mcse[2] = share * unit
        check = checks._digits(changed(at, mcse=mcse))
        assert check.level is level and check.value == f"{share:.2f} units of the last digit (f)"
    assert "digit of f:" in check.sentence and times_longer(check) == np.ceil(1.2 * 1.8**2)


def test_draws_beyond_what_a_camera_can_be(post: Posterior) -> None:
    camera, n = post.camera, len(post.draws)
    spread = np.linspace(-1.0, 1.0, n)
    sd = spread.std(ddof=1)
    # Ten standard deviations from each edge of the detector in turn; pixels reach half a pixel
    # beyond their centres.
    for column, edge, inside in ((0, -0.5, 1.0), (1, -0.5, 1.0), (0, camera.width_px - 0.5, -1.0)):
        near = checks._bounds(moved(post, column, edge + inside * 10.0 * sd + spread))
        assert near.level is Level.PASS and near.value == "nearest bound 10 sigma away"
    for share, level in ((0.0005, Level.PASS), (0.02, Level.FAIL)):
        x0 = np.full(n, 500.0) + spread
        x0[: round(share * n)] = -1.0
        check = checks._bounds(moved(post, 0, x0))
        assert check.level is level
    assert check.sentence.startswith(
        "2.0\N{NO-BREAK SPACE}% of the draws have their principal point off"
    )
    k1 = post.draws[:, 3].copy()
    k1[0] = -1e-5
    folds = checks._bounds(moved(post, 3, k1))
    assert folds.level is Level.FAIL and "folds over" in folds.sentence


def test_the_prior_or_the_data(post: Posterior) -> None:
    names = list(post.parameter_names)
    mean, sd = post.priors.mean(names), post.priors.sd(names)
    z = np.random.default_rng(1).standard_normal(len(post.draws))
    z = (z - z.mean()) / z.std(ddof=1)
    assert checks._priors(post).level is Level.PASS
    for shift, share, level, words in (
        (0.0, 0.4, Level.PASS, "The data decide every parameter"),
        (0.0, 0.6, Level.WARN, "The prior, not the data, decides y0."),
        (-3.5, 0.1, Level.WARN, "The data put y0 3.5 prior standard deviations away"),
        (2.5, 0.1, Level.PASS, "The data decide"),
    ):
        check = checks._priors(moved(post, 1, mean[1] + sd[1] * (shift + share * z)))
        assert check.level is level and check.sentence.startswith(words)
        if share > 0.3:
            assert check.value == f"sigma {100 * share:.0f}\N{NO-BREAK SPACE}% of the prior's (y0)"
