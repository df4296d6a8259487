"""The commands that run the paper again: reproduce, reproduce-field."""

from __future__ import annotations

from pathlib import Path

from starcal_uq.cli.answers import Answer
from starcal_uq.cli.console import print_table, progress_bar, say
from starcal_uq.core import settings

# Of the page's table, what a terminal has room for.
_COLUMNS = ("Place", "Number", "Printed", "Ours", "z", "Outcome")


def reproduce_command(
    out: Path,
    replicates: int = 200,
    frames: int = 1000,
    convention: settings.Convention = "eq14",
    study: bool = True,
    workers: int | None = None,
    seed: int = 2017,
    force: bool = False,
) -> Answer:
    """Run Ye & Yang 2017 again: each of its numbers beside ours, with the uncertainty that they
    lack.
    """
    from starcal_uq.paper.reproduction import reproduce
    from starcal_uq.paper.show.tables import printed_numbers

    with progress_bar("reproduction") as progress:
        found = reproduce(
            out,
            n_replicates=replicates,
            n_frames=frames,
            seed=seed,
            convention=convention,
            workers=workers,
            progress=progress,
            study=study,
            force=force,
        )
    title = "What the paper prints, and mean ± spread over seeds under the main reading"
    print_table(printed_numbers(found.judged).part(_COLUMNS, title))
    say(found.text)
    say(f"Report: {found.report.resolve()}")
    return Answer({"report": found.report, "published": found.published(), "text": found.text})


def reproduce_field_command(
    out: Path,
    frames: int = 200,
    reading: settings.FieldReading = "window",
    replicates: int = 100,
    workers: int | None = None,
    seed: int = 2017,
    force: bool = False,
) -> Answer:
    """The paper's Table 3 from rendered frames: identification and attitude with four cameras, and
    why they differ.
    """
    from starcal_uq.paper.field.experiment import field_experiment
    from starcal_uq.paper.show.field import table_3

    with progress_bar("field experiment") as progress:
        found = field_experiment(
            out,
            n_frames=frames,
            n_calibration_frames=frames,
            reading=reading,
            seed=seed,
            n_replicates=replicates,
            workers=workers,
            progress=progress,
            force=force,
        )
    print_table(table_3(found))
    say(found.text)
    say(f"Report: {found.report.resolve()}")
    return Answer({"report": found.report, "table_3": found.table_3(), "text": found.text})
