"""Coupling studies: what couples with what, and what would decouple it."""

from __future__ import annotations

from pathlib import Path

import starcal_uq as sc
from starcal_uq.cli.answers import INTERRUPTED, Answer
from starcal_uq.cli.console import note, print_table, progress_bar, say


def study_command(
    file: Path = Path("study.toml"),
    out: Path = Path("study"),
    workers: int | None = None,
    scheduler: str | None = None,
    seed: int | None = None,
    force: bool = False,
) -> Answer:
    """Vary camera, sky, noise and observation: what couples, what decouples it, and what it does to
    attitudes.

    Cells that are there already are not computed again; `--force` computes all again, and then
    replaces them. Status 1 when no cell has numbers.
    """
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
    _show(found, page)
    status = INTERRUPTED if not found.complete else int(not found.ok.any())
    return Answer({"study": (found, out, page)}, status)


def _show(found: sc.studies.Study, page: Path | None) -> None:
    from starcal_uq.presentation.words.studies import study_advice, study_answer, study_tables

    for table in study_tables(found):
        print_table(table)
    for sentence in (*study_answer(found), *study_advice(found)):
        say(sentence)
    for problem, n in found.problems.items():
        note(f"{n} of {found.n_cells} cells: {problem}")
    if page is not None:
        say(f"Page: {page.resolve()}")
