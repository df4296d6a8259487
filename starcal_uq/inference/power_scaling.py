"""How much the posterior depends on the prior, and on the likelihood, by power scaling.

Kallioinen, Paananen, Burkner & Vehtari (2024, Statistics and Computing 34:57): prior or likelihood
is raised to a power alpha near 1, which importance weights of the existing draws do without
sampling again (Pareto-smoothed). How fast the posterior moves, per doubling of alpha, is measured
by the cumulative Jensen-Shannon distance of Nguyen & Vreeken (2015).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.display import Shown
from starcal_uq.core.errors import PriorError
from starcal_uq.core.types import FloatArray, floats

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.inference.posterior import Posterior

# The step and the threshold of the paper (and of the R package priorsense).
_DELTA = 0.01
THRESHOLD = 0.05
CONFLICT, WEAK, FINE = "prior-data conflict", "weak likelihood", "fine"
# Powers at which the importance weights must still hold, for the gradient to describe more than a
# point.
_CHECKED = (0.8, 1.25)


@dataclass(frozen=True, eq=False)
class PriorSensitivity(Shown):
    """Power-scaling sensitivity of q quantities.

    Attributes
    ----------
    names : tuple of str
        The sampled parameters, then further quantities.
    prior, likelihood : array (q,)
        Cumulative Jensen-Shannon distance per doubling of the power of prior and likelihood, at
        power 1.
    prior_mean_shift, likelihood_mean_shift : array (q,)
        Change of the posterior mean per doubling of the power, in posterior standard deviations.
    prior_sd_change, likelihood_sd_change : array (q,)
        Relative change of the posterior standard deviation per doubling.
    prior_khat, likelihood_khat : float
        Largest Pareto shape of the weights at powers 0.8 and 1.25; below 0.7 they can be trusted.
    diagnosis : tuple of str
        ``prior-data conflict`` where the posterior is sensitive to both, ``weak likelihood`` where
        it is sensitive to the prior only, ``fine`` otherwise.
    threshold : float
        Sensitivity from which the posterior counts as sensitive.
    """

    names: tuple[str, ...]
    prior: FloatArray
    likelihood: FloatArray
    prior_mean_shift: FloatArray
    likelihood_mean_shift: FloatArray
    prior_sd_change: FloatArray
    likelihood_sd_change: FloatArray
    prior_khat: float
    likelihood_khat: float
    diagnosis: tuple[str, ...]
    threshold: float = THRESHOLD

    @property
    def ok(self) -> bool:
        """True if every quantity is fine."""
        return all(word == FINE for word in self.diagnosis)

    def to_dataframe(self) -> pd.DataFrame:
        """One row per quantity."""
        import pandas as pd

        return pd.DataFrame(
            {
                "parameter": self.names,
                "prior": self.prior,
                "likelihood": self.likelihood,
                "diagnosis": self.diagnosis,
                "prior_mean_shift": self.prior_mean_shift,
                "prior_sd_change": self.prior_sd_change,
                "likelihood_mean_shift": self.likelihood_mean_shift,
                "likelihood_sd_change": self.likelihood_sd_change,
            }
        )


def prior_sensitivity(
    posterior: Posterior,
    extra: Mapping[str, FloatArray] | None = None,
    threshold: float = THRESHOLD,
) -> PriorSensitivity:
    """Power-scale the prior and the likelihood of a posterior.

    Parameters
    ----------
    posterior : Posterior
        Posterior whose draws have their log densities.
    extra : mapping of str to array (n,), optional
        Further quantities, one value per draw.
    threshold : float
        Sensitivity from which the posterior counts as sensitive.

    Raises
    ------
    PriorError
        When an extra quantity has another number of draws.
    """
    columns = {posterior.parameter_names[i]: posterior.draws[:, i] for i in posterior.sampled}
    for name, values in (extra or {}).items():
        if np.shape(values) != posterior.log_posterior.shape:
            raise PriorError(
                f"{name!r} has shape {np.shape(values)}: give one value for each of the draws."
            )
        columns[name] = floats(values)
    log_prior = posterior.priors.log_density_theta(posterior.theta_draws)
    if posterior.sigma_sampled:
        log_prior = log_prior + posterior.priors.log_density_log_sigma(
            np.log(posterior.sigma_draws)
        )
    prior, likelihood = (
        _component(c, columns) for c in (log_prior, posterior.log_posterior - log_prior)
    )
    return PriorSensitivity(
        names=tuple(columns),
        prior=prior.distance,
        likelihood=likelihood.distance,
        prior_mean_shift=prior.mean_shift,
        likelihood_mean_shift=likelihood.mean_shift,
        prior_sd_change=prior.sd_change,
        likelihood_sd_change=likelihood.sd_change,
        prior_khat=prior.khat,
        likelihood_khat=likelihood.khat,
        diagnosis=tuple(
            _diagnosis(a, b, threshold)
            for a, b in zip(prior.distance, likelihood.distance, strict=True)
        ),
        threshold=threshold,
    )


def _diagnosis(prior: float, likelihood: float, threshold: float) -> str:
    if prior < threshold:
        return FINE
    return CONFLICT if likelihood >= threshold else WEAK


@dataclass(frozen=True)
class _Component:
    distance: FloatArray
    mean_shift: FloatArray
    sd_change: FloatArray
    khat: float


def _component(log_density: FloatArray, columns: Mapping[str, FloatArray]) -> _Component:
    """Sensitivity to one factor of the posterior, whose logarithm at the draws is given."""
    from starcal_uq.inference.arviz import power_sensitivity, psis

    shift = log_density - log_density.mean()
    powers = (1.0 / (1.0 + _DELTA), 1.0 + _DELTA)
    weights = [np.exp(psis((power - 1.0) * shift)[0]) for power in powers]
    khat = max(float(psis((power - 1.0) * shift)[1]) for power in _CHECKED)
    distance, mean_shift, sd_change = [], [], []
    # Derivatives with respect to log2(alpha) at 1: d E[q] / d alpha = cov(q, log density).
    doubling = float(np.log(2.0))
    for values in columns.values():
        # Standardised: 1e-15 px^-4 and 5852 px are alike then, and the distance does not depend on
        # scale.
        z = (values - values.mean()) / values.std()
        distance.append(power_sensitivity(z, weights, powers))
        mean_shift.append(float(np.mean(z * shift)) * doubling)
        sd_change.append(0.5 * float(np.mean((z * z - 1.0) * shift)) * doubling)
    return _Component(np.array(distance), np.array(mean_shift), np.array(sd_change), float(khat))
