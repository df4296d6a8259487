"""Performance and knowledge error indices of a budget: absolute, mean, relative, drift and
reproducibility errors.

The definitions are those of the ECSS pointing error glossary (ECSS-E-ST-60-10C). An index is the
budget of rows in which every error is replaced by what the index sees of it (`Behaviour`):

- absolute (APE, AKE): the error itself;
- mean (MPE, MKE): its mean over a window;
- relative (RPE, RKE): the error less the mean of its window;
- drift and reproducibility (PDE, KDE; PRE, KRE): the difference of the means of two windows, of one
  observation period or of different ones.

What is constant for a sensor is in the absolute and the mean error alone. Knowledge errors leave
out the rows of control. The rows then combine as in every total.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from starcal_uq.budgeting.behaviour import Behaviour
from starcal_uq.budgeting.rows import CONTROL, Contributor
from starcal_uq.core.errors import BudgetError, check_known

NAMES = ("APE", "AKE", "MPE", "MKE", "RPE", "RKE", "PDE", "KDE", "PRE", "KRE")
_ABSOLUTE, _MEAN, _RELATIVE = ("APE", "AKE"), ("MPE", "MKE"), ("RPE", "RKE")
_KNOWLEDGE = ("AKE", "MKE", "RKE", "KDE", "KRE")
_CONSTANT = Behaviour("constant")
Behaviours = Mapping[tuple[str, str], Behaviour]


@dataclass(frozen=True)
class Index:
    """An error index with its times.

    Attributes
    ----------
    kind : str
        One of `NAMES`, such as ``RPE``.
    window_seconds : float
        Window of the mean, s; NaN for absolute errors.
    stability_seconds : float
        Time from the beginning of the first window to that of the second, s, of drift and
        reproducibility; NaN for the others.
    """

    kind: str = "APE"
    window_seconds: float = math.nan
    stability_seconds: float = math.nan

    def __post_init__(self) -> None:
        check_known("an error index", self.kind, NAMES, BudgetError)
        for name, wanted in (("window_seconds", self.windowed), ("stability_seconds", self.later)):
            value = getattr(self, name)
            if wanted and not 0.0 < value < math.inf:
                raise BudgetError(
                    f"the index {self.kind} needs {name}; give a positive number of seconds."
                )
            if not (wanted or math.isnan(value)):
                raise BudgetError(f"the index {self.kind} takes no {name}; leave it out.")

    @classmethod
    def of(cls, label: str) -> Index:
        """The index with a `label`."""
        kind, *times = label.replace(" s", "").replace("/", " ").split()
        return cls(kind, *map(float, times))

    @property
    def windowed(self) -> bool:
        """True for all but absolute errors."""
        return self.kind not in _ABSOLUTE

    @property
    def later(self) -> bool:
        """True for the indices that compare two windows."""
        return self.windowed and self.kind not in (*_MEAN, *_RELATIVE)

    @property
    def label(self) -> str:
        """The index with its times: ``APE``, ``RPE 300 s``, ``PDE 300 s / 3600 s``."""
        times = [t for t in (self.window_seconds, self.stability_seconds) if not math.isnan(t)]
        return " ".join([self.kind, " / ".join(f"{t:.12g} s" for t in times)]).strip()


def seen_by(
    index: Index, rows: Sequence[Contributor], behaviours: Behaviours
) -> tuple[tuple[Contributor, ...], tuple[str, ...]]:
    """What an index sees of rows, as rows to be combined like those of the budget.

    Parameters
    ----------
    index : Index
        The index.
    rows : sequence of Contributor
        Rows of the budget.
    behaviours : mapping
        Behaviour in time by name and axis. Without one, a row of the ensemble is constant, and
        another one is taken at most: its mean and its relative error have the whole standard
        deviation, a difference twice that.

    Returns
    -------
    tuple of Contributor, tuple of str
        The rows, and the contributors that were taken at most.

    Raises
    ------
    BudgetError
        Where a window is longer than what a drift or a time series says anything about.
    """
    chosen = [row for row in rows if index.kind not in _KNOWLEDGE or row.part != CONTROL]
    if not index.windowed:
        return tuple(chosen), ()
    at_most: dict[str, None] = {}
    made = []
    for row in chosen:
        behaviour = behaviours.get((row.name, row.axis))
        if behaviour is None and (row.interpretation == "ensemble" or not row.sigma_arcsec > 0.0):
            behaviour = _CONSTANT
        if behaviour is None and row.applies and row.assessed:
            at_most[row.name] = None
        made.append(replace(row, **_changes(index, row, behaviour)))
    return tuple(made), tuple(at_most)


def _changes(index: Index, row: Contributor, behaviour: Behaviour | None) -> dict[str, Any]:
    mean = {} if index.kind in _MEAN else {"mean_arcsec": 0.0 * row.mean_arcsec}
    if behaviour is None:
        return {**mean, "sigma_arcsec": (2.0 if index.later else 1.0) * row.sigma_arcsec}
    window, later = index.window_seconds, index.stability_seconds
    reach = window + (later if index.later and behaviour.kind == "drift" else 0.0)
    if reach > behaviour.longest_s * (1.0 + 1e-9):
        raise BudgetError(
            f"{row.name!r} is known over {behaviour.longest_s:g} s, which is shorter than the "
            f"times of the index {index.label}; state it over a longer time, or shorten the window."
        )
    if index.kind in _MEAN:
        share = behaviour.kept(window)
    elif index.kind in _RELATIVE:
        share = behaviour.left(window)
    else:
        share = behaviour.changed(window, later)
    sigma = math.sqrt(share) * row.sigma_arcsec
    if behaviour.kind == "drift" and index.later and row.interpretation == "temporal":
        # Of a known rate the change is known.
        return {"mean_arcsec": sigma, "sigma_arcsec": 0.0, "distribution": "constant"}
    shape = {} if _keeps_shape(index, behaviour) else {"distribution": "gaussian"}
    return {**mean, "sigma_arcsec": sigma, **shape}


def _keeps_shape(index: Index, behaviour: Behaviour) -> bool:
    """Whether the error of the index is distributed as that of the row."""
    if behaviour.kind == "periodic":
        # A sinusoid again; a Gaussian reaches further than what a window leaves of one.
        return index.kind not in _RELATIVE
    return behaviour.kind == "constant" or (behaviour.kind == "drift" and not index.later)
