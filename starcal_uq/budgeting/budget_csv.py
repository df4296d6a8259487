"""The budget in one CSV file, to the last digit: contributors, totals, requirements and settings as records."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from starcal_uq.budgeting.file import Requirement
from starcal_uq.budgeting.rows import Contributor
from starcal_uq.budgeting.totals import Total
from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.files import atomic_path

if TYPE_CHECKING:
    from starcal_uq.budgeting.result import Budget

_SEPARATOR = " | "
_READERS: dict[str, Callable[[str], Any]] = {
    "float": float,
    "bool": {"True": True, "False": False}.__getitem__,
    "str": str,
    "tuple[str, ...]": lambda text: tuple(text.split(_SEPARATOR)) if text else (),
}
_DERIVED = ("combination", "margin_arcsec", "verdict")
_COLUMNS = tuple(
    dict.fromkeys(
        ["record", *(f.name for kind in (Contributor, Requirement, Total) for f in fields(kind)), *_DERIVED, "value"]
    )
)


def write_csv(budget: Budget, path: str | os.PathLike[str]) -> None:
    """Write the file, atomically."""
    records = [{"record": "contributor", **_plain(row), "combination": row.combination} for row in budget.rows]
    records += [{"record": "total", **_plain(entry)} for entry in budget.totals]
    records += [
        {
            "record": "requirement",
            **_plain(outcome.total),
            **_plain(outcome.requirement),
            "margin_arcsec": repr(outcome.margin_arcsec),
            "verdict": outcome.verdict,
        }
        for outcome in budget.outcomes
    ]
    settings = {
        "confidence": budget.confidence,
        "title": budget.title,
        "notes": list(budget.notes),
        "provenance": budget.provenance,
    }
    records += [{"record": "setting", "name": key, "value": json.dumps(value)} for key, value in settings.items()]
    with atomic_path(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, _COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(records)


def read_csv(path: str | os.PathLike[str]) -> Budget:
    """Read the file.

    Raises
    ------
    RunFolderError
        If the file is missing or is not a budget.
    """
    from starcal_uq.budgeting.result import Budget, Outcome

    try:
        with open(path, newline="", encoding="utf-8") as file:
            records = list(csv.DictReader(file))
        by_kind: dict[str, list[dict[str, str]]] = {}
        for record in records:
            by_kind.setdefault(record["record"], []).append(record)
        settings = {record["name"]: json.loads(record["value"]) for record in by_kind["setting"]}
        return Budget(
            rows=tuple(_made(Contributor, record) for record in by_kind["contributor"]),
            totals=tuple(_made(Total, record) for record in by_kind["total"]),
            outcomes=tuple(
                Outcome(_made(Requirement, record), _made(Total, record)) for record in by_kind.get("requirement", [])
            ),
            confidence=float(settings["confidence"]),
            title=settings["title"],
            notes=tuple(settings["notes"]),
            provenance=settings["provenance"],
        )
    except OSError as error:
        raise RunFolderError(
            f"{path}: cannot be read ({error.strerror or error}); run `starcal-uq budget RUN` first."
        ) from error
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise RunFolderError(
            f"{path}: is not an error budget; run `starcal-uq budget RUN` to write it again."
        ) from error


def _plain(entry: Contributor | Total | Requirement) -> dict[str, str]:
    return {f.name: _text(getattr(entry, f.name)) for f in fields(entry)}


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        return _SEPARATOR.join(value)
    return repr(float(value)) if isinstance(value, float) else str(value)


def _made(kind: Any, record: Mapping[str, str]) -> Any:
    return kind(**{f.name: _READERS[str(f.type)](record[f.name]) for f in fields(kind)})
