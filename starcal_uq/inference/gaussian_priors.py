"""A joint normal prior with its full covariance, such as the posterior of an earlier run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from starcal_uq.camera.distortion import parameter_names
from starcal_uq.core.errors import PriorError
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.inference.priors import Priors, positive_number

KIND = "gaussian"


@dataclass(frozen=True, eq=False)
class GaussianPriors(Priors):
    """Joint normal prior on the camera parameters, log-normal on the noise.

    Attributes
    ----------
    theta_mean : array (p,)
        Means of x0, y0, f, k..., px units.
    theta_covariance : array (p, p)
        Their covariance.
    sigma_median : float
        Median of the centroid noise: px, or a factor where every star states its own noise.
    sigma_log_sd : float
        Standard deviation of the logarithm of the noise.
    distortion : str
        Name of the distortion model.
    per_star_sigma : bool
        True where the noise parameter is a common factor on stated noises.
    source : dict
        Where the prior comes from, as plain values: ``name``, ``data_sha256`` (list of hashes of the data that are in
        it already) and what was added to it.
    """

    theta_mean: FloatArray
    theta_covariance: FloatArray
    sigma_median: float
    sigma_log_sd: float
    distortion: str = "brown"
    per_star_sigma: bool = False
    source: AnyDict = field(default_factory=dict)

    def __post_init__(self) -> None:
        mean = np.array(self.theta_mean, dtype=np.float64)
        covariance = np.array(self.theta_covariance, dtype=np.float64)
        p = len(parameter_names(self.distortion))
        if mean.shape != (p,) or covariance.shape != (p, p):
            raise PriorError(
                f"the prior has means of shape {mean.shape} and covariances of shape {covariance.shape}: the "
                f"distortion model {self.distortion!r} has {p} parameters."
            )
        for name in ("sigma_median", "sigma_log_sd"):
            object.__setattr__(self, name, positive_number(name, getattr(self, name)))
        variance = np.diag(covariance)
        if not (np.all(np.isfinite(mean)) and np.all(np.isfinite(covariance)) and np.all(variance > 0.0)):
            raise PriorError("the prior's mean and covariance must be finite, with variances above zero.")
        correlation = covariance / np.sqrt(np.outer(variance, variance))
        symmetric = np.allclose(correlation, correlation.T, rtol=0.0, atol=1e-9)
        if not symmetric or np.linalg.eigvalsh(0.5 * (correlation + correlation.T))[0] < 1e-12:
            raise PriorError("the prior's covariance must be symmetric and positive definite.")
        for name, value in (("theta_mean", mean), ("theta_covariance", 0.5 * (covariance + covariance.T))):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    def theta_moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean (p,) and covariance (p, p), px units."""
        return self.theta_mean, self.theta_covariance

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for files."""
        arrays = {"theta_mean": self.theta_mean.tolist(), "theta_covariance": self.theta_covariance.tolist()}
        return {"kind": KIND, **vars(self), **arrays, "source": dict(self.source)}

    @classmethod
    def read(cls, values: Mapping[str, Any]) -> GaussianPriors:
        """Read what `to_dict` wrote."""
        return cls(**{name: value for name, value in values.items() if name != "kind"})

    def _statement(self, name: str) -> str:
        mean, sd = float(self.mean([name])[0]), float(self.sd([name])[0])
        origin = f", from {self.source['name']}" if "name" in self.source else ""
        return f"normal, {mean:.8g} with sd {sd:.3g}, correlated with the others{origin}"
