"""Findings: codes with values. The sentence of each is made where it is shown.

A wing states facts. How a code is worded is known to `starcal_uq.presentation.words`, which
stands above and registers itself here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import Any


@dataclass(frozen=True)
class Finding:
    """Something that is worth telling, as data.

    Attributes
    ----------
    code : Enum
        What was found.
    values : dict
        Facts by name; a name ends in the unit of its value.
    """

    code: Enum
    values: dict[str, Any] = field(default_factory=dict)

    def __hash__(self) -> int:
        return hash(self.code)

    @property
    def sentence(self) -> str:
        """Meaning, in plain words."""
        return str(worded(self))


_wordings: list[Callable[[], Callable[[Finding], Any]]] = []


def register_wording(load: Callable[[], Callable[[Finding], Any]]) -> None:
    """Let a function word findings; `load` gives it when one is first shown."""
    _wordings.append(load)


def clause(code: Enum, **values: Any) -> str:
    """The words of a code with values, for an error or a file that keeps words."""
    return str(worded(Finding(code, values)))


def worded(finding: Finding) -> Any:
    """The words of a finding: a sentence, and of a check value, bound and sentence."""
    return _wordings[-1]()(finding)
