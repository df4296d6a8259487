"""What an error of a camera parameter does to attitudes, and which error keeps a limit.

A small error of parameter j turns frame k by R_k e_j (QUEST to first order, as in
`starcal_uq.propagation.geometry`), so that the error of an attitude is proportional to it: its
quantile over the frames, per unit of the parameter, is a sensitivity, and a limit over a
sensitivity is a tolerance. After an alignment with the wrong camera the rotation that all frames
share is gone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import parameter_names, parameters
from starcal_uq.core.constants import ARCSEC, AXES, CROSS_BORESIGHT, TOTAL_AXES
from starcal_uq.core.errors import SettingError, check_known, require
from starcal_uq.core.types import FloatArray
from starcal_uq.propagation.geometry import responses

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.camera.camera import Camera
    from starcal_uq.observations.table import Observations


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """Attitude errors of K frames per unit of each of the p parameters of a camera.

    Attributes
    ----------
    camera : Camera
        The camera around which errors are small.
    turns_arcsec : (K, 3, p) array
        Rotation (pitch, yaw, roll) of each frame by one unit of a parameter, px units, arcsec.
    """

    camera: Camera
    turns_arcsec: FloatArray

    def error_arcsec(
        self,
        name: str,
        axis: str = CROSS_BORESIGHT,
        confidence: float = 0.997,
        aligned: bool = False,
    ) -> float:
        """Attitude error that this share of the frames stays below, per unit of a parameter,
        arcsec.

        Parameters
        ----------
        name : str
            A parameter of the camera, such as ``f``; px units.
        axis : str
            ``pitch``, ``yaw``, ``roll`` or ``cross-boresight``: the angle of pitch and yaw.
        confidence : float
            Share of the frames.
        aligned : bool
            Whether alignment, calibrated with the same camera, has taken up the rotation that all
            frames share.

        Raises
        ------
        SettingError
            For an unknown parameter or axis, or a confidence that is none.
        """
        names = parameter_names(self.camera.distortion)
        check_known("parameter", name, names, SettingError)
        check_known("axis", axis, TOTAL_AXES, SettingError)
        probable = f"confidence is {confidence!r}: give a share above 0, and 1 at most."
        require(SettingError, (0.0 < confidence <= 1.0, probable))
        turns = self.turns_arcsec[:, :, names.index(name)]
        if aligned:
            turns = turns - turns.mean(axis=0)
        seen = turns[:, :2] if axis == CROSS_BORESIGHT else turns[:, [AXES.index(axis)]]
        return float(np.quantile(np.linalg.norm(seen, axis=1), confidence))

    def tolerance(
        self,
        name: str,
        limit_arcsec: float,
        axis: str = CROSS_BORESIGHT,
        confidence: float = 0.997,
        aligned: bool = False,
    ) -> float:
        """Error of a parameter, px units, that keeps a limit in this share of the frames; infinite
        for one that moves no attitude.

        The arguments are those of `error_arcsec`.
        """
        error = self.error_arcsec(name, axis, confidence, aligned)
        return limit_arcsec / error if error > 0.0 else float("inf")

    def to_dataframe(
        self, limit_arcsec: float = 1.0, confidence: float = 0.997, aligned: bool = False
    ) -> pd.DataFrame:
        """One row per parameter and axis: ``parameter``, ``unit``, ``axis``, ``error_arcsec`` per
        unit, and the ``tolerance`` for a limit.
        """
        import pandas as pd

        rows = []
        for spec in parameters(self.camera.distortion):
            for axis in TOTAL_AXES:
                error = self.error_arcsec(spec.name, axis, confidence, aligned)
                kept = self.tolerance(spec.name, limit_arcsec, axis, confidence, aligned)
                rows.append((spec.name, spec.unit, axis, error, kept))
        names = ["parameter", "unit", "axis", "error_arcsec", "tolerance"]
        return pd.DataFrame(rows, columns=names)


def sensitivities(camera: Camera, obs: Observations) -> Sensitivities:
    """Attitude errors of frames per unit of each camera parameter.

    Parameters
    ----------
    camera : Camera
        The camera, such as that of a data sheet or of a calibration.
    obs : Observations
        Frames of the mission, such as those of `starcal_uq.simulate`, with the stars that the
        tracker uses; all of them count alike.

    Raises
    ------
    DistortionError
        Where the distortion folds over in the observed field.
    """
    stars = obs.xy, obs.frame_starts, np.ones(obs.n_stars)
    *_, response = responses(camera.distortion, camera.theta, *stars)
    return Sensitivities(camera, response * ARCSEC)
