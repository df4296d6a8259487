"""The likelihood that a refinement maximises, composed of parts: noise, tails, star errors, effects.

Every combination of parts makes sense. The noise of a star scales its residuals, whatever their
distribution; tails give every star a weight on top of that scale; errors that stars bring along are
linear in the pixels and have a prior, whatever weighs the pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

from starcal_uq.attitude.relative import RelativeAttitudes
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.settings import EffectName, NoiseKind
from starcal_uq.likelihood.student import DEFAULT_DOF, DOF_RANGE


@dataclass(frozen=True)
class StudentTails:
    """Residuals of a star that follow a bivariate Student t in place of a Gaussian.

    Attributes
    ----------
    dof : float or None
        Degrees of freedom, 2 to 200; None estimates them.
    """

    dof: float | None = DEFAULT_DOF

    def __post_init__(self) -> None:
        low, high = DOF_RANGE
        if self.dof is not None and not low <= self.dof <= high:
            raise CalibrationError(
                f"dof is {self.dof!r}: use 'free' or a number from {low:g} to {high:g}."
            )


@dataclass(frozen=True)
class StarDirections:
    """Errors of the stars' directions, alike in every frame; their size is estimated."""


@dataclass(frozen=True)
class EffectTerms:
    """Effects beyond the camera, whose scales are estimated.

    Attributes
    ----------
    names : tuple of str
        The effects; those that the data ask for, of all, where it is empty.
    """

    names: tuple[str, ...] = ()

    @classmethod
    def parsed(cls, effects: str | Sequence[str] | None) -> EffectTerms | None:
        """Effects as they are typed: ``none``, ``auto``, or names with commas or as a sequence.

        CalibrationError for a name that is unknown.
        """
        names = effects.split(",") if isinstance(effects, str) else list(effects or ())
        names = [name.strip() for name in names]
        if names in ([], ["none"]):
            return None
        if names == ["auto"]:
            return cls()
        for name in names:
            if name not in get_args(EffectName):
                raise CalibrationError(
                    f"effect {name!r} is unknown: use auto or none alone, or some of "
                    f"{', '.join(get_args(EffectName))}."
                )
        return cls(tuple(dict.fromkeys(names)))


@dataclass(frozen=True)
class FixedMount:
    """A camera that the Earth turns, and nothing else.

    Attributes
    ----------
    sigma_arcsec : float
        How far the mount moves from frame to frame about each axis, standard deviation, arcsec.
    """

    sigma_arcsec: float

    def __post_init__(self) -> None:
        if not 0.0 < self.sigma_arcsec < float("inf"):
            raise CalibrationError(
                f"mount_sigma_arcsec is {self.sigma_arcsec!r}: state how far the mount moves from "
                "frame to frame, such as 1.0."
            )


@dataclass(frozen=True)
class Likelihood:
    """What the refinement maximises, the attitudes marginalised.

    Attributes
    ----------
    noise : {"common", "model"}
        One noise for all stars (or one factor on what they state), or a variance that is fitted as
        a function of radius, magnitude, frame and axis.
    tails : StudentTails or None
        Tails of the residuals; None for Gaussian ones.
    terms : tuple of StarDirections or EffectTerms
        Terms that are linear in the pixels and have a prior, marginalised.
    ties : RelativeAttitudes, FixedMount or None
        Known rotations between frames; None where every attitude is free.
    """

    noise: NoiseKind = "common"
    tails: StudentTails | None = None
    terms: tuple[StarDirections | EffectTerms, ...] = ()
    ties: RelativeAttitudes | FixedMount | None = None

    @property
    def name(self) -> str:
        """``marginal`` or ``student_t``, by the distribution of the residuals."""
        return "marginal" if self.tails is None else "student_t"

    @property
    def star_errors(self) -> bool:
        """Whether stars bring along errors of their directions."""
        return any(isinstance(term, StarDirections) for term in self.terms)

    @property
    def effects(self) -> EffectTerms | None:
        """Effects beyond the camera; None where there are none."""
        return next((term for term in self.terms if isinstance(term, EffectTerms)), None)
