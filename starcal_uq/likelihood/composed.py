"""The likelihood that a refinement maximises, composed of parts: noise, tails and star errors.

Every combination of parts makes sense. The noise of a star scales its residuals, whatever their
distribution; tails give every star a weight on top of that scale; errors that stars bring along are
linear in the pixels and have a prior, whatever weighs the pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.settings import NoiseKind
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
class Likelihood:
    """What the refinement maximises, the attitudes marginalised.

    Attributes
    ----------
    noise : {"common", "model"}
        One noise for all stars (or one factor on what they state), or a variance that is fitted as
        a function of radius, magnitude, frame and axis.
    tails : StudentTails or None
        Tails of the residuals; None for Gaussian ones.
    terms : tuple of StarDirections
        Terms that are linear in the pixels and have a prior, marginalised.
    """

    noise: NoiseKind = "common"
    tails: StudentTails | None = None
    terms: tuple[StarDirections, ...] = ()

    @property
    def name(self) -> str:
        """``marginal`` or ``student_t``, by the distribution of the residuals."""
        return "marginal" if self.tails is None else "student_t"

    @property
    def star_errors(self) -> bool:
        """Whether stars bring along errors of their directions."""
        return any(isinstance(term, StarDirections) for term in self.terms)
