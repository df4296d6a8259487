"""Commands as a user types them, settings of short runs, and what is in a folder."""

from __future__ import annotations

import json
import shlex
import sys

import jsonschema
import pytest

from starcal_uq.cli.app import main
from starcal_uq.cli.schemas import PREFIX, json_schema

SMALL = ["--walkers", "32", "--steps", "80"]


def files(folder):
    return {
        p.relative_to(folder): (p.read_bytes() if p.is_file() else None)
        for p in sorted(folder.rglob("*"))
    }


def check_document(text, status):
    """A document, alone, with the numbers that JSON has, as its schema says."""

    def refuse(word):
        raise AssertionError(f"{word} is no JSON")

    document = json.loads(text, parse_constant=refuse)
    jsonschema.validate(document, json_schema(document["schema"].removeprefix(PREFIX)))
    assert document["exit_status"] == status
    return document


class Commands:
    """Commands of one process, each given as the text that a user types or as its words."""

    def __init__(self, monkeypatch, capsys):
        self.monkeypatch, self.capsys = monkeypatch, capsys

    def __call__(self, *words):
        """Status, standard output and standard error; a document is validated."""
        words = shlex.split(words[0]) if len(words) == 1 else [*map(str, words)]
        self.monkeypatch.setattr(sys, "argv", ["starcal-uq", *words])
        with pytest.raises(SystemExit) as stop:
            main()
        captured = self.capsys.readouterr()
        code = stop.value.code or 0
        if "--json" in words:
            check_document(captured.out, code)
        return code, captured.out, captured.err

    def ok(self, *words, among=(0,)):
        """Standard output and standard error of a command that ends well."""
        status, out, err = self(*words)
        assert status in among, (words, status, err)
        return out, err

    def document(self, *words, among=(0,)):
        """The document with which it answers."""
        words = [*(shlex.split(words[0]) if len(words) == 1 else words), "--json"]
        return json.loads(self.ok(*words, among=among)[0])

    def refuses(self, said, *words):
        """Standard error of a command that ends with one sentence, which holds some words."""
        status, _, err = self(*words)
        assert status == 2 and "Traceback" not in err, (words, status, err)
        assert err.splitlines()[-1].startswith("error: ") and err.count("error: ") == 1, err
        assert said in " ".join(err.split()), (words, err)
        return err
