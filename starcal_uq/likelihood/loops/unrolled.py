"""Straight-line code for compiled loops: the kernels of a camera model, sums of products of rows.

Written out, a formula keeps its values in registers; as Python source it would take Numba half a
minute to read. Here the formula is ordinary Python that runs once, on `Number`s in the place of
doubles, and every operation on these writes one instruction. The kernels of
`starcal_uq.camera.projection`, written for NumPy arrays, run on them as they are.

Stars are the columns of a buffer (rows, `STRIDE`): a row lies at a distance that the compiler
knows.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils as _cgutils
from numba.core import typing as _typing
from numba.extending import intrinsic

from starcal_uq.camera.kernels import Kernel
from starcal_uq.likelihood.expansion import added

# Their functions carry no types.
cgutils: Any = _cgutils
signature: Any = _typing.signature  # type: ignore[attr-defined]

# More than a chunk of stars, and no multiple of what makes rows compete for places in the cache.
STRIDE = 136


class Number:
    """A double of the function that is being compiled."""

    __add__: Any
    __sub__: Any
    __mul__: Any

    def __init__(self, code: Code, value: Any) -> None:
        self.code, self.value = code, value

    def __neg__(self) -> Number:
        minus_zero = self.code.number(-0.0).value
        return Number(self.code, self.code.builder.fsub(minus_zero, self.value))

    def __abs__(self) -> Number:
        return self.code.call(math.fabs, self)

    def __pow__(self, other: Number | float) -> Number:
        return self.code.call(math.pow, self, other)


def _operator(operation: str, swapped: bool = False) -> Any:
    """A method that writes one instruction."""

    def method(self: Number, other: Number | float) -> Number:
        a, b = self.value, self.code.number(other).value
        write = getattr(self.code.builder, operation)
        return Number(self.code, write(*((b, a) if swapped else (a, b))))

    return method


def _function(function: Any) -> Any:
    """A method that writes the call of a function of Python's `math`."""
    return lambda self, *others: self.code.call(function, self, *others)


# NumPy's functions call methods of their names of what is no array.
for _name in ("add", "sub", "mul", "truediv"):
    _instruction = f"f{_name.removeprefix('true')}"
    setattr(Number, f"__{_name}__", _operator(_instruction))
    setattr(Number, f"__r{_name}__", _operator(_instruction, swapped=True))
for _name in ("sqrt", "sin", "cos", "tan", "exp", "log", "hypot"):
    setattr(Number, _name, _function(getattr(math, _name)))
for _name in ("atan", "atan2"):
    setattr(Number, _name.replace("a", "arc", 1), _function(getattr(math, _name)))


class Code:
    """The function that is being compiled, at the place where instructions are written."""

    def __init__(self, context: Any, builder: Any) -> None:
        self.context, self.builder = context, builder

    def number(self, value: Any) -> Number:
        """A constant, or an instruction's result."""
        if isinstance(value, Number):
            return value
        return Number(
            self, ir.Constant(ir.DoubleType(), value) if isinstance(value, float) else value
        )

    def call(self, function: Any, *values: Number | float) -> Number:
        """A function of Python's `math`."""
        kind = signature(types.float64, *[types.float64] * len(values))
        write = self.context.get_function(function, kind)
        return Number(self, write(self.builder, [self.number(value).value for value in values]))

    def items(self, data: Any, n: int) -> list[Number]:
        """The first numbers at a pointer."""
        at = (self.builder.gep(data, [ir.Constant(ir.IntType(64), i)]) for i in range(n))
        return [self.number(self.builder.load(place)) for place in at]

    @contextmanager
    def stars(self, begin: Any, end: Any) -> Iterator[Any]:
        """A loop over columns."""
        kind = end.type
        with cgutils.for_range_slice(self.builder, begin, end, ir.Constant(kind, 1), kind) as (
            column,
            _,
        ):
            yield column

    def array(self, kind: Any, value: Any) -> Any:
        """An array by its type and value."""
        return self.context.make_array(kind)(self.context, self.builder, value)


class Rows:
    """Rows of a buffer at one column, as numbers: ``rows[n]`` is read or written."""

    def __init__(self, code: Code, data: Any, column: Any) -> None:
        self._code, self._column = code, column
        self._first = code.builder.gep(data, [column])

    def _place(self, row: int) -> Any:
        return self._code.builder.gep(self._first, [ir.Constant(self._column.type, row * STRIDE)])

    def __getitem__(self, row: int) -> Number:
        return Number(self._code, self._code.builder.load(self._place(row)))

    def __setitem__(self, row: int, value: Number | float) -> None:
        self._code.builder.store(self._code.number(value).value, self._place(row))


class _Output:
    """An output of a kernel, whose elements stand in every so many rows from `first` on."""

    def __init__(self, rows: Rows, first: int, step: int) -> None:
        self._rows, self._first, self._step = rows, first, step

    def __setitem__(self, element: int, value: Number | float) -> None:
        self._rows[self._first + self._step * element] = value


class Stars:
    """The first columns of two buffers, and numbers that all stars share, for a function that
    writes loops over them.
    """

    def __init__(self, code: Code, args: Sequence[Any]) -> None:
        self._code = code
        self._numbers, self._one, self._two, self._end = args

    def numbers(self, n: int) -> list[Number]:
        """The first numbers, to be read outside of a loop."""
        return self._code.items(self._numbers, n)

    @contextmanager
    def each(self) -> Iterator[tuple[Rows, Rows]]:
        """A loop: the rows of both buffers at each star."""
        with self._code.stars(ir.Constant(self._end.type, 0), self._end) as column:
            yield Rows(self._code, self._one, column), Rows(self._code, self._two, column)

    def kernel(
        self,
        kernel: Kernel,
        p: int,
        reads: Sequence[Sequence[int | float]],
        writes: Sequence[int],
        step: int = 1,
    ) -> None:
        """Write a kernel of a camera model at every star.

        `reads` are the rows of the first buffer of its inputs after theta, or what these are,
        `writes` the first row of the second buffer of each output, whose elements fill every
        `step`-th row from there on.
        """
        theta = self.numbers(p)
        with self.each() as (given, taken):
            rest = [[given[n] if isinstance(n, int) else n for n in rows] for rows in reads]
            kernel.run([theta, *rest], [_Output(taken, first, step) for first in writes])


_pointer_to: Any = types.CPointer
_POINTER = _pointer_to(types.float64)
# What is called for a chunk of stars: numbers, two buffers, how many stars.
STAR_FUNCTION = types.void(_POINTER, _POINTER, _POINTER, types.int64)


def _data(typingctx: Any, array: Any) -> Any:
    """Where the elements of a contiguous array begin: an index into that needs no checks."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return context.make_array(signature.args[0])(context, builder, args[0]).data

    return _pointer_to(array.dtype)(array), codegen


def _row(typingctx: Any, buf: Any, n: Any) -> Any:
    """The rows of a buffer from one on."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        distance = builder.mul(args[1], ir.Constant(args[1].type, STRIDE))
        return builder.gep(args[0], [distance])

    return buf(buf, n), codegen


def _call(typingctx: Any, address: Any, numbers: Any, one: Any, two: Any, m: Any) -> Any:
    """Call a function of `STAR_FUNCTION` at an address."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.FunctionType(ir.VoidType(), [each.type for each in args[1:]])
        builder.call(builder.inttoptr(args[0], kind.as_pointer()), args[1:])
        return context.get_dummy_value()

    return types.void(address, numbers, one, two, m), codegen


data: Any = intrinsic(_data)
row: Any = intrinsic(_row)
call: Any = intrinsic(_call)


def block_products(a: int, b: int, axes: int) -> Any:
    """Sums over stars of the products of `a` columns with `b` others, of so many axes each.

    ``f(one, two, begin, end, into, i, j)`` adds them to ``into[i:, j:]``; the columns are the rows
    from `one` and from `two` on. Nine sums are as many as registers hold with several stars in
    each.
    """

    @intrinsic
    def products(
        typingctx: Any, one: Any, two: Any, begin: Any, end: Any, into: Any, i: Any, j: Any
    ) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            code, kind = Code(context, builder), args[3].type
            sums = code.array(signature.args[4], args[4])
            zero = ir.Constant(ir.DoubleType(), 0.0)
            places = [cgutils.alloca_once_value(builder, zero) for _ in range(a * b)]
            with code.stars(args[2], args[3]) as column:
                rows, others = (Rows(code, args[n], column) for n in (0, 1))
                left = [rows[n] for n in range(a * axes)]
                right = [others[n] for n in range(b * axes)]
                for n, place in enumerate(places):
                    k, c = divmod(n, b)
                    terms = [left[axes * k + x] * right[axes * c + x] for x in range(axes)]
                    builder.store(added([code.number(builder.load(place)), *terms]).value, place)
            for n, place in enumerate(places):
                at = [
                    builder.add(args[5 + d], ir.Constant(kind, step))
                    for d, step in enumerate(divmod(n, b))
                ]
                target = cgutils.get_item_pointer(
                    context, builder, signature.args[4], sums, at, wraparound=False
                )
                total = code.number(builder.load(target)) + code.number(builder.load(place))
                builder.store(total.value, target)
            return context.get_dummy_value()

        return types.void(one, two, begin, end, into, i, j), codegen

    return products


def turned_rows(more: bool) -> Any:
    """Three rows times a matrix (3, 3): ``f(rows, matrix, begin, end, into)`` writes them, or adds
    them to what is there.
    """

    @intrinsic
    def turned(typingctx: Any, rows: Any, matrix: Any, begin: Any, end: Any, into: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            code = Code(context, builder)
            m = code.items(args[1], 9)
            with code.stars(args[2], args[3]) as column:
                v, out = (Rows(code, args[n], column) for n in (0, 4))
                terms = [[v[a] * m[3 * a + c] for a in range(3)] for c in range(3)]
                for c in range(3):
                    out[c] = added([*([out[c]] if more else []), *terms[c]])
            return context.get_dummy_value()

        return types.void(rows, matrix, begin, end, into), codegen

    return turned
