"""Stars whose image a neighbour moves."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

import starcal_uq as sc
from starcal_uq.sky.neighbours import disturbed_stars, without_disturbed


def test_stars_beside_a_neighbour_are_left_out():
    truth = sc.paper.paper_camera()
    stars = sc.load_catalogue(max_mag=7.0)
    obs = sc.simulate(stars, truth, n_frames=40, min_stars=10, seed=2)
    mask = disturbed_stars(obs, stars, truth)
    assert 0 < mask.sum() < 0.05 * obs.n_stars
    kept = without_disturbed(obs, stars, truth)
    assert kept.meta["disturbed_stars"] >= mask.sum()
    # For the others, the nearest neighbour moves the light by less than a fifth of 0.05 px, or is
    # out of reach.
    distance, index = cKDTree(stars.directions_icrs).query(kept.directions_icrs, k=2)
    near, flux = (
        distance[:, 1] * truth.focal_px,
        10.0 ** (-0.4 * (stars.mag[index[:, 1]] - kept.mag)),
    )
    assert np.all((near * flux / (1.0 + flux) <= 0.2 * 0.05 + 1e-9) | (near > 3.99))
    # Wider star images reach farther.
    assert disturbed_stars(obs, stars, truth, psf_sigma_px=3.0).sum() > mask.sum()
