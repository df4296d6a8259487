"""Results as tables and sentences in the terminal."""

from __future__ import annotations

import logging
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from starcal_uq.core.status import Advice, Level, Note, Order
from starcal_uq.core.types import AnyDict, Progress
from starcal_uq.presentation.tables import TextTable

if TYPE_CHECKING:
    from pathlib import Path

    from starcal_uq.calibration.screening.result import Screening
    from starcal_uq.camera.camera import Camera
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.partitions import PartitionedObservations
    from starcal_uq.observations.table import Observations
    from starcal_uq.propagation.attitude_error import AttitudeError
    from starcal_uq.propagation.coupling import Coupling
    from starcal_uq.runs.run import Run

# `!starcal-uq` of a notebook has a terminal of 80 columns, which keeps every state of a bar.
_IN_NOTEBOOK = "JPY_PARENT_PID" in os.environ
# What is no terminal has no width of its own: tables get the room that they need there, or what
# COLUMNS says.
_WIDTH = None if (sys.stdout.isatty() and not _IN_NOTEBOOK) or "COLUMNS" in os.environ else 110
# Kinds of lines on standard error that -q keeps: a user can act on them.
_ACTED_ON = ("warning", "violated")
_notes = True
STYLES = {Level.PASS: "green", Level.WARN: "yellow", Level.FAIL: "red"}
# Names of files, runs and requirements may hold square brackets and colons, which are no markup.
out = Console(width=_WIDTH, markup=False, emoji=False, highlight=False)
err = Console(stderr=True, markup=False, emoji=False, highlight=False)


def say(words: str, style: str | None = None) -> None:
    """A sentence, or a few lines, of the answer: on standard output."""
    out.print(words, style=style, soft_wrap=True)


def tell(words: str) -> None:
    """What a user should know beside the answer: on standard error; notes and warnings in
    colour.
    """
    kind = words.partition(":")[0]
    if not _notes and kind not in _ACTED_ON:
        return
    err.print(
        words,
        style={"note": "yellow", "warning": "yellow", "violated": "red"}.get(kind),
        soft_wrap=True,
    )


@contextmanager
def talking(*, tables: bool, notes: bool, steps: bool) -> Iterator[None]:
    """Choose what a command prints: tables on standard output, which documents need for themselves,
    notes and bars on standard error, and a line of the log for every step.
    """
    global _notes
    out.quiet, _notes = not (tables and notes), notes
    log = logging.getLogger("starcal_uq")
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(name)s: %(message)s"))
    if steps:
        log.addHandler(handler)
        log.setLevel(logging.INFO)
    try:
        yield
    finally:
        out.quiet, _notes = False, True
        log.removeHandler(handler)
        log.setLevel(logging.NOTSET)


def show_calibration(calibration: Calibration, truth: Camera | None = None) -> None:
    """Table of start, estimate and sigma; with a truth, also truth and z."""
    from starcal_uq.presentation.words.effects import effects_table
    from starcal_uq.presentation.words.estimation import calibration_table
    from starcal_uq.presentation.words.sentences import say as wording
    from starcal_uq.presentation.words.sentences import told

    print_table(calibration_table(calibration, truth))
    say(
        f"Focal length {told('focal_length', calibration)}. Status: {calibration.status.name.lower()}."
    )
    if calibration.camera.pixel_um is None:
        say(wording("Part.pitch_unknown"))
    effects = None if calibration.effects is None else effects_table(calibration.effects)
    if effects is not None:
        print_table(effects)
    for name in ("fitted_noise", "decided"):
        for words in told(name, calibration).splitlines():
            say(words)


def show_posterior(posterior: Posterior) -> None:
    """Table of posterior means, intervals and diagnostics."""
    from starcal_uq.presentation.words.inference import posterior_table

    print_table(posterior_table(posterior))
    diagnostics = posterior.diagnostics
    for check in diagnostics.checks:
        say(f"- {check}", style=STYLES[check.level])


def note(message: str) -> None:
    """Tell what a user should know, on standard error."""
    tell(f"note: {message}")


def print_table(table: TextTable) -> None:
    """Draw a table; its marks become colours."""
    # Words and numbers are never cut off: a table that is too wide with its lines goes without
    # them.
    columns = [[head, *cells] for head, *cells in zip(table.heads, *table.rows, strict=True)]
    least = [
        max((len(word) for cell in column for word in cell.split()), default=1)
        for column in columns
    ]
    words = table.align.index("r") if "r" in table.align else len(least)
    if sum(least) + len(least) - 1 > out.width and len(least) > words + 1:
        # Numbers are not broken: the rest of the columns follows beside the words once more.
        half = (words + len(least) + 1) // 2
        heads = table.heads
        print_table(table.part(heads[:half], table.title))
        print_table(table.part((*heads[:words], *heads[half:]), ""))
        return
    wide = sum(least) + 3 * len(least) + 1 > out.width
    widths = [max(map(len, column)) for column in columns]
    gap = int(sum(least) + 2 * len(least) - 1 <= out.width)
    spare = out.width - ((1 + gap) * len(least) - 1 if wide else 3 * len(least) + 1)
    while (
        sum(widths) > spare
    ):  # the console's own shares would be cut off at its edge; words break last
        place = max(range(len(least)), key=lambda i: (widths[i] - least[i], widths[i]))
        widths[place] -= 1
    look: AnyDict = (
        {"box": SIMPLE_HEAD, "padding": (0, gap, 0, 0), "show_edge": False} if wide else {}
    )
    drawn = Table(title=table.title or None, title_justify="left", **look)
    for place, (head, side) in enumerate(zip(table.heads, table.align, strict=True)):
        style = "bold" if place == 0 and side == "l" else None
        justify: Any = "right" if side == "r" else "left"
        drawn.add_column(head, justify=justify, style=style, width=widths[place], overflow="fold")
    styles = {"total": "bold", "warning": "yellow", "fail": "red"}
    for row, mark in zip(table.rows, table.marks or ("",) * len(table.rows), strict=True):
        drawn.add_row(*row, style=styles.get(mark))
    out.print(drawn)


def show_coupling(coupling: Coupling) -> None:
    """Sigmas and their inflation, correlations, and the weak directions in words."""
    from starcal_uq.presentation.words.propagation import correlation_table, coupling_table

    print_table(coupling_table(coupling))
    print_table(correlation_table(coupling))
    for direction in coupling.weak_directions:
        say(f"- {direction.words}")


def show_attitude(error: AttitudeError) -> None:
    """Attitude error by contributor and axis, 1 sigma, and what follows."""
    from starcal_uq.presentation.words.propagation import (
        attitude_table,
        onboard_table,
        thermal_table,
    )

    print_table(attitude_table(error))
    if error.variants:
        print_table(onboard_table(error))
    if error.thermal is not None:
        print_table(thermal_table(error.thermal))


def show_screening(screening: Screening) -> None:
    """What was left out, by reason, and what a user should look at."""
    say(screening.text)


def show_summary(run: Run, page: Path) -> None:
    """The run in a screen of 80 columns, with what to try, the place of the report, and the verdict
    last.
    """
    from starcal_uq.presentation.report.summary import terminal_summary, verdict_lines

    results = run.results
    for line in ("", *terminal_summary(results), f"Report: {page.resolve()}"):
        say(line)
    style = STYLES[results.verdict.level]
    for line in verdict_lines(results.verdict):
        say(line, style=style)


def warn_air(obs: Observations | PartitionedObservations, cal: Calibration) -> None:
    """Say what refraction does to the focal length where nothing is known of the air."""
    from starcal_uq.diagnostics.verdict.observed import refraction

    found = refraction(obs, cal)
    if found is not None and found.code is Note.CONDITIONAL_ON_REFRACTION:
        site = Order(Advice.STATE_THE_SITE)
        tell(f"warning: {found.sentence} {site.sentence}")


def warn_undeclared(obs: Observations | PartitionedObservations, camera: Camera) -> None:
    """Say what follows for this camera when nothing is known of the observer's motion, and what was
    left out.
    """
    from starcal_uq.diagnostics.verdict.observed import aberration_size
    from starcal_uq.presentation.words.sentences import told

    for words in told("input_notes", obs, aberration=aberration_size(camera)).splitlines():
        tell(words)


@contextmanager
def progress_bar(label: str) -> Iterator[Progress | None]:
    """Yield a function ``(done, total)`` that moves a bar; None where nobody would see it."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    if not (err.is_terminal and _notes) or _IN_NOTEBOOK:
        yield None
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=err, transient=True) as bar:
        task = bar.add_task(label, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


@contextmanager
def working(label: str) -> Iterator[Progress | None]:
    """A bar for a step; what the likelihood of a sampling warns of is printed after it."""
    from starcal_uq.inference.named import NaivePairsWarning

    with progress_bar(label) as progress, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", NaivePairsWarning)
        yield progress
    for warning in caught:
        tell(f"warning: {warning.message}")
