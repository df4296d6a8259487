"""Options of the recursive methods, checked in one place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.types import AnyDict
from starcal_uq.estimation.recursive.innovations import PAIR_COVARIANCES, PairCovariance

RECURSIVE_METHODS = ("samaan", "griffith")


@dataclass(frozen=True)
class RecursionOptions:
    """How a recursive method (``samaan``, ``griffith``) goes from frame to frame.

    Attributes
    ----------
    pair_covariance : {"full", "diagonal"}
        Covariance of the interstar angles of a frame: with the correlations of pairs that share a star, or, as in the
        historical filters, as if pairs were independent.
    parameters : {"optics", "all"}
        What the recursion estimates: x0, y0 and f as in its source, or the distortion as well (``griffith`` only).
    process_noise : float or tuple of float, optional
        ``samaan`` only: standard deviation of each parameter's random walk from frame to frame, px; needs a stated
        noise. One number stands for all three.
    forgetting : float
        ``griffith`` only: weight of all earlier frames against the next, in (0, 1]; 1 forgets nothing. It remembers
        about ``1 / (1 - forgetting)`` frames.
    start_frames : int
        ``samaan`` only: frames whose least-squares solution starts the filter.
    sigma_px : float, optional
        Stated centroid noise per axis, px, where the stars do not state their own.
    iterations : int
        Most linearisations of a frame; 1 is the plain filter, which takes each frame once, linearised where the frame
        before has ended. From a start far off it keeps the error of its first frames.
    """

    pair_covariance: PairCovariance = "full"
    parameters: str = "optics"
    process_noise: float | tuple[float, ...] | None = None
    forgetting: float = 1.0
    start_frames: int = 10
    sigma_px: float | None = None
    iterations: int = 12

    def check(self, method: str) -> None:
        """Refuse what makes no sense.

        Raises
        ------
        CalibrationError
            In one sentence, with the remedy.
        """
        if self.pair_covariance not in PAIR_COVARIANCES:
            raise CalibrationError(
                f"pair_covariance {self.pair_covariance!r} is unknown: use one of {', '.join(PAIR_COVARIANCES)}."
            )
        if self.parameters not in ("optics", "all"):
            raise CalibrationError(f"parameters {self.parameters!r} is unknown: use one of optics, all.")
        if not 0.0 < self.forgetting <= 1.0:
            raise CalibrationError(f"forgetting is {self.forgetting}: use a number above 0 and up to 1.")
        if self.sigma_px is not None and not 0.0 < self.sigma_px < np.inf:
            raise CalibrationError(f"sigma_px is {self.sigma_px}: use a positive number of pixels.")
        for name in ("start_frames", "iterations"):
            if getattr(self, name) < 1:
                raise CalibrationError(f"{name} is {getattr(self, name)}: use 1 or more.")
        if self.process_noise is not None:
            noise = np.atleast_1d(np.asarray(self.process_noise, dtype=np.float64))
            if noise.shape not in ((1,), (3,)) or not (np.isfinite(noise).all() and (noise >= 0.0).all()):
                raise CalibrationError(
                    f"process_noise is {self.process_noise}: use one number of pixels per frame that is not negative, "
                    "or three, for x0, y0 and f."
                )
        if method == "samaan":
            if self.parameters == "all":
                raise CalibrationError("samaan filters the optics only: use griffith for parameters='all'.")
            if self.forgetting != 1.0:
                raise CalibrationError("samaan forgets by process_noise: leave forgetting out, or use griffith.")
        elif self.process_noise is not None:
            raise CalibrationError("griffith has no process noise: use forgetting, or samaan.")

    def to_dict(self) -> AnyDict:
        """Plain values, for a file."""
        values = asdict(self)
        if isinstance(self.process_noise, Sequence):
            values["process_noise"] = list(self.process_noise)
        return values

    @classmethod
    def from_dict(cls, values: AnyDict) -> RecursionOptions:
        """Inverse of `to_dict`."""
        noise = values.get("process_noise")
        return cls(**(values | {"process_noise": tuple(noise) if isinstance(noise, list) else noise}))
