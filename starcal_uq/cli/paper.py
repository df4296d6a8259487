"""The commands that run the paper again: reproduce, reproduce-field."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from starcal_uq.cli.answers import Answer
from starcal_uq.cli.console import progress_bar, say, show_table
from starcal_uq.core import settings

if TYPE_CHECKING:
    import pandas as pd


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
