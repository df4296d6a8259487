"""Planted misfits, and what is printed to try against each, followed literally to its end.

    python verification/remedies.py [--only WORD] [--seed 7] [--write]

Each misfit is planted in a table of 24 frames of 20 stars (16 frames at one place on the ground for
refraction), made by NumPy alone, and run by the command line. The first command that is printed to
try is executed as it stands, and so on, until none is printed. A chain that does not run, changes
nothing, gives an option twice or comes back to where it was stops the script. ``--write`` puts the
table into the documentation (`docs/explanation/misfit.md`).
"""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

from benchmarks.pages import put  # noqa: E402
from starcal_uq.cli import console  # noqa: E402
from starcal_uq.cli.app import main as program  # noqa: E402
from starcal_uq.presentation.report import drawing  # noqa: E402
from tests.helpers.painting import without_painting  # noqa: E402
from tests.helpers.remedy_chains import PLANTED, Step, follow, plant, row  # noqa: E402

PAGE = ROOT / "docs" / "explanation" / "misfit.md"
HEADS = ("Misfit", "Failed, warned", "What was tried, with what then failed and warned", "End")


def call(words: Sequence[str]) -> tuple[int, str, str]:
    """Run a command in this process."""
    sys.argv = ["starcal-uq", *words]
    out, err, status = io.StringIO(), io.StringIO(), 0
    console.out.file, console.err.file = out, err
    with redirect_stdout(out), redirect_stderr(err):
        try:
            program()
        except SystemExit as stop:
            status = int(stop.code or 0)
    return status, out.getvalue(), err.getvalue()


def chain(name: str, seed: int) -> list[Step]:
    """The steps against one misfit."""
    with TemporaryDirectory() as folder:
        return follow(call, plant(name, Path(folder), seed), Path(folder))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", help="misfits whose names hold this word")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--write", action="store_true", help="put the table into the documentation")
    arguments = parser.parse_args()
    # Figures take most of the time of a run.
    drawing.draw_figures = lambda _results, names, _progress: dict.fromkeys(names, b"<svg/>")
    together: dict[tuple[str, ...], list[str]] = {}
    with without_painting():
        for name in PLANTED:
            if arguments.only in name:
                _, *outcome = row(name, chain(name, arguments.seed))
                together.setdefault(tuple(outcome), []).append(name)
                print(name, *outcome, sep=" | ", flush=True)
    if arguments.write:
        note = f"Made by `python verification/remedies.py --seed {arguments.seed} --write`; do not edit."
        # Misfits with one outcome share a row.
        rows = [HEADS, ["---"] * 4, *(("; ".join(v), *key) for key, v in together.items())]
        table = "\n".join(f"| {' | '.join(line)} |" for line in rows)
        put(PAGE, "remedies", f"{note}\n\n{table}")


if __name__ == "__main__":
    main()
