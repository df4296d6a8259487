"""Run files: the command `run` as a TOML table ``[run]``.

Keys are the long names of the command's options, with underscores; `inputs` and `camera` are its
files, and `out` is its folder. Relative paths start at the folder of the file. A run writes the
file that repeats it.
"""

from __future__ import annotations

import datetime
import tomllib
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from starcal_uq.core.conflicts import parsed, without, words_of
from starcal_uq.core.errors import RunFileError
from starcal_uq.core.files import atomic_write_text, ensure_new
from starcal_uq.core.toml import read_section, unknown_key
from starcal_uq.core.types import AnyDict, PathLike

NAME = "run.toml"
_FILES = ("inputs", "camera")
_HEADER = """\
# Options of a run, by their long names on the command line (see `run --help-all`), with underscores.
# Relative paths start at the folder of this file.
"""
_TEMPLATE = (
    _HEADER
    + """\
[run]
inputs = ["stars.csv"]        # a table of identified stars, or images
camera = "camera.toml"        # the nominal camera; images can do without
out = "run"                   # the folder of results
seed = 0
# directions = "apparent"     # or "catalogue", with a time_utc column
# site = "site.toml"          # where on the ground the camera stood
# in_space = true             # the camera was above the air
# effects = "auto"            # or names, such as "field,frame"
# budget = "budget.toml"      # contributors that the data cannot know, and requirements
# [run.column]                # columns that have another name or unit
# ra_deg = "RA [h] * 15"
"""
)


def write_template(path: PathLike, force: bool = False) -> None:
    """Write a run file to start from, with comments."""
    ensure_new(path, force)
    atomic_write_text(path, _TEMPLATE)


def written(words: Sequence[str]) -> str:
    """The file that repeats a command line ``run ...`` in the folder in which the file is."""
    import tomli_w

    (_, *places), options = parsed(words)
    table: AnyDict = {"inputs": places}
    if len(places) > 1 and places[-1].lower().endswith(".toml"):
        table = {"inputs": places[:-1], "camera": places[-1]}
    table["out"] = "."
    for option, values in options.items():
        found = [_value(word) for word in values]
        table[option[2:].replace("-", "_")] = found[0] if len(found) == 1 else found
    return _HEADER + tomli_w.dumps({"run": table})


def _value(word: str | None) -> Any:
    """What a word of the command line is in TOML: a number, a text, true for one that is not
    there.
    """
    if word is None:
        return True
    with suppress(tomllib.TOMLDecodeError):
        value = tomllib.loads(f"value = {word}").get("value")
        if type(value) in (int, float):
            return value
    return word


def expanded(
    path: Path, rest: Sequence[str], known: Collection[str], paths: Collection[str]
) -> list[str]:
    """The command line of a run file and what is typed after it, which goes before the file.

    Parameters
    ----------
    path : Path
        The file.
    rest : sequence of str
        Options; ``--set KEY=VALUE`` changes a key, and without a value removes it.
    known : collection of str
        Keys that a file may have, but `inputs` and `camera`.
    paths : collection of str
        Those of them that are paths.

    Raises
    ------
    RunFileError
        If the file cannot be read, or has a key or a value that no option has.
    """
    table = _checked(path, read_section(path, "run", RunFileError), known)
    words: list[str] = []
    changed: set[str] = set()
    left = iter(rest)
    for word in left:
        option, equals, value = word.partition("=")
        if option == "--set":
            key, equals, value = (value if equals else next(left, "")).partition("=")
            if not equals:
                raise RunFileError(f"--set {key} is not KEY=VALUE, such as seed=7.")
            _checked(Path("--set"), {key: value}, known)
            # What is changed last counts, be it an option or a key.
            words, _ = without(words, _option(key))
            table.pop(key, None)
            if value and key in _FILES:
                table[key], changed = value, changed | {key}
            elif value:
                words += _words({key: {"true": True, "false": False}.get(value, value)})
        else:
            words.append(word)
            if option.startswith("-o"):
                table.pop("out", None)
            elif option.startswith("--"):
                table.pop(option[2:].replace("-", "_"), None)
    if not table.get("inputs"):
        raise RunFileError(f'{path}: key inputs is missing; add inputs = ["stars.csv"].')
    for key in {*paths, *_FILES} & set(table) - changed:
        table[key] = _beside(path.parent, key, table[key])
    return ["run", *_words(table), *words]


def edited(given: Mapping[str, Any], wanted: Mapping[str, Any]) -> tuple[str, ...]:
    """Values of ``--set`` that make other options of those of a run file, both by the names that
    the rules have for them (`core.conflicts`).
    """
    changes = dict.fromkeys(given.keys() - wanted.keys(), "")
    changes |= {name: value for name, value in wanted.items() if given.get(name) != value}
    found = []
    for name, value in changes.items():
        option, *words = words_of({name: value})
        found.append(f"{option[2:].replace('-', '_')}={words[0] if words else 'true'}")
    return tuple(found)


def _checked(path: Path, table: AnyDict, known: Collection[str]) -> AnyDict:
    for key, value in table.items():
        if key not in (names := (*_FILES, *known)):
            problem = unknown_key(key, names)
            raise RunFileError(f"{path}: {problem}{'' if problem.endswith('?') else '.'}")
        plain = value if isinstance(value, list) else [value]
        if key == "inputs" and not (plain and all(isinstance(one, str) for one in plain)):
            raise RunFileError(f'{path}: key inputs has no files; write inputs = ["stars.csv"].')
        nested = plain if not isinstance(value, dict) else value.values()
        if any(isinstance(one, list | dict) for one in nested):
            raise RunFileError(f"{path}: key {key} is nested too deeply; write plain values.")
    return dict(table)


def _beside(folder: Path, key: str, value: Any) -> Any:
    """A path from the folder of the file, where it is one: other words may stand for it."""
    if isinstance(value, list):
        return [_beside(folder, key, one) for one in value]
    if not isinstance(value, str):
        return value
    file = folder / value
    return str(file) if key in (*_FILES, "out") or file.exists() or Path(value).suffix else value


def _words(table: Mapping[str, Any]) -> list[str]:
    """A table as it is typed."""
    words: list[str] = []
    for key in _FILES:
        value = table.get(key, [])
        words += value if isinstance(value, list) else [value]
    for key, value in table.items():
        if key in _FILES or value is False:
            continue
        option = _option(key)
        if isinstance(value, dict):
            pairs = [f"{name}={_word(one)}" for name, one in value.items()]
            value = pairs if key == "column" else ",".join(pairs)
        for one in value if isinstance(value, list) else [value]:
            words += [option] if one is True else [option, _word(one)]
    return words


def _option(key: str) -> str:
    return f"--{key.replace('_', '-')}"


def _word(value: Any) -> str:
    return value.isoformat() if isinstance(value, datetime.date) else str(value)
