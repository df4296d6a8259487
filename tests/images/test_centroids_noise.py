"""The stated noise of centroids where stars are no round Gaussians, the gain is not given, or
pixels are coarse.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import erf

from starcal_uq.images import background as photon_transfer
from starcal_uq.images import fits as windowed_centroids
from starcal_uq.images import psf as psf_measurement
from starcal_uq.images.background import counts_per_electron
from starcal_uq.images.extract import extract_centroids
from starcal_uq.images.image import Image
from starcal_uq.images.pixel_phase import phase_error, without_phase_error

BACKGROUND_E, READ_NOISE_E, HALF, SUB = 50.0, 5.0, 12, 11
STEPS = np.arange(-HALF, HALF + 1)


def line(centre, sigma):
    edges = np.arange(-HALF, HALF + 2) - 0.5
    return 0.5 * np.diff(erf((edges - centre) / (np.sqrt(2.0) * sigma)))


def gaussian(x, y, sx, sy):
    return np.outer(line(y, sy), line(x, sx))


def moffat(x, y):
    """Beta 3, full width at half maximum 1.6 px."""
    at = (np.arange((2 * HALF + 1) * SUB) + 0.5) / SUB - 0.5 - HALF
    fine = (1.0 + ((at - x) ** 2 + (at[:, None] - y) ** 2) / 1.6**2) ** -3.0
    return (
        fine.reshape(2 * HALF + 1, SUB, 2 * HALF + 1, SUB).sum((1, 3))
        * 2.0
        / (np.pi * 1.6**2)
        / SUB**2
    )


SHAPES = {
    "moffat": moffat,
    "wings": lambda x, y: 0.7 * gaussian(x, y, 0.6, 0.6) + 0.3 * gaussian(x, y, 1.8, 1.8),
    "elongated": lambda x, y: gaussian(x, y, 0.8, 1.4),
    "elongated with wings": lambda x, y: (
        0.7 * gaussian(x, y, 0.6, 1.0) + 0.3 * gaussian(x, y, 1.8, 2.4)
    ),
    "sharp": lambda x, y: (
        0.15 * gaussian(x, y, 0.15, 0.15)
        + 0.6 * gaussian(x, y, 0.75, 0.75)
        + 0.25 * gaussian(x, y, 2.0, 2.0)
    ),
}


@cache
def scene(shape, n_frames, seed=3):
    """Frames of stars from barely found to bright, a sixth of them bright, and the true places."""
    rng = np.random.default_rng(seed)
    images, places = [], []
    for k in range(n_frames):
        at = 18.0 + 28.0 * np.arange(17)
        xy = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2) + rng.uniform(
            -0.5, 0.5, (289, 2)
        )
        flux = np.where(np.arange(289) % 6 == 0, 2e4, 10.0 ** rng.uniform(2.6, 3.7, 289))
        expected = np.full((512, 512), BACKGROUND_E)
        for (x, y), f in zip(xy, flux, strict=True):
            i, j = round(x), round(y)
            expected[j - HALF : j + HALF + 1, i - HALF : i + HALF + 1] += f * SHAPES[shape](
                x - i, y - j
            )
        counts = rng.poisson(expected) + rng.normal(0.0, READ_NOISE_E, expected.shape)
        images.append(Image(counts.astype(np.float32), f"frame {k}"))
        places.append(xy)
    return images, places


def errors(centroids, places):
    """Row of each star found, and its error."""
    rows, error = [], []
    for k, xy in enumerate(places):
        here = np.flatnonzero((centroids.frame == k) & ~centroids.blended)
        distance, index = cKDTree(xy).query(centroids.xy[here])
        near = distance < 1.5
        rows.append(here[near])
        error.append((centroids.xy[here] - xy[index])[near])
    return np.concatenate(rows), np.concatenate(error)


def chi2_by_snr(shape, bins=((8, 15), (15, 30), (30, 60))):
    """Mean square of error over stated sigma, by signal-to-noise ratio and axis, and the number of
    stars in each.
    """
    images, places = scene(shape, 4)
    found = extract_centroids(images, gain_e_per_count=1.0)
    rows, error = errors(found, places)
    z2 = error**2 / np.column_stack([found.var_x_px2, found.var_y_px2])[rows]
    parts = [z2[(found.snr[rows] >= low) & (found.snr[rows] < high)] for low, high in bins]
    return (
        np.array([part.mean(axis=0) for part in parts]),
        np.array([len(part) for part in parts]),
        found,
    )


@pytest.mark.parametrize("shape", ["moffat", "wings", "elongated", "elongated with wings"])
def test_the_stated_noise_of_windowed_centroids_is_the_scatter(shape):
    chi2, n, found = chi2_by_snr(shape)
    assert any("windowed" in text for text in found.messages) and n.min() > 90
    # Four standard deviations of a chi square per degree; the shape adds a little to the brighter
    # ones.
    assert np.all(np.abs(chi2 - 1.0) < 4.0 * np.sqrt(2.0 / n)[:, None])
    assert np.average(chi2.mean(axis=1), weights=n) == pytest.approx(1.0, abs=0.12)


@pytest.mark.parametrize("shape", ["moffat", "wings"])
def test_a_factor_of_two_for_every_window_states_too_much(shape, monkeypatch):
    """The control: errors by SExtractor's formula, which holds for a window as wide as the star."""
    half = lambda sums, window, fit, alone: np.tile(0.5 * np.eye(2), (len(window), 1, 1))  # noqa: E731
    monkeypatch.setattr(windowed_centroids, "_window_gradient", half)
    chi2, n, _ = chi2_by_snr(shape)
    assert np.average(chi2.mean(axis=1), weights=n) < 0.7


def test_a_round_fit_of_elongated_stars_states_the_wrong_noise_in_both_axes(monkeypatch):
    monkeypatch.setattr(psf_measurement, "_ELONGATED", 99.0)
    chi2, n, found = chi2_by_snr("elongated")
    assert not any("windowed" in text for text in found.messages)
    x, y = np.average(chi2, axis=0, weights=n)
    assert x < 0.75 and y > 1.3


def test_round_gaussians_are_never_windowed():
    rng = np.random.default_rng(5)
    for sigma in (0.6, 0.8, 1.2):
        for n_stars in (15, 100):
            xy = rng.uniform(20, 490, (n_stars, 2))
            expected = np.full((512, 512), BACKGROUND_E)
            for (x, y), f in zip(xy, 10.0 ** rng.uniform(3.0, 4.5, n_stars), strict=True):
                i, j = round(x), round(y)
                star = f * gaussian(x - i, y - j, sigma, sigma)
                expected[j - HALF : j + HALF + 1, i - HALF : i + HALF + 1] += star
            found = extract_centroids(
                Image(rng.poisson(expected).astype(np.uint16), "round"), gain_e_per_count=1.0
            )
            assert not any("windowed" in text for text in found.messages)


# --- the gain from the noise of the background


def vignetted(rng, gain, *, drop=0.3, bias=100.0, size=768):
    """Electrons of a bright background that falls towards the corners, and its counts."""
    v, u = np.mgrid[:size, :size] / (0.5 * size) - 1.0
    expected = 2000.0 * (1.0 - drop * 0.5 * (u**2 + v**2))
    return expected, lambda e: np.rint(
        bias + (rng.poisson(e) + rng.normal(0.0, 5.0, e.shape)) / gain
    ).astype(np.uint16)


@pytest.mark.parametrize("gain", [0.15, 0.5, 2.0])
def test_the_gain_is_read_off_an_uneven_background(gain):
    expected, exposed = vignetted(np.random.default_rng(1), gain)
    assert 1.0 / counts_per_electron(exposed(expected).astype(np.float32)) == pytest.approx(
        gain, rel=0.1
    )


def test_no_gain_is_read_off_where_the_background_does_not_say_it():
    rng = np.random.default_rng(2)
    for _ in range(20):
        expected, exposed = vignetted(rng, 0.5, drop=0.0)
        assert counts_per_electron(exposed(expected).astype(np.float32)) == 0.0
    # Uneven, but with the same noise everywhere; small; nothing at all.
    expected, _ = vignetted(rng, 0.5)
    assert (
        counts_per_electron((expected + rng.normal(0.0, 30.0, expected.shape)).astype(np.float32))
        == 0.0
    )
    expected, exposed = vignetted(rng, 0.5, size=256)
    assert counts_per_electron(exposed(expected).astype(np.float32)) == 0.0
    assert counts_per_electron(np.zeros((768, 768), np.float32)) == 0.0


def test_the_measured_gain_gives_bright_stars_their_photon_noise(monkeypatch):
    rng = np.random.default_rng(4)
    expected, exposed = vignetted(rng, 0.5)
    for x, y in rng.uniform(20, 740, (60, 2)):
        i, j = round(x), round(y)
        expected[j - HALF : j + HALF + 1, i - HALF : i + HALF + 1] += 4e4 * gaussian(
            x - i, y - j, 1.0, 1.0
        )
    image = Image(exposed(expected), "bright")
    given, measured = extract_centroids(image, gain_e_per_count=0.5), extract_centroids(image)
    assert measured.n_stars == given.n_stars
    np.testing.assert_allclose(np.median(measured.sigma_px), np.median(given.sigma_px), rtol=0.06)
    assert measured.meta["flux_unit"] == "counts" and measured.meta[
        "gain_from_noise_e_per_count"
    ] == pytest.approx(0.5, rel=0.1)
    assert any(
        "noise of the background says 0.5" in t or "noise of the background says 0.4" in t
        for t in measured.messages
    )
    assert given.meta["gain_from_noise_e_per_count"] is None
    monkeypatch.setattr(photon_transfer, "_LARGEST_ERROR", 0.0)
    without = extract_centroids(image)
    assert np.median(without.sigma_px) < 0.8 * np.median(given.sigma_px)
    assert any("gain is unknown" in text for text in without.messages)


# --- errors by pixel phase


def test_sharp_stars_lose_their_error_by_pixel_phase():
    images, places = scene("sharp", 6)
    result = {}
    for correct in (False, True):
        found = extract_centroids(images, gain_e_per_count=1.0, correct_pixel_phase=correct)
        rows, error = errors(found, places)
        bright = found.snr[rows] > 30
        true = (found.xy[rows] - error)[bright]
        wave = 2.0 * np.mean(error[bright] * np.sin(2.0 * np.pi * true), axis=0)
        result[correct] = wave, np.sqrt(np.mean(error[bright] ** 2)), found
    before, after = result[False], result[True]
    assert np.all(before[0] < -0.03) and not any("crowd" in text for text in before[2].messages)
    assert np.all(np.abs(after[0]) < 0.5 * np.abs(before[0])) and after[1] < 0.8 * before[1]
    assert any("crowd" in text for text in after[2].messages)
    assert (
        before[2].meta["pixel_phase_px"] == [0.0, 0.0]
        and min(after[2].meta["pixel_phase_px"]) > 0.02
    )


def test_places_that_are_even_have_no_error_and_crowded_ones_have_theirs():
    rng = np.random.default_rng(6)
    false = 0
    for _ in range(200):
        x, y = rng.uniform(0, 1000, (2, 500))
        false += phase_error(x, y).amplitude_px != 0.0
    assert false == 0
    true, y = rng.uniform(0, 1000, (2, 4000))
    crowded = true - 0.06 * np.sin(2.0 * np.pi * true)
    found = phase_error(crowded, y)
    assert found.amplitude_px == pytest.approx(0.06, abs=4.0 * found.sigma_px)
    back, factor = without_phase_error(crowded, np.zeros(4000), 0.06)
    np.testing.assert_allclose(back, true, atol=1e-6)
    assert phase_error(true + 0.06 * np.sin(2.0 * np.pi * true), y).amplitude_px == 0.0
    # The noise of the position put back is the noise of the one measured over the slope.
    np.testing.assert_allclose(
        factor, 1.0 / (1.0 - 2.0 * np.pi * 0.06 * np.cos(2.0 * np.pi * true)), rtol=1e-4
    )
    assert np.all(
        np.abs(without_phase_error(crowded, np.full(4000, 0.25), 0.06)[0] - crowded) < 1e-3
    )


def test_a_camera_that_stares_shows_its_stars_once():
    rng = np.random.default_rng(7)
    # Twenty stars that happen to lie near the centres of their pixels, in three hundred frames.
    star = rng.integers(10, 990, (20, 2)) + rng.uniform(-0.2, 0.2, (20, 2))
    x, y = (np.tile(star, (300, 1)) + rng.normal(0.0, 0.05, (6000, 2))).T
    assert phase_error(x, y).amplitude_px == 0.0
    assert np.cos(2.0 * np.pi * x).mean() > 4.0 * np.sqrt(0.5 / 6000)
    assert phase_error(x[:0], y[:0]).amplitude_px == 0.0


# --- the real sky


def residuals(frame, x, y, ra_deg, dec_deg, sigma):
    """Residuals in pixels of one camera (centre, focal length, k1) with free attitudes, and their
    share of freedom.
    """
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    star = np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    n = frame.max() + 1
    seen = np.column_stack([x - 517.0, y - 390.0, np.full(len(x), 5116.0)])
    start = [Rotation.align_vectors(seen[frame == k], star[frame == k])[0] for k in range(n)]

    def rest(p):
        turns = Rotation.concatenate(
            [Rotation.from_rotvec(p[4 + 3 * k : 7 + 3 * k]) * start[k] for k in range(n)]
        )
        b = turns[frame].apply(star)
        u, v = b[:, 0] / b[:, 2], b[:, 1] / b[:, 2]
        stretch = p[2] * (1.0 + p[3] * (u * u + v * v))
        return np.column_stack([x - p[0] - stretch * u, y - p[1] - stretch * v])

    p0 = np.r_[517.0, 390.0, 5116.0, 0.1, np.zeros(3 * n)]
    scale = np.r_[1.0, 1.0, 1.0, 0.1, np.full(3 * n, 1e-4)]
    fit = least_squares(
        lambda p: (rest(p) / sigma[:, None]).ravel(), p0, x_scale=scale, loss="soft_l1"
    )
    return rest(fit.x), 1.0 - len(p0) / (2.0 * len(x))


def real_errors(real_data, **options):
    """Residuals of the real stars, their stated sigma and signal-to-noise ratio, and the table."""
    known = pd.read_csv(real_data / "esa_tetra3_observations.csv")
    found = extract_centroids(real_data / "esa-tetra3", **options)
    rows = np.full(len(known), -1)
    for k, name in enumerate(found.image.tolist()):
        here, theirs = np.flatnonzero(found.frame == k), np.flatnonzero(known.image == name)
        distance, index = cKDTree(found.xy[here]).query(known[["x_px", "y_px"]].to_numpy()[theirs])
        rows[theirs[distance < 1.5]] = here[index[distance < 1.5]]
    use = rows >= 0
    use[use] = ~(found.blended | found.saturated | found.edge)[rows[use]]
    rows, known = rows[use], known[use]
    ra, dec = known.ra_apparent_deg.to_numpy(), known.dec_apparent_deg.to_numpy()
    sigma = found.sigma_px[rows]
    error, free = residuals(
        found.frame[rows], found.x_px[rows], found.y_px[rows], ra, dec, np.hypot(sigma, 0.04)
    )
    return error / np.sqrt(free), sigma, found.snr[rows], found, rows


def wave(found, rows, error, snr):
    """Amplitudes in x and y of the sine of the pixel phase in the residuals."""
    use = snr > 12
    return 2.0 * np.mean(error[use] * np.sin(2.0 * np.pi * found.xy[rows][use]), axis=0)


def test_the_stated_noise_of_real_frames_is_what_a_calibration_leaves(real_data):
    error, sigma, snr, found, rows = real_errors(real_data)
    assert found.meta["gain_from_noise_e_per_count"] == pytest.approx(0.165, rel=0.05)
    # 0.03 px (1.2 arcsec) stay that no noise of the pixels explains: the air, the shape of the
    # stars, faint neighbours.
    limit = np.median(np.abs(error[snr > 80])) / 0.6745
    assert 0.01 < limit < 0.05
    for low, high, tolerance in ((8, 12, 0.3), (12, 20, 0.12), (20, 40, 0.15)):
        here = (snr >= low) & (snr < high)
        # By the median, for one star in fifty has a neighbour that pulls it.
        ratio = np.median(np.abs(error[here]) / np.hypot(sigma[here], limit)[:, None]) / 0.6745
        assert ratio == pytest.approx(1.0, abs=tolerance)
    assert np.all(np.abs(wave(found, rows, error, snr)) < 0.02)


def test_real_frames_have_an_error_by_pixel_phase_that_is_taken_out(real_data):
    """The control: what the calibration finds in the same frames without the correction."""
    error, _, snr, found, rows = real_errors(real_data, correct_pixel_phase=False)
    assert np.all(wave(found, rows, error, snr) < -0.025)
    corrected = extract_centroids(real_data / "esa-tetra3")
    # What the places alone say is what the residuals of the calibration say.
    assert np.all(
        np.abs(np.array(corrected.meta["pixel_phase_px"]) + wave(found, rows, error, snr)) < 0.03
    )
