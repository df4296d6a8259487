"""Small scenes shared by the tests: cameras of every distortion model, and simulated observations
of them.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.observations.table import Observations
from starcal_uq.paper.camera import paper_camera
from starcal_uq.simulation.frames import simulate
from starcal_uq.sky.catalogue import StarCatalogue, load_catalogue

COEFFICIENTS: dict[str, tuple[float, ...]] = {
    "none": (),
    "k1": (2e-9,),
    "brown": (2e-10, -3.5e-15),
    "brown3": (2e-9, -3.5e-15, 3e-21),
    "brown_tangential": (2e-9, -3.5e-15, 2e-7, -3e-7),
    "inverse": (-2e-9, 3.5e-15),
}
USUAL = tuple(COEFFICIENTS)
COEFFICIENTS |= {
    "thin_prism": (2e-9, -3.5e-15, 2e-7, -3e-7),
    "cubic": (
        1e-7,
        2e-7,
        -1e-7,
        2e-9,
        1e-10,
        2e-9,
        3e-10,
        1e-7,
        2e-7,
        -3e-7,
        1e-10,
        2e-9,
        1e-10,
        2e-9,
    ),
    "f_theta": (),
    "equidistant": (2e-9, -3.5e-15),
    "fisheye": (2e-9, -3.5e-15, 3e-21, -1e-27),
}
AXES = (6.4e-4, -3e-4)
COEFFICIENTS |= {name + "+axes": (*values, *AXES) for name, values in COEFFICIENTS.items()}
# Every kind of formula, with square pixels or free axes.
MODELS = (
    *USUAL,
    "none+axes",
    "thin_prism+axes",
    "cubic",
    "inverse+axes",
    "fisheye",
    "equidistant+axes",
)


def camera(model: str = "brown", **changes: object) -> Camera:
    """The paper's sensor with another distortion model."""
    return paper_camera().replace(distortion=model, coefficients=COEFFICIENTS[model], **changes)


def nominal(truth: Camera) -> Camera:
    """A data-sheet start for a camera: centred, 2.5 % off in focal length, no distortion."""
    x, y = truth.centre_px
    zeros = (0.0,) * len(truth.coefficients)
    return truth.replace(focal_mm=truth.focal_mm * 1.025, x0_px=x, y0_px=y, coefficients=zeros)


@lru_cache(maxsize=8)
def catalogue(max_mag: float = 6.0, epoch: float = 2026.9) -> StarCatalogue:
    """Stars of the embedded catalogue, whose file takes longer to read than a campaign to
    simulate.
    """
    return load_catalogue(max_mag=max_mag, epoch=epoch)


@lru_cache(maxsize=64)
def observations(
    model: str = "brown",
    n_frames: int = 60,
    seed: int = 3,
    sigma_px: float = 0.05,
    max_mag: float = 6.0,
) -> Observations:
    """Simulated observations; cached, since many tests look at the same ones."""
    return simulate(
        catalogue(max_mag),
        camera(model),
        n_frames=n_frames,
        min_stars=8,
        sigma_px=sigma_px,
        seed=seed,
    )


def with_sigmas(obs: Observations, seed: int = 0) -> Observations:
    """The same stars with unequal stated noise, and noise of that size added."""
    import dataclasses

    rng = np.random.default_rng(seed)
    stated = rng.uniform(0.02, 0.2, obs.n_stars)
    return dataclasses.replace(
        obs,
        sigma_px=stated,
        x_px=obs.x_px + stated * rng.standard_normal(obs.n_stars),
        y_px=obs.y_px + stated * rng.standard_normal(obs.n_stars),
    )
