"""Centroid noise of a sensor: against images that NumPy draws, textbook formulas and the photon
limit.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import SensorError
from starcal_uq.planning.plan import plan
from starcal_uq.simulation.frames import Tracker
from starcal_uq.simulation.sensor import Sensor
from tests.helpers.pinhole import ARCSEC, FOCAL_PX, attitude_variance, directions, on_detector

SHEET = sc.Camera(1024, 1024, 10.0, 36.0, 511.5, 511.5, "none", ())
QUIET = {
    "background_e_px_s": 0.0,
    "dark_e_px_s": 0.0,
    "read_noise_e": 0.0,
    "gain_e_per_count": 0.01,
}
NARROW = {
    **QUIET,
    "aperture_mm": 1.0,
    "psf_sigma_px": 0.4,
    "gain_e_per_count": 0.5,
    "full_well_e": 1e12,
    "rate_deg_s": 0.0,
    "age_years": 0.0,
}
# A tracker of 20 mm that is worn and turns.
WORN = Sensor(
    aperture_mm=20.0,
    transmission=0.7,
    quantum_efficiency=0.5,
    exposure_s=0.1,
    rate_deg_s=0.3,
    age_years=10.0,
    transmission_loss_per_year=0.03,
    dark_growth_e_px_s=200.0,
    bits=16,
)


def photons_s(aperture_mm: float) -> float:
    """Photons per second of a star of G = 0 from 400 to 900 nm: 3631 Jy, dimmed by what separates
    Vega's system from the AB system in G.
    """
    wavelength = np.linspace(400e-9, 900e-9, 20_001)
    watt_m2_hz = 3631e-26 * 10.0 ** (-0.4 * 0.1136)
    per_metre = watt_m2_hz / (6.62607015e-34 * wavelength)
    return float(np.trapezoid(per_metre, wavelength) * math.pi * (aperture_mm / 2000.0) ** 2)


def erf_profile(centre: float, sigma: float, n: int) -> np.ndarray:
    edges = (np.arange(n + 1) - 0.5 - centre) / (math.sqrt(2.0) * sigma)
    return 0.5 * np.diff([math.erf(edge) for edge in edges])


def drawn_errors(mag: float, n: int, seed: int, smear_px: float, sensor: Sensor) -> np.ndarray:
    """Errors (n, 2) of weighted fits of a Gaussian to images of a star that moves along x."""
    rng = np.random.default_rng(seed)
    electrons = (
        photons_s(sensor.aperture_mm)
        * sensor.transmission
        * sensor.quantum_efficiency
        * (1.0 - sensor.transmission_loss_per_year) ** sensor.age_years
        * sensor.exposure_s
        * 10.0 ** (-0.4 * mag)
    )
    dark = sensor.dark_e_px_s + sensor.age_years * sensor.dark_growth_e_px_s
    uniform = (sensor.background_e_px_s + dark) * sensor.exposure_s
    size, wide = 31, math.hypot(sensor.psf_sigma_px, smear_px / math.sqrt(12.0))
    errors = []
    for place in 15.0 + (np.arange(4) - 1.5) / 4.0:
        along = np.mean(
            [
                erf_profile(place + shift, sensor.psf_sigma_px, size)
                for shift in smear_px * (np.arange(200) + 0.5 - 100.0) / 200.0
            ],
            axis=0,
        )
        across = erf_profile(15.1, sensor.psf_sigma_px, size)
        mean = electrons * np.outer(across, along) + uniform
        fitted = erf_profile(place, wide, size)
        slopes = [
            (erf_profile(place + 1e-4, wide, size) - erf_profile(place - 1e-4, wide, size)) / 2e-4,
            (
                erf_profile(15.1 + 1e-4, sensor.psf_sigma_px, size)
                - erf_profile(15.1 - 1e-4, sensor.psf_sigma_px, size)
            )
            / 2e-4,
        ]
        columns = electrons * np.stack(
            [np.outer(across, slopes[0]), np.outer(slopes[1], fitted)]
        ).reshape(2, -1)
        flux = np.outer(across, fitted).ravel()
        weight = 1.0 / (electrons * flux + uniform + sensor.read_noise_e**2)
        design = np.stack([*columns, flux], axis=1)
        solve = np.linalg.inv(design.T @ (weight[:, None] * design)) @ (design * weight[:, None]).T
        image = rng.poisson(
            mean, (n // 4, *mean.shape)
        ) + sensor.read_noise_e * rng.standard_normal((n // 4, *mean.shape))
        errors.append(((image - mean).reshape(n // 4, -1) @ solve.T)[:, :2])
    return np.concatenate(errors)


def test_photons_pass_aperture_optics_and_detector() -> None:
    wanted = photons_s(20.0) * 0.7 * 0.5
    assert WORN.zero_point_e_s == pytest.approx(wanted, rel=1e-6)
    # Liebe (2002) has 19,100 electrons per second and mm^2 of such a star; half the light detected.
    per_mm2 = photons_s(20.0) * 0.5 / (math.pi * 100.0)
    assert per_mm2 == pytest.approx(19_100, rel=0.1)
    assert float(WORN.electrons(3.0)) == pytest.approx(
        wanted * 0.97**10 * 0.1 * 10.0**-1.2, rel=1e-6
    )


@pytest.mark.parametrize("rate_deg_s", [0.0, 0.3])
def test_noise_is_the_scatter_of_fits_to_drawn_images(rate_deg_s: float) -> None:
    sensor = WORN.replace(rate_deg_s=rate_deg_s, gain_e_per_count=0.1, offset_counts=0.0)
    noise = sensor.noise(SHEET)
    assert noise.smear_px == pytest.approx(FOCAL_PX * math.radians(rate_deg_s) * 0.1)
    errors = drawn_errors(5.0, 4000, 1, noise.smear_px, sensor)
    found = math.sqrt(np.mean(errors**2))
    stated = float(noise(np.array([5.0]))[0])
    # 8000 numbers determine the scatter to 0.8 %; a moving star's image is no Gaussian.
    assert stated == pytest.approx(found, rel=0.03 if rate_deg_s == 0.0 else 0.06)
    # Control: the noise of the new sensor at rest is another.
    new = WORN.replace(age_years=0.0, rate_deg_s=0.0).noise(SHEET)
    assert float(new(np.array([5.0]))[0]) < 0.9 * found


def test_bright_and_faint_stars_follow_thompson_larson_and_webb() -> None:
    """s^2 / N for photons, 8 pi s^4 b^2 / N^2 for what is in every pixel; s of the pixelated image."""
    sensor = Sensor(psf_sigma_px=1.5, full_well_e=1e9, bits=16, gain_e_per_count=0.01)
    s2 = 1.5**2 + 1.0 / 12.0
    for mag, share in ((-5.0, 1.0), (11.0, 0.0)):
        n = float(sensor.electrons(mag))
        wanted = s2 / n if share else 8.0 * math.pi * s2**2 * sensor.pixel_variance_e2 / n**2
        assert float(sensor.star_accuracy(mag)[1]) == pytest.approx(math.sqrt(wanted), rel=0.03)


def test_photons_alone_leave_the_width_over_their_root() -> None:
    sensor = Sensor(psf_sigma_px=1.2, full_well_e=1e12, bits=16, **QUIET)
    mag = np.linspace(0.0, 8.0, 9)
    ratio = sensor.star_accuracy(mag)[1] / (1.2 / np.sqrt(sensor.electrons(mag)))
    assert np.all(ratio >= 1.0) and np.all(ratio < 1.05)


def test_a_star_that_saturates_is_located_no_better_than_one_that_does_not() -> None:
    noise = WORN.noise(SHEET)
    at = noise.brightest_mag
    several = noise(np.array([at - 3.0, at, at + 1.0]))
    assert several[0] == several[1] < several[2]


# --- the photon limit


def limits(sensor: Sensor, stars: sc.StarCatalogue, n_frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Photon limit (3,) of the noise-equivalent angle of frames, arcsec, and that of the plan.

    Every photon tells a direction to lambda / (pi D) per axis, by Heisenberg's principle for a
    round aperture (Fialho & Mortari 2019); information adds up over photons and stars.
    """
    r = directions(stars.ra_deg, stars.dec_deg)
    noise = sensor.noise(SHEET)
    tracker = Tracker(SHEET, noise, 5)
    rotations, _ = tracker.frames(stars, np.random.default_rng(5), n_frames)
    wavelength = np.linspace(400e-9, 900e-9, 20_001)
    inverse_square = np.trapezoid(wavelength**-3.0, wavelength) / np.log(900.0 / 400.0)
    detected = photons_s(sensor.aperture_mm) * sensor.transmission * sensor.quantum_efficiency
    electrons = detected * sensor.exposure_s * 10.0 ** (-0.4 * stars.mag)
    width_px = FOCAL_PX / (math.pi * sensor.aperture_mm * 1e-3 * math.sqrt(inverse_square))
    margin = 6.0 * float(noise(np.array([stars.mag.max()]))[0])
    variances = []
    for rotation in rotations:
        seen = on_detector(r, stars.mag, rotation, margin)
        variances.append(
            attitude_variance(r[seen] @ rotation.T, width_px / np.sqrt(electrons[seen]))
        )
    found = plan(
        SHEET, stars, sigma_px=noise, min_stars=5, sweeps=False, n_geometries=n_frames, seed=5
    )
    return ARCSEC * np.sqrt(np.mean(variances, axis=0)), found.nea_arcsec


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"rate_deg_s": 0.0, "age_years": 0.0},
        # A width that no aperture of 1 mm makes, and no other noise: the limit itself.
        NARROW,
    ],
)
def test_no_tracker_is_better_than_its_photons(changes: dict[str, float]) -> None:
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    sensor = WORN.replace(**changes)
    limit, nea = limits(sensor, stars, 100)
    assert np.all(nea >= (1.0 - 1e-6) * limit)


def test_a_doctored_noise_is_found_below_the_limit() -> None:
    """Control: the same sheet without its aperture, so that nothing knows of diffraction."""
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    narrow = WORN.replace(**NARROW)
    doctored = Sensor.from_dict(
        narrow.to_dict() | {"aperture_mm": 0.0, "transmission": 1.0, "quantum_efficiency": 1.0}
    )
    limit, nea = limits(narrow, stars, 100)
    found = plan(
        *(SHEET, stars),
        sigma_px=doctored.noise(SHEET),
        min_stars=5,
        sweeps=False,
        n_geometries=100,
        seed=5,
    )
    assert np.all(found.nea_arcsec < 0.9 * limit)
    assert nea == pytest.approx(limit, rel=0.02)


# --- the file


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("aperture_mm = 20\nzero_point_e_s = 5.0", "leave zero_point_e_s or aperture_mm out"),
        ("transmission = 0.7", "need aperture_mm; add it"),
        ("transmission_loss_per_year = 1", "write a share from 0 to below 1"),
        ("rate_deg_s = -1", "write a number of degrees per second, 0 to 100"),
    ],
)
def test_a_bad_key_is_named_with_its_file(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "sensor.toml"
    path.write_text(f"[sensor]\n{text}")
    with pytest.raises(SensorError, match=message) as caught:
        Sensor.load(path)
    assert str(path) in str(caught.value)


def test_a_sky_that_fills_the_pixels_is_refused() -> None:
    with pytest.raises(SensorError):
        Sensor(background_e_px_s=1e6).noise(SHEET)
