"""Distortion that a sheet leaves open: what a plan gives over a range of it.

A principal point is told from a rotation of the camera by second order alone. A turn by a small
angle delta moves stars by ``f delta`` times one and a pattern of the size (r / f)^2. With radial
distortion k1 and kappa = k1 f^2 it is

    (x^2 + kappa (3 x^2 + y^2), (1 + 2 kappa) x y) / f^2,

while a shift of the principal point moves all stars alike. Near kappa = -1/3, the cubic term of an
f-theta lens (r = f theta), little of the pattern is left: that takes half a per cent of barrel
distortion at the corner of a field of 10 degrees, two per cent in one of 20. Pincushion distortion
makes the pattern larger.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model, undistorted
from starcal_uq.camera.fields import detector_corners
from starcal_uq.camera.planes import PINHOLE
from starcal_uq.camera.projection import unproject
from starcal_uq.core.errors import DistortionError, PlanningError
from starcal_uq.core.types import FloatArray
from starcal_uq.planning.forecast import SCOPES, Forecaster, Outlook
from starcal_uq.planning.information import FrameSet, random_frames
from starcal_uq.simulation.frames import Tracker
from starcal_uq.sky.catalogue import StarCatalogue

# Cubic term of an f-theta lens, as k1 f^2.
F_THETA = -1.0 / 3.0
# Where frames needed peak lies between 0.8 and 1 of it, by the width of the field.
_BARREL = (1.0, 0.8, 0.5)
_NODES, _GEOMETRIES, _CAMPAIGNS, AFTER_FRAMES = 5, 1000, 64, 1000
# A displacement beyond this folds the distortion, or is no camera's.
_LARGEST_PERCENT = 30.0
# Share of the displacement that folds at the corner, up to which stars there can still be placed.
_NEAR_FOLD = 0.9


@dataclass(frozen=True, eq=False)
class DistortionRange:
    """Forecasts over the range of an unknown distortion, for D distortions.

    Attributes
    ----------
    percent : (D,) array
        Displacement of the corner of the detector, per cent of its distance from the centre; barrel
        is negative.
    scopes : tuple of str
        Parts of the attitude error that `frames` has a column for; empty without a target.
    frames : (D, S) array
        Fewest frames that keep the target; infinite where no number does.
    radius_arcsec : (D, G) array
        Two-axis error across the boresight for every number of frames of the forecast, arcsec.
    radius_after_arcsec : (D,) array
        Two-axis error after 1000 frames, arcsec.
    principal_point_px, focal_px : (D,) array
        Standard deviations of the principal point (per axis) and of the focal length after 1000
        frames, px.
    f_theta_percent : float
        Displacement of the corner in an f-theta lens, per cent.
    """

    percent: FloatArray
    scopes: tuple[str, ...]
    frames: FloatArray
    radius_arcsec: FloatArray
    radius_after_arcsec: FloatArray
    principal_point_px: FloatArray
    focal_px: FloatArray
    f_theta_percent: float

    @property
    def own_percent(self) -> float:
        """Distortion of the plan itself: none, or the end of the range that is nearest to it."""
        return float(np.clip(0.0, self.percent[0], self.percent[-1]))

    def frames_range(self, scope: str) -> tuple[float, float]:
        """Least and most frames that the target takes for a part of the error."""
        column = self.frames[:, self.scopes.index(scope)]
        return float(column.min()), float(column.max())


def open_range(
    camera: Camera, given: tuple[float, float] | None, calibrated: bool
) -> tuple[float, float] | None:
    """Range of the displacement of the corner that is open, per cent; None where the distortion is
    known.

    It is known of a calibrated camera and from coefficients that are not all zero. Unless a range
    is given, it is barrel distortion up to that of an f-theta lens, and as much pincushion, as far
    as neither folds on the detector.
    """
    model = get_model(camera.distortion)
    # The range is one around the pinhole; a lens that is known for a fisheye is stated.
    stated = calibrated or not model.lens or any(camera.coefficients[: len(model.lens)])
    stated = stated or model.plane is not PINHOLE
    if given is None:
        if stated:
            return None
        end = min(-f_theta_percent(camera), _LARGEST_PERCENT)
        return _unfolded(camera, -end), _unfolded(camera, end)
    low, high = given
    if stated:
        raise PlanningError(
            "the distortion is known from the coefficients of the camera, or the model has none: "
            "leave "
            "distortion_percent out, or set the coefficients to zero."
        )
    if not -_LARGEST_PERCENT <= low <= high <= _LARGEST_PERCENT:
        raise PlanningError(
            f"distortion_percent is {low:g} to {high:g}: give the least and the largest "
            "displacement of the corner in "
            f"per cent, within {_LARGEST_PERCENT:g} either way."
        )
    for end in (low, high):
        if (most := _unfolded(camera, end)) != end:
            raise PlanningError(
                f"distortion_percent is {low:g} to {high:g}: one coefficient that displaces the "
                f"corner by {end:g} per "
                f"cent folds inside this detector; stay within {most:.3g}."
            )
    return low, high


def _unfolded(camera: Camera, percent: float) -> float:
    """As much of a displacement of the corner as one coefficient can give without a fold on the
    detector, per cent.
    """
    corners = detector_corners(camera)
    for share in np.linspace(1.0, 0.02, 50):
        try:
            unproject(with_distortion(camera, percent * share / _NEAR_FOLD), corners)
        except DistortionError:
            continue
        return float(percent * share)
    return 0.0


def f_theta_percent(camera: Camera) -> float:
    """Displacement of the corner in an f-theta lens, to third order, per cent of its distance from
    the centre.
    """
    return 100.0 * F_THETA * (camera.half_diagonal_px / camera.focal_px) ** 2


def with_distortion(camera: Camera, percent: float) -> Camera:
    """The camera with a first coefficient that displaces the corner by so much, the others zero."""
    model = get_model(camera.distortion)
    sign = 1.0 if model.direction == "forward" else -1.0
    coefficient = sign * 0.01 * percent / camera.half_diagonal_px**2
    others = undistorted(camera.distortion, camera.theta)[4:]
    return camera.replace(coefficients=(coefficient, *others.tolist()))


def nodes(camera: Camera, bounds: tuple[float, float]) -> FloatArray:
    """Distortions to forecast at, per cent: the ends, none, evenly between, and around the worst of
    them.
    """
    low, high = bounds
    worst = [share * f_theta_percent(camera) for share in _BARREL]
    inside = [value for value in (0.0, *worst) if low < value < high]
    between = [] if inside else np.linspace(low, high, _NODES).tolist()
    return np.unique(np.round([low, high, *inside, *between], 6))


def distortion_range(
    base: FrameSet,
    stars: StarCatalogue,
    tracker: Tracker,
    bounds: tuple[float, float],
    outlook: Outlook,
    *,
    n_frames: Sequence[int],
    target_arcsec: float | None,
) -> DistortionRange:
    """Forecast over a range of distortions, `bounds` on the displacement of the corner, per cent.

    `base` are frames of the plan, of a camera whose distortion lies in the range.
    """
    camera = base.camera
    percent = nodes(camera, bounds)
    scopes = () if target_arcsec is None else SCOPES
    outlook = replace(outlook, n_campaigns=min(_CAMPAIGNS, outlook.n_campaigns))
    effects = None if base.seen is None else base.seen.planned
    frames, radius, sigmas = [], [], []
    for value in percent.tolist():
        other = with_distortion(camera, value)
        seen = base
        if other.coefficients != camera.coefficients:
            seen = random_frames(
                stars,
                replace(tracker, camera=other),
                n_frames=_GEOMETRIES if effects is None else min(_GEOMETRIES, base.n_frames),
                seed=outlook.seed,
                effects=effects,
            )
        needed = (
            Forecaster(seen, replace(outlook, scope=name)).frames_needed(target_arcsec or np.nan)
            for name in scopes
        )
        frames.append([np.inf if n is None else float(n) for n in needed])
        forecaster = Forecaster(seen, outlook)
        radius.append(forecaster.forecast(n_frames).radius)
        sigmas.append(forecaster.forecast((AFTER_FRAMES,)))
    point = np.array([[found.of(name)[0] for name in ("x0_px", "y0_px")] for found in sigmas])
    return DistortionRange(
        percent=percent,
        scopes=scopes,
        frames=np.array(frames, dtype=np.float64).reshape(len(percent), len(scopes)),
        radius_arcsec=np.array(radius),
        radius_after_arcsec=np.array([found.radius[0] for found in sigmas]),
        principal_point_px=np.sqrt(np.mean(point**2, axis=1)),
        focal_px=np.array([found.of("f_px")[0] for found in sigmas]),
        f_theta_percent=f_theta_percent(camera),
    )
