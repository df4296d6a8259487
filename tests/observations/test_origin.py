"""The facts of a table: read from its metadata in one place, kept by files, used by code alone."""

import ast
import dataclasses
from pathlib import Path

import numpy as np
import pytest

import starcal_uq
from starcal_uq.core.errors import ObservationError
from starcal_uq.observations.origin import Origin
from starcal_uq.observations.table import Observations, load_observations

PACKAGE = Path(starcal_uq.__file__).parent


def table(**meta):
    return Observations(
        frame=[0, 0, 0],
        x_px=[1.0, 2.0, 3.0],
        y_px=[3.0, 1.0, 2.0],
        ra_deg=[10.0, 11.0, 12.0],
        dec_deg=[0.0, 1.0, 2.0],
        meta=meta,
    )


def reads_metadata(tree):
    """Whether a syntax tree holds ``something.meta[key]`` or ``something.meta.get(key)``."""
    inside = [
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Subscript)
        or (isinstance(node, ast.Attribute) and node.attr == "get")
    ]
    return any(isinstance(value, ast.Attribute) and value.attr == "meta" for value in inside)


def readers(folder):
    """Files outside `observations` that read metadata by key."""
    texts = {
        path.relative_to(folder).as_posix(): path.read_text(encoding="utf-8")
        for path in folder.rglob("*.py")
    }
    return {
        name
        for name, text in texts.items()
        if not name.startswith("observations/")
        and ".meta" in text
        and reads_metadata(ast.parse(text))
    }


def test_code_reads_facts_and_never_the_metadata_of_users(tmp_path):
    # There a file of centroids is opened, in whose metadata all else stands under one key.
    assert readers(PACKAGE) <= {"images/centroids.py"}
    (tmp_path / "sky").mkdir()
    for line in ('obs.meta["site"]\n', 'obs.meta.get("site")\n'):
        (tmp_path / "sky" / "bad.py").write_text(line)
        assert readers(tmp_path) == {"sky/bad.py"}


def test_facts_come_from_metadata_and_the_rest_is_the_users_own():
    obs = table(directions="catalogue", observer="space", note="my own", seed=3)
    assert obs.origin == Origin(directions="catalogue", observer="space", seed=3)
    assert obs.origin.plain() == {"directions": "catalogue", "observer": "space", "seed": 3}
    assert obs.meta["note"] == "my own"
    moved = obs.with_origin(directions="apparent", low_stars=0)
    assert moved.origin.apparent and moved.origin.low_stars == 0
    assert moved.meta == {**obs.meta, "directions": "apparent", "low_stars": 0}
    assert dataclasses.replace(obs, meta={}).origin == Origin()
    assert moved.data_hash == obs.data_hash
    # What a message advises, to set an entry, has its effect too.
    moved.meta["directions"] = "catalogue"
    assert moved.origin.directions == "catalogue"


@pytest.mark.parametrize("ending", [".ecsv", ".parquet", ".fits"])
def test_files_keep_facts_beside_the_words_of_the_user(tmp_path, ending):
    obs = table(source="identified in Gaia", site={"latitude_deg": 48.0}, note="mine")
    obs.save(tmp_path / f"stars{ending}")
    again = load_observations(tmp_path / f"stars{ending}")
    assert again.origin == dataclasses.replace(obs.origin, ignored_columns=[])
    assert again.origin.from_images and again.meta["note"] == "mine"


def test_a_fact_has_one_of_the_known_names_and_values():
    with pytest.raises(TypeError):
        table().with_origin(observr="space")
    with pytest.raises(ObservationError):
        table(directions="nice")
    assert not table(source="simulated, then identified in part").origin.from_images
    # Words are those of a mission; a number of frames says nothing of which frames they are.
    assert table(frames="a mission").origin.frames == "a mission"
    assert table(frames=20).origin.frames is None
    assert np.all([table(observer=one).origin.without_air for one in ("space", "rendered")])
