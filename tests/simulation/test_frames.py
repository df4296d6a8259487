"""Simulated observations: the paper's Table 1, geometry, noise, and repeatability."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

import starcal_uq as sc
from starcal_uq.attitude.rotations import random_rotations
from starcal_uq.simulation.frames import Sky
from tests.helpers.scenes import camera, observations


def test_table_1_of_the_paper():
    cam = sc.paper.paper_camera()
    assert (cam.width_px, cam.height_px, cam.pixel_um) == (1024, 1024, 12.0)
    assert (cam.x0_px, cam.y0_px, cam.focal_mm) == (500.0, 530.0, 70.2262)
    assert cam.coefficients == (2.0e-10, -3.5e-15)
    assert cam.focal_px == pytest.approx(5852.1833, abs=1e-3)
    assert cam.fov_deg == pytest.approx((10.0, 10.0), abs=0.02)


def test_frames_hold_enough_stars_on_the_detector():
    obs = observations(n_frames=60)
    assert obs.n_frames == 60
    assert obs.stars_per_frame.min() >= 8
    assert camera().contains(obs.xy).all()
    assert obs.meta["directions"] == "apparent"
    assert obs.directions_declared


def test_noise_free_pixels_are_projections_at_one_attitude_per_frame():
    obs = observations(sigma_px=0.0)
    b = sc.camera.unproject(camera(), obs.xy)
    result = sc.attitude.quest(b, obs.directions_icrs, obs.frame_starts)
    rotated = np.einsum(
        "nij,nj->ni", np.repeat(result.rotations, obs.stars_per_frame, axis=0), obs.directions_icrs
    )
    assert np.max(np.abs(rotated - b)) < 1e-13


def test_noise_is_gaussian_with_the_stated_sigma():
    cam, stars = camera(), sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    rotations = sc.attitude.quest(
        sc.camera.unproject(cam, observations(sigma_px=0.0).xy),
        observations(sigma_px=0.0).directions_icrs,
        observations(sigma_px=0.0).frame_starts,
    ).rotations
    # Few stars near the edge drop out as the margin grows with the noise; compare star by star.
    clean = sc.simulate(stars, cam, attitudes=rotations, min_stars=5, sigma_px=0.0)
    noisy = sc.simulate(stars, cam, attitudes=rotations, min_stars=5, sigma_px=0.3, seed=4)
    key = {(f, i): row for row, (f, i) in enumerate(zip(clean.frame, clean.star_id, strict=True))}
    rows = [key[f, i] for f, i in zip(noisy.frame, noisy.star_id, strict=True)]
    noise = (noisy.xy - clean.xy[rows]).ravel() / 0.3
    assert stats.kstest(noise, "norm").pvalue > 0.001
    assert stats.kstest(noise * 1.2, "norm").pvalue < 0.001


def test_same_seed_same_bits_and_other_seed_other_frames():
    stars, cam = sc.load_catalogue(max_mag=6.0), camera()
    a, b, c = (sc.simulate(stars, cam, n_frames=5, seed=s) for s in (1, 1, 2))
    assert a.data_hash == b.data_hash
    assert a.data_hash != c.data_hash


def test_attitudes_are_uniform():
    """Boresights uniform on the sphere, roll uniform: Kolmogorov-Smirnov, with a biased control."""
    rotations = random_rotations(4000, np.random.default_rng(0))
    boresight = rotations[:, 2]
    assert stats.kstest(boresight[:, 2], "uniform", args=(-1, 2)).pvalue > 0.001
    angle = np.arctan2(boresight[:, 1], boresight[:, 0])
    assert stats.kstest(angle, "uniform", args=(-np.pi, 2 * np.pi)).pvalue > 0.001
    assert (
        stats.kstest(np.arcsin(boresight[:, 2]), "uniform", args=(-np.pi / 2, np.pi)).pvalue < 0.001
    )


def test_impossible_requests_are_named():
    stars = sc.load_catalogue(max_mag=2.0)
    with pytest.raises(sc.errors.CatalogueError):
        sc.simulate(stars, camera(), n_frames=3, min_stars=12)
    with pytest.raises(sc.errors.CatalogueError):
        sc.simulate(stars, camera(), attitudes=np.eye(3)[None], min_stars=12)
    with pytest.raises(ValueError, match="at least 3 stars"):
        sc.simulate(stars, camera(), min_stars=2)


def test_a_field_that_hardly_ever_shows_enough_stars_is_refused_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    # About one attitude in some hundred: each by itself is found, but a thousand would take
    # minutes.
    narrow = sc.paper.paper_camera().replace(focal_mm=350.0)
    tried, views = [], Sky.views

    def counted(self: Sky, rotations: np.ndarray) -> list:
        tried.append(len(rotations))
        return views(self, rotations)

    monkeypatch.setattr(Sky, "views", counted)
    with pytest.raises(sc.errors.CatalogueError):
        sc.simulate(stars, narrow, n_frames=3000, min_stars=5, seed=1)
    # For three thousand frames, more than a million would have to be tried.
    assert sum(tried) < 10_000
    assert sc.simulate(stars, narrow, n_frames=3, min_stars=4, seed=1).n_frames == 3
