"""The points of an interaction study: the paper's experiment, varied along one axis at a time."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import get_model
from starcal_uq.core.errors import SamplingError

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.sky.catalogue import StarCatalogue

# Times the paper's 0.7 px at the corner; the largest is 6 % of the radius there, as for a wide-angle lens.
DISTORTION_SCALES = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0, 4.0, 15.0, 60.0)
FIELDS_DEG = (5.0, 7.0, 10.0, 15.0, 25.0, 40.0)
FRAMES = (10, 30, 100, 300, 1000)
MAX_MAGS = (5.0, 5.5, 6.0, 6.5, 7.0)
# An attitude needs a few stars whatever the axis says.
LEAST_STARS = 4


@dataclass(frozen=True)
class Condition:
    """What is simulated.

    Attributes
    ----------
    truth, start : Camera
        What is simulated, and where every method starts.
    n_frames, min_stars : int
        As in `simulate`.
    max_mag : float
        Limiting magnitude.
    """

    truth: Camera
    start: Camera
    n_frames: int
    min_stars: int
    max_mag: float

    @property
    def field_deg(self) -> float:
        """Full horizontal field of view."""
        return float(self.truth.fov_deg[0])

    @property
    def corner_px(self) -> float:
        """What the distortion displaces at the corner farthest from the principal point, px outwards."""
        model, radius = get_model(self.truth.distortion), self.truth.corner_radius_px
        return float(model.displacement(radius, 0.0, self.truth.coefficients)[0])


@dataclass(frozen=True)
class Point:
    """A point of an axis.

    Attributes
    ----------
    axis : str
        ``distortion``, ``field``, ``frames`` or ``stars``.
    value : float
        Factor on the distortion, full field of view in deg, number of frames, or limiting magnitude.
    condition : Condition
        What is simulated there; the axes cross in one condition.
    """

    axis: str
    value: float
    condition: Condition


def study_points(
    base: Condition,
    sky: StarCatalogue,
    distortion_scales: Sequence[float],
    fields_deg: Sequence[float],
    frames: Sequence[int],
    max_mags: Sequence[float],
) -> tuple[Point, ...]:
    """All points; `sky` as from `deep_catalogue`."""
    return (
        *(Point("distortion", float(scale), _distorted(base, scale)) for scale in distortion_scales),
        *(Point("field", float(field), _with_field(base, field, sky)) for field in fields_deg),
        *(Point("frames", float(k), dataclasses.replace(base, n_frames=int(k))) for k in frames),
        *(Point("stars", float(mag), _with_mag(base, mag, sky)) for mag in max_mags),
    )


def _distorted(base: Condition, scale: float) -> Condition:
    coefficients = tuple(scale * k for k in base.truth.coefficients)
    truth = base.truth.replace(coefficients=coefficients)
    return dataclasses.replace(base, truth=truth)


def _with_field(base: Condition, field_deg: float, sky: StarCatalogue) -> Condition:
    """The same detector with another focal length, and as many stars in a frame."""
    truth = _focal_for(base.truth, field_deg)
    if np.isclose(truth.focal_mm, base.truth.focal_mm, rtol=1e-6):
        return base
    start = base.start.replace(focal_mm=truth.focal_mm * base.start.focal_mm / base.truth.focal_mm)
    n_stars = _count(sky, base.max_mag) * solid_angle_sr(base.truth) / solid_angle_sr(truth)
    limit = float(np.sort(sky.mag)[round(n_stars) - 1])
    return dataclasses.replace(base, truth=truth, start=start, max_mag=limit)


def _with_mag(base: Condition, max_mag: float, sky: StarCatalogue) -> Condition:
    """Another magnitude limit; frames hold at least the same fraction of the mean number of stars."""
    least = round(base.min_stars * _count(sky, max_mag) / _count(sky, base.max_mag))
    return dataclasses.replace(base, max_mag=float(max_mag), min_stars=max(LEAST_STARS, least))


def _focal_for(camera: Camera, field_deg: float) -> Camera:
    half_mm = 0.5e-3 * camera.width_px * camera.pixel_um
    return camera.replace(focal_mm=float(half_mm / np.tan(np.radians(0.5 * field_deg))))


def solid_angle_sr(camera: Camera) -> float:
    """Solid angle of the ideal field, sr."""
    h, v = np.radians(camera.fov_deg)
    return float(4.0 * np.arcsin(np.sin(0.5 * h) * np.sin(0.5 * v)))


def _count(sky: StarCatalogue, max_mag: float) -> int:
    return int(np.sum(sky.mag <= max_mag))


def deep_catalogue(truth: Camera, max_mag: float, base_mag: float, fields_deg: Sequence[float]) -> StarCatalogue:
    """One catalogue of which every condition takes the bright part."""
    from starcal_uq.sky.catalogue import load_catalogue

    sky = load_catalogue(max_mag=max_mag)
    smallest = min([solid_angle_sr(truth), *(solid_angle_sr(_focal_for(truth, field)) for field in fields_deg)])
    needed = _count(sky, base_mag) * solid_angle_sr(truth) / smallest
    while len(sky) < needed:
        max_mag += 0.5
        deeper = load_catalogue(max_mag=max_mag)
        if len(deeper) == len(sky):
            raise SamplingError(
                f"the catalogue has {len(sky)} stars, too few for a field of {min(fields_deg):g} deg with as many "
                "stars as the others: leave the narrowest fields out, or give a smaller max_mag."
            )
        sky = deeper
    return sky
