"""One status for every solver: how it ended, and what the user can do about it."""

from __future__ import annotations

from enum import Enum


class Status(Enum):
    """How an estimation ended; the value is the remedy, in words."""

    CONVERGED = "converged"
    MAX_ITERATIONS = "the iteration limit was reached first: start closer to the optimum or raise max_iterations"
    SINGULAR = (
        "the data do not determine every parameter: add frames or stars spread over the field, "
        "or choose a distortion model with fewer coefficients"
    )
    STALLED = "no step lowers the cost although the gradient is not zero: check the scale of the start values"
    OUTSIDE_DETECTOR = (
        "the principal point left the detector: check the identifications and the nominal camera, "
        "or use solver='ipopt', which keeps it inside"
    )
    FOLDED = (
        "the distortion folds over inside the field: choose a model with fewer coefficients or use solver='ipopt', "
        "which keeps the distortion monotonic"
    )
    NOT_FINITE = "the model is not finite at the start: check the nominal camera against the observations"
    INCONSISTENT = (
        "the fit is far worse than centroid noise can explain: check the star identifications, "
        "the parity of the axes and the nominal focal length"
    )

    @property
    def ok(self) -> bool:
        """True for a converged estimate."""
        return self is Status.CONVERGED

    @property
    def remedy(self) -> str:
        """What the user can do, in one clause."""
        return self.value
