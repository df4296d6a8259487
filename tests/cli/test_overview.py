"""The help of the program holds the first sentence of each command, which it does not load."""

from __future__ import annotations

import inspect

from starcal_uq.cli.commands import app
from starcal_uq.cli.overview import COMMANDS, LISTED, overview


def test_the_list_of_commands_is_that_of_their_docstrings_and_options():
    for name, (_, words) in COMMANDS.items():
        said = inspect.unwrap(app.commands[name].callback).__doc__
        assert " ".join(said.partition("\n\n")[0].split()) == words.strip(), name
    options = [name for name in LISTED["Options"] if name != "--help"]
    assert options == [option for one in app.params for option in one.opts]


def test_each_command_stands_on_a_line_under_what_it_is_for(monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    lines = overview().splitlines()
    assert max(map(len, lines)) <= 60
    places = [lines.index(f"{group}:") for group in LISTED]
    named = [line.split()[0] for line in lines if line[:2] == "  " and line[2:3].strip()]
    assert places == sorted(places) and named[len(LISTED["Options"]) :] == list(COMMANDS)
