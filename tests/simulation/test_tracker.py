"""What a tracker uses of its frames, beside a sky that NumPy alone looks at."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import SettingError
from starcal_uq.planning.plan import plan
from starcal_uq.simulation.frames import Tracker
from tests.helpers.pinhole import ARCSEC, attitude_variance, directions, on_detector

MAX_STARS = 12


@lru_cache
def sky() -> sc.StarCatalogue:
    return sc.load_catalogue(max_mag=6.0, epoch=2026.9)


def sheet() -> sc.Camera:
    """A pinhole of 16 degrees, so that NumPy projects with one line."""
    return sc.Camera(1024, 1024, 10.0, 36.0, 511.5, 511.5, "none", ())


def stars_at(rotation: np.ndarray) -> np.ndarray:
    return on_detector(directions(sky().ra_deg, sky().dec_deg), sky().mag, rotation, 6 * 0.05)


def test_the_brightest_stars_of_a_frame_are_used() -> None:
    tracker = Tracker(sheet(), 0.05, 5, MAX_STARS)
    rotations, frames = tracker.frames(sky(), np.random.default_rng(1), 40)
    fuller = 0
    for rotation, (index, _) in zip(rotations, frames, strict=True):
        seen = stars_at(rotation)
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
    r = directions(sky().ra_deg, sky().dec_deg)

    def nea(most: int) -> np.ndarray:
        variances = []
        for rotation in rotations:
            b = r[stars_at(rotation)[:most]] @ rotation.T
            variances.append(attitude_variance(b, np.full(len(b), 0.05)))
        return ARCSEC * np.sqrt(np.mean(variances, axis=0))

    assert found.nea_arcsec == pytest.approx(nea(MAX_STARS), rel=1e-6)
    # Control: with all stars the plan would be better.
    assert nea(10_000)[0] < 0.9 * found.nea_arcsec[0]


def test_a_tracker_that_cannot_have_its_stars_is_refused() -> None:
    with pytest.raises(SettingError):
        sc.simulate(sky(), sheet(), n_frames=3, max_stars=8)
