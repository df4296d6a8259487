"""What effects of a calibration do against what they depend on: temperature, time, night, frame,
pixel phase, magnitude, star; and where the air is.

The effects are linear: values are products of a design with their coefficients, and standard
deviations those of the coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.attitude.earth import tangents
from starcal_uq.core.types import FloatArray, floats
from starcal_uq.likelihood.shapes import TIME_DEGREE, run_clock, seconds_utc
from starcal_uq.likelihood.star_errors import StarModel

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

_POINTS = 61
_OPTICS = ("x0", "y0", "f")


@dataclass(frozen=True, eq=False)
class EffectCurve:
    """What one effect does.

    Attributes
    ----------
    effect : str
        Name in the list of effects.
    against : str
        What it depends on: ``temperature [degC]``, ``time [h]`` and others, with its unit.
    names : tuple of str
        What changes: parameters of the camera, or components of a shift.
    x : (n,) array
        Where.
    values, sigmas : (q, n) array
        Changes and their standard deviations, px.
    place : str
        Where in the field the px are; empty for parameters of the camera.
    joined : bool
        Whether what lies between the points is meant as well.
    """

    effect: str
    against: str
    names: tuple[str, ...]
    x: FloatArray
    values: FloatArray
    sigmas: FloatArray
    place: str = ""
    joined: bool = True


@dataclass(frozen=True, eq=False)
class FoundZeniths:
    """Zeniths of K frames on the sky, degrees to the east and to the north of their middle.

    Attributes
    ----------
    zeniths, boresights : (K, 2) array
        Zeniths that were found, and where the frames look.
    covariances : (K, 2, 2) array
        Covariances of the zeniths.
    truth : (K, 2) array
        Zeniths of the site, where one is known; no rows otherwise.
    """

    zeniths: FloatArray
    covariances: FloatArray
    boresights: FloatArray
    truth: FloatArray


def effect_curves(cal: Calibration, obs: Observations) -> list[EffectCurve]:
    """Curves of the effects of a calibration of this table, in the order in which they were taken
    up; none of effects that are maps of the field.
    """
    made = {
        "temperature": _temperature,
        "time": _time,
        "epoch": _nights,
        "phase": _phase,
        "magnitude": _magnitude,
        "frame": _frames,
        "star": _stars,
    }
    return [
        curve for name in cal.known_effects.names if name in made for curve in made[name](cal, obs)
    ]


def _linear(
    cal: Calibration, effect: str, against: str, x: FloatArray, design: FloatArray
) -> EffectCurve:
    """The curve of the optics by a design (3, n, m) of the effect's coefficients."""
    effects = cal.known_effects
    at = effects.at(effect)
    spread = np.einsum("qnm,mk,qnk->qn", design, effects.covariance[at, at], design)
    values = design @ effects.coefficients[at]
    return EffectCurve(effect, against, _OPTICS, x, values, np.sqrt(spread))


def _temperature(cal: Calibration, obs: Observations) -> list[EffectCurve]:
    assert obs.temperature_c is not None
    mean, spread = cal.known_effects.temperature_c
    x = np.linspace(np.nanmin(obs.temperature_c), np.nanmax(obs.temperature_c), _POINTS)
    design = np.einsum("n,qm->qnm", (x - mean) / spread, np.eye(3))
    return [_linear(cal, "temperature", "temperature [°C]", x, design)]


def _time(cal: Calibration, obs: Observations) -> list[EffectCurve]:
    from numpy.polynomial.legendre import legvander

    clock = np.linspace(-1.0, 1.0, _POINTS)
    powers = legvander(clock, TIME_DEGREE)[:, 1:]
    design = np.stack([np.kron(row, powers) for row in np.eye(3)])
    x, against = _when(obs)
    x = x.min() + np.ptp(x) * (clock + 1.0) / 2.0
    return [_linear(cal, "time", against, x, design)]


def _when(obs: Observations) -> tuple[FloatArray, str]:
    """Time of every frame (K,), or its number, and what that is called."""
    seconds = None if obs.time_utc is None else seconds_utc(obs.time_utc[obs.frame_starts[:-1]])
    if seconds is None or run_clock(obs)[1] != "time":
        return np.arange(1.0, obs.n_frames + 1.0), "frame, in order"
    hours = (seconds - seconds.min()) / 3600.0
    days = np.ptp(hours) > 72.0
    return (hours / 24.0, "time [d]") if days else (hours, "time [h]")


def _nights(cal: Calibration, obs: Observations) -> list[EffectCurve]:
    n = dict(cal.known_effects.places)["epoch"] // 3
    design = np.eye(3 * n).reshape(n, 3, 3 * n).swapaxes(0, 1)
    curve = _linear(cal, "epoch", "night", np.arange(1.0, n + 1.0), design)
    return [replace(curve, joined=False)]


def _phase(cal: Calibration, obs: Observations) -> list[EffectCurve]:
    x = np.linspace(-0.5, 0.5, _POINTS)
    shift, covariance = cal.displacement(np.column_stack([x, x]), names=("phase",))
    sigmas = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)).T
    axes = ("along x", "along y")
    against = "place in the pixel [px]"
    return [EffectCurve("phase", against, axes, x, shift.T, sigmas)]


def _magnitude(cal: Calibration, obs: Observations) -> list[EffectCurve]:
    assert obs.mag is not None
    x = np.linspace(np.nanmin(obs.mag), np.nanmax(obs.mag), _POINTS)
    z = (x - np.nanmean(obs.mag)) / np.nanstd(obs.mag)
    design = np.einsum("np,qm->qnpm", np.column_stack([z, z**2]), np.eye(3)).reshape(3, _POINTS, 6)
    curve = _linear(cal, "magnitude", "magnitude", x, design)
    return [replace(curve, names=("x", "y", "scale"), place="scale at the corner")]


def _frames(cal: Calibration, obs: Observations) -> list[EffectCurve]:
    found = cal.known_effects
    if len(found.frames) != obs.n_frames:
        return []
    x, against = _when(obs)
    names = ("scale", "stretch along x", "shear")
    values, sigmas = found.frames.T, found.frame_sigmas.T
    return [EffectCurve("frame", against, names, x, values, sigmas, "at the corner", False)]


def _stars(cal: Calibration, obs: Observations) -> list[EffectCurve]:
    found, model = cal.known_effects, StarModel(obs, float(cal.camera.focal_px))
    if len(found.stars) != len(model.images):
        return []
    x, against = model.images.astype(np.float64), "images of the star"
    if obs.mag is not None:
        x, against = np.bincount(model.numbers, obs.mag) / model.images, "magnitude"
    sizes = np.hypot(*found.stars.T)[None]
    sigmas = np.sqrt(np.mean(found.star_sigmas**2, axis=1))[None]
    names, place = ("size of the offset",), "at the boresight"
    return [EffectCurve("star", against, names, x, sizes, sigmas, place, False)]


def found_zeniths(cal: Calibration, true_zeniths: FloatArray | None = None) -> FoundZeniths | None:
    """Zeniths that the effect of air found, on the sky; `true_zeniths` (K, 3) are those of the
    site, ICRS axes. None without that effect.
    """
    found = cal.known_effects
    if found.zeniths is None:
        return None
    rotations = cal.rotations
    boresights = rotations[np.searchsorted(cal.frame_ids, found.zeniths.frame_ids), 2]
    place = found.at("zenith")
    zeniths = found.zeniths.moved(found.coefficients[place], boresights)
    n = len(zeniths.places)
    number = np.arange(n) if zeniths.apiece else np.zeros(len(zeniths.axes), dtype=np.int64)
    # North and east of every place, behind each other.
    own = found.covariance[place, place][: 2 * n, : 2 * n].reshape(2, n, 2, n)
    covariances = np.degrees(1.0) ** 2 * own[:, number, :, number][:, ::-1, ::-1]
    middle = zeniths.among_stars.mean(axis=0)
    middle /= np.linalg.norm(middle)

    def seen(directions: FloatArray) -> FloatArray:
        """Distances from the middle along its directions to the east and to the north."""
        north, east = tangents(middle[None])
        across = np.column_stack([directions @ east[0], directions @ north[0]])
        length = np.hypot(*across.T)
        angle = np.degrees(np.arctan2(length, directions @ middle))
        return floats(across * (angle / np.maximum(length, 1e-12))[:, None])

    truth = np.zeros((0, 2)) if true_zeniths is None else seen(true_zeniths)
    return FoundZeniths(seen(zeniths.among_stars), covariances, seen(boresights), truth)
