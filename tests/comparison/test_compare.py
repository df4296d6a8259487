"""Comparison of cameras: p-values that are uniform when nothing differs, and that see what does."""

import dataclasses
import json
import re
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import kstest

import starcal_uq as sc
from starcal_uq.attitude.rotations import exp_rotation
from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.camera.projection import unproject
from starcal_uq.comparison.compare import compare, compare_halves
from starcal_uq.comparison.covariance import difference_rule
from starcal_uq.comparison.result import CameraComparison
from starcal_uq.core.errors import (
    CalibrationError,
    ComparisonError,
    DistortionError,
    RunFolderError,
)
from starcal_uq.core.provenance import Provenance
from starcal_uq.core.status import Status
from starcal_uq.estimation.result import Calibration
from starcal_uq.inference.priors import GaussianPriors
from starcal_uq.observations.splits import shared_frames, split_frames
from starcal_uq.presentation.pages.comparison import write_comparison
from starcal_uq.runs.compare import compare_runs, compare_split
from starcal_uq.runs.folder import RunFolder
from tests.helpers.gaussian_camera import COVARIANCE
from tests.helpers.same import assert_same
from tests.helpers.scenes import camera, nominal, observations

ARCSEC = 648_000.0 / np.pi
SD = np.sqrt(np.diag(COVARIANCE))
ROOT = SD[:, None] * np.linalg.cholesky(COVARIANCE / np.outer(SD, SD))
# Enough for a p-value; the grid decides nothing but the weights.
SMALL: dict[str, Any] = {"n": 9, "n_draws": 400}


def result(theta: np.ndarray, covariance: np.ndarray = COVARIANCE, **changes: Any) -> Any:
    """What `compare` needs of a calibration, for the paper's camera."""
    values: dict[str, Any] = {
        "camera": camera("brown"),
        "theta": theta,
        "covariance": covariance,
        "sigma": 0.05,
        "dof": np.inf,
        "method": "efficient",
        "status": Status.CONVERGED,
        "provenance": Provenance(data_sha256="a" * 64, settings={"method": "efficient"}),
    }
    return SimpleNamespace(**{**values, **changes})


def other(**changes: Any) -> Provenance:
    """Provenance of other data."""
    return Provenance(data_sha256="b" * 64, settings={"method": "efficient"}, **changes)


def null_pairs(n: int, seed: int = 0, size_b: float = 1.0) -> list[tuple[Any, Any]]:
    """Independent estimates of one camera; the second `size_b` times as uncertain."""
    rng = np.random.default_rng(seed)
    truth = camera("brown").theta
    return [
        (
            result(truth + ROOT @ rng.standard_normal(5)),
            result(
                truth + size_b * (ROOT @ rng.standard_normal(5)),
                size_b**2 * COVARIANCE,
                provenance=other(),
            ),
        )
        for _ in range(n)
    ]


@lru_cache
def null_comparisons(n: int = 200) -> tuple[CameraComparison, ...]:
    return tuple(compare(a, b, **SMALL) for a, b in null_pairs(n, size_b=1.7))


@lru_cache
def halves() -> CameraComparison:
    return compare_halves(observations(), nominal(camera()))


def test_p_values_are_uniform_when_nothing_differs_and_both_covariances_count() -> None:
    # Negative control: the second camera taken for the truth.
    certain = [
        compare(a, SimpleNamespace(**{**vars(b), "covariance": 1e-6 * COVARIANCE}), **SMALL)
        for a, b in null_pairs(60, seed=1)
    ]
    for name in ("p_map", "p_parameters", "p_worst"):
        p, wrong = (
            np.array([getattr(one, name) for one in found])
            for found in (null_comparisons(), certain)
        )
        assert kstest(p, "uniform").pvalue > 0.01
        # Mean square and largest ratio of the same difference agree in which pairs are far apart.
        assert np.corrcoef(p, [one.p_parameters for one in null_comparisons()])[0, 1] > 0.5
        assert kstest(wrong, "uniform").pvalue < 1e-4
        assert (wrong < 0.05).mean() > 0.15


def test_verdict_keeps_its_level() -> None:
    wrong = sum(found.verdict != "agree" for found in null_comparisons())
    # 1 % of 200: more than 7 come up once in 1000 tries.
    assert wrong <= 7
    loose = [dataclasses.replace(found, level=0.2) for found in null_comparisons()]
    assert 0.06 < np.mean([found.verdict != "agree" for found in loose]) < 0.25


def test_a_focal_length_that_changed_is_seen() -> None:
    """3 sigma of f alone is far outside what f and k1, k2 trade."""
    shift = np.zeros(5)
    shift[2] = 3.0 * np.sqrt(2.0) * SD[2]
    found = [
        compare(a, SimpleNamespace(**{**vars(b), "theta": b.theta + shift}), **SMALL)
        for a, b in null_pairs(30, seed=2)
    ]
    assert np.mean([f.verdict == "maps differ" for f in found]) > 0.95
    # The same change along the weakest direction is what noise does all the time, and has less
    # power.
    weak = 3.0 * np.sqrt(2.0) * ROOT[:, 2]
    weak_found = [
        compare(a, SimpleNamespace(**{**vars(b), "theta": b.theta + weak}), **SMALL)
        for a, b in null_pairs(30, seed=2)
    ]
    assert np.mean([f.verdict != "agree" for f in weak_found]) < np.mean(
        [f.verdict != "agree" for f in found]
    )


def test_an_estimated_noise_counts() -> None:
    """With few degrees of freedom the same difference proves less."""
    a, b = null_pairs(1, seed=5)[0]
    b.theta = b.theta + 7.0 * ROOT[:, 2]
    known = compare(a, b, **SMALL)
    few = compare(*(SimpleNamespace(**{**vars(r), "dof": 30}) for r in (a, b)), **SMALL)
    assert few.p_map > 1.5 * known.p_map
    assert few.p_parameters > 1.5 * known.p_parameters
    assert few.rms_arcsec == known.rms_arcsec


def test_rotation_and_map_are_what_was_put_in() -> None:
    """A principal point moved by 2 px is a rotation of 2 px / f about Y and nearly nothing else."""
    truth = camera("brown").theta
    found = compare(result(truth), result(truth + np.array([2.0, 0, 0, 0, 0]), provenance=other()))
    arcsec = 2.0 / truth[2] * ARCSEC
    assert abs(found.rotation_arcsec[1]) == pytest.approx(arcsec, rel=0.01)
    assert found.largest_arcsec < 0.02 * arcsec
    # The rotation brings the directions of B onto those of A.
    xy = np.array([[100.0, 200.0], [900.0, 700.0]])
    a, b = (
        unproject(camera("brown").with_theta(theta), xy) for theta in (found.theta_a, found.theta_b)
    )
    rotation = exp_rotation(found.rotation_arcsec / ARCSEC)
    np.testing.assert_allclose(a @ rotation.T, b, atol=3e-6)
    assert np.abs(a - b).max() > 1e-4


def test_map_of_a_focal_length_is_radial() -> None:
    truth = camera("brown").theta
    found = compare(
        result(truth), result(truth * np.array([1, 1, 1 + 1e-4, 1, 1]), provenance=other())
    )
    # A longer focal length sees a pixel closer to the axis: inwards, in proportion to the radius.
    # From edge to edge, as the best rotation shifts all points alike.
    across = found.difference_px[12, -1, 0] - found.difference_px[12, 0, 0]
    assert across == pytest.approx(-1e-4 * 1024, rel=0.01)
    down = found.difference_arcsec[-1, 12, 1] - found.difference_arcsec[0, 12, 1]
    assert down == pytest.approx(-1e-4 * 1024 / truth[2] * ARCSEC, rel=0.02)
    length = np.linalg.norm(found.difference_arcsec, axis=-1)
    assert found.largest_arcsec == length.max()
    assert found.rms_arcsec < found.largest_arcsec


def test_uncertainties_are_those_of_draws() -> None:
    """Joint sigma of map and rotation, against the scatter of compared draws."""
    many = null_comparisons()
    lengths = np.array([np.sum(f.difference_arcsec**2, axis=-1) for f in many])
    np.testing.assert_allclose(np.sqrt(lengths.mean(axis=0)), many[0].sigma_arcsec, rtol=0.2)
    assert np.sqrt(lengths.mean(axis=0)).mean() == pytest.approx(
        many[0].sigma_arcsec.mean(), rel=0.07
    )
    rotations = np.array([f.rotation_arcsec for f in many])
    np.testing.assert_allclose(rotations.std(axis=0), many[0].rotation_sigma_arcsec, rtol=0.17)
    assert np.sqrt(np.mean([f.rms_arcsec**2 for f in many])) == pytest.approx(
        many[0].expected_rms_arcsec, rel=0.08
    )


def test_order_changes_signs_only() -> None:
    a, b = null_pairs(1, seed=4)[0]
    one, two = compare(a, b, **SMALL), compare(b, a, **SMALL)
    np.testing.assert_allclose(one.rotation_arcsec, -two.rotation_arcsec, atol=1e-4)
    assert one.rms_arcsec == pytest.approx(two.rms_arcsec, rel=1e-3)
    assert one.p_map == pytest.approx(two.p_map, rel=1e-3)
    assert one.p_parameters == pytest.approx(two.p_parameters, rel=1e-9)


@lru_cache
def calibrated(model: str = "brown", method: str = "efficient", part: str = "all") -> Calibration:
    obs = {
        "all": observations(),
        "odd": split_frames(observations())[0],
        "even": split_frames(observations())[1],
    }[part]
    return calibrate(
        obs,
        nominal(camera()).replace(
            distortion=model, coefficients=(0.0,) * len(camera(model).coefficients)
        ),
        method=method,
    )


@pytest.mark.parametrize(
    ("a", "b", "data", "signs", "words"),
    [
        (("brown", "efficient", "odd"), ("brown", "efficient", "even"), "independent", (1.0, 1.0), "add"),
        (("brown", "three_stage", "all"), ("brown", "efficient", "all"), "same", (1.0, -1.0), "Hausman"),
        (("brown", "efficient", "all"), ("brown", "three_stage", "all"), "same", (-1.0, 1.0), "Hausman"),
        (("brown", "efficient", "all"), ("brown3", "efficient", "all"), "same", (-1.0, 1.0), "simpler model"),
        (("brown", "efficient", "odd"), ("brown", "efficient", "all"), "A within B", (1.0, -1.0), "All data of A"),
        (("brown", "efficient", "all"), ("brown", "efficient", "even"), "B within A", (-1.0, 1.0), "All data of B"),
        (("brown", "efficient", "all"), ("brown", "efficient", "all"), "same", None, "both are the efficient"),
        (("brown", "efficient", "all"), ("inverse", "efficient", "all"), "same", None, "neither distortion model"),
        (("brown", "efficient", "odd"), ("brown3", "efficient", "all"), "A within B", None, "richer model or"),
        (("brown", "three_stage", "all"), ("brown", "three_stage", "odd"), "B within A", None, "neither estimate"),
    ],
)  # fmt: skip
def test_rule_follows_from_what_the_data_share(a, b, data, signs, words):
    tables = {
        "all": observations(),
        "odd": split_frames(observations())[0],
        "even": split_frames(observations())[1],
    }
    pair = tables[a[2]], tables[b[2]]
    rule = difference_rule(calibrated(*a), calibrated(*b), ("A", "B"), None, pair)
    assert (rule.data, rule.signs) == (data, signs)
    assert words in rule.words
    found = compare(calibrated(*a), calibrated(*b), observations=pair, **SMALL)
    assert found.tested == (signs is not None)
    assert found.verdict == ("not tested" if signs is None else "agree")
    assert np.isfinite(found.rms_arcsec)
    if signs is None:
        assert found.agree is None
        assert "not tested" in found.text
        assert np.isnan(found.rotation_sigma_arcsec).all()


def test_partly_shared_data_have_no_p_value() -> None:
    obs = observations()
    first, second = obs.select_frames(obs.frame_ids[:40]), obs.select_frames(obs.frame_ids[20:])
    assert shared_frames(first, second) == 20
    a, b = result(camera("brown").theta), result(camera("brown").theta, provenance=other())
    assert difference_rule(a, b, ("A", "B"), None, (first, second)).data == "overlapping"
    # What the user says overrules what the tables say.
    assert difference_rule(a, b, ("A", "B"), False, (first, second)).data == "independent"
    assert difference_rule(a, b, ("A", "B"), True, None).data == "same"
    # Merged runs that have one run in common; a prior made from the other run's data.
    merged = {"merge": {"parts": [{"data_sha256": ["a" * 64]}, {"data_sha256": ["c" * 64]}]}}
    assert (
        difference_rule(a, result(b.theta, provenance=merged), ("A", "B"), None, None).data
        == "overlapping"
    )
    prior = GaussianPriors.__new__(GaussianPriors)
    object.__setattr__(prior, "source", {"data_sha256": ["a" * 64]})
    chained = result(b.theta, provenance=other(), priors=prior)
    assert difference_rule(a, chained, ("A", "B"), None, None).data == "overlapping"


def test_an_inefficient_estimate_is_tested_on_the_map_alone() -> None:
    found = compare(calibrated("brown", "three_stage"), calibrated(), **SMALL)
    assert np.isfinite(found.p_map)
    assert np.isnan(found.p_parameters)
    assert np.isnan(found.p_worst)
    assert any("only the map is tested" in message for message in found.messages)
    # The difference of two estimates from the same data is smaller than their independent errors
    # would make it.
    apart = compare(calibrated("brown", "three_stage"), calibrated(), same_data=False, **SMALL)
    assert found.expected_rms_arcsec < 0.7 * apart.expected_rms_arcsec


def test_other_models_are_compared_by_their_directions() -> None:
    found = compare(calibrated("inverse", part="odd"), calibrated(part="even"), **SMALL)
    assert found.models == ("inverse", "brown")
    assert found.parameter_names == ("x0", "y0", "f")
    assert any("distortion models differ" in message for message in found.messages)
    assert found.verdict == "agree"
    # A pinhole cannot follow the distortion; that is not in its covariance and must not pass for
    # chance.
    pinhole = compare(calibrated("none", part="odd"), calibrated(part="even"), **SMALL)
    assert pinhole.verdict == "maps differ"
    assert pinhole.p_map < 1e-6
    # A pixel of distortion given to ideal points, and taken from distorted ones: where both are
    # known very well, they cannot agree, whatever their parameters.
    sharp = 1e-8 * COVARIANCE
    apart = compare(
        result(camera("inverse").theta, sharp, camera=camera("inverse")),
        result(camera("brown").theta, sharp, provenance=other()),
    )
    assert any("cannot come from errors of the parameters" in message for message in apart.messages)
    assert apart.outside_arcsec > apart.expected_rms_arcsec
    assert apart.p_map < 1e-12
    assert "p < 10⁻¹²" in apart.text


def test_splits_share_nothing_and_lose_nothing() -> None:
    obs = observations()
    for how in ("odd-even", "halves", "random"):
        a, b = split_frames(obs, how)
        assert a.n_frames == b.n_frames == 30
        assert sorted([*a.frame_ids, *b.frame_ids]) == list(obs.frame_ids)
        assert shared_frames(a, b) == 0
    assert list(split_frames(obs)[0].frame_ids) == list(obs.frame_ids[::2])
    assert (
        split_frames(obs, "halves")[0].frame_ids.max()
        < split_frames(obs, "halves")[1].frame_ids.min()
    )
    three = split_frames(obs.select_frames(obs.frame_ids[:3]), "random", seed=1)
    assert (three[0].n_frames, three[1].n_frames) == (2, 1)
    # Frames are known by what they hold, not by their numbers.
    renumbered = dataclasses.replace(obs, frame=obs.frame + 1000)
    assert shared_frames(obs, renumbered) == 60
    with pytest.raises(ComparisonError, match="split 'thirds' is unknown: use one of odd-even,"):
        split_frames(obs, "thirds")
    with pytest.raises(ComparisonError):
        split_frames(obs.select_frames(obs.frame_ids[:1]))


def test_halves_of_one_run_agree() -> None:
    found = halves()
    assert found.labels == ("odd frames", "even frames")
    assert found.data == "independent"
    assert found.verdict == "agree"
    assert found.agree is True
    assert found.n_directions == 5
    assert "Odd frames and even frames agree" in found.text
    with pytest.raises(CalibrationError, match="stars"):
        obs = observations()
        compare_halves(
            obs.select(obs.frame < obs.frame_ids[2]).select(few_stars()), nominal(camera())
        )


def few_stars() -> np.ndarray:
    """Three stars in each of the first two frames: too few for five parameters."""
    obs = observations()
    start = obs.frame_starts
    mask = np.zeros(start[2], dtype=bool)
    for k in range(2):
        mask[start[k] : start[k] + 3] = True
    return mask


def test_page_tables_and_file(tmp_path: Path) -> None:
    found = halves()
    page = write_comparison(found, tmp_path / "out")
    assert sc.report(found, tmp_path / "again").read_bytes() == page.read_bytes()
    with pytest.raises(TypeError, match="say where"):
        sc.report(found)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "comparison.html",
        "comparison.json",
        "difference.csv",
        "difference_map.csv",
        "difference_map.svg",
        "run.json",
    ]
    text = page.read_text(encoding="utf-8")
    assert "http" not in re.sub(r"data:image/svg\+xml,[^\"]*", "", text)
    assert "<script" not in text
    assert "Odd frames and even frames agree" in text
    assert "Monte Carlo" in text
    loaded = CameraComparison.load(tmp_path / "out")
    assert json.dumps(loaded.to_dict()) == json.dumps(found.to_dict())
    assert_same(found, loaded)
    table = found.to_dataframe()
    assert list(table["quantity"][:4]) == [
        "rotation, pitch",
        "rotation, yaw",
        "rotation, roll",
        "map, rms",
    ]
    row = table[table["quantity"] == "map, rms"].iloc[0]
    assert row["p_value"] == found.p_map
    assert row["ratio"] == found.rms_arcsec / found.expected_rms_arcsec
    assert len(found.field_dataframe()) == 625
    assert "map, rms" in found._repr_html_()


def test_an_untested_comparison_is_saved_too(tmp_path: Path) -> None:
    found = compare(calibrated(), calibrated(), labels=("<a>", "b & c"))
    text = write_comparison(found, tmp_path).read_text(encoding="utf-8")
    assert "was not tested" in text
    assert "&lt;a&gt;" in text
    assert "Is it chance?" not in text
    assert not CameraComparison.load(tmp_path / "comparison.json").tested


def write_run(path: Path, part: str) -> RunFolder:
    run = RunFolder(path).create()
    calibrated(part=part).save(run.calibration)
    table = (
        observations() if part == "all" else split_frames(observations())[0 if part == "odd" else 1]
    )
    table.save(run.observations, force=True)
    return run


def test_run_folders(tmp_path: Path) -> None:
    for part in ("odd", "even", "all"):
        write_run(tmp_path / part, part)
    found = compare_runs(tmp_path / "odd", tmp_path / "even", **SMALL)
    assert (found.labels, found.data, found.verdict) == (("odd", "even"), "independent", "agree")
    assert (
        compare_runs(tmp_path / "odd", tmp_path / "all", labels=("x", "y"), **SMALL).data
        == "A within B"
    )
    split = compare_split(tmp_path / "all", **SMALL)
    np.testing.assert_allclose(split.theta_a, found.theta_a, rtol=1e-9)
    with pytest.raises(ComparisonError, match="both runs are the same folder"):
        compare_runs(tmp_path / "odd", tmp_path / "odd")
    with pytest.raises(RunFolderError):
        compare_runs(tmp_path / "odd", tmp_path / "none")
    (tmp_path / "all" / "observations.parquet").unlink()
    with pytest.raises(RunFolderError, match="holds no observations to split"):
        compare_split(tmp_path / "all")


def test_what_cannot_be_compared_is_refused() -> None:
    truth = camera("brown").theta
    a = result(truth)
    wide, ended = camera("brown", width_px=1500), result(truth, status=Status.MAX_ITERATIONS)
    for b, options, words in (
        (result(truth, camera=wide), {}, "A has 1024 x 1024 pixels and B 1500 x 1024"),
        (ended, {"labels": ("cold", "warm")}, "warm: the calibration did not converge"),
        (a, {"level": 2.0}, "level 2 is not a probability"),
    ):
        with pytest.raises(ComparisonError, match=words):
            compare(a, b, **options)
    with pytest.raises(DistortionError):
        compare(a, result(truth * np.array([1, 1, 1, -1e4, 1])))
    pitch = compare(
        a, result(truth, camera=camera("brown", pixel_um=10.0), provenance=other()), **SMALL
    )
    assert any("pixel pitch differs (12 and 10 µm)" in message for message in pitch.messages)


def test_a_narrow_prior_and_poor_draws_are_said() -> None:
    names = camera("brown").parameter_names
    priors = SimpleNamespace(sd=lambda wanted: np.array([100, 100, 2.0, 100, 100]) * SD)
    bad = SimpleNamespace(ok=False, likelihood="marginal")
    a = result(camera("brown").theta, priors=priors, camera_names=names, diagnostics=bad)
    found = compare(a, result(camera("brown").theta, provenance=other()), **SMALL)
    assert any("prior has a say in f (only 2.0 times" in message for message in found.messages)
    assert any("miss a criterion of convergence" in message for message in found.messages)


def test_posteriors_are_compared_by_their_means() -> None:
    """Mean and covariance of the draws count, and the noise that they hold."""
    a, b = null_pairs(1, seed=8)[0]
    wide = SimpleNamespace(
        camera=a.camera,
        mean=a.theta,
        covariance=a.covariance,
        sigma_draws=np.full(10, 0.05),
        diagnostics=SimpleNamespace(ok=True, likelihood="marginal"),
        provenance=a.provenance,
    )
    by_mean, by_estimate = compare(wide, b, **SMALL), compare(a, b, **SMALL)
    assert by_mean.p_map == by_estimate.p_map
    assert by_mean.rms_arcsec == by_estimate.rms_arcsec
    # A posterior by another likelihood is not efficient, so that on the same data nothing tells the
    # covariance.
    wide.diagnostics.likelihood = "pairs"
    assert difference_rule(wide, a, ("A", "B"), None, None).signs == (1.0, -1.0)
    a.provenance["settings"]["likelihood"] = "student_t"
    assert difference_rule(wide, a, ("A", "B"), None, None).signs is None


@pytest.mark.slow
def test_tables_of_false_alarms_and_power(capsys: pytest.CaptureFixture[str]) -> None:
    from verification.comparison_power import main

    main(["--replicates", "2", "--power", "1", "--frames", "25"])
    lines = capsys.readouterr().out.splitlines()
    rows = [line for line in lines if line.startswith("| ") and "Replicates" not in line]
    assert len(rows) == 12
    assert {line.count("|") for line in rows[:6]} == {7}
    # The largest of the changes is seen.
    assert rows[-1].endswith("| 1.00 | 1.00 | 1.00 |")


@pytest.mark.slow
def test_p_values_of_whole_campaigns_are_uniform() -> None:
    """Sixty pairs of simulated and calibrated campaigns; and a richer model on the same data."""
    from starcal_uq.simulation.frames import simulate
    from starcal_uq.sky.catalogue import load_catalogue

    stars, truth = load_catalogue(max_mag=6.0, epoch=2026.9), camera("brown")
    start, richer = (
        nominal(truth),
        nominal(truth).replace(distortion="brown3", coefficients=(0.0, 0.0, 0.0)),
    )
    p = []
    for seed in range(0, 120, 2):
        first, second = (
            simulate(stars, truth, n_frames=25, min_stars=8, sigma_px=0.05, seed=7000 + seed + i)
            for i in range(2)
        )
        a, b, c = calibrate(first, start), calibrate(second, start), calibrate(first, richer)
        apart, nested, mixed = (
            compare(a, b, **SMALL),
            compare(a, c, **SMALL),
            compare(b, c, **SMALL),
        )
        naive = compare(a, c, same_data=False, **SMALL)
        p.append(
            [f.p_parameters for f in (apart, nested, mixed, naive)]
            + [f.p_map for f in (apart, nested, mixed)]
        )
    values = np.array(p)
    for column in (0, 1, 2, 4, 5, 6):
        assert kstest(values[:, column], "uniform").pvalue > 1e-3, column
    # Control: covariances of estimates from the same data do not add.
    assert kstest(values[:, 3], "uniform").pvalue < 1e-6
