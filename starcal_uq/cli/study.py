"""Coupling studies: what couples with what, and what would decouple it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import starcal_uq as sc
from starcal_uq.cli.console import err, print_json, print_table, progress_bar
from starcal_uq.cli.console import out as console
from starcal_uq.cli.options import Force, Json, SchedulerAddress, number, write_file, write_path
from starcal_uq.core import settings


def study_command(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="STUDY", help="What is varied (TOML); --template writes one to start from.", parser=write_file
        ),
    ] = Path("study.toml"),
    out: Annotated[
        Path,
        typer.Option(
            "-o",
            "--out",
            metavar="DIR",
            help="Folder for cells, results and report; a study goes on in it.",
            parser=write_path,
        ),
    ] = Path("study"),
    template: Annotated[
        settings.StudyTemplate | None,
        typer.Option(
            metavar="NAME",
            help="Write a commented STUDY and stop: fov-distortion, frames-stars, magnitude-noise, distortion-models.",
        ),
    ] = None,
    workers: Annotated[
        int | None, number("workers", "Processes; as many as processors by default, 0 for this one.")
    ] = None,
    scheduler: SchedulerAddress = None,
    seed: Annotated[int | None, number("seed", "Root seed, instead of that of STUDY.")] = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Vary camera, sky, noise and observation: what couples, what decouples it, and what it does to attitudes.

    Cells that are there already are not computed again; `--force` computes all anew, and then replaces them. Status 1
    when no cell has numbers.
    """
    if template is not None:
        sc.studies.write_study_template(template, file, force)
        print(f"Study to fill in: {file}. Next: starcal-uq study {file} -o {out}")
        return
    pages: list[Path] = []

    def page_of(found: sc.studies.Study, folder: Path) -> None:
        if found.ok.any():
            from starcal_uq.presentation.pages.write import write_page

            pages.append(out / write_page(found, folder).name)

    with progress_bar("cells") as progress:
        found = sc.study(
            file,
            out=out,
            seed=seed,
            workers=workers,
            scheduler=scheduler,
            force=force,
            progress=progress,
            more=page_of,
        )
    page = pages[0] if pages else None
    if json:
        print_json(_summary(found, out, page))
    else:
        _show(found, page)
    if not found.complete:
        raise KeyboardInterrupt
    if not found.ok.any():
        raise typer.Exit(1)


def _summary(found: sc.studies.Study, out: Path, page: Path | None) -> dict[str, object]:
    from starcal_uq.presentation.words.studies import study_answer, study_limits
    from starcal_uq.presentation.words.study_advice import study_advice

    numbers = found.ok.any()
    return {
        "name": found.definition.name,
        "question": found.definition.question,
        "cells": found.n_cells,
        "cells_ok": int(found.ok.sum()),
        "complete": found.complete,
        "problems": found.problems,
        "answer": study_answer(found) if numbers else [],
        "advice": study_advice(found) if numbers else [],
        "limits": study_limits(found),
        "data": str(out / "study.nc"),
        "table": str(out / "study.parquet"),
        "page": None if page is None else str(page),
    }


def _show(found: sc.studies.Study, page: Path | None) -> None:
    from starcal_uq.presentation.words.studies import study_answer, study_table
    from starcal_uq.presentation.words.study_advice import study_advice

    table = study_table(found)
    if table is not None:
        print_table(table)
    for sentence in (*study_answer(found), *study_advice(found)):
        console.print(sentence, highlight=False, soft_wrap=True)
    for problem, n in found.problems.items():
        err.print(f"{n} of {found.n_cells} cells: {problem}", style="yellow", highlight=False, soft_wrap=True)
    if page is not None:
        print(f"Page: {page.resolve()}")
