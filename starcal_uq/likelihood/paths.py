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
from typing import Any

from starcal_uq.core.errors import StarcalError
from starcal_uq.core.extras import extra
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


def loops_for(frames: StarFrames) -> Any:
    """The module `starcal_uq.likelihood.loops` where it makes the sums over these frames, or None."""
    return load() if path_of(frames) == "numba" else None


def load() -> Any:
    """The module `starcal_uq.likelihood.loops`, which imports Numba."""
    return importlib.import_module("starcal_uq.likelihood.loops")
