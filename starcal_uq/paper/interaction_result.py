"""The result of an interaction study: one table, and where bias overtakes noise."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.files import atomic_path
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.paper.statistics import chi_interval

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.paper.interaction import Outcome

# Methods of the study, and what they do about the distortion while they estimate the optics.
HANDLING = {
    "least squares": "ignores",
    "samaan": "decouples",
    "three stages": "couples",
    "efficient": "couples",
}
REFERENCE = "efficient"
OPTICS = ("x0", "y0", "f")
AXES = ("distortion", "field", "frames", "stars")
# The column that an axis is drawn and judged against.
AXIS_COLUMN = {
    "distortion": "corner_size_px",
    "field": "field_deg",
    "frames": "n_frames",
    "stars": "stars_per_frame",
}


class Threshold(NamedTuple):
    """Where along an axis a ratio of a method passes one.

    Attributes
    ----------
    kind : str
        ``bias``: |bias| over noise; ``rmse``: root mean square error over that of the efficient method.
    axis, method, parameter : str
        What.
    side : str
        ``above`` or ``below`` the value the ratio exceeds one; ``always`` or ``never`` within the range.
    value : float
        In the unit of the axis (px at the corner, deg, frames, stars in a frame), interpolated; NaN if there is none.
    low, high : float
        Interval of `value` from the 95 % interval of the noise; for ``rmse`` NaN.
    """

    kind: str
    axis: str
    method: str
    parameter: str
    side: str
    value: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class InteractionStudy:
    """Bias and spread of the optics along four axes.

    Attributes
    ----------
    table : DataFrame
        One row per point, method and parameter; columns as in `to_dataframe`.
    interrupted : bool
        Stopped by the user before the last data set.
    provenance : dict
        Seed, settings, versions and time; empty when the table was read from a file.
    """

    table: pd.DataFrame
    interrupted: bool = False
    provenance: AnyDict = field(default_factory=dict)

    @classmethod
    def from_rows(cls, rows: Sequence[AnyDict], interrupted: bool, provenance: AnyDict) -> InteractionStudy:
        """Collect the rows of `summary_rows`."""
        import pandas as pd

        return cls(pd.DataFrame(list(rows)), interrupted, provenance)

    def to_dataframe(self) -> pd.DataFrame:
        """One row per point, method and parameter.

        Columns
        -------
        axis, value
            ``distortion`` (factor on the coefficients), ``field`` (deg), ``frames``, ``stars`` (magnitude limit).
        corner_px, corner_size_px
            What the distortion displaces at the farthest corner, px outwards, and its size.
        field_deg, n_frames, stars_per_frame, max_mag, min_stars, sigma_px, seed
            The data: `stars_per_frame` is what was found, the others what was asked for.
        method, handling, parameter, unit
            Who, what it does about the distortion, and of what.
        n, failed
            Replicates with and without a result.
        bias, bias_se, design_spread
            Mean error without noise with its standard error, and the standard deviation of that error over designs.
        noise, noise_se
            Standard deviation of the difference between the estimates with and without noise: what noise alone does,
            with its standard error.
        spread, spread_se
            Standard deviation of the estimates with noise, over designs and noise, with its standard error.
        noise_shift, noise_shift_se
            Mean of that difference, with its standard error.
        rmse
            Root mean square error with noise.
        crlb
            Cramer-Rao bound on the spread with all parameters unknown.
        bias_over_noise, bias_over_noise_low, bias_over_noise_high
            Size of the bias over `noise`, with the 95 % interval that comes from the latter.
        """
        return self.table.copy()

    def points(self, axis: str, method: str, parameter: str) -> pd.DataFrame:
        """Rows of one curve, in the order of the axis."""
        t = self.table
        some = t[(t["axis"] == axis) & (t["method"] == method) & (t["parameter"] == parameter)]
        return some.sort_values(AXIS_COLUMN[axis], kind="stable")

    @cached_property
    def thresholds(self) -> tuple[Threshold, ...]:
        """Where the bias is one standard deviation of the noise, and where a method falls behind the efficient one."""
        found = []
        for axis in AXES:
            for method in HANDLING:
                for parameter in OPTICS:
                    rows = self.points(axis, method, parameter)
                    rows = rows[np.isfinite(rows["noise"])]
                    if len(rows) < 2:
                        continue
                    at = rows[AXIS_COLUMN[axis]].to_numpy()
                    columns = [f"bias_over_noise{end}" for end in ("", "_low", "_high")]
                    ratios = [rows[column].to_numpy() for column in columns]
                    (side, value), *others = (crossing(at, one) for one in ratios)
                    low, high = (place for _, place in others)
                    ends = (np.nan, np.nan) if np.isnan(value) else (min(low, high), max(low, high))
                    found.append(Threshold("bias", axis, method, parameter, side, value, *ends))
                    if method != REFERENCE:
                        reference = self.points(axis, REFERENCE, parameter)[["value", "rmse"]]
                        both = rows.merge(reference, on="value", suffixes=("", "_reference"))
                        ratio = (both["rmse"] / both["rmse_reference"]).to_numpy()
                        side, value = crossing(both[AXIS_COLUMN[axis]].to_numpy(), ratio)
                        found.append(Threshold("rmse", axis, method, parameter, side, value, np.nan, np.nan))
        return tuple(found)

    def thresholds_table(self) -> pd.DataFrame:
        """One row per threshold, columns as the attributes of `Threshold`."""
        import pandas as pd

        return pd.DataFrame(list(self.thresholds), columns=list(Threshold._fields))

    def threshold(self, axis: str, method: str, parameter: str, kind: str = "bias") -> Threshold:
        """One of `thresholds`."""
        for one in self.thresholds:
            if (one.axis, one.method, one.parameter, one.kind) == (axis, method, parameter, kind):
                return one
        raise ValueError(f"the study has no {kind!r} threshold of {parameter!r} by {method!r} along {axis!r}.")

    @property
    def verdict(self) -> str:
        """Where the interaction starts to cost more than noise, method by method, in plain words."""
        from starcal_uq.paper.show.study_words import interaction_verdict

        return interaction_verdict(self)

    def save_csv(self, path: str | os.PathLike[str]) -> None:
        """Write the table, atomically; overwritten. Numbers keep all digits."""
        with atomic_path(path) as temporary:
            self.table.to_csv(temporary, index=False, lineterminator="\n")

    @classmethod
    def load_csv(cls, path: str | os.PathLike[str]) -> InteractionStudy:
        """Read what `save_csv` wrote.

        Raises
        ------
        RunFolderError
            If the file is missing or does not hold an interaction study.
        """
        import pandas as pd

        try:
            # As text first: the fast parser of numbers loses the last digit.
            text = pd.read_csv(path, dtype=str, keep_default_na=False)
        except OSError as error:
            raise RunFolderError(
                f"{path}: cannot be read ({error.strerror or error}); run `starcal-uq reproduce` first."
            ) from error
        except ValueError as error:
            raise RunFolderError(f"{path}: is not a table ({error}); run `starcal-uq reproduce` again.") from error
        missing = sorted({*_TEXT, "bias", "spread"} - set(text.columns))
        if missing:
            raise RunFolderError(
                f"{path}: is not an interaction study, it lacks the column {missing[0]!r}; run `starcal-uq reproduce` "
                "again."
            )
        try:
            table = pd.DataFrame({name: _column(name, text[name].tolist()) for name in text.columns})
        except ValueError as error:
            raise RunFolderError(
                f"{path}: holds text in a column of numbers ({error}); run `starcal-uq reproduce` again."
            ) from error
        return cls(table)

    def plot(self, **options: Any) -> Any:
        """Bias and spread along the four axes; options as for `starcal_uq.paper.show.study_figures.plot_interaction`."""
        from starcal_uq.paper.show.study_figures import plot_interaction

        return plot_interaction(self, **options)

    def _repr_html_(self) -> str:
        from html import escape

        from starcal_uq.paper.show.study_words import cell

        units = {"distortion": "px at the corner", "field": "deg", "frames": "frames", "stars": "stars in a frame"}
        head = "".join(f"<th>{axis} [{units[axis]}]</th>" for axis in AXES)
        body = []
        for method in HANDLING:
            for parameter in OPTICS:
                some = {
                    t.axis: t for t in self.thresholds if (t.kind, t.method, t.parameter) == ("bias", method, parameter)
                }
                if some:
                    cells = "".join(f"<td>{escape(cell(axis, some.get(axis)))}</td>" for axis in AXES)
                    body.append(f"<tr><td>{method}</td><td>{parameter}</td>{cells}</tr>")
        return (
            f"<p><b>Interaction of optics and distortion</b>: {escape(self.verdict)}</p>"
            f"<table><caption>Where the bias exceeds one standard deviation of the noise</caption>"
            f"<thead><tr><th>method</th><th>parameter</th>{head}</tr></thead><tbody>{''.join(body)}</tbody></table>"
        )


def summary_rows(head: AnyDict, outcomes: Sequence[Outcome]) -> list[AnyDict]:
    """Rows of one point of an axis: every method and parameter."""
    noise_free = np.stack([outcome.noise_free for outcome in outcomes], axis=1)
    noisy = np.stack([outcome.noisy for outcome in outcomes], axis=1)
    bound = np.sqrt(np.mean(np.stack([outcome.crlb for outcome in outcomes]) ** 2, axis=0))
    rows = []
    for (method, handling), clean, full in zip(HANDLING.items(), noise_free, noisy, strict=True):
        good = np.isfinite(clean[:, 0]) & np.isfinite(full[:, 0])
        for j, parameter in enumerate(OPTICS):
            body: AnyDict = {"method": method, "handling": handling, "parameter": parameter, "unit": "px"}
            body |= {"n": int(np.sum(good)), "failed": int(np.sum(~good))}
            rows.append(head | body | _summary(clean[good, j], full[good, j]) | {"crlb": float(bound[j])})
    return rows


def _summary(clean: FloatArray, full: FloatArray) -> AnyDict:
    n = len(clean)
    if n < 2:
        return dict.fromkeys(_STATISTICS, np.nan)
    bias, design = float(np.mean(clean)), float(np.std(clean, ddof=1))
    change = full - clean
    noise, spread = float(np.std(change, ddof=1)), float(np.std(full, ddof=1))
    low, high = chi_interval(n)
    values = (
        *(bias, design / np.sqrt(n), design),
        *(noise, noise / np.sqrt(2.0 * (n - 1))),
        *(spread, spread / np.sqrt(2.0 * (n - 1))),
        *(float(np.mean(change)), noise / np.sqrt(n)),
        float(np.sqrt(np.mean(full**2))),
        *(abs(bias) / noise, abs(bias) / noise * low, abs(bias) / noise * high),
    )
    return dict(zip(_STATISTICS, map(float, values), strict=True))


_TEXT = ("axis", "method", "handling", "parameter", "unit")
_WHOLE = ("n_frames", "min_stars", "seed", "n", "failed")
_STATISTICS = (
    *("bias", "bias_se", "design_spread"),
    *("noise", "noise_se"),
    *("spread", "spread_se"),
    *("noise_shift", "noise_shift_se"),
    "rmse",
    *("bias_over_noise", "bias_over_noise_low", "bias_over_noise_high"),
)


def _column(name: str, values: list[str]) -> list[str] | list[int] | list[float]:
    if name in _TEXT:
        return values
    return [int(v) for v in values] if name in _WHOLE else [float(v) if v else np.nan for v in values]


def crossing(at: FloatArray, ratio: FloatArray) -> tuple[str, float]:
    """Where a ratio passes one for good: ``above``, ``below``, ``always`` or ``never``, and the place.

    Interpolated between logarithms, linearly in `at` next to zero.
    """
    over = ratio >= 1.0
    if over.all():
        return "always", float("nan")
    if not over.any():
        return "never", float("nan")
    if over[-1]:
        i = int(np.flatnonzero(~over)[-1])
        side = "above"
    else:
        i = int(np.flatnonzero(over)[-1])
        side = "below"
    x, y = at[[i, i + 1]], ratio[[i, i + 1]]
    if x[0] > 0.0 and y.min() > 0.0:
        share = np.log(y[0]) / (np.log(y[0]) - np.log(y[1]))
        return side, float(np.exp(np.log(x[0]) + share * (np.log(x[1]) - np.log(x[0]))))
    share = (1.0 - y[0]) / (y[1] - y[0])
    return side, float(x[0] + share * (x[1] - x[0]))
