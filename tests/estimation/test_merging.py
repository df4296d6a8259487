"""Merged runs are what a calibration on all stars gives."""

import dataclasses
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from scipy.special import fdtrc
from scipy.stats import kstest

from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import CalibrationError, RunFolderError
from starcal_uq.core.provenance import data_hashes
from starcal_uq.estimation.merging import consistency_of, merge, welch_james
from starcal_uq.estimation.result import Calibration
from starcal_uq.inference.sample import sample
from starcal_uq.inference.update import shift_test
from starcal_uq.likelihood.compressed import Optimum, optimum, total
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.observations.table import Observations, load_observations
from starcal_uq.runs.merge import join_observations, merge_runs
from starcal_uq.simulation.frames import simulate
from starcal_uq.sky.catalogue import load_catalogue
from tests.helpers import scenes
from tests.helpers.outside import campaign

NOMINAL = scenes.nominal(scenes.camera())


@lru_cache(maxsize=64)
def simulated(
    seed: int, n_frames: int = 12, shift_f_px: float = 0.0, sigma_px: float = 0.05
) -> Observations:
    camera = scenes.camera()
    theta = camera.theta.copy()
    theta[2] += shift_f_px
    stars = load_catalogue(max_mag=6.0, epoch=2026.9)
    return simulate(
        stars,
        camera.with_theta(theta),
        n_frames=n_frames,
        min_stars=8,
        sigma_px=sigma_px,
        seed=seed,
    )


@lru_cache(maxsize=128)
def calibrated(
    seed: int, n_frames: int = 12, shift_f_px: float = 0.0, sigma_px: float = 0.05
) -> Calibration:
    return calibrate(simulated(seed, n_frames, shift_f_px, sigma_px), NOMINAL)


def halves(obs: Observations, at: int) -> tuple[Observations, Observations]:
    return obs.select_frames(obs.frame_ids[:at]), obs.select_frames(obs.frame_ids[at:])


def points(cal: Calibration, n: int = 50) -> np.ndarray:
    u = np.random.default_rng(5).standard_normal((n, len(cal.theta)))
    return cal.theta + u @ cal.compressed.whitening.T


def write(folder: Path, obs: Observations, cal: Calibration) -> Path:
    folder.mkdir()
    obs.save(folder / "observations.parquet")
    cal.nominal.save(folder / "camera.toml")
    cal.save(folder / "calibration.json")
    return folder


@pytest.mark.parametrize("stated", [False, True])
def test_two_halves_give_the_whole(stated: bool) -> None:
    obs = scenes.observations(n_frames=200)
    obs = scenes.with_sigmas(obs) if stated else obs
    whole = calibrate(obs, NOMINAL)
    parts = halves(obs, 70)
    runs = [calibrate(part, NOMINAL) for part in parts]
    merged = merge(runs, join_observations(parts, ["a", "b"]))
    assert np.all(np.abs(merged.theta - whole.theta) < 1e-3 * whole.sigmas)
    scale = np.outer(whole.sigmas, whole.sigmas)
    assert np.max(np.abs(merged.covariance - whole.covariance) / scale) < 1e-3
    assert merged.sigma == pytest.approx(whole.sigma, rel=1e-6)
    assert merged.sigma_std == pytest.approx(whole.sigma_std, rel=1e-6)
    assert merged.chi2 == pytest.approx(whole.chi2, rel=1e-6)
    assert (merged.dof, merged.n_stars, merged.n_frames) == (
        whole.dof,
        whole.n_stars,
        whole.n_frames,
    )
    assert merged.sigma_name == whole.sigma_name
    assert np.allclose(
        merged.information * scale, whole.information * scale, atol=2e-3 * whole.n_frames
    )
    assert np.allclose(
        merged.rotation_per_theta * whole.sigmas, whole.rotation_per_theta * whole.sigmas, atol=1e-8
    )
    assert np.allclose(
        merged.attitude_noise,
        whole.attitude_noise,
        rtol=1e-3,
        atol=1e-3 * whole.attitude_noise.max(),
    )
    assert np.max(np.abs(merged.residuals_px - whole.residuals_px)) < 1e-5
    assert np.max(np.abs(merged.quaternions - whole.quaternions)) < 1e-7
    z = (merged.pair_theta - whole.pair_theta) / np.sqrt(np.diag(whole.pair_covariance))
    assert np.max(np.abs(z)) < 1.0
    # A half alone is not the whole.
    assert np.max(np.abs(runs[0].theta - whole.theta) / whole.sigmas) > 0.1


def test_merged_log_likelihood_is_the_sum_of_the_runs_and_near_the_exact_one() -> None:
    obs = scenes.observations(n_frames=120)
    runs = [calibrate(part, NOMINAL) for part in halves(obs, 40)]
    merged = merge(runs)
    theta = points(merged)
    value = merged.compressed.log_likelihood(theta, merged.sigma)
    parts = sum(run.compressed.log_likelihood(theta, merged.sigma) for run in runs)
    assert np.max(np.abs(value - parts)) < 1e-6
    exact = MarginalLikelihood(obs, "brown")
    difference = value - [exact.log_likelihood(t, merged.sigma) for t in theta]
    assert np.max(np.abs(difference)) < 0.01


def test_own_noise_is_that_of_stars_which_state_it() -> None:
    runs = [calibrated(1), calibrated(2, sigma_px=0.2)]
    common = merge(runs, noise="common")
    assert consistency_of(common).noise_p_value < 1e-6
    assert any("differ in noise" in message for message in consistency_of(common).messages)
    obs = join_observations(
        [simulated(1), simulated(2, sigma_px=0.2)], ["a", "b"], [run.sigma for run in runs]
    )
    whole = calibrate(obs, NOMINAL)
    merged = merge(runs, obs, noise="own")
    assert merged.sigma_name == "sigma_scale"
    assert merged.sigma == pytest.approx(whole.sigma, rel=1e-4)
    assert np.all(np.abs(merged.theta - whole.theta) < 1e-2 * whole.sigmas)
    assert np.allclose(merged.covariance, whole.covariance, rtol=0.02)
    assert np.max(np.abs(merged.residuals_px - whole.residuals_px)) < 1e-3
    theta = points(merged)
    exact = MarginalLikelihood(obs, "brown")
    difference = merged.compressed.log_likelihood(theta, 1.1) - [
        exact.log_likelihood(t, 1.1) for t in theta
    ]
    assert np.max(np.abs(difference)) < 0.02
    assert np.array_equal(merged.theta, merge(runs, obs).theta)
    # One noise for all is the worse estimate when they differ by a factor of four.
    assert np.all(merged.sigmas < common.sigmas)


def test_run_folders_are_merged_with_their_observations(tmp_path: Path) -> None:
    paths = [write(tmp_path / f"night{i}", simulated(i), calibrated(i)) for i in (1, 2, 3)]
    merged = merge_runs(paths, tmp_path / "all")
    obs = load_observations(tmp_path / "all" / "observations.parquet")
    loaded = Calibration.load(tmp_path / "all" / "calibration.json")
    assert obs.data_hash == loaded.provenance["data_sha256"] == merged.provenance["data_sha256"]
    assert np.array_equal(obs.frame_ids, loaded.frame_ids)
    assert np.array_equal(obs.frame_ids, np.arange(36))
    assert obs.meta["truth"] == scenes.camera().to_dict()
    assert [part["frame_shift"] for part in obs.meta["merged"]] == [0, 12, 24]
    assert Camera.load(tmp_path / "all" / "camera.toml") == NOMINAL
    whole = calibrate(obs, NOMINAL)
    assert np.all(np.abs(merged.theta - whole.theta) < 1e-2 * whole.sigmas)
    post = sample(obs, loaded, seed=1)
    assert post.diagnostics.ok, post.diagnostics.checks
    assert post.diagnostics.likelihood_used == "compressed"
    assert post.diagnostics.compressed_max_difference < 0.05
    # Merging twice is merging once.
    pair = merge_runs(paths[:2], tmp_path / "pair")
    again = merge_runs([tmp_path / "pair", paths[2]], tmp_path / "again")
    assert np.all(np.abs(again.theta - merged.theta) < 1e-4 * merged.sigmas)
    assert data_hashes(pair.provenance) < data_hashes(again.provenance)


def test_without_observations_the_runs_own_frames_stay(tmp_path: Path) -> None:
    paths = [write(tmp_path / f"night{i}", simulated(i), calibrated(i)) for i in (1, 2)]
    (paths[1] / "observations.parquet").unlink()
    merged = merge_runs(paths, tmp_path / "all")
    assert not (tmp_path / "all" / "observations.parquet").exists()
    assert not merged.provenance["merge"]["has_observations"]
    assert len(merged.residuals_px) == calibrated(1).n_stars + calibrated(2).n_stars


def test_output_folder_is_protected(tmp_path: Path) -> None:
    paths = [write(tmp_path / f"night{i}", simulated(i), calibrated(i)) for i in (1, 2)]
    with pytest.raises(RunFolderError, match="is one of the runs"):
        merge_runs(paths, paths[0], force=True)
    out = tmp_path / "all"
    out.mkdir()
    (out / "posterior.nc").write_text("stale", encoding="utf-8")
    with pytest.raises(RunFolderError):
        merge_runs(paths, out)
    merge_runs(paths, out, force=True)
    assert not (out / "posterior.nc").exists()
    with pytest.raises(RunFolderError):
        merge_runs([paths[0], tmp_path / "nothing"], tmp_path / "new")


def test_rows_that_would_count_twice_are_refused() -> None:
    """Two runs that share some frames have different hashes; their rows tell."""
    obs = simulated(7, 24)
    first, second = obs.select_frames(obs.frame_ids[:14]), obs.select_frames(obs.frame_ids[10:])
    with pytest.raises(CalibrationError, match="measurements that another run holds too"):
        join_observations([first, second], ["a", "b"])
    join_observations(halves(obs, 12), ["a", "b"])


def test_what_cannot_be_merged_is_refused() -> None:
    cal, other = calibrated(1), calibrated(2)
    wider = dataclasses.replace(other, camera=other.camera.replace(width_px=1100))
    model = calibrate(simulated(2), scenes.nominal(scenes.camera("k1")))
    stated = calibrate(scenes.with_sigmas(simulated(2)), NOMINAL)
    settings = {**cal.provenance["settings"], "likelihood": "student_t"}
    heavy = dataclasses.replace(cal, provenance={**cal.provenance, "settings": settings})
    held = calibrate(simulated(1), NOMINAL, effects="field")
    twice = merge([cal, other])
    for runs, options, words in (
        ([cal], {}, "at least two"),
        ([cal, other], {"noise": "both"}, "unknown"),
        ([cal, wider], {}, "width_px is 1100"),
        ([cal, model], {}, "distortion is k1"),
        ([cal, stated], {"noise": "common"}, "noise 'own'"),
        ([heavy, other], {}, "student_t"),
        ([held, other], {}, r"run 1: holds effects \(field\).*join_obs"),
        ([cal, cal], {}, "count twice"),
        ([twice, other], {}, "count twice"),
    ):
        with pytest.raises(CalibrationError, match=words):
            merge(runs, **options)
    assert np.isnan(consistency_of(merge([cal, stated])).noise_p_value)
    assert merge([cal, stated], noise="own").sigma_name == "sigma_scale"


def test_tables_of_different_kinds_are_refused_or_filled() -> None:
    a, b = simulated(1), simulated(2)
    with pytest.raises(CalibrationError, match="different kinds"):
        join_observations([a, b.with_meta(directions="undeclared")], ["a", "b"])
    with pytest.raises(CalibrationError, match="only some"):
        join_observations([a, scenes.with_sigmas(b)], ["a", "b"])
    joined = join_observations([a, dataclasses.replace(b, mag=None)], ["a", "b"])
    assert np.isnan(joined.mag[-1])
    assert joined.mag[0] == a.mag[0]


def test_another_camera_is_told_apart() -> None:
    # 0.15 px of 5852: one marginal sigma of f, but five along the direction that the stars see
    # best.
    runs = [calibrated(11, 50), calibrated(12, 50, 0.15)]
    with pytest.raises(CalibrationError, match="do not show the same camera"):
        merge(runs)
    found = consistency_of(merge(runs, allow_inconsistent=True))
    assert found.p_value < 1e-3
    assert not found.ok
    assert "too small" in found.messages[0]
    assert "do not show" in found._repr_html_()
    with pytest.raises(CalibrationError, match="of its own sigmas"):
        merge([calibrated(11, 50), calibrated(12, 50, 2.0)], allow_inconsistent=True)


def test_the_run_that_deviates_is_named() -> None:
    runs = [calibrated(11, 50), calibrated(13, 50), calibrated(14, 50, 0.15), calibrated(15, 50)]
    found = consistency_of(merge(runs, names=["a", "b", "c", "d"], allow_inconsistent=True))
    assert found.names[int(np.argmin(found.run_p_value))] == "c"
    assert found.odd_one_out.startswith("c deviates most")
    assert list(found.to_dataframe()["run"]) == ["a", "b", "c", "d"]


def old_p_value(runs: list[Optimum]) -> float:
    """The control: the F test of the version before, which has one noise for all runs."""
    p = len(runs[0].theta)
    own = sum(run.sum_of_squares for run in runs)
    dof = (len(runs) - 1) * p, sum(run.dof for run in runs)
    between = optimum(total([run.compressed for run in runs])).sum_of_squares - own
    return float(fdtrc(*dof, between / dof[0] / (own / dof[1])))


@pytest.mark.parametrize(
    ("noise", "dof"), [((1.0, 1.0), (200, 30)), ((1.0, 5.0), (200, 30)), ((1.0, 2.0), (10, 40))]
)
def test_agreement_is_tested_at_any_ratio_of_noises(noise, dof):
    rng = np.random.default_rng(7)
    sigma, nu, p = np.array(noise), np.array(dof, dtype=float), 5
    root = (
        np.array([np.eye(p) + 0.4 * rng.standard_normal((p, p)) for _ in nu])
        * np.sqrt(nu)[:, None, None]
    )
    unit = root @ root.transpose(0, 2, 1)
    new, old = [], []
    for _ in range(1000):
        away = (
            np.linalg.solve(root.transpose(0, 2, 1), rng.standard_normal((2, p, 1)))[..., 0]
            * sigma[:, None]
        )
        variance = sigma**2 * rng.chisquare(nu) / nu
        for information, values in ((unit / variance[:, None, None], new), (unit, old)):
            mean = np.linalg.solve(
                information.sum(axis=0), np.einsum("rij,rj->i", information, away)
            )
            square = float(np.einsum("ri,rij,rj", away - mean, information, away - mean))
            pooled = float(fdtrc(p, nu.sum(), square / p / (nu @ variance / nu.sum())))
            values.append(welch_james(square, information, nu)[2] if values is new else pooled)
    assert kstest(new, "uniform").pvalue > 0.01
    if noise[0] != noise[1]:
        assert kstest(old, "uniform").pvalue < 1e-6


@pytest.mark.slow
def test_a_shift_between_runs_is_seen_where_there_is_one() -> None:
    def p_values(n: int, shift_f_px: float = 0.0) -> list[float]:
        """Two runs each, of which the second may have moved."""
        pairs = ((calibrated(5000 + 2 * i), 5001 + 2 * i) for i in range(n))
        return [shift_test(one, calibrated(seed, 12, shift_f_px)).p_value for one, seed in pairs]

    assert kstest(p_values(40), "uniform").pvalue > 1e-3
    # The control: a focal length that moved by one of its marginal sigmas.
    assert kstest(p_values(10, 0.3), "uniform").pvalue < 1e-3


@pytest.mark.slow
def test_runs_to_be_merged_differ_where_they_do() -> None:
    def p_values(n: int, shift_f_px: float = 0.0) -> np.ndarray:
        """Three runs each, of which the last may have moved: all together, the second against the
        others, the noise.
        """
        found = []
        for i in range(n):
            runs = [calibrated(5000 + 3 * i + k, 12, shift_f_px * (k == 2)) for k in range(3)]
            compared = consistency_of(merge(runs, allow_inconsistent=True))
            found.append((compared.p_value, compared.run_p_value[1], compared.noise_p_value))
        return np.array(found)

    for column in p_values(25).T:
        assert kstest(column, "uniform").pvalue > 1e-3
    # The control: a focal length off by 0.3 px, one marginal sigma, in one of three runs.
    assert kstest(p_values(8, 0.3)[:, 0], "uniform").pvalue < 1e-3


@pytest.mark.slow
def test_merged_runs_of_unequal_noise_agree_and_cover() -> None:
    """70 pairs of runs from outside, the smaller with more noise."""
    new, old, squares = [], [], []
    for seed in range(70):
        runs, truth = [], np.zeros(5)
        for part, (frames, sigma) in enumerate(((10, 0.05), (4, 0.25))):
            c = campaign(
                np.random.default_rng((seed, part)),
                n_frames=frames,
                stars_per_frame=12,
                sigma_px=sigma,
            )
            sheet = Camera(**c.camera_toml(), coefficients=(0.0, 0.0))
            runs.append(calibrate(Observations(**c.columns), sheet))
            truth = c.theta
        merged = merge(runs, allow_inconsistent=True)
        new.append(consistency_of(merged).p_value)
        old.append(old_p_value([optimum(run.compressed) for run in runs]))
        away = (merged.theta - truth) / merged.sigmas
        squares.append(float(away @ np.linalg.solve(merged.correlation, away)) / 5.0)
    print(
        f"KS {kstest(new, 'uniform').pvalue:.2g}, before "
        f"{kstest(old, 'uniform').pvalue:.2g}; below "
        f"0.001: {np.sum(np.less(new, 1e-3))}, before {np.sum(np.less(old, 1e-3))}; NEES/p "
        f"{np.mean(squares):.3f}"
    )
    assert kstest(new, "uniform").pvalue > 0.01
    # Five degrees of freedom each: the mean of 70 has a standard error of 0.076.
    assert abs(np.mean(squares) - 1.0) < 0.2
    # Control: the test that has one noise for all runs.
    assert kstest(old, "uniform").pvalue < 1e-3
