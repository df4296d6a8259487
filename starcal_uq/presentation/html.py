"""Templates of the reports, and images inside a page."""

from __future__ import annotations

import base64
import io
import re
import textwrap
from collections.abc import Iterable, Mapping
from functools import cache
from html import escape
from typing import TYPE_CHECKING, Any

from starcal_uq.core import formatting
from starcal_uq.core.provenance import Provenance
from starcal_uq.presentation.tables import TextTable

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup


# Columns of lines in a terminal.
WIDTH = 80


def wrapped(text: str, indent: str = "", lines: int | None = None) -> str:
    """Text in lines of at most 80 columns, which begin with an indent, the others with more; an
    ellipsis stands for what is beyond so many lines.
    """
    return textwrap.fill(
        re.sub("[ \n]+", " ", text),
        WIDTH,
        initial_indent=indent,
        subsequent_indent=f"{indent}  ",
        break_on_hyphens=False,
        max_lines=lines,
        placeholder=" …",
    )


def card(title: str, text: str, *tables: TextTable) -> str:
    """A result in a notebook: what it is, what it says, and its tables."""
    said = re.sub(r"`([^`]+)`", r"<code>\1</code>", f": {escape(text)}" if text else "")
    return f"<p><b>{escape(title)}</b>{said}</p>" + "".join(table.html() for table in tables)


def listed(messages: Iterable[str]) -> str:
    """Sentences as a list; nothing where there are none."""
    items = "".join(f"<li>{escape(message)}</li>" for message in messages)
    return f"<ul>{items}</ul>" if items else ""


def symbol(name: str) -> Markup:
    """A parameter's name as a mathematical symbol in HTML."""
    from markupsafe import Markup, escape

    if name == "sigma":
        return Markup("<i>σ</i>")
    if name == "sigma_scale":
        return Markup("<i>s</i><sub>σ</sub>")
    match = re.fullmatch(r"([a-z])(\d*)", name)
    if match is None:
        return Markup("{}").format(escape(name))
    base = Markup("<i>{}</i>").format(match[1])
    return base + Markup("<sub>{}</sub>").format(match[2]) if match[2] else base


def on_page(table: TextTable, caption: str = "", kind: str = "") -> Markup:
    """A table of a page, which may scroll: first column bold; under an empty head, names of
    parameters as symbols.
    """
    from markupsafe import Markup

    shown = escape if table.heads[0] else symbol
    drawn = table.html(caption, kind, lambda name: f"<b>{shown(name)}</b>")
    return Markup(f'<div class="scroll">{drawn}</div>')


def page(template: str, made: Provenance, /, **known: Any) -> str:
    """A page from its template, with the time and the version of what it shows."""
    text = (
        template_environment()
        .get_template(template)
        .render(known, created=made.created_utc, version=made.version)
    )
    return f"{text}\n"


@cache
def template_environment() -> Environment:
    """Jinja's environment for the templates of the package: everything is escaped but text, and a
    missing name is an error.

    Templates know most functions of `starcal_uq.core.formatting`, and all sentences.
    """
    import jinja2

    from starcal_uq.presentation.words.sentences import (
        CompiledTemplates,
        functions,
        rows,
        say,
        told,
    )

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("starcal_uq.presentation"),
        autoescape=jinja2.select_autoescape(disabled_extensions=["txt.j2"], default=True),
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
        bytecode_cache=CompiledTemplates(),
    )
    environment.filters |= {
        "symbol": symbol,
        "table": on_page,
        "picture": picture,
        "wrapped": wrapped,
        "when": lambda utc: utc.replace("T", " ").replace("Z", " UTC"),
    }
    environment.globals |= {"rows": rows, "say": say, "told": told}
    environment.globals |= functions(formatting)
    environment.globals["TextTable"] = TextTable
    return environment


def picture(images: Mapping[str, bytes], name: str, alt: str) -> Markup:
    """A figure (SVG or PNG) inside the page, an inch of it 100 px wide; nothing where there is none
    of that name.
    """
    from markupsafe import Markup

    if name not in images:
        return Markup("")
    if images[name].startswith(b"\x89PNG"):
        from PIL import Image

        shown = Image.open(io.BytesIO(images[name]))
        width = shown.width * 100.0 / shown.info["dpi"][0]
        data = "image/png;base64," + base64.b64encode(images[name]).decode("ascii")
    else:
        text = images[name].decode().strip()
        points = re.match(r'<svg[^>]*? width="([\d.]+)pt"', text)
        width = 0.0 if points is None else float(points[1]) * 100.0 / 72.0
        # What an attribute in quotation marks, and an address, cannot hold.
        data = "image/svg+xml," + text.replace("%", "%25").replace("#", "%23").replace(
            '"', "'"
        ).replace("&", "%26")
    return Markup(
        f'<img class="drawn" src="data:{data}" alt="{escape(alt)}" width="{round(width)}">'
    )
