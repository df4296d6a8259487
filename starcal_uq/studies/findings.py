"""What a study found: which pairs are coupled, and which axis changes that."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, product
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from starcal_uq.core.constants import AXES as ATTITUDE
from starcal_uq.core.types import AnyDict, AnyMapping, BoolArray, FloatArray, IntArray, floats
from starcal_uq.propagation.coupling import COUPLED

if TYPE_CHECKING:
    import xarray as xr

# An axis matters where it changes a sigma by this factor, and by more than chance does.
MATTERS = 1.25
# Probability with which chance alone passes for a change.
_FALSE_ALARM = 1e-3
# A median's standard error over a mean's: of normal numbers, and of the evenly spread ones of a
# hypercube.
_MEDIAN, _EVEN = 1.25, 1.75
# An axis of a Latin hypercube is cut into this many parts of equal number.
_PARTS = 6
# Largest squared correlation, so that its price stays finite.
_CERTAIN = 1.0 - 1e-15

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
    def matters(self) -> bool:
        """Whether the axis changes the logarithm of a sigma by enough, and by more than chance."""
        return self.change > max(float(np.log(MATTERS)), self.chance)

    @property
    def factor(self) -> float:
        """Largest over smallest sigma, of the medians of its logarithm."""
        return float(np.exp(np.ptp(self.median)))

    @property
    def exponent(self) -> float:
        """Exponent of the power law that a sigma follows, by its logarithm; NaN where it follows
        none.
        """
        # Magnitudes are logarithms themselves.
        if isinstance(self.values[0], str) or min(self.values) <= 0.0 or self.axis == "max_mag":
            return np.nan
        x = np.log(floats(self.values))
        slope = float(np.polyfit(x, self.median, 1)[0])
        left = np.ptp(self.median - slope * x)
        return slope if left < 0.1 + 0.1 * np.ptp(self.median) else np.nan


class Pair:
    """How two parameters, or a parameter and the common rotation, are coupled over the sweep.

    `grid` holds the correlations, median over seeds; `strongest` and `weakest` are those that are
    largest and smallest in size, with their places as coordinates.
    """

    def __init__(self, names: tuple[str, str], correlation: FloatArray, sweep: Sweep) -> None:
        self.names, self.correlation, self._sweep = names, correlation, sweep
        self.grid = sweep.over(correlation)
        self.size = abs(self.grid)

    @property
    def strongest(self) -> xr.DataArray:
        """The largest correlation."""
        return self.grid.isel(_first(self.size, self._sweep.axes))

    @property
    def weakest(self) -> xr.DataArray:
        """The smallest correlation."""
        return self.grid.isel(_first(-self.size, self._sweep.axes))

    @property
    def mean_size(self) -> float:
        """Size, the mean over all places, 0 where a model lacks one of the two."""
        return float(self.size.fillna(0.0).mean())

    @property
    def seeds(self) -> float:
        """Range over seeds at a place, the median over all places; 0 for a Latin hypercube."""
        if self._sweep.drawn:
            return 0.0
        most, least = (self._sweep.over(self.correlation, of) for of in ("max", "min"))
        return float((most - least).median())

    @cached_property
    def costs(self) -> tuple[Curve, ...]:
        """Along every axis, the logarithm of 1 / sqrt(1 - r^2): what the coupling of this pair
        alone costs in sigma.
        """
        square = np.minimum(self.correlation**2, _CERTAIN)
        return self._sweep.curves(-0.5 * np.log1p(-square))

    def decoupling(self) -> list[Curve]:
        """Costs along the axes that change the coupling, the strongest first."""
        return sorted((cost for cost in self.costs if cost.matters), key=lambda cost: -cost.change)


def place_of(number: xr.DataArray) -> AnyDict:
    """The values of the axes at one number of a grid."""
    return {str(axis): value.item() for axis, value in number.coords.items()}


class Sweep:
    """The cells of a study by their place: every number as a grid over the axes.

    Of the swept axes, those in `latin` were drawn from a Latin hypercube.
    """

    def __init__(self, data: xr.Dataset, axes: Sequence[str], latin: Sequence[str] = ()) -> None:
        self.data = data
        self.axes = tuple(axes)
        self.ok: BoolArray = np.asarray(data["status"].values == "ok")
        self.names: tuple[str, ...] = tuple(map(str, data["parameter"].values))
        levels = {axis: _levels(data[axis].values, axis in latin) for axis in self.axes}
        self._codes = {axis: codes for axis, (codes, _) in levels.items()}
        self.values = {axis: values for axis, (_, values) in levels.items()}
        # Axes that were drawn and not laid out: their cells are no lines, and are told apart along
        # one axis at a time.
        self.drawn = tuple(
            axis for axis in self.axes if len(np.unique(data[axis].values)) > len(self.values[axis])
        )

    def over(
        self,
        numbers: FloatArray,
        statistic: Statistic = "median",
        dims: Sequence[str] | None = None,
        at: AnyMapping | None = None,
    ) -> xr.DataArray:
        """A statistic of a number (C,) of every cell over seeds, as a grid over the axes; NaN where
        no cell has it.

        The grid is over `dims`, by default all axes. Other axes count as seeds, or are held `at`
        values.
        """
        import pandas as pd
        import xarray as xr

        dims = self.axes if dims is None else dims
        levels = {axis: list(self.values[axis]) for axis in dims}
        shape = tuple(map(len, levels.values()))
        cells = self.ok & self._cells(at or {})
        place = np.zeros(int(cells.sum()), dtype=np.int64)
        if shape:
            place = np.ravel_multi_index([self._codes[axis][cells] for axis in dims], shape)
        found = pd.Series(numbers[cells]).groupby(place).agg(statistic)
        grid = np.full(math.prod(shape), 0.0 if statistic == "count" else np.nan)
        grid[found.index] = found
        return xr.DataArray(grid.reshape(shape), levels, dims)

    def along(self, numbers: FloatArray, axis: str) -> Curve | None:
        """A number of every cell along an axis; None where fewer than two values of the axis have
        it.

        Only what was found at all values of the axis is compared, so that missing cells do not pass
        for a change.
        """
        import pandas as pd

        dims = [axis, *(other for other in self.axes if other not in (axis, *self.drawn))]
        grid = self.over(numbers, dims=dims)
        lines = pd.DataFrame(grid.values.reshape(len(grid), -1), grid[axis].values)
        lines = lines.dropna(how="all")
        whole = lines.dropna(axis=1)
        lines = whole if whole.size else lines.dropna(axis=1, thresh=2)
        if len(lines) < 2 or lines.isna().all(axis=1).any():
            return None
        return Curve(
            axis,
            tuple(lines.index),
            lines.median(axis=1).to_numpy(),
            float((lines.max() - lines.min()).median()),
            self._chance(numbers, dims, len(lines)),
        )

    def _chance(self, numbers: FloatArray, dims: Sequence[str], n_values: int) -> float:
        """Range of medians at so many places that chance exceeds once in a thousand times;
        Bonferroni over pairs.
        """
        from scipy.special import stdtrit

        n = self.over(numbers, "count", dims).values
        repeated = n >= 2.0
        if not repeated.any():
            return 0.0
        n, error = n[repeated], self.over(numbers, "sem", dims).values[repeated]
        factor = _EVEN if self.drawn else np.where(n > 2.0, _MEDIAN, 1.0)
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
    ) -> xr.Dataset:
        """A number (C,) of every cell along an axis, for every value of another one, all others
        held.

        `median`, `low` and `high` (least and most) over seeds, dimensions `by` and `along`; where
        the others are held is the attribute ``held``. They are held `at` values, by default at the
        middle one of theirs (where most cells have numbers); what was drawn from a Latin hypercube
        is not held at all. ValueError for a name that is no axis, or a value that an axis does not
        have.
        """
        import xarray as xr

        held = self.held(along, by, at)
        dims = [along] if by is None else [by, along]
        statistics: dict[str, Statistic] = {"median": "median", "low": "min", "high": "max"}
        found = {
            name: self.over(numbers, statistic, dims, held)
            for name, statistic in statistics.items()
        }
        return xr.Dataset(found, attrs={"held": held})

    def held(
        self, along: str | None = None, by: str | None = None, at: AnyMapping | None = None
    ) -> AnyDict:
        """Where the axes beside `along` and `by` are held."""
        import xarray as xr

        for axis in filter(None, (along, by)):
            self.check(axis)
        given = {axis: value for axis, value in (at or {}).items() if axis not in (along, by)}
        named = (*self.drawn, along, by, *given)
        free = [axis for axis in self.axes if axis not in named]
        n_cells = self.over(np.zeros(len(self.ok)), "count", free, given)
        if not free:
            return given
        # The middle, unless cells are missing there.
        for axis in free:
            off = np.arange(n_cells.sizes[axis]) - n_cells.sizes[axis] // 2
            n_cells = n_cells - 1e-3 * xr.DataArray(np.abs(off), dims=[axis])
        return place_of(n_cells.isel(_first(n_cells, free))) | given

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
            cells &= self._codes[axis] == known.index(value)
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
        return floats(cross(self.data["frame_error_arcsec"]).values)

    @cached_property
    def common_rotation(self) -> FloatArray:
        """Rotation common to all frames across the boresight, 1 sigma per axis, of every cell
        (arcsec).
        """
        return floats(cross(self.data["common_rotation_arcsec"]).values)

    @cached_property
    def pairs(self) -> tuple[Pair, ...]:
        """All pairs of parameters, those that are coupled most somewhere first."""
        return self._pairs("correlation", combinations(self.names, 2))

    @cached_property
    def coupled(self) -> tuple[Pair, ...]:
        """The pairs whose correlation exceeds `COUPLED` somewhere."""
        return tuple(pair for pair in self.pairs if abs(pair.strongest) >= COUPLED)

    @cached_property
    def turned(self) -> tuple[Pair, ...]:
        """Parameters with an axis of the common rotation that they are coupled to everywhere."""
        pairs = self._pairs("attitude_correlation", product(self.names, ATTITUDE))
        return tuple(pair for pair in pairs if abs(pair.weakest) >= COUPLED)

    def _pairs(self, variable: str, names: Any) -> tuple[Pair, ...]:
        every = self.data[variable].transpose("parameter", ..., "cell")
        found = (
            Pair(
                pair, floats(every.sel({"parameter": pair[0], every.dims[1]: pair[1]}).values), self
            )
            for pair in names
        )
        known = [pair for pair in found if pair.grid.notnull().any()]
        return tuple(sorted(known, key=lambda pair: -float(pair.size.max())))

    @cached_property
    def failures(self) -> tuple[tuple[str, int], ...]:
        """Why cells failed, and how many, the most frequent first."""
        return tuple(Counter(map(str, self.data["status"].values[~self.ok])).most_common())


def _first(grid: xr.DataArray, dims: Sequence[str]) -> Mapping[Any, Any]:
    """Indices of the largest number of a grid."""
    return grid.argmax(list(dims)) if dims else {}


def cross(errors: xr.DataArray) -> xr.DataArray:
    """Root mean square over pitch and yaw of errors by axis."""
    return (errors.sel(axis=list(ATTITUDE[:2])) ** 2).mean("axis", skipna=False) ** 0.5


def _levels(values: Any, drawn: bool) -> tuple[IntArray, tuple[Any, ...]]:
    """Number of the level of every cell, and the levels: values of the axis, or parts of those that
    were drawn.
    """
    import pandas as pd

    array = np.asarray(values)
    if array.dtype.kind in "OUS":
        # Names keep the order in which they were given.
        codes, names = pd.factorize(array.astype(object))
        return codes, tuple(map(str, names))
    numbers = array.astype(np.float64)
    distinct, codes = np.unique(numbers, return_inverse=True)
    if not drawn or len(distinct) <= _PARTS:
        return codes.astype(np.int64), tuple(distinct.tolist())
    cuts = np.quantile(numbers, np.linspace(0.0, 1.0, _PARTS + 1)[1:-1])
    parts = np.searchsorted(cuts, numbers, side="right").astype(np.int64)
    return parts, tuple(float(np.median(numbers[parts == part])) for part in range(_PARTS))
