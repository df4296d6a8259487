"""The distortion that the posterior believes in: displacement against radius, with credible bands.

The displacement is what distortion does to an image point, distorted minus ideal, at the place
where the point is seen; its radial part points away from the principal point of each draw. A
pointwise band holds the given share of draws at each radius by itself; a curve of the posterior
leaves it somewhere more often than that. The simultaneous band is mean +- c sd with c such that the
given share of draws stays inside everywhere (the "sup-t" band; Montiel Olea & Plagborg-Moller 2019,
J. Applied Econometrics 34(1), 1-17).

Focal length and distortion are coupled: what one adds, the other takes off. These bands are of the
distortion alone; where there are stars, they are wider than the uncertainty of directions, which
the field map shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import DistortionModel, get_model
from starcal_uq.camera.planes import PINHOLE
from starcal_uq.camera.projection import unproject, unproject_theta
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import DistortionError
from starcal_uq.core.settings import Seed, bounded
from starcal_uq.core.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.table import Observations

_AZIMUTHS_DEG = (0.0, 45.0, 90.0, 135.0, 180.0, 225.0, 270.0, 315.0)

# Points that are inverted together: few calls, and little memory.
_POINTS_AT_ONCE = 50_000


@dataclass(frozen=True, eq=False)
class DistortionCurve(Shown):
    """Radial displacement against the radius at which a point is seen.

    Attributes
    ----------
    radius_px : (n,) array
        Distance from the principal point, from zero to the farthest corner of the detector.
    azimuth_deg : (A,) array
        Directions from the principal point, 0 along rising x and 90 along rising y; empty of
        meaning, and of length one, for models that are the same in all directions.
    mean_px, sd_px : (A, n) array
        Mean and standard deviation of the radial displacement over the posterior, px.
    lower_px, upper_px : (A, n) array
        Pointwise band.
    lower_simultaneous_px, upper_simultaneous_px : (A, n) array
        Band that holds whole curves, over all radii and azimuths at once.
    arcsec_per_px : (n,) array
        Angle that a radial displacement of one pixel stands for at each radius.
    level : float
        Share of the posterior in the bands.
    multiplier : float
        Half-width of the simultaneous band in standard deviations.
    model : str
        Distortion model.
    n_draws : int
        Draws used.
    star_radius_px : float
        Largest radius of an observed star: beyond it the curve is extrapolated; NaN where stars
        were not given.
    """

    radius_px: FloatArray
    azimuth_deg: FloatArray
    mean_px: FloatArray
    sd_px: FloatArray
    lower_px: FloatArray
    upper_px: FloatArray
    lower_simultaneous_px: FloatArray
    upper_simultaneous_px: FloatArray
    arcsec_per_px: FloatArray
    level: float
    multiplier: float
    model: str
    n_draws: int
    star_radius_px: float

    def to_dataframe(self) -> pd.DataFrame:
        """One row per azimuth and radius: mean, sd and bands in px, and mean and sd in arcsec."""
        import pandas as pd

        count, n = self.mean_px.shape
        scale = np.tile(self.arcsec_per_px, count)
        names = (
            "mean_px",
            "sd_px",
            "lower_px",
            "upper_px",
            "lower_simultaneous_px",
            "upper_simultaneous_px",
        )
        return pd.DataFrame(
            {
                "azimuth_deg": np.repeat(self.azimuth_deg, n),
                "radius_px": np.tile(self.radius_px, count),
                **{name: getattr(self, name).ravel() for name in names},
                "mean_arcsec": self.mean_px.ravel() * scale,
                "sd_arcsec": self.sd_px.ravel() * scale,
            }
        )


@bounded
def distortion_curve(
    post: Posterior,
    obs: Observations | None = None,
    *,
    n: int = 101,
    n_draws: int = 2000,
    level: float = 0.95,
    azimuths_deg: Sequence[float] | None = None,
    seed: Seed = 0,
) -> DistortionCurve:
    """Radial displacement against radius, with pointwise and simultaneous credible bands.

    Parameters
    ----------
    post : Posterior
        Draws of the camera.
    obs : Observations, optional
        Shows how far out stars were observed.
    n : int
        Radii from zero to the farthest corner.
    n_draws : int
        Draws taken at random from the posterior; all if there are fewer.
    level : float
        Share of the posterior in the bands.
    azimuths_deg : sequence of float, optional
        Directions for models with decentring terms; by default every 45 degrees. Others are the
        same in all.
    seed : int or Generator
        Chooses the draws.

    Raises
    ------
    ValueError
        For fewer than two radii or a level outside (0, 1).
    DistortionError
        For a camera without distortion, or when a draw folds the distortion within the detector.
    """
    if n < 2 or not 0.0 < level < 1.0:
        raise ValueError(
            f"a curve needs at least 2 radii and a level between 0 and 1, not {n} and {level:g}."
        )
    model = get_model(post.camera.distortion)
    if not model.lens:
        raise DistortionError(
            f"the camera's distortion model is {model.name!r}, so there is no curve: choose "
            "another model."
        )
    decentred = not model.radial
    chosen = _AZIMUTHS_DEG if azimuths_deg is None else tuple(azimuths_deg)
    azimuth = np.array(chosen if decentred else (0.0,), dtype=np.float64)
    camera = post.calibrated_camera
    radius = np.linspace(0.0, camera.corner_radius_px, n)
    outward = np.column_stack([np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))])
    offsets = (radius[None, :, None] * outward[:, None]).reshape(-1, 2)
    unproject(camera, _on_detector(model, offsets, post.mean) + post.mean[:2])
    draws = post.thin(n_draws, seed)[:, :-1]
    step = max(1, _POINTS_AT_ONCE // len(offsets))
    parts = (draws[first : first + step] for first in range(0, len(draws), step))
    curves = np.concatenate([_radial(model, part, offsets, outward) for part in parts])
    if not np.isfinite(curves).all():
        raise DistortionError(
            f"at some posterior draws the distortion {model.name!r} folds over within the "
            "detector: use more frames, a "
            "tighter prior or a model with fewer coefficients."
        )
    mean, sd = curves.mean(axis=0), curves.std(axis=0, ddof=1)
    tail = 50.0 * (1.0 - level)
    lower, upper = np.percentile(curves, (tail, 100.0 - tail), axis=0)
    positive = sd > 1e-9 * sd.max()
    excess = np.abs(curves - mean)[:, positive] / sd[positive]
    multiplier = float(np.quantile(excess.max(axis=1), level))
    f = float(post.mean[2])
    # The scale of a pinhole falls towards the edge, that of an f-theta lens does not.
    bent = radius if model.plane is PINHOLE else 0.0 * radius
    return DistortionCurve(
        radius_px=radius,
        azimuth_deg=azimuth,
        mean_px=mean,
        sd_px=sd,
        lower_px=lower,
        upper_px=upper,
        lower_simultaneous_px=mean - multiplier * sd,
        upper_simultaneous_px=mean + multiplier * sd,
        arcsec_per_px=ARCSEC * f / (f * f + bent * bent),
        level=level,
        multiplier=multiplier,
        model=model.name,
        n_draws=len(draws),
        star_radius_px=np.nan
        if obs is None
        else float(np.hypot(*(obs.xy - post.mean[:2]).T).max()),
    )


def _on_detector(model: DistortionModel, offsets: FloatArray, theta: FloatArray) -> FloatArray:
    """Offsets (N, 2) on the detector of points (N, 2) behind the lens."""
    return np.column_stack(model.stretched(offsets[:, 0], offsets[:, 1], theta))


def _radial(
    model: DistortionModel, thetas: FloatArray, offsets: FloatArray, outward: FloatArray
) -> FloatArray:
    """Radial part (d, A, n) of distorted minus ideal points, at offsets (A * n, 2) from each draw's
    principal point.
    """
    count, directions = len(thetas), len(outward)
    theta = np.repeat(thetas, len(offsets), axis=0)
    xy = _on_detector(model, np.tile(offsets, (count, 1)), theta.T) + theta[:, :2]
    b = unproject_theta(model.name, theta.T, xy)
    ideal = np.column_stack(model.plane.onto(b.T, theta[:, 2])).reshape(count, directions, -1, 2)
    displacement = offsets.reshape(directions, -1, 2) - ideal
    radial: FloatArray = np.sum(displacement * outward[:, None], axis=3)
    return radial
