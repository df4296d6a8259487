"""Checks of what is done with draws; those of the draws themselves are in
`Posterior.diagnostics`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.remedy import RUN, Remedy
from starcal_uq.core.status import Check, Code, Level, judged

if TYPE_CHECKING:
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.propagation.attitude_error import AttitudeError

# What first order leaves out, and how many Monte Carlo errors of a sampled sigma are tolerated
# beyond it.
PROPAGATION_SLACK, PROPAGATION_ERRORS = 0.03, 4.0


def same_data(post: Posterior, data_hash: str) -> Check:
    """Was the posterior sampled from the observations of this hash?"""
    sampled = post.provenance.data_sha256
    return judged(
        Code.DATA_OF_THE_POSTERIOR,
        {"sampled_sha256": str(sampled)},
        {"at_hand_sha256": data_hash},
        (Remedy("sample", (RUN,), {"force": True}),),
        otherwise=Level.FAIL,
        good=sampled == data_hash,
    )


def propagation(error: AttitudeError) -> Check:
    """Do draws through QUEST and first-order propagation give the same attitude error?"""
    # A standard deviation from n draws has a relative error of at most 1 / sqrt(2 n).
    bound = PROPAGATION_SLACK + PROPAGATION_ERRORS / float(np.sqrt(2.0 * error.n_draws))
    more = {"force": True, "n_draws": 4 * error.n_draws}
    return judged(
        Code.PROPAGATION_TO_ATTITUDE,
        {"difference": propagation_difference(error)},
        {"difference_most": bound},
        (Remedy("propagate", (RUN,), more, form="command"),),
    )


def propagation_difference(error: AttitudeError) -> float:
    """Largest relative difference between sampled and first-order sigmas of the calibration's
    parts.
    """
    sampled = np.concatenate([error.common_arcsec, error.rest_arcsec])
    first_order = np.concatenate([error.analytic_common_arcsec, error.analytic_rest_arcsec])
    # Parts without an effect worth the name (below a microarcsecond) have no ratio.
    real = np.maximum(sampled, first_order) > 1e-6
    return float(
        np.max(np.abs(sampled[real] / np.maximum(first_order[real], 1e-12) - 1.0), initial=0.0)
    )
