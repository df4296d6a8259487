"""Priors, all proper: what was believed before the stars were seen.

Normal on the camera parameters, log-normal on the noise. `Priors` is what every user of a prior
relies on; the two kinds are `PhysicalPriors` (independent, in physical terms; the default) and
`GaussianPriors` (a full covariance, such as the posterior of an earlier run).
"""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from starcal_uq.camera.distortion import get_model, parameter_names, parameters, sigma_parameter
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import PriorError
from starcal_uq.core.findings import clause
from starcal_uq.core.settings import Seed, bounded
from starcal_uq.core.toml import Key, Section, read_section
from starcal_uq.core.types import AnyDict, AnyMapping, FloatArray
from starcal_uq.maths.linear import correlation_of, root_diagonal, symmetric

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.camera.camera import Camera

SIGMA_NAMES = ("sigma", "sigma_scale")
_LOG_2PI = math.log(2.0 * math.pi)


class Priors(Shown, ABC):
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
    def to_dict(self) -> AnyDict:
        """Plain values, for files."""

    @abstractmethod
    def _statement(self, name: str) -> str:
        """The prior on one camera parameter in words."""

    @staticmethod
    def default(camera: Camera, per_star_sigma: bool = False) -> PhysicalPriors:
        """Wide priors around a nominal camera; see `PhysicalPriors`."""

        return PhysicalPriors.around(camera, per_star_sigma)

    @staticmethod
    def from_toml(path: str | Path, camera: Camera, per_star_sigma: bool = False) -> PhysicalPriors:
        """Read a ``[priors]`` table; what it leaves out keeps its default for this camera.

        Raises
        ------
        PriorError
            For a file that cannot be read, an unknown key or a value that is not a proper prior.
        """
        table = read_section(path, "priors", PriorError, alone=False)
        return priors_from_table(path, table, camera, per_star_sigma)

    @staticmethod
    def from_dict(values: AnyMapping) -> Priors:
        """Read what `to_dict` wrote, of either kind."""
        kind = GaussianPriors if values.get("kind") == KIND else PhysicalPriors
        return kind(**{name: value for name, value in values.items() if name != "kind"})

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters, the noise last."""
        return (*parameter_names(self.distortion), SIGMA_NAMES[self.per_star_sigma])

    def _moments(self) -> dict[str, tuple[float, float]]:
        mean, covariance = self.theta_moments()
        sd = root_diagonal(covariance)
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
                f"{self.distortion!r}; make them again with Priors.default."
            )
        return np.array([moments[name][index] for name in names])

    def precision(self, names: Sequence[str]) -> FloatArray:
        """Precision matrix (n, n) of the normal prior on the named camera parameters, the others
        left free.
        """
        sd = self.sd(names)
        known = parameter_names(self.distortion)
        rows = [known.index(name) for name in names]
        correlation = self._correlation()[np.ix_(rows, rows)]
        return np.linalg.inv(correlation) / np.outer(sd, sd)

    def _correlation(self) -> FloatArray:
        return correlation_of(self.theta_moments()[1])[0]

    def log_density_theta(self, theta: FloatArray) -> FloatArray:
        """Log density (n,) of camera parameters (n, p), per unit of each parameter."""
        mean, sd, whitening, log_volume = self._normal
        z = (np.atleast_2d(theta) - mean) / sd @ whitening
        return np.asarray(-0.5 * np.sum(z * z, axis=1) - log_volume - 0.5 * len(sd) * _LOG_2PI)

    @cached_property
    def _normal(self) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """Mean, standard deviation, whitening of the correlation and log volume of the camera's
        parameters.
        """
        names = parameter_names(self.distortion)
        sd = self.sd(names)
        factor = np.linalg.cholesky(self._correlation())
        log_volume = np.sum(np.log(sd)) + np.sum(np.log(np.diag(factor)))
        return self.mean(names), sd, np.linalg.inv(factor).T, float(log_volume)

    def log_density_log_sigma(self, log_sigma: FloatArray) -> FloatArray:
        """Log density (n,) of the logarithm of the noise, per unit of the logarithm."""
        z = (np.asarray(log_sigma) - math.log(self.sigma_median)) / self.sigma_log_sd
        return np.asarray(-0.5 * z * z - math.log(self.sigma_log_sd) - 0.5 * _LOG_2PI)

    def log_density(self, theta: FloatArray, sigma: FloatArray) -> FloatArray:
        """Log prior density (n,) per unit of theta (n, p), px units, and of sigma (n,).

        It is -inf where sigma is not above zero.
        """
        sigma = np.broadcast_to(np.asarray(sigma, dtype=float), np.atleast_2d(theta).shape[:1])
        log_sigma = np.log(np.where(sigma > 0.0, sigma, 1.0))
        # The density per unit of sigma is the one per unit of log sigma times d(log sigma)/d(sigma)
        # = 1 / sigma.
        density = self.log_density_theta(theta) + self.log_density_log_sigma(log_sigma) - log_sigma
        return np.where(sigma > 0.0, density, -np.inf)

    def marginal_density(self, name: str, values: FloatArray) -> FloatArray:
        """Prior density of one parameter at `values`, for drawing it beside a posterior."""
        values = np.asarray(values, dtype=float)
        if name in SIGMA_NAMES:
            positive = np.where(values > 0.0, values, 1.0)
            density = np.exp(self.log_density_log_sigma(np.log(positive))) / positive
            return np.where(values > 0.0, density, 0.0)
        mean, sd = self._moments_of(name)
        return np.exp(-0.5 * ((values - mean) / sd) ** 2) / (sd * math.sqrt(2.0 * math.pi))

    def _moments_of(self, name: str) -> tuple[float, float]:
        """Mean and standard deviation of one parameter."""
        return float(self.mean([name])[0]), float(self.sd([name])[0])

    @bounded
    def draw(self, n: int, seed: Seed) -> FloatArray:
        """Draw (n, p+1) parameters from the prior, the noise in the last column."""
        rng = np.random.default_rng(seed)
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
            raise PriorError(
                f"there is no prior named {unknown[0]!r}: use one of {', '.join(fields)}."
            )
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]

    def to_dataframe(self) -> pd.DataFrame:
        """One row per parameter: unit, mean, sd, and the statement in words."""
        import pandas as pd

        shown = [*parameters(self.distortion), sigma_parameter(self.per_star_sigma)]
        names = [p.name for p in shown]
        noise = clause(Stated.NOISE, it=self)
        return pd.DataFrame(
            {
                "parameter": names,
                "unit": [p.unit for p in shown],
                "mean": self.mean(names),
                "sd": self.sd(names),
                "statement": [*(self._statement(name) for name in names[:-1]), noise],
            }
        )


# How the prior of a parameter is stated in words.
Stated = Enum("Stated", "PHYSICAL NORMAL NOISE")


def positive_number(name: str, value: Any) -> float:
    """A finite number above zero; `PriorError` otherwise."""
    number = float(value)
    if not (math.isfinite(number) and number > 0.0):
        raise PriorError(f"prior {name!r} is {number:g}: it must be a finite number above zero.")
    return number


def physical_covariance(
    widths: Any, focal_px: float, radius_px: float, distortion: str
) -> FloatArray:
    """Diagonal covariance (p, p), px units, of widths in physical terms: `principal_point_px`,
    `focal_fraction` and, at this radius, `distortion_corner_px`.
    """
    point, corner = widths.principal_point_px, widths.distortion_corner_px
    powers = [c.order for c in get_model(distortion).coefficients]
    terms = [corner / np.float64(radius_px) ** power for power in powers]
    return np.diag(np.square([point, point, widths.focal_fraction * focal_px, *terms]))


# Wide on purpose: a tenth of the detector, 5 % of the focal length and a twentieth of the image
# radius cover any camera whose data sheet is not wrong, and are hundreds of times wider than what a
# night of stars determines.
_PRINCIPAL_POINT_FRACTION = 0.1
_FOCAL_FRACTION = 0.05
_DISTORTION_FRACTION = 0.05
_SIGMA_PX = (0.1, 1.5)
_SIGMA_SCALE = (1.0, 0.7)


@dataclass(frozen=True)
class PhysicalPriors(Priors):
    """Independent proper priors on the parameters of one camera.

    Attributes
    ----------
    principal_point_px : float
        Standard deviation of x0 and of y0, px.
    principal_point_centre_px : tuple of float
        Mean of (x0, y0), px.
    focal_fraction : float
        Standard deviation of the focal length relative to `focal_px`.
    focal_px : float
        Mean of the focal length, px.
    distortion_corner_px : float
        Standard deviation of the displacement by each distortion term alone at `corner_radius_px`,
        px.
    corner_radius_px : float
        Distance from the principal point at which the displacement is stated, px.
    sigma_median : float
        Median of the centroid noise: px, or a factor where every star states its own noise.
    sigma_log_sd : float
        Standard deviation of the logarithm of the noise.
    distortion : str
        Name of the distortion model, which gives names and orders of the coefficients.
    per_star_sigma : bool
        True where the noise parameter is a common factor on stated noises.
    axes : tuple of float
        Means of stretch and skew, in a model that has them.
    """

    principal_point_px: float
    principal_point_centre_px: tuple[float, float]
    focal_fraction: float
    focal_px: float
    distortion_corner_px: float
    corner_radius_px: float
    sigma_median: float
    sigma_log_sd: float
    distortion: str = "brown"
    per_star_sigma: bool = False
    axes: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        centre = tuple(float(v) for v in self.principal_point_centre_px)
        if len(centre) != 2 or not all(math.isfinite(v) for v in centre):
            raise PriorError(
                f"prior 'principal_point_centre_px' is {self.principal_point_centre_px}: give "
                "two finite numbers."
            )
        object.__setattr__(self, "principal_point_centre_px", centre)
        object.__setattr__(self, "axes", tuple(float(v) for v in self.axes))
        for name in _POSITIVE:
            object.__setattr__(self, name, positive_number(name, getattr(self, name)))
        with np.errstate(all="ignore"):
            variance = np.diag(self.theta_moments()[1])
        if not (np.isfinite(variance).all() and (variance > 0.0).all()):
            raise PriorError(
                "the prior's widths leave no number for a parameter: look at 'focal_px' "
                f"({self.focal_px:g}), 'focal_fraction' ({self.focal_fraction:g}), "
                "'distortion_corner_px' "
                f"({self.distortion_corner_px:g}) and 'corner_radius_px' "
                f"({self.corner_radius_px:g})."
            )

    @classmethod
    def around(cls, camera: Camera, per_star_sigma: bool = False) -> PhysicalPriors:
        """Wide priors around a nominal camera (see the module's constants for the widths)."""
        median, log_sd = _SIGMA_SCALE if per_star_sigma else _SIGMA_PX
        centre = camera.centre_px
        return cls(
            principal_point_px=_PRINCIPAL_POINT_FRACTION * max(camera.width_px, camera.height_px),
            principal_point_centre_px=(float(centre[0]), float(centre[1])),
            focal_fraction=_FOCAL_FRACTION,
            focal_px=float(camera.focal_px),
            distortion_corner_px=_DISTORTION_FRACTION * float(camera.corner_radius_px),
            corner_radius_px=float(camera.corner_radius_px),
            sigma_median=median,
            sigma_log_sd=log_sd,
            distortion=camera.distortion,
            per_star_sigma=per_star_sigma,
            axes=camera.axes,
        )

    def theta_moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean (p,) and diagonal covariance (p, p), px units."""
        x0, y0 = self.principal_point_centre_px
        model = get_model(self.distortion)
        covariance = physical_covariance(
            self, self.focal_px, self.corner_radius_px, self.distortion
        )
        mean = [x0, y0, self.focal_px, *(0.0 for _ in model.lens)]
        return np.array(mean + list(self.axes if model.axes else ())), covariance

    def to_dict(self) -> AnyDict:
        """Plain values, for files."""
        table = {
            **dataclasses.asdict(self),
            "principal_point_centre_px": list(self.principal_point_centre_px),
            "axes": list(self.axes),
        }
        if not get_model(self.distortion).axes:
            del table["axes"]
        return table

    def _statement(self, name: str) -> str:
        return clause(Stated.PHYSICAL, it=self, name=name)


_FIELDS = tuple(field.name for field in dataclasses.fields(PhysicalPriors))
_POSITIVE = tuple(
    name
    for name in _FIELDS
    if name not in ("principal_point_centre_px", "distortion", "per_star_sigma", "axes")
)
_NUMBER = "a number above zero and below 1e12"

PRIORS = Section(
    {
        "principal_point_px": Key(float, _NUMBER, gt=0.0, lt=1e12),
        "principal_point_centre_px": Key(
            list[float], "two numbers in brackets", min_length=2, max_length=2
        ),
        **{name: Key(float, _NUMBER, gt=0.0, lt=1e12) for name in _POSITIVE[1:]},
    },
    PriorError,
)


def priors_from_table(
    path: str | Path, table: AnyMapping, camera: Camera, per_star_sigma: bool = False
) -> PhysicalPriors:
    """Priors from the entries of a ``[priors]`` table; `path` is for messages."""
    where = f"{path}, section [priors]"
    values = PRIORS.check(table, where)
    try:
        return PhysicalPriors.around(camera, per_star_sigma).replace(**values)
    except PriorError as error:
        raise PriorError(f"{where}: {error}") from None


KIND = "gaussian"


@dataclass(frozen=True, eq=False)
class GaussianPriors(Priors):
    """Joint normal prior on the camera parameters, log-normal on the noise.

    Attributes
    ----------
    theta_mean : array (p,)
        Means of x0, y0, f, k..., px units.
    theta_covariance : array (p, p)
        Covariance of the parameters, px units.
    sigma_median : float
        Median of the centroid noise: px, or a factor where every star states its own noise.
    sigma_log_sd : float
        Standard deviation of the logarithm of the noise.
    distortion : str
        Name of the distortion model.
    per_star_sigma : bool
        True where the noise parameter is a common factor on stated noises.
    source : dict
        Origin of the prior, as plain values: ``name``, ``data_sha256`` (list of hashes of the data
        that are in it already) and what was added to it.
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
                f"the prior has means of shape {mean.shape} and covariances of shape "
                f"{covariance.shape}: the "
                f"distortion model {self.distortion!r} has {p} parameters."
            )
        for name in ("sigma_median", "sigma_log_sd"):
            object.__setattr__(self, name, positive_number(name, getattr(self, name)))
        variance = np.diag(covariance)
        if not (
            np.all(np.isfinite(mean)) and np.all(np.isfinite(covariance)) and np.all(variance > 0.0)
        ):
            raise PriorError(
                "the prior's mean and covariance must be finite, with variances above zero."
            )
        correlation, _ = correlation_of(covariance)
        alike = np.allclose(correlation, correlation.T, rtol=0.0, atol=1e-9)
        if not alike or np.linalg.eigvalsh(symmetric(correlation))[0] < 1e-12:
            raise PriorError("the prior's covariance must be symmetric and positive definite.")
        for name, value in (
            ("theta_mean", mean),
            ("theta_covariance", symmetric(covariance)),
        ):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    def theta_moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean (p,) and covariance (p, p), px units."""
        return self.theta_mean, self.theta_covariance

    def to_dict(self) -> AnyDict:
        """Plain values, for files."""
        arrays = {
            "theta_mean": self.theta_mean.tolist(),
            "theta_covariance": self.theta_covariance.tolist(),
        }
        values = {item.name: getattr(self, item.name) for item in dataclasses.fields(self)}
        return {"kind": KIND, **values, **arrays, "source": dict(self.source)}

    def _statement(self, name: str) -> str:
        mean, sd = self._moments_of(name)
        return clause(Stated.NORMAL, mean=mean, sd=sd, source=self.source.get("name"))
