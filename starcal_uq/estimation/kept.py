"""Frames of a calibration at its estimate."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.attitude.rotations import rotation_to_quaternion
from starcal_uq.camera.camera import Camera
from starcal_uq.core.later import Later
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.observations.repeats import Fingerprints

if TYPE_CHECKING:
    from starcal_uq.observations.frames import StarFrames
    from starcal_uq.observations.table import Observations


@dataclass(frozen=True)
class KeptFrames:
    """Frames of a calibration at its estimate: what it keeps of the data, star by star."""

    frame_ids: IntArray  # (K,)
    quaternions: FloatArray  # (K, 4): scalar-last R_cam_icrs
    residuals_px: FloatArray  # (N, 2): observed minus predicted
    fingerprints: Fingerprints | Later[Fingerprints] | None
    per_star: bool  # Whether the stars state their noise
    data_hash: str | None

    @classmethod
    def of(
        cls,
        obs: Observations,
        frames: StarFrames,
        rotations: FloatArray,
        whitened: FloatArray,
        camera: Camera,
    ) -> KeptFrames:
        """All frames of a table: `rotations` (K, 3, 3), residuals `whitened` (2, N); the detector of
        `camera`.
        """
        residuals = frames.in_pixels(whitened).T
        return cls(
            frame_ids=obs.frame_ids,
            quaternions=rotation_to_quaternion(rotations),
            residuals_px=residuals,
            fingerprints=Later(partial(Fingerprints.of, obs, residuals, camera.centre_px)),
            per_star=frames.weight is not None,
            data_hash=obs.data_hash,
        )

    @classmethod
    def none(cls, per_star: bool, data_hash: str | None) -> KeptFrames:
        """Nothing of a stream of frames."""
        return cls(
            frame_ids=np.zeros(0, dtype=np.int64),
            quaternions=np.zeros((0, 4)),
            residuals_px=np.zeros((0, 2)),
            fingerprints=None,
            per_star=per_star,
            data_hash=data_hash,
        )
