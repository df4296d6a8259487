"""Star fields as a camera on the ground sees them."""

from __future__ import annotations

import numpy as np

import starcal_uq as sc
from starcal_uq.camera.projection import project
from starcal_uq.images.centroids import Centroids
from starcal_uq.observations.table import Observations
from starcal_uq.sky.apparent import apparent_directions
from starcal_uq.sky.positions import ra_dec_deg
from starcal_uq.sky.refraction import site_among_stars
from starcal_uq.sky.site import Site

SITE = Site(
    latitude_deg=-24.6, longitude_deg=-70.4, height_m=2635.0, pressure_hpa=743.0, temperature_c=12.0
)
CAMERA = sc.Camera(1024, 768, 6.9, 35.3, 517.0, 390.0, "brown", (3e-9, 1e-15))
NOMINAL = sc.Camera(1024, 768, 6.9, 35.0, 511.5, 383.5, "brown", (0.0, 0.0))


def night(n_frames: int) -> list[str]:
    """Times, one for each frame, over four hours of a night at the site."""
    minutes = np.linspace(0.0, 240.0, n_frames).astype(int)
    return [f"2026-11-25T{2 + m // 60:02d}:{m % 60:02d}:00" for m in minutes.tolist()]


def ground_frames(
    stars: sc.StarCatalogue,
    altitudes_deg: np.ndarray,
    *,
    sigma_px: float = 0.05,
    seed: int = 0,
    site: Site = SITE,
    camera: sc.Camera = CAMERA,
    times: list[str] | None = None,
) -> Observations:
    """Frames at given altitudes and random azimuths: directions of the catalogue, pixels as seen
    from the site.
    """
    rng = np.random.default_rng(seed)
    columns: dict[str, list] = {name: [] for name in ("frame", "xy", "star", "time")}
    for number, (altitude, time) in enumerate(
        zip(altitudes_deg, times or night(len(altitudes_deg)), strict=True)
    ):
        zenith, _ = site_among_stars(site, time)
        level = np.linalg.svd(zenith[None])[2][1:]
        angle = rng.uniform(0.0, 2.0 * np.pi)
        along = level.T @ [np.cos(angle), np.sin(angle)]
        boresight = np.cos(np.radians(altitude)) * along + np.sin(np.radians(altitude)) * zenith
        roll = rng.uniform(0.0, 2.0 * np.pi)
        x = np.cross(boresight, zenith)
        x /= np.linalg.norm(x)
        y = np.cross(boresight, x)
        rotation = np.stack(
            [np.cos(roll) * x + np.sin(roll) * y, np.cos(roll) * y - np.sin(roll) * x, boresight]
        )
        near = np.flatnonzero(stars.directions_icrs @ boresight > np.cos(np.radians(9.0)))
        seen = apparent_directions(stars.directions_icrs[near], time, site=site) @ rotation.T
        xy = project(camera, seen) + rng.normal(0.0, sigma_px, (len(near), 2))
        inside = camera.contains(xy)
        columns["frame"] += [number] * int(inside.sum())
        columns["xy"] += xy[inside].tolist()
        columns["star"] += near[inside].tolist()
        columns["time"] += [time] * int(inside.sum())
    star, xy = np.array(columns["star"]), np.array(columns["xy"])
    ra, dec = ra_dec_deg(stars.directions_icrs[star])
    return Observations(
        frame=np.array(columns["frame"]),
        x_px=xy[:, 0],
        y_px=xy[:, 1],
        ra_deg=ra,
        dec_deg=dec,
        star_id=stars.star_id[star],
        mag=stars.mag[star],
        time_utc=np.array(columns["time"]),
        meta={"directions": "catalogue"},
    )


def as_centroids(obs: Observations, sigma_px: float = 0.05) -> Centroids:
    """The same stars without their names."""
    n, frames = obs.n_stars, obs.n_frames
    first = np.searchsorted(obs.frame, obs.frame_ids)
    flags = np.zeros(n, dtype=bool)
    return Centroids(
        frame=obs.frame,
        x_px=obs.x_px,
        y_px=obs.y_px,
        var_x_px2=np.full(n, sigma_px**2),
        var_y_px2=np.full(n, sigma_px**2),
        cov_xy_px2=np.zeros(n),
        flux=10.0 ** (-0.4 * obs.mag),
        snr=np.full(n, 50.0),
        peak=np.full(n, 1000.0),
        saturated=flags,
        blended=flags,
        edge=flags,
        frame_ids=obs.frame_ids,
        image=np.array([f"frame{k}" for k in obs.frame_ids]),
        time_utc=obs.time_utc[first],
        background=np.full(frames, 100.0),
        noise=np.full(frames, 5.0),
        psf_sigma_px=np.full(frames, 1.0),
        problem=np.full(frames, ""),
    )
