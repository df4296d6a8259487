"""Fields of a record that are computed when they are first read."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from starcal_uq.core.tasks import one_thread

T = TypeVar("T")


class Later(Generic[T]):
    """A value that is computed when it is first read; a pickle holds the value."""

    def __init__(self, make: Callable[[], T]) -> None:
        self._make = one_thread()(make)

    @cached_property
    def value(self) -> T:
        """The value."""
        made = self._make()
        # What it was computed from is needed no more.
        self._make = lambda: made
        return made

    def __reduce__(self) -> tuple[Any, ...]:
        return itemgetter(0), ((self.value,),)


class Deferring:
    """A record whose fields may be given as `Later`: a field that is read is the value."""

    # Type checkers see the fields as they are declared.
    if not TYPE_CHECKING:

        def __getattribute__(self, name):
            held = super().__getattribute__(name)
            return held.value if isinstance(held, Later) else held
