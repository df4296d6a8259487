"""Run files on the command line: ``run FILE.toml`` in place of what the file holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

# Parameters that no result depends on.
_OF_THE_CALL = ("json", "edits", "quiet", "verbose", "help_all")
# The words of a call that names a run file, as they were typed.
_typed: list[str] = []


def typed() -> Sequence[str]:
    """The words that were typed where they name a run file; none otherwise."""
    return _typed


def expand(words: Sequence[str], commands: Mapping[str, Any]) -> list[str]:
    """A command line in which a run file is replaced by what it holds."""
    _typed.clear()
    if not _names_a_file(words):
        return list(words)
    from starcal_uq.cli.options import PATHS
    from starcal_uq.core.runfile import expanded

    keys = run_keys(commands)
    paths = {key for key, name in keys.items() if name in PATHS}
    found = expanded(Path(words[1]), words[2:], keys, paths)
    _typed[:] = words
    return found


def _names_a_file(words: Sequence[str]) -> bool:
    if len(words) < 2 or words[0] != "run" or not words[1].lower().endswith(".toml"):
        return False
    path = Path(words[1])
    return path.is_file() and b"[run" in path.read_bytes()


def run_keys(commands: Mapping[str, Any]) -> Mapping[str, str]:
    """Key of a run file -> parameter of the command `run`."""
    return {
        option[2:].replace("-", "_"): parameter.name
        for parameter in commands["run"].params
        for option in parameter.opts
        if option.startswith("--") and parameter.name not in _OF_THE_CALL
    }
