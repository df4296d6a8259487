"""A bar is one line, in a notebook and in a terminal, and nothing elsewhere."""

import sys
from types import SimpleNamespace
from typing import Any

import pytest

from starcal_uq.cli import console
from starcal_uq.core import progress
from starcal_uq.core.progress import ProgressBar


def test_a_notebook_gets_one_output_that_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[Any] = []

    def publish(data: Any, transient: Any, update: bool) -> None:
        shown.append((transient["display_id"], update, data))

    shell = SimpleNamespace(kernel=True, display_pub=SimpleNamespace(publish=publish))
    monkeypatch.setattr(progress, "_shell", lambda: shell)
    monkeypatch.setattr(progress, "_EVERY_S", 0.0)
    bar = ProgressBar("a <step>")
    for done in range(1, 4):
        bar(done, 3)
    assert len({place for place, _, _ in shown}) == 1
    assert [update for _, update, _ in shown] == [False, True, True]
    assert shown[-1][2]["text/plain"] == "a <step> 3 of 3"
    assert "a &lt;step&gt;" in shown[0][2]["text/html"]


@pytest.mark.parametrize(
    ("terminal", "said"), [(True, "\rstep 1 of 900\rstep 900 of 900\n"), (False, "")]
)
def test_a_terminal_gets_one_line_and_a_file_nothing(terminal, said, monkeypatch, capsys):
    monkeypatch.setattr(progress, "_shell", lambda: None)
    monkeypatch.setattr(progress, "_EVERY_S", 1e6)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    bar = ProgressBar("step")
    for done in range(1, 901):
        bar(done, 900)
    assert capsys.readouterr().err == said


def test_commands_of_a_notebook_draw_no_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hundreds of states of it would stay in the notebook's file."""
    monkeypatch.setattr(console, "err", SimpleNamespace(is_terminal=True))
    monkeypatch.setattr(console, "_IN_NOTEBOOK", True)
    with console.progress_bar("sampling") as bar:
        assert bar is None
