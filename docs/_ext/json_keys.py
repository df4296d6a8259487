"""The keys of the documents that commands print with ``--json``, in words."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from starcal_uq.cli.schemas import json_schema
from starcal_uq.core.documents import referred

AnyDict = dict[str, Any]


def keys(name: str) -> Iterator[tuple[str, str, str, str]]:
    """Every key of a document with its type, unit and meaning; ``a[].b`` is b of every object in
    the list a.
    """
    schema = json_schema(name)
    yield from _keys(schema, schema.get("$defs", {}), "")


def _keys(place: AnyDict, parts: AnyDict, above: str) -> Iterator[tuple[str, str, str, str]]:
    for name, content in place["properties"].items():
        kind, inner = type_words(content), referred(content)
        yield f"{above}{name}", kind, content.get("unit", ""), content.get("description", "")
        if inner:
            several = "[]" if kind.startswith("list") else ""
            yield from _keys(parts[inner], parts, f"{above}{name}{several}.")


def type_words(content: AnyDict) -> str:
    """The type of a key in words."""
    if "const" in content:
        return json.dumps(content["const"])
    if "anyOf" in content:
        return " or ".join(map(type_words, content["anyOf"]))
    kind = content.get("type", "object")
    if kind == "array":
        return f"list of {_several(content['items'])}"
    values = content.get("additionalProperties")
    return f"object of {_several(values)}" if isinstance(values, dict) else str(kind)


def _several(content: AnyDict) -> str:
    return type_words(content).replace(" or ", "s or ") + "s"
