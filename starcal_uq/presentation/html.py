"""Templates of the reports, and images inside a page."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from html import escape
from typing import TYPE_CHECKING, Any

from starcal_uq.presentation.tables import TextTable

if TYPE_CHECKING:
    from jinja2 import Environment


def card(title: str, text: str, *tables: TextTable) -> str:
    """A result in a notebook: what it is, what it says, and its tables."""
    said = f": {escape(text)}" if text else ""
    return f"<p><b>{escape(title)}</b>{said}</p>" + "".join(table.html() for table in tables)


def listed(messages: Iterable[str]) -> str:
    """Sentences as a list; nothing where there are none."""
    items = "".join(f"<li>{escape(message)}</li>" for message in messages)
    return f"<ul>{items}</ul>" if items else ""


def template_environment() -> Environment:
    """Jinja's environment for the templates of the package: everything is escaped, and a missing name is an error."""
    import jinja2

    return jinja2.Environment(
        loader=jinja2.PackageLoader("starcal_uq.presentation"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )


def embedded_image(png: bytes) -> dict[str, Any]:
    """An image and its width on the page: half its pixels, so that it is sharp on fine screens and on paper."""
    return {"data": base64.b64encode(png).decode("ascii"), "width": int.from_bytes(png[16:20], "big") // 2}
