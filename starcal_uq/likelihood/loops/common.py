"""What the loops share: a model's functions for a chunk of stars, directions, arguments."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numba import cfunc, njit, types
from numba.extending import intrinsic

from starcal_uq.camera.distortion import get_model
from starcal_uq.camera.kernels import Kernel
from starcal_uq.camera.projection import (
    backward_kernel,
    bent_index,
    forward_kernel,
    newton_kernel,
    slope_kernel,
)
from starcal_uq.core.types import FloatArray
from starcal_uq.likelihood.expansion import expand, follow, packed
from starcal_uq.likelihood.loops.unrolled import STAR_FUNCTION, STRIDE, Code, Stars, call
from starcal_uq.observations.frames import StarFrames

F = TypeVar("F", bound=Callable[..., Any])
CHUNK = 128
# Rows of the buffer `work`: the direction, or the pixel; the root; the target, then the pixel.
WORK = 8
_NEWTON_STEPS = 60

# Sums in another order, fused products, shared reciprocals: nothing that changes what becomes of
# NaN and infinity.
_FAST = {"contract", "reassoc", "nsz", "arcp"}


def _kept(make: Callable[[bool], Any]) -> Any:
    try:
        return make(True)
    except RuntimeError:
        # No folder can be written: compiled for this process alone.
        return make(False)


def compiled(entry: bool = False) -> Callable[[F], F]:
    """Decorate a function that Numba compiles; an `entry` is called from Python, and kept.

    It allocates nothing, so that Numba need not count references.
    """
    options = {"nogil": True, "error_model": "numpy", "fastmath": _FAST, "_nrt": False}
    # Not all versions of Numba declare all of its options.
    make: Any = njit

    def decorated(function: F) -> F:
        def made(keep: bool) -> Any:
            return make(cache=keep, no_cpython_wrapper=not entry, no_cfunc_wrapper=True, **options)(
                function
            )

        wrapped: F = _kept(made) if entry else made(False)
        return wrapped

    return decorated


# Functions of a chunk of stars that are no kernels of the model.
_COLUMNS: dict[str, Callable[..., None]] = {
    "expand": expand,
    "follow": follow,
    "gather": partial(follow, by_frame=True),
}


def _kernel(what: str, model: str) -> Kernel:
    if what in ("first", "bent"):
        return forward_kernel(model, what)
    if what == "slope":
        return slope_kernel(model, True)
    return newton_kernel(model) if what == "root" else backward_kernel(model, what == "derivatives")


def _star_code(typingctx: Any, key: Any, numbers: Any, one: Any, two: Any, m: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        what, model, _ = key.literal_value.split()
        stars, p = Stars(Code(context, builder), args[1:]), 3 + len(get_model(model).coefficients)
        if what in _COLUMNS:
            _COLUMNS[what](stars, model, p)
            return context.get_dummy_value()
        kernel = _kernel(what, model)
        reads: list[Sequence[int | float]] = [(0, 1, 2), (3, 4)]
        # e, H, A and second derivatives.
        writes, step = (0, 2, 2 + 2 * p, 8 + 2 * p)[: len(kernel.shapes)], 1
        if what in ("direction", "derivatives"):
            # Derivatives come as rows of (p, 3).
            reads, writes = [(0, 1), (3, 4)], (0, 3)[: len(kernel.shapes)]
        elif what == "root":
            reads, writes = [(6, 7), (3, 4)], (0, 2)
        elif what == "slope":
            # Stars are weighted afterwards. One number takes the place of two axes, and stands
            # where H and A do.
            inverse = [WORK + 3 * p + packed(i, j) for i in range(3) for j in range(3)]
            reads += [(6, 7), (1.0, 0.0, 0.0, 1.0), inverse]
            writes, step = (2,), 2
        stars.kernel(kernel, p, reads, writes, step)
        return context.get_dummy_value()

    return types.void(key, numbers, one, two, m), codegen


_written: Any = intrinsic(prefer_literal=True)(_star_code)


@cache
def _digest(text: str = "") -> str:
    """Numba looks at the file of a function that it kept; it depends on others, and on the model."""
    for path in sorted(Path(__file__).parent.glob("*.py")):
        text += path.read_text("utf-8")
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def star_function(what: str, model: str) -> int:
    """Address of a compiled function of a model, for a chunk of stars: ``first``, ``bent``,
    ``direction``, ``derivatives`` and ``slope`` are its kernels, ``root`` solves for points,
    ``follow``, ``expand`` and ``gather`` make columns.

    Only these know the model; all loops around them are compiled once.
    """
    return int(_made(what, model).address)


@cache
def _made(what: str, model: str) -> Any:
    text = str(bent_index(model) if what in _COLUMNS else _kernel(what, model).function)
    key, p = f"{what} {model} {_digest(text)}", 3 + len(get_model(model).coefficients)

    # The key is part of what Numba knows a kept function by.
    def visit(numbers: Any, one: Any, two: Any, m: Any) -> None:
        _written(key, numbers, one, two, m)

    def root(theta: Any, work: Any, buf: Any, m: Any) -> None:
        """Newton's method for the points that a model displaces to the targets, as
        `solve_displacement` does it.
        """
        flat = True
        for q in range(3, p):
            flat = flat and theta[q] == 0.0
        if flat:
            return
        for step in range(_NEWTON_STEPS):
            moving = 0.0
            _written(key, theta, work, buf, m)
            for i in range(m):
                du, dv = buf[i] - work[3 * STRIDE + i], buf[STRIDE + i] - work[4 * STRIDE + i]
                far = max(abs(du), abs(dv)) >= 1e-5
                # Past a fold the determinant changes sign: that branch is not an image of the
                # field.
                lost = not buf[2 * STRIDE + i] > 0.0 or (far and step == _NEWTON_STEPS - 1)
                moving += 1.0 if far and not lost else 0.0
                work[3 * STRIDE + i] = np.nan if lost else buf[i]
                work[4 * STRIDE + i] = np.nan if lost else buf[STRIDE + i]
            if moving == 0.0:
                return

    function = root if what == "root" else visit

    return _kept(
        lambda keep: cfunc(STAR_FUNCTION, cache=keep, fastmath=_FAST, error_model="numpy")(function)
    )


@compiled()
def fill_directions(
    root: int,
    theta: Any,
    sky: Any,
    s0: int,
    m: int,
    first: int,
    work: Any,
    buf: Any,
) -> None:
    """Directions of a chunk in the camera frame into rows 0 to 2 of `work`, roots into 3 and 4.

    `sky` are the stars' directions, where frames start, and rotations; `first` is the first frame.
    """
    (r0, r1, r2), starts, rotations = sky
    f, j = first, 0
    while j < m:
        while starts[f + 1] <= s0 + j:
            f += 1
        end = min(starts[f + 1] - s0, m)
        for q in range(3):
            k, to = 9 * f + 3 * q, q * STRIDE
            a, b, c = rotations[k], rotations[k + 1], rotations[k + 2]
            for i in range(j, end):
                work[to + i] = a * r0[s0 + i] + b * r1[s0 + i] + c * r2[s0 + i]
        j = end
    if root != 0:
        for i in range(m):
            scale = theta[2] / work[2 * STRIDE + i]
            u, v = scale * work[i], scale * work[STRIDE + i]
            work[3 * STRIDE + i] = work[6 * STRIDE + i] = u
            work[4 * STRIDE + i] = work[7 * STRIDE + i] = v
        call(root, theta, work, buf, m)


class _Version:
    """An argument of every entry: loops of another version are not taken for these."""

    _numba_type_ = types.StringLiteral(_digest())


VERSION = _Version()


def root_of(model: str, explicit: str) -> int:
    """Address of the search for points; zero where there is nothing to search for: no coefficients,
    or a model that is explicit in this direction.
    """
    known = get_model(model)
    there = known.direction == explicit or not known.coefficients
    return 0 if there else star_function("root", model)


def rows(n: int) -> FloatArray:
    """A buffer of so many rows, each of whole lines of the cache."""
    room = np.zeros(n * STRIDE + 8)
    return room[-room.ctypes.data // 8 % 8 :][: n * STRIDE]


def given(array: Any) -> Any:
    """An array that is read: contiguous and marked as such, which is one type for Numba."""
    view = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view


def columns_of(frames: StarFrames) -> Any:
    return tuple(map(given, (*frames.pixel, *frames.r)))


def symmetric(upper: FloatArray) -> FloatArray:
    """A symmetric matrix from its upper triangle; what stands below does not count."""
    upper = np.triu(upper)
    whole = upper + upper.T
    whole.flat[:: len(whole) + 1] = upper.diagonal()
    return whole
