"""The starter of a budget file: every contributor that is not assessed, to be filled in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap

from starcal_uq.budgeting.rows import (
    ABSORBED,
    DISTRIBUTIONS,
    ECSS_CLASSES,
    FROM_FILE,
    INTERPRETATIONS,
    Contributor,
    Expected,
)
from starcal_uq.budgeting.shapes import HALF_WIDTHS
from starcal_uq.core.constants import AXES
from starcal_uq.core.files import atomic_write_text, ensure_new
from starcal_uq.core.types import PathLike

_LETTERS = dict(zip(AXES, "XYZ", strict=True))

_HEADER = (
    Path(__file__)
    .with_name("starter.toml")
    .read_text("utf-8")
    .format(
        distributions=", ".join(DISTRIBUTIONS),
        first_classes=", ".join(ECSS_CLASSES[:5]),
        other_classes=", ".join(ECSS_CLASSES[5:]),
        interpretations=", ".join(INTERPRETATIONS),
        absorbed=", ".join(ABSORBED),
    )
)


def template_text(rows: Sequence[Contributor] = ()) -> str:
    """Text of the starter file: everything, or what `rows` of a budget leave unassessed on an
    axis.
    """
    parts = [_HEADER]
    for entry in FROM_FILE:
        mine = [row for row in rows if row.name == entry.name]
        axes = [row.axis for row in mine if not row.assessed] if mine else list(AXES)
        if axes:
            parts.append(_entry(entry, axes))
    return "\n".join(parts)


def _entry(entry: Expected, axes: Sequence[str]) -> str:
    words = wrap(f"{entry.name[0].upper()}{entry.name[1:]}: {entry.what}.", 115)
    named = [_LETTERS[axis] for axis in axes]
    shown = ["cross-boresight", "Z"] if len(named) == len(AXES) else named
    size = "half_width_arcsec" if entry.distribution in HALF_WIDTHS else "sigma_arcsec"
    blocks = ["\n".join(f"# {line}" for line in words)]
    for axis in shown:
        lines = (
            "[[contributor]]",
            f'name = "{entry.name}"',
            f'axis = "{axis}"',
            f"{size} = ",
            f'distribution = "{entry.distribution}"',
            f'ecss_class = "{entry.ecss_class}"',
            f'interpretation = "{entry.interpretation}"',
            f'absorbed_by_alignment = "{entry.absorbed_by_alignment}"',
            'conditions = ""',
            'provenance = ""',
        )
        blocks.append("\n".join(f"# {line}".rstrip() for line in lines))
    return "\n#\n".join(blocks) + "\n"


def write_budget_template(
    path: PathLike, rows: Sequence[Contributor] = (), *, force: bool = False
) -> None:
    """Write a starter budget file that lists every contributor which is not assessed.

    Parameters
    ----------
    path : path
        The TOML file; it loads as it is, and states nothing until lines are uncommented.
    rows : sequence of Contributor
        ``Budget.rows``: what is assessed there is left out.
    force : bool
        Write over an existing file.

    Raises
    ------
    RunFolderError
        If the file exists, or cannot be written.
    """
    ensure_new(path, force)
    atomic_write_text(path, template_text(rows))
