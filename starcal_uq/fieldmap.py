"""Uncertainty of the direction that the camera assigns to each pixel, over the detector.

With B = db/dtheta at a pixel, the covariance of its direction is B Sigma B^T. Much of it is one rotation of the whole
field, which no measurement of angles sees and which every attitude takes up: a shift of the principal point is nearly
that. The rotation that a parameter error delta causes, phi = -K delta, is the least-squares one over the detector,

    K = -(A^T W A)^-1 A^T W B,

where A is the derivative of the directions with respect to a rotation and the weight W is uniform over the detector
area. What remains has the covariance (B + A K) Sigma (B + A K)^T. Directions are unit vectors, so that all of this is
in radians in the tangent plane of each direction; no pixel scale enters.
"""

from __future__ import annotations

import os
import zipfile
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq._types import FloatArray
from starcal_uq.errors import RunFolderError
from starcal_uq.formatting import significant
from starcal_uq.projection import unproject, unproject_jacobian
from starcal_uq.runfolder import atomic_path

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.observations import Observations
    from starcal_uq.posterior import Posterior

_ARCSEC = 648_000.0 / np.pi


@dataclass(frozen=True, eq=False)
class FieldMap:
    """1-sigma uncertainty of directions on a grid of pixels that spans the detector from edge to edge.

    Sigmas are per axis: the root of the mean variance of the two axes of the tangent plane, i.e. of half the trace. The
    ``worst`` fields hold the larger semi-axis of the 1-sigma ellipse.

    Attributes
    ----------
    x_px, y_px : (nx,), (ny,) array
        Grid, px.
    sigma_absolute_arcsec, sigma_compensated_arcsec : (ny, nx) array
        Before and after the best rotation of the field is removed.
    worst_absolute_arcsec, worst_compensated_arcsec : (ny, nx) array
        Along the worst direction.
    star_x_px, star_y_px : (N,) array
        Where stars were observed: beyond them the map is extrapolated.
    """

    x_px: FloatArray
    y_px: FloatArray
    sigma_absolute_arcsec: FloatArray
    sigma_compensated_arcsec: FloatArray
    worst_absolute_arcsec: FloatArray
    worst_compensated_arcsec: FloatArray
    star_x_px: FloatArray
    star_y_px: FloatArray

    def to_dataframe(self) -> pd.DataFrame:
        """One row per grid pixel: ``x_px``, ``y_px`` and the four maps."""
        import pandas as pd

        x, y = np.meshgrid(self.x_px, self.y_px)
        maps = {f.name: getattr(self, f.name).ravel() for f in fields(self) if f.name.endswith("arcsec")}
        return pd.DataFrame({"x_px": x.ravel(), "y_px": y.ravel(), **maps})

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all arrays to one ``.npz`` file, atomically; overwritten."""
        arrays = {f.name: getattr(self, f.name) for f in fields(self)}
        with atomic_path(path) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> FieldMap:
        """Read what `save` wrote, without loss.

        Raises
        ------
        RunFolderError
            If the file is missing or is not a field map.
        """
        try:
            # Opened here: NumPy leaves a file open that turns out not to be what it seems.
            with open(path, "rb") as file, np.load(file, allow_pickle=False) as arrays:
                return cls(**{f.name: arrays[f.name] for f in fields(cls)})
        except OSError as error:
            raise RunFolderError(
                f"{path}: cannot be read ({error.strerror or error}); run `starcal-uq propagate RUN` first."
            ) from error
        except (KeyError, ValueError, TypeError, EOFError, AttributeError, zipfile.BadZipFile) as error:
            raise RunFolderError(
                f"{path}: is not a field map; run `starcal-uq propagate RUN` to write it again."
            ) from error

    def plot_field_map(self, **options: Any) -> Any:
        """Both maps; options as for `starcal_uq.plots.plot_field_map`."""
        from starcal_uq.plots import plot_field_map

        return plot_field_map(self, **options)

    def _repr_html_(self) -> str:
        def row(name: str, sigma: FloatArray, worst: FloatArray) -> str:
            values = (np.min(sigma), np.median(sigma), np.max(sigma), np.max(worst))
            return f"<tr><td>{name}</td>{''.join(f'<td>{significant(float(v))}</td>' for v in values)}</tr>"

        head = "".join(f"<th>{t}</th>" for t in ("", "least", "median", "largest", "worst direction"))
        return (
            "<p><b>Direction uncertainty over the detector</b>, 1 sigma per axis, arcsec.</p>"
            f"<table><thead><tr>{head}</tr></thead><tbody>"
            f"{row('absolute', self.sigma_absolute_arcsec, self.worst_absolute_arcsec)}"
            f"{row('best rotation removed', self.sigma_compensated_arcsec, self.worst_compensated_arcsec)}"
            "</tbody></table>"
        )


def field_map(post: Posterior, obs: Observations, n: int = 25) -> FieldMap:
    """Direction uncertainty over the detector by first-order propagation of the posterior's covariance.

    Parameters
    ----------
    post : Posterior
        Its mean and covariance of the camera parameters are used.
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
    if n < 2:
        raise ValueError(f"a map needs at least 2 grid points along each side, not {n}.")
    camera = post.camera.with_theta(post.mean)
    x = np.linspace(-0.5, camera.width_px - 0.5, n)
    y = np.linspace(-0.5, camera.height_px - 0.5, n)
    xy = np.column_stack([grid.ravel() for grid in np.meshgrid(x, y)])
    unproject(camera, xy)
    b, B = unproject_jacobian(camera.distortion, post.mean, xy)
    # The trapezoidal rule: grid points on an edge stand for half the area, those in a corner for a quarter.
    side = np.ones(n)
    side[[0, -1]] = 0.5
    compensated = B + _rotated(-_rotation_response(b, B, np.outer(side, side).ravel()), b)
    maps = [_ellipse(D, post.covariance, (n, n)) for D in (B, compensated)]
    return FieldMap(
        x_px=x,
        y_px=y,
        sigma_absolute_arcsec=maps[0][0],
        sigma_compensated_arcsec=maps[1][0],
        worst_absolute_arcsec=maps[0][1],
        worst_compensated_arcsec=maps[1][1],
        star_x_px=obs.x_px,
        star_y_px=obs.y_px,
    )


def _rotation_response(b: FloatArray, B: FloatArray, w: FloatArray) -> FloatArray:
    """Rotation (3, p) that fits the displacements B (N, 3, p) of directions b (N, 3) best, with weights w (N,).

    A phi = phi x b, so that A^T A = I - b b^T and A^T B = b x B.
    """
    normal = np.einsum("n,nij->ij", w, np.eye(3) - b[:, :, None] * b[:, None, :])
    torque = np.einsum("n,npi->ip", w, np.cross(b[:, None], np.swapaxes(B, 1, 2)))
    response: FloatArray = np.linalg.solve(normal, torque)
    return response


def _rotated(K: FloatArray, b: FloatArray) -> FloatArray:
    """Displacements (N, 3, p) of the directions b (N, 3) by the rotations K (3, p)."""
    return np.swapaxes(np.cross(K.T[None], b[:, None]), 1, 2)


def _ellipse(D: FloatArray, covariance: FloatArray, shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Per-axis root mean square and largest semi-axis, arcsec, of the covariances D Sigma D^T."""
    C = D @ covariance @ np.swapaxes(D, 1, 2)
    # The covariance has rank two, in the tangent plane: its non-zero eigenvalues from trace and |C|^2.
    half_trace = 0.5 * np.trace(C, axis1=1, axis2=2)
    half_gap = np.sqrt(np.maximum(0.5 * np.sum(C * C, axis=(1, 2)) - half_trace**2, 0.0))
    rms, worst = np.sqrt(half_trace), np.sqrt(half_trace + half_gap)
    return rms.reshape(shape) * _ARCSEC, worst.reshape(shape) * _ARCSEC
