"""The first page of a report and the last lines in a terminal: what to decide by, and what to do
next.
"""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from starcal_uq.budgeting.rows import confidence_text
from starcal_uq.core.remedy import RUN, Remedy
from starcal_uq.core.status import Check, Level, Question
from starcal_uq.diagnostics.verdict.remedies import MOST_COMMANDS
from starcal_uq.presentation.html import WIDTH, template_environment, wrapped
from starcal_uq.presentation.report.tables import parameter_rows
from starcal_uq.presentation.words.numbers import both, bound
from starcal_uq.presentation.words.sentences import say, told

if TYPE_CHECKING:
    from starcal_uq.diagnostics.verdict.judge import Verdict
    from starcal_uq.presentation.report.results import Results


def conclusion(verdict: Verdict) -> str:
    """The headline; the data that would tell more are for when there is nothing left to try."""
    later = {} if verdict.ended else {"data": ()}
    return replace(verdict.summary, values=verdict.summary.values | later).sentence


def later(verdict: Verdict) -> str:
    """The data that would tell more, where there is something to try first."""
    asked = verdict.summary.values.get("data")
    return "" if verdict.ended or not asked else say("Part.telling", data=asked, tried=None)


def causes(verdict: Verdict) -> tuple[list[tuple[Check, str]], str]:
    """Each cause of doubt once: its first check, and the others that show it; behind one that
    failed, in one sentence, what may follow from it.
    """
    found: list[tuple[Check, str]] = []
    behind: list[Check] = []
    failed = ""
    for cause, (first, *others) in verdict.causes.items():
        if failed:
            behind += [first, *others]
            continue
        found.append((first, say("Part.same_cause", cause=cause, checks=others)))
        failed = cause if first.level is Level.FAIL else ""
    return found, say("Part.behind", cause=failed, checks=behind)


def next_steps(results: Results) -> list[tuple[str, str]]:
    """Commands to go on with, three at most, each with what it is for where nothing failed."""
    steps = [(command, "") for command in results.verdict.commands]
    if steps:
        return steps
    steps = [(part.remedy.command, told("missing", part)) for part in results.missing]
    if results.budget is not None and results.budget.not_assessed and not results.failed:
        template = Remedy("budget", (RUN,), {"template": "budget.toml"})
        steps.append((results.command(template), told("to_assess", results.budget)))
    return steps[:MOST_COMMANDS]


def terminal_summary(results: Results) -> list[str]:
    """The run in lines of at most 80 columns, without the verdict; commands can be copied."""
    found, behind = causes(results.verdict)
    text = (
        template_environment()
        .get_template("summary.txt.j2")
        .render(
            {one.__name__: one for one in (Level, Question, both, bound, confidence_text, zip)},
            results=results,
            rows=parameter_rows(results),
            causes=found,
            behind=behind,
            shell=_shell,
        )
    )
    # A filter of nothing leaves an empty line.
    return [line.rstrip() for line in text.splitlines() if line.strip()]


def verdict_lines(verdict: Verdict) -> list[str]:
    """The verdict in at most 80 columns."""
    return wrapped(f"Verdict ({verdict.level.value}): {conclusion(verdict)}").splitlines()


def _shell(text: str) -> str:
    """A command, from the current folder, over lines that a shell puts together again."""
    lines = ["  try:"]
    for word in shlex.split(text):
        near = word.removeprefix(f"{Path.cwd()}/")
        written = word if word == "&&" else shlex.quote(near)
        # Room for the backslash.
        if len(lines[-1]) + len(written) + 3 > WIDTH and lines[-1].strip():
            lines.append("     ")
        lines[-1] += f" {written}"
    return " \\\n".join(lines)
