"""Uncertainty of the direction that the camera assigns to each pixel, over the detector.

With B = db/dtheta at a pixel, the covariance of its direction is B Sigma B^T. Much of it is one
rotation of the whole field, which no measurement of angles sees and which every attitude takes up:
a shift of the principal point is nearly that. The rotation that a parameter error delta causes, phi
= -K delta, is the least-squares one over the detector,

    K = -(A^T W A)^-1 A^T W B,

where A is the derivative of the directions with respect to a rotation and the weight W is uniform
over the detector area. What remains has the covariance (B + A K) Sigma (B + A K)^T. Directions are
unit vectors, so that all of this is in radians in the tangent plane of each direction; no pixel
scale enters.

The *equivalent principal point* says the common rotation in pixels: it is the shift of (x0, y0)
that alone would turn the field by the same pitch and yaw.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from starcal_uq.camera.fields import (
    area_weights,
    detector_axes,
    grid_points,
    rotated,
    rotation_response,
    tangent_axes,
)
from starcal_uq.camera.projection import unproject, unproject_jacobian
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.display import Shown
from starcal_uq.core.records import Saved
from starcal_uq.core.remedy import RUN, Remedy
from starcal_uq.core.types import FloatArray
from starcal_uq.maths.linear import root_diagonal

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.table import Observations


@dataclass(frozen=True, eq=False)
class FieldMap(Shown, Saved):
    """1-sigma uncertainty of directions on a grid of pixels that spans the detector from edge to
    edge.

    Sigmas are per axis: the root of the mean variance of the two axes of the tangent plane, i.e. of
    half the trace. The ``worst`` fields hold the larger semi-axis of the 1-sigma ellipse.

    Attributes
    ----------
    x_px, y_px : (nx,), (ny,) array
        Grid, px.
    sigma_absolute_arcsec, sigma_compensated_arcsec : (ny, nx) array
        Before and after the best rotation of the field is removed.
    worst_absolute_arcsec, worst_compensated_arcsec : (ny, nx) array
        Along the worst direction.
    star_x_px, star_y_px : (N,) array
        Pixels where stars were observed, px: beyond them the map is extrapolated.
    covariance_absolute_arcsec2, covariance_compensated_arcsec2 : (ny, nx, 2, 2) array or None
        Covariance of each direction along camera X and Y (x and y of the image), from which the
        1-sigma ellipses are drawn; None when read from a file of an earlier version, which did not
        keep it.
    rotation_covariance_arcsec2 : (3, 3) array or None
        Covariance of the rotation that was removed: pitch, yaw, roll; None as above.
    equivalent_covariance_px2 : (2, 2) array or None
        Covariance of the shift of the principal point (x0, y0) that alone would cause the pitch and
        yaw of that rotation; None as above.
    """

    x_px: FloatArray
    y_px: FloatArray
    sigma_absolute_arcsec: FloatArray
    sigma_compensated_arcsec: FloatArray
    worst_absolute_arcsec: FloatArray
    worst_compensated_arcsec: FloatArray
    star_x_px: FloatArray
    star_y_px: FloatArray
    covariance_absolute_arcsec2: FloatArray | None = None
    covariance_compensated_arcsec2: FloatArray | None = None
    rotation_covariance_arcsec2: FloatArray | None = None
    equivalent_covariance_px2: FloatArray | None = None

    KIND = ""
    FILE = "a field map", Remedy("propagate", (RUN,), {"force": True}, "to write it again")
    SHAPES: ClassVar = """
        x: x_px
        y: y_px
        n: star_x_px star_y_px
        y x: sigma_absolute_arcsec sigma_compensated_arcsec worst_absolute_arcsec
        y x: worst_compensated_arcsec
        y x 2 2: covariance_absolute_arcsec2 covariance_compensated_arcsec2
        3 3: rotation_covariance_arcsec2
        2 2: equivalent_covariance_px2
    """

    @property
    def equivalent_principal_point_px(self) -> FloatArray | None:
        """1-sigma error (2,) of the principal point, x and y, that alone would cause the common
        rotation, px.
        """
        return _root_diagonal(self.equivalent_covariance_px2)

    @property
    def equivalent_principal_point_arcsec(self) -> FloatArray | None:
        """The same as an angle (2,): standard deviation of the yaw equivalent to x0, and of the
        pitch equivalent to y0.
        """
        angles = _root_diagonal(self.rotation_covariance_arcsec2)
        return None if angles is None else angles[[1, 0]]

    def to_dataframe(self) -> pd.DataFrame:
        """One row per grid pixel: ``x_px``, ``y_px``, the four maps, and the entries of both
        covariances.
        """
        import pandas as pd

        x, y = np.meshgrid(self.x_px, self.y_px)
        maps = {
            f.name: getattr(self, f.name).ravel() for f in fields(self) if f.name.endswith("arcsec")
        }
        kinds = {
            "absolute": self.covariance_absolute_arcsec2,
            "compensated": self.covariance_compensated_arcsec2,
        }
        entries = {"xx": (0, 0), "xy": (0, 1), "yy": (1, 1)}
        for kind, covariance in kinds.items():
            if covariance is not None:
                maps |= {
                    f"{kind}_{name}_arcsec2": covariance[:, :, i, j].ravel()
                    for name, (i, j) in entries.items()
                }
        return pd.DataFrame({"x_px": x.ravel(), "y_px": y.ravel(), **maps})


def field_map(post: Posterior, obs: Observations, n: int = 25) -> FieldMap:
    """Direction uncertainty over the detector by first-order propagation of the posterior's
    covariance.

    Parameters
    ----------
    post : Posterior
        Posterior, of which mean and covariance of the camera parameters are used.
    obs : Observations
        Only its star positions are kept, to show where the map is extrapolated.
    n : int
        Grid points along each side.

    Raises
    ------
    ValueError
        For fewer than two grid points.
    DistortionError
        When the distortion at the posterior mean folds over within the detector.
    """
    camera = post.calibrated_camera
    x, y = detector_axes(camera, n)
    xy = grid_points(x, y)
    unproject(camera, xy)
    b, B = unproject_jacobian(camera.distortion, post.mean, xy)
    response = rotation_response(b, B, area_weights(n))
    axes = tangent_axes(b)
    absolute, compensated = (
        _covariances(axes @ D, post.covariance, n) * ARCSEC**2
        for D in (B, B + rotated(-response, b))
    )
    rms, worst = zip(*(_sigmas(covariance) for covariance in (absolute, compensated)), strict=True)
    # What a shift of the principal point does to pitch and yaw, and the shift that does what all
    # parameters did.
    shift = np.linalg.solve(response[:2, :2], response[:2])
    return FieldMap(
        x_px=x,
        y_px=y,
        sigma_absolute_arcsec=rms[0],
        sigma_compensated_arcsec=rms[1],
        worst_absolute_arcsec=worst[0],
        worst_compensated_arcsec=worst[1],
        star_x_px=obs.x_px,
        star_y_px=obs.y_px,
        covariance_absolute_arcsec2=absolute,
        covariance_compensated_arcsec2=compensated,
        rotation_covariance_arcsec2=response @ post.covariance @ response.T * ARCSEC**2,
        equivalent_covariance_px2=shift @ post.covariance @ shift.T,
    )


def _covariances(J: FloatArray, covariance: FloatArray, n: int) -> FloatArray:
    """Covariances (n, n, 2, 2) of directions whose derivatives along the tangent axes are J (n * n,
    2, p).
    """
    matrices: FloatArray = J @ covariance @ np.swapaxes(J, 1, 2)
    return matrices.reshape(n, n, 2, 2)


def _sigmas(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Per-axis root mean square and largest semi-axis of ellipses (..., 2, 2)."""
    xx, yy, xy = covariance[..., 0, 0], covariance[..., 1, 1], covariance[..., 0, 1]
    half_trace, half_gap = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    return np.sqrt(half_trace), np.sqrt(half_trace + half_gap)


def _root_diagonal(covariance: FloatArray | None) -> FloatArray | None:
    return None if covariance is None else root_diagonal(covariance)
