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


def write_comparison(found: CameraComparison, folder: str | os.PathLike[str]) -> Path:
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
    image = png_bytes(plot_camera_comparison(found))
    found.save(path / "comparison.json")
    atomic_write_text(path / "difference.csv", found.to_dataframe().to_csv(index=False))
    atomic_write_text(path / "difference_map.csv", found.field_dataframe().to_csv(index=False))
    atomic_write_bytes(path / "difference_map.png", image)
    page = path / "comparison.html"
    atomic_write_text(page, render_comparison(found, image))
    return page


def render_comparison(found: CameraComparison, image: bytes) -> str:
    """The page as one HTML document; `image` is the figure as PNG."""
    environment = template_environment()
    context = {
        "found": found,
        "level": _LEVELS[found.verdict],
        "badge": _BADGES[found.verdict],
        "headline": headline(found),
        "rotation": rotation_words(found),
        "false_alarms": percent(found.level, 1),
        "map_rows": _map_rows(found),
        "test_rows": _test_rows(found),
        "parameter_rows": _parameter_rows(found),
        "sources": [
            _source(label, found.provenance.get(key, {})) for label, key in zip(found.labels, "ab", strict=True)
        ],
        "image": embedded_image(image),
    }
    return environment.get_template("comparison.html.j2").render(context) + "\n"


def _map_rows(found: CameraComparison) -> list[dict[str, str]]:
    return [
        {
            "name": "Root mean square over the detector",
            "arcsec": significant(found.rms_arcsec),
            "px": significant(found.rms_px),
            "expected": significant(found.expected_rms_arcsec) if found.tested else "not known",
        },
        {
            "name": "Largest",
            "arcsec": significant(found.largest_arcsec),
            "px": significant(found.largest_px),
            "expected": "",
        },
    ]


def _test_rows(found: CameraComparison) -> list[dict[str, str]]:
    if not found.tested:
        return []
    worst = (
        f"{significant(found.worst_ratio)} times its 1 sigma at x = {found.worst_x_px:.0f} px, y = "
        f"{found.worst_y_px:.0f} px"
    )
    error = f" (Monte Carlo, ±\N{NO-BREAK SPACE}{significant(found.p_worst_error, 1)})"
    rows = [
        {
            "name": "Map",
            "asks": "Do the directions differ by more than they should, on average over the detector?",
            "statistic": f"{significant(found.rms_arcsec)} arcsec, {significant(found.expected_rms_arcsec)} expected",
            "p": p_words(found.p_map),
        },
        {
            "name": "Parameters",
            "asks": "Can the two be the same camera, every direction weighed by its own uncertainty?",
            "statistic": f"χ² = {significant(found.statistic, 3)} for {found.n_directions}",
            "p": p_words(found.p_parameters),
        },
        {
            "name": "Worst place",
            "asks": "Is the place that stands out most worse than the worst of so many by chance?",
            "statistic": worst,
            "p": p_words(found.p_worst) + error,
        },
    ]
    return rows if np.isfinite(found.p_parameters) else rows[:1]


def _parameter_rows(found: CameraComparison) -> list[dict[str, str]]:
    specs = {p.name: p for model in found.models for p in parameters(model)}
    rows = []
    for i, name in enumerate(found.parameter_names):
        spec = specs[name]
        a, b, sd_a, sd_b, sd = (
            float(values[i]) / spec.scale
            for values in (found.theta_a, found.theta_b, found.sd_a, found.sd_b, found.sd_difference)
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
