"""Quantities that follow from the sampled parameters, with the same diagnostics as the parameters
themselves.

Convergence of every parameter does not imply that of their combinations: strongly coupled
parameters can look settled while a difference of them is not.
"""

from __future__ import annotations

from starcal_uq.camera.distortion import get_model
from starcal_uq.camera.fields import corner_displacement_px
from starcal_uq.core.constants import ARCSEC, AXES
from starcal_uq.core.types import FloatArray, floats
from starcal_uq.inference import arviz as arviz_compat
from starcal_uq.inference.posterior import Derived, Posterior
from starcal_uq.maths.intervals import mean_and_sd


def derived_quantities(post: Posterior) -> tuple[Derived, ...]:
    """Displacement by the distortion at the corner, the common rotation about each axis, and the
    focal length in mm.

    That in mm is left out where the pixel pitch is unknown.
    """
    draws, model = post.theta_draws, get_model(post.camera.distortion)
    rotation = (draws - post.mean) @ post.rotation_per_theta.T * ARCSEC
    values: dict[tuple[str, str], FloatArray] = {}
    if post.camera.pixel_um is not None:
        values["focal length", "mm"] = draws[:, 2] * post.camera.pixel_um / 1000.0
    if model.lens:
        values["distortion at the corner", "px"] = floats(
            corner_displacement_px(post.camera, list(draws[:, 3:].T))
        )
    for i, axis in enumerate(AXES):
        values[f"common rotation, {axis}", "arcsec"] = rotation[:, i]
    return tuple(_diagnosed(post, name, unit, v) for (name, unit), v in values.items())


def _diagnosed(post: Posterior, name: str, unit: str, values: FloatArray) -> Derived:
    mean, sd = mean_and_sd(values)
    # In standard units: tiny ranges mislead the diagnostics.
    chains = ((values - mean) / (sd or 1.0)).reshape(post.n_ensembles, -1)
    return Derived(
        name=name,
        unit=unit,
        mean=mean,
        sd=sd,
        mcse=float(arviz_compat.mcse_mean(chains)) * sd,
        rhat=arviz_compat.rhat(chains),
        ess_bulk=arviz_compat.ess_bulk(chains),
        ess_tail=arviz_compat.ess_tail(chains),
    )
