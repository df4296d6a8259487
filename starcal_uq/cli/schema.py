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

    chosen = SCHEMAS if name is None else {name: SCHEMAS[name]}
    rows = [(each, version, part.text) for each, (version, part) in chosen.items()]
    if name is None:
        cells = tuple((each, str(version), text) for each, version, text in rows)
        print_table(TextTable(("schema", "version", "what it holds"), cells, align="lrl"))
    else:
        say(json.dumps(json_schema(name), indent=1))
    return Answer(
        {
            "schemas": [dict(zip(("name", "version", "text"), row, strict=True)) for row in rows],
            "json_schema": None if name is None else json_schema(name),
        }
    )
