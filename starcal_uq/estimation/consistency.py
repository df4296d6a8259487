"""Do several runs show the same camera, and the same noise?

With Gaussian noise, ``F = (S_merged - sum S_r) / ((R - 1) p) / s^2`` has Fisher's distribution where all runs share one
camera: S_r is the sum of squares of run r at its own optimum, S_merged the one at the common optimum, and s^2 the
pooled variance. The noises are compared by Bartlett's test.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.estimation.expansion import Optimum

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.estimation.calibration import Calibration

# Below this probability, chance is no explanation that a mission would accept.
ALPHA = 1e-3


@dataclass(frozen=True, eq=False)
class Consistency:
    """Comparison of R runs with what they give together.

    Attributes
    ----------
    names : tuple of str
        The runs.
    parameter_names : tuple of str
        The p camera parameters.
    statistic : float
        F.
    dof : tuple of int
        Its degrees of freedom: (R - 1) p, and those of the pooled noise.
    p_value : float
        Probability of a larger F if all runs show the same camera.
    distance_sigma : array (R,)
        Distance of each run's optimum from the merged one, in that run's own sigmas (Mahalanobis).
    run_p_value : array (R,)
        Probability of a larger deviation of the run from all others, if it shows the same camera.
    z : array (R, p)
        Deviation of each parameter of the run from the merged one, in units of the deviation's standard deviation.
    sigma : array (R,)
        Noise of each run.
    noise_p_value : float
        Probability of noises that differ as much, if they are the same; NaN where each run keeps its own.
    messages : tuple of str
        What deserves attention, in sentences.
    """

    names: tuple[str, ...]
    parameter_names: tuple[str, ...]
    statistic: float
    dof: tuple[int, int]
    p_value: float
    distance_sigma: FloatArray
    run_p_value: FloatArray
    z: FloatArray
    sigma: FloatArray
    noise_p_value: float
    messages: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """True if neither the cameras nor the noises differ significantly."""
        return not self.messages

    @property
    def odd_one_out(self) -> str:
        """The run that deviates most, in words."""
        run = int(np.argmin(self.run_p_value))
        # Jointly: strongly coupled parameters can each stay within their sigma while their combination does not.
        return f"{self.names[run]} deviates most, by {self.distance_sigma[run]:.1f} of its own sigmas jointly"

    def to_dataframe(self) -> pd.DataFrame:
        """One row per run: noise, distance, probability, and the deviation of every parameter in sigmas."""
        import pandas as pd

        table = pd.DataFrame(
            {
                "run": self.names,
                "sigma": self.sigma,
                "distance_sigma": self.distance_sigma,
                "p_value": self.run_p_value,
            }
        )
        for i, name in enumerate(self.parameter_names):
            table[f"z_{name}"] = self.z[:, i]
        return table

    def to_dict(self) -> AnyDict:
        """Plain lists and numbers; NaN becomes None, which JSON can hold."""
        values = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(self).items()}
        values["noise_p_value"] = None if np.isnan(self.noise_p_value) else self.noise_p_value
        return values

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Consistency:
        """Inverse of `to_dict`."""
        data: AnyDict = dict(values)
        for name in ("distance_sigma", "run_p_value", "z", "sigma"):
            data[name] = np.asarray(data[name], dtype=np.float64)
        for name in ("names", "parameter_names", "dof", "messages"):
            data[name] = tuple(data[name])
        data["noise_p_value"] = float("nan") if data["noise_p_value"] is None else data["noise_p_value"]
        return cls(**data)

    def _repr_html_(self) -> str:
        import html

        table = self.to_dataframe().to_html(index=False, float_format=lambda v: f"{v:.3g}", border=0)
        notes = "".join(f"<li>{html.escape(message)}</li>" for message in self.messages)
        verdict = "show the same camera" if self.p_value >= ALPHA else "do not show the same camera"
        return (
            f"<p><b>Consistency</b>: the runs {verdict} (F = {self.statistic:.3g} with {self.dof[0]} and "
            f"{self.dof[1]} degrees of freedom, p = "
            f"{self.p_value:.2g}).</p>{table}{f'<ul>{notes}</ul>' if notes else ''}"
        )


def consistency_of(calibration: Calibration) -> Consistency | None:
    """The comparison stored with a merged calibration; None for one that was not merged."""
    record = calibration.provenance.get("merge")
    return None if record is None else Consistency.from_dict(record["consistency"])


def compare_runs(
    names: Sequence[str],
    parameter_names: Sequence[str],
    runs: Sequence[Optimum],
    units: Sequence[float],
    merged: Optimum,
) -> Consistency:
    """Compare the optima of runs with the merged one.

    Parameters
    ----------
    names, parameter_names : sequence of str
        Of the runs and of the parameters.
    runs : sequence of Optimum
        Each run's own.
    units : sequence of float
        Divisors of each run's residuals in the merged sum: 1, or the run's own noise.
    merged : Optimum
        The common one.
    """
    from scipy.special import fdtrc

    p = len(merged.theta)
    own = float(sum(run.sum_of_squares / unit**2 for run, unit in zip(runs, units, strict=True)))
    dof = ((len(runs) - 1) * p, sum(run.dof for run in runs))
    pooled = own / dof[1]
    statistic = max(merged.sum_of_squares - own, 0.0) / dof[0] / pooled
    distance, run_p, z = [], [], []
    scale = np.sqrt(np.diag(merged.covariance))
    reduced = merged.covariance / np.outer(scale, scale)
    for run, unit in zip(runs, units, strict=True):
        shift = (run.theta - merged.theta) / scale
        # The run's covariance at the pooled noise; that of its difference from a mean it is part of is the difference.
        covariance = run.covariance * (pooled * unit**2 / run.sigma**2) / np.outer(scale, scale)
        information = run.information * np.outer(scale, scale)
        difference = covariance - reduced * (pooled / merged.sigma**2)
        distance.append(float(np.sqrt(shift @ information @ shift)))
        square = float(shift @ np.linalg.solve(difference, shift))
        run_p.append(float(fdtrc(p, dof[1], max(square, 0.0) / p)))
        z.append(shift / np.sqrt(np.diag(difference)))
    noise_p = float("nan") if any(unit != 1.0 for unit in units) else _bartlett(runs)
    found = Consistency(
        names=tuple(names),
        parameter_names=tuple(parameter_names),
        statistic=float(statistic),
        dof=dof,
        p_value=float(fdtrc(*dof, statistic)),
        distance_sigma=np.array(distance),
        run_p_value=np.array(run_p),
        z=np.array(z),
        sigma=np.array([run.sigma for run in runs]),
        noise_p_value=noise_p,
        messages=(),
    )
    return _with_messages(found)


def _with_messages(found: Consistency) -> Consistency:
    import dataclasses

    messages = []
    if found.p_value < ALPHA:
        messages.append(
            f"The runs do not show the same camera (p = {found.p_value:.2g}): {found.odd_one_out}; the merged sigmas "
            f"are too small by a factor of about {np.sqrt(found.statistic):.2g}."
        )
    if found.noise_p_value < ALPHA:
        values = ", ".join(f"{name} {sigma:.3g}" for name, sigma in zip(found.names, found.sigma, strict=True))
        messages.append(
            f"The runs differ in noise (p = {found.noise_p_value:.2g}; {values}): merge with noise 'own', which "
            "weights each run by its own."
        )
    return dataclasses.replace(found, messages=tuple(messages))


def _bartlett(runs: Sequence[Optimum]) -> float:
    """p-value of Bartlett's test (1937) that all runs have the same noise."""
    from scipy.special import chdtrc

    dof = np.array([run.dof for run in runs], dtype=np.float64)
    variance = np.array([run.sigma**2 for run in runs])
    pooled = float(dof @ variance / dof.sum())
    statistic = float(dof.sum() * np.log(pooled) - dof @ np.log(variance))
    correction = 1.0 + (np.sum(1.0 / dof) - 1.0 / dof.sum()) / (3.0 * (len(runs) - 1))
    return float(chdtrc(len(runs) - 1, max(statistic, 0.0) / correction))
