"""Stars whose light mixes with that of a catalogue neighbour, so that their centroids are not where
they are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.types import BoolArray

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.observations.table import Observations
    from starcal_uq.sky.catalogue import StarCatalogue

# A neighbour within so many widths of the star image adds to the light that is fitted.
_REACH_PSF = 4.0
# Displacements below this part of a star's own noise do not matter.
_HARMLESS_SIGMAS = 0.2
# A frame needs more than three stars to say anything of the camera.
_LEAST_STARS = 4


def disturbed_stars(
    obs: Observations, stars: StarCatalogue, camera: Camera, psf_sigma_px: float = 1.0
) -> BoolArray:
    """Stars (N,) that a neighbour in the catalogue displaces by more than a fifth of their noise.

    The light centre of two stars at a distance d is displaced by ``d q / (1 + q)`` from the one,
    with q the ratio of their fluxes. Neighbours fainter than the catalogue's limit are not known.
    """
    from scipy.spatial import cKDTree

    if obs.mag is None or not obs.n_stars:
        return np.zeros(obs.n_stars, dtype=bool)
    sigma = np.full(obs.n_stars, 0.05) if obs.sigma_px is None else obs.sigma_px
    tree = cKDTree(stars.directions_icrs)
    reach = _REACH_PSF * psf_sigma_px / camera.focal_px
    directions = obs.directions_icrs
    mask = np.zeros(obs.n_stars, dtype=bool)
    own = tree.query(directions)[1]
    for row, near in enumerate(tree.query_ball_point(directions, reach)):
        others = [index for index in near if index != own[row]]
        if not others:
            continue
        distance_px = (
            np.linalg.norm(stars.directions_icrs[others] - directions[row], axis=1)
            * camera.focal_px
        )
        ratio = 10.0 ** (-0.4 * (stars.mag[others] - obs.mag[row]))
        mask[row] = np.max(distance_px * ratio / (1.0 + ratio)) > _HARMLESS_SIGMAS * sigma[row]
    return mask


def without_disturbed(
    obs: Observations, stars: StarCatalogue, camera: Camera, psf_sigma_px: float = 1.0
) -> Observations:
    """The other stars, in frames that keep at least four; ``origin.disturbed_stars`` says how many
    were left out.
    """
    kept = obs.select(~disturbed_stars(obs, stars, camera, psf_sigma_px))
    kept = kept.select_frames(kept.frame_ids[kept.stars_per_frame >= _LEAST_STARS])
    return kept.with_origin(disturbed_stars=obs.n_stars - kept.n_stars)
