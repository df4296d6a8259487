"""What a command answers: text for people, or with ``--json`` one document for programs."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import typer

INTERRUPTED = 130
# Whether this call has printed its document: there is one at most.
_printed = False


@dataclass(frozen=True)
class Answer:
    """The results of a command by the keys of its schema, and how it ends.

    Attributes
    ----------
    results : mapping of str to object
        Results, paths, tables or plain values; read only where a document is asked for.
    status : int
        Exit status: 0, 1 for a result that should not be trusted, or 130 for one that is not
        complete.
    """

    results: Mapping[str, Any]
    status: int = 0


def begin() -> None:
    """A new call of the command line begins."""
    global _printed
    _printed = False


def deliver(name: str, answer: Answer, as_json: bool) -> None:
    """Print the document, where one is asked for, and end the command with its status."""
    if as_json:
        _print(name, answer.results, answer.status)
    if answer.status == INTERRUPTED:
        raise KeyboardInterrupt
    if answer.status:
        raise typer.Exit(answer.status)


def deliver_error(sentence: str, status: int) -> None:
    """Print what went wrong as a document, where the call asks for one, be it wrong itself, and got
    none yet.
    """
    if "--json" in sys.argv[1:] and not _printed:
        _print("error", {"error": sentence}, status)


def _print(name: str, results: Mapping[str, Any], status: int) -> None:
    from starcal_uq.cli.schemas import document

    global _printed
    print(json.dumps(document(name, results, status), indent=1, allow_nan=False), flush=True)
    _printed = True
