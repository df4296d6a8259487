"""The mutants of sources, on planted files."""

from __future__ import annotations

import pytest

from verification import mutation

pytestmark = pytest.mark.slow


MUTATED = """
'''A sentence - and its sign.'''
_BLOCK = 5

def f(x: int, n=3):
    if x < n and not n:
        raise ValueError("a" + f"{x - 1}")
    # A comment - here.
    return g(x.T[: x + 1], axis=-1, strict=True)
"""


def test_mutants_change_mathematics_and_leave_sentences(tmp_path, monkeypatch):
    monkeypatch.setattr(mutation, "ROOT", tmp_path)
    (tmp_path / "made.py").write_text(MUTATED, "utf-8")
    found = {mutant.source(MUTATED): mutant.what for mutant in mutation.mutants("made.py")}
    changed = {
        (old, new): what
        for text, what in found.items()
        for old, new in zip(MUTATED.splitlines(), text.splitlines(), strict=True)
        if old != new
    }
    for text in found:
        compile(text, "made.py", "exec")
    condition, returned = MUTATED.splitlines()[5], MUTATED.splitlines()[8]
    assert {new.strip(): what for (old, new), what in changed.items() if old == condition} == {
        "if not (x < n and not n):": "condition negated",
        "if x < n or not n:": "logic",
        "if x >= n and not n:": "comparison",
        "if x < n and (n):": "sign",
    }
    assert {
        new.partition("return ")[2]: what for (old, new), what in changed.items() if old == returned
    } == {
        "None": "nothing returned",
        "g(x[: x + 1], axis=-1, strict=True)": "transpose dropped",
        "g(x.T[: (x + 1) - 1], axis=-1, strict=True)": "slice",
        "g(x.T[: x - 1], axis=-1, strict=True)": "arithmetic",
        "g(x.T[: x + 2], axis=-1, strict=True)": "constant",
    }
    assert {old for old, _ in changed} == {condition, returned, "def f(x: int, n=3):"}


def test_a_function_becomes_its_mutant_wherever_it_is_held(tmp_path, monkeypatch):
    """Behind a cache, as a method and in a list; a change outside functions has to be imported
    anew.
    """
    monkeypatch.setattr(mutation, "ROOT", tmp_path)
    text = (
        "from functools import cache\nLIMIT = 3.0\n@cache\ndef f(x, n=2.0):\n    return x + n\n"
        "class A:\n    def g(self):\n        return (lambda y: y - 1.0)(5.0)\n"
    )
    (tmp_path / "made.py").write_text(text, "utf-8")
    space: dict = {"__name__": "made"}
    exec(compile(text, str(tmp_path / "made.py"), "exec"), space)
    live = mutation.functions_of(["made.py"])
    found = {mutant.source(text): mutant for mutant in mutation.mutants("made.py")}
    for old, new in (("x + n", "x - n"), ("n=2.0", "n=4.0"), ("y - 1.0", "y + 1.0")):
        for change in mutation.changes(found[text.replace(old, new)], text, live):
            change()
    assert mutation.changes(found[text.replace("3.0", "6.0")], text, live) == []
    # One change at a time: the last default stays, the last code counts.
    assert (space["f"](1.0), space["A"]().g()) == (-3.0, 6.0)
