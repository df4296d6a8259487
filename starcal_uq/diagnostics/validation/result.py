"""The result of a validation: truths against their posteriors, and every test of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.core.display import Shown
from starcal_uq.core.provenance import Provenance
from starcal_uq.core.records import Saved
from starcal_uq.core.remedy import CAMERA, Remedy
from starcal_uq.core.types import BoolArray, FloatArray, IntArray
from starcal_uq.diagnostics.validation.replicates import INTERVAL
from starcal_uq.inference.priors import Priors
from starcal_uq.maths.intervals import binomial_interval, holm
from starcal_uq.maths.ranks import uniformity_p_value

if TYPE_CHECKING:
    import pandas as pd

# Of one false alarm among all tests of a validation.
FAMILY_LEVEL = 0.01
# Below this many replicates, intervals that are half as wide as they should be could go unnoticed.
ENOUGH_REPLICATES = 100


class Finding(NamedTuple):
    """One test."""

    # `quantity`, `test`: ``ranks``, ``coverage`` or ``NEES`` of what.
    quantity: str
    test: str
    p_value: float  # Probability of a result at least as far off when all is well
    rejected: bool  # Holm's procedure over all tests of the validation, at an overall level of 1 %


@dataclass(frozen=True, eq=False)
class Validation(Shown, Saved):
    """Truths against their posteriors over n replicates, for Q quantities and p parameters.

    Attributes
    ----------
    quantities, units : tuple of str
        Camera parameters, noise (if sampled), ``log_likelihood`` (joint, of all data), and
        ``pitch``, ``yaw``, ``roll``: the common rotation that the error of the parameters causes in
        every attitude, to first order.
    camera, nominal : Camera
        The truth (or what it was drawn around), and the start of every calibration.
    priors : Priors
        Sampled with; with ``truth="prior"`` also drawn from.
    replicate : (n,) array of int
        Numbers of the replicates that have a result.
    truth : (n, p+1) array
        Camera parameters and noise, px units.
    ranks : (n, Q) array of int
        Number of draws below the truth, of `n_ranked` nearly independent ones.
    n_ranked : int
        Ranks run from 0 to this number.
    covered : (n, Q) array of bool
        The central 95 % interval holds the truth.
    error, sd : (n, Q) array
        Posterior mean minus truth, and posterior standard deviation, in `units`.
    nees : (n,) array
        Normalised squared error of the camera parameters with mean and covariance of the draws.
    nees_calibration : (n,) array
        Normalised squared error with estimate and covariance of `calibrate`.
    compression_error : (n,) array
        Compressed minus exact log likelihood at the truth, nat; NaN with a likelihood of one's own.
    dof : (n,) array of int
        Degrees of freedom of the calibrations.
    failures : tuple of str
        Reasons of the replicates without a result.
    n_requested : int
        Replicates asked for.
    interrupted : bool
        Stopped by the user before the last one.
    provenance : Provenance
        Seed, settings, versions and time.
    """

    quantities: tuple[str, ...]
    units: tuple[str, ...]
    camera: Camera
    nominal: Camera
    priors: Priors
    replicate: IntArray
    truth: FloatArray
    ranks: IntArray
    n_ranked: int
    covered: BoolArray
    error: FloatArray
    sd: FloatArray
    nees: FloatArray
    nees_calibration: FloatArray
    compression_error: FloatArray
    dof: IntArray
    failures: tuple[str, ...]
    n_requested: int
    interrupted: bool
    provenance: Provenance

    KIND = "starcal_uq validation 1"
    FILE = "a validation", Remedy("validate", (CAMERA,), purpose="to write it")
    SHAPES: ClassVar = """
        q: quantities units
        n p+1: truth
        n: replicate nees nees_calibration compression_error dof
        n q: ranks covered error sd
    """

    def __post_init__(self) -> None:
        if self.n_ranked < 1:
            raise ValueError(f"n_ranked is {self.n_ranked}, no number of draws")

    @property
    def n_replicates(self) -> int:
        """Replicates with a result."""
        return len(self.replicate)

    @property
    def n_parameters(self) -> int:
        """Number p of camera parameters."""
        return int(self.truth.shape[1]) - 1

    @cached_property
    def z(self) -> FloatArray:
        """Errors in posterior standard deviations (n, Q)."""
        return self.error / self.sd

    @property
    def coverage(self) -> FloatArray:
        """Fraction (Q,) of the 95 % intervals that hold the truth."""
        return np.asarray(self.covered.mean(axis=0))

    @cached_property
    def coverage_interval(self) -> FloatArray:
        """95 % binomial interval (Q, 2) of the coverage (Clopper & Pearson)."""
        return np.array(
            [binomial_interval(int(k), self.n_replicates) for k in self.covered.sum(axis=0)]
        )

    @cached_property
    def coverage_p_value(self) -> FloatArray:
        """Binomial p-values (Q,) of a coverage of 95 %."""
        from scipy.stats import binomtest

        counts = self.covered.sum(axis=0)
        return np.array([binomtest(int(k), self.n_replicates, INTERVAL).pvalue for k in counts])

    @cached_property
    def rank_p_value(self) -> FloatArray:
        """p-values (Q,) of uniform ranks; below 0.05 where the curve leaves its band in the
        figure.
        """
        return np.array([uniformity_p_value(ranks, self.n_ranked + 1) for ranks in self.ranks.T])

    @property
    def nees_ratio(self) -> float:
        """Mean NEES over the number of parameters: 1 if the covariance of the draws is right."""
        return float(np.mean(self.nees)) / self.n_parameters

    @property
    def nees_ratio_se(self) -> float:
        """Standard deviation of `nees_ratio` by chance alone.

        With nu degrees of freedom for the noise, NEES is (nu - 2) / nu times p F(p, nu), and
        chi-square for many.
        """
        p, nu = self.n_parameters, np.maximum(self.dof, 5)
        return float(np.sqrt(np.mean(2.0 / p * (p + nu - 2.0) / (nu - 4.0)) / self.n_replicates))

    @property
    def nees_p_value(self) -> float:
        """p-value of a mean NEES of p, from the gamma distribution with the mean and variance that
        it should have.
        """
        from scipy.stats import gamma

        variance = self.nees_ratio_se**2
        law = gamma(1.0 / variance, scale=variance)
        return float(min(1.0, 2.0 * min(law.cdf(self.nees_ratio), law.sf(self.nees_ratio))))

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """All tests, smallest p-value first."""
        tests = [("camera parameters", "NEES", self.nees_p_value)]
        tests += [
            (q, "ranks", float(p)) for q, p in zip(self.quantities, self.rank_p_value, strict=True)
        ]
        tests += [
            (q, "coverage", float(p))
            for q, p in zip(self.quantities, self.coverage_p_value, strict=True)
        ]
        tests.sort(key=lambda test: test[2])
        corrected = holm([p for *_, p in tests])
        return tuple(
            Finding(*test, bool(p <= FAMILY_LEVEL))
            for test, p in zip(tests, corrected, strict=True)
        )

    @property
    def ok(self) -> bool:
        """No test objects, there were enough replicates, and at most one in a hundred failed."""
        few_failed = len(self.failures) <= 0.01 * (self.n_replicates + len(self.failures))
        return (
            few_failed
            and self.n_replicates >= ENOUGH_REPLICATES
            and not any(f.rejected for f in self.findings)
        )

    def to_dataframe(self) -> pd.DataFrame:
        """One row per quantity.

        Columns are ``quantity``, ``unit``, ``posterior_sd`` (median), ``rms_error`` (of the
        posterior mean), ``bias_sd`` and ``rms_sd`` (mean and root mean square of the error in
        posterior standard deviations), ``coverage_95`` with its binomial interval ``coverage_low``
        and ``coverage_high``, ``coverage_p`` and ``rank_p``.
        """
        import pandas as pd

        return pd.DataFrame(
            {
                "quantity": list(self.quantities),
                "unit": list(self.units),
                "posterior_sd": np.median(self.sd, axis=0),
                "rms_error": np.sqrt(np.mean(self.error**2, axis=0)),
                "bias_sd": self.z.mean(axis=0),
                "rms_sd": np.sqrt(np.mean(self.z**2, axis=0)),
                "coverage_95": self.coverage,
                "coverage_low": self.coverage_interval[:, 0],
                "coverage_high": self.coverage_interval[:, 1],
                "coverage_p": self.coverage_p_value,
                "rank_p": self.rank_p_value,
            }
        )
