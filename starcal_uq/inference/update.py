"""A posterior as the prior of the next run, and whether the camera changed between two runs.

Ground calibration to orbit is the case in mind: what the ground determined is worth keeping, but
the launch may have moved it. So the prior can be widened by an allowed shift in physical terms, and
the shift that did happen is tested.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import parameters
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import PriorError, check_known
from starcal_uq.core.provenance import data_hashes
from starcal_uq.core.types import AnyMapping, FloatArray
from starcal_uq.inference.posterior import Posterior
from starcal_uq.inference.priors import (
    SIGMA_NAMES,
    GaussianPriors,
    Priors,
    physical_covariance,
    positive_number,
)
from starcal_uq.maths.linear import correlation_of, root_diagonal

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.estimation.result import Calibration

NOISES = ("default", "posterior")
SHIFT_KEYS = ("principal_point_px", "focal_fraction", "distortion_corner_px")
ALPHA = 1e-3


@dataclass(frozen=True)
class AllowedShift:
    """Standard deviations of what may have changed between two runs, in physical terms; zero is no
    change.

    Attributes
    ----------
    principal_point_px : float
        Allowed shift of x0 and of y0, px.
    focal_fraction : float
        Allowed relative shift of the focal length.
    distortion_corner_px : float
        Allowed shift of the displacement by each distortion term at the corner of the field, px.
    """

    principal_point_px: float = 0.0
    focal_fraction: float = 0.0
    distortion_corner_px: float = 0.0

    def __post_init__(self) -> None:
        for name in SHIFT_KEYS:
            value = float(getattr(self, name))
            if not (np.isfinite(value) and value >= 0.0):
                raise PriorError(
                    f"the allowed shift {name!r} is {value:g}: it must be a finite number, zero "
                    "or more."
                )

    def covariance(self, camera: Camera) -> FloatArray:
        """Diagonal covariance (p, p) for the parameters of a camera, px units."""
        radius_px = float(camera.corner_radius_px)
        return physical_covariance(self, camera.focal_px, radius_px, camera.distortion)


def prior_from(
    posterior: Posterior,
    *,
    inflation: float = 1.0,
    shift: AllowedShift | None = None,
    noise: str = "default",
    per_star_sigma: bool | None = None,
    name: str = "an earlier posterior",
    data_sha256: Collection[str] = (),
) -> GaussianPriors:
    """Turn a posterior into a prior: normal with its mean and full covariance, log-normal for the
    noise.

    Parameters
    ----------
    posterior : Posterior
        Posterior of the earlier run.
    inflation : float
        Factor on all standard deviations, at least 1.
    shift : AllowedShift, optional
        Added to the covariance: what may have changed since.
    noise : {"default", "posterior"}
        ``default``: the wide prior of `Priors.default`, because centroid noise belongs to the
        exposures and the sky and not to the camera. ``posterior``: log-normal with the moments of
        the earlier noise's logarithm.
    per_star_sigma : bool, optional
        Whether the next run's stars state their noise; as in the earlier run by default.
    name : str
        Name of the earlier run in tables.
    data_sha256 : collection of str
        Hashes of the data behind the posterior besides the one it states.

    Raises
    ------
    PriorError
        For an inflation below 1, or a noise that means something else in the next run.
    """
    check_known("the prior's noise", noise, NOISES, PriorError)
    if positive_number("inflation", inflation) < 1.0:
        raise PriorError(
            f"the prior's inflation is {inflation:g}: use 1 or more; less would claim what no "
            "data showed."
        )
    stated = posterior.sigma_name == SIGMA_NAMES[1]
    per_star = stated if per_star_sigma is None else per_star_sigma
    if noise == "posterior" and (per_star != stated or not posterior.sigma_sampled):
        raise PriorError(
            f"the noise of {name} cannot become a prior, because it was given or is of another "
            "kind: use noise "
            "'default'."
        )
    shift = AllowedShift() if shift is None else shift
    wide = Priors.default(posterior.camera, per_star)
    median, log_sd = wide.sigma_median, wide.sigma_log_sd
    if noise == "posterior":
        log_sigma = np.log(posterior.sigma_draws)
        median, log_sd = float(np.exp(log_sigma.mean())), float(log_sigma.std(ddof=1)) * inflation
    hashes = data_hashes(posterior.provenance) | set(data_sha256)
    inherited = getattr(posterior.priors, "source", {})
    return GaussianPriors(
        theta_mean=posterior.mean,
        theta_covariance=posterior.covariance * inflation**2 + shift.covariance(posterior.camera),
        sigma_median=median,
        sigma_log_sd=log_sd,
        distortion=posterior.camera.distortion,
        per_star_sigma=per_star,
        source={
            "name": name,
            "data_sha256": sorted(hashes | set(inherited.get("data_sha256", ()))),
            "inflation": float(inflation),
            "shift": dict(vars(shift)),
            "noise": noise,
            "detector": _detector(posterior.camera),
        },
    )


def check_chain(priors: Priors, camera: Camera, data_sha256: Collection[str] = ()) -> None:
    """Refuse a chained prior of another camera, or one that the same data have shaped already."""
    source: AnyMapping = getattr(priors, "source", {})
    name = source.get("name", "the prior")
    if priors.distortion != camera.distortion:
        raise PriorError(
            f"{name} has the distortion model {priors.distortion!r}, this run "
            f"{camera.distortion!r}: calibrate both "
            "with the same model."
        )
    if "detector" in source and list(source["detector"]) != _detector(camera):
        raise PriorError(
            f"{name} is of another detector (width, height in px, pixel in um): "
            f"{source['detector']}."
        )
    if set(data_sha256) & set(source.get("data_sha256", ())):
        raise PriorError(
            f"{name} rests on the observations of this run already, which would count twice: use "
            "other data."
        )


def _detector(camera: Camera) -> list[float | None]:
    return [camera.width_px, camera.height_px, camera.pixel_um]


@dataclass(frozen=True, eq=False)
class ShiftTest(Shown):
    """Did the camera change between two runs?

    Attributes
    ----------
    names : tuple of str
        The p camera parameters.
    units : tuple of str
        Units of the parameters.
    shift : array (p,)
        After minus before, px units.
    covariance : array (p, p)
        Covariance of the shift if nothing changed (or no more than was allowed for).
    z : array (p,)
        Shift in its standard deviations.
    statistic : float
        Squared Mahalanobis length of the shift; p on average if nothing changed.
    dof : float
        Degrees of freedom of the noise estimates behind the covariance; infinite where they are in
        the posteriors.
    p_value : float
        Probability of a larger statistic if nothing changed.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    shift: FloatArray
    covariance: FloatArray
    z: FloatArray
    statistic: float
    dof: float
    p_value: float

    @property
    def significant(self) -> bool:
        """True if chance is no explanation (p below 0.001)."""
        return self.p_value < ALPHA

    def to_dataframe(self) -> pd.DataFrame:
        """One row per parameter: shift, its sigma, and their ratio."""
        import pandas as pd

        return pd.DataFrame(
            {
                "parameter": self.names,
                "unit": self.units,
                "shift": self.shift,
                "sigma": root_diagonal(self.covariance),
                "z": self.z,
            }
        )


def shift_test(
    before: Calibration | Posterior,
    after: Calibration | Posterior,
    allowed: AllowedShift | None = None,
) -> ShiftTest:
    """Compare two estimates from different data.

    The statistic is ``d^T (C_before + C_after + C_allowed)^-1 d``. Calibrations know the degrees of
    freedom of their noise, so that its p-value is taken from F; the effective number for the sum of
    two covariances is Welch's.

    Parameters
    ----------
    before, after : Calibration or Posterior
        Of the same kind of camera, from different observations. A posterior whose own prior came
        from another run does not stand on its data alone: give its calibration.
    allowed : AllowedShift, optional
        Change that would be no surprise.

    Raises
    ------
    PriorError
        For other cameras, the same data, or a posterior with a chained prior.
    """
    from scipy.special import chdtrc, fdtrc

    for result in (before, after):
        if isinstance(getattr(result, "priors", None), GaussianPriors):
            raise PriorError(
                "a posterior whose prior came from another run does not stand on its own data: "
                "test its calibration."
            )
    if before.camera.distortion != after.camera.distortion or _detector(before.camera) != _detector(
        after.camera
    ):
        raise PriorError(
            "the two runs are of different detectors or distortion models: their parameters do "
            "not compare."
        )
    if data_hashes(before.provenance) & data_hashes(after.provenance):
        raise PriorError(
            "the two runs rest on the same observations: a shift can only be seen between "
            "different data."
        )
    specs = parameters(after.camera.distortion)
    shift = _estimate(after) - _estimate(before)
    extra = (AllowedShift() if allowed is None else allowed).covariance(after.camera)
    covariance = before.covariance + after.covariance + extra
    correlation, sd = correlation_of(covariance)
    inverse = np.linalg.inv(correlation)
    z, p = shift / sd, len(shift)
    statistic = float(z @ inverse @ z)
    # Share of each run's covariance in the sum, for the effective degrees of freedom.
    loss = 0.0
    for result in (before, after):
        share = float(np.trace(inverse @ (result.covariance / np.outer(sd, sd)))) / p
        loss += share**2 / float(getattr(result, "dof", np.inf))
    dof = 1.0 / loss if loss > 0.0 else float("inf")
    p_value = (
        float(fdtrc(p, dof, statistic / p)) if np.isfinite(dof) else float(chdtrc(p, statistic))
    )
    return ShiftTest(
        names=tuple(spec.name for spec in specs),
        units=tuple(spec.unit for spec in specs),
        shift=shift,
        covariance=covariance,
        z=z,
        statistic=statistic,
        dof=dof,
        p_value=p_value,
    )


def _estimate(result: Calibration | Posterior) -> FloatArray:
    return result.mean if isinstance(result, Posterior) else result.theta
