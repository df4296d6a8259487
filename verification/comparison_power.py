"""How often comparisons of cameras raise false alarms, and what they see: whole campaigns,
simulated and calibrated.

    python verification/comparison_power.py --replicates 200 --power 60 --frames 60

prints the tables of ``docs/explanation/comparison.md``. The sensor is that of Ye & Yang (2017) with
0.05 px of noise.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.comparison.compare import compare
from starcal_uq.core.types import FloatArray
from starcal_uq.paper.camera import paper_camera, paper_start
from starcal_uq.simulation.frames import simulate
from starcal_uq.sky.catalogue import load_catalogue

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.comparison.result import CameraComparison
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.sky.catalogue import StarCatalogue

_ALPHA = 0.05
_SEED = 40_000
_OPTIONS: dict[str, Any] = {"n": 13, "n_draws": 200}
_SHIFTS = (0.1, 0.2, 0.3, 0.5, 1.0, 3.0)


def null_comparisons(replicates: int, frames: int) -> dict[str, list[CameraComparison]]:
    """Comparisons in which nothing differs, and two that take the covariance of the difference
    wrongly, by name.
    """
    stars, truth, start = load_catalogue(max_mag=6.0, epoch=2026.9), paper_camera(), paper_start()
    richer = start.replace(distortion="brown3", coefficients=(0.0, 0.0, 0.0))
    found: dict[str, list[CameraComparison]] = {}
    for first, second in _campaigns(stars, truth, truth, replicates, frames):
        a, b, c = calibrate(first, start), calibrate(second, start), calibrate(first, richer)
        stages = calibrate(first, start, method="three_stage")
        certain = replace(b, covariance=1e-6 * b.covariance)
        pairs: tuple[tuple[str, Calibration, Calibration, dict[str, Any]], ...] = (
            ("other frames, same model", a, b, {}),
            ("other frames, brown and brown3", b, c, {}),
            ("same frames, brown and brown3", a, c, {}),
            ("same frames, three stages and efficient", stages, a, {}),
            ("control: one covariance left out", a, certain, {}),
            ("control: same frames, covariances added", a, c, {"same_data": False}),
        )
        for name, one, other, options in pairs:
            found.setdefault(name, []).append(compare(one, other, **_OPTIONS, **options))
    return found


def changed_focal_lengths(replicates: int, frames: int) -> dict[float, list[CameraComparison]]:
    """Comparisons of campaigns between which f grew by so many standard deviations of its
    difference.
    """
    stars, truth, start = load_catalogue(max_mag=6.0, epoch=2026.9), paper_camera(), paper_start()
    first, second = next(_campaigns(stars, truth, truth, 1, frames))
    sd_mm = (
        float(np.hypot(*(calibrate(obs, start).sigmas[2] for obs in (first, second))))
        * truth.pixel_um
        * 1e-3
    )
    found: dict[float, list[CameraComparison]] = {}
    for shift in _SHIFTS:
        changed = truth.replace(focal_mm=truth.focal_mm + shift * sd_mm)
        pairs = _campaigns(stars, truth, changed, replicates, frames)
        found[shift] = [
            compare(calibrate(a, start), calibrate(b, start), **_OPTIONS) for a, b in pairs
        ]
    return found


def _campaigns(
    stars: StarCatalogue, one: Camera, other: Camera, count: int, frames: int
) -> Iterator[Any]:
    for seed in range(_SEED, _SEED + 2 * count, 2):
        yield tuple(
            simulate(stars, camera, n_frames=frames, min_stars=8, sigma_px=0.05, seed=seed + i)
            for i, camera in enumerate((one, other))
        )


def null_table(found: dict[str, list[CameraComparison]]) -> str:
    """Markdown: share of p-values below 5 %, and the p-value of their uniformity (Kolmogorov and
    Smirnov).
    """
    lines = [
        (
            "| Nothing differs | Replicates | Map: p < 0.05 | uniform? | Parameters: p < 0.05 | "
            "uniform? |"
        ),
        "|---|---|---|---|---|---|",
    ]
    for name, comparisons in found.items():
        cells = []
        for p in (_values(comparisons, "p_map"), _values(comparisons, "p_parameters")):
            cells += (
                ["–", "–"] if np.isnan(p).any() else [f"{np.mean(p < _ALPHA):.3f}", _uniform(p)]
            )
        lines.append(f"| {name} | {len(comparisons)} | {' | '.join(cells)} |")
    return "\n".join(lines)


def power_table(found: dict[float, list[CameraComparison]]) -> str:
    """Markdown: how often a change is seen."""
    lines = [
        (
            "| f changed by | Replicates | Map: p < 0.05 | Parameters: p < 0.05 | Verdict “differ” "
            "(1 %) |"
        ),
        "|---|---|---|---|---|",
    ]
    for shift, comparisons in found.items():
        rates = [np.mean(_values(comparisons, name) < _ALPHA) for name in ("p_map", "p_parameters")]
        differ = np.mean([comparison.verdict != "agree" for comparison in comparisons])
        lines.append(
            f"| {shift:g} σ | {len(comparisons)} | {rates[0]:.2f} | {rates[1]:.2f} | {differ:.2f} |"
        )
    return "\n".join(lines)


def _values(comparisons: list[CameraComparison], name: str) -> FloatArray:
    return np.array([getattr(comparison, name) for comparison in comparisons])


def _uniform(p: FloatArray) -> str:
    from scipy.stats import kstest

    value = float(kstest(p, "uniform").pvalue)
    return f"{value:.2f}" if value >= 0.01 else f"{value:.0e}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(
        description="False alarms and power of comparisons of cameras."
    )
    parser.add_argument(
        "--replicates", type=int, default=200, help="pairs of campaigns in which nothing differs"
    )
    parser.add_argument(
        "--power", type=int, default=60, help="pairs for each change of the focal length"
    )
    parser.add_argument("--frames", type=int, default=60, help="frames of a campaign")
    options = parser.parse_args(arguments)
    print(null_table(null_comparisons(options.replicates, options.frames)))
    print()
    print(power_table(changed_focal_lengths(options.power, options.frames)))


if __name__ == "__main__":
    main()
