"""Templates of the reports, and images inside a page."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterable
from html import escape
from typing import TYPE_CHECKING, Any

from starcal_uq.presentation.tables import TextTable

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup


def card(title: str, text: str, *tables: TextTable) -> str:
    """A result in a notebook: what it is, what it says, and its tables."""
    said = f": {escape(text)}" if text else ""
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
    """A table of a page, which may scroll: first column bold; under an empty head, names of parameters as symbols."""
    from markupsafe import Markup

    shown = escape if table.heads[0] else symbol
    drawn = table.html(caption, kind, lambda name: f"<b>{shown(name)}</b>")
    return Markup(f'<div class="scroll">{drawn}</div>')


def template_environment() -> Environment:
    """Jinja's environment for the templates of the package: everything is escaped, and a missing name is an error."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("starcal_uq.presentation"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {"symbol": symbol, "table": on_page}
    return environment


def embedded_image(png: bytes) -> dict[str, Any]:
    """An image and its width on the page, 100 px an inch: half as fine again, so that it is sharp on paper too."""
    from PIL import Image

    picture = Image.open(io.BytesIO(png))
    width = round(picture.width * 100.0 / picture.info["dpi"][0])
    return {"data": base64.b64encode(png).decode("ascii"), "width": width}
