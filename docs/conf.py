"""Configuration of the documentation; `make docs` builds it, with warnings as errors."""

from __future__ import annotations

import importlib
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

HERE = Path(__file__).parent
PROJECT = tomllib.loads((HERE.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"]

project = "starcal_uq"
author = "The starcal_uq developers"
copyright = "2026, The starcal_uq developers"
version = release = PROJECT["version"]

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx-mathjax-offline",
]
exclude_patterns = ["_build"]
source_suffix = {".md": "myst-nb", ".ipynb": "myst-nb"}
# Notebooks are executed on every build, each in a folder of its own; one that fails fails the build.
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True
myst_enable_extensions = ["amsmath", "dollarmath"]
myst_heading_anchors = 2

autodoc_default_options = {"members": True, "member-order": "bysource", "show-inheritance": True}
autodoc_typehints = "none"  # the docstrings state shapes and units, which annotations cannot
napoleon_google_docstring = False
napoleon_use_ivar = True  # fields of dataclasses are described once, in the docstring of the class
napoleon_use_rtype = False
napoleon_attr_annotations = False
# Words of a docstring's types ("n_frames values") are taken for references; two classes may have such a field.
suppress_warnings = ["ref.python"]

html_theme = "furo"
html_title = f"starcal_uq {release}"
html_static_path: list[str] = []


def copy_notebooks(_app: object) -> None:
    """Bring the notebooks where Sphinx looks for them."""
    for notebook in (HERE.parent / "notebooks").glob("*.ipynb"):
        (HERE / "notebooks").mkdir(exist_ok=True)
        shutil.copyfile(notebook, HERE / "notebooks" / notebook.name)


def command_names() -> list[str]:
    """The commands of the command line, in the order of its help."""
    from starcal_uq.cli.commands import app

    return [str(command.name or command.callback.__name__) for command in app.registered_commands if command.callback]


def write_command_help(_app: object) -> None:
    """Write the help texts as the installed command prints them, so that the page cannot go stale."""
    command = str(Path(sys.executable).with_name("starcal-uq"))
    environment = {**os.environ, "COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}
    texts = []
    for arguments in ([], *([name] for name in command_names())):
        run = subprocess.run(
            [command, *arguments, "--help"], env=environment, capture_output=True, text=True, check=True
        )
        lines = [line.rstrip() for line in run.stdout.strip().splitlines()]
        texts.append("\n".join([" ".join(["$ starcal-uq", *arguments, "--help"]), "", *lines]))
    (HERE / "reference" / "_commands.txt").write_text("\n\n\n".join(texts) + "\n", encoding="utf-8")


def write_reference(_app: object) -> None:
    """One page a namespace, with what its stub offers: a public name cannot be forgotten here."""
    folder = HERE / "reference" / "api"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    wings = sorted(path.parent.name for path in (HERE.parent / "starcal_uq").glob("*/__init__.pyi"))
    for place in ("", *wings):
        module = importlib.import_module(f"starcal_uq.{place}".rstrip("."))
        names = [name for name in module.__all__ if not isinstance(getattr(module, name), ModuleType)]
        lines = [f"# {f'sc.{place}' if place else 'sc'}", "", (module.__doc__ or "").strip(), "", "```{eval-rst}"]
        for name in sorted(names, key=lambda name: (not name[0].isupper(), name.lower())):
            public = getattr(module, name)
            kind = "class" if isinstance(public, type) else "function" if callable(public) else "data"
            lines.append(f".. auto{kind}:: {module.__name__}.{name}")
        if place == "core":
            lines.append(".. automodule:: starcal_uq.core.errors")
        (folder / f"{place or '_top'}.md").write_text("\n".join([*lines, "```", ""]), encoding="utf-8")


def escape_formulas(_app: object, _what: str, _name: str, _object: object, _options: object, lines: list[str]) -> None:
    """Keep the bars of |A| and the last underscore of `str_` from being read as markup; literals stay as they are."""
    literal_above: int | None = None
    for number, line in enumerate(lines):
        indent = len(line) - len(line.lstrip())
        if literal_above is not None and line.strip() and indent <= literal_above:
            literal_above = None
        if literal_above is None:
            parts = re.split(r"(``.*?``|`.*?`)", line)
            parts[::2] = [re.sub(r"(?<!\\)\||(?<=\w)_(?!\w)", r"\\\g<0>", part) for part in parts[::2]]
            lines[number] = "".join(parts)
            literal_above = indent if line.rstrip().endswith("::") else None


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("builder-inited", write_command_help)
    app.connect("builder-inited", write_reference)
    app.connect("builder-inited", copy_notebooks)
    app.connect("autodoc-process-docstring", escape_formulas, priority=400)  # before napoleon
