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

from sphinx.addnodes import desc_signature
from sphinx.ext.napoleon import NumpyDocstring

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "_ext"))
# Pages that show commands import `shell` from there.
os.environ["PYTHONPATH"] = os.pathsep.join(
    [str(HERE / "_ext"), *filter(None, [os.environ.get("PYTHONPATH")])]
)
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
    "example",
]
copybutton_prompt_text = "$ "
exclude_patterns = ["_build", "reference/_commands.md", "reference/_schemas.md"]
source_suffix = {".md": "myst-nb", ".ipynb": "myst-nb"}
# Notebooks are executed on every build, each in a folder of its own; one that fails fails the
# build.
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True
myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "none"  # the docstrings state shapes and units, which annotations cannot
napoleon_google_docstring = False
# Names that share a line share an entry; fields of dataclasses are described once, in the docstring
# of the class.
napoleon_use_param = False
napoleon_custom_sections = [("Fields", "params_style")]
napoleon_use_rtype = False
napoleon_attr_annotations = False
# The first words of a property are no type, whatever colon follows.
NumpyDocstring._consume_inline_attribute = lambda self: ("", self._consume_to_end())  # type: ignore[method-assign]
default_role = "py:obj"  # `name` is a link where it is public
add_module_names = False
python_maximum_signature_line_length = 60
# Words of a docstring's types ("n_frames values") are taken for references; two classes may have
# such a field.
suppress_warnings = ["ref.python"]

html_theme = "furo"
html_title = f"starcal_uq {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
templates_path = ["_templates"]
# The bar at the top of every page (`_templates/page.html`); the theme shows it where this is set.
html_theme_options = {"announcement": "pages"}
html_context = {
    "top_pages": [
        ("install", "Install"),
        ("tour", "Tour"),
        ("how-to/run", "How to"),
        ("gallery", "Gallery"),
        ("reference/api", "Python"),
        ("reference/cli", "Commands"),
        ("faq", "Questions"),
    ]
}


def write_gallery(_app: object) -> None:
    """Draw the figures of the gallery, in a process of its own: they change Matplotlib's state."""
    code = "import gallery_figures, pathlib, sys; gallery_figures.main(pathlib.Path(sys.argv[1]))"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE), str(HERE.parent)])}
    subprocess.run(
        [sys.executable, "-c", code, str(HERE / "gallery.md")], env=environment, check=True
    )


def write_schemas(_app: object) -> None:
    """Write the page of the documents that commands print with `--json`, from their declaration."""
    from json_keys import keys

    from starcal_uq.cli.schemas import SCHEMAS

    lines: list[str] = []
    for name, (version, part) in SCHEMAS.items():
        what = "`RUN/verdict.json`" if name == "verdict" else f"`starcal-uq {name} --json`"
        lines += [
            f"## {name}",
            "",
            f"{'Any command' if name == 'error' else what}, version {version}. {part.text}",
            "",
        ]
        lines += ["| Key | Type | Unit | |", "|---|---|---|---|"]
        for key, kind, unit, text in list(keys(name))[3:]:
            said = text.replace("``", "`").replace("|", "\\|")
            lines.append(f"| `{key}` | {kind} | {unit} | {said} |")
        lines.append("")
    (HERE / "reference" / "_schemas.md").write_text("\n".join(lines), encoding="utf-8")


def copy_notebooks(_app: object) -> None:
    """Bring the notebooks where Sphinx looks for them."""
    for notebook in (HERE.parent / "notebooks").glob("*.ipynb"):
        (HERE / "notebooks").mkdir(exist_ok=True)
        shutil.copyfile(notebook, HERE / "notebooks" / notebook.name)


def write_command_help(_app: object) -> None:
    """Write the help texts as the installed command prints them, so that the page cannot go
    stale.
    """
    from starcal_uq.cli.commands import app

    command = str(Path(sys.executable).with_name("starcal-uq"))
    environment = {**os.environ, "COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}
    texts = []
    for name in ("", *app.commands):
        arguments = [name, "--help"] if name else ["--help"]
        run = subprocess.run(
            [command, *arguments], env=environment, capture_output=True, text=True, check=True
        )
        lines = [line.rstrip() for line in run.stdout.strip().splitlines()]
        texts += [f"## {name}\n" if name else "", "```text", *lines, "```\n"]
    (HERE / "reference" / "_commands.md").write_text("\n".join(texts), encoding="utf-8")


def public_objects() -> dict[str, dict[str, Any]]:
    """What a user can name, by namespace: "" for the top, then the wings; modules among them left
    out.
    """
    wings = sorted(path.parent.name for path in (HERE.parent / "starcal_uq").glob("*/__init__.pyi"))
    found = {}
    for wing in ("", *wings):
        module = importlib.import_module(f"starcal_uq.{wing}".rstrip("."))
        names = sorted(module.__all__, key=lambda name: (not name[0].isupper(), name.lower()))
        public = {name: getattr(module, name) for name in names}
        found[wing] = {
            name: value for name, value in public.items() if not isinstance(value, ModuleType)
        }
    return found


def drawn_by(public: Any) -> str:
    """The figures of a class, with their places in the gallery."""
    from starcal_uq.core.display import view_of

    try:
        names = sorted(view_of(public).figures) if isinstance(public, type) else []
    except LookupError:
        names = []
    place = f"../../../gallery.md#{public.__name__.lower()}-" if names else ""
    links = [f"[`plot.{name}()`]({place}{name.replace('_', '-')})" for name in names]
    return f"\n## Figures\n\n{', '.join(links)}\n" if links else ""


def write_reference(_app: object) -> None:
    """One page an object, and one a namespace, from what the stubs offer: a public name cannot be
    forgotten here.
    """
    from starcal_uq.core.records import Saved

    folder = HERE / "reference" / "api"
    shutil.rmtree(folder, ignore_errors=True)
    for wing, objects in public_objects().items():
        place = folder / (wing or "top")
        place.mkdir(parents=True)
        prefix = f"sc.{wing}." if wing else "sc."
        module = f"starcal_uq.{wing}".rstrip(".")
        pages, rows = [], []
        for name, public in objects.items():
            # Classes and functions may differ by a capital letter only, and file systems may not.
            page = f"{name}-class" if isinstance(public, type) else name
            pages.append(f"{place.name}/{page}")
            kind = (
                "class" if isinstance(public, type) else "function" if callable(public) else "data"
            )
            of_file = isinstance(public, type) and issubclass(public, Saved)
            files = "\n\n   .. automethod:: save\n   .. automethod:: load" if of_file else ""
            # What it holds is declared apart from its steps.
            held = "\n   :inherited-members:" if name == "Run" else ""
            directive = f".. auto{kind}:: {module}.{name}{held}{files}"
            text = f"# {prefix}{name}\n\n```{{eval-rst}}\n{directive}\n```\n{drawn_by(public)}"
            (place / f"{page}.md").write_text(text, encoding="utf-8")
            told = (public.__doc__ or "").strip().partition("\n\n")[0] if kind != "data" else ""
            told = " ".join(told.split()).replace("|", r"\|")
            rows.append(f"| [`{prefix}{name}`]({pages[-1]}.md) | {told} |")
        if wing == "core":
            pages.append(f"{place.name}/errors")
            directive = (
                ".. automodule:: starcal_uq.core.errors\n   :exclude-members: printable, "
                "register_reason"
            )
            errors = f"# sc.errors\n\n```{{eval-rst}}\n{directive}\n```\n"
            (place / "errors.md").write_text(errors, encoding="utf-8")
            rows.append(f"| [`sc.errors`]({pages[-1]}.md) | Errors that a user can act on. |")
        told = (importlib.import_module(module).__doc__ or "").strip() if wing else "Common names."
        lines = [f"# {prefix.rstrip('.')}", "", told, "", "| | |", "|---|---|", *rows]
        lines += ["", "```{toctree}", ":hidden:", "", *pages, "```", ""]
        (folder / f"{wing or '_top'}.md").write_text("\n".join(lines), encoding="utf-8")


def readable(
    _app: object, what: str, _name: str, _object: object, _options: object, lines: list[str]
) -> None:
    """Fields of a class under that name, links from types, and formulas that are not read as
    markup.

    The bars of |A| and the last underscore of `str_` are kept; literals stay as they are.
    """
    literal_above: int | None = None
    for number, line in enumerate(lines):
        indent = len(line) - len(line.lstrip())
        if what == "class" and line == "Attributes" and set(lines[number + 1]) == {"-"}:
            line = "Fields"
        if literal_above is not None and line.strip() and indent <= literal_above:
            literal_above = None
        if literal_above is None:
            parts = re.split(r"(``.*?``|`.*?`)", line)
            parts[::2] = [
                re.sub(r"(?<!\\)\||(?<=\w)_(?!\w)", r"\\\g<0>", part) for part in parts[::2]
            ]
            line = "".join(parts)
            field, colon, kind = line.partition(" : ")
            if colon and not indent:
                line = field + colon + re.sub(r"\b[A-Z]\w+", lambda word: linked(word[0]), kind)
            elif line in PUBLIC and number and set(lines[number - 1]) == {"-"}:  # what is returned
                line = linked(line)
            literal_above = indent if line.rstrip().endswith("::") else None
        lines[number] = line


PUBLIC: dict[str, str] = {}


def linked(name: str) -> str:
    return f":py:obj:`{name}`" if name in PUBLIC else name


def find_public(_app: object) -> None:
    """Where each public name is described: classes of the top level in their wings' docstrings,
    too.
    """
    for wing, objects in public_objects().items():
        for name in objects:
            PUBLIC.setdefault(name, ".".join(filter(None, ["starcal_uq", wing, name])))
    PUBLIC["Status"] = "starcal_uq.core.Status"


def resolve_short(app: Any, env: Any, node: Any, content: Any) -> Any:
    """`Camera` and `Camera.load` stand for the public ones, from wherever they are named."""
    first, dot, rest = (
        node.get("reftarget", "").removeprefix("sc.").rpartition("starcal_uq.")[2].partition(".")
    )
    if node.get("refdomain") != "py" or first not in PUBLIC:
        return None
    target = PUBLIC[first] + dot + rest
    return env.domains["py"].resolve_xref(
        env, node["refdoc"], app.builder, "obj", target, node, content
    )


def name_twice(_app: object, doctree: Any) -> None:
    """Objects bear their names at the top and under their wing, whichever links of the source pages
    have.
    """
    import starcal_uq as sc

    for node in doctree.findall(desc_signature):
        for name in [name for name in node["ids"] if name.startswith("starcal_uq.")]:
            rest = name.split(".")[1:]
            there = getattr(sc, rest[0], sc)
            wing = rest[0] if isinstance(there, ModuleType) else str(there.__module__).split(".")[1]
            below = rest[1:] if wing == rest[0] else [wing, *rest]
            node["ids"].append(".".join(["starcal_uq", *below]))


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("doctree-read", name_twice)
    app.connect("builder-inited", write_command_help)
    app.connect("builder-inited", write_schemas)
    app.connect("builder-inited", write_reference)
    app.connect("builder-inited", copy_notebooks)
    app.connect("builder-inited", write_gallery)
    app.connect("builder-inited", find_public)
    app.connect("missing-reference", resolve_short)
    app.connect("autodoc-process-docstring", readable, priority=400)  # before napoleon
