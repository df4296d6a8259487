"""Rendered frames: light where the camera model puts it, noise of the stated size, files that carry
their truth.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from starcal_uq.attitude.rotations import exp_rotation, random_rotations, rotation_vector
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.projection import project, unproject
from starcal_uq.core.errors import (
    CatalogueError,
    ImageError,
    RunFolderError,
    SensorError,
    SettingError,
)
from starcal_uq.images.read import read_image
from starcal_uq.paper.camera import paper_camera
from starcal_uq.simulation.campaign import render_frames
from starcal_uq.simulation.frames import simulate
from starcal_uq.simulation.psf import profiles
from starcal_uq.simulation.rendering import Scene, render, uniform_shot_noise
from starcal_uq.simulation.sensor import Sensor
from starcal_uq.simulation.truth import RenderedFrame, read_truth, truth_table, write_frame
from starcal_uq.sky.catalogue import StarCatalogue, load_catalogue
from starcal_uq.sky.positions import ra_dec_deg
from tests.helpers.speed import times_as_long

# Light and nothing else, in electrons.
LIGHT = Sensor(
    background_e_px_s=0.0,
    dark_e_px_s=0.0,
    read_noise_e=0.0,
    gain_e_per_count=1.0,
    offset_counts=0.0,
    full_well_e=1e12,
)
SMALL = paper_camera().replace(width_px=200, height_px=150, x0_px=95.0, y0_px=80.0)
ATTITUDE = exp_rotation(np.array([0.3, -0.7, 1.1]))


@pytest.fixture(scope="module")
def stars() -> StarCatalogue:
    return load_catalogue(6.0)


def sky_of(pixels: Any, camera: Camera = SMALL, mag: float = 3.0) -> StarCatalogue:
    """Stars that the camera sees at these pixels in the attitude ATTITUDE."""
    pixels = np.asarray(pixels, dtype=float).reshape(-1, 2)
    ra, dec = ra_dec_deg(unproject(camera, pixels) @ ATTITUDE)
    n = len(pixels)
    return StarCatalogue(
        star_id=np.array([f"star {i}" for i in range(n)]),
        ra_deg=ra,
        dec_deg=dec,
        mag=np.full(n, mag),
        pm_ra_mas_yr=np.zeros(n),
        pm_dec_mas_yr=np.zeros(n),
        has_proper_motion=np.zeros(n, dtype=bool),
        epoch=2016.0,
        band="G",
        apparent=True,
        source="test",
    )


def light_of(
    pixels: Any, camera: Camera = SMALL, sensor: Sensor = LIGHT, **options: Any
) -> np.ndarray[Any, Any]:
    return render(
        sky_of(pixels, camera), camera, ATTITUDE, sensor, noise=False, quantise=False, **options
    ).data


def moments(image: np.ndarray[Any, Any]) -> tuple[float, float, np.ndarray[Any, Any]]:
    """Centroid (x, y) and covariance of the light."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    total = image.sum()
    cx, cy = (x * image).sum() / total, (y * image).sum() / total
    dx, dy = x - cx, y - cy
    covariance = [[(a * b * image).sum() / total for a in (dx, dy)] for b in (dx, dy)]
    return float(cx), float(cy), np.array(covariance)


# --- light


@pytest.mark.parametrize("psf", ["gaussian", "sampled"])
@pytest.mark.parametrize("sigma", [0.8, 1.0, 2.0])
def test_the_centroid_is_the_projected_position(psf: str, sigma: float) -> None:
    rng = np.random.default_rng(1)
    for place in rng.uniform(40.0, 100.0, (12, 2)):
        x, y, covariance = moments(
            light_of([place], sensor=LIGHT.replace(psf_sigma_px=sigma, psf=psf))
        )
        assert np.allclose((x, y), place, atol=1e-3)
        # Integration over a pixel adds the variance of the pixel.
        wanted = sigma**2 + (1.0 / 12.0 if psf == "gaussian" else 0.0)
        assert np.allclose(covariance, wanted * np.eye(2), atol=2e-3)


def test_a_psf_too_narrow_for_its_pixels_is_noticed_by_the_centroid_test() -> None:
    # The control of the test above: at 0.3 px the centroid of the pixels is not the position.
    x, _, _ = moments(light_of([[70.25, 60.0]], sensor=LIGHT.replace(psf_sigma_px=0.3)))
    assert abs(x - 70.25) > 1e-3


def test_truth_is_what_the_camera_model_says(stars: StarCatalogue) -> None:
    camera = paper_camera()
    rotation = random_rotations(1, np.random.default_rng(3))[0]
    truth = render(stars, camera, rotation, noise=False).truth
    b = stars.directions_icrs @ rotation.T
    front = b[:, 2] > np.cos(np.radians(8.0))
    xy = project(camera, b[front])
    on = camera.contains(xy)
    assert np.array_equal(truth.star_id, stars.star_id[front][on])
    assert np.allclose(np.column_stack([truth.x_px, truth.y_px]), xy[on], atol=1e-12)
    assert np.allclose(truth.electrons, Sensor().electrons(stars.mag[front][on]))
    assert len(truth) > 5


def test_a_star_beyond_the_edge_sends_light_and_is_not_in_the_truth() -> None:
    frame = render(
        sky_of([[-1.0, 70.0], [-40.0, 20.0]]), SMALL, ATTITUDE, LIGHT, noise=False, quantise=False
    )
    assert len(frame.truth) == 0
    # The detector begins half a pixel from the star: 31 % of a Gaussian of 1 px.
    assert frame.data.sum() / LIGHT.electrons(3.0) == pytest.approx(stats.norm.sf(0.5), rel=1e-4)


def test_two_stars_in_the_same_pixels_add_up() -> None:
    both = light_of([[70.2, 60.1], [71.5, 61.0]])
    assert np.allclose(both, light_of([[70.2, 60.1]]) + light_of([[71.5, 61.0]]), atol=1e-9)


def test_an_empty_sky_is_an_empty_frame(tmp_path: Path) -> None:
    frame = render(sky_of([[-90.0, 20.0]]), SMALL, ATTITUDE, LIGHT, noise=False)
    assert len(frame.truth) == 0 and not frame.data.any()
    assert len(frame.truth.observations) == 0
    write_frame(frame, tmp_path / "empty.fits")
    assert len(read_truth(tmp_path / "empty.fits")) == 0


def test_a_profile_is_the_integral_of_the_gaussian() -> None:
    first, fraction = profiles(np.array([10.3]), 0.9, "gaussian")
    edges = first[0] - 0.5 + np.arange(fraction.shape[1] + 1)
    assert np.allclose(fraction[0], np.diff(stats.norm.cdf(edges, 10.3, 0.9)), atol=1e-12)


# --- smear


@pytest.mark.parametrize("length_px", [0.5, 3.0, 20.0, 60.0])
def test_a_smear_has_the_length_of_the_motion(length_px: float) -> None:
    angle = length_px / SMALL.focal_px
    place = np.array([SMALL.x0_px, SMALL.y0_px])
    image = light_of([place], rate_rad_s=[0.0, angle / LIGHT.exposure_s, 0.0])
    x, y, covariance = moments(image)
    assert image.sum() == pytest.approx(float(LIGHT.electrons(3.0)), rel=1e-6)
    assert np.allclose((x, y), place, atol=1e-3)
    # A uniform distribution of length L has the variance L^2 / 12.
    assert covariance[0, 0] == pytest.approx(1.0 + (length_px**2 + 1.0) / 12.0, rel=2e-3)
    assert covariance[1, 1] == pytest.approx(1.0 + 1.0 / 12.0, rel=2e-3)


def test_the_sky_turns_against_the_camera() -> None:
    # Half an exposure later the attitude is exp(-w t / 2) R: the truth there is where the smear
    # ends.
    rate = np.array([0.004, -0.007, 0.05])
    place = [[150.0, 40.0]]
    middle = render(
        sky_of(place), SMALL, ATTITUDE, LIGHT, rate_rad_s=rate, noise=False, quantise=False
    )
    xy = []
    for part in np.linspace(-0.5, 0.5, 101):
        turned = exp_rotation(-rate * part * LIGHT.exposure_s) @ ATTITUDE
        truth = render(sky_of(place), SMALL, turned, LIGHT, noise=False).truth
        xy.append([truth.x_px[0], truth.y_px[0]])
    path = np.array(xy)
    x, y, covariance = moments(middle.data)
    assert np.allclose((x, y), path.mean(axis=0), atol=5e-3)
    motion = path[-1] - path[0]
    assert np.allclose(
        covariance - (13.0 / 12.0) * np.eye(2), np.outer(motion, motion) / 12.0, atol=0.02
    )
    # A positive rate about y turns the boresight towards +x, so that stars move towards -x.
    assert np.sign(motion[0]) == -np.sign(rate[1])


# --- noise


def noise_table(claimed: Sensor) -> np.ndarray[Any, Any]:
    """z of the mean and of the variance of sky and star pixels over frames, against what `claimed`
    says.
    """
    sensor = Sensor(gain_e_per_count=2.0, offset_counts=300.0, read_noise_e=6.0)
    sky = sky_of([[30.2, 25.6]], SMALL_DETECTOR, mag=2.0)
    scene = Scene(sky, SMALL_DETECTOR, sensor)
    rng = np.random.default_rng(7)
    frames = np.array([scene.render(ATTITUDE, rng).data for _ in range(400)]).astype(float)
    expected = (
        Scene(sky, SMALL_DETECTOR, claimed).render(ATTITUDE, None, noise=False, quantise=False).data
    )
    electrons = (expected - claimed.offset_counts) * claimed.gain_e_per_count
    variance = (electrons + claimed.read_noise_e**2) / claimed.gain_e_per_count**2 + 1.0 / 12.0
    n = len(frames)
    z_mean = (frames.mean(axis=0) - expected) / np.sqrt(variance / n)
    # Near enough Gaussian for the variance of a variance.
    z_variance = (frames.var(axis=0, ddof=1) / variance - 1.0) * np.sqrt((n - 1) / 2.0)
    star = np.zeros(frames.shape[1:], dtype=bool)
    star[24:28, 28:33] = True
    return np.array(
        [
            [z[part].sum() / np.sqrt(part.sum()) for part in (star, ~star)]
            for z in (z_mean, z_variance)
        ]
    )


SMALL_DETECTOR = paper_camera().replace(width_px=60, height_px=50, x0_px=28.0, y0_px=26.0)


def test_mean_and_variance_are_those_of_shot_and_read_noise() -> None:
    truth = Sensor(gain_e_per_count=2.0, offset_counts=300.0, read_noise_e=6.0)
    assert np.abs(noise_table(truth)).max() < 4.0


@pytest.mark.parametrize(
    "wrong", [{"read_noise_e": 5.8}, {"gain_e_per_count": 2.1}, {"background_e_px_s": 84.0}]
)
def test_the_noise_test_notices_a_wrong_sensor(wrong: dict[str, float]) -> None:
    truth = Sensor(gain_e_per_count=2.0, offset_counts=300.0, read_noise_e=6.0)
    assert np.abs(noise_table(truth.replace(**wrong))).max() > 8.0


@pytest.mark.parametrize("mean", [0.02, 1.3, 10.0, 240.0, 3000.0])
def test_shot_noise_is_poisson(mean: float) -> None:
    drawn = uniform_shot_noise(mean, (400, 1000), np.random.default_rng(5)).ravel()
    low, high = stats.poisson.ppf([1e-4, 1.0 - 1e-4], mean).astype(int)
    edges = np.unique(np.linspace(low, high, 30).astype(int))
    share = np.diff(np.concatenate([[0.0], stats.poisson.cdf(edges, mean), [1.0]]))
    count = np.bincount(np.searchsorted(edges, drawn), minlength=len(edges) + 1)
    kept = share * drawn.size > 5.0
    chi2 = np.sum((count[kept] - share[kept] * drawn.size) ** 2 / (share[kept] * drawn.size))
    assert stats.chi2.sf(chi2, max(1, kept.sum() - 1)) > 1e-4
    wrong = stats.poisson.cdf(edges, mean * 1.02 + 0.002)
    wrong_share = np.diff(np.concatenate([[0.0], wrong, [1.0]]))
    wrong_chi2 = np.sum(
        (count[kept] - wrong_share[kept] * drawn.size) ** 2 / (wrong_share[kept] * drawn.size)
    )
    assert stats.chi2.sf(wrong_chi2, max(1, kept.sum() - 1)) < 1e-4


def test_the_default_star_of_magnitude_six_is_located_to_a_twentieth_of_a_pixel() -> None:
    snr, sigma_px = Sensor().star_accuracy(6.0)
    assert sigma_px == pytest.approx(0.05, rel=0.02)
    assert snr == pytest.approx(25.0, rel=0.02)
    assert float(Sensor().electrons(6.0)) == pytest.approx(1035.0, abs=1.0)


# --- electronics


def test_bright_stars_stop_at_the_full_well_and_at_the_end_of_the_converter() -> None:
    sky = sky_of([[70.0, 60.0]], mag=-3.0)
    full = render(sky, SMALL, ATTITUDE, Sensor())
    assert full.data.max() >= Sensor().saturation_counts
    assert full.data.max() < Sensor().max_counts
    end = render(sky, SMALL, ATTITUDE, Sensor(bits=8, offset_counts=5.0))
    assert end.data.max() == 255 == end.truth.sensor.saturation_counts
    assert end.data.dtype == np.uint16
    faint = render(sky_of([[70.0, 60.0]], mag=3.0), SMALL, ATTITUDE, Sensor())
    assert faint.data.max() < Sensor().saturation_counts


def test_counts_do_not_become_negative() -> None:
    frame = render(
        sky_of([[70.0, 60.0]]), SMALL, ATTITUDE, Sensor(offset_counts=0.0, read_noise_e=40.0)
    )
    assert frame.data.min() == 0 and frame.data.max() < 4095


def test_quantisation_rounds_the_unquantised_frame() -> None:
    sky = sky_of([[70.3, 60.4]])
    fine = render(sky, SMALL, ATTITUDE, Sensor(), noise=False, quantise=False).data
    coarse = render(sky, SMALL, ATTITUDE, Sensor(), noise=False).data
    assert np.array_equal(coarse, np.rint(fine))


def test_hot_pixels_stay_in_their_places() -> None:
    sensor = Sensor(hot_pixel_fraction=1e-3, hot_pixel_e_s=50_000.0)
    sky = sky_of([[-90.0, 20.0]])
    where, level = sensor.hot_pixels(SMALL.width_px, SMALL.height_px)
    assert len(where) == 30 and len(np.unique(where)) == 30
    first, second = (
        render(sky, SMALL, ATTITUDE, sensor, seed=seed).data.ravel() for seed in (1, 2)
    )
    clear = where[level > 400.0]
    assert set(clear) == {i for i in np.flatnonzero(first > 140) if i in set(where[level > 400.0])}
    assert np.all(first[clear] > 140) and np.all(second[clear] > 140)
    other = sensor.replace(hot_pixel_seed=1).hot_pixels(SMALL.width_px, SMALL.height_px)[0]
    assert len(np.intersect1d(where, other)) < 5


def test_a_seed_repeats_bit_for_bit() -> None:
    sky = sky_of([[70.0, 60.0]])
    one, again, other, next_frame = (
        render(sky, SMALL, ATTITUDE, seed=seed, frame=frame).data
        for seed, frame in ((1, 0), (1, 0), (2, 0), (1, 1))
    )
    assert np.array_equal(one, again)
    assert not np.array_equal(one, other) and not np.array_equal(one, next_frame)
    rngs = [np.random.default_rng(4) for _ in range(2)]
    assert np.array_equal(*(render(sky, SMALL, ATTITUDE, seed=rng).data for rng in rngs))


def test_rendering_is_quick_beyond_its_noise_arrays(stars: StarCatalogue) -> None:
    camera = paper_camera()
    rotation = random_rotations(1, np.random.default_rng(1))[0]
    rng = np.random.default_rng(2)
    # Everything but the noise takes half as long as one array of it.
    ratio = times_as_long(
        lambda: render(stars, camera, rotation, noise=False),
        lambda: rng.standard_normal((camera.height_px, camera.width_px)),
        repeats=8,
    )
    assert ratio < 1.5


# --- the sensor


def test_a_psf_radius_becomes_a_sigma() -> None:
    assert Sensor.from_psf_radius(2.0).psf_sigma_px == pytest.approx(1.0)
    half = Sensor.from_psf_radius(2.0, fraction=0.5, exposure_s=0.2)
    assert half.psf_sigma_px == pytest.approx(2.0 / 1.17741, rel=1e-5)
    assert half.exposure_s == 0.2
    with pytest.raises(SensorError):
        Sensor.from_psf_radius(2.0, fraction=1.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "[sensor]\npsf_sigma_px = 0",
            "psf_sigma_px is 0; write a number of pixels from 0.1 to 100",
        ),
        ("[sensor]\nbits = 17", "bits is 17; write a whole number from 1 to 16"),
        ("[sensor]\nread_noise_e = -1", "write a number of electrons, 0 or more"),
        ('[sensor]\npsf = "moffat"', "write one of 'gaussian', 'sampled'"),
    ],
)
def test_a_bad_sensor_file_is_named_with_its_key(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "sensor.toml"
    path.write_text(text)
    with pytest.raises(SensorError, match=message) as caught:
        Sensor.load(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value).split("(")[0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rotation": np.zeros((3, 3))}, "no rotation"),
        ({"rate_rad_s": [1.0, 2.0]}, "three finite numbers"),
        ({"rate_rad_s": [10.0, 0.0, 0.0]}, "more than the detector"),
        ({"time_utc": "tonight"}, "no time"),
    ],
)
def test_what_cannot_be_rendered_is_said(options: dict[str, Any], message: str) -> None:
    rotation = options.pop("rotation", ATTITUDE)
    with pytest.raises((SensorError, SettingError), match=message):
        render(sky_of([[70.0, 60.0]]), SMALL, rotation, **options)


# --- files


def test_frames_are_those_of_the_simulation(stars: StarCatalogue, tmp_path: Path) -> None:
    camera, done = paper_camera(), []
    paths = render_frames(
        stars,
        camera,
        tmp_path / "frames",
        n_frames=3,
        seed=5,
        progress=lambda *step: done.append(step),
    )
    assert [path.name for path in paths] == [
        "frame_00000.fits",
        "frame_00001.fits",
        "frame_00002.fits",
    ]
    assert done == [(1, 3), (2, 3), (3, 3)]
    table = truth_table(paths)
    seen = simulate(stars, camera, n_frames=3, seed=5)
    # A star nearer than 0.3 px to the edge is in the truth and not in the simulation.
    inner = np.isin(table.star_id, seen.star_id)
    assert inner.sum() == len(seen) >= len(table) - 1
    assert np.abs(table.xy[inner] - seen.xy).max() < 0.05 * 6.0
    assert table.meta["truth"] == camera.to_dict()
    table.check(camera)


def test_a_file_carries_the_truth_of_its_frame(tmp_path: Path) -> None:
    from astropy.io import fits

    sensor = Sensor(hot_pixel_fraction=1e-3, bits=14, psf_sigma_px=1.1)
    frame = render(
        sky_of([[70.3, 60.2], [20.0, 30.0]]),
        SMALL,
        ATTITUDE,
        sensor,
        seed=3,
        frame=12,
        rate_rad_s=[1e-4, 2e-4, 3e-4],
        time_utc="2026-11-21T01:02:03.500000",
    )
    path = tmp_path / "frame.fits"
    write_frame(frame, path)
    truth = read_truth(path)
    assert (truth.camera, truth.sensor) == (SMALL, sensor)
    assert (truth.frame, truth.seed, truth.time_utc) == (12, 3, "2026-11-21T01:02:03.500000")
    for name in ("star_id", "ra_deg", "dec_deg", "mag", "x_px", "y_px", "electrons", "rate_rad_s"):
        assert np.array_equal(getattr(truth, name), getattr(frame.truth, name)), name
    assert np.abs(rotation_vector(truth.rotation @ ATTITUDE.T)).max() < 1e-14
    assert truth.observations.time_utc is not None
    # The header repeats the frame: everything that the noise depends on is in it.
    repeated = render(
        sky_of([[70.3, 60.2], [20.0, 30.0]]),
        truth.camera,
        ATTITUDE,
        truth.sensor,
        seed=truth.seed or 0,
        frame=truth.frame,
        rate_rad_s=truth.rate_rad_s,
    )
    assert np.array_equal(repeated.data, frame.data)
    with fits.open(path) as hdus:
        assert hdus[0].header["BZERO"] == 32768 and hdus[0].header["BITPIX"] == 16
        hdus.verify("exception")
    image = read_image(path, SMALL)
    assert image.data.dtype == np.uint16 and np.array_equal(image.data, frame.data)
    assert image.time_utc == truth.time_utc and image.exposure_s == sensor.exposure_s
    assert (
        image.saturation == sensor.saturation_counts
        and image.gain_e_per_count == sensor.gain_e_per_count
    )
    assert frame.image.saturation == image.saturation


def test_frames_repeat_to_the_byte(tmp_path: Path) -> None:
    sky = sky_of([[70.3, 60.2], [20.0, 30.0], [120.0, 110.0]])
    kwargs: dict[str, Any] = {
        "min_stars": 3,
        "attitudes": np.array([ATTITUDE, ATTITUDE]),
        "seed": 4,
    }
    one = render_frames(sky, SMALL, tmp_path / "one", **kwargs)
    two = render_frames(sky, SMALL, tmp_path / "two", **kwargs)
    assert [path.read_bytes() for path in one] == [path.read_bytes() for path in two]
    assert one[0].read_bytes() != one[1].read_bytes()
    assert sorted(os.listdir(tmp_path / "one")) == ["frame_00000.fits", "frame_00001.fits"]


def test_times_and_rates_go_to_their_frames(tmp_path: Path) -> None:
    sky = sky_of([[70.3, 60.2], [20.0, 30.0], [120.0, 110.0]])
    kwargs: dict[str, Any] = {"min_stars": 3, "attitudes": np.array([ATTITUDE, ATTITUDE])}
    rates = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0]])
    times = ["2026-11-21T01:02:03", "2026-11-21T01:02:04Z"]
    paths = render_frames(sky, SMALL, tmp_path / "a", rates_rad_s=rates, times_utc=times, **kwargs)
    truths = [read_truth(path) for path in paths]
    assert [truth.time_utc for truth in truths] == [
        "2026-11-21T01:02:03.000000",
        "2026-11-21T01:02:04.000000",
    ]
    assert np.array_equal([truth.rate_rad_s for truth in truths], rates)
    assert list(truth_table(paths).time_utc)[::3] == [
        "2026-11-21T01:02:03.000000",
        "2026-11-21T01:02:04.000000",
    ]  # type: ignore[arg-type]
    for bad, message in (
        ({"rates_rad_s": [1.0]}, "shape"),
        ({"times_utc": times[:1]}, "1 times for 2 frames"),
        ({"times_utc": ["noon", "night"]}, "no time"),
        ({"times_utc": [times[0], "2026-11-21T01:02:04+01:00"]}, "time zone"),
    ):
        with pytest.raises((SensorError, SettingError), match=message):
            render_frames(sky, SMALL, tmp_path / "b", **kwargs, **bad)
    with pytest.raises(CatalogueError):
        render_frames(sky, SMALL, tmp_path / "b", **{**kwargs, "min_stars": 4})
    assert not (tmp_path / "b").exists()


def test_frames_are_not_written_over_or_among_others(tmp_path: Path) -> None:
    sky = sky_of([[70.3, 60.2], [20.0, 30.0], [120.0, 110.0]])
    two = np.array([ATTITUDE, ATTITUDE])
    paths = render_frames(sky, SMALL, tmp_path, min_stars=3, attitudes=two)
    with pytest.raises(RunFolderError):
        render_frames(sky, SMALL, tmp_path, min_stars=3, attitudes=two)
    assert render_frames(sky, SMALL, tmp_path, min_stars=3, attitudes=two, force=True) == paths
    with pytest.raises(RunFolderError, match="1 other frame"):
        render_frames(sky, SMALL, tmp_path, min_stars=3, attitudes=two[:1], force=True)
    (tmp_path / "file").write_text("")
    with pytest.raises(RunFolderError, match="is a file, not a folder"):
        render_frames(sky, SMALL, tmp_path / "file", min_stars=3, attitudes=two)


def test_an_unquantised_frame_can_be_written(tmp_path: Path) -> None:
    frame = render(sky_of([[70.3, 60.2]]), SMALL, ATTITUDE, LIGHT, noise=False, quantise=False)
    write_frame(frame, tmp_path / "light.fits")
    assert read_truth(tmp_path / "light.fits").seed is None
    assert np.allclose(read_image(tmp_path / "light.fits").data, frame.data, rtol=1e-6)


def test_a_file_without_truth_is_refused(tmp_path: Path) -> None:
    from astropy.io import fits

    with pytest.raises(ImageError):
        read_truth(tmp_path / "none.fits")
    fits.PrimaryHDU(np.zeros((4, 5), dtype=np.uint16)).writeto(tmp_path / "plain.fits")
    with pytest.raises(ImageError):
        read_truth(tmp_path / "plain.fits")
    frame = render(sky_of([[70.3, 60.2]]), SMALL, ATTITUDE)
    assert isinstance(frame, RenderedFrame)
    write_frame(frame, tmp_path / "whole.fits")
    data = (tmp_path / "whole.fits").read_bytes()
    (tmp_path / "half.fits").write_bytes(data[: len(data) // 2])
    (tmp_path / "text.fits").write_text("no image")
    for name in ("half.fits", "text.fits"):
        with pytest.raises(ImageError, match=name):
            read_truth(tmp_path / name)
    with pytest.raises(ImageError):
        truth_table([])
