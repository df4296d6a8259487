"""Spectrum of the attitude error along a slew, against SciPy's periodograms of attitudes solved
here.
"""

import dataclasses
from functools import lru_cache

import numpy as np
import pytest

from starcal_uq.attitude.rotations import left_error
from starcal_uq.attitude.wahba import quest
from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.camera.projection import unproject_theta
from starcal_uq.core.errors import AttitudeProfileError, SamplingError
from starcal_uq.observations.table import Observations
from starcal_uq.propagation.propagate import propagate
from starcal_uq.propagation.spectrum import ErrorSpectrum, error_spectrum
from starcal_uq.simulation.mission import profile_frames
from starcal_uq.sky.catalogue import load_catalogue
from tests.helpers.gaussian_camera import gaussian_posterior
from tests.helpers.profiles import slew
from tests.helpers.scenes import camera, nominal, observations

ARCSEC = 648_000.0 / np.pi


@lru_cache
def posterior(n: int = 2000, scale: float = 1.0):
    return gaussian_posterior(calibrate(observations(), nominal(camera())), n=n, scale=scale)


@lru_cache
def frames(rate_deg_s: float = 0.1, n: int = 601, max_mag: float = 6.0) -> Observations:
    """One frame per second along a slew."""
    stars = load_catalogue(max_mag=max_mag, epoch=2026.9)
    return profile_frames(stars, camera(), slew(n, 1.0, rate_deg_s=rate_deg_s, seed=2))


@lru_cache
def spectrum(rate_deg_s: float = 0.1) -> ErrorSpectrum:
    return error_spectrum(posterior(), frames(rate_deg_s), n_draws=20)


def rest_of_draws(post, obs: Observations) -> np.ndarray:
    """Frame-dependent part (D, K, 3) of all draws, arcsec."""

    def solve(theta: np.ndarray) -> np.ndarray:
        b = unproject_theta("brown", theta, obs.xy)
        return quest(b, obs.directions_icrs, obs.frame_starts).quaternions

    phi = ARCSEC * np.stack(
        [left_error(solve(theta), solve(post.mean)) for theta in post.theta_draws]
    )
    return phi - phi.mean(axis=1, keepdims=True)


@pytest.mark.parametrize("n", [601, 600])
@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_is_the_mean_periodogram_of_the_draws(n: int, scale: float) -> None:
    from scipy.signal import periodogram

    post, obs = posterior(40, scale), frames(n=n)
    found = error_spectrum(post, obs, n_draws=40)
    rest = rest_of_draws(post, obs)
    f, psd = periodogram(rest, fs=1.0, axis=1, detrend=False)
    # First order gives the posterior's covariance, with one draw less in the divisor, and no mean
    # of draws.
    shift = rest.mean(axis=0)
    expected = (psd.sum(axis=0) - 40 * periodogram(shift, fs=1.0, axis=0, detrend=False)[1])[
        1:
    ] / 39.0
    np.testing.assert_allclose(found.frequency_hz, f[1:], rtol=1e-12)
    tolerance = 1e-4 if scale == 1.0 else 0.06
    top = expected.max(axis=0)
    share = np.abs(found.psd_arcsec2_hz - expected) / top
    assert share.max() < tolerance


def test_integral_is_the_variance_and_that_of_the_table() -> None:
    found = spectrum()
    integral_arcsec2 = found.psd_arcsec2_hz.sum(axis=0) * found.frequency_hz[0]
    np.testing.assert_allclose(integral_arcsec2, found.variance_arcsec2, rtol=1e-10)
    table = propagate(posterior(), frames())
    # The spectrum has what changes along the profile.
    changing = np.sqrt(table.rest_arcsec**2 - table.rest_constant_arcsec**2)
    np.testing.assert_allclose(found.rest_arcsec, changing, rtol=1e-3)
    np.testing.assert_allclose(found.nea_arcsec, table.nea_arcsec, rtol=1e-5)
    np.testing.assert_allclose(
        np.sqrt(np.mean(found.sigma_arcsec**2, axis=0)), found.rest_arcsec, rtol=1e-3
    )
    # The floor of white noise holds the variance of a frame over all frequencies.
    np.testing.assert_allclose(found.nea_psd_arcsec2_hz * 0.5, found.nea_arcsec**2, rtol=1e-12)
    np.testing.assert_allclose(found.share_below(1.0), 1.0)


def test_correlation_is_that_of_the_draws() -> None:
    post, obs = posterior(40), frames()
    found = error_spectrum(post, obs, n_draws=40)
    rest = rest_of_draws(post, obs)
    for lag in (1, 10, 100):
        expected = np.mean(
            rest[:, lag:] * rest[:, : len(found.time_s) - lag], axis=(0, 1)
        ) / np.mean(rest**2, (0, 1))
        np.testing.assert_allclose(found.autocorrelation[lag], expected, atol=0.03)


def test_gaps_are_bridged_and_said() -> None:
    obs, whole = frames(), spectrum()
    kept = np.random.default_rng(4).random(obs.n_frames) > 0.05
    kept[[0, -1]] = True
    part = obs.select(kept[obs.frame])
    found = error_spectrum(posterior(), part, np.flatnonzero(kept).astype(float), n_draws=5)
    assert found.gap_share == pytest.approx(1.0 - kept.mean())
    np.testing.assert_allclose(found.time_s, np.arange(601.0), atol=1e-9)
    np.testing.assert_allclose(found.rest_arcsec, whole.rest_arcsec, rtol=0.02)
    slow, slow_of_whole = (s.rest_arcsec * np.sqrt(s.share_below(0.02)) for s in (found, whole))
    np.testing.assert_allclose(slow, slow_of_whole, rtol=0.03)
    assert "were interpolated" in found.text
    assert "interpolated" not in whole.text
    # The first frame of a series counts from zero whatever its number.
    late = dataclasses.replace(part, frame=part.frame + 7)
    again = error_spectrum(posterior(), late, 1e3 + np.flatnonzero(kept), n_draws=5)
    np.testing.assert_allclose(again.psd_arcsec2_hz, found.psd_arcsec2_hz, rtol=1e-12)
    # Half the rate, over the same time.
    thin = obs.select(obs.frame % 2 == 0)
    half = error_spectrum(posterior(), thin, np.arange(0.0, 601.0, 2.0), n_draws=5)
    assert half.longest_average_s == pytest.approx(whole.longest_average_s, rel=0.01)


def test_times_that_are_no_series_are_refused() -> None:
    post, obs = posterior(), frames()
    for table, times, message in (
        (observations(), None, "these frames carry no times"),
        (obs, np.arange(600.0), r"has shape \(600,\), but there are 601 frames"),
        (obs, np.arange(601.0)[::-1], "increase from frame to frame"),
    ):
        with pytest.raises(AttitudeProfileError, match=message):
            error_spectrum(post, table, times)
    with pytest.raises(SamplingError):
        error_spectrum(post, obs, n_draws=1)
    # Times rounded to milliseconds are still a series.
    rounded = error_spectrum(post, obs, np.round(np.arange(601) / 3.0, 3), n_draws=5)
    assert rounded.step_s == pytest.approx(1.0 / 3.0, rel=1e-5)


def test_slower_frames_have_the_same_errors_at_lower_frequencies() -> None:
    post, obs = posterior(), frames()
    one, four = (
        error_spectrum(post, obs, step * np.arange(601.0), n_draws=5) for step in (1.0, 4.0)
    )
    np.testing.assert_allclose(4.0 * four.frequency_hz, one.frequency_hz, rtol=1e-12)
    for density in ("psd_arcsec2_hz", "nea_psd_arcsec2_hz"):
        np.testing.assert_allclose(getattr(four, density), 4.0 * getattr(one, density), rtol=1e-9)
    np.testing.assert_allclose(four.lag_s, 4.0 * one.lag_s, rtol=1e-12)
    np.testing.assert_allclose(four.autocorrelation, one.autocorrelation, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(four.variance_arcsec2, one.variance_arcsec2)


def test_a_camera_without_error_has_no_spectrum() -> None:
    post = posterior(10, 1e-9)
    post.theta_draws[:] = post.draws[:, :-1] = post.mean
    post.covariance = np.zeros((5, 5))
    found = error_spectrum(post, frames(), n_draws=5)
    assert np.isnan(found.correlation_time_s).all() or (found.rest_arcsec < 1e-6).all()
    assert (
        "no frame-dependent part" in dataclasses.replace(found, variance_arcsec2=np.zeros(3)).text
    )
    found.plot.spectrum()


def test_limits_of_a_series() -> None:
    """Sixteen frames, a fifth of them missing at most, and times off by a twentieth of a step."""
    post, obs = posterior(40), frames()
    some = obs.select(obs.frame < 16)
    assert len(error_spectrum(post, some, np.arange(16.0), n_draws=2).frequency_hz) == 8
    with pytest.raises(AttitudeProfileError, match="at least 16 frames, not 15"):
        error_spectrum(post, obs.select(obs.frame < 15), np.arange(15.0), n_draws=2)
    for off in (0.045, -0.045, 0.055, -0.055):
        times = np.arange(16.0)
        times[7] += off
        if abs(off) > 0.05:
            with pytest.raises(AttitudeProfileError, match="not evenly spaced"):
                error_spectrum(post, some, times, n_draws=2)
            continue
        found = error_spectrum(post, some, 3.0 * times, n_draws=2)
        np.testing.assert_allclose(found.time_s, 3.0 * np.arange(16.0), rtol=1e-12)
        assert (found.step_s, found.gap_share, found.n_draws) == (3.0, 0.0, 2)
    found = error_spectrum(post, some, np.append(np.arange(15.0), 19.0), n_draws=2)
    assert found.gap_share == pytest.approx(4 / 20)
    for last, message in (
        (20.0, r"5 of 21 evenly .*longest gap begins at 14 s"),
        (np.inf, "must be finite"),
    ):
        with pytest.raises(AttitudeProfileError, match=message):
            error_spectrum(post, some, np.append(np.arange(15.0), last), n_draws=2)


def test_figures_of_a_spectrum_are_those_of_its_numbers() -> None:
    """A density by hand: shares, averages, crossings and the table."""
    found = dataclasses.replace(
        spectrum(),
        frequency_hz=np.array([0.1, 0.2, 0.3]),
        psd_arcsec2_hz=np.array([[4.0, 1.0, 0.0], [2.0, 1.0, 0.0], [2.0, 2.0, 0.0]]),
        nea_psd_arcsec2_hz=np.array([1.0, 2.0, 3.0]),
        nea_arcsec=np.array([2.0, 1e-6, 1.0]),
        step_s=1.0,
        time_s=np.arange(20.0),
        lag_s=np.array([0.0, 1.0, 2.0]),
        autocorrelation=np.array([[1.0, 1.0, 0.1], [0.6, 0.5, 0.2], [0.2, 0.4, 0.3]]),
    )
    np.testing.assert_allclose(found.share_below(0.2), [0.75, 0.5, np.nan])
    e = np.exp(-1.0)
    np.testing.assert_allclose(found.correlation_time_s, [1.0 + (0.6 - e) / 0.4, np.nan, np.nan])
    assert found.longest_average_s == 5.0 and found.axes == ("pitch", "yaw", "roll")
    # Four frames: their mean passes a sum of phases over four.
    phases = np.exp(2j * np.pi * np.outer(found.frequency_hz, np.arange(4.0)))
    passed = np.abs(phases.mean(axis=1)) ** 2
    rest, noise = found.averaged_arcsec(4.0)
    np.testing.assert_allclose(rest, np.sqrt(0.1 * passed @ found.psd_arcsec2_hz), rtol=1e-9)
    np.testing.assert_allclose(noise, found.nea_arcsec / 2.0, rtol=1e-12)
    np.testing.assert_allclose(found.dominates_after_s, [np.nan, 1.0, np.nan])
    for seconds in (1.0 - 1e-12, 5.0 + 1e-12):
        found.averaged_arcsec(seconds)
    for seconds in (0.999, 5.001):
        with pytest.raises(ValueError, match="choose 1 s to 5 s"):
            found.averaged_arcsec(seconds)
    # Sixty times, evenly in their logarithm: where noise is overtaken is good to that.
    level = dataclasses.replace(found, nea_arcsec=np.sqrt(2.0) * found.averaged_arcsec(2.0)[0])
    times = np.geomspace(1.0, 5.0, 60)
    later = [
        next((t for t in times if np.greater(*level.averaged_arcsec(t))[axis]), np.nan)
        for axis in range(2)
    ]
    np.testing.assert_array_equal(level.dominates_after_s[:2], later)
    table = found.to_dataframe()
    assert table["frequency_hz"].tolist() == [0.1] * 3 + [0.2] * 3 + [0.3] * 3
    assert table["axis"].tolist() == ["pitch", "yaw", "roll"] * 3
    assert table["rest_arcsec2_hz"].tolist() == found.psd_arcsec2_hz.ravel().tolist()
    assert table["nea_arcsec2_hz"].tolist() == [1.0, 2.0, 3.0] * 3
