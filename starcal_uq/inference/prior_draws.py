"""What the prior says before any data: cameras drawn from it, and the images they would make of the
observed stars.

A prior is checked in terms that can be judged by eye: fields of view, displacements at the corner,
shifts of field positions. With observations, it is also checked against them: each drawn camera
images the observed stars, and attitude-free summaries of such images are compared with those of the
real one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model
from starcal_uq.camera.projection import (
    fold_radius_px,
    forward_kernel,
    forward_root,
    unproject_theta,
)
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import PriorError
from starcal_uq.core.settings import Seed, bounded, check_memory
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.observations.frames import StarFrames

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.inference.priors import Priors
    from starcal_uq.observations.table import Observations

# Data beyond these prior predictive quantiles are a surprise.
_SURPRISE = 0.01
_QUANTILES = (0.005, 0.5, 0.995)
_ONE_SIDED = "residual_px"
_MAX_FRAMES = 30
_GRID = 5


@dataclass(frozen=True, eq=False)
class PriorPredictive(Shown):
    """Prior predictive distributions of q quantities, and where the data lie in them.

    Attributes
    ----------
    names : tuple of str
        Quantities; the unit is in the name.
    draws : array (n, q)
        Values for cameras drawn from the prior; NaN where a camera has no image of the field.
    observed : array (q,)
        Values for the data; NaN for those that only a camera has.
    tail : array (q,)
        Prior predictive tail probability of the data: two-sided, but for ``residual_px`` that of a
        larger one, since a camera simpler than the prior's is no conflict.
    field_px : array (g, 2)
        Field positions, px.
    shift_px : array (n, g)
        Distance by which a drawn camera moves them from where the nominal camera puts them, best
        rotation removed, px.
    folded : float
        Share of the drawn cameras whose distortion folds over inside the field, or which have no
        image of it.
    off_detector : float
        Share of the drawn cameras with the principal point off the detector.
    """

    names: tuple[str, ...]
    draws: FloatArray
    observed: FloatArray
    tail: FloatArray
    field_px: FloatArray
    shift_px: FloatArray
    folded: float
    off_detector: float

    @property
    def surprising(self) -> tuple[str, ...]:
        """Quantities in which the data lie outside the prior's central 99 %, allowing for their
        number.
        """
        n = int(np.sum(np.isfinite(self.tail)))
        return tuple(
            name
            for name, tail in zip(self.names, self.tail, strict=True)
            if tail < _SURPRISE / max(n, 1)
        )

    @property
    def ok(self) -> bool:
        """True if the data are no surprise to the prior."""
        return not self.surprising

    def to_dataframe(self) -> pd.DataFrame:
        """One row per quantity: quantiles under the prior, value of the data, tail probability."""
        import pandas as pd

        with np.errstate(all="ignore"):
            quantiles = np.nanquantile(self.draws, _QUANTILES, axis=0)
        columns: AnyDict = {"quantity": self.names}
        columns |= {f"q{100 * q:g}": quantiles[i] for i, q in enumerate(_QUANTILES)}
        return pd.DataFrame({**columns, "observed": self.observed, "tail_probability": self.tail})


@bounded
def prior_predictive(
    priors: Priors,
    camera: Camera,
    obs: Observations | None = None,
    *,
    n_draws: int = 200,
    seed: Seed = 0,
) -> PriorPredictive:
    """Draw cameras from a prior and look at what they would see.

    Of each camera: the field of view, the displacement by distortion at the corner, and the shift
    of field positions from the nominal camera. Of each image of the observed stars, seen with the
    nominal camera and the best attitude of each frame: the scale (percent, positive for a longer
    focal length), the cubic distortion at the corner, and the residuals that neither explains.
    These summaries do not depend on what any calibration found.

    Parameters
    ----------
    priors : Priors
        Priors to check.
    camera : Camera
        Nominal camera of the same distortion model.
    obs : Observations, optional
        The data; up to 30 frames are used, evenly spread.
    n_draws : int
        Number of cameras, at least 100 for the tail probabilities to mean something.
    seed : int or Generator
        Repeats bit for bit.

    Raises
    ------
    PriorError
        For priors of another distortion model or kind of noise, or too few draws.
    """
    if priors.distortion != camera.distortion:
        raise PriorError(
            f"the priors are for {priors.distortion!r}, the camera has {camera.distortion!r}: "
            "use one model."
        )
    if n_draws < 100:
        raise PriorError(f"n_draws is {n_draws}: at least 100 are needed for tail probabilities.")
    if obs is not None and priors.per_star_sigma != (obs.sigma_px is not None):
        raise PriorError(
            "the priors' noise is not of the kind of the observations: make them with "
            "per_star_sigma to suit."
        )
    rng = np.random.default_rng(seed)
    draws = priors.draw(n_draws, rng)
    field = _field(camera)
    check_memory(f"n_draws={n_draws}", 8.0 * n_draws * len(field))
    columns = {
        name: np.full(n_draws, np.nan)
        for name in ("fov_h_deg", "fov_v_deg", "corner_displacement_px")
    }
    shift, folded = np.full((n_draws, len(field)), np.nan), np.zeros(n_draws, dtype=bool)
    nominal = unproject_theta(camera.distortion, camera.theta, field)
    for i, theta in enumerate(draws[:, :-1]):
        folded[i] = theta[2] <= 0.0 or _folds(camera, theta)
        if folded[i]:
            continue
        columns["fov_h_deg"][i], columns["fov_v_deg"][i] = _field_of_view(camera, theta)
        columns["corner_displacement_px"][i] = _corner_displacement(camera, theta)
        shift[i] = _shift(camera, theta, field, nominal)
    columns["largest_field_shift_px"] = shift.max(axis=1)
    observed = {name: float("nan") for name in columns}
    if obs is not None:
        images = _Images(camera, obs)
        columns |= images.replicate(draws, folded, rng)
        observed |= images.observed()
    values, data = np.stack(list(columns.values()), axis=1), np.array(list(observed.values()))
    inside = camera.contains(draws[:, :2])
    return PriorPredictive(
        names=tuple(columns),
        draws=values,
        observed=data,
        tail=np.array([_tail(values[:, i], data[i], name) for i, name in enumerate(columns)]),
        field_px=field,
        shift_px=shift,
        folded=float(np.mean(folded)),
        off_detector=float(np.mean(~inside)),
    )


def _tail(values: FloatArray, observed: float, name: str) -> float:
    """Tail probability of a value under draws; beyond all of them, by the normal tail of their
    median and spread.
    """
    from scipy.special import erfc

    drawn = values[np.isfinite(values)]
    if not np.isfinite(observed) or not len(drawn):
        return float("nan")
    above, below = float(np.mean(drawn >= observed)), float(np.mean(drawn <= observed))
    share = above if name == _ONE_SIDED else min(2.0 * min(above, below), 1.0)
    if share > 0.0:
        return share
    low, middle, high = np.quantile(drawn, (0.16, 0.5, 0.84))
    spread = max(
        float(high - middle) if observed > middle else float(middle - low),
        np.finfo(np.float64).tiny,
    )
    return min(float(erfc(abs(observed - middle) / spread / np.sqrt(2.0))), 1.0 / len(drawn))


def _field(camera: Camera) -> FloatArray:
    x, y = (np.linspace(-0.5, size - 0.5, _GRID) for size in (camera.width_px, camera.height_px))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _folds(camera: Camera, theta: FloatArray) -> bool:
    corners = _field(camera)[[0, _GRID - 1, -_GRID, -1]]
    radius = float(np.max(np.hypot(*(corners - theta[:2]).T)))
    return bool(fold_radius_px(camera.distortion, theta, radius) <= radius)


def _field_of_view(camera: Camera, theta: FloatArray) -> tuple[float, float]:
    """Full angles (horizontal, vertical) between the middles of opposite edges, degrees."""
    (cx, cy), w, h = camera.centre_px, camera.width_px - 0.5, camera.height_px - 0.5
    b = unproject_theta(
        camera.distortion, theta, np.array([(-0.5, cy), (w, cy), (cx, -0.5), (cx, h)])
    )
    horizontal, vertical = (
        np.arctan2(np.linalg.norm(np.cross(u, v)), u @ v) for u, v in ((b[0], b[1]), (b[2], b[3]))
    )
    return float(np.rad2deg(horizontal)), float(np.rad2deg(vertical))


def _corner_displacement(camera: Camera, theta: FloatArray) -> float:
    """Radial displacement by distortion at the nominal corner radius, along the diagonal, px."""
    along = camera.corner_radius_px / np.sqrt(2.0)
    dx, dy = get_model(camera.distortion).displacement(along, along, tuple(theta[3:]))
    return float((dx + dy) / np.sqrt(2.0))


def _shift(camera: Camera, theta: FloatArray, field: FloatArray, nominal: FloatArray) -> FloatArray:
    """Pixel shifts (g,) of field positions against the nominal camera, after the best rotation."""
    frames = StarFrames(field.T.copy(), nominal.T.copy(), None, np.array([0, len(field)]))
    state, cost = MarginalLikelihood(frames, camera.distortion).profile(theta)
    return np.hypot(*state.e) if np.isfinite(cost) else np.full(len(field), np.nan)


class _Images:
    """Images of the observed stars, summarised with the nominal camera."""

    def __init__(self, camera: Camera, obs: Observations) -> None:
        chosen = np.unique(
            np.linspace(0, obs.n_frames - 1, min(_MAX_FRAMES, obs.n_frames)).astype(np.int64)
        )
        self.camera = camera
        self.frames = StarFrames.from_observations(obs.select_frames(obs.frame_ids[chosen]))
        self.rotations = MarginalLikelihood(self.frames, camera.distortion).start_rotations(
            camera.theta
        )
        self.b = self.frames.rotated(self.rotations)

    def observed(self) -> dict[str, float]:
        return self._summary(self.frames.pixel)

    def replicate(
        self, draws: FloatArray, folded: Any, rng: np.random.Generator
    ) -> dict[str, FloatArray]:
        model, n = self.camera.distortion, self.frames.n_stars
        project: Callable[..., Any] = forward_kernel(model, "attitude")
        rows = []
        for draw, bad in zip(draws, folded, strict=True):
            noise = self.frames.in_pixels(rng.standard_normal((2, n)) * draw[-1])
            theta = draw[:-1]
            if bad:
                rows.append(self._nothing())
                continue
            with np.errstate(all="ignore"):
                xy = project(n, theta, self.b, forward_root(model, theta, self.b))[0]
            rows.append(self._summary(xy + noise) if np.all(np.isfinite(xy)) else self._nothing())
        return {name: np.array([row[name] for row in rows]) for name in rows[0]}

    @staticmethod
    def _nothing() -> dict[str, float]:
        return dict.fromkeys(("scale_percent", "cubic_corner_px", "residual_px"), float("nan"))

    def _summary(self, pixel: FloatArray) -> dict[str, float]:
        """Scale, cubic distortion and remaining residual rms of an image (2, N), attitudes fitted
        with them.
        """
        frames = StarFrames(pixel, self.frames.r, None, self.frames.starts)
        likelihood = MarginalLikelihood(frames, self.camera.distortion)
        state, cost = likelihood.profile(self.camera.theta, self.rotations)
        if not np.isfinite(cost):
            return self._nothing()
        offset = frames.rotated(state.rotations)
        offset = self.camera.focal_px * offset[:2] / offset[2]
        corner = self.camera.corner_radius_px
        cubic = offset * np.sum(offset**2, axis=0) / corner**3
        columns = likelihood.project_out(state, np.stack([offset / 100.0, cubic])).reshape(2, -1)
        e = likelihood.project_out(state, state.e[None]).reshape(-1)
        solution = np.linalg.lstsq(columns.T, e, rcond=None)[0]
        rest = e - solution @ columns
        dof = max(likelihood.dof - 2, 1)
        return {
            "scale_percent": float(solution[0]),
            "cubic_corner_px": float(solution[1]),
            "residual_px": float(np.sqrt(rest @ rest / dof)),
        }
