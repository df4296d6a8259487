"""The commands that run the paper again: reproduce, reproduce-field."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from starcal_uq.cli.answers import Answer
from starcal_uq.cli.console import progress_bar, say, show_table
from starcal_uq.cli.options import Force, Seed, Workers, number, write_path
from starcal_uq.core import settings

if TYPE_CHECKING:
    import pandas as pd


Out = Annotated[
    Path,
    typer.Option(
        "-o",
        "--out",
        metavar="DIR",
        help="Folder for report, tables and figures.",
        parser=write_path,
    ),
]


def reproduce_command(
    out: Out,
    replicates: Annotated[
        int,
        number("n_replicates", "Repetitions of the experiment, each with its own seed.", least=8),
    ] = 200,
    frames: Annotated[int, number("n_frames", "Frames in each.", least=20)] = 1000,
    convention: Annotated[
        settings.Convention,
        typer.Option(
            help="eq14 (ideal to distorted, as everybody's models) or eq6 (distorted to ideal)."
        ),
    ] = "eq14",
    study: Annotated[
        bool, typer.Option(help="Also study the interaction of optics and distortion.")
    ] = True,
    workers: Workers = None,
    seed: Seed = 2017,
    force: Force = False,
) -> Answer:
    """Run Ye & Yang 2017 again: each of its numbers beside ours, with the uncertainty that they
    lack.
    """
    from starcal_uq.paper.reproduction import reproduce

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
    published = found.published()
    show_table(_readable(published), "What the paper prints, and what comes out over seeds")
    say(found.text)
    say(f"Report: {found.report.resolve()}")
    return Answer({"report": found.report, "published": published, "text": found.text})


def reproduce_field_command(
    out: Out,
    frames: Annotated[
        int, number("n_frames", "Frames identified and solved; as many calibrate.", least=20)
    ] = 200,
    reading: Annotated[
        settings.FieldReading,
        typer.Option(
            help="window (the middle of a larger detector, 10.8 degrees) or full (all of it)."
        ),
    ] = "window",
    replicates: Annotated[
        int, number("n_replicates", "Repetitions behind the ranges of the errors.", least=20)
    ] = 100,
    workers: Workers = None,
    seed: Seed = 2017,
    force: Force = False,
) -> Answer:
    """The paper's Table 3 from rendered frames: identification and attitude with four cameras, and
    why they differ.
    """
    from starcal_uq.paper.field.experiment import field_experiment

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
    table = found.table_3()
    show_table(_readable_table_3(table), "Table 3: rates in %, errors in arcsec, with 95 % ranges")
    say(found.text)
    say(f"Report: {found.report.resolve()}")
    return Answer({"report": found.report, "table_3": table, "text": found.text})


def _readable(published: pd.DataFrame) -> pd.DataFrame:
    """The columns that fit a terminal, each number with the digits that its spread leaves it."""
    from starcal_uq.core.formatting import plus_minus

    table = published[["place", "method", "quantity", "printed"]].copy()
    table["ours"] = [
        plus_minus(mean, spread)
        for mean, spread in zip(published["main_mean"], published["main_spread"], strict=True)
    ]
    table["z"] = published["main_z"]
    table["outcome"] = published["outcome"]
    return table


def _readable_table_3(table: pd.DataFrame) -> pd.DataFrame:
    """The columns that fit a terminal: printed, ours as it stands, ours after alignment, and which
    of them agrees.
    """
    import pandas as pd

    from starcal_uq.core.formatting import significant

    def ranged(row: pd.Series, prefix: str, value: str) -> str:
        if pd.isna(row[value]):
            return ""
        ends = " to ".join(significant(float(row[f"{prefix}{end}"]), 3) for end in ("low", "high"))
        return f"{significant(float(row[value]), 3)} ({ends})"

    words = {
        "rate_percent": "rate",
        "pitch_arcsec": "pitch",
        "yaw_arcsec": "yaw",
        "roll_arcsec": "roll",
    }
    return pd.DataFrame(
        {
            "method": [method.replace("_", " ") for method in table["method"]],
            "": [words[quantity] for quantity in table["quantity"]],
            "printed": table["printed"],
            "true attitude": [ranged(row, "", "ours") for _, row in table.iterrows()],
            "after alignment": [ranged(row, "aligned_", "aligned") for _, row in table.iterrows()],
            "print agrees": table["agrees"],
        }
    )
