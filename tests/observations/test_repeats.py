"""A measurement counts once."""

import dataclasses
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import RepeatedFramesError
from starcal_uq.diagnostics.residuals import normalised_residuals
from starcal_uq.estimation.merging import consistency_of, merge
from starcal_uq.estimation.result import Calibration
from starcal_uq.estimation.weights import weighed
from starcal_uq.observations.repeats import Fingerprints, _crowded, repeats
from starcal_uq.runs.merge import merge_runs
from tests.helpers.outside import Campaign, campaign, measured_again

SIGMA = 0.05


def camera(c: Campaign) -> sc.Camera:
    return sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0))


@lru_cache
def night(seed: int = 1, n_frames: int = 16) -> Campaign:
    return campaign(np.random.default_rng(seed), n_frames=n_frames, sigma_px=SIGMA)


def together(*tables: dict[str, np.ndarray]) -> sc.Observations:
    """Rows of several tables, columns that one lacks left out."""
    return sc.Observations(
        **{name: np.concatenate([t[name] for t in tables]) for name in tables[-1]}
    )


def table(c: Campaign) -> sc.Observations:
    return sc.Observations(**c.columns)


@lru_cache
def calibrated(seed: int = 1, n_frames: int = 16) -> Calibration:
    return sc.calibrate(table(night(seed, n_frames)), camera(night(seed, n_frames)))


@lru_cache
def doubled(eta: float = 0.1, origin_px: float = 0.0) -> sc.Observations:
    rng = np.random.default_rng(5)
    return together(
        night().columns, measured_again(rng, night().columns, eta * SIGMA, origin_px=origin_px)
    )


def test_every_frame_twice_is_refused_left_out_or_kept() -> None:
    obs, sheet = doubled(), camera(night())
    with pytest.raises(RepeatedFramesError) as caught:
        sc.calibrate(obs, sheet)
    first, later = np.array(caught.value.pairs).T
    # Frames are measured again in reverse, under new numbers.
    assert np.array_equal(first, np.arange(16))
    assert np.array_equal(later, 1000 + 15 - first)
    rest = sc.calibrate(obs, sheet, duplicates="drop")
    assert np.array_equal(rest.frame_ids, np.arange(16))
    assert rest.provenance["dropped_frames"] == list(range(1000, 1016))
    assert np.all(np.abs(rest.theta - calibrated().theta) < 1e-6 * calibrated().sigmas)
    assert weighed(obs, rest).n_frames == 16
    # Judged is what was calibrated: with what was left out, each residual would be 1.4 times too
    # many sigmas.
    alone = normalised_residuals(calibrated(), table(night()))
    assert np.allclose(normalised_residuals(rest, obs), alone, atol=1e-4)
    # The old behaviour, which counts all twice: sigmas that are 0.7 times too small.
    kept = sc.calibrate(obs, sheet, duplicates="keep")
    # All frames compared, or those alone that share their attitude with another.
    assert np.array_equal(sc.estimation.repeated_frames(kept), caught.value.pairs)
    assert np.all(np.abs(kept.sigmas / calibrated().sigmas - np.sqrt(0.5)) < 0.06)


def test_exposures_of_one_sky_are_not_taken_for_one() -> None:
    stare = campaign(np.random.default_rng(2), n_frames=30, pointings=10, sigma_px=SIGMA)
    assert sc.estimation.repeated_frames(sc.calibrate(table(stare), camera(stare))).shape == (0, 2)
    # One of its exposures again, though it has noise of its own from the others: found.
    again = {name: values[stare.columns["frame"] == 7] for name, values in stare.columns.items()}
    more = together(stare.columns, measured_again(np.random.default_rng(3), again, 0.1 * SIGMA))
    with pytest.raises(RepeatedFramesError):
        sc.calibrate(more, camera(stare))


def test_runs_that_share_frames_are_not_merged_unawares(tmp_path: Path) -> None:
    a, sheet = night(), camera(night())
    fresh, part = (
        night(2),
        {name: values[a.columns["frame"] >= 10] for name, values in a.columns.items()},
    )
    shared = measured_again(np.random.default_rng(4), part, 0.1 * SIGMA)
    second = together(fresh.columns, shared)
    runs = [sc.Run(tmp_path / name) for name in ("a", "b", "fresh")]
    for run, obs in zip(runs, (table(a), second, table(fresh)), strict=True):
        run.calibrate(obs, sheet)
    one, two = runs[0].calibration, runs[1].calibration
    with pytest.raises(RepeatedFramesError):
        merge([one, two])
    with pytest.raises(RepeatedFramesError):
        merge_runs([run.path for run in runs[:2]])
    dropped = merge_runs([run.path for run in runs[:2]], duplicates="drop")
    right = merge_runs([runs[0].path, runs[2].path])
    assert np.all(np.abs(dropped.theta - right.theta) < 1e-3 * right.sigmas)
    # The old behaviour.
    assert np.all(merge([one, two], duplicates="keep").sigmas < 0.95 * right.sigmas)
    found = sc.compare(one, two, n=5, n_draws=50)
    assert (found.data, found.tested) == ("overlapping", False)
    assert "6 frames" in found.rule
    assert sc.compare(one, runs[2].calibration, n=5, n_draws=50).data == "independent"
    # Runs of a version without fingerprints: said where there is nothing else, found where
    # observations are.
    old = [dataclasses.replace(cal, fingerprints=None) for cal in (one, two)]
    assert "cannot be checked" in sc.compare(*old, n=5, n_draws=50).rule
    assert any("cannot be checked" in words for words in consistency_of(merge(old)).messages)
    for run, cal in zip(runs, old, strict=False):
        cal.save(run.folder.calibration)
        (run.path / "run.json").unlink()
    with pytest.raises(RepeatedFramesError):
        merge_runs([run.path for run in runs[:2]])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("eta", "origin_px", "found"),
    [(0.0, 0.0, 1.0), (0.1, 0.5, 1.0), (0.2, 0.0, 1.0), (0.3, 0.0, 0.7)],
)
def test_images_measured_again_are_found(eta: float, origin_px: float, found: float) -> None:
    cal = sc.calibrate(doubled(eta, origin_px), camera(night()), duplicates="keep")
    assert len(repeats(cal.fingerprints)) >= found * 16


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"pointings": 10, "n_frames": 20},
        {"pointings": 10, "n_frames": 20, "stars_per_frame": 4},
        {"pointings": 3, "n_frames": 150},
        {"pointings": 10, "n_frames": 100, "drift_px": 0.3},
        {"pointings": 10, "n_frames": 20, "star_sigma_px": SIGMA},
        {"pointings": 10, "n_frames": 100, "star_sigma_px": 4.0 * SIGMA},
        {
            "pointings": 10,
            "n_frames": 20,
            "sigma_px": lambda radius, mag, frame: 0.02 * 10.0 ** (0.35 * (mag - 4.0)),
        },
        {
            "pointings": 10,
            "n_frames": 20,
            "sigma_px": lambda radius, mag, frame: 0.02 + 0.08 * (frame % 2),
        },
        {"pointings": 10, "n_frames": 20, "corner_px": (60.0, -30.0)},
    ],
    ids=[
        "pairs",
        "few stars",
        "stare",
        "drift",
        "star errors",
        "large star errors",
        "magnitudes",
        "frames",
        "misfit",
    ],
)
def test_no_exposures_are_called_one(options: dict[str, object]) -> None:
    for seed in range(4):
        c = campaign(np.random.default_rng(seed), **options)
        cal = sc.calibrate(table(c), camera(c), throw=False, duplicates="keep")
        assert len(repeats(cal.fingerprints)) == 0


def marks(place: np.ndarray, errors: np.ndarray) -> Fingerprints:
    """Fingerprints of frames with their stars at places (n, m, 2), up to errors."""
    xy, length = place + errors, np.linalg.norm(errors, axis=2)
    order = np.argsort(np.hypot(*(xy - 500.0).transpose(2, 0, 1)), axis=1)
    return Fingerprints(
        np.full(len(errors), errors.shape[1]),
        np.take_along_axis(xy, order[..., None], axis=1).reshape(-1, 2).astype(np.float32),
        np.take_along_axis(length, order, axis=1).ravel().astype(np.float32),
    )


def test_noise_of_their_own_tells_pairs_apart_whatever_its_size() -> None:
    """300 pointings with two exposures each, noise of 0.01 to 0.2 px."""
    rng = np.random.default_rng(6)
    n, m = 300, 8
    place = np.repeat(rng.uniform(50.0, 950.0, (n, m, 2)), 2, axis=0)
    noise = np.repeat(rng.uniform(0.01, 0.2, n), 2)[:, None, None]
    errors = noise * rng.standard_normal((2 * n, m, 2))
    assert len(repeats(marks(place, errors))) == 0
    errors[1::2] = errors[::2] + 0.1 * noise[1::2] * rng.standard_normal((n, m, 2))
    assert len(repeats(marks(place, errors))) > 0.98 * n


@pytest.mark.slow
@pytest.mark.parametrize(("m", "least"), [(5, (1.0, 0.9, 0.7)), (12, (1.0, 0.99, 0.95))])
def test_power_and_false_alarms(m: int, least: tuple[float, float, float]) -> None:
    """500 pointings: images measured again to within eta sigma."""
    rng = np.random.default_rng(m)
    n = 500
    place = np.repeat(rng.uniform(50.0, 950.0, (n, m, 2)), 2, axis=0)
    for eta, expected in zip((0.1, 0.2, 0.3, 0.4), (*least, 0.0), strict=True):
        errors = np.repeat(0.05 * rng.standard_normal((n, m, 2)), 2, axis=0)
        errors[1::2] += eta * 0.05 * rng.standard_normal((n, m, 2))
        seen = len(repeats(marks(place, errors))) / n
        alone = [len(repeats(marks(place[i : i + 2], errors[i : i + 2]))) for i in range(0, 200, 2)]
        print(f"{m} stars, eta {eta:g}: {seen:.3f} found, of single pairs {np.mean(alone):.2f}")
        assert seen >= expected
    for share in (0.0, 0.25, 0.5, 0.7, 0.9):
        alarms = 0
        for _ in range(4):
            common = np.repeat(rng.standard_normal((n, m, 2)), 2, axis=0)
            own = rng.standard_normal((2 * n, m, 2))
            alarms += len(
                repeats(marks(place, 0.05 * (np.sqrt(share) * common + np.sqrt(1.0 - share) * own)))
            )
        print(f"{m} stars, share {share:g}: {alarms} of {4 * n}")
        # Where nearly all of the error is common, two exposures are hardly more than one.
        assert (alarms > 0) == (share == 0.9)


def test_no_likeness_is_overlooked_on_the_way_to_the_tree() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-40.0, 40.0, (4, 1500))
    points[:, 1400:] = points[:, :100] + rng.uniform(-1.0, 1.0, (4, 100))
    gap = np.abs(points[:, :, None] - points[:, None]).max(axis=0)
    np.fill_diagonal(gap, np.inf)
    near = (gap <= 1.0).any(axis=0)
    kept = _crowded(points)
    assert near.sum() >= 200 and kept[near].all()
    assert not kept[~near].all()
