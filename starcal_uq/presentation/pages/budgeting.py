"""The budget for people: Excel, LaTeX and HTML."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcal_uq.budgeting.result import Budget
from starcal_uq.budgeting.rows import AXIS_LABELS, Contributor, confidence_text
from starcal_uq.budgeting.totals import Total
from starcal_uq.core.errors import BudgetError
from starcal_uq.core.extras import extra
from starcal_uq.core.files import atomic_path, atomic_write_text, cell_text
from starcal_uq.core.status import Level
from starcal_uq.core.types import AnyDict, PathLike
from starcal_uq.presentation.figures.budgeting import plot_budget
from starcal_uq.presentation.figures.style import svg_bytes
from starcal_uq.presentation.html import template_environment
from starcal_uq.presentation.sentences.budgeting import NOT_RESOLVED, axis_label, outcome_text
from starcal_uq.presentation.tables import tex
from starcal_uq.presentation.words.budgeting import headline, tables
from starcal_uq.propagation.attitude_error import IF_MODEL_HOLDS, NOT_ASSESSED, WITH_MISFIT_FOUND

if TYPE_CHECKING:
    from openpyxl.worksheet.worksheet import Worksheet

_RED, _AMBER, _GREEN, _HEAD = "FFFDE6DB", "FFFDF1D6", "FFE3F4EE", "FFDFE4E9"


def write_tex(budget: Budget, path: PathLike) -> None:
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
    template = environment.get_template("budget.tex.j2")
    text = template.render(created=budget.provenance.created_utc, **tables(budget))
    atomic_write_text(path, text + "\n")


def section_html(budget: Budget) -> str:
    """The section of the report by itself, without a page around it."""
    template = template_environment().get_template("budget_section.html.j2")
    return template.render(**budget_context(budget), images=_images(budget))


def write_html(budget: Budget, path: PathLike) -> None:
    """A page that needs no network and no other file."""
    provenance = budget.provenance
    text = (
        template_environment()
        .get_template("budget.html.j2")
        .render(
            **budget_context(budget),
            images=_images(budget),
            created=provenance.created_utc,
            version=provenance.version,
            data_sha256=provenance.data_sha256 or "",
        )
    )
    atomic_write_text(path, text + "\n")


def write_xlsx(budget: Budget, path: PathLike) -> None:
    """A workbook with the sheets Contributors, Totals, Requirements (if any) and Notes; numbers are
    numbers.
    """
    with extra("excel", "Excel workbooks", "write .csv or .html"):
        from openpyxl import Workbook

    book = Workbook()
    sheet = book.active
    sheet.title = "Contributors"
    _contributors(sheet, budget)
    _totals(book.create_sheet("Totals"), budget)
    if budget.outcomes:
        _requirements(book.create_sheet("Requirements"), budget)
    notes = book.create_sheet("Notes")
    created = budget.provenance.created_utc
    lines = [
        budget.title,
        created,
        headline(budget),
        *tables(budget)["explanations"],
        *budget.notes,
    ]
    _table(notes, ["Notes"], [[line] for line in lines if line], [110])
    with atomic_path(path) as temporary:
        book.save(temporary)


def _contributors(sheet: Worksheet, budget: Budget) -> None:
    header = [
        *("Contributor", "ECSS class", "Axis", "Mean [arcsec]", "Sigma [arcsec]"),
        *(f"{name[0].upper()}{name[1:]} [arcsec]" for name in (WITH_MISFIT_FOUND, IF_MODEL_HOLDS)),
        *(
            "Distribution",
            "99.7 % half-width [sigma]",
            "Random over",
            "Correlation group",
            "Combination",
        ),
        *("Absorbed by alignment", "Conditions", "Provenance", "Source"),
    ]
    rows, colours = [], []
    for row in budget.rows:
        mean, sigma = (
            (row.mean_arcsec, row.sigma_arcsec) if row.assessed else (NOT_ASSESSED, NOT_ASSESSED)
        )
        gaussian = row.assessed and row.applies and row.distribution == "gaussian"
        rows.append(
            [
                *(row.name, row.ecss_class, AXIS_LABELS[row.axis], mean, sigma),
                *(_with_misfit(row), row.if_model_holds_arcsec),
                *(
                    row.distribution if row.applies else "does not apply",
                    row.tail_997 if gaussian else None,
                ),
                *(row.interpretation, row.correlation_group, row.combination),
                *(row.absorbed_by_alignment, row.conditions, row.provenance, row.source),
            ]
        )
        colours.append("" if row.assessed and not row.inflated else _AMBER)
    _table(
        sheet,
        header,
        rows,
        [34, 20, 11, 13, 13, 17, 17, 15, 16, 13, 16, 24, 15, 50, 40, 13],
        colours,
    )


def _with_misfit(row: Contributor) -> float | str:
    untested = not math.isnan(row.if_model_holds_arcsec) and math.isnan(
        row.with_misfit_found_arcsec
    )
    return NOT_ASSESSED if untested else row.with_misfit_found_arcsec


def _totals(sheet: Worksheet, budget: Budget) -> None:
    header = [
        *(
            "Scope",
            "Axis",
            "Random over",
            "Confidence",
            "Mean [arcsec]",
            "Sigma [arcsec]",
            "Factor n [sigma]",
        ),
        *("Worst case added [arcsec]", "Bound by the rule [arcsec]", "Bound by sampling [arcsec]"),
        *("Rule at the least [arcsec]", "Sampling at the least [arcsec]"),
        *(
            "Standard error of sampling [arcsec]",
            "Reads",
            "Dominant",
            "Not assessed",
            "Rule against sampling",
        ),
    ]
    rows = [
        [
            *(entry.scope, AXIS_LABELS[entry.axis], entry.interpretation, entry.confidence),
            *(_numbers(entry)[:2]),
            *(entry.factor, entry.worst_arcsec, *_numbers(entry)[2:]),
            *(entry.rule_least_arcsec, entry.sampled_least_arcsec, entry.sampled_se_arcsec),
            *(
                "at least" if entry.at_least else "total",
                entry.dominant,
                "; ".join(entry.not_assessed),
            ),
            entry.explanation,
        ]
        for entry in budget.totals
    ]
    colours = [_AMBER if entry.at_least else "" for entry in budget.totals]
    _table(
        sheet,
        header,
        rows,
        [17, 17, 13, 12, 13, 13, 11, 14, 14, 14, 14, 14, 16, 10, 30, 55, 60],
        colours,
    )


def _numbers(entry: Total) -> list[Any]:
    values = (entry.mean_arcsec, entry.sigma_arcsec, entry.rule_arcsec, entry.sampled_arcsec)
    missing = NOT_RESOLVED if entry.unresolved else NOT_ASSESSED
    return [missing if math.isnan(value) else value for value in values]


def _requirements(sheet: Worksheet, budget: Budget) -> None:
    header = [
        *(
            "Requirement",
            "Axis",
            "Scope",
            "Random over",
            "Confidence",
            "Limit [arcsec]",
            "Bound by the rule [arcsec]",
        ),
        *(
            "Bound by sampling [arcsec]",
            "Judged by",
            "Bound at the least [arcsec]",
            "Margin [arcsec]",
            "Outcome",
            "In words",
        ),
    ]
    rows = []
    for outcome in budget.outcomes:
        asked = outcome.requirement
        rows.append(
            [
                *(
                    asked.name,
                    axis_label(asked),
                    asked.scope,
                    asked.interpretation,
                    asked.confidence,
                ),
                *(
                    asked.limit_arcsec,
                    *_numbers(outcome.total)[2:],
                    asked.judged_by,
                    outcome.least_arcsec,
                ),
                outcome.margin_arcsec,
                *(outcome.verdict, outcome_text(outcome)),
            ]
        )
    colours = [
        {Level.FAIL: _RED, Level.WARN: _AMBER, Level.PASS: _GREEN}[outcome.level]
        for outcome in budget.outcomes
    ]
    _table(sheet, header, rows, [34, 17, 17, 13, 12, 12, 14, 14, 12, 14, 12, 12, 70], colours)


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
        sheet.append(
            [
                None if isinstance(value, float) and math.isnan(value) else _cell(value)
                for value in row
            ]
        )
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
    from openpyxl.cell.cell import ILLEGAL_CHARACTERS_RE

    # No workbook holds control characters; a name that begins like a formula is text, not a
    # formula.
    return (
        cell_text(ILLEGAL_CHARACTERS_RE.sub("\N{REPLACEMENT CHARACTER}", value))
        if isinstance(value, str)
        else value
    )


def _share_format(value: float) -> str:
    """Per cent with as many decimals as the confidence has."""
    decimals = len(confidence_text(value).partition(".")[2].removesuffix("\N{NO-BREAK SPACE}%"))
    return f"0.{'0' * max(decimals, 1)}%"


def _format(value: float) -> str:
    size = abs(value)
    if size == 0.0:
        return "0"
    return (
        "0.0"
        if size >= 100.0
        else "0.00"
        if size >= 1.0
        else "0.0000"
        if size >= 0.01
        else "0.00E+00"
    )


_WRITERS: dict[str, Callable[[Budget, PathLike], None]] = {
    ".csv": Budget.save,
    ".xlsx": write_xlsx,
    ".tex": write_tex,
    ".html": write_html,
}
FORMATS = tuple(_WRITERS)


def write_budget(budget: Budget, path: PathLike) -> Path:
    """Write the budget, atomically; overwritten. The ending names the format.

    ``.csv`` holds everything to the last digit and is what `Budget.load` reads; the others are for
    people. BudgetError for another ending.
    """
    ending = Path(path).suffix.lower()
    if ending not in _WRITERS:
        raise BudgetError(f"{path}: the ending names the format; use one of {', '.join(FORMATS)}.")
    _WRITERS[ending](budget, path)
    return Path(path)


def budget_context(budget: Budget | None) -> AnyDict:
    """What ``budget_section.html.j2`` shows beside the figure, under the name ``budget``; None
    where there is none.
    """
    return {"budget": None if budget is None else tables(budget)}


def _images(budget: Budget) -> dict[str, bytes]:
    return {"budget": svg_bytes(plot_budget(budget))}
