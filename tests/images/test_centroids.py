"""Images read from files, and the centroids measured in them."""

from __future__ import annotations

from collections import Counter
from functools import cache

import numpy as np
import pandas as pd
import PIL.Image
import pytest
import scipy.ndimage
from scipy.spatial import cKDTree
from scipy.special import erf

from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import ImageError, ObservationError, RunFolderError
from starcal_uq.identification.result import FrameIdentification, Identification
from starcal_uq.images import detection
from starcal_uq.images import fits as star_fits
from starcal_uq.images.background import prepare_image
from starcal_uq.images.centroids import COLUMNS, FRAME_COLUMNS, Centroids
from starcal_uq.images.extract import extract_centroids
from starcal_uq.images.image import Image
from starcal_uq.images.read import read_image
from tests.helpers.speed import sort_a_million, times_as_long

sep, fits = (
    pytest.importorskip(name, reason="the extra images is not installed")
    for name in ("sep", "astropy.io.fits")
)

BACKGROUND_E, READ_NOISE_E = 50.0, 5.0


def line(centre, sigma, first, n):
    """Fractions of a Gaussian's light in pixels first, first + 1, ..."""
    edges = first + np.arange(n + 1) - 0.5
    return 0.5 * np.diff(erf((edges - centre) / (np.sqrt(2.0) * sigma)))


def sky(xy, flux, sigma, shape=(512, 512)):
    """Expected electrons of stars on the background; stars near the border lose what lies
    outside.
    """
    h = int(np.ceil(6.0 * sigma)) + 2
    image = np.zeros((shape[0] + 2 * h, shape[1] + 2 * h))
    for (x, y), f in zip(xy, np.broadcast_to(flux, len(xy)), strict=True):
        i, j = round(x) - h, round(y) - h
        star = f * line(y, sigma, j, 2 * h + 1)[:, None] * line(x, sigma, i, 2 * h + 1)
        image[j + h : j + 3 * h + 1, i + h : i + 3 * h + 1] += star
    return image[h:-h, h:-h] + BACKGROUND_E


def noisy(expected, rng, gain=1.0):
    return ((rng.poisson(expected) + rng.normal(0.0, READ_NOISE_E, expected.shape)) / gain).astype(
        np.float32
    )


def bound(flux, sigma):
    """Cramer-Rao bound of x (standard deviation, mean over pixel phases), and the SNR of the
    flux.
    """
    h, d = int(np.ceil(6.0 * sigma)) + 1, 1e-4
    covariances = []
    for u in np.linspace(-0.4, 0.4, 5):
        for v in np.linspace(-0.4, 0.4, 5):
            px, py = line(u, sigma, -h, 2 * h + 1), line(v, sigma, -h, 2 * h + 1)
            dx = (line(u + d, sigma, -h, 2 * h + 1) - line(u - d, sigma, -h, 2 * h + 1)) / (2 * d)
            dy = (line(v + d, sigma, -h, 2 * h + 1) - line(v - d, sigma, -h, 2 * h + 1)) / (2 * d)
            design = np.stack(
                [flux * np.outer(py, dx), flux * np.outer(dy, px), np.outer(py, px)]
            ).reshape(3, -1)
            variance = flux * design[2] + BACKGROUND_E + READ_NOISE_E**2
            covariances.append(np.diag(np.linalg.inv((design / variance) @ design.T)))
    x, _, f = np.mean(covariances, axis=0)
    return np.sqrt(x), flux / np.sqrt(f)


def flux_for(snr, sigma):
    low, high = 1.0, 1e8
    for _ in range(50):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if bound(middle, sigma)[1] < snr else (low, middle)
    return low


def grid(rng, n=21, pitch=24.0):
    """Places of n x n stars at random pixel phases."""
    at = 16.0 + pitch * np.arange(n)
    return np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2) + rng.uniform(
        -0.5, 0.5, (n * n, 2)
    )


def matched(centroids, xy, reach=2.0):
    """Rows of `centroids` near a true place, and the error of each."""
    distance, index = cKDTree(xy).query(centroids.xy)
    rows = np.flatnonzero(distance < reach)
    return rows, centroids.xy[rows] - xy[index[rows]]


def moments(image, xy, reach=5):
    """Plain first moments, without a window: what is not good enough."""
    found = []
    counts = image - np.median(image)
    for x, y in xy:
        i, j = round(x), round(y)
        part = counts[j - reach : j + reach + 1, i - reach : i + reach + 1]
        rows, columns = np.mgrid[j - reach : j + reach + 1, i - reach : i + reach + 1]
        found.append([(part * columns).sum() / part.sum(), (part * rows).sum() / part.sum()])
    return np.array(found)


@cache
def trial(snr, sigma):
    rng = np.random.default_rng([int(snr), int(10 * sigma)])
    xy = grid(rng)
    image = noisy(sky(xy, flux_for(snr, sigma), sigma), rng)
    return xy, image, extract_centroids(Image(image, "trial"), gain_e_per_count=1.0)


# --- accuracy


@pytest.mark.parametrize(
    ("snr", "sigma"), [(10, 0.8), (10, 2.0), (30, 1.2), (100, 2.0), (300, 0.8), (300, 1.2)]
)
def test_scatter_is_near_the_cramer_rao_bound_and_is_predicted(snr, sigma):
    xy, _, centroids = trial(snr, sigma)
    rows, error = matched(centroids, xy)
    assert len(rows) > 0.97 * len(xy)
    rms = np.sqrt(np.mean(error**2))
    # 882 numbers: their rms is known to 2.4 %.
    assert rms / bound(flux_for(snr, sigma), sigma)[0] < 1.15
    assert rms / np.sqrt(np.mean(centroids.sigma_px[rows] ** 2)) == pytest.approx(1.0, abs=0.1)
    assert np.median(centroids.snr[rows]) == pytest.approx(snr, rel=0.1)


@pytest.mark.parametrize("snr", [30, 300])
def test_plain_moments_miss_the_bound(snr):
    """The control: the same frames, and what the test above would say of a moment."""
    xy, image, _ = trial(snr, 1.2)
    error = moments(image, xy) - xy
    assert 1.4826 * np.median(np.abs(error)) / bound(flux_for(snr, 1.2), 1.2)[0] > 1.2


def phase_errors(sigma):
    phase = np.linspace(-0.5, 0.5, 21)
    n = len(phase)
    at = 16.0 + 24.0 * np.arange(n)
    xy = np.stack([np.tile(at + phase, n), np.repeat(at + 0.3, n)], axis=-1)
    # As good as without noise: 1e8 electrons, of which 1e4 make one count.
    image = sky(xy, 1e8, sigma) / 1e4 + np.random.default_rng(5).normal(0.0, 0.01, (512, 512))
    return xy, image, phase


@pytest.mark.parametrize("sigma", [0.8, 1.5, 2.5])
def test_there_is_no_error_by_pixel_phase(sigma):
    xy, image, _ = phase_errors(sigma)
    rows, error = matched(extract_centroids(Image(image, "phases")), xy)
    assert len(rows) == len(xy)
    assert np.abs(error).max() < 0.002


def test_a_window_of_nine_pixels_has_an_error_by_pixel_phase():
    xy, image, phase = phase_errors(0.8)
    error = (moments(image, xy, reach=1) - xy)[:, 0].reshape(-1, len(phase)).mean(axis=0)
    assert np.abs(error).max() > 0.01


def test_without_gain_counts_are_reported_and_a_message_says_what_is_missing():
    _, image, known = trial(300, 1.2)
    unknown = extract_centroids(Image(image, "trial"))
    assert unknown.meta["flux_unit"] == "counts" and known.meta["flux_unit"] == "electrons"
    assert "gain is unknown" in unknown.messages[-1] and not any(
        "gain" in text for text in known.messages
    )
    assert np.median(unknown.sigma_px) < 0.8 * np.median(known.sigma_px)


def test_the_gain_scales_fluxes_and_not_positions():
    rng = np.random.default_rng(8)
    xy = grid(rng, 8, 60.0)
    electrons = noisy(sky(xy, 5000.0, 1.1), rng)
    one = extract_centroids(Image(electrons, "e"), gain_e_per_count=1.0)
    four = extract_centroids(Image(electrons / 4, "c", gain_e_per_count=4.0))
    np.testing.assert_allclose(one.xy, four.xy, atol=1e-3)
    np.testing.assert_allclose(one.flux, four.flux, rtol=1e-3)
    np.testing.assert_allclose(one.sigma_px, four.sigma_px, rtol=1e-2)


def test_a_large_frame_takes_a_moment():
    rng = np.random.default_rng(2)
    xy = rng.uniform(20, 1000, (15, 2))
    counts = (
        noisy(sky(xy, rng.uniform(2000, 30000, 15), 1.0, (1024, 1024)), rng)
        .clip(0)
        .astype(np.uint16)
    )
    image = Image(counts, "large", gain_e_per_count=1.0)
    assert len(matched(extract_centroids(image), xy)[0]) == 15
    # A third of it.
    assert times_as_long(lambda: extract_centroids(image), sort_a_million) < 1.2


def test_an_image_is_passed_over_once_and_stars_are_fitted_together(monkeypatch):
    rng = np.random.default_rng(21)
    xy = grid(rng)
    image = Image(noisy(sky(xy, flux_for(30, 1.2), 1.2), rng), "counted")
    passes, fits = Counter(), []

    def counted(name, original):
        def call(data, *rest, **options):
            passes[name] += np.size(data) == image.data.size
            return original(data, *rest, **options)

        return call

    for module, name in ((sep, "Background"), (sep, "extract"), (detection, "_filtered")):
        monkeypatch.setattr(module, name, counted(name, getattr(module, name)))
    solve = star_fits._solve
    monkeypatch.setattr(
        star_fits,
        "_solve",
        lambda normal, right: (fits.append(len(normal)), solve(normal, right))[1],
    )
    assert len(matched(extract_centroids(image, gain_e_per_count=1.0), xy)[0]) == len(xy)
    assert passes == {"Background": 1, "extract": 1, "_filtered": 1}
    # Width, shape and places: some ten steps for each star, all stars in one call.
    assert sum(fits) < 12 * len(xy) and len(fits) < 40


def test_detections_are_those_of_sextractor():
    """The filter along one axis after the other finds what SExtractor's finds, in a crowd too."""
    rng = np.random.default_rng(22)
    xy = rng.uniform(3, 252, (300, 2))
    image = Image(noisy(sky(xy, 10.0 ** rng.uniform(3.0, 5.0, 300), 1.2, (256, 256)), rng), "crowd")
    frame, _, _ = prepare_image(image, 1.0, None, None)
    ours = detection._detect(frame, "crowd", 1.2, detection.DetectionOptions())
    line_ = np.exp(-0.5 * (np.arange(-3, 4) / 1.2) ** 2)
    kernel = np.outer(line_, line_).astype(np.float32)
    threshold = 5.0 * np.sqrt(np.sum(kernel**2)) / kernel.sum()
    theirs = sep.extract(
        frame.counts,
        threshold,
        err=frame.noise,
        minarea=1,
        filter_kernel=kernel,
        filter_type="conv",
    )
    distance, index = cKDTree(np.column_stack([ours["x"], ours["y"]])).query(
        np.column_stack([theirs["x"], theirs["y"]])
    )
    same = distance < 1e-3
    # Cleaning weighs areas of the filtered image here: a detection at the foot of a bright one may
    # differ.
    assert len(ours) == pytest.approx(len(theirs), abs=3) and np.count_nonzero(~same) <= 3
    assert np.count_nonzero(theirs["flag"] & 1) > 50
    np.testing.assert_array_equal(ours["flag"][index[same]], theirs["flag"][same])
    # Which part gets a pixel between two is drawn by lot.
    lone = same & (theirs["flag"] & 1 == 0)
    np.testing.assert_allclose(ours["flux"][index[lone]], theirs["flux"][lone], rtol=1e-3)


@pytest.mark.parametrize("shape", [(64, 65), (130, 9), (3, 200)])
def test_the_filter_is_a_convolution_with_darkness_beyond_the_edges(shape):
    counts = np.random.default_rng(0).standard_normal(shape).astype(np.float32)
    line = np.array([0.1, 0.25, 0.3, 0.25, 0.1], dtype=np.float32)
    expected = scipy.ndimage.correlate(counts, np.outer(line, line), mode="constant")
    np.testing.assert_allclose(detection._filtered(counts, line), expected, atol=1e-6)


def test_windows_settle_where_sextractors_do():
    xy, image, found = trial(100, 2.0)
    frame, _, _ = prepare_image(Image(image, "window"), 1.0, None, None)
    start, width = found.xy[:, 0] + 0.2, np.full(len(found), 2.0)
    stamps = star_fits.cut_stamps(frame, start, found.xy[:, 1] - 0.2, 9)
    x, y, good = star_fits.window_positions(
        stamps, image.shape, start, found.xy[:, 1] - 0.2, np.hypot(width, 0.3), width, 2e-4
    )
    theirs = sep.winpos(frame.counts, start, found.xy[:, 1] - 0.2, np.hypot(width, 0.3))
    assert good.all() and len(good) == len(xy)
    np.testing.assert_allclose(
        np.hypot(x - theirs[0], y - theirs[1]), 0.0, atol=0.02 * found.sigma_px.max()
    )


# --- flags and rejections


@pytest.fixture(scope="module")
def stars():
    rng = np.random.default_rng(11)
    xy = grid(rng, 8, 60.0)
    return xy, sky(xy, 8000.0, 1.0), rng


def test_hot_pixels_and_cosmic_rays_are_no_stars(stars):
    xy, expected, rng = stars
    image = noisy(expected, rng)
    hot = np.array([[46, 46], [106, 166], [226, 286], [406, 46], [346, 226]])
    image[hot[:, 1], hot[:, 0]] += 3000.0
    image[410, 400:403] += 2000.0
    found = extract_centroids(Image(image, "hot"), gain_e_per_count=1.0)
    assert len(matched(found, xy)[0]) == len(xy) == len(found)
    assert "6 detections were left out" in found.messages[0] and "6 too sharp" in found.messages[0]


def test_a_blob_like_the_moon_is_no_star_and_the_stars_elsewhere_are_found(stars):
    xy, expected, rng = stars
    y, x = np.mgrid[:512, :512]
    image = noisy(expected + 4000.0 * (np.hypot(x - 250, y - 250) < 30), rng)
    found = extract_centroids(Image(image, "moon"), gain_e_per_count=1.0)
    far = np.hypot(*(xy - 250).T) > 100
    assert len(matched(found, xy[far])[0]) == far.sum()
    assert np.hypot(*(found.xy - 250).T).min() > 45
    assert "extended" in found.messages[0]


def test_saturated_stars_are_flagged_and_measured_from_their_wings(stars):
    xy, expected, rng = stars
    image = np.minimum(noisy(expected, rng), 600.0).round().astype(np.uint16)
    found = extract_centroids(Image(image, "sat", saturation=600.0), gain_e_per_count=1.0)
    rows, error = matched(found, xy)
    assert len(rows) == len(xy) and found.saturated.all() and found.peak.max() == 600.0
    z = error / found.sigma_px[rows, None]
    assert np.sqrt(np.mean(z**2)) < 1.4
    free = extract_centroids(
        Image(noisy(expected, rng), "free", saturation=60000.0), gain_e_per_count=1.0
    )
    assert not free.saturated.any() and found.sigma_px.mean() > 1.2 * free.sigma_px.mean()


def test_neighbours_are_flagged_and_do_not_pull(stars):
    rng = np.random.default_rng(4)
    lone = grid(rng, 8, 60.0)
    xy = np.concatenate([lone, lone[::2] + np.array([4.5, 0.0])])
    found = extract_centroids(
        Image(noisy(sky(xy, 8000.0, 1.0), rng), "pairs"), gain_e_per_count=1.0
    )
    rows, error = matched(found, xy)
    assert len(rows) == len(xy)
    index = cKDTree(xy).query(found.xy)[1]
    double = (index >= len(lone)) | (index % 2 == 0)
    np.testing.assert_array_equal(found.blended, double)
    assert np.sqrt(np.mean((error / found.sigma_px[:, None]) ** 2)) == pytest.approx(1.0, abs=0.15)


def test_stars_at_the_border_are_flagged():
    rng = np.random.default_rng(6)
    xy = np.array(
        [[0.7, 100.0], [510.5, 300.0], [250.0, 1.0], [250.0, 250.0], [100.0, 400.0], [400.0, 100.0]]
    )
    found = extract_centroids(Image(noisy(sky(xy, 9000.0, 1.0), rng), "edge"), gain_e_per_count=1.0)
    rows, error = matched(found, xy)
    assert len(rows) == 6 and np.abs(error).max() < 0.2
    assert found.edge.sum() == 3


def test_pixels_without_value_are_masked(stars):
    xy, expected, rng = stars
    image = noisy(expected, rng)
    image[:, 200] = np.nan
    image[300:310, 300:310] = np.nan
    rows, error = matched(extract_centroids(Image(image, "nan"), gain_e_per_count=1.0), xy)
    assert len(rows) > 0.85 * len(xy) and np.abs(error).max() < 0.2


def test_a_steep_background_is_no_noise(stars):
    xy, expected, rng = stars
    image = noisy(expected + np.linspace(0.0, 2000.0, 512), rng)
    found = extract_centroids(Image(image, "slope"), gain_e_per_count=1.0)
    rows, error = matched(found, xy)
    assert len(rows) == len(found) == len(xy)
    assert np.sqrt(np.mean((error / found.sigma_px[rows, None]) ** 2)) == pytest.approx(
        1.0, abs=0.2
    )


@pytest.mark.parametrize("offset", [2.5, 0.0])
def test_eight_bits_with_less_noise_than_a_count_or_cut_off_at_black(stars, offset):
    xy, expected, rng = stars
    counts = (
        (noisy(expected - BACKGROUND_E, rng) / 20.0 + offset).round().clip(0, 255).astype(np.uint8)
    )
    found = extract_centroids(Image(counts, "coarse"), gain_e_per_count=20.0)
    rows, error = matched(found, xy)
    assert len(rows) == len(xy) and len(found) <= len(xy) + 1 and found.messages == ()
    assert np.sqrt(np.mean((error / found.sigma_px[rows, None]) ** 2)) == pytest.approx(
        1.0, abs=0.3
    )


def test_undersampled_stars_with_halos_get_windowed_centroids():
    rng = np.random.default_rng(9)
    xy = grid(rng, 8, 60.0)
    halo = sky(xy, 12000.0, 1.8) - BACKGROUND_E
    found = extract_centroids(
        Image(noisy(sky(xy, 30000.0, 0.55) + halo, rng), "halo"), gain_e_per_count=1.0
    )
    assert "windowed" in found.messages[0]
    rows, error = matched(found, xy)
    assert len(rows) == len(xy) and np.abs(error).max() < 0.05
    assert np.sqrt(np.mean((error / found.sigma_px[rows, None]) ** 2)) < 1.3


def test_frames_that_cannot_be_used_are_left_out_and_the_others_go_on(stars, tmp_path):
    xy, expected, rng = stars
    camera = Camera(512, 512, 10.0, 50.0, 255.5, 255.5)
    good = noisy(expected, rng).clip(0).round().astype(np.uint16)
    fits.writeto(tmp_path / "a.fits", good)
    whole = (tmp_path / "a.fits").read_bytes()
    (tmp_path / "b.fits").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "c.fits").write_bytes(b"")
    (tmp_path / "d.png").write_text("no picture")
    fits.writeto(tmp_path / "e.fits", np.zeros((512, 512), np.uint16))
    fits.writeto(tmp_path / "f.fits", np.full((512, 512), 65535, np.uint16))
    fits.writeto(tmp_path / "g.fits", good[:256])
    fits.writeto(tmp_path / "h.fits", noisy(sky(xy[:0], 1.0, 1.0), rng))
    eight = np.clip(good / 4, 0, 255).astype(np.uint8)
    PIL.Image.fromarray(np.stack([eight, eight // 2, eight], axis=-1)).save(
        tmp_path / "i.jpg", quality=95
    )
    (tmp_path / "notes.txt").write_text("not an image, and not looked at")
    steps = []
    found = extract_centroids(
        tmp_path, camera=camera, progress=lambda done, total: steps.append((done, total))
    )
    assert steps == [(i + 1, 9) for i in range(9)]
    assert found.image.tolist() == [
        "a.fits",
        "b.fits",
        "c.fits",
        "d.png",
        "e.fits",
        "f.fits",
        "g.fits",
        "h.fits",
        "i.jpg",
    ]
    problem = dict(zip(found.image.tolist(), found.problem.tolist(), strict=True))
    assert problem["a.fits"] == problem["h.fits"] == problem["i.jpg"] == ""
    assert (
        "truncated" in problem["b.fits"]
        and "empty" in problem["c.fits"]
        and "not an image" in problem["d.png"]
    )
    assert problem["e.fits"] == "every pixel has the value 0"
    assert (
        "100 % of the pixels are saturated" in problem["f.fits"]
        and "512 x 256 px" in problem["g.fits"]
    )
    assert found.n_frames == 9 and found.n_left_out == 6
    counts = dict(zip(found.image.tolist(), found.stars_per_frame.tolist(), strict=True))
    assert counts["a.fits"] == 64 and counts["h.fits"] <= 1 and counts["i.jpg"] >= 60
    assert (
        "6 frames were left out: " in found.text
        and "1 because every pixel has the value 0" in found.text
    )
    assert any("luminance" in text for text in found.messages) and any(
        "JPEG" in text for text in found.messages
    )
    assert sum("was left out" in text for text in found.messages) == 6
    alone = extract_centroids(tmp_path / "a.fits", camera=camera)
    np.testing.assert_array_equal(alone.xy, found.select_frames([0]).xy)


# --- reading images


def test_fits_with_time_exposure_gain_and_saturation(tmp_path):
    header = fits.Header(
        {"DATE-OBS": "2026-11-21T01:02:03.5", "EXPTIME": 1.0, "SATURATE": 4000.0, "OBJECT": "sky"}
    )
    header["GAIN"] = 2.5, "[e-/ADU]"
    data = np.arange(12, dtype=np.float32).reshape(3, 4)
    for name in ("a.fits", "a.fit", "a.fits.gz"):
        fits.writeto(tmp_path / name, data, header)
        image = read_image(tmp_path / name)
        np.testing.assert_array_equal(image.data, data)
        assert image.time_utc == "2026-11-21T01:02:04.000000"
        assert (image.exposure_s, image.gain_e_per_count, image.saturation) == (1.0, 2.5, 4000.0)
        assert image.header["OBJECT"] == "sky" and image.name == name
    cube = tmp_path / "cube.fits"
    fits.writeto(cube, np.stack([data, data + 1]))
    assert "first of 2 planes" in read_image(cube).messages[0]
    data[1, 2] = np.nan
    fits.writeto(tmp_path / "nan.fits", data)
    assert "1 pixel without a value" in read_image(tmp_path / "nan.fits").messages[0]


def test_pictures_keep_their_bits(tmp_path):
    rng = np.random.default_rng(1)
    for dtype, endings in ((np.uint8, ("png", "tiff", "tif")), (np.uint16, ("png", "tiff"))):
        data = rng.integers(0, np.iinfo(dtype).max, (5, 7)).astype(dtype)
        for ending in endings:
            path = tmp_path / f"{np.dtype(dtype).name}.{ending}"
            PIL.Image.fromarray(data).save(path)
            image = read_image(path)
            np.testing.assert_array_equal(image.data, data)
            assert image.saturation == np.iinfo(dtype).max and image.messages == ()
    twelve = np.minimum(rng.integers(0, 6000, (50, 50)), 4095).astype(np.uint16)
    PIL.Image.fromarray(twelve).save(tmp_path / "twelve.png")
    assert read_image(tmp_path / "twelve.png").saturation == 4095.0


def test_errors_of_reading_are_sentences_with_a_remedy(tmp_path):
    (tmp_path / "a.xyz").write_text("a")
    (tmp_path / "fake.fits").write_text("no FITS")
    fits.writeto(tmp_path / "nan.fits", np.full((4, 4), np.nan))
    fits.PrimaryHDU().writeto(tmp_path / "header.fits")
    for name, words in {
        "a.xyz": "ending .xyz is unknown",
        "fake.fits": "not a FITS image",
        "nan.fits": "no pixel has a value",
        "header.fits": "holds no image",
    }.items():
        with pytest.raises(ImageError, match=words) as caught:
            read_image(tmp_path / name)
        assert str(caught.value).startswith(str(tmp_path / name)) and "; " in str(caught.value)


# --- the table


@pytest.fixture(scope="module")
def table(stars):
    _, expected, rng = stars
    images = [
        Image(noisy(expected, rng), "first, or so", time_utc="2026-11-21T01:02:03"),
        Image(np.zeros((9, 9)), "zeros"),
        Image(noisy(expected, rng), "third"),
    ]
    return extract_centroids(images, gain_e_per_count=1.0)


@pytest.mark.parametrize("ending", ["csv", "ecsv", "parquet"])
def test_files_lose_nothing(table, tmp_path, ending):
    for i, wanted in enumerate((table, table.select(np.zeros(len(table), dtype=bool)))):
        path = tmp_path / f"t{i}.{ending}"
        wanted.save(path)
        again = Centroids.load(path)
        for name in (*COLUMNS, *FRAME_COLUMNS):
            np.testing.assert_array_equal(getattr(again, name), getattr(wanted, name))
            assert getattr(again, name).dtype.kind == getattr(wanted, name).dtype.kind
        assert again.messages == wanted.messages and again.meta == wanted.meta
        with pytest.raises(RunFolderError):
            wanted.save(path)


def test_the_table_and_its_frames(table):
    assert (
        table.n_frames == 3
        and table.n_left_out == 1
        and table.stars_per_frame.tolist() == [64, 0, 64]
    )
    assert table.frame_starts.tolist() == [0, 64, 64, 128]
    assert table.text.startswith(
        "128 stars in 2 frames; 1 frame was left out: 1 because every pixel"
    )
    assert np.isnan(table.noise[1]) and table.time_utc.tolist() == ["2026-11-21T01:02:03", "", ""]
    assert np.all(np.diff(table.flux[:64]) <= 0)
    assert table.select_frames([1, 2]).stars_per_frame.tolist() == [0, 64]
    assert (
        list(table.to_dataframe().columns) == list(COLUMNS) and len(table.frames_dataframe()) == 3
    )
    assert "first, or so" in table._repr_html_() and "128 stars" in repr(table)
    np.testing.assert_allclose(table.var_x_px2 + table.var_y_px2, 2 * table.sigma_px**2)
    assert not table.x_px.flags.writeable
    with pytest.raises(ObservationError):
        table.select([1, 2])
    with pytest.raises(ObservationError):
        table.select_frames([7])


# --- the real sky


def test_real_frames_agree_with_the_independent_centroids(real_data):
    camera = Camera.load(real_data / "esa_tetra3_camera.toml")
    known = pd.read_csv(real_data / "esa_tetra3_observations.csv")
    found = extract_centroids(real_data / "esa-tetra3", camera=camera)
    assert found.n_frames == 8 and found.n_left_out == 0
    difference = np.full((len(known), 2), np.nan)
    for frame, name in enumerate(found.image.tolist()):
        mine, theirs = found.select_frames([frame]), np.flatnonzero(known.image == name)
        xy = known[["x_px", "y_px"]].to_numpy()[theirs]
        distance, index = cKDTree(mine.xy).query(xy)
        near = distance < 1.5
        difference[theirs[near]] = (mine.xy[index] - xy)[near]
    assert np.count_nonzero(np.isfinite(difference[:, 0])) >= 560
    bright = known.snr.to_numpy() >= 20.0
    size = np.hypot(*difference[bright].T)
    assert np.isfinite(size).all() and np.median(size) < 0.05
    assert np.sqrt(np.mean(size**2)) < 0.05


def test_coarse_counts_give_no_false_stars():
    # A background of a few electrons behind a gain of 4: the median of the counts is off by a
    # quarter of a count.
    rng = np.random.default_rng(1)
    n = 0
    for _ in range(4):
        data = np.round(
            60.0 + rng.poisson(25.0, (1024, 1024)) / 4.0 + rng.normal(0.0, 0.9, (1024, 1024))
        )
        n += extract_centroids(Image(data=data.astype(np.uint16), name="dark")).n_stars
    assert n <= 6


# --- what headers and folders may do


@pytest.mark.parametrize(
    ("header", "time", "words"),
    [
        ({"DATE-OBS": "2019-07-29T22:47:26+02:00"}, "2019-07-29T20:47:26.000000", None),
        (
            {"DATE-OBS": "2019-07-29T22:47:26+02:00", "EXPTIME": 3.0},
            "2019-07-29T20:47:27.500000",
            None,
        ),
        ({"DATE-OBS": "2019-07-29", "TIME-OBS": "20:47:26"}, "2019-07-29T20:47:26.000000", None),
        ({"DATE-OBS": "2019-07-29T20:47:26", "TIMESYS": "UTC"}, "2019-07-29T20:47:26.000000", None),
        # 37 leap seconds since 2017, 10 before 1972-07-01.
        ({"DATE-OBS": "2019-07-29T20:48:03", "TIMESYS": "TAI"}, "2019-07-29T20:47:26.000000", None),
        ({"DATE-OBS": "1972-01-02T00:00:10", "TIMESYS": "tai"}, "1972-01-02T00:00:00.000000", None),
        ({"DATE-OBS": "2019-07-29T20:47:44", "TIMESYS": "GPS"}, "2019-07-29T20:47:26.000000", None),
        (
            {"DATE-AVG": "2019-07-29T20:48:35.184", "TIMESYS": "TT(BIPM)"},
            "2019-07-29T20:47:26.000000",
            None,
        ),
        (
            {"DATE-OBS": "2019-07-29T20:47:26", "TIMESYS": "LOCAL"},
            None,
            "a.fits: DATE-OBS is in LOCAL by TIMESYS",
        ),
        (
            {"DATE-OBS": "1858-11-17T00:00:00"},
            None,
            "a.fits: DATE-OBS is of the year 1858, not of 1960 to 2100",
        ),
        ({"DATE-OBS": "0001-01-01T00:00:00+02:00"}, None, "a.fits: DATE-OBS is of the year 1,"),
        ({"DATE-OBS": "2019-07-29T20:47:26", "EXPTIME": 1e300}, None, None),
        ({"DATE-OBS": "29/07/19"}, None, None),
    ],
)
def test_times_of_headers_become_utc(tmp_path, header, time, words):
    fits.writeto(tmp_path / "a.fits", np.ones((4, 5), np.int16), fits.Header(header))
    image = read_image(tmp_path / "a.fits")
    assert image.time_utc == time
    assert len(image.messages) == (words is not None)
    assert all(message.startswith(words) for message in image.messages)


def test_the_time_in_a_name_replaces_an_impossible_one(tmp_path):
    path = tmp_path / "2019-07-29T204726.fits"
    fits.writeto(path, np.ones((4, 5), np.int16), fits.Header({"DATE-OBS": "1858-11-17T00:00:00"}))
    assert read_image(path).time_utc == "2019-07-29T20:47:26"


def test_the_science_image_is_taken_rather_than_its_preview(tmp_path):
    science = np.arange(48 * 64, dtype=np.int16).reshape(48, 64)
    preview, first, big = (
        fits.ImageHDU(science[::8, ::8]),
        fits.PrimaryHDU(),
        fits.ImageHDU(np.ones((99, 99))),
    )
    first.header["DATE-OBS"] = "2019-07-29T20:47:26"
    path = tmp_path / "a.fits"
    fits.HDUList([first, preview, fits.ImageHDU(science), fits.ImageHDU(science + 1)]).writeto(path)
    camera = Camera(64, 48, 10.0, 50.0, 31.5, 23.5)
    for image in (read_image(path), read_image(path, camera)):
        np.testing.assert_array_equal(image.data, science)
        assert image.messages == (
            "a.fits: of 3 images in the file, the one of 64 x 48 px in HDU 2 was taken.",
        )
        # The first header holds for all images.
        assert image.time_utc == "2019-07-29T20:47:26.000000" and image.header["NAXIS1"] == 64
    fits.HDUList([first, preview, fits.ImageHDU(science), big]).writeto(path, overwrite=True)
    assert read_image(path).data.shape == (99, 99)
    np.testing.assert_array_equal(read_image(path, camera).data, science)
    assert extract_centroids(path, camera=camera).problem[0] != "the image is 99 x 99 px"
    # Bytes after the images do no harm; an image that is cut short is not replaced by its preview.
    fits.writeto(path, science, overwrite=True)
    path.write_bytes(path.read_bytes() + 2880 * b"x")
    np.testing.assert_array_equal(read_image(path).data, science)
    fits.HDUList([first, preview, fits.ImageHDU(science)]).writeto(path, overwrite=True)
    path.write_bytes(path.read_bytes()[:-4000])
    with pytest.raises(ImageError):
        read_image(path)


def test_a_folder_of_subfolders_says_that_they_are_not_searched(tmp_path):
    (tmp_path / "inner").mkdir()
    fits.writeto(tmp_path / "inner" / "a.fits", np.ones((4, 5), np.int16))
    with pytest.raises(ImageError, match=r"holds no image .* subfolders are not searched"):
        extract_centroids(tmp_path)


@pytest.mark.parametrize(
    ("statuses", "n_left_out", "words"),
    [
        (["identified"], 0, "1 of 1 frame is identified, with 5.0 stars on average."),
        (
            ["identified", "too few stars"],
            1,
            "1 of 1 frame is identified, with 5.0 stars on average.",
        ),
        (
            ["identified"] * 2 + ["too few stars"] * 3,
            1,
            "Left out: 2 with fewer than four centroids.",
        ),
        (["identified"] * 2 + ["ambiguous"], 0, "2 of 3 frames are identified"),
        (["not identified"], 0, "0 of 1 frame is identified. Left out: 1 in which"),
        (["not identified"] * 2, 0, "0 of 2 frames are identified. Left out: 2 in which"),
    ],
)
def test_frames_left_out_before_are_not_counted_again(statuses, n_left_out, words):
    frames = tuple(
        FrameIdentification(
            k, "", status, 5, 5 * (status == "identified"), 0, 0, np.nan, None, 1.0, 1.0, 1.0, 1.0
        )
        for k, status in enumerate(statuses)
    )
    camera = Camera(64, 48, 10.0, 50.0, 31.5, 23.5)
    found = Identification(None, frames, camera, camera, "normal", n_left_out)
    assert words in found.text
    assert n_left_out == 0 or len(statuses) > 2 or "Left out" not in found.text
