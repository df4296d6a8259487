"""The starter of a budget file: every contributor that is not assessed, to be filled in."""

from __future__ import annotations

from collections.abc import Sequence
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

_HEADER = f"""\
# Error budget: what the calibration cannot know, and what is required.
#
# Remove the "# " in front of the lines of a contributor that you have assessed, and put your number in. What stays
# commented out reads "not assessed" in the budget, never zero, and the totals read "at least".
# What does not exist for your sensor: applies = false, with the reason as provenance.
# A contributor of your own has a name that is not listed here, and states ecss_class, interpretation and
# absorbed_by_alignment too. On an axis that it leaves out it is not assessed, unless applies = false is stated there.
#
# Keys of a contributor (values that are left out are those shown here for it):
#   axis                   X (pitch), Y (yaw), Z (roll), cross-boresight (pitch and yaw, each), all
#   sigma_arcsec           standard deviation; or half_width_arcsec for uniform (half its width) and arcsine (amplitude)
#   mean_arcsec            known mean, with its sign; 0 if left out
#   distribution           {", ".join(DISTRIBUTIONS)}
#   ecss_class             {", ".join(ECSS_CLASSES[:5])},
#                          {", ".join(ECSS_CLASSES[5:])}
#   interpretation         what it is random over: {", ".join(INTERPRETATIONS)}
#   absorbed_by_alignment  by an alignment calibration with the same camera parameters:
#                          {", ".join(ABSORBED)} (exists only after it)
#   correlation_group      rows with the same text here err together, on all axes: their sigmas add; "-text" errs
#                          against those with "text"
#   conditions             under what conditions the number holds
#   provenance             where the number is from (a report, an analysis); it must be given

[budget]
title = "Star sensor: attitude error budget"
confidence = 0.997

# [document]                           # title block of the budget to sign: -o budget.pdf
# project = "..."
# number = "..."
# issue = "1"
# prepared = "..."                     # names, with room for signatures
# checked = "..."
# approved = "..."

# [[requirement]]
# name = "R-1 attitude knowledge across the boresight"
# axis = "cross-boresight"             # X, Y, Z, or cross-boresight: the angle of both axes together
# limit_arcsec = 10.0
# confidence = 0.997
# scope = "after alignment"            # or "before alignment"
# interpretation = "mixed"             # or "ensemble" (a sensor at its worst moment), "temporal" (the worst sensor)
# judged_by = "both"                   # the larger of "rule" and "sampling"
# frame = "sensor"                     # or one with a table of its own:
#
# [frame.payload]
# rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]   # v_payload = R v_sensor; or a quaternion (scalar
#                                                                  # last)

"""


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
