"""The sums over frames as loops for Numba: the same numbers as the NumPy path, several times faster.

The source is generated for one distortion model: its kernels come from the instructions of CasADi, and what has a fixed
number of terms is written out, so that accumulators stay in registers. Stars are visited in chunks whose columns stay
in the first cache; a column is a row of `CHUNK` numbers in one buffer, at a distance that the compiler knows.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import Any

import numpy as np

from starcal_uq.camera import compiled
from starcal_uq.camera.distortion import get_model
from starcal_uq.camera.kernels import Kernel, emit_source
from starcal_uq.camera.projection import forward_kernel, newton_kernel
from starcal_uq.core.types import FloatArray
from starcal_uq.observations.frames import StarFrames

_CHUNK = 128
_NONE = np.empty(0)

_HEAD = """
import numpy as np
from numba import float64, int64, njit, types

P, CHUNK, ROWS, EXPLICIT = {p}, {chunk}, {rows}, {explicit}
SMALL = {p} + {p} * ({p} + 1) // 2 + 1
# Sums in another order and fused products, nothing that changes what is done with NaN and infinity.
ORDERED = dict(nogil=True, cache=True, error_model="numpy", fastmath={{"contract"}})
FAST = dict(nogil=True, cache=True, error_model="numpy", fastmath={{"contract", "reassoc", "nsz"}})
INLINE = dict(nogil=True, inline="always", error_model="numpy", fastmath={{"contract", "reassoc", "nsz"}})
"""

_LOOPS = '''
@njit(**FAST)
def fill_root(theta, buf, row, target, m):
    """Newton's method for the point that a model displaces to the targets; as `solve_displacement` does it."""
    flat = True
    for q in range(3, P):
        flat = flat and theta[q] == 0.0
    for i in range(m):
        x, y = buf[target * CHUNK + i], buf[(target + 1) * CHUNK + i]
        u, v = x, y
        if not flat:
            settled = False
            for _ in range(60):
                newton(theta, x, y, u, v, buf, row, i)
                du, dv = buf[row * CHUNK + i] - u, buf[(row + 1) * CHUNK + i] - v
                u, v = buf[row * CHUNK + i], buf[(row + 1) * CHUNK + i]
                if not buf[(row + 2) * CHUNK + i] > 0.0:
                    break
                if max(abs(du), abs(dv)) < 1e-5:
                    settled = True
                    break
            if not settled:
                u, v = np.nan, np.nan
        buf[row * CHUNK + i] = u
        buf[(row + 1) * CHUNK + i] = v


@njit(**FAST)
def fill_directions(theta, r0, r1, r2, starts, rotations, s0, m, first, work):
    """Directions of a chunk in the camera frame into rows 0 to 2 of `work`, roots into rows 3 and 4."""
    f, j = first, 0
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
            work[CHUNK + i] = a10 * x + a11 * y + a12 * z
            work[2 * CHUNK + i] = a20 * x + a21 * y + a22 * z
        j = end
    if EXPLICIT:
        return
    for i in range(m):
        scale = theta[2] / work[2 * CHUNK + i]
        work[6 * CHUNK + i] = scale * work[i]
        work[7 * CHUNK + i] = scale * work[CHUNK + i]
    fill_root(theta, work, 3, 6, m)


@njit(**FAST)
def fill_columns(theta, turn, x0, y0, r0, r1, r2, weight, starts, rotations, s0, m, first, work, buf):
    """A, e and H' of a chunk."""
    fill_directions(theta, r0, r1, r2, starts, rotations, s0, m, first, work)
    for i in range(m):
        x, y, z, u, v = work[i], work[CHUNK + i], work[2 * CHUNK + i], work[3 * CHUNK + i], work[4 * CHUNK + i]
        first_kernel(theta, x, y, z, u, v, buf, i)
    for i in range(m):
        buf[6 * CHUNK + i] = x0[s0 + i] - buf[6 * CHUNK + i]
        buf[7 * CHUNK + i] = y0[s0 + i] - buf[7 * CHUNK + i]
    if len(weight) > 0:
        for q in range(2 * ROWS):
            for i in range(m):
                buf[q * CHUNK + i] *= weight[s0 + i]
    for q in range(P):
        t0, t1, t2 = turn[0, q], turn[1, q], turn[2, q]
        for x in range(2):
            o = (8 + 2 * q + x) * CHUNK
            for i in range(m):
                buf[o + i] -= (
                    t0 * buf[x * CHUNK + i] + t1 * buf[(2 + x) * CHUNK + i] + t2 * buf[(4 + x) * CHUNK + i]
                )


@njit(**FAST)
def inverse3(acc, out):
    """Inverse of the symmetric 3 x 3 matrix in the upper corner of `acc`: six entries; its determinant comes back."""
    xx, xy, xz, yy, yz, zz = acc[0, 0], acc[0, 1], acc[0, 2], acc[1, 1], acc[1, 2], acc[2, 2]
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    determinant = xx * a + xy * b + xz * c
    out[0], out[1], out[2] = a / determinant, b / determinant, c / determinant
    out[3], out[4] = (xx * zz - xz * xz) / determinant, (xy * xz - xx * yz) / determinant
    out[5] = (xx * yy - xy * xy) / determinant
    return determinant


@njit(FRAME_SUMS, **FAST)
def frame_sums(theta, x0, y0, r0, r1, r2, weight, starts, rotations, residuals, gram, shift, response, inverse, volume):
    work, buf = np.zeros(8 * CHUNK), np.empty(2 * ROWS * CHUNK)
    acc, inv, turn = np.zeros((3, ROWS)), np.empty(6), np.zeros((3, P))
    n, first, s0 = starts[len(starts) - 1], 0, 0
    m = min(CHUNK, n)
    fill_columns(theta, turn, x0, y0, r0, r1, r2, weight, starts, rotations, 0, m, 0, work, buf)
    frame_products(buf, 0, m, acc)
    inverse3(acc, inv)
    for q in range(P):
        a, b, c = acc[0, 4 + q], acc[1, 4 + q], acc[2, 4 + q]
        turn[0, q] = inv[0] * a + inv[1] * b + inv[2] * c
        turn[1, q] = inv[1] * a + inv[3] * b + inv[4] * c
        turn[2, q] = inv[2] * a + inv[4] * b + inv[5] * c
    if not np.all(np.isfinite(turn)):
        turn[:] = 0.0
    acc[:] = 0.0
    while s0 < n:
        m = min(CHUNK, n - s0)
        fill_columns(theta, turn, x0, y0, r0, r1, r2, weight, starts, rotations, s0, m, first, work, buf)
        if residuals.shape[1] > 0:
            for x in range(2):
                for i in range(m):
                    residuals[x, s0 + i] = buf[(6 + x) * CHUNK + i]
        chunk_products(buf, m, gram)
        f, j = first, 0
        while j < m:
            while starts[f + 1] <= s0 + j:
                f += 1
            end = min(starts[f + 1] - s0, m)
            frame_products(buf, j, end, acc)
            j = end
            if s0 + j == starts[f + 1]:
                volume[f] = np.log(inverse3(acc, inv))
                inverse[0, 0, f], inverse[0, 1, f], inverse[0, 2, f] = inv[0], inv[1], inv[2]
                inverse[1, 0, f], inverse[1, 1, f], inverse[1, 2, f] = inv[1], inv[3], inv[4]
                inverse[2, 0, f], inverse[2, 1, f], inverse[2, 2, f] = inv[2], inv[4], inv[5]
                for q in range(P + 1):
                    s, t, u = acc[0, 3 + q], acc[1, 3 + q], acc[2, 3 + q]
                    g0 = inv[0] * s + inv[1] * t + inv[2] * u
                    g1 = inv[1] * s + inv[3] * t + inv[4] * u
                    g2 = inv[2] * s + inv[4] * t + inv[5] * u
                    for p in range(q + 1):
                        gram[p, q] -= acc[0, 3 + p] * g0 + acc[1, 3 + p] * g1 + acc[2, 3 + p] * g2
                    if q == 0:
                        shift[0, f], shift[1, f], shift[2, f] = g0, g1, g2
                    else:
                        response[0, q - 1, f] = -g0 - turn[0, q - 1]
                        response[1, q - 1, f] = -g1 - turn[1, q - 1]
                        response[2, q - 1, f] = -g2 - turn[2, q - 1]
                acc[:] = 0.0
        first = f
        s0 += m
'''

_SIGNATURES = """
ONE, TWO, THREE = float64[::1], float64[:, ::1], float64[:, :, ::1]
GIVEN, TABLE, BLOCKS = (types.Array(float64, n, "C", readonly=True) for n in (1, 2, 3))
THETA = types.UniTuple(float64, P)
STARS = (*[GIVEN] * 6, types.Array(int64, 1, "C", readonly=True), BLOCKS)
FRAME_SUMS = types.void(THETA, *STARS, TWO, TWO, TWO, THREE, THREE, ONE)
"""


def _row(first: Iterable[int]) -> Any:
    """Where the elements of each output stand in the buffer."""
    starts = list(first)
    return lambda output, element: f"out[{starts[output] + element} * CHUNK + i]"


def _scalar_source(kernel: Kernel, name: str, first: Iterable[int]) -> str:
    """A kernel for one star: its outputs go to rows of the buffer that begin at `first`, in column i."""
    arguments = [None, ("x", "y", "z"), ("u", "v")]

    def read(source: int, element: int) -> str:
        names = arguments[source]
        return f"t[{element}]" if names is None else names[element]

    return emit_source(kernel.function, name, "t, x, y, z, u, v, out, i", read, _row(first))


def _newton_source(kernel: Kernel) -> str:
    names = ("t", ("x", "y"), ("u", "v"))

    def read(source: int, element: int) -> str:
        return f"t[{element}]" if source == 0 else names[source][element]

    def write(output: int, element: int) -> str:
        return f"out[(row + {2 * output + element}) * CHUNK + i]"

    return emit_source(kernel.function, "newton", "t, x, y, u, v, out, row, i", read, write)


def _products_source(name: str, arguments: str, begin: str, end: str, pairs: list[tuple[int, int]], offset: int) -> str:
    """Sums of products of rows (two axes each) from `begin` to `end`, added to entries of a matrix.

    Row and column of the matrix are those of the pairs less `offset`.
    """
    needed = sorted({row for pair in pairs for row in pair})
    lines = [f"def {name}(buf, {arguments}, total):"]
    lines += [f"    s{a}_{b} = 0.0" for a, b in pairs]
    lines.append(f"    for i in range({begin}, {end}):")
    lines += [f"        v{row}_{x} = buf[{2 * row + x} * CHUNK + i]" for row in needed for x in range(2)]
    lines += [f"        s{a}_{b} += v{a}_0 * v{b}_0 + v{a}_1 * v{b}_1" for a, b in pairs]
    lines += [f"    total[{a - offset}, {b - offset}] += s{a}_{b}" for a, b in pairs]
    return "\n".join(lines) + "\n"


@lru_cache(maxsize=16)
def source(model_name: str) -> str:
    """Source of the loops for one distortion model."""
    p = 3 + len(get_model(model_name).coefficients)
    rows = p + 4
    explicit = get_model(model_name).direction == "forward"
    with_attitude = [(c, q) for c in range(3) for q in range(c, rows)]
    among = [(a, b) for a in range(3, rows) for b in range(a, rows)]
    return "\n\n".join(
        [
            _HEAD.format(p=p, chunk=_CHUNK, rows=rows, explicit=explicit) + _SIGNATURES,
            "@njit(**INLINE)\n" + _scalar_source(forward_kernel(model_name, "first"), "first_kernel", (6, 8, 0)),
            "@njit(**INLINE)\n" + _newton_source(newton_kernel(model_name)),
            "@njit(**ORDERED)\n" + _products_source("frame_products", "j, end", "j", "end", with_attitude, 0),
            "@njit(**FAST)\n" + _products_source("chunk_products", "m", "0", "m", among, 3),
            _LOOPS,
        ]
    )


def wanted(model_name: str, n_stars: int) -> bool:
    """Whether the compiled loops are to be used for so many stars."""
    return compiled.chosen(n_stars, lambda: source(model_name)) == "numba"


def _stars(frames: StarFrames, rotations: FloatArray) -> tuple[Any, ...]:
    weight = _NONE if frames.weight is None else np.ascontiguousarray(frames.weight)
    return (*frames.pixel, *frames.r, weight, frames.starts, np.ascontiguousarray(rotations))


def frame_loop(
    frames: StarFrames, model_name: str, theta: FloatArray, rotations: FloatArray, residuals: FloatArray | None
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Gram matrix (p + 1, p + 1) of e and H with the attitudes eliminated, and what `Attitudes` holds of every frame.

    Shift (3, K), response (3, p, K), inverse (3, 3, K) and log determinant (K,): see `starcal_uq.estimation.sums`.
    """
    p, k = len(theta), frames.n_frames
    gram, shift, response = np.zeros((p + 1, p + 1)), np.empty((3, k)), np.empty((3, p, k))
    inverse, volume = np.empty((3, 3, k)), np.empty(k)
    into = np.empty((2, 0)) if residuals is None else residuals
    loops = compiled.load(model_name, source(model_name))
    loops.frame_sums(tuple(theta.tolist()), *_stars(frames, rotations), into, gram, shift, response, inverse, volume)
    upper = np.triu(gram, 1)
    return np.triu(gram) + upper.T, shift, response, inverse, volume
