"""A calibration whose posterior is known in closed form, with the scales and couplings of a real
star sensor.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.core.provenance import Provenance
from starcal_uq.core.status import Status
from starcal_uq.estimation.result import Calibration
from starcal_uq.likelihood.fitted_effects import Effects
from starcal_uq.maths.linear import symmetric_inverse

SD = np.array([0.15, 0.15, 0.028, 0.39e-10, 0.073e-15])
CORRELATION = np.eye(5)
CORRELATION[2, 3] = CORRELATION[3, 2] = -0.94
CORRELATION[2, 4] = CORRELATION[4, 2] = 0.84
CORRELATION[3, 4] = CORRELATION[4, 3] = -0.97
COVARIANCE = CORRELATION * np.outer(SD, SD)


@dataclass(frozen=True)
class GaussianLikelihood:
    """Gaussian in theta at every sigma: ``-1/2 (dof sigma0^2 + q(theta)) / sigma^2 - dof log
    sigma``.
    """

    theta: np.ndarray
    information: np.ndarray
    sigma: float
    dof: int
    name: str = "gaussian"

    def log_likelihood(self, theta: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        scale = np.sqrt(np.diag(self.information))
        shift = (theta - self.theta) * scale
        q = np.sum(shift @ (self.information / np.outer(scale, scale)) * shift, axis=1)
        return -0.5 * (self.dof + q) * (self.sigma / sigma) ** 2 - self.dof * np.log(sigma)


def gaussian_calibration(dof: int = 25_000, sigma: float = 0.05, **changes: Any) -> SimpleNamespace:
    """What `sample` needs of a calibration."""
    nominal = Camera(1024, 1024, 12.0, 72.0, 511.5, 511.5)
    camera = nominal.with_theta([500.0, 530.0, 5852.0, 2.0e-10, -3.5e-15])
    information = symmetric_inverse(COVARIANCE)
    values: dict[str, Any] = {
        "theta": camera.theta,
        "information": information,
        "sigma": sigma,
        "sigma_name": "sigma",
        "dof": dof,
        "camera": camera,
        "nominal": nominal,
        "parameter_names": camera.parameter_names,
        "status": Status.CONVERGED,
        "compressed": GaussianLikelihood(camera.theta, information, sigma, dof),
        "rotation_per_theta": np.arange(15.0).reshape(3, 5) * 1e-4,
        "attitude_noise": np.eye(3) * 1e-12,
        "provenance": Provenance(data_sha256="0" * 64),
        "known_effects": Effects(),
        "noise_model": None,
        "inflation": None,
        "width_factors": np.ones(5),
        "sampled_likelihood": "marginal",
        "undetermined": (),
    }
    values |= changes
    values["log_likelihood"] = getattr(values["compressed"], "log_likelihood", None)
    return SimpleNamespace(**values, remedy=values["status"].value)


def gaussian_posterior(
    cal: Calibration, n: int = 4000, scale: float = 1.0, seed: int = 0
) -> SimpleNamespace:
    """What `propagate` reads of a posterior, with Gaussian draws; sigmas `scale` times those of the
    calibration.
    """
    rng = np.random.default_rng(seed)
    sd = np.sqrt(np.diag(cal.covariance))
    root = np.linalg.cholesky(cal.covariance / np.outer(sd, sd))
    theta = cal.theta + scale * sd * (rng.standard_normal((n, len(sd))) @ root.T)
    draws = np.column_stack((theta, cal.sigma + cal.sigma_std * rng.standard_normal(n)))
    mean = theta.mean(axis=0)
    return SimpleNamespace(
        camera=cal.camera,
        calibrated_camera=cal.camera.with_theta(mean),
        draws=draws,
        theta_draws=theta,
        sigma_draws=draws[:, -1],
        sigma_name=cal.sigma_name,
        mean=mean,
        covariance=np.cov(theta, rowvar=False),
        rotation_per_theta=cal.rotation_per_theta,
        attitude_noise=cal.attitude_noise,
        provenance=Provenance(),
        star_error_px=0.0,
        effects=None,
        thin=lambda count, seed: draws[np.random.default_rng(seed).permutation(n)[:count]],
    )
