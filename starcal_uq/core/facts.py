"""Facts among plain values: what code reads from metadata is a field of a record, and has a type."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from starcal_uq.core.types import AnyDict

F = TypeVar("F", bound="Facts")


class Facts:
    """Base of frozen dataclasses whose fields are called as they are in files; None is not stated."""

    @classmethod
    def of(cls: type[F], values: Mapping[str, Any]) -> F:
        """The facts among plain values; all others are the user's own."""
        return cls(**{name: values[name] for name in cls.__annotations__ if name in values})

    def plain(self) -> AnyDict:
        """Inverse of `of`: the facts that are stated, for metadata."""
        return {name: value for name, value in vars(self).items() if value is not None}
