"""How every result is drawn, told and laid out, by class: ``views.toml`` is the table."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from functools import partial
from importlib.resources import files
from pkgutil import resolve_name
from typing import Any

from starcal_uq.core.display import View
from starcal_uq.core.types import AnyDict
from starcal_uq.presentation.html import card, listed
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.sentences import rows as named_rows
from starcal_uq.presentation.words.sentences import told


def rows(result: Any) -> TextTable:
    """The data frame of a result as it is."""
    return TextTable.of(result.to_dataframe())


def draws(result: Any) -> list[str]:
    """How many draws of the posterior a result is made from."""
    return [f"{result.n_draws} posterior draws."]


def messages(result: Any) -> tuple[str, ...]:
    """What a result says of itself."""
    return tuple(result.messages)


def _html(said: Callable[[Any], str], entry: Mapping[str, Any], result: Any) -> str:
    """Title, sentences and tables of a result, what is worth noting and its interactive figure."""
    found = entry["table"](result) if "table" in entry else None
    tables = filter(None, [found] if isinstance(found, TextTable | None) else found)
    notes = entry["notes"](result) if "notes" in entry else ()
    shown = card(entry["title"], said(result), *tables) + listed(notes)
    return shown + (entry["frame"](result) if "frame" in entry else "")


def _view(entry: AnyDict) -> View:
    entry["figures"] = {name: _found(where) for name, where in entry.get("figures", {}).items()}
    for part in ("say", "table", "notes", "frame", "html"):
        if part in entry:
            entry[part] = _found(entry[part])
    if "rows" in entry:
        entry["table"] = partial(named_rows, entry["rows"])
    said = entry["say"] if "say" in entry else partial(told, entry["text"])
    html = partial(_html, said, entry) if "title" in entry else entry.get("html")
    return View(said, html, entry["figures"])


def _found(where: str) -> Any:
    return resolve_name(f"starcal_uq.presentation.{where}")


VIEWS: Mapping[type, View] = {
    resolve_name(f"starcal_uq.{name}"): _view(entry)
    for name, entry in tomllib.loads(
        (files("starcal_uq.presentation") / "views.toml").read_text("utf-8")
    ).items()
}
