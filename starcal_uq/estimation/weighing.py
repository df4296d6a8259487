"""Effects that decide how much stars count: noise that varies, and tails, with what they gain."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.types import FloatArray
from starcal_uq.estimation.noise_model import axes_p, star_squares, uneven_p
from starcal_uq.estimation.weights import weighed
from starcal_uq.likelihood.fitted_effects import FittedEffect
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.student import DEFAULT_DOF, DOF_RANGE
from starcal_uq.observations.frames import StarFrames

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

# Range of the log of a scale about that of the median.
_LOG_SCALE = 5.0


def log_density(squares: FloatArray, nu: float | None) -> float:
    """Log likelihood of squared residuals (N,) of two axes at their best scale, but for a constant.

    `nu`: degrees of freedom of a Student t; None for a Gaussian.
    """
    n = len(squares)
    if nu is None:
        return -n * (1.0 + float(np.log(np.mean(squares) / 2.0)))
    from scipy.optimize import minimize_scalar

    middle = float(np.log(np.median(squares)))

    def cost(log_scale: float) -> float:
        far = np.log1p(squares * np.exp(-log_scale) / nu)
        return n * log_scale + 0.5 * (nu + 2.0) * float(np.sum(far))

    bounds = (middle - _LOG_SCALE, middle + _LOG_SCALE)
    return -float(minimize_scalar(cost, bounds=bounds, method="bounded").fun)


def gains(obs: Observations, cal: Calibration, noise: bool, tails: bool) -> dict[str, float]:
    """What noise that varies, and tails, would gain at an estimate, nat; those that it has already
    are left out.

    Noise by radius, by magnitude, of each frame, and of each axis are tests of their own; the gain
    is that of a single scale with their joint probability. `obs`: the stars, freed of effects that
    shift them. Of an estimate with `tails` they have kept their weights.
    """
    from scipy.optimize import minimize_scalar
    from scipy.special import chdtri

    frames = StarFrames.from_observations(weighed(obs, cal))
    likelihood = MarginalLikelihood(frames, cal.camera.distortion, cal.rotations)
    squares, share = star_squares(likelihood, cal.theta)
    freed, found = 2.0 * squares / share, {}
    if not tails:
        best = minimize_scalar(
            lambda log_nu: -log_density(freed, float(np.exp(log_nu))),
            bounds=np.log((DEFAULT_DOF, DOF_RANGE[1])),
            method="bounded",
            options={"xatol": 0.05},
        )
        found["tails"] = max(-float(best.fun) - log_density(freed, None), 0.0)
    if not noise:
        if tails:
            # Squares of Gaussian residuals that are as improbable as those of a Student t.
            assert cal.star_weights is not None
            nu = cal.nu
            squares = nu * np.log((nu + 2.0) / (nu * cal.star_weights))
        p = [*uneven_p(obs, cal.camera, squares, share), axes_p(likelihood, cal.theta)]
        chance = min(len(p) * min(p), 0.5)
        found["noise"] = 0.5 * float(chdtri(1.0, 2.0 * chance))
    return found


def with_weighing(obs: Observations, cal: Calibration, noise: bool, tails: bool) -> Calibration:
    """The calibration with ``noise`` and ``tails`` among its effects, where these were asked for.

    What they gain is told by the residuals at the estimate, for as many stars as there are degrees
    of freedom. `obs`: the table, with the noise that its stars state.
    """
    found: list[FittedEffect] = []
    stated = obs.unweighted.sigma_or_one
    model, nu = cal.noise_model, cal.nu if tails else None
    sigma_px = stated if model is None else model.sigma_px(obs)
    squares = np.sum(cal.residuals_px**2, axis=1)
    # Stars that cannot be in the field have no residual.
    seen = np.isfinite(squares)
    stated, sigma_px, squares = stated[seen], sigma_px[seen], squares[seen]
    share = 0.5 * cal.dof / len(squares)
    here = log_density(squares / sigma_px**2, nu)
    if noise:
        shrunk = 2.0 * float(np.sum(np.log(sigma_px / stated)))
        gain = here - shrunk - log_density(squares / stated**2, nu)
        spread = float(np.std(sigma_px)) * cal.sigma
        found.append(FittedEffect.weighing("noise", share * gain, scale_px=spread))
    if nu is not None:
        gain = here - log_density(squares / sigma_px**2, None)
        found.append(FittedEffect.weighing("tails", share * gain, dof=nu))
    if not found:
        return cal
    held = cal.known_effects
    asked = (*(effect.name for effect in found), *held.asked)
    held = replace(held, weighing=tuple(found), asked=asked)
    record = cal.provenance.with_settings(effects=list(held.names))
    return replace(cal, effects=held, provenance=record)
