"""Observations with the weights that an estimate gives their stars."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.errors import CalibrationError
from starcal_uq.likelihood.noise_model import noise_model_of
from starcal_uq.observations.partitions import PartitionedObservations

if TYPE_CHECKING:
    from starcal_uq.observations.table import Observations


def weighed(obs: Observations | PartitionedObservations, result: Any) -> Observations:
    """Observations as a calibration or posterior weighs them: with the noise of its model, if it
    has one that varies.

    The data and their hash stay what they are, but for repeated frames that a calibration left out.
    Without a model, weights of another result's are what the table states. Of partitioned
    observations it is the sample of frames that their calibration has kept. CalibrationError when
    partitioned observations are not those of the result.
    """
    if isinstance(obs, PartitionedObservations):
        return _sample_of(obs, result)
    left_out = np.isin(obs.frame, result.provenance.dropped_frames)
    if left_out.any():
        obs = obs.select(~left_out)
    obs = by_noise_model(obs, result)
    known = len(getattr(result, "residuals_px", ())) == len(obs)
    if "tail_weights" not in result.provenance or not known:
        # Of a mission's stars no tails are known.
        return obs
    from starcal_uq.estimation.robust import by_weights, tail_weights

    weights = result.star_weights
    if weights is None:
        # Of a version that did not keep them.
        weights = tail_weights(obs, result, result.provenance.tail_weights)
    return by_weights(obs, weights)


def by_noise_model(obs: Observations, result: Any) -> Observations:
    """Observations with the noise of a result's model, without the weights of its tails."""
    if "tail_weights" in result.provenance:
        obs = obs.unweighted
    model = noise_model_of(result)
    if model is None or not model.varies:
        return obs if obs.stated_px is None else replace(obs, stated_px=None, noise_axes=None)
    if model.multiplies and obs.unweighted.sigma_px is None:
        return obs
    if obs.stated_px is not None and model.frame_dof is not None and not len(model.frame_ids):
        # A posterior keeps no factors of frames; the calibration that weighed these does.
        return obs
    return obs.weighted(model.sigma_px(obs), model.axes)


def _sample_of(obs: PartitionedObservations, result: Any) -> Observations:
    """The sample of frames that a calibration has kept, read again."""
    sample = obs.sample()
    if result.provenance.partitions.get("sample_sha256") != sample.data_hash:
        raise CalibrationError(
            f"the calibration was made from other observations than those in {obs.folder}: "
            "calibrate these first."
        )
    return sample
