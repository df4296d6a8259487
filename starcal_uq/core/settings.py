"""What settings may be, numbers within limits or words of a list: said once, for Python and the
command line.

A limit belongs to the name of a parameter, which has it wherever it occurs; `bounded` makes a
function refuse what lies outside, before it does anything.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import wraps
from numbers import Integral, Real
from typing import Any, Literal, ParamSpec, TypeVar

from starcal_uq.core.errors import SettingError
from starcal_uq.core.files import shown

P = ParamSpec("P")
R = TypeVar("R")

Method = Literal["efficient", "three_stage", "least_squares", "samaan", "griffith"]
RecursiveMethod = Literal["samaan", "griffith"]
Solver = Literal["lm", "minpack", "ipopt"]
ModelName = Literal["none", "k1", "brown", "brown3", "brown_tangential", "inverse"]
NoiseKind = Literal["common", "model"]
MergedNoise = Literal["auto", "common", "own"]
Duplicates = Literal["refuse", "drop", "keep"]
Directions = Literal["undeclared", "catalogue", "apparent"]
Engine = Literal["pyramid", "tetra3rs"]
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
StudyTemplate = Literal["fov-distortion", "frames-stars", "magnitude-noise", "distortion-models"]
Convention = Literal["eq14", "eq6"]
FieldReading = Literal["window", "full"]
Starter = Literal["camera", "site", "budget", "study", "example"]
ExampleName = Literal["esa"]
ReportFormat = Literal["html", "pdf"]
ExportFormat = Literal[
    "opencv",
    "ros",
    "kalibr",
    "mrcal",
    "tetra3rs",
    "tetra3",
    "sip",
    "asdf",
    "covariance",
    "csv",
    "netcdf",
    "arviz",
    "latex",
    "markdown",
]


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


# What `numpy.random.SeedSequence` makes of one seed for others.
SEED = Limit(0, 2**64 - 1)
SIGMA_PX = Limit(0.0, 100.0, whole=False)
EPOCH = Limit(1800.0, 2200.0, whole=False)
MAGNITUDES = Limit(-2.0, 10.0, whole=False)
PROBABILITY = Limit(1e-9, 1.0 - 1e-9, whole=False)
# Of an error that is aimed at.
ARCSEC = Limit(1e-9, 1e6, whole=False)
LIMITS = {
    "seed": SEED,
    "n_frames": Limit(1, 10**9),
    "gallery_frames": Limit(1, 1000),
    "partition_frames": Limit(1, 10**7),
    "alignment_frames": Limit(1, 10**6),
    "min_stars": Limit(2, 10**4),
    "max_stars": Limit(1, 10**6),
    "n_replicates": Limit(1, 10**6),
    "n_campaigns": Limit(1, 10**6),
    "n_geometries": Limit(1, 10**6),
    "n_starts": Limit(0, 10**4),
    "max_iterations": Limit(1, 10**6),
    "n_draws": Limit(1, 10**7),
    "n_samples": Limit(1, 10**9),
    "n_ensembles": Limit(1, 10**4),
    "n_walkers": Limit(1, 10**6),
    "n_steps": Limit(1, 10**8),
    "n_burn": Limit(0, 10**8),
    "workers": Limit(0, 10**4),
    "sigma_px": SIGMA_PX,
    "rate_hz": Limit(1e-6, 1e6, whole=False),
    "gain_e_per_count": Limit(1e-6, 1e6, whole=False),
    "read_noise_e": Limit(0.0, 1e6, whole=False),
    "saturation": Limit(0.0, 1e12, whole=False),
    "threshold_sigma": Limit(2.0, 1e6, whole=False),
    "psf_sigma_px": Limit(0.2, 20.0, whole=False),
    "min_pixels": Limit(1, 10**6),
    "focal_tolerance": Limit(1e-9, 0.3, whole=False),
    "centre_tolerance_px": Limit(1e-3, 1e5, whole=False),
    "distortion_tolerance_px": Limit(0.0, 1e5, whole=False),
}


# The same for keys of files and axes of studies that are no parameters of functions, or have limits
# of their own there.
KEYS = {
    "width_px": Limit(1, 10**6),
    "height_px": Limit(1, 10**6),
    "pixel_um": Limit(0.01, 1e4, whole=False),
    "focal_mm": Limit(1e-3, 1e7, whole=False),
    "focal_px": Limit(1e-2, 1e9, whole=False),
    "x0_px": Limit(-1e6, 1e6, whole=False),
    "y0_px": Limit(-1e6, 1e6, whole=False),
    "coefficient": Limit(-1.0, 1.0, whole=False),
    "fov_deg": Limit(0.1, 120.0, whole=False),
    "pixels": Limit(16, 10**5),
    "x0_offset_px": Limit(-1e5, 1e5, whole=False),
    "y0_offset_px": Limit(-1e5, 1e5, whole=False),
    "distortion_px": Limit(-1e5, 1e5, whole=False),
    "max_mag": Limit(-1.0, 10.0, whole=False),
    "stars": Limit(3, 10**5),
    "frames": Limit(1, 10**7),
    "min_stars": Limit(3, 10**4),
    "sigma_px": Limit(1e-6, 20.0, whole=False),
    "noise_per_mag": Limit(0.0, 1.0, whole=False),
    "noise_mag": Limit(-30.0, 60.0, whole=False),
    "noise_floor_px": Limit(0.0, 20.0, whole=False),
    "direction_mas": Limit(0.0, 1e6, whole=False),
    "seeds": Limit(1, 10**6),
    "target_arcsec": ARCSEC,
    "target_sigma": Limit(1e-9, 1e6, whole=False),
    "epoch": EPOCH,
    "probability": PROBABILITY,
    "magnitude": MAGNITUDES,
    "geometries": Limit(20, 10**5),
    "draws": Limit(100, 10**6),
    "values": Limit(1, 10**6),
}


def bounded(function: Callable[P, R]) -> Callable[P, R]:
    """A function that refuses, with `SettingError`, settings outside the limits of their names."""
    parameters = inspect.signature(function).parameters
    names = tuple(parameters)
    takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    limits = {name: limit for name, limit in LIMITS.items() if takes_any or name in names}

    @wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        given: Iterable[tuple[str, Any]] = (*zip(names, args, strict=False), *kwargs.items())
        for name, value in given:
            if name in limits and not limits[name].holds(value):
                raise SettingError(f"{name} is {shown(value)}: {limits[name].wanted()}.")
        return function(*args, **kwargs)

    return checked


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
