"""The pages: every command has an example, recordings match their lines, and prose keeps to the
house style.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from starcal_uq.cli.commands import app

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("example", ROOT / "docs" / "_ext" / "example.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_command_has_an_example(example):
    found = [
        found for page in sorted(example.PAGES.glob("*.md")) for found in example.examples(page)
    ]
    lines = [line for _, lines in found for line in lines]
    named = {line.split()[1] for line in lines if line.startswith("starcal-uq ")}
    assert named == set(app.commands)
    # Recordings are of these lines, fit a page, and none is left over.
    names = {name: lines for name, lines in found if name}
    assert {path.stem for path in example.RECORDED.glob("*")} == set(names)
    for name, lines in names.items():
        text = example.recorded(name, lines)
        assert max(map(len, text.splitlines())) <= example.WIDTH
        assert "Traceback" not in text and str(Path.home()) not in text
        with pytest.raises(RuntimeError, match="of other lines"):
            example.recorded(name, [*lines, "starcal-uq demo"])


def test_examples_are_what_their_lines_print(example, tmp_path):
    text = example.output_of(
        "echo a; echo b >&2; echo $COLUMNS; printf 'x%.0s' {1..99}; exit 1", tmp_path
    )
    assert text.splitlines() == ["a", "b", "80", 80 * "x", f"  {19 * 'x'}"]
    assert example.output_of(f"echo {tmp_path}/run", tmp_path) == "run"
    with pytest.raises(RuntimeError, match="status 2"):
        example.output_of("exit 2", tmp_path)


def test_prose_keeps_to_the_style():
    """Of pages and notebooks; codespell and proselint run in `make docs`."""
    from scripts.prose import against_style, pages, prose_of

    found = pages()
    assert {"README.md", "tour.md", "quickstart.ipynb"} <= {page.name for page in found}
    slips = {str(page.relative_to(ROOT)): list(against_style(prose_of(page))) for page in found}
    assert {page: slip for page, slip in slips.items() if slip} == {}


def test_the_style_is_looked_for_in_prose_alone(tmp_path):
    from scripts.prose import against_style, prose_of

    page = tmp_path / "page.md"
    page.write_text("# A\n\n```text\ngoes on\n```\n\n    goes on\n\n`goes on`\nThis goes\non.\n")
    assert list(against_style(prose_of(page))) == [(10, "goes on", "continues")]
