"""Rows that a sensor fills: what its rate and its age add to the noise of an attitude."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.budgeting.posterior import of_axes
from starcal_uq.budgeting.rows import FROM_FILE, Contributor, Remark
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.errors import BudgetError
from starcal_uq.core.findings import clause
from starcal_uq.core.types import FloatArray
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.maths.linear import root_diagonal
from starcal_uq.observations.frames import StarFrames

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.observations.table import Observations
    from starcal_uq.simulation.sensor import Sensor

MOTION, END_OF_LIFE = "motion during exposure", "end-of-life noise"


def sensor_rows(
    sensor: Sensor, camera: Camera, frames: Observations, name: str = ""
) -> tuple[Contributor, ...]:
    """Noise by the rate of a sensor beyond that at rest, and by its age beyond that of a new one.

    Both are differences of the covariance of attitudes over the frames, so that the rows and the
    noise of the new sensor at rest add up to that of the sensor as it is. A rate or an age of zero
    fills no row.

    Parameters
    ----------
    sensor : Sensor
        The sensor, with its rate and its age.
    camera : Camera
        The calibrated camera.
    frames : Observations
        Stars of the mission, with their magnitudes.
    name : str
        Where the sensor is stated, as provenance.

    Raises
    ------
    BudgetError
        If the frames have no magnitudes.
    SensorError
        If sky and dark current fill the pixels.
    """
    still = sensor.replace(rate_deg_s=0.0, age_years=0.0)
    new = sensor.replace(age_years=0.0)
    if new == still and sensor == new:
        return ()
    before, moving, old = (noise_covariance(one, camera, frames) for one in (still, new, sensor))
    added = {MOTION: moving - before, END_OF_LIFE: old - moving}
    if new == still:
        del added[MOTION]
    if sensor == new:
        del added[END_OF_LIFE]
    expected = {entry.name: entry for entry in FROM_FILE}
    own = root_diagonal(before)
    rows: list[Contributor] = []
    for row, covariance in added.items():
        facts = {"of_rate": row == MOTION, "sensor": sensor, "own_arcsec": own}
        rows += of_axes(
            expected[row],
            covariance,
            conditions=clause(Remark.OF_SENSOR, n_frames=frames.n_frames, **facts),
            provenance=f"sensor {name}".strip(),
            source="file",
        )
    return tuple(rows)


def noise_covariance(sensor: Sensor, camera: Camera, frames: Observations) -> FloatArray:
    """Mean covariance (3, 3) of the attitudes of frames by the centroid noise of a sensor,
    arcsec^2; the squared noise-equivalent angles stand on its diagonal.
    """
    if frames.mag is None or not np.isfinite(frames.mag).all():
        raise BudgetError(
            "the noise of a sensor needs the magnitude of every star, and the frames lack some: "
            "give a column mag, or leave out the key sensor of [budget]."
        )
    stars = replace(
        StarFrames.from_observations(frames), weight=1.0 / sensor.noise(camera)(frames.mag)
    )
    state, _ = MarginalLikelihood(stars, camera.distortion).profile(camera.theta)
    covariance: FloatArray = ARCSEC**2 * state.inverse.mean(axis=2)
    return covariance
