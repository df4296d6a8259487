"""The one door from a result to its figures, its words and its tables, which all stand above it.

A result knows numbers. Whoever stands above registers how its class is shown, and the result finds
that here, by its class, when somebody asks.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field, fields, is_dataclass
from functools import wraps
from typing import Any


@dataclass(frozen=True)
class View:
    """How the results of one class are shown: sentences, HTML for a notebook, and what draws after
    ``result.plot.``.

    Every function takes the result first.
    """

    text: Callable[[Any], str] | None = None
    html: Callable[[Any], str] | None = None
    figures: Mapping[str, Callable[..., Any]] = field(default_factory=dict)


# The figure that a user gave to draw into; None for one of its own.
GIVEN: ContextVar[Any] = ContextVar("GIVEN", default=None)
_VIEWS: list[Callable[[], Mapping[type, View]]] = []


def register(views: Callable[[], Mapping[type, View]]) -> None:
    """Add a table of views; `views` is called when a result is first shown, and may import heavily
    then.
    """
    _VIEWS.append(views)


def view_of(cls: type) -> View:
    """The view of a class, or of the nearest class that it derives from; `LookupError` where there
    is none.
    """
    tables = [views() for views in _VIEWS]
    for ancestor in cls.__mro__:
        for table in tables:
            if ancestor in table:
                return table[ancestor]
    raise LookupError(f"nothing says how a {cls.__name__} is shown")


class Figures:
    """The figures of one result: ``result.plot.<name>(...)`` draws, and tab completion lists the
    names.

    With ``fig=``, a Figure or SubFigure of matplotlib, it draws into that one.
    """

    def __init__(self, result: Any, figures: Mapping[str, Callable[..., Any]]) -> None:
        self._result = result
        self._figures = figures

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("_") or name not in self._figures:
            known = ", ".join(sorted(self._figures)) or "none"
            raise AttributeError(
                f"a {type(self._result).__name__} has no figure {name!r}; it has {known}"
            )
        figure = self._figures[name]

        @wraps(figure)
        def draw(*args: Any, fig: Any = None, **options: Any) -> Any:
            token = GIVEN.set(fig)
            try:
                return figure(self._result, *args, **options)
            finally:
                GIVEN.reset(token)

        _, *own = inspect.signature(figure).parameters.values()
        own.append(inspect.signature(draw, follow_wrapped=False).parameters["fig"])
        own.sort(key=lambda parameter: parameter.kind)
        draw.__signature__ = inspect.Signature(own)  # type: ignore[attr-defined]
        return draw

    def __dir__(self) -> list[str]:
        return sorted(self._figures)

    def __repr__(self) -> str:
        return f"figures of this {type(self._result).__name__}: {', '.join(dir(self))}"


def public_names(thing: object) -> list[str]:
    """Names for tab completion, without the private ones."""
    return [name for name in object.__dir__(thing) if not name.startswith("_")]


class Shown:
    """What every result can do once somebody above has said how."""

    __dir__ = public_names

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        # That of a dataclass would print every array.
        if "__repr__" not in vars(cls):
            cls.__repr__ = _short  # type: ignore[method-assign]

    @property
    def plot(self) -> Figures:
        """The figures of this result, by name: ``result.plot.<name>()``."""
        return Figures(self, view_of(type(self)).figures)

    @property
    def text(self) -> str:
        """This result in a few sentences."""
        text = view_of(type(self)).text
        return type(self).__name__ if text is None else text(self)

    def _repr_html_(self) -> str | None:
        html = view_of(type(self)).html
        return None if html is None else html(self)


_MOST = 300


def _short(result: Any) -> str:
    """A result for the prompt: its fields where they are few, what it says otherwise."""
    name = type(result).__name__
    if is_dataclass(result):
        plain = f"{name}({', '.join(f'{f.name}={getattr(result, f.name)!r:.{_MOST}}' for f in fields(result))})"
        if len(plain) <= _MOST and "\n" not in plain:
            return plain
    try:
        return f"{name}: {result.text}"
    except Exception:
        # A prompt and an error message show results of which something is wrong, too.
        return f"{name}(...)"
