"""Tables of the field experiment."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

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
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.sentences import table

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


def table_3(found: FieldExperiment) -> TextTable:
    """Every printed number of Table 3 beside ours."""
    given = {"names": CAMERA_NAMES, "ranged": _ranged, "tolerance_px": found.tolerance_px}
    return table("field_3", given, it=found.table_3().to_dict("records"))


def parts(found: FieldExperiment) -> TextTable:
    """What the errors consist of."""
    given = {"names": CAMERA_NAMES, "triple": _triple}
    return table("field_parts", given, camera=found.errors, it=found.errors.values())


def sources(found: FieldExperiment) -> TextTable:
    """Each fault by itself."""
    groups = found.sources().groupby(["camera", "source"], sort=False)
    some = [(*name, group) for name, group in groups if name[0] != TRUE_CAMERA]
    cameras, faults, tables = zip(*some, strict=True)
    given = {"names": CAMERA_NAMES, "triple": _triple}
    return table("field_sources", given, camera=cameras, source=faults, it=tables)


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
    results, errors = zip(*found.data_sheets.values(), strict=True)
    given = {"rate": _rate, "triple": _triple}
    return table("field_sheets", given, focal_mm=found.data_sheets, found=results, errors=errors)


def cameras(found: FieldExperiment) -> TextTable:
    """The cameras with claimed standard deviations."""
    groups = found.camera_table().groupby("camera", sort=False)
    rows = [
        {row["parameter"]: (row["value"], row["sigma"]) for row in group.to_dict("records")}
        for _, group in groups
    ]
    reading = found.reading
    given = {"mm": reading.truth.length_mm(1.0), "offset": reading.offset_px, "shown": _shown}
    return table("field_cameras", given, name=[CAMERA_NAMES[name] for name, _ in groups], it=rows)


def _shown(pair: Any, factor: float, decimals: int) -> str:
    """A value with its sigma, if it has one; a dash for a parameter that a camera lacks."""
    if not pair:
        return "–"
    known = (number * factor for number in pair if np.isfinite(number))
    return " ± ".join(fixed(number, decimals) for number in known)


def sensor(found: FieldExperiment) -> TextTable:
    """What is printed of the sensor, and what the reading makes of it."""
    reading = found.reading
    return table("field_sensor", {"words": reading.words}, it=printed_sensor(reading))


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
