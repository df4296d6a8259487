"""Noise by magnitude: what a simulation draws is what its table states."""

from __future__ import annotations

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import SettingError


def sheet() -> sc.Camera:
    return sc.Camera(1024, 1024, 10.0, 36.0, 511.5, 511.5, "none", ())


def test_noise_by_magnitude_is_drawn_and_stated() -> None:
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    options = {"n_frames": 200, "min_stars": 5, "seed": 4}
    noisy = sc.simulate(
        stars, sheet(), sigma_px=lambda mag: 0.02 * 10.0 ** (0.2 * (mag - 4)), **options
    )
    assert noisy.sigma_px == pytest.approx(0.02 * 10.0 ** (0.2 * (noisy.mag - 4.0)))
    exact = sc.simulate(stars, sheet(), sigma_px=lambda mag: 1e-9 + 0.0 * mag, **options)
    # Stars within six sigma of the edge are seen in one of the two alone.
    places = {
        (f, s): xy
        for f, s, *xy in zip(exact.frame, exact.star_id, exact.x_px, exact.y_px, strict=True)
    }
    known = [(f, s) in places for f, s in zip(noisy.frame, noisy.star_id, strict=True)]
    there = np.array(
        [places[key] for key in zip(noisy.frame[known], noisy.star_id[known], strict=True)]
    )
    z = (np.stack([noisy.x_px, noisy.y_px], axis=1)[known] - there) / noisy.sigma_px[known, None]
    n = z.size
    assert n > 3000
    assert np.mean(z**2) == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / n))
    # Control: one noise for all stars would not be that of the faint ones.
    faint = noisy.mag[known] > 5.5
    alike = z[faint] * noisy.sigma_px[known][faint, None] / np.median(noisy.sigma_px)
    assert np.mean(alike**2) > 1.2


def test_noise_that_is_none_is_refused() -> None:
    stars = sc.load_catalogue(max_mag=5.0, epoch=2026.9)
    with pytest.raises(SettingError):
        sc.simulate(stars, sheet(), n_frames=3, min_stars=3, sigma_px=lambda mag: -mag)
