"""Screening: wrong identifications are found."""

import csv
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy import stats

import starcal_uq as sc
from starcal_uq.calibration.screening.result import COLUMNS, REASONS
from starcal_uq.calibration.screening.screening import screen
from starcal_uq.calibration.screening.tails import allowed_near, fit_tails
from starcal_uq.simulation.contamination import contaminate
from tests.helpers import scenes
from tests.helpers.outside import campaign
from tests.helpers.speed import times_as_long

TRUTH = scenes.camera()


def uncalibrated(truth: sc.Camera = TRUTH, focal: float = 1.1) -> sc.Camera:
    """A nominal camera that is far off: focal length, principal point and no distortion."""
    return truth.replace(
        focal_mm=truth.focal_mm * focal,
        x0_px=truth.x0_px + 15.0,
        y0_px=truth.y0_px - 15.0,
        coefficients=(0.0,) * len(truth.coefficients),
    )


@lru_cache(maxsize=1)
def deep_catalogue() -> sc.StarCatalogue:
    """Fainter stars than those in the frames: what a neighbour is mistaken for."""
    return sc.load_catalogue(max_mag=8.0, epoch=2026.9)


@lru_cache(maxsize=8)
def noise_free(n_frames: int = 50, stars_per_frame: int | None = None) -> sc.Observations:
    obs = scenes.observations(n_frames=n_frames, seed=4, sigma_px=0.0)
    if stars_per_frame is None:
        return obs
    rng, keep = np.random.default_rng(0), np.zeros(len(obs), dtype=bool)
    for first, last in zip(obs.frame_starts[:-1], obs.frame_starts[1:], strict=True):
        keep[rng.choice(np.arange(first, last), stars_per_frame, replace=False)] = True
    return obs.select(keep)


def with_noise(obs: sc.Observations, seed: int, sigma: object = 0.05) -> sc.Observations:
    noise = np.asarray(sigma) * np.random.default_rng(seed).standard_normal((2, len(obs)))
    return replace(obs, x_px=obs.x_px + noise[0], y_px=obs.y_px + noise[1])


@pytest.mark.parametrize("model", ["brown", "brown_tangential", "inverse"])
def test_distortion_models(model: str) -> None:
    truth = scenes.camera(model)
    obs = scenes.observations(model)
    clean = sc.calibrate(obs, uncalibrated(truth, 0.9))
    dirty = contaminate(obs, deep_catalogue(), truth, 0.1, "neighbour", seed=2)
    found = screen(dirty.observations, uncalibrated(truth, 0.9))
    assert not np.any(~found.kept & ~dirty.wrong)
    assert np.count_nonzero(found.kept & dirty.wrong) <= 2
    assert np.all(np.abs(found.calibration.theta - clean.theta) < 1.5 * clean.sigmas)


def test_half_of_a_frame_wrong_and_a_frame_beyond_help() -> None:
    obs = scenes.observations()
    wrong = np.zeros(len(obs), dtype=bool)
    starts = obs.frame_starts
    wrong[starts[2] : starts[2] + obs.stars_per_frame[2] // 2] = True
    wrong[starts[5] : starts[6]] = True
    rng = np.random.default_rng(1)
    ra = np.where(wrong, rng.uniform(0.0, 360.0, len(obs)), obs.ra_deg)
    found = screen(replace(obs, ra_deg=ra), uncalibrated())
    assert np.array_equal(~found.kept, wrong)
    assert found.dropped_frames.tolist() == [obs.frame_ids[5]]
    assert set(found.rejected["reason"][found.rejected["frame"] == obs.frame_ids[5]]) == {
        "frame_dropped"
    }
    assert set(found.rejected["reason"][found.rejected["frame"] == obs.frame_ids[2]]) <= {
        "elsewhere",
        "displaced",
    }


@pytest.fixture(scope="module")
def dirty():
    return contaminate(scenes.observations(), deep_catalogue(), TRUTH, 0.05, "neighbour", seed=3)


@pytest.fixture(scope="module")
def found(dirty):
    return screen(dirty.observations, uncalibrated())


def test_every_rejected_row_is_listed_with_its_reason(dirty, found) -> None:
    table = found.rejected
    assert tuple(table.columns) == COLUMNS
    rows = table["row"].to_numpy()
    assert np.array_equal(np.sort(rows), np.flatnonzero(~found.kept))
    assert np.array_equal(table["frame"], dirty.observations.frame[rows])
    assert np.array_equal(table["star_id"], dirty.observations.star_id[rows])
    assert set(table["reason"]) <= set(REASONS)
    assert np.all(table["statistic"] > table["threshold"])
    # The residual is the distance between the right star and the one it was taken for.
    truth = scenes.observations().directions_icrs[rows]
    distance = (
        np.linalg.norm(truth - dirty.observations.directions_icrs[rows], axis=1) * TRUTH.focal_px
    )
    assert np.allclose(table["residual_px"], distance, rtol=0.02, atol=0.3)
    assert sum(found.counts.values()) == found.n_rejected == len(rows)
    assert len(found.observations) + found.n_rejected == len(dirty.observations)
    assert found.calibration.provenance["data_sha256"] == found.observations.data_hash
    assert found.observations.meta["screening"]["rejected"] == found.n_rejected


def test_clean_data_are_left_alone(tmp_path) -> None:
    obs = scenes.observations()
    found = screen(obs, uncalibrated())
    plain = sc.calibrate(obs, uncalibrated())
    assert found.kept.all()
    assert found.stable
    assert found.warnings == ()
    assert np.array_equal(found.calibration.theta, plain.theta)
    assert found.focal_ratio == pytest.approx(1 / 1.1, abs=2e-3)
    found.save_rejected(tmp_path / "rejected.csv")
    assert (tmp_path / "rejected.csv").read_text() == ",".join(COLUMNS) + "\n"
    assert "<table>" not in found._repr_html_()


def test_stars_without_names_and_noise_free_data() -> None:
    obs = replace(noise_free(20), star_id=None)
    moved = obs.ra_deg.copy()
    moved[[3, 50]] += (0.01, 90.0)
    # At rounding level a solver may end without a verdict.
    found = screen(replace(obs, ra_deg=moved), uncalibrated(), throw=False)
    assert found.rejected["row"].tolist() == [3, 50]
    assert found.rejected["star_id"].tolist() == ["", ""]
    assert found.rejected["reason"].tolist() == ["displaced", "elsewhere"]


def test_a_blurred_frame_is_dropped_as_a_whole() -> None:
    """Three times the noise in one frame: not trimmed until what is left happens to fit."""
    base = noise_free()
    sigma = np.where(base.frame == base.frame_ids[7], 0.15, 0.05)
    found = screen(with_noise(base, 2, sigma), uncalibrated())
    assert found.dropped_frames.tolist() == [base.frame_ids[7]]
    assert found.counts == {"frame_disturbed": base.stars_per_frame[7]}
    assert np.all(found.rejected["statistic"] > 30.0)
    assert found.rejected["residual_px"].max() < 1.0
    assert screen(with_noise(base, 2, 0.05), uncalibrated()).n_rejected == 0


def test_frames_with_two_stars_are_listed() -> None:
    obs = scenes.observations()
    keep = np.ones(len(obs), dtype=bool)
    keep[obs.frame_starts[3] + 2 : obs.frame_starts[4]] = False
    found = screen(obs.select(keep), uncalibrated())
    assert found.counts == {"frame_too_small": 2}
    assert found.rejected["statistic"].isna().all()


def test_a_single_frame() -> None:
    obs = scenes.observations("none").select_frames([5])
    nominal = uncalibrated(scenes.camera("none"))
    assert screen(obs, nominal).kept.all()
    found = screen(
        replace(obs, ra_deg=np.where(np.arange(len(obs)) == 3, 10.0, obs.ra_deg)), nominal
    )
    assert found.rejected["row"].tolist() == [3]


def test_nothing_right_is_said() -> None:
    dirty = contaminate(scenes.observations(), deep_catalogue(), TRUTH, 1.0, "random", seed=2)
    with pytest.raises(sc.errors.CalibrationError) as caught:
        screen(dirty.observations, uncalibrated())
    assert caught.value.status is sc.core.Status.INCONSISTENT


def test_heavy_tails_are_not_called_wrong_stars() -> None:
    base = noise_free()
    noise = 0.05 * np.random.default_rng(5).standard_t(3.0, (2, len(base)))
    obs = replace(base, x_px=base.x_px + noise[0], y_px=base.y_px + noise[1])
    found = screen(obs, uncalibrated())
    assert found.stable and found.model_is_wrong
    assert "the model is wrong, not the stars" in found.text and "Student t" in found.text
    assert found.calibration.provenance["settings"]["likelihood"] == "student_t"
    # Tails of three degrees of freedom reach far; before, nine of these right stars were left out.
    assert found.n_rejected <= 1
    cut_short = screen(obs, uncalibrated(), max_rounds=1)
    assert not cut_short.stable and cut_short.model_is_wrong
    assert any("did not settle" in warning for warning in cut_short.warnings)


def poor_camera(seed: int, *, share_wrong: float = 0.0, tails: bool = True, bend_px: float = 2.0):
    """Ten frames whose centroids are of very unequal noise, through a lens with a bend that no
    model here has.
    """
    rng = np.random.default_rng(seed)
    by_frame = np.exp(0.4 * rng.standard_normal(10)) if tails else np.ones(10)

    def displaced(d, xy, magnitude, frame):
        x, y = d / 724.0
        bend = bend_px * np.array([x * y, y**2 - 0.3 * x**3]) if tails else 0.0
        sigma = 0.1 * by_frame[frame] * np.exp(tails * rng.standard_normal(d.shape[1]))
        return bend + sigma * rng.standard_normal(d.shape)

    c = campaign(
        rng, n_frames=10, stars_per_frame=40, field_deg=20.0, sigma_px=0.0, displaced=displaced
    )
    wrong = rng.random(len(c.columns["frame"])) < share_wrong
    for name in ("x_px", "y_px"):
        c.columns[name] = np.where(wrong, rng.uniform(0.0, 1023.0, len(wrong)), c.columns[name])
    return (
        c,
        sc.Observations(**c.columns),
        sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0)),
        wrong,
    )


def test_screening_does_not_hurt_where_the_model_is_wrong() -> None:
    """Four to twenty of a hundred right stars, and a whole frame, were left out of these before."""
    for seed in (0, 2):
        c, obs, camera, _ = poor_camera(seed)
        found = screen(obs, camera)
        assert found.model_is_wrong and found.n_rejected <= 1 and not len(found.dropped_frames)
        # The bend moves f by itself.
        assert abs(found.calibration.theta[2] - c.theta[2]) < 3.0 * found.calibration.sigmas[2]
        assert found.observations.meta["screening"]["blame"] in found.text


@pytest.mark.slow
def test_a_lens_without_its_model_is_no_tail() -> None:
    """Student's tails put f 6.6 and 4.4 sigma off here."""
    for seed in (0, 1):
        c, obs, camera, _ = poor_camera(seed, bend_px=5.0)
        found = screen(obs, camera)
        assert found.model_is_wrong and found.n_rejected == 0
        assert found.calibration.provenance["settings"].get("likelihood") != "student_t"
        assert abs(found.calibration.theta[2] - c.theta[2]) < 3.0 * found.calibration.sigmas[2]
        assert "follow the place on the detector" in found.text and "Student t" not in found.text
    _, obs, camera, _ = poor_camera(0, bend_px=0.0)
    found = screen(obs, camera)
    assert found.calibration.provenance["settings"]["likelihood"] == "student_t"
    assert "follow the place" not in found.text


@pytest.mark.parametrize("share", [0.1])
def test_wrong_stars_are_left_out_whatever_the_model(share: float) -> None:
    _, obs, camera, wrong = poor_camera(1, share_wrong=share)
    found = screen(obs, camera)
    assert not (found.kept & wrong).any()
    assert np.count_nonzero(~found.kept & ~wrong) <= 1
    # The control: with a model that holds, the stars are to blame.
    _, obs, camera, wrong = poor_camera(1, share_wrong=share, tails=False)
    found = screen(obs, camera)
    assert not found.model_is_wrong and np.array_equal(found.kept, ~wrong)


def test_a_t_is_fitted_to_what_hangs_together() -> None:
    rng = np.random.default_rng(0)
    t = np.sum(0.2 * rng.standard_normal((2, 3000)) ** 2, axis=0) / rng.gamma(2.0, 0.5, 3000)
    tails = fit_tails(np.append(t, [1e6, np.inf]), 1e-5)
    assert 3.0 < tails.nu < 5.5 and tails.scale2 == pytest.approx(0.2, rel=0.1) and tails.heavy
    assert np.count_nonzero(~tails.within[:-2]) <= 1 and not tails.within[-2:].any()
    # The control: Gaussian tails.
    assert not fit_tails(np.sum(rng.standard_normal((2, 3000)) ** 2, axis=0), 1e-5).heavy


def test_how_many_stars_may_be_just_beyond_the_limit() -> None:
    rng = np.random.default_rng(1)
    # Wrong stars anywhere within 60 px, at a noise of 0.3 px: 14 of 4000 are near, and are allowed
    # for.
    wrong = rng.uniform(20.0, 40_000.0, 4000)
    near, allowed = allowed_near(wrong, np.full(4000, 20.0), 0.05)
    assert 0 < near <= allowed < 30
    tail = 20.0 / rng.random(100) ** 0.5
    near, allowed = allowed_near(tail, np.full(100, 20.0), 0.05)
    assert near > allowed
    assert allowed_near(np.array([25.0]), np.array([20.0]), 0.05) == (1, 2)


def test_a_poor_model_is_not_hidden_by_screening() -> None:
    """Right stars at the edge, rejected for a distortion that the model lacks, raise a warning."""
    from starcal_uq.calibration.screening.result import warnings_about

    obs = scenes.observations()
    radius = np.hypot(obs.x_px - TRUTH.x0_px, obs.y_px - TRUTH.y0_px)
    for rows, expected in (
        (np.argsort(radius)[-12:], True),
        (np.arange(0, len(obs), len(obs) // 12), False),
    ):
        kept = np.ones(len(obs), dtype=bool)
        kept[rows] = False
        base = screen(obs, uncalibrated())
        import pandas as pd

        table = pd.DataFrame(
            {"row": rows, "reason": "displaced", "statistic": 1e4, "threshold": 20.0}
        )
        texts = warnings_about(obs, base.calibration.camera, kept, table)
        assert any("distortion model" in text for text in texts) == expected


def test_per_star_noise_is_respected() -> None:
    base = noise_free()
    stated = np.random.default_rng(9).uniform(0.02, 0.4, len(base))
    obs = with_noise(replace(base, sigma_px=stated), 1, stated)
    moved, noisy = int(np.argmin(stated)), int(np.argmax(stated))
    x = obs.x_px.copy()
    x[[moved, noisy]] += 0.5
    found = screen(replace(obs, x_px=x), uncalibrated())
    # Half a pixel is much for one star and nothing for the other.
    assert found.rejected["row"].tolist() == [moved]
    assert found.calibration.sigma_name == "sigma_scale"
    assert found.calibration.sigma == pytest.approx(1.0, abs=0.05)
    # The control: without the stated noise, the noisy stars are tails that one noise does not
    # explain.
    assert screen(replace(obs, x_px=x, sigma_px=None), uncalibrated()).model_is_wrong


def test_many_frames_are_fast() -> None:
    """Some ten calibrations of clean stars."""
    obs = scenes.observations(n_frames=300, seed=1)
    dirty = contaminate(obs, deep_catalogue(), TRUTH, 0.1, "neighbour", seed=1)
    screen(dirty.observations.select_frames(np.arange(20)), uncalibrated())
    ratio = times_as_long(
        lambda: screen(dirty.observations, uncalibrated()),
        lambda: sc.calibrate(obs, uncalibrated()),
        repeats=2,
    )
    assert ratio < 16.0


def test_contamination_is_what_it_says() -> None:
    obs = scenes.observations()
    for kind in ("random", "neighbour"):
        dirty = contaminate(obs, deep_catalogue(), TRUTH, 0.05, kind, seed=1)
        again = contaminate(obs, deep_catalogue(), TRUTH, 0.05, kind, seed=1)
        assert again.observations.data_hash == dirty.observations.data_hash
        assert np.count_nonzero(dirty.wrong) == round(0.05 * len(obs))
        distance = np.linalg.norm(obs.directions_icrs - dirty.observations.directions_icrs, axis=1)
        assert np.array_equal(distance > 0.0, dirty.wrong)
        assert np.array_equal(obs.star_id != dirty.observations.star_id, dirty.wrong)
        assert np.array_equal(obs.xy, dirty.observations.xy)
        dirty.observations.check(TRUTH)
        if kind == "neighbour":
            assert distance.max() * TRUTH.focal_px <= 60.0
        else:
            assert np.median(np.degrees(distance[dirty.wrong])) > 45.0
    with pytest.raises(sc.errors.CatalogueError):
        contaminate(obs, sc.load_catalogue(max_mag=6.0, epoch=2026.9), TRUTH, 0.5, "neighbour")
    with pytest.raises(ValueError):
        contaminate(obs, deep_catalogue(), TRUTH, 0.1, "other")


def test_real_stars(real_data) -> None:
    camera = sc.Camera.load(real_data / "esa_tetra3_camera.toml")
    path = real_data / "esa_tetra3_observations.csv"
    obs = sc.load_observations(
        path, camera, columns={"ra_deg": "ra_apparent_deg", "dec_deg": "dec_apparent_deg"}
    )
    with path.open() as stream:
        snr = np.array([float(row["snr"]) for row in csv.DictReader(stream)])
    everything = screen(obs, camera)
    # A hundredth is just beyond the limit, faint stars: their noise differs, they are not other
    # stars.
    assert everything.model_is_wrong and everything.n_rejected == 0
    # With noise that grows as 1 / SNR stated, hardly any.
    assert screen(replace(obs, sigma_px=np.hypot(0.06, 0.6 / snr)), camera).n_rejected <= 2
    bright = screen(obs.select(snr >= 10), camera)
    assert bright.n_rejected == 2
    assert bright.rejected["residual_px"].max() < 0.5
    # The estimate stays; and wrong stars put among them are found.
    plain = sc.calibrate(obs.select(snr >= 10), camera)
    assert np.all(np.abs(bright.calibration.theta - plain.theta) < plain.sigmas)
    ra = bright.observations.ra_deg.copy()
    ra[::20] += 0.05
    assert np.array_equal(
        np.flatnonzero(~screen(replace(bright.observations, ra_deg=ra), camera).kept)[:12],
        np.arange(0, len(ra), 20)[:12],
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("control", "significance", "stated"), [("table", 0.2, True), ("star", 0.01, False)]
)
def test_false_rejections_on_clean_data(control: str, significance: float, stated: bool) -> None:
    base = noise_free()
    sigma = (
        np.random.default_rng(9).uniform(0.02, 0.3, len(base))
        if stated
        else np.full(len(base), 0.05)
    )
    if stated:
        base = replace(base, sigma_px=sigma)
    replicates = 60 if control == "table" else 15
    rejected = np.array(
        [
            screen(
                with_noise(base, 100 + seed, sigma),
                uncalibrated(),
                significance=significance,
                control=control,
            ).n_rejected
            for seed in range(replicates)
        ]
    )
    # Independent tests would give the stated rate; stars and frames that overlap give less, but not
    # half.
    if control == "table":
        expected = significance * replicates
        assert stats.binom.cdf(np.count_nonzero(rejected), replicates, 0.4 * significance) > 1e-3
        assert stats.binom.sf(np.count_nonzero(rejected) - 1, replicates, significance) > 1e-3
    else:
        expected = significance * replicates * len(base)
        assert (
            0.6 * expected - 4 * np.sqrt(expected)
            < rejected.sum()
            < expected + 4 * np.sqrt(expected)
        )


@pytest.mark.slow
def test_cutting_the_tails_shrinks_sigma_as_stated() -> None:
    base = noise_free()
    sigma, stated = [], []
    for seed in range(16):
        obs = with_noise(base, 500 + seed)
        found = screen(obs, uncalibrated(), significance=0.05, control="star")
        sigma.append(found.calibration.sigma / sc.calibrate(obs, uncalibrated()).sigma)
        stated.append(found.sigma_shrinkage)
    shrinkage = 1.0 - np.mean(sigma)
    # Frames rejected by TASTE add to it: about the same again, half of the risk being theirs.
    assert stated[0] < shrinkage < 2.5 * stated[0]
    assert screen(with_noise(base, 1), uncalibrated()).sigma_shrinkage < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "fraction"), [("random", 0.1), ("neighbour", 0.1)])
def test_estimate_and_coverage_with_wrong_identifications(kind: str, fraction: float) -> None:
    """Within half a sigma of the clean estimate and covering; without screening neither holds."""
    base, nominal = noise_free(), uncalibrated()
    shift, z, z_control = [], [], []
    for seed in range(25):
        obs = with_noise(base, 1000 + seed)
        clean = sc.calibrate(obs, nominal)
        dirty = contaminate(obs, deep_catalogue(), TRUTH, fraction, kind, seed=seed).observations
        cal = screen(dirty, nominal).calibration
        shift.append(np.abs(cal.theta - clean.theta) / clean.sigmas)
        z.append((cal.theta - TRUTH.theta) / cal.sigmas)
        if seed < 8:
            try:
                plain = sc.calibrate(dirty, nominal, model=nominal.distortion, throw=False)
                z_control.append(np.abs(plain.theta - clean.theta) / clean.sigmas)
            except sc.errors.CalibrationError:
                z_control.append(np.full(5, np.inf))
    assert np.all(np.mean(shift, axis=0) < 0.5)
    # 125 intervals, five of a replicate being dependent: 92 % less two standard errors of 50
    # independent ones.
    assert np.mean(np.abs(z) < 1.96) > 0.92 - 2 * np.sqrt(0.95 * 0.05 / 50)
    assert np.median(np.mean(z_control, axis=1)) > 3.0


def test_noise_of_each_axis_is_no_wrong_star():
    """Stars that err along one axis alone lie beyond the limit of a noise that is alike."""
    c = campaign(np.random.default_rng(4), n_frames=20, sigma_px=0.0)
    rng, n = np.random.default_rng(14), len(c.columns["frame"])
    for name, sigma in (("x_px", 0.12), ("y_px", 0.012)):
        c.columns[name] = c.columns[name] + sigma * rng.standard_normal(n)
    obs, nominal = sc.Observations(**c.columns), sc.Camera(**c.camera_toml())
    assert screen(obs, nominal).n_rejected > 0
    found = screen(obs, nominal, effects="noise")
    assert found.n_rejected == 0
    assert found.calibration.fitted_noise.axis_ratio > 5.0
