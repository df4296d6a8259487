"""One comparison as a self-contained page, with its tables and its figure beside it."""

from __future__ import annotations

from pathlib import Path

from starcal_uq.camera.distortion import parameters, scales_of
from starcal_uq.comparison.result import CameraComparison
from starcal_uq.core.files import atomic_write_bytes, atomic_write_text, write_csv
from starcal_uq.core.formatting import p_words
from starcal_uq.core.manifest import making
from starcal_uq.core.provenance import Provenance
from starcal_uq.core.types import PathLike
from starcal_uq.presentation.figures.comparison import plot_camera_comparison
from starcal_uq.presentation.figures.style import svg_bytes
from starcal_uq.presentation.html import page
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.sentences import table

# Class and badge of the page.
_VERDICTS = {
    "agree": ("pass", "✓ agree"),
    "parameters differ": ("warning", "! parameters differ"),
    "maps differ": ("fail", "✗ differ"),
    "not tested": ("warning", "! not tested"),
}
_PAGE = "comparison.html"


def write_comparison(comparison: CameraComparison, folder: PathLike) -> Path:
    """Write the page, the tables, the figure and a lossless file into a folder, in place of those
    of before.

    Returns ``comparison.html``, which needs no network and no other file.
    """
    image = svg_bytes(plot_camera_comparison(comparison))
    with making(folder, "compare", _PAGE, force=True) as path:
        comparison.save(path / "comparison.json")
        write_csv(comparison.to_dataframe(), path / "difference.csv")
        write_csv(comparison.field_dataframe(), path / "difference_map.csv")
        atomic_write_bytes(path / "difference_map.svg", image)
        atomic_write_text(path / _PAGE, render_comparison(comparison, image))
    return Path(folder) / _PAGE


def render_comparison(comparison: CameraComparison, image: bytes) -> str:
    """The page as one HTML document; `image` is the figure as SVG."""
    level, badge = _VERDICTS[comparison.verdict]
    return page(
        "comparison.html.j2",
        comparison.provenance,
        found=comparison,
        level=level,
        badge=badge,
        p_words=p_words,
        parameters=_parameter_table(comparison),
        sources=_source_table(comparison),
        images={"difference": image},
    )


def _parameter_table(found: CameraComparison) -> TextTable:
    specs = {p.name: p for model in found.models for p in parameters(model)}
    estimates = (found.theta_a, found.theta_b, found.sd_a, found.sd_b, found.sd_difference)
    shown = [specs[name] for name in found.parameter_names]
    names = ("a", "b", "sd_a", "sd_b", "sd")
    scaled = {
        name: values / scales_of(shown) for name, values in zip(names, estimates, strict=True)
    }
    return table("compared", {"labels": found.labels}, spec=shown, **scaled)


def _source_table(found: CameraComparison) -> TextTable:
    """Where both results come from."""
    sources = [Provenance(found.provenance.get(key, {})) for key in "ab"]
    return table("sources", label=found.labels, it=sources)
