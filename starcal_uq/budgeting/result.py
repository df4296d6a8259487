"""The budget as a result: rows, totals, margins; saved in the format that the file ending names."""

from __future__ import annotations

import csv
import itertools
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from starcal_uq.budgeting.file import SENSOR, Requirement
from starcal_uq.budgeting.filters import FilterState
from starcal_uq.budgeting.rows import AXIS_LABELS, ECSS_CLASSES, KNOWLEDGE, SCOPES, Contributor
from starcal_uq.budgeting.sampling import Samples, draw
from starcal_uq.budgeting.totals import Difference, Total, grouped_sigma, read_difference, total
from starcal_uq.core.constants import AXES, CROSS_BORESIGHT
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import BudgetError
from starcal_uq.core.files import atomic_path, cell_content, cell_text, reading
from starcal_uq.core.findings import Finding
from starcal_uq.core.provenance import Provenance
from starcal_uq.core.records import to_json, to_plain
from starcal_uq.core.remedy import RUN, Remedy
from starcal_uq.core.status import Advice, Check, Code, Level, Order
from starcal_uq.core.types import AnyDict, AnyMapping, FloatArray, PathLike

if TYPE_CHECKING:
    import pandas as pd

# All that people may call an axis: its name, its letter, its label in the tables of any version.
_AXIS_NAMES = {
    **{name: name for name in AXIS_LABELS},
    **{label: name for name, label in AXIS_LABELS.items()},
    **dict(zip("xyz", AXES, strict=True)),
    **{f"{letter} ({name})": name for letter, name in zip("xyz", AXES, strict=True)},
    "x and y together": CROSS_BORESIGHT,
}


@dataclass(frozen=True)
class Outcome(Shown):
    """A requirement against the total that it is about, which is at the requirement's
    confidence.
    """

    requirement: Requirement
    total: Total

    @property
    def bound_arcsec(self) -> float:
        """Bound that is compared with the limit: by the rule, by sampling, or the larger of both.

        NaN if it is not known. The larger of both is at least the rule, which is enough where that
        violates the limit.
        """
        return self._judged(self.total.rule_arcsec, self.total.sampled_arcsec)

    @property
    def least_arcsec(self) -> float:
        """The same bound at the least: worst cases do not meet, and what is absorbed in part is
        gone.

        Only where it is above the limit is the requirement violated.
        """
        least = self._judged(self.total.rule_least_arcsec, self.total.sampled_least_arcsec)
        return self.bound_arcsec if math.isnan(least) else least

    def _judged(self, rule: float, sampled: float) -> float:
        asked = self.requirement
        if asked.judged_by == "both" and math.isnan(sampled) and rule > asked.limit_arcsec:
            return rule
        both = math.nan if math.isnan(sampled) else max(rule, sampled)
        return {"rule": rule, "sampling": sampled}.get(asked.judged_by, both)

    @property
    def margin_arcsec(self) -> float:
        """Limit minus bound; negative if violated, or open between the least and the bound."""
        return self.requirement.limit_arcsec - self.bound_arcsec

    @property
    def verdict(self) -> str:
        """``violated``, ``met``, or ``open``.

        Open while contributors are missing or samples do not resolve the confidence, and where the
        limit lies between what is reached for certain and a bound that is only an upper one.
        """
        if self.least_arcsec > self.requirement.limit_arcsec:
            return "violated"
        # No row at all is assessed, or the samples end too early: the margin is not a number.
        return "met" if self.margin_arcsec >= 0.0 and not self.total.at_least else "open"

    @property
    def level(self) -> Level:
        """The verdict as the outcome of a check."""
        return {"violated": Level.FAIL, "open": Level.WARN, "met": Level.PASS}[self.verdict]

    @property
    def between(self) -> bool:
        """True if it is open because the bound above the limit is only an upper one."""
        return self.verdict == "open" and self.margin_arcsec < 0.0

    @property
    def unresolved(self) -> bool:
        """True if it is open because the samples do not resolve its confidence."""
        return self.total.unresolved and math.isnan(self.bound_arcsec)


def requirement_checks(budget: Budget | None) -> tuple[Check, ...]:
    """The requirements of a budget as checks of a run's verdict; none without a budget."""
    return tuple(
        _requirement_check(outcome) for outcome in (() if budget is None else budget.outcomes)
    )


def _requirement_check(outcome: Outcome) -> Check:
    asked, total = outcome.requirement, outcome.total
    orders: tuple[Order, ...] = (Order(Advice.REDUCE_OR_RELAX, {"row": total.dominant}),)
    if outcome.level is Level.PASS:
        orders = ()
    elif outcome.unresolved:
        orders = (Order(Advice.LET_THE_RULE_JUDGE),)
    elif outcome.level is Level.WARN and not outcome.between:
        orders = (Order(Advice.STATE_WHAT_IS_MISSING, {"missing": total.not_assessed}),)
    return Check(
        Code.REQUIREMENT,
        {"outcome": outcome},
        outcome.level,
        {"limit_arcsec": asked.limit_arcsec},
        orders=orders,
        title=f"Requirement {asked.name!r}",
    )


@dataclass(frozen=True, eq=False)
class Budget(Shown):
    """The attitude error budget of a star sensor.

    Attributes
    ----------
    rows : tuple of Contributor
        One per contributor and axis, those not assessed included.
    totals : tuple of Total
        Both scopes, three axes and the two across the boresight together, three interpretations.
    outcomes : tuple of Outcome
        Requirements against their totals.
    confidence : float
        Probability of the totals.
    title : str
        Title.
    notes : tuple of str
        Sentences that the reader has to know: inflations, what stays open.
    provenance : Provenance
        Seed, settings, versions, time and data hash.
    index_totals : tuple of Total
        The same totals of every other error index that was asked for; `totals` are those of the
        absolute knowledge error.
    filter : tuple of FilterState
        What the rows are to a gyro-stellar filter; empty where none is known to change in time.
    document : dict of str
        Title block of the budget to sign, from the user's file.
    configuration : dict
        Camera and data of the calibration: plain values by name.
    """

    rows: tuple[Contributor, ...]
    totals: tuple[Total, ...]
    outcomes: tuple[Outcome, ...]
    confidence: float
    title: str
    notes: tuple[str, ...]
    provenance: Provenance
    index_totals: tuple[Total, ...] = ()
    filter: tuple[FilterState, ...] = ()
    document: Mapping[str, str] = field(default_factory=dict)
    configuration: AnyMapping = field(default_factory=dict)

    @property
    def violations(self) -> tuple[Outcome, ...]:
        """Requirements violated by the assessed contributors alone."""
        return tuple(outcome for outcome in self.outcomes if outcome.verdict == "violated")

    @property
    def open_requirements(self) -> tuple[Outcome, ...]:
        """Requirements that are neither violated nor met: see `Outcome.verdict`."""
        return tuple(outcome for outcome in self.outcomes if outcome.verdict == "open")

    @property
    def comparable(self) -> tuple[Outcome, ...]:
        """Requirements in the sensor's frame, mixed, at the budget's own confidence: its totals are
        about these.
        """
        return tuple(
            outcome
            for outcome in self.outcomes
            if outcome.requirement.interpretation == "mixed"
            and outcome.requirement.index == "AKE"
            and outcome.requirement.frame == SENSOR
            and math.isclose(
                1.0 - outcome.requirement.confidence, 1.0 - self.confidence, rel_tol=1e-9
            )
        )

    @property
    def not_assessed(self) -> tuple[str, ...]:
        """Contributors that are not assessed on some axis."""
        return tuple(dict.fromkeys(row.name for row in self.rows if not row.assessed))

    @property
    def indices(self) -> tuple[str, ...]:
        """Labels of the error indices that have totals, the absolute knowledge error first."""
        return tuple(dict.fromkeys(entry.of_index for entry in (*self.totals, *self.index_totals)))

    def total(
        self,
        axis: str,
        scope: str = "after alignment",
        interpretation: str = "mixed",
        index: str = "AKE",
    ) -> Total:
        """One of the totals.

        Parameters
        ----------
        axis : str
            ``pitch``, ``yaw``, ``roll``, ``cross-boresight``, ``across the boresight``, ``X``,
            ``Y`` or ``Z``.
        scope : str
            ``before alignment`` or ``after alignment``.
        interpretation : str
            ``mixed``, ``ensemble`` or ``temporal``.
        index : str
            One of `indices`, such as ``RKE 300 s``.

        Raises
        ------
        ValueError
            For an unknown axis, scope, interpretation or index.
        """
        name = _AXIS_NAMES.get(axis.strip().lower(), axis)
        wanted = (name, scope, interpretation, index)
        for found in (*self.totals, *self.index_totals):
            if (found.axis, found.scope, found.interpretation, found.of_index) == wanted:
                return found
        raise ValueError(
            f"this budget has no total for {axis!r}, {scope!r}, {interpretation!r}, {index!r}; "
            f"the axis is one of pitch, yaw, roll (or X, Y, Z) or {CROSS_BORESIGHT}, the scope "
            f"{' or '.join(SCOPES)}, the interpretation mixed, ensemble or temporal, the index "
            f"one of {', '.join(self.indices)}"
        )

    def to_dataframe(self) -> pd.DataFrame:
        """One row per contributor and axis: the fields of `Contributor`, ``assessed`` and
        ``combination``.
        """
        return _table(self.rows, Contributor)

    def totals_dataframe(self) -> pd.DataFrame:
        """One row per total: the fields of `Total`, and ``at_least``."""
        import pandas as pd

        rows = [
            {
                **{name: getattr(entry, name) for name in (*_TOTAL, "at_least")},
                **{name: "; ".join(getattr(entry, name)) for name in ("not_assessed", "at_most")},
            }
            for entry in (*self.totals, *self.index_totals)
        ]
        return pd.DataFrame(rows)

    def classes_dataframe(self, scope: str = "after alignment") -> pd.DataFrame:
        """Standard deviations by class of the standard: ``ecss_class``, ``axis``, ``sigma_arcsec``,
        ``at_least``.
        """
        import pandas as pd

        counted = [
            row for row in self.rows if row.counts(scope) and row.applies and row.part == KNOWLEDGE
        ]
        classes = [name for name in ECSS_CLASSES if any(row.ecss_class == name for row in counted)]
        records = []
        for name, axis in itertools.product(classes, AXES):
            rows = [row for row in counted if (row.ecss_class, row.axis) == (name, axis)]
            known = [row for row in rows if row.assessed]
            sigma = grouped_sigma(known) if known or not rows else math.nan
            records.append((name, axis, sigma, any(not row.assessed for row in rows)))
        return pd.DataFrame(records, columns=["ecss_class", "axis", "sigma_arcsec", "at_least"])

    def filter_dataframe(self) -> pd.DataFrame:
        """One row per state of a filter: the fields of `FilterState`, and ``density``."""
        return _table(self.filter, FilterState)

    def requirements_dataframe(self) -> pd.DataFrame:
        """One row per requirement: its fields, the bounds, ``least_arcsec``, ``margin_arcsec`` and
        ``verdict``.
        """
        import pandas as pd

        names = [f.name for f in fields(Requirement)]
        columns = [*names, "rule_arcsec", "sampled_arcsec", "least_arcsec", "bound_arcsec"]
        columns += ["margin_arcsec", "verdict", "at_least"]
        rows = [
            (
                *(getattr(outcome.requirement, name) for name in names),
                *(outcome.total.rule_arcsec, outcome.total.sampled_arcsec),
                *(outcome.least_arcsec, outcome.bound_arcsec),
                *(outcome.margin_arcsec, outcome.verdict, outcome.total.at_least),
            )
            for outcome in self.outcomes
        ]
        return pd.DataFrame(rows, columns=columns)

    def to_dict(self) -> AnyDict:
        """Plain values for JSON; unknown values are None, never zero or NaN."""

        def plain(table: pd.DataFrame) -> Any:
            return to_plain(table.to_dict("records"), null=True)

        return {
            "title": self.title,
            "confidence": self.confidence,
            "contributors": plain(self.to_dataframe()),
            "classes": plain(self.classes_dataframe()),
            "totals": plain(self.totals_dataframe()),
            "requirements": plain(self.requirements_dataframe()),
            "filter": plain(self.filter_dataframe()),
            "violations": [outcome.requirement.name for outcome in self.violations],
            "not_assessed": list(self.not_assessed),
            "notes": list(self.notes),
            "provenance": self.provenance,
        }

    def save(self, path: PathLike) -> None:
        """Write everything as CSV, to the last digit and atomically; overwritten.

        Raises
        ------
        BudgetError
            For another ending than ``.csv``.
        RunFolderError
            If it cannot be written.
        """
        if Path(path).suffix.lower() != ".csv":
            raise BudgetError(
                f"{path}: a budget is saved as .csv; sc.report(budget, path) writes .xlsx, .tex, "
                ".html."
            )
        records = [
            {"record": "contributor", **_plain(row), "combination": row.combination}
            for row in self.rows
        ]
        records += [{"record": "total", **_plain(entry)} for entry in self.totals]
        records += [{"record": "index total", **_plain(entry)} for entry in self.index_totals]
        records += [{"record": "filter state", **_plain(state)} for state in self.filter]
        records += [
            {
                "record": "requirement",
                **_plain(outcome.total),
                **_plain(outcome.requirement),
                "margin_arcsec": repr(outcome.margin_arcsec),
                "verdict": outcome.verdict,
            }
            for outcome in self.outcomes
        ]
        settings = {
            "confidence": self.confidence,
            "title": self.title,
            "notes": list(self.notes),
            "provenance": self.provenance,
            "document": dict(self.document),
            "configuration": dict(self.configuration),
        }
        records += [
            {"record": "setting", "name": key, "value": json.dumps(value)}
            for key, value in settings.items()
        ]
        with (
            atomic_path(path) as temporary,
            open(temporary, "w", newline="", encoding="utf-8") as file,
        ):
            writer = csv.DictWriter(file, _COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows(
                {name: cell_text(value) for name, value in record.items()} for record in records
            )

    @classmethod
    def load(cls, path: PathLike) -> Budget:
        """Read a budget written by `save`, without loss.

        Raises
        ------
        RunFolderError
            If the file is missing or is not a budget.
        """
        with reading(
            path, "an error budget", Remedy("budget", (RUN,), {"force": True}, "to write it again")
        ):
            with open(path, newline="", encoding="utf-8") as file:
                records = [
                    {name: cell_content(cell) for name, cell in record.items()}
                    for record in csv.DictReader(file)
                ]
            by_kind: dict[str, list[dict[str, str]]] = {}
            for record in records:
                before = record.pop("raw_sigma_arcsec", "nan")
                if before not in ("", "nan"):
                    # What a version before called inflated.
                    record |= {
                        "if_model_holds_arcsec": before,
                        "with_misfit_found_arcsec": record["sigma_arcsec"],
                    }
                if told := "difference" not in record and record["explanation"]:
                    # A version before wrote words alone.
                    words = Finding(Difference.IN_WORDS, {"words": told})
                    record["difference"] = to_json(words)
                by_kind.setdefault(record["record"], []).append(record)
            settings = {
                record["name"]: json.loads(record["value"]) for record in by_kind["setting"]
            }
            return Budget(
                rows=tuple(_made(Contributor, record) for record in by_kind["contributor"]),
                totals=tuple(_made(Total, record) for record in by_kind["total"]),
                outcomes=tuple(
                    Outcome(_made(Requirement, record), _made(Total, record))
                    for record in by_kind.get("requirement", [])
                ),
                confidence=float(settings["confidence"]),
                title=settings["title"],
                notes=tuple(settings["notes"]),
                provenance=Provenance(settings["provenance"]),
                index_totals=tuple(_made(Total, one) for one in by_kind.get("index total", [])),
                filter=tuple(_made(FilterState, one) for one in by_kind.get("filter state", [])),
                document=settings.get("document", {}),
                configuration=settings.get("configuration", {}),
            )


def _table(records: Sequence[Any], kind: Any) -> pd.DataFrame:
    """Records of a kind, a row each: their fields, and what is documented beside them."""
    import pandas as pd

    names = [*(f.name for f in fields(kind)), *kind.DOCUMENTED]
    rows = [[getattr(record, name) for name in names] for record in records]
    return pd.DataFrame(rows, columns=names)


def judge(
    requirements: Sequence[Requirement],
    rows: Sequence[Contributor],
    samples: Samples,
    rotations: Mapping[str, FloatArray] = MappingProxyType({}),
    at_most: Sequence[str] = (),
) -> tuple[Outcome, ...]:
    """Every requirement of one index against the total at its own confidence, in its own frame.

    Rows that are taken `at_most` do not violate it: at the least, they are nothing.
    """
    n_samples = next(iter(samples.sums.values())).shape[1]
    certain = [row for row in rows if row.name not in at_most]
    least_samples = draw(certain, n_samples) if requirements and at_most else samples
    outcomes = []
    for asked in requirements:
        of_rows = partial(
            total,
            scope=asked.scope,
            axis=asked.axis,
            interpretation=asked.interpretation,
            confidence=asked.confidence,
            rotation=rotations.get(asked.frame),
        )
        found = of_rows(rows, samples)
        if at_most:
            least = of_rows(certain, least_samples)
            bounds = (least.rule_least_arcsec, least.sampled_least_arcsec)
            if math.isnan(bounds[0]):
                bounds = (0.0, 0.0)
            found = replace(found, rule_least_arcsec=bounds[0], sampled_least_arcsec=bounds[1])
        found = replace(found, of_index=asked.limited.label, at_most=tuple(at_most))
        outcomes.append(Outcome(asked, found))
    return tuple(outcomes)


def by_contributor(rows: Sequence[Contributor]) -> dict[str, dict[str, Contributor]]:
    """Rows by name, then by axis, in the order of the budget."""
    found: dict[str, dict[str, Contributor]] = {}
    for row in rows:
        found.setdefault(row.name, {})[row.axis] = row
    order = {axis: index for index, axis in enumerate(AXES)}
    return {
        name: dict(sorted(axes.items(), key=lambda item: order[item[0]]))
        for name, axes in found.items()
    }


_SEPARATOR = " | "

_READERS: dict[str, Callable[[str], Any]] = {
    "float": float,
    "bool": {"True": True, "False": False}.__getitem__,
    "str": str,
    "tuple[str, ...]": lambda text: tuple(text.split(_SEPARATOR)) if text else (),
    # Earlier versions wrote them without brackets.
    "tuple[float, ...]": lambda text: tuple(
        float(value) for value in re.findall(r"[^][,|\s]+", text)
    ),
    "Finding | None": lambda text: read_difference(json.loads(text)) if text else None,
}

_DERIVED = ("combination", "margin_arcsec", "verdict")

# Columns of a total that readers look for.
_TOTAL = (*(f.name for f in fields(Total) if f.name != "difference"), "explanation")
_COLUMNS = tuple(
    dict.fromkeys(
        [
            "record",
            *(f.name for kind in (Contributor, Requirement) for f in fields(kind)),
            *_TOTAL,
            "difference",
            *_DERIVED,
            "value",
            *(f.name for f in fields(FilterState)),
        ]
    )
)


def _plain(entry: Contributor | Total | Requirement | FilterState) -> dict[str, str]:
    names = [f.name for f in fields(entry)]
    names += ["explanation"] if isinstance(entry, Total) else []
    return {name: _text(getattr(entry, name)) for name in names}


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        # Numbers in brackets: a minus in front of a cell would be that of a formula.
        texts = all(isinstance(entry, str) for entry in value)
        return _SEPARATOR.join(value) if texts else json.dumps(value)
    if isinstance(value, Finding):
        return to_json(value)
    if value is None:
        return ""
    return repr(float(value)) if isinstance(value, float) else str(value)


def _made(kind: Any, record: Mapping[str, str]) -> Any:
    # Files of earlier versions lack columns, for which the defaults stand.
    return kind(
        **{
            f.name: _READERS[str(f.type)](record[f.name])
            for f in fields(kind)
            if record.get(f.name) is not None
        }
    )
