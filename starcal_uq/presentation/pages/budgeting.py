"""The budget for people: Excel, LaTeX, HTML, and PDF to sign."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from starcal_uq.budgeting.result import Budget
from starcal_uq.budgeting.rows import AXIS_LABELS, SCOPES, confidence_text
from starcal_uq.core.constants import AXES
from starcal_uq.core.errors import BudgetError
from starcal_uq.core.extras import extra
from starcal_uq.core.files import atomic_path, atomic_write_bytes, atomic_write_text, cell_text
from starcal_uq.core.formatting import join_words
from starcal_uq.core.status import Level
from starcal_uq.core.types import AnyDict, PathLike
from starcal_uq.presentation.figures.budgeting import plot_budget
from starcal_uq.presentation.figures.style import svg_bytes
from starcal_uq.presentation.html import page, template_environment
from starcal_uq.presentation.pages.printing import pdf_bytes
from starcal_uq.presentation.tables import tex
from starcal_uq.presentation.words.budgeting import tables
from starcal_uq.presentation.words.numbers import NOT_RESOLVED
from starcal_uq.presentation.words.sentences import told
from starcal_uq.propagation.attitude_error import NOT_ASSESSED

if TYPE_CHECKING:
    import pandas as pd
    from openpyxl import Workbook
    from openpyxl.worksheet.worksheet import Worksheet

# Heads of columns that have another name than their field.
_HEADS = {
    "ecss_class": "ECSS class",
    "interpretation": "random over",
    "tail_997": "99.7 % half-width [sigma]",
    "factor": "factor n [sigma]",
    "rule_arcsec": "bound by the rule_arcsec",
    "sampled_arcsec": "bound by sampling_arcsec",
    "rule_least_arcsec": "rule at the least_arcsec",
    "sampled_least_arcsec": "sampling at the least_arcsec",
    "sampled_se_arcsec": "standard error of sampling_arcsec",
    "explanation": "rule against sampling",
    "of_index": "error index",
    "at_most": "taken at most",
}
_RED, _AMBER, _GREEN, _GROUND = "FFFDE6DB", "FFFDF1D6", "FFE3F4EE", "FFDFE4E9"


def write_tex(budget: Budget, path: PathLike) -> None:
    """A document that compiles by itself, with booktabs tables to take out."""
    environment = template_environment().overlay(
        block_start_string="<%",
        block_end_string="%>",
        variable_start_string="<<",
        variable_end_string=">>",
        comment_start_string="<#",
        comment_end_string="#>",
        autoescape=False,
        finalize=tex,
    )
    template = environment.get_template("budget.tex.j2")
    text = template.render(created=budget.provenance.created_utc, **tables(budget))
    atomic_write_text(path, text + "\n")


def section_html(budget: Budget) -> str:
    """The section of the report by itself, without a page around it."""
    template = template_environment().get_template("budget_section.html.j2")
    return template.render(budget=tables(budget), images=_images(budget))


def write_html(budget: Budget, path: PathLike) -> None:
    """A page that needs no network and no other file."""
    text = page(
        "budget.html.j2",
        budget.provenance,
        budget=tables(budget),
        images=_images(budget),
        data_sha256=budget.provenance.data_sha256 or "",
    )
    atomic_write_text(path, text)


def write_pdf(budget: Budget, path: PathLike) -> None:
    """The budget to sign; MissingExtraError without a browser or WeasyPrint."""
    with TemporaryDirectory() as folder:
        sheet = Path(folder, "budget.html")
        sheet.write_text(sheet_html(budget), encoding="utf-8")
        content = pdf_bytes(sheet)
    atomic_write_bytes(path, content)


def sheet_html(budget: Budget) -> str:
    """The page that is printed to be signed, A4: title block, requirements (violated ones first),
    configuration, rows by class, totals, assumptions and signatures.
    """
    known = tables(budget)
    document, made = budget.document, budget.provenance
    by_class: dict[str, list[AnyDict]] = {}
    for row in known["rows"]:
        by_class.setdefault(row["ecss_class"], []).append(row)
    sigma = {row["name"]: row["sigma"] for row in known["classes"]}
    # Violated, open, met.
    ranked = sorted(known["requirements"], key=lambda row: -Level(row["level"]).rank)
    return page(
        "budget_sheet.html.j2",
        made,
        budget=known,
        document=document,
        configuration=budget.configuration,
        requirements=ranked,
        classes=[
            (name, by_class[name])
            for name in dict.fromkeys((*sigma, *by_class))
            if name in by_class
        ],
        sigma=sigma,
        foot=", ".join(filter(None, (document.get("number"), document.get("issue"), budget.title))),
        seed=made.seed,
        file=made.settings.get("file", ""),
        data_sha256=made.data_sha256 or "",
    )


def write_xlsx(budget: Budget, path: PathLike) -> None:
    """A workbook with the sheets Contributors, Totals, Live totals, Requirements and Filter (if there
    are any) and Notes; numbers are numbers. The rule of the live totals is formulas over the contributors.
    """
    with extra("excel", "Excel workbooks", "write .csv or .html"):
        from openpyxl import Workbook
    import pandas as pd

    book = Workbook()
    book.remove(book.active)
    contributors = _contributors(budget)
    marks = [not row.assessed or row.inflated for row in budget.rows]
    _sheet(book, "Contributors", contributors, [_AMBER if mark else "" for mark in marks])
    totals = _totals(budget)
    _sheet(book, "Totals", totals, [_AMBER if mark else "" for mark in totals["at_least"]])
    _live_totals(book, budget, list(contributors))
    if budget.outcomes:
        requirements = budget.requirements_dataframe()
        requirements["in_words"] = [told("outcome", outcome) for outcome in budget.outcomes]
        colours = {Level.FAIL: _RED, Level.WARN: _AMBER, Level.PASS: _GREEN}
        outcomes = [colours[outcome.level] for outcome in budget.outcomes]
        _sheet(book, "Requirements", requirements, outcomes)
    if budget.filter:
        states = budget.filter_dataframe()
        states["contributors"] = states["contributors"].map(join_words)
        _sheet(book, "Filter", states)
    created = budget.provenance.created_utc
    lines = [budget.title, created, told("budget", budget), *tables(budget)["explanations"]]
    notes = pd.DataFrame({"notes": [line for line in (*lines, *budget.notes) if line]})
    _sheet(book, "Notes", notes)
    with atomic_path(path) as temporary:
        book.save(temporary)


def _contributors(budget: Budget) -> pd.DataFrame:
    table = budget.to_dataframe().drop(columns=["axis_correlation"]).astype(object)
    untested = table["with_misfit_found_arcsec"].isna() & table["if_model_holds_arcsec"].notna()
    table.loc[untested, "with_misfit_found_arcsec"] = NOT_ASSESSED
    unknown = [not row.assessed for row in budget.rows]
    table.loc[unknown, ["mean_arcsec", "sigma_arcsec"]] = NOT_ASSESSED
    gaussian = [row.assessed and row.distribution == "gaussian" for row in budget.rows]
    table["tail_997"] = table["tail_997"].where(gaussian)
    return table


def _totals(budget: Budget) -> pd.DataFrame:
    table = budget.totals_dataframe().astype(object)
    names = ["mean_arcsec", "sigma_arcsec", "rule_arcsec", "sampled_arcsec"]
    every = (*budget.totals, *budget.index_totals)
    words = [NOT_RESOLVED if row.unresolved else NOT_ASSESSED for row in every]
    for name in names:
        table[name] = table[name].where(table[name].notna(), words)
    return table


def _live_totals(book: Workbook, budget: Budget, columns: Sequence[str]) -> None:
    """A sheet that repeats the rule for each axis in the mixed interpretation: what is changed on
    the sheet Contributors changes it.
    """
    import pandas as pd
    from openpyxl.utils import get_column_letter

    letters = {name: get_column_letter(n) for n, name in enumerate(columns, start=1)}
    first = len(SCOPES) * len(AXES) + 4
    last = first + len(budget.rows) - 1
    totals: list[tuple[str, ...]] = []
    rows: list[tuple[str | int, ...]] = []
    for scope, flag in zip(SCOPES, "FG", strict=True):
        for axis in AXES:
            at = len(totals) + 2
            axes, counts, means, sigmas, together = (
                f"${c}${first}:${c}${last}" for c in ("B", flag, "C", "E", chr(ord(flag) + 2))
            )
            where = f'({axes}="{AXIS_LABELS[axis]}")*{counts}'
            totals.append(
                (
                    *(scope, AXIS_LABELS[axis]),
                    f"=SUMPRODUCT({where},{means})",
                    f"=SQRT(SUMPRODUCT({where},{sigmas},{together}))",
                    f"=NORMSINV((1+{budget.confidence!r})/2)",
                    f"=ABS(C{at})+E{at}*D{at}",
                )
            )
    for number, row in enumerate(budget.rows):
        group, sign = row.group
        at, source = first + number, f"Contributors!{{}}{number + 2}"
        key = _cell(f"group: {group}" if group else row.name)
        of_axis = f"B${first}:B${last},B{at},D${first}:D${last},D{at}"
        rows.append(
            (
                *(_cell(row.name), AXIS_LABELS[row.axis]),
                *(f"=N({source.format(letters['mean_arcsec'])})", key),
                f"={sign:+.0f}*N({source.format(letters['sigma_arcsec'])})",
                *(int(row.counts(scope) and row.applies) for scope in SCOPES),
                *(f"=SUMIFS(E${first}:E${last},{of_axis},{c}${first}:{c}${last},1)" for c in "FG"),
            )
        )
    heads = ("scope", "axis", "mean_arcsec", "sigma_arcsec", "factor", "rule_arcsec")
    sheet = _sheet(book, "Live totals", pd.DataFrame(totals, columns=heads))
    for number, formulas in enumerate(totals, start=2):
        for cell, formula in zip(sheet[number], formulas, strict=True):
            cell.value, cell.number_format = formula, "0.0000"
    sheet.append([])
    sums = (f"signed sigma of all that err together, {scope}" for scope in SCOPES)
    sheet.append(["contributor", "axis", "mean", "errs with", "signed sigma", *SCOPES, *sums])
    for cells in rows:
        sheet.append(cells)


def _head(name: str) -> str:
    """The head of a column, with its unit."""
    text = _HEADS.get(name, name).replace("_arcsec", " [arcsec]").replace("_", " ")
    return text[0].upper() + text[1:]


def _sheet(
    book: Workbook, title: str, table: pd.DataFrame, colours: Sequence[str] = ()
) -> Worksheet:
    """A sheet with a frozen header, a filter, widths, and coloured rows; NaN is an empty cell."""
    from openpyxl.styles import Alignment, Border, Font, PatternFill, Side
    from openpyxl.utils import get_column_letter

    sheet = book.create_sheet(title)
    sheet.append([_head(name) for name in table])
    for row in table.itertuples(index=False, name=None):
        sheet.append([None if value != value else _cell(value) for value in row])
    line = Border(bottom=Side(style="thin", color="FFB8C1CA"))
    for number, name in enumerate(table, start=1):
        letter = get_column_letter(number)
        texts = [str(value) for value in table[name] if isinstance(value, str)]
        sheet.column_dimensions[letter].width = min(60, 4 + max(map(len, ["0" * 10, *texts])))
        head, *cells = sheet[letter]
        head.font, head.fill = Font(bold=True), PatternFill("solid", fgColor=_GROUND)
        head.alignment, head.border = Alignment(wrap_text=True), line
        for cell, colour in zip(cells, colours or [""] * len(cells), strict=True):
            text = isinstance(cell.value, str)
            cell.alignment, cell.border = Alignment(wrap_text=text, vertical="top"), line
            if colour:
                cell.fill = PatternFill("solid", fgColor=colour)
            if isinstance(cell.value, float):
                form = _share_format if name == "confidence" else _format
                cell.number_format = form(cell.value)
    sheet.freeze_panes = "B2" if len(table.columns) > 1 else "A2"
    if len(table) and len(table.columns) > 1:
        sheet.auto_filter.ref = sheet.dimensions
    sheet.page_setup.orientation = "landscape"
    sheet.page_setup.fitToHeight = 0
    sheet.sheet_properties.pageSetUpPr.fitToPage = True
    sheet.print_title_rows = "1:1"
    return sheet


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
    """Three digits or so, whatever the size."""
    size = abs(value)
    if size == 0.0:
        return "0"
    if size < 0.01:
        return "0.00E+00"
    return "0.0" if size >= 100.0 else "0.00" if size >= 1.0 else "0.0000"


_WRITERS: dict[str, Callable[[Budget, PathLike], None]] = {
    ".csv": Budget.save,
    ".xlsx": write_xlsx,
    ".tex": write_tex,
    ".html": write_html,
    ".pdf": write_pdf,
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


def _images(budget: Budget) -> dict[str, bytes]:
    return {"budget": svg_bytes(plot_budget(budget))}
