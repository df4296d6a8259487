"""The starter of a budget file: it states nothing, lists everything, and loads when it is filled in."""

from __future__ import annotations

from pathlib import Path

import pytest

from starcal_uq.budgeting.file import load_budget_file
from starcal_uq.budgeting.rows import FROM_FILE, Contributor, not_assessed
from starcal_uq.budgeting.starter import template_text, write_budget_template
from starcal_uq.core.constants import AXES
from starcal_uq.core.errors import RunFolderError


def test_the_template_states_nothing_and_lists_everything(tmp_path: Path) -> None:
    path = tmp_path / "starter.toml"
    write_budget_template(path)
    found = load_budget_file(path)
    assert not found.contributors and not found.requirements and found.confidence == 0.997
    text = path.read_text(encoding="utf-8")
    assert all(f'# name = "{entry.name}"' in text for entry in FROM_FILE)
    assert max(len(line) for line in text.splitlines()) <= 120
    with pytest.raises(RunFolderError):
        write_budget_template(path)
    write_budget_template(path, force=True)


def test_an_uncommented_template_loads_once_numbers_are_in(tmp_path: Path) -> None:
    body = template_text().split("# [[requirement]]", 1)[1]
    lines = ["[[requirement]]"]
    for line in body.splitlines():
        bare = line.removeprefix("# ")
        if line.startswith("# ") and (" = " in f"{bare} " or bare.startswith("[")):
            bare = bare.replace('provenance = ""', 'provenance = "test"')
            lines.append(bare + "1.5" if bare.rstrip().endswith("arcsec =") else bare)
            lines[-1] = lines[-1].replace("arcsec =1.5", "arcsec = 1.5")
    path = tmp_path / "budget.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    found = load_budget_file(path)
    assert {(row.name, row.axis) for row in found.contributors} == {
        (entry.name, axis) for entry in FROM_FILE for axis in AXES
    }
    assert len(found.requirements) == 1
    by_name = {row.name: row for row in found.contributors}
    for entry in FROM_FILE:
        assert by_name[entry.name].ecss_class == entry.ecss_class
        assert by_name[entry.name].distribution == entry.distribution


def test_the_template_leaves_out_what_is_assessed() -> None:
    rows = [not_assessed(entry, axis) for entry in FROM_FILE for axis in AXES]
    catalogue = "star catalogue"
    rows = [
        Contributor(row.name, row.ecss_class, row.axis, 0.0, 1.0, source="file")
        if row.name == catalogue or (row.name == "end-of-life noise" and row.axis != "roll")
        else row
        for row in rows
    ]
    text = template_text(rows)
    assert f'name = "{catalogue}"' not in text
    part = text.split('# name = "end-of-life noise"', 1)[1].split("[[contributor]]")[0]
    assert '# axis = "Z"' in part and text.count('# name = "end-of-life noise"') == 1
