"""One comparison as a self-contained page, with its tables and its figure beside it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from starcal_uq.camera.distortion import parameters
from starcal_uq.comparison.result import CameraComparison
from starcal_uq.core.files import atomic_write_bytes, atomic_write_text, new_folder
from starcal_uq.core.formatting import fixed, percent, pretty_unit, significant, with_sigma
from starcal_uq.presentation.figures.comparison import plot_camera_comparison
from starcal_uq.presentation.figures.style import png_bytes
from starcal_uq.presentation.html import embedded_image, template_environment
from starcal_uq.presentation.words.comparison import headline, p_words, rotation_words

_LEVELS = {"agree": "pass", "parameters differ": "warning", "maps differ": "fail", "not tested": "warning"}
_BADGES = {
    "agree": "✓ agree",
    "parameters differ": "! parameters differ",
    "maps differ": "✗ differ",
    "not tested": "! not tested",
}


def write_comparison(comparison: CameraComparison, folder: str | os.PathLike[str]) -> Path:
    """Write the page, the tables, the figure and a lossless file into a folder; existing ones are overwritten.

    Returns
    -------
    Path
        ``comparison.html``, which needs no network and no other file.

    Raises
    ------
    RunFolderError
        If the folder cannot be made or written to.
    """
    path = new_folder(folder)
    image = png_bytes(plot_camera_comparison(comparison))
    comparison.save(path / "comparison.json")
    atomic_write_text(path / "difference.csv", comparison.to_dataframe().to_csv(index=False))
    atomic_write_text(path / "difference_map.csv", comparison.field_dataframe().to_csv(index=False))
    atomic_write_bytes(path / "difference_map.png", image)
    page = path / "comparison.html"
    atomic_write_text(page, render_comparison(comparison, image))
    return page


def render_comparison(comparison: CameraComparison, image: bytes) -> str:
    """The page as one HTML document; `image` is the figure as PNG."""
    environment = template_environment()
    context = {
        "found": comparison,
        "level": _LEVELS[comparison.verdict],
        "badge": _BADGES[comparison.verdict],
        "headline": headline(comparison),
        "rotation": rotation_words(comparison),
        "false_alarms": percent(comparison.level, 1),
        "map_rows": _map_rows(comparison),
        "test_rows": _test_rows(comparison),
        "parameter_rows": _parameter_rows(comparison),
        "sources": [
            _source(label, comparison.provenance.get(key, {}))
            for label, key in zip(comparison.labels, "ab", strict=True)
        ],
        "image": embedded_image(image),
    }
    return environment.get_template("comparison.html.j2").render(context) + "\n"


def _map_rows(comparison: CameraComparison) -> list[dict[str, str]]:
    return [
        {
            "name": "Root mean square over the detector",
            "arcsec": significant(comparison.rms_arcsec),
            "px": significant(comparison.rms_px),
            "expected": significant(comparison.expected_rms_arcsec) if comparison.tested else "not known",
        },
        {
            "name": "Largest",
            "arcsec": significant(comparison.largest_arcsec),
            "px": significant(comparison.largest_px),
            "expected": "",
        },
    ]


def _test_rows(comparison: CameraComparison) -> list[dict[str, str]]:
    if not comparison.tested:
        return []
    worst = (
        f"{significant(comparison.worst_ratio)} times its 1 sigma at x = {comparison.worst_x_px:.0f} px, y = "
        f"{comparison.worst_y_px:.0f} px"
    )
    error = f" (Monte Carlo, ±\N{NO-BREAK SPACE}{significant(comparison.p_worst_error, 1)})"
    rows = [
        {
            "name": "Map",
            "asks": "Do the directions differ by more than they should, on average over the detector?",
            "statistic": f"{significant(comparison.rms_arcsec)} arcsec, "
            f"{significant(comparison.expected_rms_arcsec)} expected",
            "p": p_words(comparison.p_map),
        },
        {
            "name": "Parameters",
            "asks": "Can the two be the same camera, every direction weighed by its own uncertainty?",
            "statistic": f"χ² = {significant(comparison.statistic, 3)} for {comparison.n_directions}",
            "p": p_words(comparison.p_parameters),
        },
        {
            "name": "Worst place",
            "asks": "Is the place that stands out most worse than the worst of so many by chance?",
            "statistic": worst,
            "p": p_words(comparison.p_worst) + error,
        },
    ]
    return rows if np.isfinite(comparison.p_parameters) else rows[:1]


def _parameter_rows(comparison: CameraComparison) -> list[dict[str, str]]:
    specs = {p.name: p for model in comparison.models for p in parameters(model)}
    rows = []
    for i, name in enumerate(comparison.parameter_names):
        spec = specs[name]
        a, b, sd_a, sd_b, sd = (
            float(values[i]) / spec.scale
            for values in (
                comparison.theta_a,
                comparison.theta_b,
                comparison.sd_a,
                comparison.sd_b,
                comparison.sd_difference,
            )
        )
        known = np.isfinite(sd) and sd > 0.0
        rows.append(
            {
                "name": name,
                "a": f"{with_sigma(a, sd_a)} ± {significant(sd_a)}",
                "b": f"{with_sigma(b, sd_b)} ± {significant(sd_b)}",
                "difference": f"{with_sigma(b - a, sd)} ± {significant(sd)}" if known else significant(b - a),
                "z": fixed((b - a) / sd, 1) if known else "",
                "unit": pretty_unit(spec.scaled_unit),
            }
        )
    return rows


def _source(label: str, provenance: dict[str, Any]) -> dict[str, str]:
    """Where a result comes from."""
    settings = provenance.get("settings", {})
    words = [f"{name} {settings[name]}" for name in ("method", "likelihood") if name in settings]
    return {
        "label": label,
        "created": str(provenance.get("created_utc", "")).replace("T", " ").replace("Z", " UTC"),
        "settings": ", ".join(words),
        "data": str(provenance.get("data_sha256") or ""),
    }
