"""What the package offers to users: the names of all stubs."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import starcal_uq as sc

PACKAGE = Path(sc.__file__).parent


def public() -> Iterator[tuple[str, Any]]:
    """Functions, classes and modules with their names."""
    for stub in sorted(PACKAGE.rglob("__init__.pyi")):
        wing = importlib.import_module(".".join(stub.parent.relative_to(PACKAGE.parent).parts))
        for name in re.findall(r"import \w+ as (\w+)", stub.read_text()):
            yield name, getattr(wing, name)


def public_functions() -> Iterator[tuple[str, Any]]:
    """Functions and methods, by their full names."""
    for name, thing in public():
        members = (
            inspect.getmembers(thing, inspect.isfunction)
            if inspect.isclass(thing)
            else [("", thing)]
        )
        for member, function in members:
            if inspect.isfunction(function) and not member.startswith("_"):
                yield f"{name}.{member}".rstrip("."), function
