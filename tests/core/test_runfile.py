"""A run file and the command line are two forms of the same options."""

import tomllib
from pathlib import Path

import pytest

from starcal_uq.core.conflicts import parsed
from starcal_uq.core.errors import RunFileError
from starcal_uq.core.runfile import edited, expanded, write_template, written

KNOWN = ("out", "seed", "site", "in_space", "effects", "column", "start", "time", "alignment")
PATHS = ("out", "site", "alignment")


def expand(folder, text, *rest):
    path = Path(folder) / "run.toml"
    path.write_text(text, encoding="utf-8")
    return expanded(path, rest, KNOWN, PATHS)


WORDS = [
    *("run", "/data/stars.csv", "/data/camera.toml", "--seed", "7", "--in-space"),
    *("--column", "ra_deg=RA [h] * 15", "--column", "x_px=X - 1", "--time", "2026-11-25T02:00:00"),
    *("--effects", "field,frame", "--start", "focal_mm=50.2,x0_px=511.5"),
]


def test_what_a_run_writes_is_the_command_that_made_it(tmp_path):
    words = expand(tmp_path, written(WORDS))
    assert words[:3] == WORDS[:3]
    options = parsed(words)[1]
    assert options.pop("--out") == (str(tmp_path),)
    assert options == parsed(WORDS)[1]
    images = expand(tmp_path, written(["run", "/data/a.fits", "/data/b.fits"]))
    assert images == ["run", "/data/a.fits", "/data/b.fits", "--out", str(tmp_path)]


def test_tables_and_toml_values_are_options_and_paths_start_at_the_file(tmp_path):
    (tmp_path / "here.toml").touch()
    words = expand(
        tmp_path,
        """[run]
inputs = ["stars.csv"]
camera = "../camera.toml"
out = "results"
site = "here.toml"
alignment = "random"
time = 2026-11-25T02:00:00
in_space = false
column = {ra_deg = "RA"}
start = {focal_mm = 50.2, x0_px = 511}
""",
    )
    assert words == [
        *("run", f"{tmp_path}/stars.csv", f"{tmp_path}/../camera.toml"),
        *("--out", f"{tmp_path}/results", "--site", f"{tmp_path}/here.toml"),
        *("--alignment", "random", "--time", "2026-11-25T02:00:00"),
        *("--column", "ra_deg=RA", "--start", "focal_mm=50.2,x0_px=511"),
    ]


def test_what_is_typed_goes_before_the_file(tmp_path):
    text = '[run]\ninputs = "a.csv"\nseed = 3\nsite = "site.toml"\nin_space = true\n'
    words = expand(tmp_path, text, "--seed=4", "--set", "site=other.toml", "--set=in_space=", "-oX")
    # What is typed is a path from where one stands.
    assert words == ["run", f"{tmp_path}/a.csv", "--seed=4", "--site", "other.toml", "-oX"]
    assert expand(tmp_path, text, "--set", "in_space=false")[-2:] == [
        "--site",
        f"{tmp_path}/site.toml",
    ]


def test_what_is_typed_last_counts_be_it_an_option_or_a_change_of_the_file(tmp_path):
    text = '[run]\ninputs = "a.csv"\neffects = "field"\n'
    given = ("--effects", "none", "--seed", "3", "--set", "effects=auto")
    assert expand(tmp_path, text, *given)[2:] == ["--seed", "3", "--effects", "auto"]
    given = ("--set", "effects=auto", "--set", "effects=", "--set", "inputs=b.csv")
    assert expand(tmp_path, text, *given) == ["run", "b.csv"]


def test_edits_make_other_options_of_those_of_a_file():
    given = {"in_space": True, "effects": "field", "seed": "3"}
    wanted = {"site": "s.toml", "effects": "field,frame", "seed": "3", "screening": True}
    assert set(edited(given, wanted)) == {
        *("in_space=", "site=s.toml", "effects=field,frame", "screen=true")
    }
    assert edited(given, given) == ()


@pytest.mark.parametrize(
    ("text", "rest", "said"),
    [
        ("[run]\nseed = 3\n", (), "key inputs is missing; add inputs = "),
        ("[run]\ninputs = []\n", (), "key inputs has no files"),
        ("[run]\ninputs = 3\n", (), "key inputs has no files"),
        ('[run]\ninputs = "a"\nsede = 3\n', (), "key sede is unknown; did you mean seed?"),
        ('[run]\ninputs = "a"\ncolumn = [["a"]]\n', (), "key column is nested too deeply"),
        ('[run]\ninputs = "a"\n[camera]\nx = 1\n', (), "camera stands outside section [run]"),
        ('[run]\ninputs = "a"\n', ("--set", "seed"), "--set seed is not KEY=VALUE"),
        ('[run]\ninputs = "a"\n', ("--set", "sede=3"), "--set: key sede is unknown"),
        ("[run\n", (), "not valid TOML"),
    ],
)
def test_what_is_wrong_with_a_file_is_one_sentence(tmp_path, text, rest, said):
    with pytest.raises(RunFileError) as error:
        expand(tmp_path, text, *rest)
    assert said in str(error.value) and str(error.value)[-1] in ".?"
    if not rest:
        assert str(tmp_path / "run.toml") in str(error.value)


def test_the_starter_has_keys_of_the_command_alone(tmp_path):
    from starcal_uq.cli.commands import app
    from starcal_uq.cli.runfiles import run_keys

    write_template(tmp_path / "run.toml")
    text = (tmp_path / "run.toml").read_text(encoding="utf-8")
    # With every line that is a comment made a key as well.
    whole = "\n".join(
        line.removeprefix("# ") if " = " in line or "[run.column]" in line else line
        for line in text.splitlines()
    )
    keys = tomllib.loads(whole)["run"].keys()
    assert len(keys) > 8 and keys - {"inputs", "camera"} <= run_keys(app.commands).keys()
