"""Shapes that residuals take when the model is wrong, as columns of pixel shifts.

Every column is a displacement (observed minus predicted) for every star and both axes. Positions
are predicted ones: with measured ones, the noise of a star would enter its own shape. What the
attitudes and the fitted parameters absorb of a shape is removed where the shapes are used, so their
scale and their overlap do not matter here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from starcal_uq.camera.distortion import (
    COEFFICIENTS,
    get_model,
    parameter_names,
    rivals,
    shared_names,
)
from starcal_uq.core.constants import LIGHT_SPEED_KM_S
from starcal_uq.core.texts import Texts
from starcal_uq.core.types import FloatArray, IntArray, StrArray, floats
from starcal_uq.likelihood.marginal import MarginalLikelihood, Profile

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.observations.table import Observations

_HARMONICS = 2
_AZIMUTH_ORDERS = 3
_RADIAL_DEGREE, _TWIST_DEGREE = 6, 3
TIME_DEGREE = 3
_STARS_PER_CELL = 25.0
MAX_CELLS = 8
# Hours without a frame that separate two nights.
_NIGHT_HOURS = 4.0
# Coordinates of shapes that keep their place in the field.
IN_FIELD = ("radius", "azimuth", "field", "field cells")
FRAME_BY_FRAME = "scale and shape that change from frame to frame"
_LEAST_SPREAD = 1e-9


@dataclass(frozen=True)
class View:
    """Some frames, as the shapes see them."""

    rows: slice | IntArray  # Rows of the stars in the table
    part: MarginalLikelihood  # Likelihood of the stars
    state: Profile  # The model at the best attitudes
    parameter_columns: (
        FloatArray  # (p, 2, n): derivatives by the fitted parameters, not divided by the noise
    )
    centre: FloatArray  # (2,): principal point, px

    @classmethod
    def of(
        cls,
        part: MarginalLikelihood,
        state: Profile,
        theta: FloatArray,
        rows: slice | IntArray,
    ) -> View:
        """The stars of `part`, which are these rows of the table."""
        parameter_columns = part.frames.in_pixels(state.slopes)
        return cls(rows, part, state, parameter_columns, theta[:2])

    @property
    def predicted(self) -> FloatArray:
        """Predicted positions (2, n), px."""
        return self.part.frames.pixel - self.part.frames.in_pixels(self.state.e)

    @cached_property
    def uv(self) -> FloatArray:
        """The same (2, n) relative to the principal point."""
        return self.predicted - self.centre[:, None]

    @property
    def held(self) -> FloatArray:
        """Columns (p + 3, 2, n), px, of the parameters and of a rotation."""
        return np.concatenate(
            [self.parameter_columns, self.part.frames.in_pixels(self.state.attitude)]
        )


@dataclass(frozen=True)
class Shape:
    """A family of shapes that one test looks for."""

    # `name`, `against`: short name, and what the residuals are compared with.
    name: str
    against: str
    size: int  # Number of columns
    columns: Callable[[View], FloatArray]  # ``View -> (size, 2, n)`` shifts in px
    # Name and unit of each column's amplitude, where amplitudes mean something by themselves.
    labels: tuple[tuple[str, str], ...] = ()
    per_amplitude: tuple[float, ...] = ()  # Amplitude in that unit of a column as it stands
    # Cell (n,) of every star, where columns are the shifts of a cell in x and in y.
    cells: Callable[[View], IntArray] | None = None


def shapes(
    obs: Observations,
    camera: Camera,
    *,
    max_cells: int = MAX_CELLS,
) -> tuple[Shape, ...]:
    """Every family of shapes that the table allows; magnitude, time and temperature are used where
    they vary.

    `max_cells`: largest number of field cells along the longer side.
    """
    known = Covariates.of(obs)
    found = [*lens_shapes(camera), _aberration()]
    if known.clock is not None:
        found.append(_drift(known.clock, known.called))
    if known.warmth is not None and obs.temperature_c is not None:
        spread = float(np.nanstd(obs.temperature_c))
        found.append(
            _focal_against(
                known.warmth,
                "focal length with temperature",
                "temperature",
                ("df/dT", "px/K"),
                spread,
            )
        )
    found += [_radius(camera), _azimuth(camera), phase_shape(0), phase_shape(1)]
    if known.magnitude is not None:
        found.append(magnitude_shape(known.magnitude, camera))
    if known.clock is not None:
        found.append(over_time(known.clock, known.called))
    return (*found, _cells(obs, camera, max_cells))


def nights_of(seconds: FloatArray | None) -> FloatArray:
    """First and last moment (E, 2) of every night in which there are frames."""
    if seconds is None or not len(seconds):
        return np.zeros((0, 2))
    moments = np.unique(seconds)
    first = np.flatnonzero(np.diff(moments) > 3600.0 * _NIGHT_HOURS) + 1
    return np.stack([moments[[0, *first]], moments[[*(first - 1), -1]]], axis=1)


@dataclass(frozen=True)
class Extent:
    """Covariates of all stars of a table, which its parts are standardised by."""

    # `temperature_c`, `magnitude` (3,): number of stars that state it, mean and standard deviation
    temperature_c: FloatArray
    magnitude: FloatArray
    nights_s: FloatArray  # (E, 2): first and last moment of every night, seconds since 1970

    SHAPES: ClassVar = """
        3: temperature_c magnitude
        e 2: nights_s
    """

    @classmethod
    def of(cls, obs: Observations) -> Extent:
        """That of a table."""
        seconds = None if obs.time_utc is None else seconds_utc(obs.time_utc)
        return cls(_moments(obs.temperature_c), _moments(obs.mag), nights_of(seconds))

    @classmethod
    def joined(cls, parts: Sequence[Extent]) -> Extent:
        """That of all parts."""
        nights = np.concatenate([part.nights_s for part in parts])
        nights = nights[np.argsort(nights[:, 0])]
        ends = np.maximum.accumulate(nights[:, 1])
        first = np.flatnonzero(nights[1:, 0] - ends[:-1] > 3600.0 * _NIGHT_HOURS) + 1
        if len(nights):
            nights = np.stack([nights[[0, *first], 0], ends[[*(first - 1), -1]]], axis=1)
        temperature = _joined_moments([part.temperature_c for part in parts])
        return cls(temperature, _joined_moments([part.magnitude for part in parts]), nights)

    @property
    def warmth(self) -> tuple[float, float]:
        """Mean and standard deviation of the temperature, degC; NaN where there is none."""
        return float(self.temperature_c[1]), float(self.temperature_c[2])

    @property
    def time_s(self) -> tuple[float, float]:
        """First and last moment, seconds since 1970; NaN where there are no times."""
        if not len(self.nights_s):
            return np.nan, np.nan
        return float(self.nights_s[0, 0]), float(self.nights_s[-1, 1])


def _moments(values: FloatArray | None) -> FloatArray:
    known = np.zeros(0) if values is None else values[np.isfinite(values)]
    if not len(known):
        return np.array([0.0, np.nan, np.nan])
    return np.array([len(known), known.mean(), known.std()])


def _joined_moments(parts: Sequence[FloatArray]) -> FloatArray:
    counts, means, spreads = np.array([part for part in parts if part[0] > 0.0]).reshape(-1, 3).T
    if not len(counts):
        return np.array([0.0, np.nan, np.nan])
    mean = float(np.average(means, weights=counts))
    square = float(np.average(spreads**2 + (means - mean) ** 2, weights=counts))
    return np.array([counts.sum(), mean, np.sqrt(square)])


@dataclass(frozen=True)
class Covariates:
    """What shapes may change with, of every star (N,), standardised; None where nothing varies.

    `clock` runs from -1 to 1 over the run, and is `called` so; `warmth` and `magnitude` are in
    standard deviations of the table.
    """

    clock: FloatArray | None
    called: str
    warmth: FloatArray | None
    magnitude: FloatArray | None

    @classmethod
    def of(
        cls,
        obs: Observations,
        seen: Observations | None = None,
        extent: Extent | None = None,
    ) -> Covariates:
        """Those of a table, or of other frames on which its shapes are wanted.

        What these do not state is drawn from the table: the time of a frame and its temperature
        together, the magnitude of a star by itself. `extent`: that of all frames, of which the table
        is a part; the order of the frames is no clock then.
        """
        seen = obs if seen is None else seen
        clock, called = run_clock(obs) if extent is None else (_clock_in(obs, extent), "time")
        like: Any = slice(None)
        star = like
        if seen is not obs:
            rng = np.random.default_rng(0)
            frame = np.repeat(_drawn(rng, obs.n_frames, seen.n_frames), np.diff(seen.frame_starts))
            like = obs.frame_starts[frame]
            clock = None if clock is None else clock[like]
            star = _drawn(rng, obs.n_stars, seen.n_stars)
        warmth, magnitude = (
            (None, None) if extent is None else (extent.temperature_c[1:], extent.magnitude[1:])
        )
        return cls(
            clock,
            called,
            _standardised(obs.temperature_c, seen.temperature_c, like, warmth),
            _standardised(obs.mag, seen.mag, star, magnitude),
        )


def lens_shapes(camera: Camera) -> tuple[Shape, ...]:
    """Terms that the fitted model lacks: of the lens in other models, and scale and skew of the
    axes.
    """
    axes = () if get_model(camera.distortion).axes else (axes_shape(camera),)
    return *_missing_terms(camera), *axes


def focal_drift(obs: Observations) -> tuple[Shape, ...]:
    """Linear drift of f over the run, where there is more than one frame."""
    clock, called = run_clock(obs)
    return () if clock is None else (_drift(clock, called),)


def _drift(clock: FloatArray, called: str) -> Shape:
    # The clock runs from -1 to 1: twice the amplitude is the change over the run.
    return _focal_against(
        clock, "linear drift of f", called, ("change of f over the run", "px"), 0.5
    )


def run_clock(obs: Observations) -> tuple[FloatArray | None, str]:
    """Time of every star from -1 to 1 over the run, or the order of frames where there is no time;
    and its name.
    """
    seconds = None if obs.time_utc is None else seconds_utc(obs.time_utc)
    called = "time"
    if seconds is None or np.ptp(seconds) <= 0.0:
        seconds = np.searchsorted(obs.frame_ids, obs.frame).astype(np.float64)
        called = "order of frames"
    if np.ptp(seconds) <= 0.0:
        return None, called
    clock: FloatArray = 2.0 * (seconds - seconds.min()) / np.ptp(seconds) - 1.0
    return clock, called


def _clock_in(obs: Observations, extent: Extent) -> FloatArray | None:
    """The clock of a part of a table; None where no frame of it states a time."""
    seconds = None if obs.time_utc is None else seconds_utc(obs.time_utc)
    first, last = extent.time_s
    if seconds is None or not last > first:
        return None
    return 2.0 * (seconds - first) / (last - first) - 1.0


def seconds_utc(times: StrArray) -> FloatArray | None:
    """Seconds since 1970 of times (N,); None where one of them cannot be read."""
    texts = Texts.of(times)
    try:
        parsed = [datetime.fromisoformat(text) for text in texts.names.tolist()]
    except ValueError:
        return None
    stamps = [(t if t.tzinfo is not None else t.replace(tzinfo=UTC)).timestamp() for t in parsed]
    return floats(stamps)[texts.codes]


def frame_shapes(camera: Camera) -> Shape:
    """Scale and two components of shape of a frame by itself, px at the corner."""
    radius = camera.corner_radius_px

    def columns(view: View) -> FloatArray:
        u, v = view.uv / radius
        scale = view.parameter_columns[2] * (float(camera.focal_px) / radius)
        return np.stack([scale, np.stack([u, -v]), np.stack([v, u])])

    return Shape(FRAME_BY_FRAME, "frame", 3, columns)


def _drawn(rng: np.random.Generator, n: int, size: int) -> IntArray:
    """Places among n, each as often as the others as far as `size` allows, in random order."""
    return rng.permutation(np.arange(size) % n)


def _standardised(
    table: FloatArray | None,
    seen: FloatArray | None,
    rows: Any,
    moments: FloatArray | None = None,
) -> FloatArray | None:
    """A quantity of the stars seen by mean and spread of the table's, or by these moments (2,), and
    within its range; zero where unknown.

    Where it is not stated, it is taken from these rows of the table. None where nothing varies.
    """
    if table is None:
        return None
    mean, spread = (np.nanmean(table), np.nanstd(table)) if moments is None else moments
    if not float(spread) > _LEAST_SPREAD:
        return None
    values = table[rows] if seen is None else np.clip(seen, np.nanmin(table), np.nanmax(table))
    z: FloatArray = np.nan_to_num((values - mean) / spread)
    return z


def _missing_terms(camera: Camera) -> list[Shape]:
    """Terms of the other registered models that the fitted one lacks: radial ones, and the rest."""
    fitted = set(camera.parameter_names)
    lacking: dict[str, tuple[str, int]] = {}
    for name in rivals(camera.distortion):
        for index, coefficient in enumerate(get_model(name).lens):
            if coefficient.name not in fitted:
                lacking.setdefault(coefficient.name, (name, index))
    found = []
    for title, radial in (
        ("radial distortion beyond the model", True),
        ("decentring distortion", False),
    ):
        names = [name for name in lacking if name.startswith("k") is radial]
        if names:
            found.append(
                Shape(
                    f"{title} ({', '.join(names)})",
                    "radius" if radial else "field",
                    len(names),
                    _TermColumns(camera, tuple(lacking[name] for name in names)),
                    tuple((f"{name} at the corner", "px") for name in names),
                    tuple(
                        float(camera.corner_radius_px ** COEFFICIENTS[name].order) for name in names
                    ),
                )
            )
    return found


@dataclass(frozen=True)
class _TermColumns:
    """Derivatives by coefficients of richer models, where those are zero."""

    camera: Camera
    terms: tuple[tuple[str, int], ...]

    def __call__(self, view: View) -> FloatArray:
        own = dict(zip(self.camera.parameter_names, self.camera.theta.tolist(), strict=True))
        slopes = {}
        for model_name in dict(self.terms):
            shared = ("x0", "y0", "f", *shared_names(model_name, self.camera.distortion))
            names = parameter_names(model_name)
            theta = np.array([own[name] if name in shared else 0.0 for name in names])
            richer = MarginalLikelihood(view.part.frames, model_name)
            slopes[model_name] = richer.first(theta, view.state.b)[1][3:]
        columns = [slopes[model_name][index] for model_name, index in self.terms]
        return view.part.frames.in_pixels(np.stack(columns))


def axes_shape(camera: Camera) -> Shape:
    """Scale of x against y, and skew."""
    radius = camera.corner_radius_px

    def columns(view: View) -> FloatArray:
        u, v = view.uv / radius
        return np.stack([np.stack([u, -v]), np.stack([v, u])])

    labels = (("scale x against y, at the corner", "px"), ("skew of the axes, at the corner", "px"))
    return Shape("scale and skew of the axes", "field", 2, columns, labels, (1.0, 1.0))


def _aberration() -> Shape:
    def columns(view: View) -> FloatArray:
        # A velocity V/c moves all stars by V/c: columns of the rotations are those along its axes.
        frames, state = view.part.frames, view.state
        return frames.in_pixels(state.shifts(frames.spread(state.rotations.T)))

    labels = tuple((f"velocity along {axis}", "km/s") for axis in ("ICRS x", "ICRS y", "ICRS z"))
    return Shape(
        "aberration of a constant velocity",
        "direction",
        3,
        columns,
        labels,
        (LIGHT_SPEED_KM_S,) * 3,
    )


def _focal_against(
    clock: FloatArray, name: str, against: str, label: tuple[str, str], spread: float
) -> Shape:
    def columns(view: View) -> FloatArray:
        return view.parameter_columns[2:3] * clock[view.rows]

    return Shape(name, against, 1, columns, (label,), (1.0 / spread,))


def outwards(uv: FloatArray, size: int) -> FloatArray:
    """Columns (size, 2, n) along the radius, at positions (2, n) in units of the largest one."""
    from numpy.polynomial.chebyshev import chebvander

    powers = chebvander(2.0 * np.hypot(*uv) - 1.0, size - 1).T
    return powers[:, None] * uv


def _radius(camera: Camera) -> Shape:
    radius = camera.corner_radius_px

    def columns(view: View) -> FloatArray:
        out = outwards(view.uv / radius, _RADIAL_DEGREE)
        across = out[:_TWIST_DEGREE, ::-1] * np.array([[-1.0], [1.0]])
        return np.concatenate([out, across])

    return Shape("smooth pattern over radius", "radius", _RADIAL_DEGREE + _TWIST_DEGREE, columns)


def _azimuth(camera: Camera) -> Shape:
    radius = camera.corner_radius_px

    def columns(view: View) -> FloatArray:
        angle = np.arctan2(view.uv[1], view.uv[0])
        out = view.uv / radius
        across = np.stack([-out[1], out[0]])
        waves = [f(m * angle) for m in range(1, _AZIMUTH_ORDERS + 1) for f in (np.cos, np.sin)]
        return np.stack([wave * direction for wave in waves for direction in (out, across)])

    return Shape("smooth pattern over azimuth", "azimuth", 4 * _AZIMUTH_ORDERS, columns)


def phase_shape(axis: int) -> Shape:
    """Waves over a pixel along one axis, 0 or 1."""
    name = "xy"[axis]

    def columns(view: View) -> FloatArray:
        # Whole pixels drop out of the waves, so the position on the detector stands for its
        # fraction.
        centre = view.predicted[axis]
        waves = [
            f(2.0 * np.pi * h * centre) for h in range(1, _HARMONICS + 1) for f in (np.sin, np.cos)
        ]
        found = np.zeros((len(waves), 2, len(centre)))
        found[:, axis] = waves
        return found

    labels = tuple(
        (f"{wave}({2 * h}π{name})", "px")
        for h in range(1, _HARMONICS + 1)
        for wave in ("sin", "cos")
    )
    size = 2 * _HARMONICS
    against = f"pixel phase in {name}"
    return Shape(
        f"error with the pixel phase in {name}", against, size, columns, labels, (1.0,) * size
    )


def magnitude_shape(z: FloatArray, camera: Camera) -> Shape:
    """Shift and scale that change with the standardised magnitude (N,), to second order."""
    radius = camera.corner_radius_px

    def columns(view: View) -> FloatArray:
        own = z[view.rows]
        one, zero = np.ones_like(own), np.zeros_like(own)
        shifts = np.stack([np.stack([one, zero]), np.stack([zero, one]), view.uv / radius])
        return np.concatenate([shifts * own, shifts * own**2])

    return Shape("shift and scale with magnitude", "magnitude", 6, columns)


def over_time(clock: FloatArray, called: str) -> Shape:
    """Polynomials in the clock (N,) for x0, y0 and f, without constants."""

    def columns(view: View) -> FloatArray:
        from numpy.polynomial.legendre import legvander

        powers = legvander(clock[view.rows], TIME_DEGREE).T[1:]
        moving = view.parameter_columns[:3]
        return np.concatenate([moving[i] * powers[:, None] for i in range(3)])

    return Shape(
        f"smooth change of x0, y0 and f over the {called}", called, 3 * TIME_DEGREE, columns
    )


@dataclass(frozen=True)
class Cells:
    """Square cells of a detector, row by row: `ny` rows of `nx`."""

    side_px: float
    nx: int
    ny: int

    @classmethod
    def of(cls, camera: Camera, n_stars: int, fewest: int, most: int) -> Cells:
        """Cells of about 25 of so many stars: `fewest` to `most` of them along the longer side."""
        sides = camera.width_px, camera.height_px
        along = np.sqrt(n_stars / _STARS_PER_CELL * max(sides) / min(sides))
        cell = max(sides) / int(np.clip(along, fewest, most))
        nx, ny = (int(np.ceil(side / cell - 1e-9)) for side in sides)
        return cls(cell, nx, ny)

    def at(self, xy: FloatArray) -> IntArray:
        """Cell (N,) of each of these pixels (2, N)."""
        column, row = (
            np.clip(((values + 0.5) / self.side_px).astype(np.int64), 0, n - 1)
            for values, n in zip(xy, (self.nx, self.ny), strict=True)
        )
        return np.asarray(row * self.nx + column)


def _cells(obs: Observations, camera: Camera, max_cells: int) -> Shape:
    field = Cells.of(camera, obs.n_stars, 2, max_cells)
    nx, ny = field.nx, field.ny

    def cells(view: View) -> IntArray:
        return field.at(view.predicted)

    def columns(view: View) -> FloatArray:
        own = cells(view)
        star = np.arange(len(own))
        found = np.zeros((nx * ny, 2, 2, len(own)))
        found[own, 0, 0, star] = found[own, 1, 1, star] = 1.0
        return found.reshape(-1, 2, len(own))

    name = f"mean shift in {nx} × {ny} cells of the field"
    return Shape(name, "field cells", 2 * nx * ny, columns, cells=cells)
