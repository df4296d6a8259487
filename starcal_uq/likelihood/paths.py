"""The choice between the two paths of the sums over stars: NumPy, and loops compiled by Numba.

Both give the same to rounding. The extra ``compiled`` installs Numba; loops are then
used from `WORTH_LOADING` stars on. The number of stars alone decides, so that the same data give
the same digits in every process of a machine, whatever was compiled before; provenance says which
path ran. For comparisons, the environment variable ``STARCAL_UQ_KERNELS`` (`use` sets it) asks for
``numpy`` or ``numba`` at any size.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import os
from collections.abc import Iterator
from typing import Protocol

from starcal_uq.core.errors import StarcalError
from starcal_uq.core.extras import extra
from starcal_uq.core.types import FloatArray
from starcal_uq.likelihood import arrays
from starcal_uq.observations.frames import StarFrames

SWITCH = "STARCAL_UQ_KERNELS"
CHOICES = ("auto", "numpy", "numba")
# Stars from which loops are worth loading (0.6 s), once they have been compiled.
WORTH_LOADING = 200_000


def use(choice: str) -> None:
    """Choose ``numpy``, ``numba`` or ``auto`` for this process and those that it starts."""
    _check(choice)
    os.environ[SWITCH] = choice


@contextlib.contextmanager
def using(choice: str) -> Iterator[None]:
    """As `use`, for a while."""
    before = os.environ.get(SWITCH)
    use(choice)
    try:
        yield
    finally:
        if before is None:
            del os.environ[SWITCH]
        else:
            os.environ[SWITCH] = before


def _check(choice: str) -> None:
    if choice not in CHOICES:
        raise StarcalError(
            f"kernels {choice!r} are unknown: set {SWITCH} to one of {', '.join(CHOICES)}."
        )
    if choice == "numba" and not installed():
        with extra("compiled", "compiled kernels", f"set {SWITCH}=numpy"):
            raise ModuleNotFoundError(name="numba")


def installed() -> bool:
    """Whether Numba is there; it is not imported for that."""
    return importlib.util.find_spec("numba") is not None


def chosen(n_stars: int) -> str:
    """``numpy`` or ``numba`` for sums over so many stars."""
    choice = os.environ.get(SWITCH, "auto").strip().lower() or "auto"
    _check(choice)
    if choice != "auto":
        return choice
    return "numba" if n_stars >= WORTH_LOADING and installed() else "numpy"


def path_of(frames: StarFrames) -> str:
    """``numpy`` or ``numba`` for sums over these frames; loops know no noise of each axis."""
    return "numpy" if frames.axes is not None else chosen(frames.n_stars)


class Sums(Protocol):
    """Sums over the stars of some frames: what `starcal_uq.likelihood.arrays` and
    `starcal_uq.likelihood.loops` both are.
    """

    def normals(
        self,
        frames: StarFrames,
        model_name: str,
        theta: FloatArray,
        rotations: FloatArray,
        /,
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Gram matrix (p + 1, p + 1) of e and H with the attitudes eliminated, and what
        `starcal_uq.likelihood.sums.Attitudes` holds of every frame: shift, response, inverse and
        log determinant.
        """

    def gram(
        self,
        frames: StarFrames,
        model_name: str,
        theta: FloatArray,
        whitening: FloatArray,
        rotations: FloatArray,
        response: FloatArray,
        inverse: FloatArray,
        /,
    ) -> tuple[FloatArray, FloatArray]:
        """Gram matrix (q, q) of `starcal_uq.likelihood.compressed.GramSums`, and the slope (p,) of
        the log determinant.

        `response` (3, p, K) and `inverse` (3, 3, K) are those of the frames, whose best attitudes
        are `rotations`.
        """

    def slope(
        self,
        frames: StarFrames,
        model_name: str,
        theta: FloatArray,
        rotations: FloatArray,
        response: FloatArray,
        inverse: FloatArray,
        /,
    ) -> FloatArray:
        """Slope (p,) of ``(e^T e + sigma**2 log |A^T A|) / 2`` along theta, attitudes following.

        The inverse is that of `gram` times ``sigma**2``.
        """

    def pairs(
        self, frames: StarFrames, model_name: str, theta: FloatArray, rotations: FloatArray, /
    ) -> tuple[float, FloatArray, FloatArray]:
        """Cost, Gauss-Newton matrix (p, p) and gradients (p, K) of frames over interstar angles.

        `rotations` (K, 3, 3) turn the catalogue nearly into the camera frame.
        """

    def attitudes(
        self,
        frames: StarFrames,
        model_name: str,
        theta: FloatArray,
        weights: FloatArray | None = None,
        /,
    ) -> FloatArray:
        """Attitudes (K, 3, 3) by QUEST at theta, with weights (N,) of the stars; NaN where stars
        determine none.
        """


def sums_for(frames: StarFrames) -> Sums:
    """What makes the sums over these frames."""
    if path_of(frames) == "numpy":
        return arrays
    # Numba is imported where it is needed.
    return importlib.import_module("starcal_uq.likelihood.loops")
