"""The field experiment's attitude errors over repetitions: another campaign, other test frames.

A printed error is one draw of an experiment. The repetitions say how far apart two draws lie: the noise of
the campaign is drawn anew around the true places of its stars, every method calibrates again, and the test frames are
drawn with replacement. Identifications and the campaign's attitudes stay.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import CalibrationError, DistortionError
from starcal_uq.core.tasks import Progress, run_tasks
from starcal_uq.core.types import FloatArray
from starcal_uq.estimation.calibrate import calibrate
from starcal_uq.paper.field.attitudes import FieldStars, attitude_errors
from starcal_uq.paper.published import PAPER_METHODS

if TYPE_CHECKING:
    from starcal_uq.observations.table import Observations

PARTS = ("rms", "aligned", "common", "rest", "noise")
_CHUNK = 4


@dataclass(frozen=True, eq=False)
class FieldReplicates:
    """Errors over repetitions.

    Attributes
    ----------
    draws : dict
        Camera name -> part -> (n, 3) array, arcsec, columns pitch, yaw, roll. The common rotation has its sign. A
        repetition in which a method failed is missing from its arrays.
    """

    draws: Mapping[str, Mapping[str, FloatArray]]

    def interval(self, camera: str, part: str) -> tuple[FloatArray, FloatArray]:
        """Ends (3,), (3,) of the range that 95 of 100 repetitions stay in; NaN without repetitions."""
        values = np.abs(self.draws[camera][part])
        if len(values) < 2:
            return np.full(3, np.nan), np.full(3, np.nan)
        low, high = np.quantile(values, (0.025, 0.975), axis=0)
        return low, high


class _ReplicateTask:
    """One repetition: {camera: {part: (3,)}}, without the methods that failed."""

    def __init__(
        self,
        campaign: Observations,
        campaign_px: FloatArray,
        scale: float,
        nominal: Camera,
        tests: Mapping[str, FieldStars],
        cameras: Mapping[str, Camera],
        seed: int,
    ) -> None:
        self.campaign, self.campaign_px, self.scale, self.nominal = campaign, campaign_px, scale, nominal
        self.tests, self.cameras, self.seed = tests, cameras, seed

    def __call__(self, number: int) -> dict[str, dict[str, FloatArray]]:
        rng = np.random.default_rng([self.seed, 2, number])
        sigma = np.ones(len(self.campaign_px)) if self.campaign.sigma_px is None else self.campaign.sigma_px
        xy = self.campaign_px + rng.standard_normal(self.campaign_px.shape) * (self.scale * sigma)[:, None]
        obs = replace(self.campaign, x_px=xy[:, 0], y_px=xy[:, 1])
        found = {}
        for index, (name, stars) in enumerate(self.tests.items()):
            camera = self.cameras[name]
            if name in PAPER_METHODS:
                try:
                    camera = calibrate(obs, self.nominal, method=name).camera
                except (CalibrationError, DistortionError):
                    continue
            # A source of its own for each camera: what one of them does leaves the others alone.
            rng = np.random.default_rng([self.seed, 3, number, index])
            chosen = rng.integers(stars.n_frames, size=stars.n_frames)
            errors = attitude_errors(stars.frames(chosen), camera)
            found[name] = {part: getattr(errors, part) for part in PARTS}
        return found


def replicate_field(
    campaign: Observations,
    campaign_px: FloatArray,
    scale: float,
    nominal: Camera,
    tests: Mapping[str, FieldStars],
    cameras: Mapping[str, Camera],
    *,
    n_replicates: int,
    seed: int,
    workers: int | None,
    progress: Progress | None,
) -> FieldReplicates:
    """Repeat calibration and test with other noise.

    Parameters
    ----------
    campaign : Observations
        What was calibrated.
    campaign_px : (m, 2) array
        Where its stars truly are.
    scale : float
        Noise over what is stated.
    nominal : Camera
        Start of the calibrations.
    tests : mapping
        Camera name to the stars that were identified with it.
    cameras : mapping
        Camera name to camera; those of the paper's methods are calibrated anew.
    n_replicates, seed, workers, progress
        As in `field_experiment`.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C.
    """
    results, interrupted = run_tasks(
        _ReplicateTask(campaign, campaign_px, scale, nominal, tests, cameras, seed),
        n_replicates,
        caller="field_experiment",
        chunk=_CHUNK,
        workers=workers,
        progress=progress,
    )
    if interrupted:
        raise KeyboardInterrupt
    empty = np.empty((0, 3))
    return FieldReplicates(
        {
            name: {part: np.array([one[name][part] for one in results if name in one] or empty) for part in PARTS}
            for name in tests
        }
    )
