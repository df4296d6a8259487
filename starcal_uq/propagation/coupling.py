"""How the parameters are coupled: which trade against each other, by how much, and what the data
say of each.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from starcal_uq.core.constants import AXES
from starcal_uq.core.display import Shown
from starcal_uq.core.types import FloatArray, floats
from starcal_uq.maths.linear import correlation_of, root_diagonal, unit_inverse

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.camera.camera import Camera

# From this correlation on a pair counts as coupled.
COUPLED = 0.5
# A parameter takes part in a direction when its share of the direction's length exceeds this.
PART = 0.25
# Directions whose variance lies within these bounds are those of uncoupled parameters.
ALONE = (0.7, 1.4)


class HasCovariance(Protocol):
    """What a coupling is taken from: a `Posterior`, a `Calibration`, or a `Plan` before there are
    data.
    """

    @property
    def camera(self) -> Camera:
        """The camera."""
        ...

    @property
    def covariance(self) -> FloatArray:
        """Covariance (p, p) of the parameters, px units."""
        ...

    @property
    def information(self) -> FloatArray:
        """Fisher information (p, p) of the data."""
        ...

    @property
    def rotation_per_theta(self) -> FloatArray:
        """Common rotation (3, p) that a parameter causes, rad."""
        ...

    @property
    def attitude_noise(self) -> FloatArray:
        """Covariance (3, 3) of one frame's attitude due to centroid noise, rad^2."""
        ...


@dataclass(frozen=True)
class WeakDirection:
    """A combination of parameters, in units of their own sigmas.

    Attributes
    ----------
    weights : (p,) array
        Unit vector over the parameters divided by their marginal sigmas; the largest entry is
        positive.
    variance : float
        Variance along it, as an eigenvalue of the correlation matrix (they sum to p).
    words : str
        Description in words.
    """

    weights: FloatArray
    variance: float
    words: str


@dataclass(frozen=True)
class Coupling(Shown):
    """Coupling of the parameters.

    Attributes
    ----------
    parameter_names : tuple of str
        Optics and distortion, in order (p of them).
    units : tuple of str
        Units of the parameters.
    correlation : (p, p) array
        Correlation matrix.
    covariance : (p, p) array
        Covariance matrix, px units.
    sigma_marginal : (p,) array
        Standard deviations, all others unknown.
    sigma_conditional : (p,) array
        Standard deviations, all others known.
    variance_inflation : (p,) array
        (marginal / conditional)^2: the price of not knowing the others.
    information : (p, p) array
        Fisher information of the data (attitudes eliminated), px units.
    crlb_sigma : (p,) array
        Cramer-Rao bounds: square roots of the diagonal of the inverse information.
    prior_sigma : (p,) array or None
        Standard deviations of the prior.
    contraction : (p,) array or None
        1 - (posterior variance / prior variance): 1 when the data decide, 0 when the prior does.
    weak_directions : tuple of WeakDirection
        From the least to the best determined, relative to the parameters' own sigmas.
    extended_names : tuple of str
        Parameters, then pitch, yaw and roll of the common rotation.
    extended_correlation : (p + 3, p + 3) array
        Correlations including the attitude common to all frames: the near-gauge of principal point
        and boresight.
    common_rotation_arcsec : (3,) array
        Standard deviation of that common rotation about X, Y and Z.
    single_frame_correlation : (p, 3) array
        Correlation of the parameters with the attitude of one average frame, centroid noise
        included.
    """

    parameter_names: tuple[str, ...]
    units: tuple[str, ...]
    correlation: FloatArray
    covariance: FloatArray
    sigma_marginal: FloatArray
    sigma_conditional: FloatArray
    variance_inflation: FloatArray
    information: FloatArray
    crlb_sigma: FloatArray
    prior_sigma: FloatArray | None
    contraction: FloatArray | None
    weak_directions: tuple[WeakDirection, ...]
    extended_names: tuple[str, ...]
    extended_correlation: FloatArray
    common_rotation_arcsec: FloatArray
    single_frame_correlation: FloatArray

    def pairs(self, at_least: float = COUPLED) -> list[tuple[str, str, float]]:
        """Pairs of parameters with a correlation of at least this size, the strongest first."""
        i, j = np.triu_indices(len(self.parameter_names), 1)
        strong = [
            (self.parameter_names[a], self.parameter_names[b], float(self.correlation[a, b]))
            for a, b in zip(i, j, strict=True)
            if abs(self.correlation[a, b]) >= at_least
        ]
        return sorted(strong, key=lambda pair: -abs(pair[2]))

    def to_dataframe(self) -> pd.DataFrame:
        """One row per parameter: sigmas, inflation, bound, contraction and its row of the extended
        correlations.
        """
        import pandas as pd

        p = len(self.parameter_names)
        table = pd.DataFrame(
            {
                "parameter": self.parameter_names,
                "unit": self.units,
                "sigma_marginal": self.sigma_marginal,
                "sigma_conditional": self.sigma_conditional,
                "variance_inflation": self.variance_inflation,
                "crlb_sigma": self.crlb_sigma,
            }
        )
        if self.prior_sigma is not None:
            table["prior_sigma"] = self.prior_sigma
            table["contraction"] = self.contraction
        for index, name in enumerate(self.extended_names):
            table[f"corr_{name}"] = self.extended_correlation[:p, index]
        return table


def coupling(result: HasCovariance) -> Coupling:
    """Analyse the coupling of the parameters of a posterior, of a calibration, or of a plan.

    Parameters
    ----------
    result : Posterior, Calibration or Plan
        Supplies the covariance (of the draws, or of the estimate), the Fisher information of the
        data, the response of the common attitude to the parameters, and, for a posterior, the
        prior. Of a plan it is what the frames that its target takes will give (`Plan.expected` for
        another number).
    """
    from starcal_uq.camera.distortion import parameters

    specs = parameters(result.camera.distortion)
    names = tuple(spec.name for spec in specs)
    covariance = floats(result.covariance)
    correlation, sigma = correlation_of(covariance)
    conditional = sigma / root_diagonal(np.linalg.inv(correlation))
    information = floats(result.information)
    inverse, scale = unit_inverse(information)
    bound = root_diagonal(inverse) * scale
    priors = getattr(result, "priors", None)
    prior_sigma = None if priors is None else floats(priors.sd(names))
    response = floats(result.rotation_per_theta)
    extended, common = _extended(covariance, response)
    noise = floats(result.attitude_noise)
    frame_sigma = root_diagonal(response @ covariance @ response.T + noise)
    return Coupling(
        parameter_names=names,
        units=tuple(spec.unit for spec in specs),
        correlation=correlation,
        covariance=covariance,
        sigma_marginal=sigma,
        sigma_conditional=conditional,
        variance_inflation=(sigma / conditional) ** 2,
        information=information,
        crlb_sigma=bound,
        prior_sigma=prior_sigma,
        contraction=None if prior_sigma is None else 1.0 - (sigma / prior_sigma) ** 2,
        weak_directions=weak_directions(correlation, names),
        extended_names=names + AXES,
        extended_correlation=extended,
        common_rotation_arcsec=np.rad2deg(common) * 3600.0,
        single_frame_correlation=covariance @ response.T / np.outer(sigma, frame_sigma),
    )


def _extended(covariance: FloatArray, response: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Correlations of the parameters with the common rotation they cause, and its standard
    deviations (rad).
    """
    joint = np.vstack([np.eye(len(covariance)), response])
    correlation, sigma = correlation_of(joint @ covariance @ joint.T)
    # The last bit of a one would show as 1.0000 beside 1.00.
    np.fill_diagonal(correlation, np.rint(np.diag(correlation)))
    return correlation, sigma[-3:]


def weak_directions(correlation: FloatArray, names: tuple[str, ...]) -> tuple[WeakDirection, ...]:
    """Eigenvectors of a correlation matrix (p, p), from the least to the best determined."""
    values, vectors = np.linalg.eigh(correlation)
    directions = []
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        weights = vector * np.sign(vector[np.argmax(np.abs(vector))])
        directions.append(
            WeakDirection(weights, float(value), _words(weights, float(value), names))
        )
    return tuple(directions)


def _words(weights: FloatArray, variance: float, names: tuple[str, ...]) -> str:
    """Say which parameters trade against each other along a direction.

    No template: workers of a study make these words for every cell, and need not load any.
    """
    order = [i for i in np.argsort(-np.abs(weights)) if abs(weights[i]) >= PART]
    up = [names[i] for i in order if weights[i] > 0.0]
    down = [names[i] for i in order if weights[i] < 0.0]
    if len(order) == 1 or ALONE[0] < variance < ALONE[1]:
        return f"{' and '.join(names[i] for i in order)}: not coupled to the others"
    trade = (
        f"{' and '.join(up)} against {' and '.join(down)}"
        if down
        else f"{' and '.join(up)} together"
    )
    if variance > 1.0:
        return (
            f"{trade}: poorly determined, {variance:.2g} times the variance of uncoupled parameters"
        )
    return f"{trade}: well determined, {variance:.2g} times the variance of uncoupled parameters"
