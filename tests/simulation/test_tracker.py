"""What a tracker uses of its frames, beside a sky that NumPy alone looks at."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import SettingError
from starcal_uq.planning.plan import plan
from starcal_uq.simulation.frames import Tracker

MAX_STARS = 12


@lru_cache
def sky() -> sc.StarCatalogue:
    return sc.load_catalogue(max_mag=6.0, epoch=2026.9)


def sheet() -> sc.Camera:
    """A pinhole of 16 degrees, so that NumPy projects with one line."""
    return sc.Camera(1024, 1024, 10.0, 36.0, 511.5, 511.5, "none", ())


def on_detector(rotation: np.ndarray, margin_px: float) -> np.ndarray:
    """Catalogue numbers of the stars that a pinhole shows, brightest first."""
    ra, dec = np.radians(sky().ra_deg), np.radians(sky().dec_deg)
    r = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    b = r @ rotation.T
    x, y = (3600.0 * b[:, axis] / b[:, 2] + 511.5 for axis in (0, 1))
    low, high = -0.5 + margin_px, 1023.5 - margin_px
    inside = (b[:, 2] > 0.0) & (x > low) & (x < high) & (y > low) & (y < high)
    seen = np.flatnonzero(inside)
    return seen[np.argsort(sky().mag[seen], kind="stable")]


def test_the_brightest_stars_of_a_frame_are_used() -> None:
    tracker = Tracker(sheet(), 0.05, 5, MAX_STARS)
    rotations, frames = tracker.frames(sky(), np.random.default_rng(1), 40)
    fuller = 0
    for rotation, (index, _) in zip(rotations, frames, strict=True):
        seen = on_detector(rotation, 6 * 0.05)
        assert set(index) == set(seen[:MAX_STARS])
        fuller += len(seen) > MAX_STARS
        # Control: the faintest ones are others.
        assert len(seen) <= MAX_STARS or set(index) != set(seen[-MAX_STARS:])
    assert fuller > 20


def test_a_simulation_is_that_of_all_stars_with_the_others_left_out() -> None:
    limited = sc.simulate(sky(), sheet(), n_frames=30, max_stars=MAX_STARS, sigma_px=0.0, seed=2)
    every = sc.simulate(sky(), sheet(), n_frames=30, sigma_px=0.0, seed=2)
    assert np.diff(limited.frame_starts).max() == MAX_STARS < np.diff(every.frame_starts).max()
    for frame in range(30):
        own, all_of_it = limited.frame == frame, every.frame == frame
        faintest = np.sort(every.mag[all_of_it])[:MAX_STARS][-1]
        assert sorted(limited.star_id[own]) == sorted(
            every.star_id[all_of_it & (every.mag <= faintest)]
        )


def test_fewer_stars_make_a_plan_worse_as_their_geometry_says() -> None:
    """Covariance of an attitude from the stars' directions, by hand, beside that of the plan."""
    options = {"min_stars": 5, "sweeps": False, "n_geometries": 300, "seed": 3}
    found = plan(sheet(), sky(), max_stars=MAX_STARS, **options)
    assert found.mean_stars <= MAX_STARS < plan(sheet(), sky(), **options).mean_stars
    rotations, _ = Tracker(sheet(), 0.05, 5).frames(sky(), np.random.default_rng(3), 300)
    ra, dec = np.radians(sky().ra_deg), np.radians(sky().dec_deg)
    r = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)

    def nea(most: int) -> np.ndarray:
        variances = []
        for rotation in rotations:
            b = r[on_detector(rotation, 6 * 0.05)[:most]] @ rotation.T
            x, y, one = b[:, 0] / b[:, 2], b[:, 1] / b[:, 2], np.ones(len(b))
            # A small turn moves the image (x, y) of a pinhole by these columns.
            rows = (
                np.stack([x * y, -(one + x * x), y], axis=1),
                np.stack([one + y * y, -x * y, -x], axis=1),
            )
            a = 3600.0 * np.concatenate(rows)
            variances.append(np.diag(np.linalg.inv(a.T @ a / 0.05**2)))
        return 206264.806 * np.sqrt(np.mean(variances, axis=0))

    assert found.nea_arcsec == pytest.approx(nea(MAX_STARS), rel=1e-6)
    # Control: with all stars the plan would be better.
    assert nea(10_000)[0] < 0.9 * found.nea_arcsec[0]


def test_a_tracker_that_cannot_have_its_stars_is_refused() -> None:
    with pytest.raises(SettingError, match="max_stars is 8 and min_stars 10"):
        sc.simulate(sky(), sheet(), n_frames=3, max_stars=8)
