"""Examples of the command line in the how-to pages: their output is made when the pages are, never
typed.

The lines of an ``example`` are run in a folder of their page, which starts as a copy of one night
that all pages share. What takes too long for every build has a name, and its output is kept under
``how-to/_recorded``; ``python docs/_ext/example.py`` runs all pages and writes these files anew.
"""

from __future__ import annotations

import atexit
import os
import re
import shutil
import subprocess
import sys
import tempfile
import textwrap
from functools import cache
from pathlib import Path
from typing import Any

PAGES = Path(__file__).parents[1] / "how-to"
RECORDED = PAGES / "_recorded"
WIDTH = 80
# The night: a camera of which the data sheet is wrong, stars in 60 of its frames, and four of them
# as images.
NIGHT = (
    "starcal-uq new camera -o camera.toml",
    "starcal-uq simulate truth.toml -o stars.ecsv --frames 60 --seed 5",
    "starcal-uq simulate truth.toml -o few.ecsv --frames 4 --seed 7 --images night",
    "starcal-uq run stars.ecsv camera.toml -o run",
)
BLOCK = re.compile(r"^```\{example\}[ ]*(\S*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


# What the lines that make the night have printed.
_made: dict[str, str] = {}


@cache
def _temporary() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="examples-")).resolve()
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@cache
def _night() -> Path:
    import starcal_uq as sc

    folder = _temporary() / "night"
    folder.mkdir()
    sc.paper.paper_camera().save(folder / "truth.toml")
    _made.update({line: output_of(line, folder) for line in NIGHT})
    return folder


@cache
def folder_of(page: str) -> Path:
    """The folder in which the examples of a page run."""
    return Path(shutil.copytree(_night(), _temporary() / page))


def output_of(line: str, folder: Path) -> str:
    """What a line prints, on both streams, in 80 columns; an error, unless ``|| true`` follows."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {
        **os.environ,
        "PATH": path,
        "COLUMNS": str(WIDTH),
        "NO_COLOR": "1",
        "PYTHONUNBUFFERED": "1",
    }
    run = subprocess.run(
        ["bash", "-o", "pipefail", "-c", line],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    if run.returncode not in (0, 1):
        raise RuntimeError(f"{line}\nstatus {run.returncode}: {run.stdout}")
    # A run of the shared night names its files where they were made.
    shown = run.stdout.replace(f"{folder}/", "").replace(f"{_temporary()}/night/", "")
    lines = shown.rstrip().splitlines()
    return "\n".join(
        part
        for each in lines
        for part in textwrap.wrap(each.rstrip(), WIDTH, subsequent_indent="  ") or [""]
    )


def text_of(page: str, lines: list[str]) -> str:
    """Lines with their prompts, each with its output."""
    folder = folder_of(page)
    shown = (line.removesuffix(" || true") for line in lines)
    made = (_made[line] if line in _made else output_of(line, folder) for line in lines)
    parts = (f"$ {line}\n{text}" for line, text in zip(shown, made, strict=True))
    return "\n\n".join(part.rstrip() for part in parts)


def examples(page: Path) -> list[tuple[str, list[str]]]:
    """Name (empty for what every build runs) and lines of every example of a page."""
    return [
        (name, body.strip().splitlines()) for name, body in BLOCK.findall(page.read_text("utf-8"))
    ]


def recorded(name: str, lines: list[str]) -> str:
    """The recorded output of an example; an error where that is of other lines."""
    path = RECORDED / f"{name}.txt"
    text = path.read_text("utf-8") if path.exists() else ""
    if [line.removeprefix("$ ") for line in text.splitlines() if line.startswith("$ ")] != lines:
        raise RuntimeError(f"{path} is of other lines: run python docs/_ext/example.py {name}")
    return text.rstrip("\n")


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""
    from docutils import nodes
    from sphinx.util.docutils import SphinxDirective

    class Example(SphinxDirective):
        """Lines of a shell, shown with what they print."""

        has_content = True
        optional_arguments = 1

        def run(self) -> list[nodes.Node]:
            lines = list(self.content)
            text = (
                recorded(self.arguments[0], lines)
                if self.arguments
                else text_of(Path(self.env.docname).name, lines)
            )
            return [nodes.literal_block(text, text, language="text")]

    app.add_directive("example", Example)
    return {"parallel_read_safe": False}


if __name__ == "__main__":
    RECORDED.mkdir(exist_ok=True)
    for page in sorted(PAGES.glob("*.md")):
        for name, lines in examples(page):
            if name and (not sys.argv[1:] or name in sys.argv[1:]):
                (RECORDED / f"{name}.txt").write_text(
                    text_of(page.stem, lines) + "\n", encoding="utf-8"
                )
                print(f"{page.name}: {name}")
