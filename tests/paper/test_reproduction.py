"""The paper's experiment beside ours: measures of error, readings, judgement, and the report."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import brentq, least_squares
from scipy.stats import kstest, norm

import starcal_uq as sc
from starcal_uq.attitude.rotations import exp_rotation
from starcal_uq.camera.projection import unproject
from starcal_uq.paper import published
from starcal_uq.paper import reproduction as command
from starcal_uq.paper.camera import paper_camera, paper_start
from starcal_uq.paper.checks import NO, WITHIN_NOISE, paper_checks, printed_camera
from starcal_uq.paper.errors import (
    OPTICS,
    aligned,
    detector_grid,
    map_error,
    reprojection_error_px,
    undistorted,
)
from starcal_uq.paper.judgement import MAX_CHANCE, Judged, Outcome, trial
from starcal_uq.paper.published import (
    LEAST_SQUARES,
    PAPER_METHODS,
    PROPOSED,
    SAMAAN,
    Printed,
    printed,
)
from starcal_uq.paper.readings import AS_PRINTED, OTHER_EQUATION, READINGS, fit_angles
from starcal_uq.paper.replicates import METHODS, is_slow, replicate
from starcal_uq.paper.result import Reproduction, row_tests
from starcal_uq.simulation.frames import simulate
from tests.helpers.painting import without_painting
from tests.helpers.scenes import observations

# Table 1 of the paper, and where sections 3.2 and 3.3 say that the estimation starts.
PRINTED_TRUTH = {
    **{
        "width_px": 1024,
        "height_px": 1024,
        "pixel_um": 12.0,
        "focal_mm": 70.2262,
        "x0_px": 500.0,
        "y0_px": 530.0,
    },
    **{"k1": 2.0e-10, "k2": -3.5e-15},
}
PRINTED_START = {"focal_mm": 72.0, "x0_px": 512.0, "y0_px": 512.0}
TRUTH = paper_camera()
WRONG = TRUTH.replace(focal_mm=70.2, x0_px=503.0, y0_px=526.0, coefficients=(5e-10, -2e-15))


def points(n: int = 40, seed: int = 0) -> np.ndarray:
    """Places on the detector."""
    return np.random.default_rng(seed).uniform(0.0, 1023.0, (n, 2))


def test_the_cameras_are_those_of_the_paper() -> None:
    for convention, model in (("eq14", "brown"), ("eq6", "inverse")):
        camera, start = paper_camera(convention), paper_start(convention)
        assert camera.distortion == start.distortion == model
        table = camera.to_dict()
        assert {key: table[key] for key in PRINTED_TRUTH} == PRINTED_TRUTH
        assert {key: start.to_dict()[key] for key in PRINTED_START} == PRINTED_START
    assert paper_camera() == paper_camera("eq14")
    with pytest.raises(sc.errors.CameraError):
        paper_camera("eq15")


def test_numbers_are_kept_as_printed() -> None:
    assert len(published.PUBLISHED) == len(set(published.PUBLISHED)) == 24
    assert printed(SAMAAN, "k1").value == 2.76e-10
    assert printed(SAMAAN, "k1").unit_in_last_place == pytest.approx(1e-12)
    assert printed(SAMAAN, "k1", "section 3.3").text == "3.09e-10"
    assert printed(LEAST_SQUARES, "y0_px").unit_in_last_place == pytest.approx(0.01)
    with pytest.raises(KeyError):
        printed(LEAST_SQUARES, "k1")


def undistorted_by_hand(camera: sc.Camera, xy: np.ndarray, how: str) -> np.ndarray:
    """Eqs. 6 and 14, one star at a time, along the radius."""
    k1, k2 = camera.coefficients
    found = []
    for x, y in xy:
        dx, dy = x - camera.x0_px, y - camera.y0_px
        seen = np.hypot(dx, dy)
        if how == "eq14":
            ideal = brentq(
                lambda r, s=seen: r * (1 + k1 * r**2 + k2 * r**4) - s, 0.0, 2.0 * seen, xtol=1e-12
            )
        elif how == "eq14_measured":
            ideal = seen / (1 + k1 * seen**2 + k2 * seen**4)
        else:
            ideal = seen * (1 + k1 * seen**2 + k2 * seen**4)
        found.append((camera.x0_px + dx * ideal / seen, camera.y0_px + dy * ideal / seen))
    return np.array(found)


@pytest.mark.parametrize("how", ["eq14", "eq14_measured", "eq6"])
def test_eq16_against_a_direct_calculation(how: str) -> None:
    xy = points()
    np.testing.assert_allclose(
        undistorted(WRONG, xy, how), undistorted_by_hand(WRONG, xy, how), atol=1e-9
    )
    ideal = undistorted_by_hand(TRUTH, xy, "eq14")
    hat = undistorted_by_hand(WRONG, xy, how)
    squares = [(x - u) ** 2 + (y - v) ** 2 for (x, y), (u, v) in zip(ideal, hat, strict=True)]
    found = reprojection_error_px(TRUTH, WRONG, xy, undistortion=how)
    assert found.rms_px == pytest.approx((sum(squares) / len(squares)) ** 0.5, abs=1e-9)
    assert found.max_px == pytest.approx(max(squares) ** 0.5, abs=1e-9)


def test_each_model_undistorts_by_its_own_equation() -> None:
    xy = points()
    for convention, how in (("eq14", "eq14"), ("eq6", "eq6")):
        camera = paper_camera(convention)
        np.testing.assert_allclose(undistorted(camera, xy), undistorted(camera, xy, how), atol=1e-9)
        assert (
            np.abs(
                undistorted(camera, xy)
                - undistorted(camera, xy, "eq6" if how == "eq14" else "eq14")
            ).max()
            > 0.1
        )
    with pytest.raises(ValueError, match="use one of model"):
        undistorted(TRUTH, xy, "eq15")
    with pytest.raises(ValueError, match="use one of truth"):
        reprojection_error_px(TRUTH, WRONG, xy, optics="guess")


def test_eq16_is_zero_for_the_truth_and_the_noise_for_noise() -> None:
    xy = points(20_000)
    noise = 0.05 * np.random.default_rng(1).standard_normal(xy.shape)
    for how in ("model", "eq14"):
        for optics in OPTICS:
            assert (
                reprojection_error_px(TRUTH, TRUTH, xy, undistortion=how, optics=optics).max_px
                < 1e-9
            )
    noisy = reprojection_error_px(TRUTH, TRUTH, xy, noise_px=noise)
    assert noisy.rms_px == pytest.approx(0.05 * 2**0.5, rel=0.02)
    # Negative control: the other equation is no inverse, and is seen.
    assert reprojection_error_px(TRUTH, TRUTH, xy, undistortion="eq6").rms_px > 0.2


def test_eq16_is_blind_to_the_focal_length_unless_it_makes_the_ideal_points() -> None:
    xy, longer = points(), TRUTH.replace(focal_mm=TRUTH.focal_mm * 1.001)
    assert reprojection_error_px(TRUTH, longer, xy).max_px < 1e-9
    assert reprojection_error_px(TRUTH, longer, xy, optics="focal").max_px > 0.3
    moved = TRUTH.replace(x0_px=502.0)
    assert reprojection_error_px(TRUTH, moved, xy).max_px < 0.01
    assert reprojection_error_px(TRUTH, moved, xy, optics="estimate").rms_px == pytest.approx(
        2.0, rel=0.01
    )


def test_map_error_is_blind_to_a_common_rotation_and_to_nothing_else() -> None:
    xy, weight = detector_grid(TRUTH)
    true, estimated = unproject(TRUTH, xy), unproject(WRONG, xy)
    turned, rotation = aligned(estimated, true, weight)
    extra = exp_rotation(np.array([1e-3, -2e-3, 5e-3]))
    again, both = aligned(estimated @ extra.T, true, weight)
    np.testing.assert_allclose(again, turned, atol=1e-12)
    np.testing.assert_allclose(both, extra @ rotation, atol=1e-12)
    # Negative controls: a focal length that is 1e-5 too long, and a distortion, are seen.
    longer = map_error(TRUTH, TRUTH.replace(focal_mm=TRUTH.focal_mm * (1.0 + 1e-5)))
    radius = np.hypot(*(undistorted(TRUTH, xy) - TRUTH.theta[:2]).T)
    assert longer.rms_px == pytest.approx(1e-5 * np.sqrt(np.sum(weight * radius**2)), rel=0.02)
    assert map_error(TRUTH, TRUTH.replace(coefficients=(3e-10, -3.5e-15))).max_px > 0.02


def test_grid_weights_make_the_mean_over_the_detector() -> None:
    (x, y), weight = (lambda xy, w: (xy.T, w))(*detector_grid(TRUTH, 33))
    u, v = (x - 511.5) / 512.0, (y - 511.5) / 512.0
    assert weight.sum() == pytest.approx(1.0)
    assert np.sum(weight * u**2 * v**2) == pytest.approx(1.0 / 9.0, rel=1e-4)
    assert np.sum(weight * (u**2 + v**2) ** 5) == pytest.approx(
        detector_mean_of_tenth_power(), rel=1e-3
    )
    with pytest.raises(ValueError):
        detector_grid(TRUTH, 1)


def detector_mean_of_tenth_power() -> float:
    """Mean of (u^2 + v^2)^5 over the square, by the binomial theorem."""
    choose = (1, 5, 10, 10, 5, 1)
    return sum(c / ((2 * i + 1) * (2 * (5 - i) + 1)) for i, c in enumerate(choose))


@pytest.mark.parametrize(("convention", "focal_mm"), [("eq14", 70.211), ("eq6", 70.242)])
def test_focal_length_of_least_squares_tells_the_equation(convention: str, focal_mm: float) -> None:
    obs = simulate(
        sc.load_catalogue(max_mag=6.0), paper_camera(convention), n_frames=1000, seed=2017
    )
    cal = sc.calibrate(obs, paper_start(convention), method="least_squares")
    assert cal.camera.focal_mm == pytest.approx(focal_mm, abs=0.001)


def test_angles_against_brute_force() -> None:
    obs = observations(n_frames=12, seed=5)
    start = sc.calibrate(obs, paper_start(), method="least_squares").theta

    def residuals(theta: np.ndarray) -> np.ndarray:
        offset = np.column_stack([obs.xy - theta[:2], np.full(obs.n_stars, theta[2])])
        b = offset / np.linalg.norm(offset, axis=1)[:, None]
        found = []
        for k in obs.frame_ids:
            rows = obs.frame == k
            i, j = np.triu_indices(int(rows.sum()), 1)
            for vectors, sign in ((b[rows], 1.0), (obs.directions_icrs[rows], -1.0)):
                angle = np.arccos(np.clip(np.sum(vectors[i] * vectors[j], axis=1), -1.0, 1.0))
                found.append(sign * angle)
        return 1e4 * (np.concatenate(found[::2]) + np.concatenate(found[1::2]))

    tight = {"jac": "3-point", "xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    direct = least_squares(residuals, start, **tight).x
    found = fit_angles(obs, "none", start)
    np.testing.assert_allclose(found, direct, atol=0.01)
    assert np.sum(residuals(found) ** 2) <= np.sum(residuals(direct) ** 2) * (1.0 + 1e-7)
    # Another weighting is another answer where the model is wrong, and the same where it is right.
    assert abs(found[2] - start[2]) > 0.05
    clean = observations(n_frames=12, seed=5, sigma_px=0.0)
    np.testing.assert_allclose(
        fit_angles(clean, "brown", TRUTH.theta * 1.0001), TRUTH.theta, rtol=1e-6
    )


def test_readings_go_where_their_equations_lead(small) -> None:
    one = small[0].readings
    assert {key.reading for key in one.keys} == {r.key for r in READINGS} - {"diagonal"}
    f = {
        r: one.of(r, LEAST_SQUARES, "f_mm").mean()
        for r in (AS_PRINTED, OTHER_EQUATION, "angles", "weighted pairs")
    }
    assert f[AS_PRINTED] < f["angles"] < f[OTHER_EQUATION]
    assert f[AS_PRINTED] < f["weighted pairs"] < f[OTHER_EQUATION]
    assert len(one.of("angles", SAMAAN, "f_mm")) == 0


# --- judgement

NUMBER = Printed(PROPOSED, "f_mm", "70.2259", "Table 2, row 3")


def test_z_of_a_new_draw() -> None:
    rng = np.random.default_rng(0)
    for n in (5, 40):
        z = []
        for _ in range(400):
            draws = rng.normal(70.0, 0.01, n + 1)
            number = dataclasses.replace(NUMBER, text=f"{draws[0]:.6f}")
            z.append(trial(number, "r", True, draws[1:]).z)
        # Student's t with n - 1 degrees of freedom, exactly.
        assert np.std(z) == pytest.approx(np.sqrt((n - 1) / (n - 3)), rel=0.25)
    assert abs(trial(NUMBER, "r", True, [70.2259] * 5).z) < 1e-9
    assert trial(NUMBER, "r", True, [70.2259, 70.2259 + 1e-13]).spread == 0.0
    assert trial(printed(SAMAAN, "k2"), "r", True, [-1.88e-15, -1.89e-15]).spread == pytest.approx(
        1e-17 / 2**0.5
    )


def test_error_sizes_are_compared_on_a_logarithmic_scale() -> None:
    number = Printed(PROPOSED, "reprojection_px", "0.0040", "here")
    draws = 0.002 * np.exp(0.5 * norm.ppf((np.arange(99) + 0.5) / 99))
    found = trial(number, "r", True, draws)
    assert found.mean == pytest.approx(0.002)
    assert found.z == pytest.approx(np.log(2.0) / 0.5, rel=0.05)
    with pytest.raises(ValueError):
        trial(number, "r", True, [0.1, np.nan])


@pytest.mark.parametrize(
    ("spread", "digits"), [(1e-5, 0), (2e-4, 0), (3e-4, 1), (2.4e-3, 1), (2.7e-3, 2)]
)
def test_noise_digits(spread: float, digits: int) -> None:
    draws = 70.226 + spread * norm.ppf((np.arange(999) + 0.5) / 999)
    assert trial(NUMBER, "r", True, draws).noise_digits == digits


def judged(main: float, *others: tuple[float, float, bool]) -> Judged:
    """NUMBER with a main reading at a mean, and others at means with spreads; all by 40 draws."""
    unit = norm.ppf((np.arange(40) + 0.5) / 40)
    trials = [trial(NUMBER, "main", True, main + 1e-4 * unit)]
    trials += [
        trial(NUMBER, f"other {i}", ok, mean + sd * unit) for i, (mean, sd, ok) in enumerate(others)
    ]
    return Judged(NUMBER, tuple(trials))


def test_outcomes() -> None:
    at = NUMBER.value
    assert judged(at + 1e-4).outcome is Outcome.REPRODUCED
    far = at + 0.01
    assert judged(far).outcome is Outcome.NOT_REPRODUCED
    assert judged(far, (at, 1e-4, True)).outcome is Outcome.REPRODUCED
    assert judged(far, (at, 4e-4, True)).outcome is Outcome.WITHIN_NOISE
    assert judged(far, (at, 1e-4, False)).outcome is Outcome.AGAINST_TEXT
    assert judged(far, (at, 1e-4, False), (at + 1e-4, 1e-4, True)).best.reading == "other 1"
    # A reading that spreads over everything proves nothing, nor does one of very many.
    assert judged(far, (at, 0.01, True)).outcome is Outcome.BY_CHOICE
    many = [(at + 0.02 * i / 40, 1e-4, True) for i in range(41)]
    assert judged(far, *many).outcome is Outcome.BY_CHOICE
    assert judged(far, *many).by_chance == pytest.approx(1.0, abs=0.2)
    few = judged(far, (at, 1e-4, True))
    # Three standard deviations on one side of 0.01 on both, and the main reading, which accepts as
    # much of it.
    assert 0.0 < few.by_chance < MAX_CHANCE
    assert np.isnan(judged(far).by_chance)


def test_judgement_over_seeds() -> None:
    rng = np.random.default_rng(7)
    accepted = dict.fromkeys((0.0, 6.0), 0)
    for shift in accepted:
        for _ in range(300):
            draws = 70.0 + 0.01 * rng.standard_normal(31)
            number = dataclasses.replace(NUMBER, text=f"{draws[0] + 0.01 * shift:.5f}")
            accepted[shift] += trial(number, "r", True, draws[1:]).accepted
    assert accepted[0.0] >= 294
    # Negative control: six standard deviations away are not accepted.
    assert accepted[6.0] <= 6


def test_the_paper_against_itself() -> None:
    xy, weight = detector_grid(TRUTH, 65)
    ideal = undistorted(TRUTH, xy)
    rms = np.sqrt(np.sum(weight * np.sum((xy - ideal) ** 2, axis=1)))
    sigmas = {
        m: {"x0": 0.17, "y0": 0.17, "f": 0.03, "k1": 4e-11, "k2": 8e-17} for m in PAPER_METHODS
    }
    checks = {check.statement: check for check in paper_checks(TRUTH, points(20_000), sigmas)}
    row_1 = checks["Reprojection error of row 1, px"]
    # Without coefficients, eq. 16 is the distortion itself, whatever the optics.
    assert float(row_1.follows.split()[0]) == pytest.approx(rms, rel=0.05)
    assert row_1.agrees == NO
    assert checks["Error of both other methods in y₀, px"].follows.startswith("2.30 and 1.23")
    ratio = next(
        check for name, check in checks.items() if name.endswith("ratio of the largest residuals")
    )
    assert (ratio.follows, ratio.agrees) == ("54 and 8", NO)
    assert checks["Coefficients k₁, k₂ of the proposed method"].agrees == WITHIN_NOISE
    assert checks["Coefficients k₁, k₂ of Samaan’s method"].agrees == NO
    # Control: a paper without noise that printed two different coefficients would contradict
    # itself.
    exact = {m: dict.fromkeys(values, 0.0) for m, values in sigmas.items()}
    assert all(check.agrees != WITHIN_NOISE for check in paper_checks(TRUTH, points(100), exact))
    assert printed_camera(TRUTH, LEAST_SQUARES).distortion == "none"


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> tuple[Reproduction, list[tuple[int, int]]]:
    """A reproduction of few frames, interrupted and gone on with, and what its progress callback
    was told.
    """
    told: list[tuple[int, int]] = []
    folder = tmp_path_factory.mktemp("reproduction") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "N_READING_DRAWS", 2)
        few = {"n_replicates": 8, "n_frames": 30, "seed": 3, "workers": 0, "study": False}

        def stop(done: int, total: int) -> None:
            if done > 0.4 * total:
                raise KeyboardInterrupt

        with without_painting():
            with pytest.raises(KeyboardInterrupt):
                command.reproduce(folder, progress=stop, **few)
            assert [path.name for path in folder.iterdir()] == [".unfinished"]
            found = command.reproduce(folder, progress=lambda *n: told.append(n), **few)
    return found, told


def test_tables(small: tuple[Reproduction, list[tuple[int, int]]]) -> None:
    found, _ = small
    table = pd.read_csv(found.path / "table_2.csv", dtype={"printed": str})
    row = table[
        (table["method"] == found.run.label(PROPOSED)) & (table["quantity"] == "f_mm")
    ].iloc[0]
    cal = found.run.of(PROPOSED)
    assert row["printed"] == "70.2259"
    assert row["ours"] == pytest.approx(cal.camera.focal_mm)
    assert row["sigma_claimed"] == pytest.approx(cal.sigmas[2] * 0.012)
    assert row["sigma_crlb"] == pytest.approx(found.run.crlb[2] * 0.012)
    estimates = (
        found.replicates.estimates[found.replicates.labels.index(row["method"]), :, 2] * 0.012
    )
    assert row["mean"] == pytest.approx(estimates.mean())
    assert row["spread"] == pytest.approx(estimates.std(ddof=1))
    distance = (70.2259 - estimates.mean()) / np.sqrt(
        estimates.var(ddof=1) * (1 + 1 / 8) + 1e-8 / 12
    )
    assert row["z_printed"] == pytest.approx(distance)
    assert set(table["method"]) == set(found.replicates.labels)
    numbers = pd.read_csv(found.path / "published.csv", dtype={"printed": str})
    assert list(numbers["printed"]) == [n.text for n in published.PUBLISHED]
    assert set(numbers["outcome"]) <= {kind.value for kind in Outcome}
    trials = pd.read_csv(found.path / "trials.csv", dtype={"printed": str})
    assert len(trials) == numbers["n_readings"].sum()
    errors = pd.read_csv(found.path / "errors.csv").set_index("method")
    assert (errors["eq16_noisy_px"] > errors["eq16_px"]).all()
    assert errors.loc[found.run.label(LEAST_SQUARES), "map_px"] > 0.06
    assert errors.loc["efficient", "map_px"] < 0.03
    assert len(pd.read_csv(found.path / "checks.csv")) == len(found.checks)


def test_rows_as_one_draw(small: tuple[Reproduction, list[tuple[int, int]]]) -> None:
    replicates = small[0].replicates
    assert [row.method for row in row_tests(replicates)] == list(PAPER_METHODS)
    index = [method.method for method in replicates.methods].index(PROPOSED)
    row = np.array([500.03, 530.09, 70.2259 / 0.012, 2.14e-10, -3.56e-15])
    sigma = np.array([0.17, 0.16, 0.031, 4.2e-11, 8e-17])
    correlation = np.eye(5)
    for (i, j), value in {(2, 3): -0.94, (2, 4): 0.84, (3, 4): -0.967}.items():
        correlation[i, j] = correlation[j, i] = value
    half = np.linalg.cholesky(correlation)
    rng = np.random.default_rng(5)

    def p_value(offset: np.ndarray) -> float:
        """Of the printed row, if it is off by this many spreads of 60 draws."""
        estimates = replicates.estimates.repeat(10, axis=1)[:, :60]
        estimates[index] = row + (rng.standard_normal((60, 5)) @ half.T - offset) * sigma
        found = row_tests(dataclasses.replace(replicates, estimates=estimates))
        return next(test.p_value for test in found if test.method == PROPOSED)

    p = np.array([p_value(half @ rng.standard_normal(5)) for _ in range(200)])
    assert kstest(p, "uniform").pvalue > 0.01
    # Negative control: each number within 0.8 spreads, together against all correlations.
    assert p_value(np.array([0.1, 0.6, -0.8, 0.3, -0.7])) < 0.02


def test_slow_methods_take_part_in_fewer_replicates(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("starcal_uq.paper.replicates._LEAST", 3)
    options = {"n_frames": 20, "seed": 6, "workers": 0}
    chosen = [m for m in METHODS if m.method in ("least_squares", "samaan")]
    both = replicate(n_replicates=6, methods=chosen, share_slow=True, **options)
    assert both.methods == tuple(chosen)
    slow = [i for i, method in enumerate(chosen) if is_slow(method)]
    assert len(slow) == 1
    found = np.isfinite(both.estimates[:, :, 0]).sum(axis=1)
    assert found[slow[0]] == 3
    assert (np.delete(found, slow[0]) == 6).all()
    whole = replicate(methods=chosen, n_replicates=3, **options)
    np.testing.assert_array_equal(both.estimates[:, :3], whole.estimates)
    np.testing.assert_array_equal(both.reprojection_px[:, :3], whole.reprojection_px)
    assert both.n_failed(chosen[slow[0]].label) == 0


def test_report_is_self_contained(small: tuple[Reproduction, list[tuple[int, int]]]) -> None:
    found, _ = small
    page = found.report.read_text(encoding="utf-8")
    assert not re.search(r'(?:src|href)\s*=\s*"(?!data:|#)', page)
    assert "<script" not in page
    assert "@import" not in page
    assert page.count("data:image/png;base64,") == 4
    text = re.sub(r"<[^>]*>", "", page)
    for number in published.PUBLISHED:
        assert number.text.partition("e")[0].replace("-", "−") in text
    assert found.run.observations.data_hash in page
    assert "70.2122" in text
    assert "Distortion by eq. 14" in text and found.text.split(".")[0] in text
    assert "This reproduction has 30 frames where the paper has" in text
    assert sorted(p.name for p in (found.path / "figures").iterdir()) == [
        "error_fields.png",
        "printed_numbers.png",
        "replicates.png",
        "trajectories.png",
    ]
    assert "Reproduction(24 printed numbers" in repr(found)
    assert "24 printed numbers" in found._repr_html_()


def test_progress_rises_to_the_end(small: tuple[Reproduction, list[tuple[int, int]]]) -> None:
    _, told = small
    done, totals = np.array(told).T
    assert len(set(totals)) == 1
    assert (np.diff(done) >= 0).all()
    assert done[-1] == totals[-1]
    # What was done before the interrupt is not done again.
    assert np.diff(done).max() > 0.3 * totals[0]


def test_refusals(small: tuple[Reproduction, list[tuple[int, int]]], tmp_path: Path) -> None:
    found, _ = small
    with pytest.raises(sc.errors.RunFolderError):
        command.reproduce(found.path)
    file = tmp_path / "file"
    file.write_text("x")
    with pytest.raises(sc.errors.RunFolderError):
        command.reproduce(file, force=True)
    with pytest.raises(sc.errors.CalibrationError, match="at least 8"):
        command.reproduce(tmp_path / "new", n_replicates=3)
    with pytest.raises(sc.errors.CalibrationError, match="at least 20"):
        command.reproduce(tmp_path / "new", n_frames=3)
    with pytest.raises(sc.errors.CameraError):
        command.reproduce(tmp_path / "new", convention="eq7")
    assert not (tmp_path / "new").exists()


def test_interrupt_leaves_nothing_behind(tmp_path: Path) -> None:
    def stop(done: int, total: int) -> None:
        if done > 0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        command.reproduce(tmp_path / "out", n_replicates=8, n_frames=20, workers=0, progress=stop)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_what_comes_out_and_what_does_not(tmp_path: Path) -> None:
    found = command.reproduce(tmp_path / "out", n_replicates=8, study=False)
    outcomes = {
        (one.printed.method, one.printed.quantity, one.printed.place): one.outcome
        for one in found.judged
    }
    # The paper's own method is reproduced, to digits that are noise.
    own = [outcome for (method, _, _), outcome in outcomes.items() if method == PROPOSED]
    assert set(own) <= {Outcome.REPRODUCED, Outcome.WITHIN_NOISE}
    assert outcomes[LEAST_SQUARES, "reprojection_px", "Table 2, row 1"] is Outcome.NOT_REPRODUCED
    assert outcomes[LEAST_SQUARES, "f_mm", "Table 2, row 1"] is Outcome.AGAINST_TEXT
    for quantity in ("f_mm", "k1", "k2"):
        assert outcomes[SAMAAN, quantity, "Table 2, row 2"] is Outcome.NOT_REPRODUCED
    assert found.readings.of(OTHER_EQUATION, LEAST_SQUARES, "f_mm").mean() == pytest.approx(
        70.242, abs=0.001
    )
