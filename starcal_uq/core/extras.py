"""Libraries that only some users need: extras of the package, imported where they are used, and what
other packages offer.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from starcal_uq.core.errors import MissingExtraError
from starcal_uq.core.provenance import NAME

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


@contextmanager
def extra(name: str, what: str, instead: str = "") -> Iterator[None]:
    """For a block of imports: a library that is missing is named with the command that installs it.

    `name` is the extra of ``pyproject.toml`` that brings the library, `what` needs it, in the
    plural, such as "FITS images", and `instead` is another way out, an order, where there is one.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        library = (error.name or str(error)).partition(".")[0]
        otherwise = f", or {instead}" if instead else ""
        raise MissingExtraError(
            f'{what} need {library}: run `pip install "{NAME}[{name}]"`{otherwise}.'
        ) from None


def entry_point(group: str, name: str) -> EntryPoint | None:
    """The entry point of this name in a group; None where no installed package offers it."""
    from importlib.metadata import entry_points

    return next(iter(entry_points(group=group, name=name)), None)
