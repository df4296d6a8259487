"""The result of many replicates: raw estimates and claims, and the table that judges them."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import parameters
from starcal_uq.core.formatting import fixed, percent, significant
from starcal_uq.core.records import read, write
from starcal_uq.core.types import AnyDict, BoolArray, FloatArray, IntArray
from starcal_uq.maths.intervals import holm
from starcal_uq.paper.methods import Method
from starcal_uq.paper.statistics import FAMILY_LEVEL, classical_words, summarise, words

if TYPE_CHECKING:
    import pandas as pd

_TESTS = ("bias_p", "claimed_p", "coverage95_p", "claimed_classical_p")


@dataclass(frozen=True, eq=False)
class Replicates:
    """Estimates and claims of M methods over n replicates, for p parameters of the truth.

    Attributes
    ----------
    methods : tuple of Method
        Who calibrated; all of them the same data.
    truth, start : Camera
        What was simulated, and where every method started.
    replicate : (n,) array of int
        Numbers of the replicates.
    estimates : (M, n, p) array
        Estimates, px units; NaN for parameters that a method leaves out, and where it failed.
    claimed : (M, n, p) array
        The standard deviation that the method gives with each.
    classical : (M, n, p) array
        Standard deviations by the formula of the textbooks: ``(J^T J)^-1 s^2`` with pairs taken as independent for
        least squares over pairs, and a filter's own for filters. NaN where there is none.
    crlb : (n, p) array
        Cramer-Rao bound on the standard deviations for each design, at the truth, all p parameters and the attitudes
        unknown.
    map_px, map_arcsec : (M, n) arrays
        Root mean square error over the detector of the directions that an estimated camera gives, the best common
        rotation removed (`starcal_uq.paper.errors.map_error`); NaN where the estimated distortion folds over.
    reprojection_px : (M, n) array
        Eq. 16 of the paper over the detector, without noise
        (`starcal_uq.paper.errors.reprojection_error_px`): blind to a wrong focal length.
    failures : tuple of tuple of str
        For each method and replicate why there is no result; empty where there is one.
    n_requested : int
        Replicates asked for.
    interrupted : bool
        Stopped by the user before the last one.
    provenance : dict
        Seed, settings, versions and time.
    """

    methods: tuple[Method, ...]
    truth: Camera
    start: Camera
    replicate: IntArray
    estimates: FloatArray
    claimed: FloatArray
    classical: FloatArray
    crlb: FloatArray
    map_px: FloatArray
    map_arcsec: FloatArray
    reprojection_px: FloatArray
    failures: tuple[tuple[str, ...], ...]
    n_requested: int
    interrupted: bool
    provenance: AnyDict

    @property
    def n_replicates(self) -> int:
        """Number of replicates."""
        return len(self.replicate)

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the methods."""
        return tuple(method.label for method in self.methods)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Parameters of the truth."""
        return self.truth.parameter_names

    @property
    def bound(self) -> FloatArray:
        """Cramer-Rao bound (p,) on the spread over replicates: root mean square over the designs."""
        return np.asarray(np.sqrt(np.mean(self.crlb**2, axis=0)))

    def errors(self, label: str) -> FloatArray:
        """Estimates minus truth (n, p) of one method, px units."""
        error: FloatArray = self.estimates[self._at(label)] - self.truth.theta
        return error

    def _at(self, label: str) -> int:
        if label not in self.labels:
            raise ValueError(f"there is no method {label!r}: use one of {', '.join(self.labels)}.")
        return self.labels.index(label)

    @cached_property
    def _rows(self) -> list[AnyDict]:
        """Statistics of every method and parameter, with verdicts."""
        rows: list[AnyDict] = []
        for i, method in enumerate(self.methods):
            good = np.isfinite(self.estimates[i, :, 0])
            for j, parameter in enumerate(parameters(self.truth.distortion)):
                error = self.estimates[i, good, j] - self.truth.theta[j]
                if not np.isfinite(error).all():
                    continue
                found = summarise(error, self.claimed[i, good, j], self.classical[i, good, j], float(self.bound[j]))
                head = {"method": method.label, "parameter": parameter.name, "unit": parameter.unit}
                rows.append(head | {"truth": float(self.truth.theta[j])} | found)
        # One family: whoever reads the table looks at every test in it.
        rejected = (holm([row[test] for row in rows for test in _TESTS]) <= FAMILY_LEVEL).reshape(-1, len(_TESTS))
        for row, (bias, claim, coverage, classical) in zip(rows, rejected.tolist(), strict=True):
            row["biased"], row["claim_wrong"], row["classical_wrong"] = bias, claim, classical
            row["verdict"] = words(row, bias, claim, coverage)
            row["verdict_classical"] = classical_words(row, classical)
        return rows

    def table(self) -> pd.DataFrame:
        """One row per method and parameter, in px units.

        Columns
        -------
        method, parameter, unit, truth, n
            What, and over how many replicates.
        bias, bias_se, bias_over_spread
            Mean error with its standard error, and as a multiple of the spread.
        spread, spread_se, crlb
            Standard deviation of the estimates with its standard error, and the Cramer-Rao bound on it.
        efficiency, efficiency_low, efficiency_high
            Variance of the bound over that of the estimates, with 95 % interval. It can exceed one for methods that
            are biased, or that leave parameters out.
        rmse, rmse_over_crlb
            Root mean square error, bias and spread together.
        claimed, claimed_over_spread, .._low, .._high
            Root mean square of the method's own standard deviations; over the spread, with 95 % interval.
        claimed_over_rmse
            The same over the root mean square error: what it claims of its error, bias included.
        coverage95, coverage95_low, coverage95_high
            How often the claimed 95 % interval holds the truth, with Wilson interval.
        claimed_classical, ...
            The same eight for the formula of the textbooks: pairs taken as independent, or a filter's own covariance.
        bias_p, claimed_p, coverage95_p, claimed_classical_p, coverage95_classical_p
            p-values of single tests; the verdicts rest on Holm's procedure over all of them at 1 %.
        biased, claim_wrong, classical_wrong
            What the procedure rejects: that the mean error is zero, that the spread is as claimed, and that it is as
            the formula of the textbooks claims.
        verdict, verdict_classical
            In words.
        """
        import pandas as pd

        return pd.DataFrame(self._rows)

    def accuracy(self) -> pd.DataFrame:
        """One row per method: errors over the field, without noise, of the cameras that it finds.

        Columns
        -------
        method, n
            Who, and over how many replicates.
        map_px, map_arcsec
            Root mean square over detector and replicates of the error of a direction, best common rotation removed.
        map_px_low, map_px_high
            Range that holds 95 % of the replicates.
        reprojection_px
            Eq. 16 of the paper, root mean square over the replicates.
        """
        import pandas as pd

        rows = []
        for i, label in enumerate(self.labels):
            good = np.isfinite(self.map_px[i])
            low, high = np.quantile(self.map_px[i, good], [0.025, 0.975]) if good.any() else (np.nan, np.nan)
            sizes = {
                name: float(np.sqrt(np.mean(getattr(self, name)[i, good] ** 2))) if good.any() else np.nan
                for name in ("map_px", "map_arcsec", "reprojection_px")
            }
            rows.append({"method": label, "n": int(good.sum()), **sizes, "map_px_low": low, "map_px_high": high})
        return pd.DataFrame(rows)

    def row(self, label: str, parameter: str) -> AnyDict:
        """The row of the table of one method and parameter."""
        for row in self._rows:
            if (row["method"], row["parameter"]) == (label, parameter):
                return row
        raise ValueError(f"the method {label!r} has no estimate of {parameter!r}.")

    @property
    def verdict(self) -> str:
        """What was found, in plain words, method by method."""
        from starcal_uq.paper.show.study_words import replicates_verdict

        return replicates_verdict(self)

    def verdict_of(self, label: str) -> str:
        """What was found of one method, in plain words."""
        from starcal_uq.paper.show.study_words import verdict_of

        return verdict_of(self, label)

    def n_failed(self, label: str) -> int:
        """Number of replicates in which a method gave no result."""
        return sum(map(bool, self.failures[self._at(label)]))

    @property
    def wrong_claims(self) -> BoolArray:
        """Whether the claim of a parameter is rejected, (M, p)."""
        wrong = np.zeros((len(self.methods), len(self.parameter_names)), dtype=np.bool_)
        for row in self._rows:
            wrong[self._at(row["method"]), self.parameter_names.index(row["parameter"])] = row["claim_wrong"]
        return wrong

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything to one ``.npz`` file, atomically; overwritten."""
        write(self, path, _FORMAT)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Replicates:
        """Read what `save` wrote, without loss.

        Raises
        ------
        RunFolderError
            If the file is missing or is not a set of replicates.
        """
        return read(
            cls,
            path,
            _FORMAT,
            missing="run `starcal-uq reproduce` first",
            wrong="does not hold replicates; run `starcal-uq reproduce` to write it again",
        )

    def plot(self, **options: Any) -> Any:
        """Bias, spread, claims and bound of every method; options as for `starcal_uq.paper.show.study_figures.plot_replicates`."""
        from starcal_uq.paper.show.study_figures import plot_replicates

        return plot_replicates(self, **options)

    def _repr_html_(self) -> str:
        from html import escape

        head = (
            "method",
            "parameter",
            "bias",
            "spread",
            "bound",
            "efficiency",
            "claimed / spread",
            "coverage",
            "verdict",
        )
        body = []
        for row in self._rows:
            parameter = next(p for p in parameters(self.truth.distortion) if p.name == row["parameter"])
            low, high = row["claimed_over_spread_low"], row["claimed_over_spread_high"]
            cells = (
                row["method"],
                f"{parameter.name} [{parameter.scaled_unit}]",
                f"{significant(row['bias'] / parameter.scale)} ± {significant(row['bias_se'] / parameter.scale, 1)}",
                significant(row["spread"] / parameter.scale),
                significant(row["crlb"] / parameter.scale),
                fixed(row["efficiency"], 2),
                f"{fixed(row['claimed_over_spread'], 2)} ({fixed(low, 2)} to {fixed(high, 2)})",
                percent(row["coverage95"], 3),
                row["verdict"],
            )
            body.append("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>")
        return (
            f"<p><b>Replicates</b>: {escape(self.verdict)}</p><table><thead><tr>"
            + "".join(f"<th>{name}</th>" for name in head)
            + f"</tr></thead><tbody>{''.join(body)}</tbody></table>"
        )


_FORMAT = "starcal_uq replicates 1"
