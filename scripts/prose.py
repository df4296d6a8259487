"""Check the English of pages and notebooks: `prose.py` prints what to change, with status 1.

The house's patterns are in `docs/style.toml`; codespell (settings in `pyproject.toml`) and proselint
(`docs/proselint.json`) run where they are installed. Generated pages are left out.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
GENERATED = re.compile(r"docs/(_build/|gallery|notebooks/|reference/(api/|_))")
CODE = re.compile(
    r"^(`{3,}|:{3,}).*?^\1[ ]*$|^ {4}.*?$|^---\n.*?^---$|`[^`]*`", re.MULTILINE | re.DOTALL
)


def pages() -> list[Path]:
    """Pages and notebooks that people write."""
    found = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("notebooks/*.ipynb")]
    return sorted(page for page in found if not GENERATED.match(str(page.relative_to(ROOT))))


def prose_of(page: Path) -> str:
    """The text of a page without its code, line for line."""
    text = page.read_text("utf-8")
    if page.suffix == ".ipynb":
        cells = json.loads(text)["cells"]
        text = "\n\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")
    return CODE.sub(lambda code: "\n" * code[0].count("\n"), text)


def against_style(text: str) -> Iterator[tuple[int, str, str]]:
    """Line number, words and better words of each pattern that a text contains."""
    style = tomllib.loads((ROOT / "docs" / "style.toml").read_text("utf-8"))
    for pattern, better in style["instead"].items():
        for found in re.finditer(pattern.replace(" ", r"\s+"), text, re.IGNORECASE):
            yield text.count("\n", 0, found.start()) + 1, " ".join(found[0].split()), better


def main() -> int:
    """Run all checks and return the number of those that failed."""
    names = [str(page.relative_to(ROOT)) for page in pages()]
    failed = 0
    for page in pages():
        for line, words, better in against_style(prose_of(page)):
            print(f"{page.relative_to(ROOT)}:{line}: '{words}': write {better}")
            failed = 1
    texts = [name for name in names if name.endswith(".md")]
    checks = {
        "codespell_lib": ["codespell", *names, "starcal_uq"],
        "proselint": ["proselint", "check", "--config", "docs/proselint.json", *texts],
    }
    for module, (command, *arguments) in checks.items():
        if find_spec(module) is None:
            print(f"{command} is not installed: make docs installs it")
            continue
        program = Path(sys.executable).with_name(command)
        failed += subprocess.run([program, *arguments], cwd=ROOT, check=False).returncode != 0
    return failed


if __name__ == "__main__":
    sys.exit(min(main(), 1))
