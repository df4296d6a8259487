"""Studies whose answer is known: correlations, sigmas and errors are given by formulas, not
computed from frames.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import product
from typing import Any

import numpy as np
import xarray as xr

import starcal_uq as sc
from starcal_uq.core.constants import AXES
from starcal_uq.propagation.coupling import weak_directions
from starcal_uq.studies.definition import StudyDefinition
from starcal_uq.studies.result import Study

NAMES = ("x0", "y0", "f", "k1", "k2")
SIGMAS = np.array([0.5, 0.5, 0.1, 1e-10, 1e-16])
Correlations = Callable[[Mapping[str, Any]], dict[tuple[str, str], float]]


def made_study(
    sweep: dict[str, tuple[Any, ...]],
    correlations: Correlations,
    *,
    size: Callable[[Mapping[str, Any]], float] = lambda cell: 1.0,
    jitter: float = 1e-3,
    seeds: int = 3,
    failing: Callable[[Mapping[str, Any]], str] = lambda cell: "ok",
    covered: float | None = None,
    target_arcsec: float | None = 0.5,
    bias_arcsec: Callable[[Mapping[str, Any]], float] = lambda cell: 0.1,
) -> Study:
    """A study in which a cell's correlations, the size of its errors (arcsec) and its failures are
    given.

    `correlations`: from a cell's values to the correlations of pairs; all others are zero. `size`:
    factor on all sigmas and errors of a cell; the frame-dependent error is this many arcsec.
    `jitter`: standard deviation that other seeds give the correlations. `covered`: probability that
    an interval holds the truth; makes the study a simulated one.
    """
    rng = np.random.default_rng(1)
    definition = StudyDefinition(
        camera=sc.paper.paper_camera(),
        sweep=sweep,
        name="A study <made> by hand",
        seeds=tuple(range(seeds)),
        mode="fisher" if covered is None else "simulate",
        target_arcsec=target_arcsec,
        target_sigma={"f": 0.05},
    )
    cells = [
        dict(zip(sweep, values, strict=True))
        for values in product(*sweep.values())
        for _ in range(seeds)
    ]
    n, p = len(cells), len(NAMES)
    status = np.array([failing(cell) for cell in cells])
    good = status == "ok"
    scale = np.where(good, [size(cell) for cell in cells], np.nan)
    matrix = np.full((n, p, p), np.nan)
    weak = np.full((n, p), np.nan)
    variance = np.full(n, np.nan)
    words = np.full(n, "", dtype=object)
    for i in np.flatnonzero(good):
        matrix[i] = np.eye(p)
        for (first, second), r in correlations(cells[i]).items():
            a, b = NAMES.index(first), NAMES.index(second)
            matrix[i, a, b] = matrix[i, b, a] = np.clip(r + jitter * rng.normal(), -0.9999, 0.9999)
        direction = weak_directions(matrix[i], NAMES)[0]
        weak[i], variance[i] = direction.weights, direction.variance
        words[i] = direction.words
    sigma = scale[:, None] * SIGMAS
    inflation = np.full((n, p), np.nan)
    inflation[good] = np.diagonal(np.linalg.inv(matrix[good]), axis1=1, axis2=2)
    ones = np.ones((n, 3))
    attitude = np.where(good[:, None, None], 0.1, np.nan) * np.ones((n, p, 3))
    frames = np.array([cell.get("frames", 200) for cell in cells], dtype=np.float64)
    factor = 10.0 ** np.arange(-3.0, 3.01, 0.25)
    bias = np.where(good, [bias_arcsec(cell) for cell in cells], np.nan)
    variables: dict[str, Any] = {
        "status": ("cell", status),
        "n_frames": ("cell", np.where(good, frames, np.nan)),
        "mean_stars": ("cell", np.where(good, 15.0, np.nan)),
        "sigma": (("cell", "parameter"), sigma),
        "sigma_conditional": (("cell", "parameter"), sigma / np.sqrt(inflation)),
        "variance_inflation": (("cell", "parameter"), inflation),
        "correlation": (("cell", "parameter", "parameter_2"), matrix),
        "condition_number": ("cell", np.where(good, 1.0, np.nan)),
        "weak_direction": (("cell", "parameter"), weak),
        "weak_variance": ("cell", variance),
        "weak_words": ("cell", words.astype(str)),
        "attitude_correlation": (("cell", "parameter", "axis"), attitude),
        "common_rotation_arcsec": (("cell", "axis"), 10.0 * scale[:, None] * ones),
        "frame_error_arcsec": (("cell", "axis"), scale[:, None] * ones),
        "nea_arcsec": (("cell", "axis"), scale[:, None] * ones),
        "error_curve_arcsec": (("cell", "frames_factor"), scale[:, None] / np.sqrt(factor)),
        # Sigmas fall as the root of the number of frames.
        "frames_needed_sigma": (
            ("cell", "parameter"),
            np.ceil(frames[:, None] * (sigma / 0.05) ** 2),
        ),
        "model_bias_arcsec": (("cell", "simpler"), bias[:, None]),
        "model_bias_attitude_arcsec": (
            ("cell", "simpler", "axis"),
            bias[:, None, None] * ones[:, None, :],
        ),
    }
    if covered is not None:
        held = np.where(good[:, None], rng.random((n, p)) < covered, np.nan)
        variables["covered_95"] = (("cell", "parameter"), held)
        variables["posterior_correlation"] = variables["correlation"]
    coordinates: dict[str, Any] = {
        **{name: ("cell", np.array([cell[name] for cell in cells])) for name in sweep},
        "seed_index": ("cell", np.tile(np.arange(seeds), n // seeds)),
        "key": ("cell", np.array([f"{i:032x}" for i in range(n)])),
        "parameter": list(NAMES),
        "parameter_2": list(NAMES),
        "axis": list(AXES),
        "frames_factor": factor,
        "simpler": ["none"],
    }
    return Study(xr.Dataset(variables, coordinates, {"starcal_uq": "0.1.0", "seed": 0}), definition)
