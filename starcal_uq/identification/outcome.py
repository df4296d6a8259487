"""What identified frames say together: tables, attitudes and TASTE with the common camera."""

from __future__ import annotations

import numpy as np

from starcal_uq.attitude.rotations import rotation_to_quaternion
from starcal_uq.attitude.wahba import quest
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model
from starcal_uq.camera.projection import unproject
from starcal_uq.core.types import AnyDict, FloatArray, floats
from starcal_uq.identification.result import (
    FoundOptics,
    FrameIdentification,
    Identification,
    Parity,
)
from starcal_uq.identification.search import (
    LEAST_SIGMA_PX,
    CentroidTable,
    Found,
    FrameTable,
    has_radial,
)
from starcal_uq.observations.origin import Origin
from starcal_uq.observations.table import Observations
from starcal_uq.sky.catalogue import StarCatalogue


def moved(camera: Camera, shared: FloatArray) -> Camera:
    """The camera with shared parameters (ln f, d, kappa) added."""
    log_scale, dx, dy, kappa = (float(v) for v in shared)
    coefficients = list(camera.coefficients)
    if has_radial(camera):
        names = [c.name for c in get_model(camera.distortion).coefficients]
        coefficients[names.index("k1")] += kappa / camera.corner_radius_px**3
    return camera.replace(
        focal_px=camera.focal_px * float(np.exp(log_scale)),
        x0_px=camera.x0_px + dx,
        y0_px=camera.y0_px + dy,
        coefficients=tuple(coefficients),
    )


def identification(
    field: FrameTable,
    results: list[Found],
    camera: Camera,
    nominal: Camera,
    stars: StarCatalogue,
    parity: Parity,
    table: CentroidTable,
    optics: FoundOptics | None,
) -> Identification:
    """Attitudes and TASTE with the common camera, and the tables."""
    from scipy.special import chdtrc

    solved = [(k, m) for k, f in enumerate(results) if (m := f.match) is not None]
    sizes = [len(m) for _, m in solved]
    star = np.concatenate([m.star for _, m in solved] or [np.empty(0, dtype=np.int64)])
    rows = np.concatenate([field.rows[k][m.centroid] for k, m in solved] or [star])
    xy = np.concatenate([field.xy[k][m.centroid] for k, m in solved] or [np.empty((0, 2))])
    sigma = floats(table.sigma_px)[rows]
    attitudes: dict[int, AnyDict] = {}
    if solved:
        starts = np.concatenate([[0], np.cumsum(sizes)])
        floor = np.hypot(sigma, LEAST_SIGMA_PX)
        b, r = unproject(camera, xy), stars.directions_icrs[star]
        wahba = quest(b, r, starts, sigma_rad=floor / camera.focal_px, covariance=False)
        taste = np.asarray(wahba.taste)
        p_value = chdtrc(wahba.dof, taste)
        for i, (k, m) in enumerate(solved):
            attitudes[k] = {
                "n_identified": len(m),
                "n_ambiguous": m.n_ambiguous,
                "n_unlike_brightness": m.n_unlike_brightness,
                "log10_expected_false": m.log10_false,
                "quaternion": rotation_to_quaternion(wahba.rotations[i]),
                "noise_scale": m.noise_scale,
                "taste": float(taste[i]),
                "taste_p_value": float(p_value[i]),
            }
    records = tuple(
        FrameIdentification(
            frame=field.ids[k],
            image=str(table.image[k]),
            status=f.status,
            n_centroids=len(field.xy[k]),
            milliseconds=1e3 * f.seconds,
            **attitudes.get(k, {}),
        )
        for k, f in enumerate(results)
    )
    times = [str(table.time_utc[k]) for k, _ in solved]
    origin = Origin.identified(
        stars.source,
        directions="apparent" if stars.apparent else "catalogue",
        epoch=float(stars.epoch),
        max_mag=float(stars.mag.max()),
    )
    observations = Observations(
        frame=np.repeat([field.ids[k] for k, _ in solved], sizes).astype(np.int64),
        x_px=xy[:, 0],
        y_px=xy[:, 1],
        sigma_px=sigma,
        **stars.named(star),
        time_utc=np.repeat(times, sizes) if times and all(times) else None,
        meta={**origin.plain(), "parity": parity},
    )
    # Not every table says which frames were left out.
    problems = getattr(table, "problem", [""] * len(records))
    n_left_out = sum(
        bool(problems[k]) and record.status == "too few stars" for k, record in enumerate(records)
    )
    return Identification(observations, records, camera, nominal, parity, n_left_out, optics)
