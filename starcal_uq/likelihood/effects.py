"""Effects: errors of the pixels that no parameter of the camera holds, linear, with a prior.

    pixel = project(theta; R_k r_s) + sum_e C_e a_e + noise,    a_e ~ N(0, tau_e^2 Lambda_e)

An effect belongs to the run, with one set of coefficients, to every frame, or to every star. The
coefficients of one whose prior is known may have an expected value that is not zero.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

import numpy as np

from starcal_uq.camera.distortion import get_model
from starcal_uq.camera.projection import unproject_theta
from starcal_uq.core.settings import EffectName
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.shapes import (
    TIME_DEGREE,
    Covariates,
    Extent,
    Shape,
    View,
    axes_shape,
    frame_shapes,
    magnitude_shape,
    nights_of,
    outwards,
    over_time,
    phase_shape,
    seconds_utc,
)
from starcal_uq.likelihood.star_errors import StarModel
from starcal_uq.likelihood.zenith import Zeniths
from starcal_uq.observations.frames import StarFrames

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.observations.table import Observations

# Highest order of the products of Legendre polynomials, and how fast higher orders shrink.
_ORDER, _SMOOTHNESS = 8, 1.5
# Points along the longer side of the detector on which a field is made orthogonal to the camera.
_GRID = 24
# Fewer stars than this that are seen twice do not tell their errors from noise.
_FEWEST_STARS = 5
# Stars whose many columns stay in the cache.
_STARS_AT_ONCE = 1_500


@dataclass(frozen=True, eq=False)
class Effect:
    """An effect with columns of pixel shifts."""

    name: str
    grouping: Literal["run", "frame", "star"]
    columns: Shape
    prior: FloatArray  # (c,): standard deviations of the coefficients for a scale of 1 px
    stars: StarModel | None = None  # Of an effect of the stars, whose scale is px at the boresight
    # (c,): expected coefficients of an effect of the run whose prior is known, its scale being 1
    mean: FloatArray | None = None
    # (c,): slopes of the log prior there beyond its Gaussian
    pull: FloatArray | None = None

    @property
    def of_run(self) -> bool:
        """Whether its coefficients belong to the run."""
        return self.grouping == "run"

    @property
    def known(self) -> bool:
        """Whether its prior is known, so that its scale is one and nothing to estimate."""
        return self.mean is not None


def effects_of(
    obs: Observations,
    camera: Camera,
    *,
    seen: Observations | None = None,
    zeniths: Zeniths | None = None,
    extent: Extent | None = None,
) -> dict[str, Effect]:
    """Every effect that a table allows, by name; its scale is px at the corner of the field.

    `camera`: the estimate. `seen`: other frames that the same effects are wanted on. `zeniths`:
    those of the frames, for the effect of air. `extent`: that of all frames, of which the table is
    a part; stars, which parts share, have no effect then.
    """
    known = Covariates.of(obs, seen, extent)
    corner = corner_unit(camera)
    found = list(place_effects(camera).values())
    found.append(Effect("frame", "frame", frame_shapes(camera), np.ones(3)))
    if known.warmth is not None:
        found.append(_run("temperature", _moving("temperature", known.warmth[None]), corner))
    if known.clock is not None:
        decay = 1.0 / np.arange(1.0, TIME_DEGREE + 1.0)
        found.append(
            _run("time", over_time(known.clock, known.called), np.outer(corner, decay).ravel())
        )
    nights = None if seen is not None else _nights(obs, extent)
    if nights is not None:
        found.append(_run("epoch", _moving("epoch", nights), np.tile(corner, len(nights))))
    if zeniths is not None:
        found.append(zenith_effect(obs if seen is None else seen, zeniths))
    if known.magnitude is not None:
        found.append(_run("magnitude", magnitude_shape(known.magnitude, camera)))
    if extent is None:
        stars = StarModel(obs if seen is None else seen, float(camera.focal_px))
        if seen is not None or stars.n_recurring >= _FEWEST_STARS or np.any(stars.stated2 > 0.0):
            found.append(star_effect(stars))
    return {effect.name: effect for effect in found}


def star_effect(stars: StarModel) -> Effect:
    """Errors of the stars' directions, px at the boresight, beyond what their catalogue states."""
    shape = Shape("directions of the stars", "star", 2, lambda view: view.uv[None][:0])
    return Effect("star", "star", shape, np.ones(2), stars)


def zenith_effect(obs: Observations, zeniths: Zeniths) -> Effect:
    """Refraction below zeniths, and their errors."""
    return Effect(
        "zenith",
        "run",
        zeniths.shape(obs),
        zeniths.prior,
        mean=zeniths.mean,
        pull=zeniths.pull if len(zeniths.pull) else None,
    )


def run_shifts(
    likelihood: MarginalLikelihood,
    effects: Sequence[tuple[Effect, FloatArray]],
    theta: FloatArray,
) -> FloatArray:
    """Shifts (2, N), px, of images by effects of the run with their coefficients, at theta (p,).

    Air bends light and does not turn the camera: attitudes keep what they reproduce of it.
    """
    found = np.zeros((2, likelihood.frames.n_stars))
    for part, state, rows in likelihood.pieces(theta, None, _STARS_AT_ONCE):
        view = View.of(part, state, theta, rows)
        for effect, coefficients in effects:
            shift = np.tensordot(coefficients, effect.columns.columns(view), 1)
            if effect.known:
                part.frames.whiten(shift)
                shift = part.frames.in_pixels(part.project_out(state, shift[None])[0])
            found[:, rows] += shift
    return found


def corner_unit(camera: Camera) -> FloatArray:
    """Changes (3,) of x0, y0 and f that move the corner of the field by one px."""
    return np.array([1.0, 1.0, float(camera.focal_px) / camera.corner_radius_px])


def _run(name: EffectName, columns: Shape, prior: FloatArray | None = None) -> Effect:
    return Effect(name, "run", columns, np.ones(columns.size) if prior is None else prior)


def _phase() -> Shape:
    both = phase_shape(0), phase_shape(1)
    return Shape(
        "error with the pixel phase",
        "pixel phase",
        sum(shape.size for shape in both),
        lambda view: np.concatenate([shape.columns(view) for shape in both]),
    )


def _moving(against: str, weights: FloatArray) -> Shape:
    """Changes of x0, y0 and f with each of the weights (w, N) of the stars."""

    def columns(view: View) -> FloatArray:
        moving = view.parameter_columns[:3]
        found = weights[:, None, None, view.rows] * moving
        return found.reshape(-1, *moving.shape[1:])

    return Shape(f"change of x0, y0 and f with {against}", against, 3 * len(weights), columns)


def _nights(obs: Observations, extent: Extent | None) -> FloatArray | None:
    """Membership (E, N) of the stars in nights; None where there is one."""
    seconds = None if obs.time_utc is None else seconds_utc(obs.time_utc)
    nights = nights_of(seconds) if extent is None else extent.nights_s
    if seconds is None or len(nights) < 2:
        return None
    return np.eye(len(nights))[:, np.searchsorted(nights[1:, 0], seconds, side="right")]


@lru_cache(maxsize=8)
def field_effect(camera: Camera) -> Effect:
    """A smooth displacement over the field: products of Legendre polynomials of x and y along each
    axis.

    Over the detector it is orthogonal to what parameters of the camera and a rotation do, so that
    these keep their meaning: the camera is the one that is nearest to the map.
    """
    half = np.array([camera.width_px, camera.height_px]) / 2.0
    i, j = np.array([(i, j) for i in range(_ORDER + 1) for j in range(_ORDER + 1 - i)]).T

    def raw(xy: FloatArray) -> FloatArray:
        from numpy.polynomial.legendre import legvander

        x, y = ((xy + 0.5) / half[:, None]) - 1.0
        waves = legvander(x, _ORDER).T[i] * legvander(y, _ORDER).T[j]
        return np.asarray(np.einsum("tn,xy->txyn", waves, np.eye(2)).reshape(-1, *xy.shape))

    return _smooth("field", camera, raw, i + j)


@lru_cache(maxsize=8)
def radial_effect(camera: Camera) -> Effect:
    """A smooth displacement along the radius: that of a lens which is a body of rotation.

    It hardly turns frames about the boresight. A field, which knows no symmetry, has to leave open
    whether it does.
    """

    def raw(xy: FloatArray) -> FloatArray:
        uv = xy - camera.theta[:2, None]
        return outwards(uv / camera.corner_radius_px, _ORDER + 1)

    return _smooth("radial", camera, raw, np.arange(_ORDER + 1))


def _smooth(
    name: EffectName,
    camera: Camera,
    raw: Callable[[FloatArray], FloatArray],
    order: IntArray,
) -> Effect:
    """Columns (c, 2, n) at pixels (2, n), less what the camera and a rotation do; smaller the
    higher the orders (t,) of their terms are.
    """
    unit, taken = _of_camera(camera, raw)
    removed = -taken.T / unit
    prior = np.asarray((1.0 + order) ** -_SMOOTHNESS, dtype=np.float64)
    prior = np.repeat(prior / np.sqrt(np.sum(prior**2)), len(removed) // len(order))

    def columns(view: View) -> FloatArray:
        return raw(view.predicted) + np.tensordot(removed, view.held, 1)

    shape = Shape(f"smooth {name} shift", name, len(prior), columns)
    return Effect(name, "run", shape, prior)


def _of_camera(
    camera: Camera, raw: Callable[[FloatArray], FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Units (p + 3,) of the camera's parameters and a rotation, and coefficients (p + 3, s) by
    which they imitate columns over the detector.
    """
    longer = max(camera.width_px, camera.height_px)
    sides = [
        np.linspace(-0.5, side - 0.5, max(2, round(_GRID * side / longer)))
        for side in (camera.width_px, camera.height_px)
    ]
    xy = np.stack([axis.ravel() for axis in np.meshgrid(*sides)])
    good = np.isfinite(unproject_theta(camera.distortion, camera.theta, xy.T)).all(axis=1)
    xy = np.ascontiguousarray(xy[:, good])
    view = pixels_of(camera, xy)
    held = np.concatenate([view.parameter_columns, view.state.attitude])
    flat = held.reshape(len(held), -1)
    unit = np.linalg.norm(flat, axis=1)
    taken = np.linalg.lstsq((flat / unit[:, None]).T, raw(xy).reshape(-1, flat.shape[1]).T)[0]
    return unit, taken


def pixels_of(camera: Camera, xy: FloatArray) -> View:
    """Pixels (2, n) of the detector as stars of one frame, for columns of effects there."""
    b = np.ascontiguousarray(unproject_theta(camera.distortion, camera.theta, xy.T).T)
    frames = StarFrames(np.ascontiguousarray(xy), b, None, np.array([0, xy.shape[1]]))
    whole = MarginalLikelihood(frames, camera.distortion)
    state, _ = whole.profile(camera.theta, np.eye(3)[None])
    return View.of(whole, state, camera.theta, slice(None))


def place_effects(camera: Camera) -> dict[str, Effect]:
    """Effects of the place on the detector alone, by name."""
    found = [] if get_model(camera.distortion).axes else [_run("axes", axes_shape(camera))]
    found += [field_effect(camera), radial_effect(camera), _run("phase", _phase())]
    return {effect.name: effect for effect in found}
