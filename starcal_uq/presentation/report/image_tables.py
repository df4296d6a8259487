"""The section on images: what was found in them, and what identifying twice changed."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

from starcal_uq.camera.distortion import parameters
from starcal_uq.core.formatting import count, fixed, plural, pretty_unit, significant, with_sigma
from starcal_uq.presentation.report.tables import Row, symbol

if TYPE_CHECKING:
    from starcal_uq.estimation.calibration import Calibration
    from starcal_uq.pipeline.record import ImageRecord

# More images than this are counted, and only those left out are listed.
_LISTED = 40


def image_context(record: ImageRecord | None, cal: Calibration) -> dict[str, Any]:
    """What the section shows; empty where the run did not start from images."""
    if record is None:
        return {"image_record": None}
    rows = record.rows if len(record.rows) <= _LISTED else record.left_out[:_LISTED]
    reasons = Counter(row.outcome for row in record.left_out)
    return {
        "image_record": record,
        "image_rows": rows,
        "image_reasons": [f"{plural(number, 'image')}: {reason}" for reason, number in reasons.most_common()],
        "image_listing": "Every image." if len(record.rows) <= _LISTED else _listing(len(record.left_out)),
        "round_rows": _round_rows(record, cal),
    }


def _listing(left_out: int) -> str:
    if left_out > _LISTED:
        return f"The first {_LISTED} of {count(left_out)} images that were left out."
    return "The images that were left out."


def _round_rows(record: ImageRecord, cal: Calibration) -> list[Row]:
    """One row per quantity, with its value after the first and after the last round."""
    first, last = record.rounds[0], record.rounds[-1]
    rows: list[Row] = [
        {"name": "images identified", "values": [count(r.n_frames) for r in (first, last)], "change": "", "unit": ""},
        {
            "name": "stars calibrated",
            "values": [count(r.n_stars) for r in (first, last)],
            "change": f"{count(last.new)} identified anew, {count(last.given_up)} given up",
            "unit": "",
        },
    ]
    for parameter in parameters(cal.camera.distortion):
        if parameter.name not in first.parameters or parameter.name not in last.parameters:
            continue
        (old, old_sigma), (new, sigma) = first.parameters[parameter.name], last.parameters[parameter.name]
        scale = parameter.scale
        rows.append(
            {
                "name": symbol(parameter.name),
                "values": [_with_error(old / scale, old_sigma / scale), _with_error(new / scale, sigma / scale)],
                "change": f"{fixed((new - old) / sigma, 1)} σ" if sigma > 0.0 else "",
                "unit": pretty_unit(parameter.scaled_unit),
            }
        )
    unit = "times the stated noise" if last.sigma_name == "sigma_scale" else "px per axis"
    rows.append(
        {"name": "noise", "values": [significant(r.sigma, 3) for r in (first, last)], "change": "", "unit": unit}
    )
    return rows


def _with_error(value: float, sigma: float) -> str:
    return f"{with_sigma(value, sigma)} ± {significant(sigma)}"
