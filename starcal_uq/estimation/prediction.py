"""The camera at a temperature, at a time, on another night: effects that move it, with their
covariance.

Effects change x0, y0 and f linearly in their coefficients, which have a joint posterior with the
camera's parameters. Where the data end, a prediction goes by what they say of the scale: beyond the
temperatures seen the covariance grows with the square of the distance, and a night that was not
seen draws offsets of its own.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.types import FloatArray, floats
from starcal_uq.likelihood.effects import corner_unit, pixels_of, place_effects
from starcal_uq.likelihood.shapes import TIME_DEGREE, seconds_utc
from starcal_uq.maths.linear import root_diagonal

if TYPE_CHECKING:
    from starcal_uq.likelihood.fitted_effects import Effects


@dataclass(frozen=True, eq=False)
class PredictedCamera:
    """A camera where and when it is asked for.

    Attributes
    ----------
    camera : Camera
        The prediction.
    covariance : (p, p) array
        Its covariance, px units, in the order of `Camera.parameter_names`.
    """

    camera: Camera
    covariance: FloatArray

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviation of each parameter, (p,)."""
        return root_diagonal(self.covariance)


def predicted(
    estimate: PredictedCamera,
    effects: Effects,
    temperature_c: float | None = None,
    time_utc: str | None = None,
    new_night: bool = False,
) -> PredictedCamera:
    """The camera of an estimate with effects; `Calibration.at` describes the others."""
    camera, names = estimate.camera, effects.names
    if not effects.fitted:
        if temperature_c is None and time_utc is None and not new_night:
            return estimate
        raise CalibrationError(
            "the calibration holds no effect that moves the camera: calibrate with effects "
            "'temperature', 'time' or 'epoch'."
        )
    # Change of the parameters (p, m) by the coefficients of the run.
    move = np.zeros((len(camera.theta), len(effects.coefficients)))
    covariance = estimate.covariance.copy()
    if temperature_c is not None:
        mean, spread = _known(effects.temperature_c, "temperature", names)
        move[:3, effects.at("temperature")] = np.eye(3) * (temperature_c - mean) / spread
    if time_utc is not None:
        from numpy.polynomial.legendre import legval

        first, last = _known(effects.time_s, "time", names)
        seconds = seconds_utc(np.array([time_utc]))
        if seconds is None:
            raise CalibrationError(f"time_utc {time_utc!r} is no time: give it as ISO 8601, UTC.")
        clock = 2.0 * (float(seconds[0]) - first) / (last - first) - 1.0
        powers = legval(clock, np.eye(TIME_DEGREE + 1)[:, 1:])
        move[:3, effects.at("time")] = np.kron(np.eye(3), powers)
    if new_night:
        _known((0.0, 1.0), "epoch", names)
        scale = effects.scale("epoch")
        covariance[:3, :3] += np.diag((scale * corner_unit(camera)) ** 2)
    crossed = effects.cross @ move.T
    covariance += crossed + crossed.T + move @ effects.covariance @ move.T
    theta = camera.theta + move @ effects.coefficients
    return PredictedCamera(camera.with_theta(floats(theta)), covariance)


def displacement(
    estimate: PredictedCamera,
    effects: Effects,
    xy: FloatArray,
    names: Collection[str] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Shifts (n, 2), px, and their covariances (n, 2, 2) by effects of the place at pixels (n, 2),
    those of some `names` or all; see `Calibration.displacement`.
    """
    n = len(xy)
    if not effects.fitted:
        return np.zeros((n, 2)), np.zeros((n, 2, 2))
    columns = np.zeros((len(effects.coefficients), 2, n))
    view, known = pixels_of(estimate.camera, xy.T), place_effects(estimate.camera)
    for name, effect in known.items():
        if name in effects.names and (names is None or name in names):
            columns[effects.at(name)] = effect.columns.columns(view)
    shift = np.einsum("m,mxn->nx", effects.coefficients, columns)
    spread = np.einsum("mxn,mk,kyn->nxy", columns, effects.covariance, columns, optimize=True)
    return shift, spread


def _known(values: tuple[float, float], name: str, names: tuple[str, ...]) -> tuple[float, float]:
    if name in names:
        return values
    raise CalibrationError(
        f"the calibration holds no effect {name!r}: calibrate with effects={name!r}, or leave it "
        "out of the question."
    )
