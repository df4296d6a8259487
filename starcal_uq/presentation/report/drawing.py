"""The figures of a report, and another process that draws them ahead of it."""

from __future__ import annotations

import gc
import sys
import tomllib
from collections import ChainMap
from collections.abc import Callable, Collection
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import ExitStack, suppress
from functools import partial, reduce
from importlib.resources import files
from multiprocessing import active_children
from pathlib import Path
from pkgutil import resolve_name
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, TypeVar

from starcal_uq.core.tasks import processes, submit, worth_starting
from starcal_uq.core.types import Progress
from starcal_uq.pipeline.inspection import Frames
from starcal_uq.presentation.figures.style import figure_of, label, new_axes, svg_bytes
from starcal_uq.presentation.report.results import Results

T = TypeVar("T")

# Figures by the step after which they can be drawn.
_STEPS: dict[str, dict[str, list[str]]] = tomllib.loads(
    files("starcal_uq.presentation.report").joinpath("drawing.toml").read_text("utf-8")
)
AFTER = {step: tuple(figures) for step, figures in _STEPS.items()}
# The frames of a run from images stand among the figures by this name: a piece of a page, not a
# picture.
GALLERY = "gallery"
# Figures that take longer to draw than what draws them to load.
_WORTH_LOADING = 5
FIGURES = tuple(name for names in AFTER.values() for name in names)


def draw_figures(
    results: Results, names: Collection[str] = FIGURES, progress: Progress | None = None
) -> dict[str, bytes]:
    """The figures of these names that the results allow, as SVG."""
    drawn = {}
    for done, name in enumerate(names):
        figure = _figure(results, name)
        if figure is not None:
            drawn[name] = svg_bytes(figure)
            if (pyplot := sys.modules.get("matplotlib.pyplot")) is not None:
                pyplot.close(figure)  # A notebook would show it below the cell.
        if progress is not None:
            progress(done + 1, len(names))
    return drawn


def draw_gallery(frames: Frames) -> dict[str, bytes]:
    """The frames of a run, with their stars."""
    from starcal_uq.presentation.pages.gallery import gallery

    return {GALLERY: gallery(frames).encode()}


def _figure(results: Results, name: str) -> Any:
    """One figure; None where the results lack what it shows."""
    where, *needed = next(figures[name] for figures in _STEPS.values() if name in figures)
    shown = [reduce(_part, what.split("."), results) for what in needed]
    if any(part is None for part, what in zip(shown, needed, strict=True) if what != "truth"):
        return None
    drawn = resolve_name(f"starcal_uq.presentation.figures.{where}")(*shown)
    return None if drawn is None else figure_of(drawn)


def _part(of: Any, name: str) -> Any:
    return getattr(of, name, None)


class Ahead:
    """Another process that draws the figures of a report while what comes after them is computed; a
    context, at whose end it is gone.

    It never is the only way to a result: where it failed, there is a single processor or the
    context is not entered, the caller does the work.
    """

    def __init__(self) -> None:
        self._end, self._drawn = ExitStack(), list[Callable[[], Any]]()
        self._pool: Executor | None = None
        # By the call that asks for them: figures, and those that were drawn here.
        self._asked, self._own = list[list[_Asked]](), list[dict[str, bytes]]()
        self._folder = Path()

    def __enter__(self) -> Ahead:
        self._folder = Path(self._end.enter_context(TemporaryDirectory(ignore_cleanup_errors=True)))
        n_others = min(worth_starting(), 1)
        self._pool = self._end.enter_context(processes(n_others, "run", alike=True))
        others = set(active_children())
        # What drawing needs takes a second to load.
        self.begin(_load)
        for process in set(active_children()) - others:
            self._end.callback(process.kill)
        return self

    def __exit__(self, *_: object) -> None:
        self._end.close()

    def begin(self, function: Callable[..., T], *arguments: Any) -> Callable[[], T | None]:
        """Begin something else that can be done meanwhile; what waits for its result, None if it
        failed.
        """
        with suppress(BrokenExecutor):
            if self._pool is not None:
                return partial(self._result, submit(self._pool, function, *arguments))
        return lambda: None

    def draw(self, results: Results, names: Collection[str]) -> None:
        """Begin to draw the figures of these names, as far as the results allow them."""
        claims = self._folder / str(len(self._drawn))
        asked = [_Asked(results, name, Path(f"{claims}-{name}")) for name in names]
        self._keep(self.begin(_draw_asked, asked), asked)

    def draw_frames(self, frames: Frames) -> None:
        """Begin to draw the frames that the report shows."""
        self._keep(self.begin(draw_gallery, frames), [])

    def _keep(self, drawn: Callable[[], Any], asked: list[_Asked]) -> None:
        self._drawn.append(drawn)
        self._asked.append(asked)
        self._own.append({})

    def figures(self) -> dict[str, bytes]:
        """What was drawn, by name; a figure that was drawn twice as it was drawn last."""
        drawn: dict[str, bytes] = {}
        for some, own in zip(self._drawn, self._own, strict=True):
            drawn |= some() or {}
            drawn |= own
        return drawn

    def _result(self, future: Future[T]) -> T | None:
        """What the other process finds; in place of waiting this one draws figures as well."""
        while not future.done() and self._draws_last():
            continue
        with suppress(Exception):
            return future.result()
        return None

    def _draws_last(self) -> bool:
        """Draw the last of the figures that nobody draws yet; False where there are too few."""
        left = [
            (own, one)
            for own, asked in zip(self._own, self._asked, strict=True)
            for one in asked
            if not one.claim.exists()
        ]
        if not left or (len(left) < _WORTH_LOADING and "matplotlib.figure" not in sys.modules):
            return False
        own, last = left[-1]
        with suppress(Exception):
            own |= last.drawn()
        return True


class _Asked(NamedTuple):
    """A figure for whichever process makes its claim, a folder, first."""

    results: Results
    name: str
    claim: Path

    def drawn(self) -> dict[str, bytes]:
        """The figure by its name; nothing where the other process draws it."""
        try:
            self.claim.mkdir()
        except FileExistsError:
            return {}
        return draw_figures(self.results, (self.name,))


def _draw_asked(asked: Collection[_Asked]) -> dict[str, bytes]:
    return dict(ChainMap(*(one.drawn() for one in asked)))


def _load() -> None:
    """Load what drawing needs, in a process that only draws."""
    # A figure is thousands of objects that refer to each other: looking for those that can go takes
    # a fifth of the time, and a dozen of them fit into memory.
    gc.disable()
    ax = new_axes(1.0, 1.0)
    label(ax, "", "x")
    svg_bytes(figure_of(ax))
