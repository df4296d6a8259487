"""What the loops share: kernels at a star, a chunk's directions, arguments."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numba import njit, types
from numba.extending import overload

from starcal_uq.camera.distortion import get_model
from starcal_uq.camera.projection import backward_kernel, forward_kernel, newton_kernel
from starcal_uq.core.types import FloatArray
from starcal_uq.likelihood.loops.unrolled import STRIDE, name_of, star_kernel
from starcal_uq.observations.frames import StarFrames

F = TypeVar("F", bound=Callable[..., Any])
CHUNK = 128
_NEWTON_STEPS = 60
_NONE = np.empty(0)
_SOURCES = sorted(Path(__file__).parent.glob("*.py"))

# Sums in another order, fused products, shared reciprocals: nothing that changes what becomes of
# NaN and infinity.
_FAST = frozenset({"contract", "reassoc", "nsz", "arcp"})
ORDERED = frozenset({"contract"})


def compiled(entry: bool = False, fastmath: frozenset[str] = _FAST) -> Callable[[F], F]:
    """Decorate a function that Numba compiles; an `entry` is called from Python, and kept."""
    options = {"nogil": True, "error_model": "numpy", "fastmath": set(fastmath)}
    # Not all versions of Numba declare all of its options.
    make: Any = njit

    def kept(function: F) -> F:
        wrapped: F
        try:
            wrapped = make(
                cache=entry, no_cpython_wrapper=not entry, no_cfunc_wrapper=True, **options
            )(function)
        except RuntimeError:
            # No folder can be written: compiled for this process alone.
            wrapped = make(no_cfunc_wrapper=True, **options)(function)
        return wrapped

    return kept


# Rows of `work`: the direction, or the pixel; the root, and the determinant there; the target.
first_kernel = star_kernel(
    lambda name: forward_kernel(name, "first"), [(0, 1, 2), (3, 4)], lambda p: (6, 8, 0)
)
bent_kernel = star_kernel(
    lambda name: forward_kernel(name, "bent"),
    [(0, 1, 2), (3, 4)],
    lambda p: (0, 2, 2 + 2 * p, 8 + 2 * p),
)
newton = star_kernel(newton_kernel, [(6, 7), (3, 4)], lambda p: (3, 5))
direction_kernel = star_kernel(
    lambda name: backward_kernel(name, False), [(0, 1), (3, 4)], lambda p: (0,)
)
# Derivatives come as rows of (p, 3).
derivatives_kernel = star_kernel(
    lambda name: backward_kernel(name, True), [(0, 1), (3, 4)], lambda p: (0, 3)
)


@compiled()
def _solve_root(model: Any, theta: Any, work: FloatArray, m: int) -> None:
    """Newton's method for the points that a model displaces to the targets, as
    `solve_displacement` does it.
    """
    flat = True
    for q in range(3, len(theta)):
        flat = flat and theta[q] == 0.0
    for i in range(m):
        work[3 * STRIDE + i] = work[6 * STRIDE + i]
        work[4 * STRIDE + i] = work[7 * STRIDE + i]
    if flat:
        return
    for step in range(_NEWTON_STEPS):
        moving = 0.0
        for i in range(m):
            u, v = work[3 * STRIDE + i], work[4 * STRIDE + i]
            newton(model, theta, work, work, i)
            du, dv = work[3 * STRIDE + i] - u, work[4 * STRIDE + i] - v
            far = max(abs(du), abs(dv)) >= 1e-5
            # Past a fold the determinant changes sign: that branch is not an image of the field.
            lost = not work[5 * STRIDE + i] > 0.0 or (far and step == _NEWTON_STEPS - 1)
            moving += 1.0 if far and not lost else 0.0
            if lost:
                work[3 * STRIDE + i] = np.nan
                work[4 * STRIDE + i] = np.nan
        if moving == 0.0:
            return


def _nothing(model: Any, theta: Any, work: Any, m: Any) -> None:
    pass


def _solved(model: Any, theta: Any, work: Any, m: Any) -> None:
    _solve_root(model, theta, work, m)


def forward_root(model: Any, theta: Any, work: FloatArray, m: int) -> None:
    """Points on the sensor of ideal ones, where the model is not explicit in that direction."""


def backward_root(model: Any, theta: Any, work: FloatArray, m: int) -> None:
    """Ideal points of those on the sensor, where the model is not explicit in that direction."""


@overload(forward_root, prefer_literal=True)
def _(model: Any, theta: Any, work: Any, m: Any) -> Callable[..., None]:
    return _nothing if get_model(name_of(model)).direction == "forward" else _solved


@overload(backward_root, prefer_literal=True)
def _(model: Any, theta: Any, work: Any, m: Any) -> Callable[..., None]:
    return _solved if get_model(name_of(model)).direction == "forward" else _nothing


@compiled()
def fill_directions(
    model: Any,
    theta: Any,
    stars: Any,
    starts: Any,
    rotations: FloatArray,
    s0: int,
    m: int,
    first: int,
    work: FloatArray,
) -> None:
    """Directions of a chunk in the camera frame into rows 0 to 2 of `work`, roots into 3 and 4."""
    r0, r1, r2 = stars[2:]
    f, j = first, starts[0]
    while j < m:
        while starts[f + 1] <= s0 + j:
            f += 1
        end = min(starts[f + 1] - s0, m)
        a00, a01, a02 = rotations[f, 0, 0], rotations[f, 0, 1], rotations[f, 0, 2]
        a10, a11, a12 = rotations[f, 1, 0], rotations[f, 1, 1], rotations[f, 1, 2]
        a20, a21, a22 = rotations[f, 2, 0], rotations[f, 2, 1], rotations[f, 2, 2]
        for i in range(j, end):
            x, y, z = r0[s0 + i], r1[s0 + i], r2[s0 + i]
            work[i] = a00 * x + a01 * y + a02 * z
            work[STRIDE + i] = a10 * x + a11 * y + a12 * z
            work[2 * STRIDE + i] = a20 * x + a21 * y + a22 * z
        j = end
    for i in range(m):
        scale = theta[2] / work[2 * STRIDE + i]
        work[6 * STRIDE + i] = scale * work[i]
        work[7 * STRIDE + i] = scale * work[STRIDE + i]
    forward_root(model, theta, work, m)


def packed(i: int, j: int) -> int:
    """Place of an entry of a symmetric matrix among its six unique ones."""
    return 3 * min(i, j) - min(i, j) * (min(i, j) + 1) // 2 + max(i, j)


class _Literal:
    """A distortion model as an argument that is compiled for its name."""

    def __init__(self, name: str) -> None:
        # Numba looks at the file of a function that it kept; it depends on others, and on the model.
        kernels = (
            forward_kernel(name, "first"),
            forward_kernel(name, "bent"),
            backward_kernel(name, True),
            newton_kernel(name),
        )
        text = "".join(path.read_text("utf-8") for path in _SOURCES)
        text += "".join(str(kernel.function) for kernel in kernels)
        digest = hashlib.sha256(text.encode()).hexdigest()[:16]
        self._numba_type_ = types.StringLiteral(f"{name} {digest}")


literal_of = cache(_Literal)


def given(array: Any) -> Any:
    """An array that is read: contiguous and marked as such, which is one type for Numba."""
    view = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view


def columns_of(frames: StarFrames) -> Any:
    return tuple(map(given, (*frames.pixel, *frames.r)))


def weighted(frames: StarFrames, rotations: FloatArray) -> tuple[Any, Any, Any, Any]:
    weight = _NONE if frames.weight is None else frames.weight
    return columns_of(frames), given(weight), given(frames.starts), given(rotations)


def numbers_of(theta: FloatArray) -> tuple[float, ...]:
    return tuple(theta.tolist())


def symmetric(upper: FloatArray) -> FloatArray:
    """A symmetric matrix from its upper triangle, zeros below."""
    whole = upper + upper.T
    whole.flat[:: len(whole) + 1] = upper.diagonal()
    return whole
