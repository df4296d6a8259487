"""Priors, all proper: what was believed before the stars were seen.

Normal on the camera parameters, log-normal on the noise. `Priors` is what every user of a prior relies on; the two
kinds are `physical_priors.PhysicalPriors` (independent, in physical terms; the default) and
`gaussian_priors.GaussianPriors` (a full covariance, such as the posterior of an earlier run).
"""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from starcal_uq.camera.distortion import parameter_names, parameters, sigma_parameter
from starcal_uq.core.errors import PriorError
from starcal_uq.core.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.camera.camera import Camera
    from starcal_uq.inference.physical_priors import PhysicalPriors

SIGMA_NAMES = ("sigma", "sigma_scale")
_LOG_2PI = math.log(2.0 * math.pi)


class Priors(ABC):
    """A proper prior on the parameters of one camera: joint normal, and log-normal for the noise.

    Attributes
    ----------
    distortion : str
        Name of the distortion model, which gives names and orders of the coefficients.
    per_star_sigma : bool
        True where the noise parameter is a common factor on stated noises.
    sigma_median : float
        Median of the centroid noise: px, or a factor where every star states its own noise.
    sigma_log_sd : float
        Standard deviation of the logarithm of the noise.
    """

    distortion: str
    per_star_sigma: bool
    sigma_median: float
    sigma_log_sd: float

    @abstractmethod
    def theta_moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean (p,) and covariance (p, p) of the camera parameters, px units."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Plain values, for files."""

    @abstractmethod
    def _statement(self, name: str) -> str:
        """The prior on one camera parameter in words."""

    @staticmethod
    def default(camera: Camera, per_star_sigma: bool = False) -> PhysicalPriors:
        """Wide priors around a nominal camera; see `physical_priors`."""
        from starcal_uq.inference.physical_priors import PhysicalPriors

        return PhysicalPriors.around(camera, per_star_sigma)

    @staticmethod
    def from_toml(path: str | Path, camera: Camera, per_star_sigma: bool = False) -> PhysicalPriors:
        """Read a ``[priors]`` table; what it leaves out keeps its default for this camera.

        Raises
        ------
        PriorError
            For a file that cannot be read, an unknown key or a value that is not a proper prior.
        """
        from starcal_uq.inference.physical_priors import priors_from_toml

        return priors_from_toml(path, camera, per_star_sigma)

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> Priors:
        """Read what `to_dict` wrote, of either kind."""
        from starcal_uq.inference.gaussian_priors import KIND, GaussianPriors
        from starcal_uq.inference.physical_priors import PhysicalPriors

        if values.get("kind") == KIND:
            return GaussianPriors.read(values)
        return PhysicalPriors.read(values)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters, the noise last."""
        return (*parameter_names(self.distortion), SIGMA_NAMES[self.per_star_sigma])

    def _moments(self) -> dict[str, tuple[float, float]]:
        mean, covariance = self.theta_moments()
        sd = np.sqrt(np.diag(covariance))
        names = parameter_names(self.distortion)
        moments = {name: (float(mean[i]), float(sd[i])) for i, name in enumerate(names)}
        # Moments of a log-normal variable with median m and log sd s.
        growth = math.exp(self.sigma_log_sd**2)
        noise = self.sigma_median * math.sqrt(growth)
        for name in SIGMA_NAMES:
            moments[name] = (noise, noise * math.sqrt(growth - 1.0))
        return moments

    def mean(self, names: Sequence[str]) -> FloatArray:
        """Prior means of the named parameters, in the units of `distortion.parameters`."""
        return self._pick(names, 0)

    def sd(self, names: Sequence[str]) -> FloatArray:
        """Prior standard deviations of the named parameters."""
        return self._pick(names, 1)

    def _pick(self, names: Sequence[str], index: int) -> FloatArray:
        moments = self._moments()
        unknown = [name for name in names if name not in moments]
        if unknown:
            raise PriorError(
                f"no prior on {unknown[0]!r}: these priors were made for the distortion model "
                f"{self.distortion!r}; make them anew with Priors.default."
            )
        return np.array([moments[name][index] for name in names])

    def precision(self, names: Sequence[str]) -> FloatArray:
        """Precision matrix (n, n) of the normal prior on the named camera parameters, the others left free."""
        sd = self.sd(names)
        known = parameter_names(self.distortion)
        rows = [known.index(name) for name in names]
        correlation = self._correlation()[np.ix_(rows, rows)]
        return np.asarray(np.linalg.inv(correlation) / np.outer(sd, sd))

    def _correlation(self) -> FloatArray:
        covariance = self.theta_moments()[1]
        sd = np.sqrt(np.diag(covariance))
        return np.asarray(covariance / np.outer(sd, sd))

    def log_density_theta(self, theta: FloatArray) -> FloatArray:
        """Log density (n,) of camera parameters (n, p), per unit of each parameter."""
        names = parameter_names(self.distortion)
        sd = self.sd(names)
        factor = np.linalg.cholesky(self._correlation())
        z = (np.atleast_2d(theta) - self.mean(names)) / sd @ np.linalg.inv(factor).T
        log_volume = np.sum(np.log(sd)) + np.sum(np.log(np.diag(factor)))
        return np.asarray(-0.5 * np.sum(z * z, axis=1) - log_volume - 0.5 * len(names) * _LOG_2PI)

    def log_density_log_sigma(self, log_sigma: FloatArray) -> FloatArray:
        """Log density (n,) of the logarithm of the noise, per unit of the logarithm."""
        z = (np.asarray(log_sigma) - math.log(self.sigma_median)) / self.sigma_log_sd
        return np.asarray(-0.5 * z * z - math.log(self.sigma_log_sd) - 0.5 * _LOG_2PI)

    def log_density(self, theta: FloatArray, sigma: FloatArray) -> FloatArray:
        """Log prior density per unit of theta and of sigma.

        Parameters
        ----------
        theta : array (n, p)
            Camera parameters x0, y0, f, k... in px units.
        sigma : array (n,)
            Noise; -inf is returned where it is not above zero.

        Returns
        -------
        array (n,)
        """
        sigma = np.broadcast_to(np.asarray(sigma, dtype=float), np.atleast_2d(theta).shape[:1])
        log_sigma = np.log(np.where(sigma > 0.0, sigma, 1.0))
        # The density per unit of sigma is the one per unit of log sigma times d(log sigma)/d(sigma) = 1 / sigma.
        density = self.log_density_theta(theta) + self.log_density_log_sigma(log_sigma) - log_sigma
        return np.where(sigma > 0.0, density, -np.inf)

    def marginal_density(self, name: str, values: FloatArray) -> FloatArray:
        """Prior density of one parameter at `values`, for drawing it beside a posterior."""
        values = np.asarray(values, dtype=float)
        if name in SIGMA_NAMES:
            positive = np.where(values > 0.0, values, 1.0)
            density = np.exp(self.log_density_log_sigma(np.log(positive))) / positive
            return np.where(values > 0.0, density, 0.0)
        mean, sd = float(self.mean([name])[0]), float(self.sd([name])[0])
        return np.asarray(np.exp(-0.5 * ((values - mean) / sd) ** 2) / (sd * math.sqrt(2.0 * math.pi)))

    def draw(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw (n, p+1) parameters from the prior, the noise in the last column."""
        names = parameter_names(self.distortion)
        u = rng.standard_normal((n, len(names))) @ np.linalg.cholesky(self._correlation()).T
        theta = self.mean(names) + self.sd(names) * u
        sigma = self.sigma_median * np.exp(self.sigma_log_sd * rng.standard_normal(n))
        return np.column_stack([theta, sigma])

    def replace(self, **changes: Any) -> Self:
        """The same priors with some fields changed."""
        fields = [field.name for field in dataclasses.fields(self)]  # type: ignore[arg-type]
        unknown = sorted(set(changes) - set(fields))
        if unknown:
            raise PriorError(f"there is no prior named {unknown[0]!r}: use one of {', '.join(fields)}.")
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]

    def to_dataframe(self) -> pd.DataFrame:
        """One row per parameter: unit, mean, sd, and the statement in words."""
        import pandas as pd

        shown = [*parameters(self.distortion), sigma_parameter(self.per_star_sigma)]
        names = [p.name for p in shown]
        noise = f"log-normal, median {self.sigma_median:g} with log sd {self.sigma_log_sd:g}"
        return pd.DataFrame(
            {
                "parameter": names,
                "unit": [p.unit for p in shown],
                "mean": self.mean(names),
                "sd": self.sd(names),
                "statement": [*(self._statement(name) for name in names[:-1]), noise],
            }
        )

    def _repr_html_(self) -> str:
        return str(self.to_dataframe().to_html(index=False, float_format=lambda v: f"{v:.4g}"))


def positive_number(name: str, value: Any) -> float:
    """A finite number above zero.

    Raises
    ------
    PriorError
        Otherwise.
    """
    number = float(value)
    if not (math.isfinite(number) and number > 0.0):
        raise PriorError(f"prior {name!r} is {number:g}: it must be a finite number above zero.")
    return number


def read_priors_table(path: str | Path) -> dict[str, Any]:
    """The ``[priors]`` table of a TOML file.

    Raises
    ------
    PriorError
        For a file that cannot be read, or without the table.
    """
    import tomllib

    try:
        document = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise PriorError(f"{path}: cannot be read as TOML ({error}).") from error
    table = document.get("priors")
    if not isinstance(table, dict):
        raise PriorError(f"{path}: the section [priors] is missing; add it above the priors.")
    return table
