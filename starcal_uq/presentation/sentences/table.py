"""The table of sentences, which the modules beside fill."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import Any, TypeAlias, TypeVar

from starcal_uq.core.findings import Finding
from starcal_uq.core.status import Check, Level

# Value, bound and sentence of a check.
Told: TypeAlias = tuple[str, str, str]
Entry = Callable[..., Any]
F = TypeVar("F", bound=Entry)

SENTENCES: dict[Enum, Entry] = {}


def entry(*codes: Enum) -> Callable[[F], F]:
    """Enter a function as the one that words these codes."""

    def enter(function: F) -> F:
        SENTENCES.update(dict.fromkeys(codes, function))
        return function

    return enter


def wording(finding: Finding) -> Any:
    """The words of a finding; an entry of a check takes first whether it passed."""
    told = SENTENCES[finding.code]
    if isinstance(finding, Check):
        return told(finding.level is Level.PASS, **finding.values, **finding.bounds)
    return told(**finding.values)
