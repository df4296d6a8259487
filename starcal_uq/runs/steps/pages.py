"""What a run is read in: its report, the report for printing, and a notebook."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from starcal_uq.core.files import (
    atomic_write_bytes,
    atomic_write_text,
    ensure_new,
    new_folder,
)
from starcal_uq.core.records import write_json
from starcal_uq.core.types import PathLike, Progress
from starcal_uq.runs.folder import FILES, RunFolder
from starcal_uq.runs.stored import StoredRun, writing


def report(
    run: StoredRun,
    /,
    drawn: Callable[[], Mapping[str, bytes]] | None = None,
    *,
    force: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Write ``RUN/report.html`` of whatever the run holds, and the figures in ``RUN/figures``.

    A report follows from the rest of the run, and goes when that changes: one that is there is
    left as it is, if no budget was made after it.

    Parameters
    ----------
    drawn : callable, optional
        Figures of these results that are drawn elsewhere, as SVG by name, asked for when all
        else is ready; the others are drawn now.
    force : bool
        Whether to write it again.
    progress : callable, optional
        Called with the figures drawn and all.

    Raises
    ------
    RunFolderError
        If there is no calibration, or a file cannot be read or is not of this run.
    """
    if force or not run.has("report") or run.folder.is_older("report"):
        from starcal_uq.presentation.report.drawing import (
            FIGURES,
            GALLERY,
            draw_figures,
            draw_gallery,
        )
        from starcal_uq.presentation.report.page import prepared

        page = prepared(run.results)
        figures = {} if drawn is None else dict(drawn())
        figures |= draw_figures(
            run.results, [name for name in FIGURES if name not in figures], progress
        )
        if GALLERY not in figures and run.images is not None:
            figures |= draw_gallery(run.shown_frames)
        html = page(figures, figures.pop(GALLERY, b"").decode())
        with run._step("report", None, {}) as files:
            new_folder(files.figures)
            for name, svg in figures.items():
                atomic_write_bytes(files.figures / f"{name}.svg", svg)
            write_json(run.verdict.to_dict(), files.verdict)
            atomic_write_text(files.report, html)
    return run.path / RunFolder.report


@writing
def pdf(run: StoredRun, /, *, force: bool = False) -> Path:
    """Write the report as ``RUN/report.pdf``, by a browser that is installed or by WeasyPrint.

    Parameters
    ----------
    force : bool
        Whether to write report and PDF again.

    Raises
    ------
    MissingExtraError
        If nothing is installed that makes a PDF.
    RunFolderError
        If there is no calibration, a file cannot be read, or no PDF came of it.
    """
    page = report(run, force=force)
    if force or not run.has("pdf"):
        from starcal_uq.presentation.pages.printing import pdf_bytes

        content = pdf_bytes(page)
        with run._step("pdf", None, {}) as files:
            atomic_write_bytes(files.pdf, content)
    return run.path / RunFolder.pdf


def notebook(
    run: StoredRun,
    /,
    to: PathLike | None = None,
    *,
    force: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Write an executed notebook of the run's results, ``RUN/report.ipynb``, to continue from.

    It is of the run as it is now, and goes when that changes, if it is in the folder.

    Parameters
    ----------
    to : path, optional
        Another file.
    force : bool
        Whether to replace a file.
    progress : callable, optional
        Called as ``progress(cells_done, cells_total)``.

    Raises
    ------
    RunFolderError
        If there is no calibration, a file cannot be read or is in the way, or a cell fails.
    MissingExtraError
        If nbformat, nbclient or ipykernel is not installed.
    """
    from starcal_uq.presentation.pages.notebook import executed, write_cells

    place = run.path / RunFolder.notebook if to is None else Path(to)
    ensure_new(place, force or (to is None and run.folder.is_older("notebook")))
    # What is wrong with the run is told here, and not by a cell.
    _ = run.results
    parts = [name for name in FILES if run.has(name)] + ["images"] * (run.images is not None)
    found = run.calibration.effects
    parts += ["effects"] * (found is not None and bool(found.names))
    # A folder that moves takes its notebook along.
    folder = "." if to is None else str(run.path.resolve())
    content = executed(write_cells(run.name, parts, folder), place.resolve().parent, progress)
    if to is not None:
        atomic_write_text(place, content)
        return place
    with run._step("notebook", None, {}) as files:
        atomic_write_text(files.notebook, content)
    return place
