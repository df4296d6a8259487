"""Fill the template."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from starcal_uq.camera.distortion import get_model, parameters
from starcal_uq.core.formatting import p_words
from starcal_uq.core.remedy import RUN, Remedy
from starcal_uq.core.status import Code, Level, Question
from starcal_uq.core.types import AnyDict
from starcal_uq.diagnostics.verdict.estimate import MISFIT_P
from starcal_uq.diagnostics.verdict.limits import limits
from starcal_uq.presentation.html import page
from starcal_uq.presentation.pages.explorer import explorer
from starcal_uq.presentation.report import summary, tables, words
from starcal_uq.presentation.report.results import Results
from starcal_uq.presentation.words import budgeting, diagnostics, effects, propagation


def render(results: Results, figures: Mapping[str, bytes], gallery: str = "") -> str:
    """The report as one HTML document.

    Parameters
    ----------
    results
        What to report.
    figures
        SVG images by the names of `starcal_uq.presentation.report.drawing.draw_figures`; a missing
        one is left out.
    gallery
        The frames of a run from images, as a piece of a page.
    """
    return prepared(results)(figures, gallery)


def prepared(results: Results) -> Callable[[Mapping[str, bytes], str], str]:
    """The report as a function of figures and gallery, for whoever waits for these: what takes
    time is done.
    """
    made = (results.posterior or results.calibration).provenance
    fill = partial(page, "report.html.j2", made, **context(results))
    return lambda figures, gallery: fill(images=figures, gallery=gallery)


def context(results: Results) -> AnyDict:
    """What the template knows beside the figures: the results, and what words and tabulates
    them.
    """
    cal = results.calibration
    return {
        "results": results,
        "verdict": results.verdict,
        "curve": results.distortion_curve,
        "model": get_model(cal.camera.distortion),
        "specs": parameters(cal.camera.distortion),
        "budget": None if results.budget is None else budgeting.tables(results.budget),
        **tables.image_context(results.images, cal),
        **_KNOWN,
    }


_KNOWN: AnyDict = {
    one.__name__.rpartition(".")[2]: one
    for one in (
        *(Code, Level, Question, Remedy, explorer, limits, p_words),
        *(diagnostics, effects, propagation, summary, tables, words),
    )
} | {"RUN": RUN, "MISFIT_P": MISFIT_P}
