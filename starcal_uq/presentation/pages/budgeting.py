"""The budget for people: Excel, LaTeX and HTML."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from starcal_uq.budgeting.result import Budget, Outcome, by_contributor
from starcal_uq.budgeting.rows import AXIS_LABELS, SCOPES, Contributor, confidence_text
from starcal_uq.budgeting.totals import Total
from starcal_uq.core.constants import AXES, TOTAL_AXES
from starcal_uq.core.files import atomic_path, atomic_write_text
from starcal_uq.core.formatting import decimals_for, fixed, join_words, plural, significant
from starcal_uq.presentation.html import embedded_image, template_environment
from starcal_uq.presentation.tables import tex

if TYPE_CHECKING:
    from openpyxl.worksheet.worksheet import Worksheet

_RED, _AMBER, _GREEN, _HEAD = "FFFDE6DB", "FFFDF1D6", "FFE3F4EE", "FFDFE4E9"


def write_tex(budget: Budget, path: str | os.PathLike[str]) -> None:
    """A document that compiles by itself, with booktabs tables to take out."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("starcal_uq.presentation"),
        block_start_string="<%",
        block_end_string="%>",
        variable_start_string="<<",
        variable_end_string=">>",
        comment_start_string="<#",
        comment_end_string="#>",
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=tex,
        undefined=jinja2.StrictUndefined,
    )
    created = budget.provenance.get("created_utc", "")
    text = environment.get_template("budget.tex.j2").render(created=created, **tables(budget))
    atomic_write_text(path, text + "\n")


def section_html(budget: Budget) -> str:
    """The section of the report by itself, without a page around it."""
    template = template_environment().get_template("budget_section.html.j2")
    return template.render(**budget_context(budget))


def write_html(budget: Budget, path: str | os.PathLike[str]) -> None:
    """A page that needs no network and no other file."""
    provenance = budget.provenance
    text = (
        template_environment()
        .get_template("budget.html.j2")
        .render(
            **budget_context(budget),
            created=provenance.get("created_utc", ""),
            version=provenance.get("versions", {}).get("starcal_uq") or "",
            data_sha256=provenance.get("data_sha256") or "",
        )
    )
    atomic_write_text(path, text + "\n")


def write_xlsx(budget: Budget, path: str | os.PathLike[str]) -> None:
    """A workbook with the sheets Contributors, Totals, Requirements (if any) and Notes; numbers are numbers."""
    from openpyxl import Workbook

    book = Workbook()
    sheet = book.active
    sheet.title = "Contributors"
    _contributors(sheet, budget)
    _totals(book.create_sheet("Totals"), budget)
    if budget.outcomes:
        _requirements(book.create_sheet("Requirements"), budget)
    notes = book.create_sheet("Notes")
    created = str(budget.provenance.get("created_utc", ""))
    lines = [budget.title, created, headline(budget), *tables(budget)["explanations"], *budget.notes]
    _table(notes, ["Notes"], [[line] for line in lines if line], [110])
    with atomic_path(path) as temporary:
        book.save(temporary)


def _contributors(sheet: Worksheet, budget: Budget) -> None:
    header = [
        *("Contributor", "ECSS class", "Axis", "Mean [arcsec]", "Sigma [arcsec]", "Sigma before inflation [arcsec]"),
        *("Distribution", "99.7 % half-width [sigma]", "In time", "Random over", "Correlation group", "Combination"),
        *("Absorbed by alignment", "Conditions", "Provenance", "Source"),
    ]
    rows, colours = [], []
    for row in budget.rows:
        mean, sigma = (row.mean_arcsec, row.sigma_arcsec) if row.assessed else (NOT_ASSESSED, NOT_ASSESSED)
        gaussian = row.assessed and row.applies and row.distribution == "gaussian"
        rows.append(
            [
                *(row.name, row.ecss_class, AXIS_LABELS[row.axis], mean, sigma, row.raw_sigma_arcsec),
                *(row.distribution if row.applies else "does not apply", row.tail_997 if gaussian else None),
                *(row.time_class, row.interpretation, row.correlation_group, row.combination),
                *(row.absorbed_by_alignment, row.conditions, row.provenance, row.source),
            ]
        )
        colours.append("" if row.assessed and not row.inflated else _AMBER)
    _table(sheet, header, rows, [34, 20, 11, 13, 13, 17, 15, 16, 15, 13, 16, 24, 15, 50, 40, 13], colours)


def _totals(sheet: Worksheet, budget: Budget) -> None:
    header = [
        *("Scope", "Axis", "Random over", "Confidence", "Mean [arcsec]", "Sigma [arcsec]", "Factor n [sigma]"),
        *("Worst case added [arcsec]", "Bound by the rule [arcsec]", "Bound by sampling [arcsec]"),
        *("Standard error of sampling [arcsec]", "Reads", "Dominant", "Not assessed", "Rule against sampling"),
    ]
    rows = [
        [
            *(entry.scope, AXIS_LABELS[entry.axis], entry.interpretation, entry.confidence),
            *(_numbers(entry)[:2]),
            *(entry.factor, entry.worst_arcsec, *_numbers(entry)[2:], entry.sampled_se_arcsec),
            *("at least" if entry.at_least else "total", entry.dominant, "; ".join(entry.not_assessed)),
            entry.explanation,
        ]
        for entry in budget.totals
    ]
    colours = [_AMBER if entry.at_least else "" for entry in budget.totals]
    _table(sheet, header, rows, [17, 17, 13, 12, 13, 13, 11, 14, 14, 14, 16, 10, 30, 55, 60], colours)


def _numbers(entry: Total) -> list[Any]:
    values = (entry.mean_arcsec, entry.sigma_arcsec, entry.rule_arcsec, entry.sampled_arcsec)
    missing = NOT_RESOLVED if entry.unresolved else NOT_ASSESSED
    return [missing if math.isnan(value) else value for value in values]


def _requirements(sheet: Worksheet, budget: Budget) -> None:
    header = [
        *("Requirement", "Axis", "Scope", "Random over", "Confidence", "Limit [arcsec]", "Bound by the rule [arcsec]"),
        *("Bound by sampling [arcsec]", "Judged by", "Margin [arcsec]", "Outcome", "In words"),
    ]
    rows = []
    for outcome in budget.outcomes:
        asked = outcome.requirement
        rows.append(
            [
                *(asked.name, AXIS_LABELS[asked.axis], asked.scope, asked.interpretation, asked.confidence),
                *(asked.limit_arcsec, *_numbers(outcome.total)[2:], asked.judged_by, outcome.margin_arcsec),
                *(outcome.verdict, outcome.sentence),
            ]
        )
    colours = [{"violated": _RED, "open": _AMBER, "met": _GREEN}[outcome.verdict] for outcome in budget.outcomes]
    _table(sheet, header, rows, [34, 17, 17, 13, 12, 12, 14, 14, 12, 12, 12, 70], colours)


def _table(
    sheet: Worksheet,
    header: Sequence[str],
    rows: Sequence[Sequence[Any]],
    widths: Sequence[float],
    colours: Sequence[str] = (),
) -> None:
    """A table with a frozen header, a filter, widths, and coloured rows; NaN is an empty cell."""
    from openpyxl.styles import Alignment, Border, Font, PatternFill, Side
    from openpyxl.utils import get_column_letter

    sheet.append(list(header))
    for row in rows:
        sheet.append([None if isinstance(value, float) and math.isnan(value) else _cell(value) for value in row])
    line = Side(style="thin", color="FFB8C1CA")
    for cells in sheet.iter_rows():
        for cell in cells:
            head = cell.row == 1
            text = isinstance(cell.value, str)
            cell.alignment = Alignment(wrap_text=text, vertical="bottom" if head else "top")
            cell.border = Border(bottom=line)
            if head:
                cell.font, cell.fill = Font(bold=True), PatternFill("solid", fgColor=_HEAD)
                continue
            colour = colours[cell.row - 2] if colours else ""
            if colour:
                cell.fill = PatternFill("solid", fgColor=colour)
            if not text and cell.value is not None:
                share = header[cell.column - 1] == "Confidence"
                cell.number_format = _share_format(cell.value) if share else _format(cell.value)
    for index, width in enumerate(widths, start=1):
        sheet.column_dimensions[get_column_letter(index)].width = width
    sheet.freeze_panes = "B2" if len(header) > 1 else "A2"
    if rows and len(header) > 1:
        sheet.auto_filter.ref = sheet.dimensions
    sheet.page_setup.orientation = "landscape"
    sheet.page_setup.fitToHeight = 0
    sheet.sheet_properties.pageSetUpPr.fitToPage = True
    sheet.print_title_rows = "1:1"


def _cell(value: Any) -> Any:
    # A name that begins like a formula is text, not a formula.
    return f"'{value}" if isinstance(value, str) and value[:1] in "=+@" and value else value


def _share_format(value: float) -> str:
    """Per cent with as many decimals as the confidence has."""
    decimals = len(confidence_text(value).partition(".")[2].removesuffix("\N{NO-BREAK SPACE}%"))
    return f"0.{'0' * max(decimals, 1)}%"


def _format(value: float) -> str:
    size = abs(value)
    if size == 0.0:
        return "0"
    return "0.0" if size >= 100.0 else "0.00" if size >= 1.0 else "0.0000" if size >= 0.01 else "0.00E+00"


WRITERS: dict[str, Callable[[Budget, str | os.PathLike[str]], None]] = {
    ".xlsx": write_xlsx,
    ".tex": write_tex,
    ".html": write_html,
}


Row = dict[str, Any]


NOT_ASSESSED = "not assessed"


NOT_RESOLVED = "not resolved"


# Above what rounding makes of 2.968.
_GAUSSIAN_TAIL = 2.98


_MIXED, *_OTHERS = ("mixed", "ensemble", "temporal")


_MEANING = {
    "mixed": "a sensor and a moment at random",
    "ensemble": "a sensor at random, at its worst moment",
    "temporal": "the worst sensor, at a moment at random",
}


def budget_context(budget: Budget | None) -> dict[str, Any]:
    """What the template ``budget_section.html.j2`` shows, under the one name ``budget``; None where there is none."""
    if budget is None:
        return {"budget": None}
    from starcal_uq.presentation.figures.budgeting import plot_budget
    from starcal_uq.presentation.figures.style import png_bytes

    return {"budget": {**tables(budget), "image": embedded_image(png_bytes(plot_budget(budget)))}}


def tables(budget: Budget) -> dict[str, Any]:
    """All rows and sentences."""
    return {
        "title": budget.title,
        "confidence": confidence_text(budget.confidence),
        "rows": contributor_rows(budget),
        "has_means": any(row.assessed and row.mean_arcsec != 0.0 for row in budget.rows),
        "totals": total_rows(budget),
        "interpretations": [{"name": name, "meaning": text} for name, text in _MEANING.items()],
        "requirements": [_requirement_row(outcome) for outcome in budget.outcomes],
        "headline": headline(budget),
        "not_drawn": len(budget.outcomes) - len(budget.comparable),
        "violated": bool(budget.violations),
        "open": bool(budget.not_assessed or budget.open_requirements),
        "explanations": explanations(budget),
        "notes": list(budget.notes),
        "factors": factor_sentence(budget),
    }


def headline(budget: Budget) -> str:
    """The budget in one or two sentences."""
    parts = []
    if budget.violations:
        names = join_words([repr(outcome.requirement.name) for outcome in budget.violations])
        verb = "requirement is" if len(budget.violations) == 1 else "requirements are"
        parts.append(f"{len(budget.violations)} {verb} violated: {names}.")
    met = [outcome for outcome in budget.outcomes if outcome.verdict == "met"]
    if met:
        parts.append(f"{plural(len(met), 'requirement')} met.")
    unresolved = [outcome for outcome in budget.open_requirements if outcome.unresolved]
    missing = len(budget.open_requirements) - len(unresolved)
    if missing:
        parts.append(f"{plural(missing, 'requirement')} open: contributors are missing.")
    if unresolved:
        parts.append(f"{plural(len(unresolved), 'requirement')} open: the samples do not resolve so high a confidence.")
    if budget.not_assessed:
        every = len(by_contributor(budget.rows))
        parts.append(
            f"{len(budget.not_assessed)} of {every} contributors are not assessed on one axis or more, so the totals "
            "read “at least”."
        )
    elif not budget.outcomes:
        parts.append("Every contributor is assessed; no requirement was given.")
    return " ".join(parts)


def contributor_rows(budget: Budget) -> list[Row]:
    """One row per contributor, its three axes side by side; what differs between axes is listed."""
    return [_contributor_row(name, axes) for name, axes in by_contributor(budget.rows).items()]


def _contributor_row(name: str, axes: dict[str, Contributor]) -> Row:
    stated = [row for row in axes.values() if row.assessed]
    first = next(iter(axes.values()))
    every = stated or [first]

    def listed(values: list[str]) -> str:
        return " / ".join(dict.fromkeys(value for value in values if value))

    return {
        "name": name,
        "ecss_class": listed([row.ecss_class for row in every]),
        "sigma": [_sigma(axes.get(axis)) for axis in AXES],
        "mean": _means(axes),
        "missing": [axis in axes and not axes[axis].assessed for axis in AXES],
        "distribution": " / ".join(
            dict.fromkeys(row.distribution if row.applies else "does not apply" for row in stated)
        ),
        "tail": _tails(stated),
        "time_class": listed([row.time_class for row in every]),
        "interpretation": listed([row.interpretation for row in every]),
        "absorbed": listed([row.absorbed_by_alignment for row in every]),
        "combination": listed([row.combination for row in every]),
        "group": listed([row.correlation_group for row in every]),
        "conditions": listed([row.conditions for row in every]),
        "provenance": listed([row.provenance for row in stated]),
        "source": listed([row.source for row in axes.values()]),
        "inflated": any(row.inflated for row in stated),
        "assessed": bool(stated),
    }


def _sigma(row: Contributor | None) -> str:
    if row is None:
        return "–"
    if not row.assessed:
        return NOT_ASSESSED
    return significant(row.sigma_arcsec, 3) if row.applies else "n/a"


def _means(axes: dict[str, Contributor]) -> str:
    """Means of the three axes, or one 0 for all."""
    values = [axes[axis].mean_arcsec if axis in axes and axes[axis].assessed else None for axis in AXES]
    if not any(values):
        return "0" if any(value is not None for value in values) else ""
    return ", ".join("–" if value is None else significant(value, 3) for value in values)


def _tails(rows: list[Contributor]) -> str:
    """The range of the tails where sigma changes from frame to frame."""
    tails = [row.tail_997 for row in rows if row.distribution == "gaussian" and row.tail_997 > _GAUSSIAN_TAIL]
    if not tails:
        return ""
    ends = " to ".join(dict.fromkeys(significant(tail, 3) for tail in (min(tails), max(tails))))
    return f"sigma varies by frame: 99.7 % within {ends} σ"


def bound(value: float, at_least: bool, digits: int = 3) -> str:
    """A bound in arcsec, with "≥" while contributors are missing."""
    if math.isnan(value):
        return NOT_ASSESSED
    return ("≥ " if at_least else "") + significant(value, digits)


def total_rows(budget: Budget) -> list[Row]:
    """One row per scope and axis: mean, sigma, factor and the bounds of all interpretations."""
    rows = []
    for scope in SCOPES:
        for axis in TOTAL_AXES:
            mixed = budget.total(axis, scope)
            rows.append(
                {
                    "scope": scope,
                    "axis": AXIS_LABELS[axis],
                    "mean": "–" if math.isnan(mixed.mean_arcsec) else significant(mixed.mean_arcsec, 3),
                    "sigma": bound(mixed.sigma_arcsec, mixed.at_least),
                    "factor": "–" if math.isnan(mixed.factor) else fixed(mixed.factor, 3),
                    "rule": bound(mixed.rule_arcsec, mixed.at_least),
                    "sampled": _sampled(mixed),
                    "others": [_pair(budget.total(axis, scope, kind)) for kind in _OTHERS],
                    "dominant": mixed.dominant or "–",
                }
            )
    return rows


def _sampled(total: Total) -> str:
    if total.unresolved:
        return NOT_RESOLVED
    if math.isnan(total.sampled_arcsec):
        return NOT_ASSESSED
    digits = max(decimals_for(total.sampled_se_arcsec, 1), decimals_for(total.sampled_arcsec, 2))
    digits = min(digits, decimals_for(total.sampled_arcsec, 3))
    return ("≥ " if total.at_least else "") + fixed(total.sampled_arcsec, digits)


def _pair(total: Total) -> dict[str, str]:
    return {"rule": bound(total.rule_arcsec, total.at_least), "sampled": _sampled(total)}


def _requirement_row(outcome: Outcome) -> Row:
    asked = outcome.requirement
    return {
        "name": asked.name,
        "axis": AXIS_LABELS[asked.axis],
        "scope": asked.scope,
        "interpretation": asked.interpretation,
        "confidence": confidence_text(asked.confidence),
        "limit": significant(asked.limit_arcsec, 3),
        "rule": bound(outcome.total.rule_arcsec, outcome.total.at_least),
        "sampled": _sampled(outcome.total),
        "margin": "–" if math.isnan(outcome.margin_arcsec) else significant(outcome.margin_arcsec, 3),
        "judged_by": {"both": "the larger"}.get(asked.judged_by, asked.judged_by),
        "verdict": outcome.verdict,
        "level": {"violated": "fail", "open": "warning", "met": "pass"}[outcome.verdict],
        "sentence": outcome.sentence,
    }


def explanations(budget: Budget) -> list[str]:
    """Why rule and sampling differ, one line per distinct reason, for the mixed interpretation."""
    found: dict[str, list[str]] = {}
    for entry in budget.totals:
        if entry.interpretation == _MIXED and entry.explanation:
            found.setdefault(entry.explanation, []).append(f"{AXIS_LABELS[entry.axis]}, {entry.scope}")
    every = len(SCOPES) * len(TOTAL_AXES)
    return [f"{'All totals' if len(where) == every else '; '.join(where)}: {text}" for text, where in found.items()]


def factor_sentence(budget: Budget) -> str:
    """Which quantiles the rule took."""
    from starcal_uq.budgeting.shapes import one_axis_factor, two_axis_radius

    level = budget.confidence
    return (
        f"At {confidence_text(level)} a Gaussian error stays within {fixed(one_axis_factor(level), 3)} sigma on one "
        f"axis, but the angle of two equal axes within {fixed(two_axis_radius(level, 1.0, 1.0), 3)} sigma per axis; "
        "for unequal ones the factor refers to the root mean square of both."
    )
