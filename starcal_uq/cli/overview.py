"""The help of the whole program, which needs no command."""

from __future__ import annotations

import shutil
import textwrap
import tomllib
from functools import partial
from pathlib import Path

_ABOUT = (
    "Probabilistic calibration of star sensors: from identified stars to a posterior and its "
    "attitude error."
)
_START = (
    "Start with `starcal-uq demo`: the experiment of Ye & Yang 2017, from a star catalogue to a "
    "report."
)
LISTED: dict[str, dict[str, tuple[str, str]]] = tomllib.loads(
    Path(__file__).with_name("commands.toml").read_text("utf-8")
)
_NAMES = [name for rows in LISTED.values() for name in rows]
# Command -> the module that holds it, and its first sentence, in the order of the help.
COMMANDS = {
    name: row for rows in LISTED.values() for name, row in rows.items() if not name.startswith("-")
}


def overview() -> str:
    """All commands, by what one wants, each with its first sentence."""
    wrap = partial(textwrap.fill, width=min(shutil.get_terminal_size().columns, 100))
    indent = max(map(len, _NAMES)) + 4
    parts = ["Usage: starcal-uq [OPTIONS] COMMAND [ARGS]...", wrap(_ABOUT)]
    for group, rows in LISTED.items():
        lines = [
            wrap(
                words,
                initial_indent=f"  {name}".ljust(indent),
                subsequent_indent=" " * indent,
                break_on_hyphens=False,
            )
            for name, (_, words) in rows.items()
        ]
        parts.append("\n".join([f"{group}:", *lines]))
    return "\n\n".join([*parts, wrap(_START)])
