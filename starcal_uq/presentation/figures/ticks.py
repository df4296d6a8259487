"""The ticks of a figure that is drawn once: all of an axis by a single tick.

Matplotlib keeps five artists for each tick and measures its label up to eight times, which is a
quarter of the time of a page's figures.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.types import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.text import Text

# Share of an axis by which a tick may lie outside.
_SLACK = 1e-10
# Along a grid line: both ends, and nothing to the next one.
_LINE = (0.0, 1.0, np.nan)


@contextmanager
def single_ticks(figure: Figure) -> Iterator[None]:
    """Draw the axes of a figure by single ticks within the block: the same picture.

    Ticks must look alike. Secondary axes and those with minor ticks or an offset are drawn by
    matplotlib.
    """
    found = [axis for ax in figure.axes if ax.axison for axis in (ax.xaxis, ax.yaxis)]
    with ExitStack() as after:
        for axis in found:
            marks = _marks()(axis)
            others = len(axis.get_minorticklocs()) or axis.get_major_formatter().get_offset()
            if axis.get_visible() and not others:
                axis.axes.add_artist(marks)
                axis.set_visible(False)
                after.callback(marks.remove)
                after.callback(axis.set_visible, True)
        yield


@cache
def _marks() -> Any:
    """The class, made where matplotlib is loaded."""
    from matplotlib.artist import Artist
    from matplotlib.transforms import Bbox

    class Marks(Artist):
        """Grid, ticks, their labels and the label of an axis."""

        # How far the ticks' labels extend beyond each end of the panel, pixels.
        beyond: FloatArray | None = None

        def __init__(self, axis: Any) -> None:
            super().__init__()
            self.axis, self.across = axis, axis.axis_name == "x"
            self.tick = axis.get_major_ticks(1)[0]
            self.set(zorder=axis.get_zorder(), clip_on=False)
            scale = axis.get_transform().transform
            low, high = np.sort(scale(axis.get_view_interval()))
            slack = _SLACK * (high - low)
            at = axis.get_majorticklocs()
            inside = (scale(at) >= low - slack) & (scale(at) <= high + slack)
            self.at = np.compress(inside, at)
            self.words = np.compress(inside, axis.get_major_formatter().format_ticks(at))

        def labels(self) -> Iterator[Text]:
            """Each tick's label in turn."""
            for text in filter(Artist.get_visible, (self.tick.label1, self.tick.label2)):
                for place, word in zip(self.at, self.words, strict=True):
                    text.set(text=word, **{self.axis.axis_name: place})
                    yield text

        def extents(self, renderer: Any) -> FloatArray:
            """Ends of the panel with the ticks' labels, after the axis' label was put beside these,
            pixels.
            """
            axis, panel = self.axis, self.axis.axes.bbox
            if self.beyond is None:
                boxes = [text.get_window_extent(renderer) for text in self.labels()]
                self.beyond = np.subtract(Bbox.union([panel, *boxes]).extents, panel.extents)
            ends: FloatArray = panel.extents + self.beyond
            side = ("left", "bottom", "right", "top").index(axis.get_label_position())
            pad = (side // 2 * 2 - 1) * axis.labelpad * axis.axes.figure.dpi / 72.0
            axis.label.set(**{"xy"[side % 2]: ends[side] + pad})
            return ends

        def draw(self, renderer: Any) -> None:
            tick = self.tick
            lines = (tick.gridline, _LINE), (tick.tick1line, (0.0,)), (tick.tick2line, (1.0,))
            for line, ends in lines:
                before = line.get_data()
                places = np.repeat(self.at, len(ends)), np.tile(ends, len(self.at))
                line.set_data(*places[:: 1 if self.across else -1])
                line.draw(renderer)
                line.set_data(*before)
            for text in self.labels():
                text.draw(renderer)
            if self.axis.label.get_text():
                self.extents(renderer)
                self.axis.label.draw(renderer)

        def get_tightbbox(self, renderer: Any = None) -> Bbox:
            self.beyond = None
            x0, y0, x1, y1 = self.extents(renderer)
            if not self.axis.label.get_text():
                return Bbox.from_extents(x0, y0, x1, y1)
            label = self.axis.label.get_window_extent(renderer)
            # No panel makes room for a label that is longer.
            if self.across:
                return Bbox.from_extents(x0, min(y0, label.y0), x1, max(y1, label.y1))
            return Bbox.from_extents(min(x0, label.x0), y0, max(x1, label.x1), y1)

    return Marks
