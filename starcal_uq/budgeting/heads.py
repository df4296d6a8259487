"""The budget of an array of heads: rows of each head, turned into the body by its weight, and rows
that all heads have in common.

A head's error e about its axes turns the fused attitude of the body by G e (`HeadArray.gains`), so
that every row of its budget becomes a row of the body. Gaussian rows are turned with their
covariance. Another error of one axis stays one error: its parts about X, Y and Z of the body are a
correlation group. An error of the body itself, such as that of the bracket under all heads, is no
smaller with many heads: it stands in the file of the heads, as in that of a budget.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path

import numpy as np

from starcal_uq.attitude.heads import HeadArray, load_heads
from starcal_uq.budgeting.behaviour import Behaviour
from starcal_uq.budgeting.budget import combination, confidence_of, from_file, row_notes
from starcal_uq.budgeting.file import BudgetFile, load_budget_file
from starcal_uq.budgeting.posterior import axis_correlations
from starcal_uq.budgeting.result import Budget, by_contributor
from starcal_uq.budgeting.rows import NEA, Contributor, Remark
from starcal_uq.budgeting.sampling import N_SAMPLES
from starcal_uq.budgeting.totals import covariance
from starcal_uq.core.constants import AXES
from starcal_uq.core.errors import BudgetError, RunFolderError
from starcal_uq.core.findings import clause
from starcal_uq.core.provenance import provenance
from starcal_uq.core.remedy import Remedy
from starcal_uq.core.settings import Seed, bounded, seed_of
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.types import AnyDict, FloatArray, PathLike

_LETTERS = dict(zip(AXES, "XYZ", strict=True))
# A row is turned with its covariance where its axes are alike in these.
_ALIKE = ("ecss_class", "interpretation", "absorbed_by_alignment", "part", "behaviour")
# Figures that are turned alike.
_SIGMAS = ("sigma_arcsec", "if_model_holds_arcsec", "with_misfit_found_arcsec")
# Less of an error than this is rounding.
_NOTHING = 1e-9
# Noise above the least by more than this is worth a note.
_WORSE = 0.02
_FILE = "budget.csv"


@bounded
@one_thread()
def array_budget(
    file: PathLike,
    budgets: Sequence[Budget] | None = None,
    *,
    confidence: float | None = None,
    n_samples: int = N_SAMPLES,
    seed: Seed = 0,
) -> Budget:
    """Attitude error budget of the body from those of its heads.

    Heads are weighed by the covariance of their centroid noise, or by what the file states that the
    software aboard weighs them by.

    Parameters
    ----------
    file : path
        Heads and their mountings, as of `starcal_uq.attitude.load_heads`, and beside them what a
        budget file may hold: contributors that all heads have in common and requirements, both
        about X, Y and Z of the body. A contributor that it states replaces that of the heads.
    budgets : sequence of Budget, optional
        Those of the heads, in their order; those of their run folders by default.
    confidence : float, optional
        Probability of the totals; that of the file, or 0.997.
    n_samples, seed : int
        Number and seed of the sampled totals.

    Raises
    ------
    HeadError, BudgetError
        If the file is wrong, a head has neither run nor budget, or no centroid noise.
    RunFolderError
        If a run folder holds no budget.
    """
    seed = seed_of(seed)
    heads, stated = load_heads(file), load_budget_file(file, ("head",))
    if stated.sensor is not None:
        raise BudgetError(
            f"{file}, [budget]: key sensor belongs to the budget of one head; move it there."
        )
    if budgets is None:
        for name, run in zip(heads.names, heads.runs, strict=True):
            if not run:
                raise BudgetError(
                    f"{file}, head {name!r}: names no run; add run, the run folder of its "
                    "calibration."
                )
            if not (Path(run) / _FILE).exists():
                again = Remedy("budget", (str(run),), purpose="to make it")
                raise RunFolderError(f"{run}: holds no budget; {again}.")
        budgets = [Budget.load(Path(run) / _FILE) for run in heads.runs]
    if len(budgets) != len(heads.names):
        raise BudgetError(
            f"{file}: there are {len(budgets)} budgets for {len(heads.names)} heads; give one for "
            "each."
        )
    chosen = confidence_of(stated, confidence, n_samples)
    noise = np.stack(
        [_noise(name, budget) for name, budget in zip(heads.names, budgets, strict=True)]
    )
    weighed = noise
    if heads.weighed_arcsec is not None:
        weighed = np.where(
            np.isnan(heads.weighed_arcsec)[:, :1, None],
            noise,
            heads.weighed_arcsec[:, :, None] ** 2 * np.eye(3),
        )
    gains, _ = heads.gains(weighed)
    turned = _Turned(heads, gains, stated)
    shared = {row.name for row in stated.contributors}
    for name in dict.fromkeys(row.name for budget in budgets for row in budget.rows):
        if name not in shared:
            turned.add(name, [by_contributor(budget.rows).get(name, {}) for budget in budgets])
    for common in from_file(stated, (), ()):
        turned.keep(common.name, [common])
    rows = tuple(turned.rows)
    settings = {"file": str(file), "heads": list(heads.names), "n_samples": n_samples}
    return Budget(
        **combination(rows, stated, turned.behaviours, chosen, n_samples, seed),
        title=stated.title or f"Attitude error budget of {len(heads.names)} heads",
        notes=(
            clause(Remark.OF_HEADS),
            *_of_weights(heads, gains, noise),
            *row_notes(rows),
        ),
        provenance=provenance(seed, settings, None),
        document=stated.document,
        configuration={"heads": list(heads.names)},
    )


def _noise(name: str, budget: Budget) -> FloatArray:
    """Covariance (3, 3) of a head's centroid noise, arcsec^2."""
    rows = [row for row in budget.rows if row.name == NEA and row.assessed]
    found = covariance(rows)
    if not (len(rows) == len(AXES) and np.diag(found).min() > 0.0):
        raise BudgetError(
            f"the budget of head {name!r} holds no {NEA!r} about three axes, which weighs it; make "
            "it from its posterior."
        )
    return found


def _of_weights(heads: HeadArray, gains: FloatArray, noise: FloatArray) -> tuple[str, ...]:
    """How much larger the noise is than with the best weights, where it is."""
    _, least = heads.gains(noise)
    found = np.einsum("hij,hjk,hik->i", gains, noise, gains)
    worse = float(np.max(np.sqrt(found / np.diag(least)))) - 1.0
    if worse < _WORSE:
        return ()
    return (clause(Remark.WEIGHTS, worse=worse),)


@dataclass(frozen=True, eq=False)
class _Turned:
    """Rows of the body, and how they behave in time."""

    heads: HeadArray
    gains: FloatArray
    stated: BudgetFile
    rows: list[Contributor] = field(default_factory=list)
    behaviours: dict[tuple[str, str], Behaviour] = field(default_factory=dict)

    def add(self, name: str, by_head: Sequence[Mapping[str, Contributor]]) -> None:
        """One contributor of all heads."""
        every = [row for axes in by_head for row in axes.values()]
        if not any(row.assessed for row in every):
            self.rows.extend(every[: len(AXES)])
            return
        for head, gain, axes in zip(self.heads.names, self.gains, by_head, strict=True):
            rows = list(axes.values())
            called = f"{head}: {name}"
            if not any(row.assessed for row in rows):
                self.rows.extend(replace(row, name=called) for row in rows)
                continue
            if _gaussian(rows):
                self.keep(name, _together(rows, called, gain))
                continue
            for row in filter(attrgetter("applies"), rows):
                own = f"{called} about {_LETTERS[row.axis]}"
                self.keep(name, _alone(row, own, head, gain))

    def keep(self, name: str, rows: Sequence[Contributor]) -> None:
        """Rows of a contributor, which behave as the file states, or as their heads do."""
        for row in rows:
            behaviour = self.stated.behaviours.get((name, row.axis))
            if behaviour is None and name == NEA and self.stated.frame_seconds is not None:
                behaviour = Behaviour("white", self.stated.frame_seconds)
            behaviour = behaviour or Behaviour.of_text(row.behaviour)
            if behaviour is not None:
                self.behaviours[row.name, row.axis] = behaviour
                row = replace(row, behaviour=behaviour.text)
            self.rows.append(row)


def _gaussian(rows: Sequence[Contributor]) -> bool:
    """Whether the axes of a contributor are one Gaussian error."""
    alike = len({tuple(getattr(row, key) for key in _ALIKE) for row in rows}) == 1
    return alike and all(
        row.assessed and not row.correlation_group and row.distribution in ("gaussian", "constant")
        for row in rows
    )


def _together(rows: Sequence[Contributor], name: str, gain: FloatArray) -> list[Contributor]:
    """An error of Gaussian axes, or of one axis alone, about the axes of the body."""
    mean = gain[:, [AXES.index(row.axis) for row in rows]] @ [row.mean_arcsec for row in rows]
    figures: AnyDict = {}
    for key in _SIGMAS:
        of_head = covariance([replace(row, sigma_arcsec=getattr(row, key)) for row in rows])
        figures[key] = gain @ of_head @ gain.T
    correlations = axis_correlations(figures[_SIGMAS[0]], np.ones(3))
    made = []
    for i, axis in enumerate(AXES):
        own: AnyDict = {key: math.sqrt(max(matrix[i, i], 0.0)) for key, matrix in figures.items()}
        own |= {"mean_arcsec": float(mean[i]), "axis_correlation": correlations[i]}
        own |= {"tail_997": max(row.tail_997 for row in rows)}
        own |= {"applies": any(row.applies for row in rows)}
        made.append(replace(rows[0], name=name, axis=axis, **own))
    return made


def _alone(row: Contributor, name: str, head: str, gain: FloatArray) -> list[Contributor]:
    """An error about one axis of a head, which turns the body about a fixed axis."""
    group, sign = row.group
    together = f"{head}: {group}" if group else name
    made = []
    for moved, turn in zip(
        _together([row], name, gain), gain[:, AXES.index(row.axis)], strict=True
    ):
        signed = together if sign * turn > 0.0 else f"-{together}"
        own: AnyDict = {"correlation_group": signed, "axis_correlation": ()}
        if abs(turn) < _NOTHING:
            # It is known to be nothing about this axis.
            own |= dict.fromkeys(("mean_arcsec", *_SIGMAS), 0.0)
            own |= {"source": "file", "correlation_group": ""}
        made.append(replace(moved, **own))
    return made
