"""The command that tells what the others print with ``--json``."""

from __future__ import annotations

import json

from starcal_uq.cli.answers import Answer
from starcal_uq.cli.console import print_table, say
from starcal_uq.presentation.tables import TextTable


def schema_command(
    name: str | None = None,
) -> Answer:
    """The JSON Schema of what a command prints with `--json`."""
    from starcal_uq.cli.schemas import SCHEMAS, json_schema

    rows = [
        {"name": each, "version": version, "text": part.text}
        for each, (version, part) in SCHEMAS.items()
        if name in (None, each)
    ]
    schema = None if name is None else json_schema(name)
    if schema is None:
        cells = tuple(tuple(map(str, row.values())) for row in rows)
        print_table(TextTable(("schema", "version", "what it holds"), cells, align="lrl"))
    else:
        say(json.dumps(schema, indent=1))
    return Answer({"schemas": rows, "json_schema": schema})
