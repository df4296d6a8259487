"""Tables of the field experiment."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.formatting import fixed, significant
from starcal_uq.core.types import FloatArray
from starcal_uq.paper.field.published import (
    FIELD_CAMERAS,
    FIELD_METHODS,
    RATE,
    TRUE_CAMERA,
    UNCALIBRATED,
    printed_field,
    printed_sensor,
)
from starcal_uq.paper.field.result import NEITHER
from starcal_uq.presentation.tables import TextTable

if TYPE_CHECKING:
    from starcal_uq.paper.field.frames import FieldIdentification
    from starcal_uq.paper.field.result import FieldExperiment

CAMERA_NAMES = {
    UNCALIBRATED: "uncalibrated",
    "least_squares": "least squares",
    "samaan": "Samaan",
    "three_stage": "proposed",
    TRUE_CAMERA: "true camera",
}
_ANGLES = "arcsec, pitch / yaw / roll"


def table_3(found: FieldExperiment) -> TextTable:
    """Every printed number of Table 3 beside ours."""
    rows, marks = [], []
    for row in found.table_3().to_dict("records"):
        rate = row["quantity"] == RATE
        what = "identified [%]" if rate else f"{row['quantity'].removesuffix('_arcsec')} [arcsec]"
        ours = _ranged(row["ours"], row["low"], row["high"])
        after = _ranged(row["aligned"], row["aligned_low"], row["aligned_high"])
        rows.append((CAMERA_NAMES[row["method"]], what, row["printed"], ours, after, row["agrees"]))
        marks.append("" if row["agrees"] == NEITHER else "pass")
    return TextTable(
        ("Camera", "", "Printed", "Ours (95 % range)", "After alignment", "Agrees"),
        tuple(rows),
        f"Rates at a tolerance of {found.tolerance_px:g} px with Wilson intervals; errors "
        "against the true attitude, "
        "and about the mean of all frames, with the range of 95 % of repetitions with other noise.",
        "llrrrl",
        tuple(marks),
    )


def parts(found: FieldExperiment) -> TextTable:
    """What the errors consist of."""
    rows = []
    for name, one in found.errors.items():
        sizes = (one.rms, np.abs(one.common), one.rest, one.noise, one.aligned)
        rows.append((CAMERA_NAMES[name], *map(_triple, sizes)))
    return TextTable(
        ("Camera", "Total", "Common", "Rest", "Noise", "After alignment"),
        tuple(rows),
        f"Root mean squares over the identified frames ({_ANGLES}).",
    )


def sources(found: FieldExperiment) -> TextTable:
    """Each fault by itself."""
    rows = [
        (CAMERA_NAMES[camera], source, _triple(np.abs(group["common"])), _triple(group["rest"]))
        for (camera, source), group in found.sources().groupby(["camera", "source"], sort=False)
        if camera != TRUE_CAMERA
    ]
    return TextTable(
        ("Camera", "Wrong", "Common", "Rest"),
        tuple(rows),
        (
            f"One fault of each camera in an otherwise true one, without noise ({_ANGLES}); "
            "together "
            "they do less."
        ),
        "llrr",
    )


def rates(found: FieldExperiment) -> TextTable:
    """Identification against tolerance."""
    rows = []
    for camera in FIELD_CAMERAS:
        print_ = printed_field(camera, RATE).text if camera in FIELD_METHODS else ""
        cells = (_rate(found.sweep[camera, tolerance]) for tolerance in found.tolerances)
        rows.append((CAMERA_NAMES[camera], print_, *cells))
    return TextTable(
        ("Camera", "Printed", *(f"{tolerance:g} px" for tolerance in found.tolerances)),
        tuple(rows),
        (
            "Frames identified without a wrong star, in per cent, by what a star in the corner may "
            "be misplaced by."
        ),
    )


def data_sheets(found: FieldExperiment) -> TextTable:
    """Other data sheets of the uncalibrated camera."""
    rows = [
        (f"{focal:g}", _rate(result), "–" if errors is None else _triple(errors.aligned))
        for focal, (result, errors) in found.data_sheets.items()
    ]
    return TextTable(
        ("Focal length [mm]", "Identified [%]", "After alignment"),
        tuple(rows),
        f"The uncalibrated camera with other nominal focal lengths ({_ANGLES}).",
        "rrr",
    )


def cameras(found: FieldExperiment) -> TextTable:
    """The cameras with claimed standard deviations."""
    shown = {"x0": (1.0, 2), "y0": (1.0, 2), "f": (found.reading.truth.length_mm(1.0), 4)}
    shown |= {"k1": (1e9, 2), "k2": (1e16, 1)}
    rows = []
    for name, group in found.camera_table().groupby("camera", sort=False):
        cells = dict.fromkeys(shown, "–")
        for row in group.to_dict("records"):
            factor, decimals = shown[row["parameter"]]
            sigma = (
                f" ± {fixed(row['sigma'] * factor, decimals)}" if np.isfinite(row["sigma"]) else ""
            )
            cells[row["parameter"]] = fixed(row["value"] * factor, decimals) + sigma
        rows.append((CAMERA_NAMES[name], *cells.values()))
    offset = found.reading.offset_px
    return TextTable(
        ("Camera", "x₀ [px]", "y₀ [px]", "f [mm]", "k₁ [10⁻⁹ px⁻²]", "k₂ [10⁻¹⁶ px⁻⁴]"),
        tuple(rows),
        f"With claimed standard deviations; the paper counts pixels {offset} higher."
        if offset
        else "",
    )


def sensor(found: FieldExperiment) -> TextTable:
    """What is printed of the sensor, and what the reading makes of it."""
    return TextTable(
        ("Printed", "", "Kept", "How"),
        tuple(
            (name, text, "yes" if kept else "no", how)
            for name, text, kept, how in printed_sensor(found.reading)
        ),
        found.reading.words,
        "llll",
    )


def _rate(result: FieldIdentification) -> str:
    wrong = int(result.wrong.sum())
    return f"{100.0 * float(np.mean(result.correct)):.1f}" + (f" ({wrong} wrong)" if wrong else "")


def _arcsec(value: float) -> str:
    if not np.isfinite(value):
        return "–"
    if value < 5e-4:
        return "0.000"
    return fixed(value, 0) if value >= 100.0 else significant(value, 3)


def _triple(values: FloatArray | Iterable[float]) -> str:
    return " / ".join(_arcsec(float(value)) for value in values)


def _ranged(value: float, low: float, high: float) -> str:
    return f"{_arcsec(value)} ({_arcsec(low)} to {_arcsec(high)})" if np.isfinite(value) else "–"
