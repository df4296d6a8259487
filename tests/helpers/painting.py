"""Figures without Matplotlib's painting."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import IO

import numpy as np
import pytest
from matplotlib.backends.backend_svg import FigureCanvasSVG

from starcal_uq.presentation.figures import style
from starcal_uq.presentation.report import drawing
from starcal_uq.presentation.report.results import Results

SVG = '<svg xmlns="http://www.w3.org/2000/svg" width="72pt" height="72pt" viewBox="0 0 72 72"/>'


def _empty(_canvas: FigureCanvasSVG, file: IO[str], **_options: object) -> None:
    file.write(SVG)


# Whose absence leaves out a figure of the report; the others need the calibration alone.
NEEDED = {"misfit": "diagnosis", "corner": "posterior", "prior_posterior": "posterior"}
NEEDED |= {
    "correlation": "coupling",
    "price_of_coupling": "coupling",
    "glance_attitude": "attitude",
    "glance_field": "field_map",
}
NEEDED |= {name: name for name in ("attitude", "field_map", "distortion_curve", "budget")}


def _drawn(results: Results, names: Collection[str] = drawing.FIGURES, *_: object) -> dict:
    lacking = {name for name, part in NEEDED.items() if getattr(results, part) is None}
    if results.calibration.effects is None:
        lacking.add("effects")
    if results.attitude is None or results.attitude.thermal is None:
        lacking.add("thermal")
    return {name: SVG.encode() for name in names if name not in lacking}


@contextmanager
def without_painting() -> Iterator[None]:
    """An empty drawing takes the place of each figure.

    Figures are most of the time that a report takes. Every figure is painted in
    `tests/presentation`, whole pages in the tests of the report and in one run of the command line.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            style, "painted", lambda _figure, _dpi: np.full((1, 1, 3), 255, dtype=np.uint8)
        )
        patch.setattr(FigureCanvasSVG, "print_svg", _empty)
        patch.setattr(drawing, "draw_figures", _drawn)
        # Another process would paint.
        patch.setattr(drawing, "worth_starting", lambda: 0)
        yield
