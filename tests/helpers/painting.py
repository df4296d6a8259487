"""Figures without Matplotlib's painting."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from starcal_uq.presentation.figures import style
from starcal_uq.presentation.report import drawing


@contextmanager
def without_painting() -> Iterator[None]:
    """Figures are made but not painted: a file of one white pixel takes the place of each.

    Painting is most of the time that a report takes, and all of it is Matplotlib's. Every figure is
    painted in `tests/presentation`, whole pages in the tests of the report and in one run of the
    command line.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            style, "painted", lambda _figure, _dpi: np.full((1, 1, 3), 255, dtype=np.uint8)
        )
        # Another process would paint.
        patch.setattr(drawing, "processors", lambda: 1)
        yield
