"""What a study found: which pairs are coupled, and which axis changes that."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, compress
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from starcal_uq.core.constants import AXES as ATTITUDE
from starcal_uq.core.types import AnyDict, AnyMapping, BoolArray, FloatArray, IntArray, floats
from starcal_uq.propagation.coupling import COUPLED

if TYPE_CHECKING:
    import xarray as xr

# An axis matters where it changes what a pair's coupling costs in sigma by this factor, and by more
# than chance does.
MATTERS = 1.25
# Probability with which chance alone passes for a change.
_FALSE_ALARM = 1e-3
# A median's standard error over a mean's: of normal numbers, and of the evenly spread ones of a
# hypercube.
_MEDIAN, _EVEN = 1.25, 1.75
# An axis of a Latin hypercube is cut into this many parts of equal number.
_PARTS = 6

Statistic = Literal["median", "min", "max", "mean", "count", "sem"]


@dataclass(frozen=True)
class Curve:
    """A number along one axis, its median over seeds first and then over all other axes.

    `values` are those of the axis, the median of each part where there are too many, and `median`
    (n,) belongs to them. `change` is the largest less the smallest value along the axis, the median
    of it over the other axes; `chance` is what other seeds (in a Latin hypercube, the other drawn
    axes) make of it less than once in a thousand times, 0 with one seed.
    """

    axis: str
    values: tuple[Any, ...]
    median: FloatArray
    change: float
    chance: float

    @property
    def most(self) -> int:
        """Where the number is largest."""
        return int(np.argmax(self.median))

    @property
    def least(self) -> int:
        """Where the number is smallest."""
        return int(np.argmin(self.median))

    @property
    def factor(self) -> float:
        """Largest over smallest median; infinite where the smallest is not above zero."""
        least = float(self.median.min())
        return float(self.median.max()) / least if least > 0.0 else np.inf

    @property
    def exponent(self) -> float | None:
        """Exponent of the power law between the ends of the axis; None where there is none."""
        if isinstance(self.values[0], str):
            return None
        x, y = floats(self.values), self.median
        if np.any(x <= 0.0) or np.any(y <= 0.0):
            return None
        slope = float(np.polyfit(np.log(x), np.log(y), 1)[0])
        law = np.log(y) - slope * np.log(x)
        return slope if float(np.ptp(law)) < 0.1 + 0.1 * float(np.ptp(np.log(y))) else None


@dataclass(frozen=True)
class Lines:
    """A number along one axis (n values), a line for every value of another one, `by`, where there
    is one.

    The other axes are `held` at values; median, least and most (lines, n) are over seeds.
    """

    along: str
    values: tuple[Any, ...]
    by: str | None
    by_values: tuple[Any, ...]
    held: AnyDict
    median: FloatArray
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True)
class Pair:
    """How two parameters are coupled over the sweep.

    Correlations (median over seeds) where they are largest and smallest in size, and where that is.
    `seeds` is their range over seeds at a place, the median over all places, 0 for a Latin
    hypercube; `mean_size` their size, the mean over all places, 0 where a model lacks one of the
    two. Along every axis, `sizes` are the size, and `costs` the logarithm of 1 / sqrt(1 - r^2),
    what the coupling of this pair alone costs in sigma.
    """

    names: tuple[str, str]
    strongest: float
    weakest: float
    strongest_at: AnyDict
    weakest_at: AnyDict
    seeds: float
    mean_size: float
    sizes: tuple[Curve, ...]
    costs: tuple[Curve, ...]

    def decoupling(self) -> list[tuple[Curve, Curve]]:
        """Size and cost along the axes that change the coupling, the strongest first."""
        both = zip(self.sizes, self.costs, strict=True)
        return sorted((p for p in both if matters(p[1])), key=lambda pair: -pair[1].change)


def matters(cost: Curve) -> bool:
    """Whether an axis changes the logarithm of a sigma by enough, and by more than chance does."""
    return cost.change > max(float(np.log(MATTERS)), cost.chance)


class Sweep:
    """The cells of a study by their place: every number as a dense array over the axes.

    Of the swept axes, those in `latin` were drawn from a Latin hypercube.
    """

    def __init__(self, data: xr.Dataset, axes: Sequence[str], latin: Sequence[str] = ()) -> None:
        self.data = data
        self.axes = tuple(axes)
        self.ok: BoolArray = np.asarray(data["status"].values == "ok")
        self.names: tuple[str, ...] = tuple(map(str, data["parameter"].values))
        levels = [_levels(data[axis].values, axis in latin) for axis in self.axes]
        self.values = {axis: values for axis, (_, values) in zip(self.axes, levels, strict=True)}
        self.shape = tuple(len(values) for _, values in levels)
        self._codes = [code for code, _ in levels]
        # Axes that were drawn and not laid out: their cells are no lines, and are told apart along
        # one axis at a time.
        self.drawn = tuple(
            axis for axis in self.axes if len(np.unique(data[axis].values)) > len(self.values[axis])
        )

    def over(
        self,
        numbers: FloatArray,
        statistic: Statistic = "median",
        pooled: Sequence[str] = (),
        cells: Any = True,
    ) -> FloatArray:
        """A statistic of a number (C,) of every cell, over seeds, as an array over the axes; NaN
        where no cell has it.

        Axes `pooled` count as seeds; the array has one value for them. Of `cells` (C,), those that
        are true count.
        """
        import pandas as pd

        kept = [axis not in pooled for axis in self.axes]
        shape = tuple(n if keep else 1 for keep, n in zip(kept, self.shape, strict=True))
        good = self.ok & ~np.isnan(numbers) & cells
        place = np.zeros(int(good.sum()), dtype=np.int64)
        if shape:
            codes = [code[good] * keep for keep, code in zip(kept, self._codes, strict=True)]
            place = np.ravel_multi_index(codes, shape)
        found = pd.Series(numbers[good]).groupby(place).agg(statistic)
        grid = np.full(math.prod(shape), np.nan)
        grid[found.index.to_numpy()] = found.to_numpy()
        return grid.reshape(shape)

    def at(self, index: int) -> AnyDict:
        """The values of the axes at a place, by its number in the flattened array."""
        codes = np.unravel_index(index, self.shape) if self.axes else ()
        return {
            axis: self.values[axis][int(code)] for axis, code in zip(self.axes, codes, strict=True)
        }

    def along(self, numbers: FloatArray, axis: str) -> Curve | None:
        """A number of every cell along an axis; None where fewer than two values of the axis have
        it.

        Only what was found at all values of the axis is compared, so that missing cells do not pass
        for a change.
        """
        pooled = tuple(other for other in self.drawn if other != axis)
        lines = np.moveaxis(self.over(numbers, pooled=pooled), self.axes.index(axis), 0)
        lines = lines.reshape(len(self.values[axis]), -1)
        has = np.isfinite(lines).any(axis=1)
        lines = lines[has]
        if len(lines) < 2:
            return None
        known = np.isfinite(lines)
        lines = lines[:, known.all(axis=0) if known.all(axis=0).any() else known.sum(axis=0) >= 2]
        if lines.shape[1] == 0 or not np.isfinite(lines).any(axis=1).all():
            return None
        return Curve(
            axis,
            tuple(compress(self.values[axis], np.atleast_1d(has))),
            np.nanmedian(lines, axis=1),
            float(np.median(np.nanmax(lines, axis=0) - np.nanmin(lines, axis=0))),
            self._chance(numbers, pooled, len(lines)),
        )

    def seeds(self, numbers: FloatArray) -> float:
        """Range over seeds at a place, the median over all places."""
        spread = self.over(numbers, "max") - self.over(numbers, "min")
        return float(np.nanmedian(spread)) if np.isfinite(spread).any() else 0.0

    def _chance(self, numbers: FloatArray, pooled: Sequence[str], n_values: int) -> float:
        """Range of medians at so many places that chance exceeds once in a thousand times;
        Bonferroni over pairs.
        """
        from scipy.special import stdtrit

        n = self.over(numbers, "count", pooled)
        repeated = n >= 2.0
        if not repeated.any():
            return 0.0
        n, error = n[repeated], self.over(numbers, "sem", pooled)[repeated]
        factor = _EVEN if pooled or self.drawn else np.where(n > 2.0, _MEDIAN, 1.0)
        p = 1.0 - _FALSE_ALARM / (n_values * (n_values - 1))
        quantile = float(stdtrit(float(np.sum(n - 1.0)), p))
        return float(np.sqrt(2.0 * np.mean((factor * error) ** 2))) * quantile

    def curves(self, numbers: FloatArray) -> tuple[Curve, ...]:
        """`along` every axis that has it."""
        found = (self.along(numbers, axis) for axis in self.axes)
        return tuple(curve for curve in found if curve is not None)

    def lines(
        self,
        numbers: FloatArray,
        along: str,
        by: str | None = None,
        at: AnyMapping | None = None,
    ) -> Lines:
        """A number (C,) of every cell along an axis, a line for every value of another one, all
        others held.

        They are held `at` values, by default at the middle one of theirs (where most cells have
        numbers); what was drawn from a Latin hypercube is not held at all. ValueError for a name
        that is no axis, or a value that an axis does not have.
        """
        held = self.held(along, by, at)
        cells = self._cells(held)
        pooled = [axis for axis in self.axes if axis not in (along, by)]
        turned = by is not None and self.axes.index(by) > self.axes.index(along)

        def laid_out(numbers: FloatArray, statistic: Statistic = "median") -> FloatArray:
            grid = self.over(numbers, statistic, pooled, cells)
            grid = grid.squeeze(tuple(self.axes.index(axis) for axis in pooled))
            return grid.T if turned else np.atleast_2d(grid)

        # Values at which no cell has numbers are left out.
        there = np.isfinite(laid_out(np.zeros(len(self.ok))))
        rows, columns = np.flatnonzero(there.any(axis=1)), np.flatnonzero(there.any(axis=0))
        kept = np.ix_(rows, columns)
        median, low, high = (laid_out(numbers, of)[kept] for of in ("median", "min", "max"))
        values = tuple(self.values[along][i] for i in columns)
        by_values = () if by is None else tuple(self.values[by][i] for i in rows)
        return Lines(along, values, by, by_values, held, median, low, high)

    def held(self, along: str, by: str | None = None, at: AnyMapping | None = None) -> AnyDict:
        """Where the other axes are held."""
        for axis in filter(None, (along, by)):
            self.check(axis)
        given = {axis: value for axis, value in (at or {}).items() if axis not in (along, by)}
        cells = self.ok & self._cells(given)
        named = (*self.drawn, along, by, *given)
        free = [i for i, axis in enumerate(self.axes) if axis not in named]
        if not free or not cells.any():
            return given
        # The middle, unless cells are missing there.
        places, counts = np.unique(
            np.stack([self._codes[i][cells] for i in free]), axis=1, return_counts=True
        )
        middle = np.array([self.shape[i] // 2 for i in free])[:, None]
        best = int(np.lexsort((np.abs(places - middle).sum(axis=0), -counts))[0])
        chosen = {
            axis: self.values[axis][code]
            for axis, code in zip((self.axes[i] for i in free), places[:, best], strict=True)
        }
        return chosen | given

    def pooled(
        self,
        numbers: FloatArray,
        along: str,
        at: AnyMapping | None = None,
        statistic: Statistic = "median",
    ) -> FloatArray:
        """A statistic of a number at every value of an axis, over seeds and all axes that `at` does
        not hold.
        """
        self.check(along)
        others = [axis for axis in self.axes if axis != along]
        return self.over(numbers, statistic, others, self._cells(at or {})).ravel()

    def _cells(self, at: AnyMapping) -> BoolArray:
        """Cells (C,) at values of axes."""
        cells = np.ones(len(self.ok), dtype=np.bool_)
        for axis, value in at.items():
            self.check(axis)
            known = self.values[axis]
            if value not in known:
                raise ValueError(
                    f"{axis} has no value {value!r}: use one of {', '.join(map(str, known))}."
                )
            cells &= self._codes[self.axes.index(axis)] == known.index(value)
        return cells

    def check(self, axis: str) -> None:
        """ValueError for a name that is no swept axis."""
        if axis not in self.axes:
            raise ValueError(
                f"{axis!r} was not swept: use one of {', '.join(self.axes) or 'none'}."
            )

    @cached_property
    def frame_error(self) -> FloatArray:
        """Frame-dependent error of the calibration across the boresight, 1 sigma per axis, of every
        cell (arcsec).
        """
        return self.cross("frame_error_arcsec")

    @cached_property
    def common_rotation(self) -> FloatArray:
        """Rotation common to all frames across the boresight, 1 sigma per axis, of every cell
        (arcsec).
        """
        return self.cross("common_rotation_arcsec")

    def cross(self, variable: str) -> FloatArray:
        """Root mean square over pitch and yaw of a variable by axis, of every cell."""
        return floats(cross(self.data[variable]).values)

    @cached_property
    def pairs(self) -> tuple[Pair, ...]:
        """All pairs of parameters, those that are coupled most somewhere first."""
        found = (self._pair(*names) for names in combinations(self.names, 2))
        return tuple(sorted(filter(None, found), key=lambda pair: -abs(pair.strongest)))

    @property
    def coupled(self) -> tuple[Pair, ...]:
        """The pairs whose correlation exceeds `COUPLED` somewhere."""
        return tuple(pair for pair in self.pairs if abs(pair.strongest) >= COUPLED)

    def _pair(self, first: str, second: str) -> Pair | None:
        r = floats(self.data["correlation"].sel(parameter=first, parameter_2=second).values)
        grid = self.over(r).ravel()
        if not np.isfinite(grid).any():
            return None
        size = np.abs(grid)
        most, least = int(np.nanargmax(size)), int(np.nanargmin(size))
        cost = -0.5 * np.log1p(-np.minimum(r**2, 1.0 - 1e-15))
        sizes, costs = self.curves(np.abs(r)), self.curves(cost)
        return Pair(
            (first, second),
            float(grid[most]),
            float(grid[least]),
            self.at(most),
            self.at(least),
            0.0 if self.drawn else self.seeds(r),
            float(np.nan_to_num(size).mean()),
            sizes,
            costs,
        )

    @cached_property
    def failures(self) -> tuple[tuple[str, int], ...]:
        """Why cells failed, and how many, the most frequent first."""
        return tuple(Counter(map(str, self.data["status"].values[~self.ok])).most_common())


def cross(errors: xr.DataArray) -> xr.DataArray:
    """Root mean square over pitch and yaw of errors by axis."""
    across: xr.DataArray = (errors.sel(axis=list(ATTITUDE[:2])) ** 2).mean(
        "axis", skipna=False
    ) ** 0.5
    return across


def _levels(values: Any, drawn: bool) -> tuple[IntArray, tuple[Any, ...]]:
    """Number of the level of every cell, and the levels: values of the axis, or parts of those that
    were drawn.
    """
    array = np.asarray(values)
    if array.dtype.kind in "OUS":
        # Names keep the order in which they were given.
        known = {name: code for code, name in enumerate(dict.fromkeys(map(str, array)))}
        return np.array([known[str(name)] for name in array], dtype=np.int64), tuple(known)
    numbers = array.astype(np.float64)
    distinct, codes = np.unique(numbers, return_inverse=True)
    if not drawn or len(distinct) <= _PARTS:
        return codes.astype(np.int64), tuple(distinct.tolist())
    cuts = np.quantile(numbers, np.linspace(0.0, 1.0, _PARTS + 1)[1:-1])
    parts = np.searchsorted(cuts, numbers, side="right").astype(np.int64)
    return parts, tuple(float(np.median(numbers[parts == part])) for part in range(_PARTS))
