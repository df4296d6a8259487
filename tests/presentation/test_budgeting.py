"""The budget to sign, as an installed browser prints it."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys

import pytest

import starcal_uq as sc
from starcal_uq.budgeting.budget import combination, from_file
from starcal_uq.budgeting.file import load_budget_file
from starcal_uq.budgeting.result import Budget
from starcal_uq.core.provenance import provenance
from starcal_uq.presentation.pages import budgeting, printing

FILE = """
[budget]
title = "Budget of a <tracker>"
[document]
number = "TN-014"
issue = "2"
prepared = "A. Analyst"
[[contributor]]
name = "alignment residual"
ecss_class = "bias"
axis = "all"
sigma_arcsec = 1.0
interpretation = "ensemble"
absorbed_by_alignment = "no"
provenance = "report"
[[requirement]]
name = "R-met"
axis = "X"
limit_arcsec = 9.0
[[requirement]]
name = "R-violated"
axis = "Y"
limit_arcsec = 2.0
"""

GROUPS = """
[[contributor]]
name = "thermal, one"
ecss_class = "thermo-elastic"
axis = "cross-boresight"
sigma_arcsec = 0.7
mean_arcsec = -0.3
interpretation = "temporal"
absorbed_by_alignment = "yes"
correlation_group = "=thermal"
provenance = "report"
[[contributor]]
name = "=thermal, two"
ecss_class = "thermo-elastic"
axis = "all"
sigma_arcsec = 0.4
interpretation = "temporal"
absorbed_by_alignment = "no"
correlation_group = "-=thermal"
provenance = "report"
"""


def made_of(text, tmp_path):
    path = tmp_path / "budget.toml"
    path.write_text(text)
    stated = load_budget_file(path)
    rows = from_file(stated, (), ())
    return Budget(
        **combination(rows, stated, {}, 0.997, 20_000, 1),
        title=stated.title,
        notes=("A note to read.",),
        provenance=provenance(1, {"file": "budget.toml"}, None),
        document=stated.document,
        configuration={
            "camera": sc.paper.paper_camera().to_dict(),
            "effects": [],
            "n_frames": 60,
            "n_stars": 999,
        },
    )


@pytest.fixture
def found(tmp_path):
    return made_of(FILE, tmp_path)


def test_the_sheet_ranks_requirements_and_keeps_what_the_title_block_states(found, tmp_path):
    found.save(tmp_path / "b.csv")
    again = Budget.load(tmp_path / "b.csv")
    assert (again.document, again.configuration) == (found.document, found.configuration)
    assert again.document == {"number": "TN-014", "issue": "2", "prepared": "A. Analyst"}
    text = budgeting.sheet_html(again)
    assert text.index("R-violated") < text.index("R-met</b>")
    assert "Budget of a &lt;tracker&gt;" in text and "<tracker>" not in text
    marks = re.findall(r'class="mark (\w+)">(\w+)<', text)
    assert marks == [("fail", "violated"), ("pass", "met")]
    for shown in ("999 stars in 60 frames", "A. Analyst", "A note to read.", "TN-014, 2, Budget"):
        assert shown in text


@pytest.mark.skipif(shutil.which("chromium") is None, reason="takes an installed browser")
def test_the_sheet_is_printed_with_numbers_bookmarks_and_text(found, tmp_path):
    path = sc.report(found, tmp_path / "sheet.pdf")
    content = path.read_bytes()
    assert content.startswith(b"%PDF")
    assert b"/Outlines" in content
    pages = len(re.findall(rb"/Type\s*/Page\b(?!s)", content))
    assert 1 <= pages <= 3
    if shutil.which("pdftotext"):
        shown = ["pdftotext", "-layout", str(path), "-"]
        text = subprocess.run(shown, capture_output=True, text=True, check=True).stdout
        assert "R-violated" in text and f"Page 1 of {pages}" in text


def test_a_key_of_the_title_block_that_is_unknown_is_refused(tmp_path):
    path = tmp_path / "budget.toml"
    path.write_text(FILE.replace('issue = "2"', 'isue = "2"'))
    with pytest.raises(sc.errors.BudgetError, match=r"\[document\].*isue.*issue"):
        load_budget_file(path)


def test_without_a_browser_nothing_is_written(found, monkeypatch, tmp_path):
    monkeypatch.setattr(printing, "browsers", lambda: iter(()))
    monkeypatch.setitem(sys.modules, "weasyprint", None)
    with pytest.raises(sc.errors.MissingExtraError):
        sc.report(found, tmp_path / "sheet.pdf")
    assert not (tmp_path / "sheet.pdf").exists()


@pytest.mark.slow
@pytest.mark.extra("excel")
@pytest.mark.skipif(shutil.which("soffice") is None, reason="takes LibreOffice")
def test_a_spreadsheet_recalculates_the_rule_from_the_contributors(tmp_path):
    """As written, and after a sigma was changed in the workbook, without any code of ours."""
    import openpyxl

    text = FILE + GROUPS
    written = sc.report(made_of(text, tmp_path), tmp_path / "b.xlsx")
    for sigma in (1.0, 2.5):
        book = openpyxl.load_workbook(written)
        rows = book["Contributors"]
        heads = [cell.value for cell in rows[1]]
        for row in rows.iter_rows(min_row=2):
            if row[0].value == "alignment residual":
                row[heads.index("Sigma [arcsec]")].value = sigma
        book.save(tmp_path / "changed.xlsx")
        recalculated = ["soffice", "--headless", "--convert-to", "ods", "--outdir", str(tmp_path)]
        subprocess.run(
            [*recalculated, str(tmp_path / "changed.xlsx")], check=True, capture_output=True
        )
        recalculated[3] = "xlsx:Calc MS Excel 2007 XML"
        (tmp_path / "changed.xlsx").unlink()
        subprocess.run(
            [*recalculated, str(tmp_path / "changed.ods")], check=True, capture_output=True
        )
        live = openpyxl.load_workbook(tmp_path / "changed.xlsx", data_only=True)["Live totals"]
        expected = made_of(text.replace("sigma_arcsec = 1.0", f"sigma_arcsec = {sigma}"), tmp_path)
        for row in live.iter_rows(min_row=2, max_row=7, values_only=True):
            scope, axis, mean, spread, factor, rule = row[:6]
            total = expected.total(axis, scope)
            shown = (mean, spread, factor, rule)
            assert shown == pytest.approx(
                (total.mean_arcsec, total.sigma_arcsec, total.factor, total.rule_arcsec), rel=1e-9
            )
    # Rows that err together matter: in squares alone the sum is another.
    alone = (1.0**2 + 0.7**2 + 0.4**2) ** 0.5
    before = made_of(text, tmp_path).total("X", "before alignment").sigma_arcsec
    assert abs(before - (1.0**2 + (0.7 - 0.4) ** 2) ** 0.5) < 1e-12 < 0.1 < alone - before
