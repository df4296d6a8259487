"""What settings may be, numbers within limits or words of a list: said once, for Python and the
command line.

A limit belongs to the name of a parameter, which has it wherever it occurs; `bounded` makes a
function refuse what lies outside, before it does anything.
"""

from __future__ import annotations

import inspect
import os
import tomllib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import wraps
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, ParamSpec, TypeAlias, TypeVar, get_args

from starcal_uq.core.errors import CalibrationError, SettingError
from starcal_uq.core.files import shown
from starcal_uq.core.units import plain

if TYPE_CHECKING:
    import numpy as np

P = ParamSpec("P")
R = TypeVar("R")

# What `seed_of` makes a whole number of, which is recorded.
Seed: TypeAlias = "int | np.random.Generator"
Method = Literal["efficient", "three_stage", "least_squares", "samaan", "griffith"]
RecursiveMethod = Literal["samaan", "griffith"]
Solver = Literal["lm", "minpack", "ipopt"]
ModelName = Literal[
    "none",
    "k1",
    "brown",
    "brown3",
    "brown_tangential",
    "inverse",
    "thin_prism",
    "cubic",
    "f_theta",
    "equidistant",
    "fisheye",
    "none+axes",
    "k1+axes",
    "brown+axes",
    "brown3+axes",
    "brown_tangential+axes",
    "inverse+axes",
    "thin_prism+axes",
    "cubic+axes",
    "f_theta+axes",
    "equidistant+axes",
    "fisheye+axes",
]
MountKind = Literal["none", "fixed"]
EffectName = Literal[
    "axes",
    "field",
    "radial",
    "frame",
    "zenith",
    "temperature",
    "time",
    "epoch",
    "star",
    "phase",
    "magnitude",
    "noise",
    "tails",
]
# Effects that decide how much stars count, and shift none.
WEIGHING = ("noise", "tails")
OnboardModel = Literal["model", "effects"]
MergedNoise = Literal["auto", "common", "own"]
Duplicates = Literal["refuse", "drop", "keep"]
Directions = Literal["undeclared", "catalogue", "apparent"]
Mosaic = Literal["RGGB", "BGGR", "GRBG", "GBRG"]
Bayer = Literal["RGGB", "BGGR", "GRBG", "GBRG", "none"]
LikelihoodName = Literal["marginal", "pairs", "pairs_naive", "student_t"]
Evaluation = Literal["auto", "compressed", "exact"]
Moves = Literal["mixture", "stretch"]
Sense = Literal["icrs_to_camera", "camera_to_icrs"]
Scalar = Literal["first", "last"]
Split = Literal["odd-even", "halves", "random"]
Scope = Literal["common", "rest", "calibration", "total"]
Criterion = Literal["D", "A"]
PairCovariance = Literal["full", "diagonal"]
Filtered = Literal["optics", "all"]
Truth = Literal["fixed", "prior"]
StudyTemplate = Literal[
    "fov-distortion", "frames-stars", "magnitude-noise", "distortion-models", "effects"
]
Convention = Literal["eq14", "eq6"]
FieldReading = Literal["window", "full"]
Starter = Literal["run", "camera", "sensor", "site", "budget", "study", "example"]
ExampleName = Literal["esa"]
ReportFormat = Literal["html", "pdf"]
BudgetFormat = Literal["xlsx", "tex", "html", "pdf"]
ExportFormat = Literal[
    "opencv",
    "ros",
    "kalibr",
    "mrcal",
    "giant",
    "tetra3rs",
    "tetra3",
    "sip",
    "spice",
    "asdf",
    "covariance",
    "csv",
    "netcdf",
    "arviz",
    "latex",
    "markdown",
]


def effect_names(effects: str | Sequence[str] | None) -> tuple[str, ...]:
    """Names in a list of effects as it is typed, ``auto`` among them; empty for ``none``.

    CalibrationError for a name that is unknown.
    """
    names = effects.split(",") if isinstance(effects, str) else list(effects or ())
    names = [name.strip() for name in names]
    if names == ["none"]:
        return ()
    known = ("auto", *get_args(EffectName))
    for name in names:
        if name not in known:
            raise CalibrationError(
                f"effect {name!r} is unknown: use none alone, or some of {', '.join(known)}."
            )
    return tuple(dict.fromkeys(names))


def joined_effects(*lists: str | Sequence[str] | None) -> str:
    """Lists of effects as one, as it is typed."""
    names = dict.fromkeys(name for effects in lists for name in effect_names(effects))
    return ",".join(names) or "none"


@dataclass(frozen=True)
class Limit:
    """The least and the greatest number that a setting may be, and whether it is a whole one."""

    low: float
    high: float
    whole: bool = True

    def wanted(self, low: float | None = None) -> str:
        """What to give, in words; a command may ask for more than the least."""
        return wanted(self.low if low is None else low, self.high, self.whole)

    def holds(self, value: Any) -> bool:
        """Whether a number is one of these; what is neither number nor text is not judged."""
        if isinstance(value, str | float if self.whole else str):
            return False
        if isinstance(value, tuple | list):
            return all(map(self.holds, value))
        if not isinstance(value, Integral if self.whole else Real):
            return True
        return bool(self.low <= value <= self.high)  # type: ignore[operator]


def wanted(low: float, high: float, whole: bool, verb: str = "give") -> str:
    """What to give for a number within limits."""
    return f"{verb} a {'whole ' if whole else ''}number from {_written(low)} to {_written(high)}"


def _written(number: float) -> str:
    return str(number) if isinstance(number, int) else f"{number:.15g}"


def _limits(table: str) -> dict[str, Limit]:
    return {
        name: Limit(low, high, isinstance(low, int))
        for name, (low, high) in _DECLARED[table].items()
    }


_DECLARED = tomllib.loads(Path(__file__).with_name("limits.toml").read_text("utf-8"))
# Those of parameters of functions, and of keys of files and axes of studies.
LIMITS, KEYS = _limits("parameters"), _limits("keys")


def bounded(function: Callable[P, R]) -> Callable[P, R]:
    """A function that refuses, with `SettingError`, settings outside the limits of their names, and
    takes quantities and times of astropy in place of numbers and text.
    """
    names = tuple(inspect.signature(function).parameters)

    @wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        placed: Any = [*map(plain, names, args), *args[len(names) :]]
        others: Any = {name: plain(name, value) for name, value in kwargs.items()}
        given: Iterable[tuple[str, Any]] = (*zip(names, placed, strict=False), *others.items())
        for name, value in given:
            if name in LIMITS and not LIMITS[name].holds(value):
                raise SettingError(f"{name} is {shown(value)}: {LIMITS[name].wanted()}.")
        return function(*placed, **others)

    return checked


def seed_of(seed: Seed) -> int:
    """A whole number that repeats a result bit for bit: the seed, or one drawn from a Generator."""
    if isinstance(seed, Integral):
        return int(seed)
    draw = getattr(seed, "integers", None)
    if draw is None:
        raise SettingError(
            f"seed is {shown(seed)}: {LIMITS['seed'].wanted()}, or a numpy.random.Generator."
        )
    return int(draw(1 << 63))


def check_memory(setting: str, n_bytes: float) -> None:
    """Refuse a setting, such as "n_steps=10", with which results alone take more memory than this
    machine has.
    """
    try:
        installed = float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        # Not every system tells.
        return
    if n_bytes > installed:
        raise SettingError(
            f"{setting}: the result needs {n_bytes / 1e9:.3g} GB of memory at the least, and "
            "this machine has "
            f"{installed / 1e9:.3g} GB: give less."
        )
