"""The calibration's part of the attitude error by what the software aboard uses, effects
included.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.constants import TOTAL_AXES
from starcal_uq.core.settings import OnboardModel
from starcal_uq.core.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd

# Name of the part of the parameters themselves.
PARAMETERS = "camera parameters"


def _not_known(*shape: int) -> FloatArray:
    return np.full(shape, np.nan)


@dataclass(frozen=True, eq=False)
class EffectError:
    """The share of one effect, or of the parameters, in the calibration's part.

    Effects err together with the parameters and with each other. Everything is decomposed in one
    order, the parameters first and then effect by effect: a share holds what is left of an effect
    once all before it are known. So covariances of shares add up to those of the whole. Fields of
    covariances and means are NaN in files of a version without.

    Attributes
    ----------
    name : str
        The effect, or ``camera parameters``.
    common_arcsec, rest_arcsec : (3,) array
        Root mean squares of its common rotation and, over frames, of its rest, arcsec.
    common_mean_arcsec, rest_mean_arcsec : (3,) array
        The expected part, with its sign, that the software does not correct: of the common
        rotation, and of the rest the mean over frames.
    common_covariance_arcsec2, rest_covariance_arcsec2 : (3, 3) array
        Covariances around these, mean over frames.
    rest_constant_arcsec : (3,) array
        Standard deviation of what all frames share of the rest, beyond its mean.
    """

    name: str
    common_arcsec: FloatArray
    rest_arcsec: FloatArray
    common_mean_arcsec: FloatArray = field(default_factory=lambda: _not_known(3))
    rest_mean_arcsec: FloatArray = field(default_factory=lambda: _not_known(3))
    common_covariance_arcsec2: FloatArray = field(default_factory=lambda: _not_known(3, 3))
    rest_covariance_arcsec2: FloatArray = field(default_factory=lambda: _not_known(3, 3))
    rest_constant_arcsec: FloatArray = field(default_factory=lambda: _not_known(3))

    @classmethod
    def of(
        cls,
        name: str,
        common: tuple[FloatArray, FloatArray],
        rest: tuple[FloatArray, FloatArray],
        constant: FloatArray,
    ) -> EffectError:
        """From means (3,), arcsec, and covariances (3, 3), arcsec^2, of common rotation and rest,
        and the variance (3,) of the constant part.
        """
        sizes = [np.sqrt(mean**2 + np.diag(covariance)) for mean, covariance in (common, rest)]
        return cls(
            name,
            common_arcsec=sizes[0],
            rest_arcsec=sizes[1],
            common_mean_arcsec=common[0],
            rest_mean_arcsec=rest[0],
            common_covariance_arcsec2=common[1],
            rest_covariance_arcsec2=rest[1],
            rest_constant_arcsec=np.sqrt(np.maximum(constant, 0.0)),
        )


@dataclass(frozen=True, eq=False)
class OnboardError:
    """The calibration's part of the attitude error with one onboard model, effects included.

    Attributes
    ----------
    onboard : {"model", "effects"}
        What the mission's software uses: parameters of the camera alone, or what can be uploaded of
        the effects as well.
    common_arcsec, rest_arcsec, total_arcsec : (3,) array
        Root mean squares of common rotation, rest, and both together, arcsec.
    effects : tuple of EffectError
        The share of every effect. That of the stars is in the centroid noise, and not in the
        figures above.
    parameters : EffectError or None
        The share of the camera's parameters; None in files of a version without.
    """

    onboard: OnboardModel
    common_arcsec: FloatArray
    rest_arcsec: FloatArray
    total_arcsec: FloatArray
    effects: tuple[EffectError, ...]
    parameters: EffectError | None = None

    @property
    def parts(self) -> dict[str, FloatArray]:
        """Root mean squares (3,), arcsec, by name: of the whole, then of every share."""
        found = {
            "common rotation": self.common_arcsec,
            "rest": self.rest_arcsec,
            "total": self.total_arcsec,
        }
        for share in (self.parameters, *self.effects):
            if share is not None:
                found[f"{share.name}, common rotation"] = share.common_arcsec
                found[f"{share.name}, rest"] = share.rest_arcsec
        return found


def side_by_side(variants: Sequence[OnboardError]) -> pd.DataFrame:
    """What is left with each onboard model: columns ``part``, ``axis``, ``onboard_model_arcsec``
    and ``onboard_effects_arcsec``, 1 sigma if the model holds; no rows without effects.

    Cross-boresight rows hold the root mean square of pitch and yaw.
    """
    import pandas as pd

    parts = list(variants[0].parts) if variants else []
    columns = {
        f"onboard_{own.onboard}_arcsec": np.concatenate([with_cross(v) for v in own.parts.values()])
        for own in variants
    }
    return pd.DataFrame(
        {
            "part": np.repeat(np.array(parts, dtype=object), len(TOTAL_AXES)),
            "axis": np.array(TOTAL_AXES * len(parts), dtype=object),
            **columns,
        }
    )


def with_cross(sigma: FloatArray) -> FloatArray:
    """Sigmas of the three axes (3,), then the root mean square of the two across the boresight:
    (4,).
    """
    return np.append(sigma, np.sqrt(np.mean(sigma[:2] ** 2)))
