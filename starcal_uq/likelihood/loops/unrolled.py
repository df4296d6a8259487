"""Straight-line code for compiled loops: a camera model's kernel at one star, sums of products of
rows.

Written out, a formula keeps its values in registers; as Python source it would take Numba half a
minute to read. Here the formula is ordinary Python that runs once, on `Number`s in the place of
doubles, and every operation on these writes one instruction. The kernels of
`starcal_uq.camera.projection`, written for NumPy arrays, run on them as they are.

Stars are the columns of a buffer (rows, `STRIDE`): a row lies at a distance that the compiler
knows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import reduce
from itertools import chain
from operator import add
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils as _cgutils
from numba.core import typing as _typing
from numba.core.errors import TypingError
from numba.extending import intrinsic

from starcal_uq.camera.kernels import Kernel

# Their functions carry no types.
cgutils: Any = _cgutils
signature: Any = _typing.signature  # type: ignore[attr-defined]

# More than a chunk of stars, and no multiple of what makes rows compete for places in the cache.
STRIDE = 136
# For short sums, which a compiler must not spread over more registers than there are.
_ORDERED = ("contract",)


class Number:
    """A double of the function that is being compiled."""

    def __init__(self, code: Code, value: Any) -> None:
        self.code, self.value = code, value

    def _with(self, operation: str, other: Number | float, swapped: bool = False) -> Number:
        a, b = self.value, self.code.number(other).value
        write = getattr(self.code.builder, operation)
        return Number(self.code, write(*((b, a) if swapped else (a, b)), flags=self.code.flags))

    def _of(self, function: Any, *others: Number | float) -> Number:
        return self.code.call(function, self, *others)

    def __add__(self, other: Number | float) -> Number:
        return self._with("fadd", other)

    def __radd__(self, other: float) -> Number:
        return self._with("fadd", other, swapped=True)

    def __sub__(self, other: Number | float) -> Number:
        return self._with("fsub", other)

    def __rsub__(self, other: float) -> Number:
        return self._with("fsub", other, swapped=True)

    def __mul__(self, other: Number | float) -> Number:
        return self._with("fmul", other)

    def __rmul__(self, other: float) -> Number:
        return self._with("fmul", other, swapped=True)

    def __truediv__(self, other: Number | float) -> Number:
        return self._with("fdiv", other)

    def __rtruediv__(self, other: float) -> Number:
        return self._with("fdiv", other, swapped=True)

    def __neg__(self) -> Number:
        return -0.0 - self

    def __abs__(self) -> Number:
        return self._of(math.fabs)

    def __pow__(self, other: Number | float) -> Number:
        return self._of(math.pow, other)

    # NumPy's functions call these methods of what is no array.
    def sqrt(self) -> Number:
        return self._of(math.sqrt)

    def sin(self) -> Number:
        return self._of(math.sin)

    def cos(self) -> Number:
        return self._of(math.cos)

    def tan(self) -> Number:
        return self._of(math.tan)

    def arctan(self) -> Number:
        return self._of(math.atan)

    def exp(self) -> Number:
        return self._of(math.exp)

    def log(self) -> Number:
        return self._of(math.log)

    def arctan2(self, other: Number) -> Number:
        return self._of(math.atan2, other)

    def hypot(self, other: Number) -> Number:
        return self._of(math.hypot, other)


class Code:
    """The function that is being compiled, at the place where instructions are written."""

    def __init__(self, context: Any, builder: Any, ordered: bool = False) -> None:
        self.context, self.builder = context, builder
        self.flags = _ORDERED if ordered else ()

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

    def items(self, values: Any) -> list[Number]:
        """The numbers of a tuple."""
        return [self.number(item) for item in cgutils.unpack_tuple(self.builder, values)]

    def array(self, kind: Any, value: Any) -> Any:
        """An array by its type and value."""
        return self.context.make_array(kind)(self.context, self.builder, value)


class Rows:
    """Rows of a buffer from `first` on at one column, as numbers: ``rows[n]`` is read or written."""

    def __init__(self, code: Code, data: Any, column: Any, first: int = 0) -> None:
        self._code, self._column, self._row = code, column, first
        self._first = code.builder.gep(data, [column])

    def _place(self, row: int) -> Any:
        distance = ir.Constant(self._column.type, (self._row + row) * STRIDE)
        return self._code.builder.gep(self._first, [distance])

    def __getitem__(self, row: int) -> Number:
        return Number(self._code, self._code.builder.load(self._place(row)))

    def __setitem__(self, row: int, value: Number | float) -> None:
        self._code.builder.store(self._code.number(value).value, self._place(row))


class _Output:
    """An output of a kernel, whose elements stand in rows from `first` on."""

    def __init__(self, rows: Rows, first: int) -> None:
        self._rows, self._first = rows, first

    def __setitem__(self, element: int, value: Number | float) -> None:
        self._rows[self._first + element] = value


def star_kernel(
    kernel_of: Callable[[str], Kernel],
    reads: Sequence[Sequence[int]],
    writes: Callable[[int], Sequence[int]],
) -> Any:
    """A kernel of a camera model at one star: ``f(model, theta, work, buf, i)``.

    `reads` are the rows of `work` of its inputs after theta, `writes` gives the first row of `buf`
    of each output from the number of parameters.
    """

    @intrinsic(prefer_literal=True)
    def at_star(typingctx: Any, model: Any, theta: Any, work: Any, buf: Any, i: Any) -> Any:
        kernel = kernel_of(name_of(model))

        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            code = Code(context, builder)
            given, taken = (
                Rows(code, code.array(signature.args[n], args[n]).data, args[4]) for n in (2, 3)
            )
            inputs = [code.items(args[1]), *([given[row] for row in rows] for rows in reads)]
            kernel.run(inputs, [_Output(taken, first) for first in writes(theta.count)])
            return context.get_dummy_value()

        return types.void(model, theta, work, buf, i), codegen

    return at_star


def name_of(model: Any) -> str:
    """Name of the distortion model that a literal type stands for."""
    if not isinstance(model, types.StringLiteral):
        raise TypingError("a distortion model is no literal")
    return str(model.literal_value.partition(" ")[0])


class Stars:
    """Columns `begin` to `end` of a buffer, for a function that writes loops over them.

    `numbers` are those of a tuple, `into` is an array that sums are added to; the rows of
    ``shifted`` begin `axis` rows later.
    """

    def __init__(self, code: Code, model: str, kinds: Any, args: Any) -> None:
        self._code, self.model = code, model
        _, numbers, buf, self._begin, self._end, axis, into = args
        self.numbers = code.items(numbers)
        self._data = code.array(kinds[2], buf).data
        step = code.builder.mul(axis, ir.Constant(axis.type, STRIDE))
        self._shifted = code.builder.gep(self._data, [step])
        self._into = code.array(kinds[6], into)
        self._kind = kinds[6]

    @contextmanager
    def each(self, shift: int | None = None) -> Iterator[tuple[Rows, Rows]]:
        """A loop: the rows at each star, and those from row `shift` on; by default the argument's."""
        code, kind = self._code, self._end.type
        with cgutils.for_range_slice(
            code.builder, self._begin, self._end, ir.Constant(kind, 1), kind
        ) as (column, _):
            others = (
                Rows(code, self._shifted, column)
                if shift is None
                else Rows(code, self._data, column, shift)
            )
            yield Rows(code, self._data, column), others

    def total(self) -> Total:
        """A sum, zero before a loop."""
        return Total(self._code)

    def add(self, value: Number, *index: int) -> None:
        """Add to an element of `into`."""
        code = self._code
        at = [ir.Constant(self._end.type, position) for position in index]
        place = cgutils.get_item_pointer(
            code.context, code.builder, self._kind, self._into, at, wraparound=False
        )
        code.builder.store((Number(code, code.builder.load(place)) + value).value, place)


class Total:
    """A sum that grows in a loop."""

    def __init__(self, code: Code) -> None:
        zero = ir.Constant(ir.DoubleType(), 0.0)
        self._code, self._place = code, cgutils.alloca_once_value(code.builder, zero)

    def add(self, value: Number) -> None:
        self._code.builder.store((self.value + value).value, self._place)

    @property
    def value(self) -> Number:
        return Number(self._code, self._code.builder.load(self._place))


def over_stars(write: Callable[[Stars], None], ordered: bool = False) -> Any:
    """Loops over stars that a function writes: ``f(model, numbers, buf, begin, end, axis, into)``."""

    @intrinsic(prefer_literal=True)
    def loops(
        typingctx: Any,
        model: Any,
        numbers: Any,
        buf: Any,
        begin: Any,
        end: Any,
        axis: Any,
        into: Any,
    ) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            write(Stars(Code(context, builder, ordered), name_of(model), signature.args, args))
            return context.get_dummy_value()

        return types.void(model, numbers, buf, begin, end, axis, into), codegen

    return loops


# An entry of an array, and the pairs of rows whose products are summed into it.
Sums = dict[tuple[int, ...], list[tuple[int, int]]]


def row_sums(sums_of: Callable[[str, int], Sums], ordered: bool = True) -> Any:
    """Sums of products of rows; `sums_of` gives them from the model and its number of parameters."""

    def write(stars: Stars) -> None:
        sums = sums_of(stars.model, len(stars.numbers))
        totals = [stars.total() for _ in sums]
        with stars.each() as (rows, _):
            value = {row: rows[row] for row in sorted({*chain(*chain(*sums.values()))})}
            for total, pairs in zip(totals, sums.values(), strict=True):
                total.add(added([value[a] * value[b] for a, b in pairs]))
        for total, index in zip(totals, sums, strict=True):
            stars.add(total.value, *index)

    return over_stars(write, ordered)


def added(terms: Sequence[Number]) -> Any:
    """The sum of some numbers; 0.0 of none."""
    return reduce(add, terms) if terms else 0.0
