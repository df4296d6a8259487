"""Figures that are written and handed to nobody: they look the same, in less time.

Matplotlib makes five artists for each tick, which are most of what a panel consists of, and
measures its labels three times. Here one tick goes along each axis and is measured once.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import XAxis, YAxis
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

# Beyond the ends of an axis, as a share of its length, where matplotlib still draws a tick.
_SLACK = 1e-10


class _Along:
    """The tick of an axis at each of its places in view, as often as it is looped over."""

    def __init__(self, axis: Any) -> None:
        self._shown: list[tuple[Any, float, str]] = []
        self.boxes: Any = None
        transform = axis.get_transform()
        low, high = sorted(transform.transform(axis.get_view_interval()))
        slack = _SLACK * (high - low)
        for minor, ticker in ((False, axis.major), (True, axis.minor)):
            if isinstance(ticker.locator, NullLocator):
                continue
            places = axis.get_ticklocs(minor=minor)
            for place, text in zip(places, ticker.formatter.format_ticks(places), strict=True):
                if low - slack <= transform.transform(place) <= high + slack:
                    self._shown.append((axis.one_tick(minor), place, text))

    def __iter__(self) -> Iterator[Any]:
        for tick, place, text in self._shown:
            tick.update_position(place)
            tick.label1.set_text(text)
            tick.label2.set_text(text)
            yield tick


def _with_one_tick(kind: Any) -> Any:
    """A class of axes with one tick of either kind, made when it is first drawn."""

    class OneTick(kind):  # type: ignore[misc]
        _along: _Along | None = None

        def reset_ticks(self) -> None:
            # Spines ask for it once they know where they are, which is here where they always are.
            self.majorTicks: list[Any] = vars(self).get("majorTicks", [])
            self.minorTicks: list[Any] = vars(self).get("minorTicks", [])

        def one_tick(self, minor: bool) -> Any:
            ticks = self.minorTicks if minor else self.majorTicks
            if not ticks:
                ticks.append(self._get_tick(major=not minor))
                ticks[0].set_clip_path(self.axes.patch)
            return ticks[0]

        def get_major_ticks(self, numticks: int | None = None) -> list[Any]:
            return [self.one_tick(minor=False)]

        def get_minor_ticks(self, numticks: int | None = None) -> list[Any]:
            return [self.one_tick(minor=True)]

        def set_clip_path(self, path: Any, transform: Any = None) -> None:
            Artist.set_clip_path(self, path, transform)

        def _update_ticks(self) -> Any:
            return self._along or _Along(self)

        def _get_ticklabel_bboxes(self, ticks: Any, renderer: Any) -> Any:
            if ticks.boxes is None:
                ticks.boxes = super()._get_ticklabel_bboxes(ticks, renderer)
            return ticks.boxes

        def _update_label_position(self, renderer: Any) -> None:
            if self.label.get_text():
                super()._update_label_position(renderer)

        def get_tightbbox(self, *args: Any, **options: Any) -> Any:
            return self._at_rest(super().get_tightbbox, *args, **options)

        def draw(self, renderer: Any) -> None:
            self._at_rest(super().draw, renderer)

        def _at_rest(self, function: Any, *args: Any, **options: Any) -> Any:
            """What a function returns while the ticks stay where they are."""
            self._along = _Along(self)
            try:
                return function(*args, **options)
            finally:
                self._along = None

    return OneTick


_QuickX, _QuickY = map(_with_one_tick, (XAxis, YAxis))


class _QuickAxes(Axes):
    def _init_axis(self) -> None:
        super()._init_axis()  # type: ignore[misc]
        self.xaxis.__class__, self.yaxis.__class__ = _QuickX, _QuickY


class QuickFigure(Figure):
    """A figure whose panels are made and drawn in less time."""

    def add_subplot(self, *args: Any, **options: Any) -> Any:
        return super().add_subplot(*args, **{"axes_class": _QuickAxes} | options)

    def add_axes(self, *args: Any, **options: Any) -> Any:
        return super().add_axes(*args, **{"axes_class": _QuickAxes} | options)
