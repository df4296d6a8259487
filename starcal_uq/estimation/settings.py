"""Settings of an estimate: one record for functions, runs and the command line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Protocol, TypedDict, get_args

from starcal_uq.attitude.relative import RelativeAttitudes, load_relative_attitudes
from starcal_uq.core.conflicts import refuse_conflicts
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.settings import Duplicates, Method, MountKind, NoiseKind, Solver
from starcal_uq.core.types import PathLike
from starcal_uq.likelihood.composed import (
    EffectTerms,
    FixedMount,
    Likelihood,
    StarDirections,
    StudentTails,
)
from starcal_uq.likelihood.student import parse_dof

METHODS = get_args(Method)
ITERATIONS = 200
# Words that a setting may be.
_WORDS = {
    "method": METHODS,
    "solver": get_args(Solver),
    "likelihood": ("marginal", "student_t"),
    "noise": get_args(NoiseKind),
    "mount": get_args(MountKind),
}


class MethodOptions(Protocol):
    """Options of a method."""

    def check(self, method: str) -> None:
        """Refuse what makes no sense for a method, by a `CalibrationError` with the remedy."""


class EstimationOptions(TypedDict, total=False):
    """Fields of `EstimationSettings`, as keywords."""

    model: str | None
    method: str
    solver: str
    max_iterations: int
    likelihood: str | Likelihood
    dof: float | str | None
    noise: str
    star_errors: bool
    effects: str | Sequence[str]
    relative_attitudes: RelativeAttitudes | PathLike | None
    mount: str
    mount_sigma_arcsec: float | None
    recursion: MethodOptions | None
    duplicates: str


@dataclass(frozen=True, kw_only=True)
class EstimationSettings:
    """How a calibration is made; `calibrate` describes the fields, which are its keywords.

    `likelihood` is a composed one, or its name, to which `dof`, `noise`, `star_errors`,
    `effects`, `relative_attitudes` and `mount` add parts.

    Raises
    ------
    CalibrationError
        For a word that is unknown, and for settings that exclude each other.
    """

    model: str | None = None
    method: str = "efficient"
    solver: str = "lm"
    max_iterations: int = ITERATIONS
    likelihood: str | Likelihood = "marginal"
    dof: float | str | None = None
    noise: str = "common"
    star_errors: bool = False
    effects: str | Sequence[str] = "none"
    relative_attitudes: RelativeAttitudes | PathLike | None = None
    mount: str = "free"
    mount_sigma_arcsec: float | None = None
    recursion: MethodOptions | None = None
    duplicates: Duplicates | str = "refuse"

    def __post_init__(self) -> None:
        for name, words in _WORDS.items():
            value = getattr(self, name)
            if isinstance(value, str) and value not in words:
                raise CalibrationError(
                    f"{name} {value!r} is unknown: use one of {', '.join(words)}."
                )
        parse_dof(self.dof, CalibrationError)
        self.refuse_conflicts()

    def refuse_conflicts(self, **others: object) -> None:
        """Refuse settings that exclude each other or some others, such as ``partitioned=True``."""
        refuse_conflicts(
            **{
                **{field.name: getattr(self, field.name) for field in fields(self)},
                "likelihood": self.composed.name,
                "noise": self.composed.noise,
                "star_errors": self.composed.star_errors,
                "effects": self.composed.effects,
                "mount": None if self.mount == "free" else self.mount,
                "relative_attitudes": None if self.mount == "fixed" else self.composed.ties,
                **others,
            }
        )

    @cached_property
    def composed(self) -> Likelihood:
        """The likelihood of its parts."""
        if isinstance(self.likelihood, Likelihood):
            return self.likelihood
        tails = None
        if self.likelihood == "student_t":
            tails = StudentTails(parse_dof(self.dof, CalibrationError))
        noise: NoiseKind = "model" if self.noise == "model" else "common"
        effects = EffectTerms.parsed(self.effects)
        terms = (StarDirections(),) if self.star_errors else ()
        terms = terms if effects is None else (*terms, effects)
        return Likelihood(noise, tails, terms, self._ties)

    @property
    def _ties(self) -> RelativeAttitudes | FixedMount | None:
        if self.mount == "fixed":
            return FixedMount(self.mount_sigma_arcsec or 0.0)
        known = self.relative_attitudes
        if known is None or isinstance(known, RelativeAttitudes):
            return known
        return load_relative_attitudes(known)

    @property
    def weighs(self) -> bool:
        """Whether residuals decide how much stars count: by tails, or a model of the noise."""
        return self.composed.tails is not None or self.composed.noise == "model"

    def changed(self, **options: Any) -> EstimationSettings:
        """The settings with some of their fields changed.

        TypeError for a name that is not one of them.
        """
        return replace(self, **options)
