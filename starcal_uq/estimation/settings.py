"""Settings of an estimate: one record for functions, runs and the command line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Protocol, TypedDict, get_args

from starcal_uq.attitude.relative import RelativeAttitudes, load_relative_attitudes
from starcal_uq.core.conflicts import refuse_conflicts
from starcal_uq.core.errors import CalibrationError, check_known
from starcal_uq.core.settings import (
    WEIGHING,
    Duplicates,
    Method,
    ModelName,
    MountKind,
    Solver,
    effect_names,
    joined_effects,
)
from starcal_uq.core.types import AnyDict, PathLike
from starcal_uq.likelihood.student import parse_dof
from starcal_uq.likelihood.ties import FixedMount

METHODS = get_args(Method)
ITERATIONS = 200
# Words that a setting may be.
_WORDS = {
    "method": METHODS,
    "solver": get_args(Solver),
    "mount": get_args(MountKind),
    "duplicates": get_args(Duplicates),
}
# Keywords of earlier versions, and the effects that they are now.
_EARLIER = {"likelihood": "tails", "noise": "noise", "star_errors": "star"}


class MethodOptions(Protocol):
    """Options of a method."""

    def check(self, method: str) -> None:
        """Refuse what makes no sense for a method, by a `CalibrationError` with the remedy."""


class EstimationOptions(TypedDict, total=False):
    """Fields of `EstimationSettings`, as keywords."""

    model: ModelName | None
    method: str
    solver: Solver
    max_iterations: int
    effects: str | Sequence[str] | None
    dof: float | str | None
    relative_attitudes: RelativeAttitudes | PathLike | None
    relative_alignment_arcsec: float | None
    mount: MountKind
    mount_sigma_arcsec: float | None
    recursion: MethodOptions | None
    duplicates: Duplicates


@dataclass(frozen=True, kw_only=True)
class EstimationSettings:
    """Settings of a calibration; `calibrate` describes the fields, which are its keywords.

    Raises
    ------
    CalibrationError
        For a word that is unknown, and for settings that exclude each other.
    """

    model: str | None = None
    method: str = "efficient"
    solver: str = "lm"
    max_iterations: int = ITERATIONS
    effects: str | Sequence[str] | None = "none"
    dof: float | str | None = None
    relative_attitudes: RelativeAttitudes | PathLike | None = None
    relative_alignment_arcsec: float | None = None
    mount: str = "none"
    mount_sigma_arcsec: float | None = None
    recursion: MethodOptions | None = None
    duplicates: Duplicates | str = "refuse"

    def __post_init__(self) -> None:
        for name, words in _WORDS.items():
            check_known(name, getattr(self, name), words, CalibrationError)
        parse_dof(self.dof, CalibrationError)
        if self.dof is not None and not self.tails:
            raise CalibrationError(
                f"dof={self.dof!r} belongs to effects='tails': add this effect, or leave dof out."
            )
        self.refuse_conflicts()

    def refuse_conflicts(self, **others: object) -> None:
        """Refuse settings that exclude each other or some others, such as ``partitioned=True``."""
        own = {field.name: getattr(self, field.name) for field in fields(self)}
        own["effects"] = joined_effects(self.effects)
        own["relative_attitudes"] = None if self.mount == "fixed" else self.ties
        refuse_conflicts(**own | others)

    @cached_property
    def ties(self) -> RelativeAttitudes | FixedMount | None:
        """What ties the attitudes of different frames."""
        if self.mount == "fixed":
            return FixedMount(self.mount_sigma_arcsec or 0.0)
        known, alignment = self.relative_attitudes, self.relative_alignment_arcsec
        if known is None:
            if alignment is not None:
                raise CalibrationError(
                    "relative_alignment_arcsec is about relative_attitudes, which are not given: "
                    "give both, or leave it out."
                )
            return None
        if not isinstance(known, RelativeAttitudes):
            known = load_relative_attitudes(known)
        return known if alignment is None else replace(known, alignment_arcsec=alignment)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names in the list of effects, ``auto`` among them."""
        return effect_names(self.effects)

    @property
    def shifting(self) -> tuple[str, ...]:
        """The same of effects that shift stars."""
        return tuple(name for name in self.names if name not in WEIGHING)

    @property
    def noise(self) -> bool:
        """True if the noise may vary from star to star."""
        return "noise" in self.names

    @property
    def made(self) -> AnyDict:
        """What the provenance of a result states of them."""
        return {"method": self.method, "solver": self.solver}

    @property
    def tails(self) -> bool:
        """True if residuals may have the tails of a Student t."""
        return "tails" in self.names

    def changed(self, **options: Any) -> EstimationSettings:
        """The settings with some of their fields changed.

        TypeError for a name that is not one of them.
        """
        for name in options:
            if name in _EARLIER:
                raise TypeError(
                    f"{name} is no setting any more: use effects={_EARLIER[name]!r} in its place."
                )
        return replace(self, **options)
