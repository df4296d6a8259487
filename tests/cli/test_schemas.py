"""Every command answers with one document of its schema; commands and schemas come from their own
declarations.
"""

from __future__ import annotations

import inspect
import json
import math
import re
from pathlib import Path
from typing import get_type_hints

import jsonschema
import numpy as np
import pytest

import starcal_uq as sc
from docs._ext.json_keys import keys, type_words
from starcal_uq.cli import schemas
from starcal_uq.cli.answers import Answer
from starcal_uq.cli.commands import app
from starcal_uq.core.formatting import significant
from tests.helpers.commands import check_document
from tests.helpers.outside import campaign

# Calls that end soon, in the order in which they need each other. Others are validated where they
# are tested: the fixture `cli` holds every document against its schema.
CALLS = {
    "new": "camera -o new.toml",
    "simulate": "camera.toml -o made.csv --frames 3",
    "calibrate": "obs.parquet camera.toml -o run --in-space --screen",
    "filter": "obs.parquet camera.toml -o filtered --sigma 0.05",
    "sample": "run --ensembles 2 --walkers 14 --steps 20",
    "coupling": "run",
    "export": "run --to covariance",
    "merge": "run other -o both",
    "schema": "coupling",
}
ELSEWHERE = {
    "demo": "../runs/test_run",
    "run": "test_commands",
    "report": "test_mission",
    "propagate": "test_mission",
    "budget": "test_mission",
    "compare": "test_mission",
    "plan": "test_mission",
    "study": "test_study",
    "validate": "test_statistics",
    "diagnose": "test_statistics",
    "centroid": "test_images",
    "identify": "test_images",
    "inspect": "test_images",
    "reproduce": "test_paper",
    "reproduce-field": "test_paper",
}
# Keys and types of every schema and part as they stand. Where a line has to change, say so in the
# changelog; where a key goes or changes its type or meaning, raise the version of every schema that
# holds it.
RECORDED = Path(__file__).with_name("schemas.txt")


def _line(schema):
    types = {key: type_words(content) for key, content in schema["properties"].items()}
    return ", ".join(
        f"{key} {words}" for key, words in types.items() if key not in ("schema", "version")
    )


def test_every_command_has_a_schema_and_is_tried():
    assert set(schemas.SCHEMAS) == set(app.commands) | {"verdict", "error"}
    assert set(CALLS) | set(ELSEWHERE) == set(app.commands)
    for command, file in ELSEWHERE.items():
        text = (Path(__file__).parent / f"{file}.py").read_text("utf-8")
        assert re.search(rf'"{command}[ "]', text), command
    for command in app.commands.values():
        assert get_type_hints(inspect.unwrap(command.callback))["return"] is Answer, command.name
        assert any(parameter.name == "json" for parameter in command.params), command.name


@pytest.mark.parametrize("name", schemas.SCHEMAS)
def test_schemas_are_schemas_and_say_what_every_key_is(name):
    schema = schemas.json_schema(name)
    jsonschema.Draft202012Validator.check_schema(schema)
    found = list(keys(name))
    assert [key for key, *_ in found][:3] == ["schema", "version", "exit_status"]
    unsaid = [key for key, kind, _, text in found if not text or kind == "Any"]
    assert not unsaid, unsaid
    # A number has a unit in its name, beside it, or none.
    assert not [
        key for key, kind, unit, _ in found if re.search("_(px|arcsec|mm|deg)$", key) and not unit
    ]


def test_keys_are_stable_within_a_version():
    now = []
    for name, (version, _) in schemas.SCHEMAS.items():
        schema = schemas.json_schema(name)
        now += [f"{name} {version}: {_line(schema)}"]
        now += [f"{part}: {_line(content)}" for part, content in schema.get("$defs", {}).items()]
    now = list(dict.fromkeys(now))
    assert len({line.partition(":")[0] for line in now}) == len(now)
    assert now == RECORDED.read_text("utf-8").splitlines(), "\n".join(now)


@pytest.fixture
def folder(cli, tmp_path):
    c = campaign(np.random.default_rng(4), n_frames=24)
    obs, camera = sc.Observations(**c.columns), sc.Camera(**c.camera_toml())
    obs.select_frames(obs.frame_ids[:16]).save(tmp_path / "obs.parquet")
    camera.save(tmp_path / "camera.toml")
    sc.Run(tmp_path / "other").calibrate(obs.select_frames(obs.frame_ids[16:]), camera)
    return tmp_path


def test_documents_are_alone_on_standard_output_and_as_their_schemas_say(cli, folder):
    for name, arguments in CALLS.items():
        document = cli.document(f"{name} {arguments}", among=(0, 1))
        assert document["schema"] == f"starcal-uq/{name}"
    # The same numbers as in the text, and as in Python.
    text = cli("coupling run")[1]
    rows = cli.document("coupling run")["coupling"]["parameters"]
    for row in rows:
        for key in ("sigma_marginal", "sigma_conditional", "crlb_sigma"):
            assert significant(row[key]) in text
    assert [row["sigma_marginal"] for row in rows] == sc.Run("run").coupling.sigma_marginal.tolist()


def test_errors_are_documents(cli, folder):
    for call in ("nonsense", "coupling nowhere", "sample other --steps x", "coupling obs.parquet"):
        document = cli.document(call, among=(2,))
        assert document["schema"] == "starcal-uq/error"
        assert cli(call)[1:] == ("", f"error: {document['error']}\n")


def test_controls():
    good = schemas.document(
        "export", {"file": "a", "to": "opencv", "error_px": 0.1, "text": "ok."}, 0
    )
    schema = schemas.json_schema("export")
    jsonschema.validate(good, schema)
    for wrong in (
        {key: value for key, value in good.items() if key != "error_px"},
        good | {"error_px": "0.1"},
        good | {"version": 2},
        good | {"schema": "starcal-uq/run"},
    ):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(wrong, schema)
    with pytest.raises(AssertionError, match="NaN"):
        check_document(json.dumps(good | {"error_px": math.nan}), 0)
    assert schemas.document("export", good | {"error_px": math.nan}, 0)["error_px"] is None
