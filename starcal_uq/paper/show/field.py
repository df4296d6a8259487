"""The report on the field experiment as one HTML file, and the files beside it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.files import atomic_path, atomic_write_bytes, atomic_write_text, new_folder
from starcal_uq.core.formatting import fixed, join_words, percent, plural, significant
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.maths.intervals import wilson_interval
from starcal_uq.paper.field.identification import WRONG_PX
from starcal_uq.paper.field.published import (
    AXES,
    FIELD_CAMERAS,
    FIELD_METHODS,
    MORE_THAN_STARS,
    N_CHOSEN,
    N_TAKEN,
    NOMINAL_FOCAL_MM,
    RATE,
    REJECTED_READINGS,
    TRUE_CAMERA,
    UNCALIBRATED,
    printed_field,
)
from starcal_uq.paper.field.result import ALIGNED, AS_IT_STANDS, BOTH, NEITHER
from starcal_uq.paper.published import PROPOSED
from starcal_uq.presentation.html import embedded_image, template_environment

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.paper.field.result import FieldExperiment

_TEMPLATE = "field.html.j2"


def write_field(found: FieldExperiment) -> None:
    """Everything that is computed, the report last: it is there only if all else is."""
    figures = field_figures(found)
    tables = _tables(found)
    page = render_field(found, figures)
    new_folder(found.path)
    folder = new_folder(found.path / "figures")
    for name, png in figures.items():
        atomic_write_bytes(folder / f"{name}.png", png)
    for name, table in tables.items():
        with atomic_path(found.path / f"{name}.csv") as temporary:
            table.to_csv(temporary, index=False, lineterminator="\n")
    atomic_write_text(found.report, page)


def field_figures(found: FieldExperiment) -> dict[str, bytes]:
    """Every figure as PNG, by name."""
    from starcal_uq.presentation.figures.style import png_bytes

    return {"field_rates": png_bytes(found.plot_rates()), "field_errors": png_bytes(found.plot_errors())}


def render_field(found: FieldExperiment, figures: Mapping[str, bytes]) -> str:
    """The report; `figures` are PNG images by the names of `field_figures`."""
    return template_environment().get_template(_TEMPLATE).render(_context(found, figures)) + "\n"


def _context(found: FieldExperiment, figures: Mapping[str, bytes]) -> dict[str, Any]:
    return {
        "created": found.provenance["created_utc"],
        "version": found.provenance["versions"].get("starcal_uq") or "",
        "headline": headline(found),
        "findings": findings(found),
        "reading": found.reading,
        "rejected": REJECTED_READINGS,
        "assumptions": assumptions(found),
        "table_rows": table_rows(found),
        "part_rows": part_rows(found),
        "source_rows": source_rows(found),
        "rate_heads": [f"{tolerance:g}" for tolerance in found.tolerances],
        "rate_rows": rate_rows(found),
        "sheet_rows": sheet_rows(found),
        "camera_rows": camera_rows(found),
        "tolerance": f"{found.tolerance_px:g}",
        "provenance_rows": provenance_rows(found),
        "images": {name: embedded_image(png) for name, png in figures.items()},
    }


def _tables(found: FieldExperiment) -> dict[str, pd.DataFrame]:
    return {
        "table_3": found.table_3(),
        "rates": found.rates(),
        "parts": found.parts(),
        "sources": found.sources(),
        "data_sheets": found.other_data_sheets(),
        "cameras": found.camera_table(),
        "frames": found.frame_table(),
    }


CAMERA_NAMES = {
    UNCALIBRATED: "Uncalibrated",
    "least_squares": "Least squares",
    "samaan": "Samaan",
    PROPOSED: "Proposed",
    TRUE_CAMERA: "True camera (control)",
}


# Within a sentence.
_SHORT_NAMES = {
    UNCALIBRATED: "the uncalibrated sensor",
    "least_squares": "least squares",
    "samaan": "Samaan’s method",
    PROPOSED: "the proposed method",
}


# Differences with a p-value below this are more than chance.
MAX_P = 0.01


_AXIS_NAMES = ("pitch", "yaw", "roll")


_AGREES = {
    "yes": "yes",
    AS_IT_STANDS: "against the true attitude",
    ALIGNED: "after alignment",
    BOTH: "either way",
    NEITHER: "no",
}


def headline(found: FieldExperiment) -> str:
    """How many printed numbers come out, in one sentence."""
    table = found.table_3()
    rates = table["quantity"] == RATE
    agree = table["agrees"] != NEITHER
    return (
        f"Of the 16 numbers of Table 3, {int(agree.sum())} come out: {int((agree & rates).sum())} of the 4 rates at a "
        f"tolerance of {found.tolerance_px:g} px, and {int((agree & ~rates).sum())} of the 12 errors."
    )


def findings(found: FieldExperiment) -> list[str]:
    """What was found, a sentence or two each."""
    sentences = [_principal_point(found), _lucky(found), *_errors(found), _roll(found)]
    return [*sentences, _ordering(found), _printed_rates(), _control(found)]


def _principal_point(found: FieldExperiment) -> str:
    """Whether the printed errors can hold the common rotation."""
    listed, excluded = [], []
    for method in FIELD_METHODS:
        if method not in found.errors:
            continue
        across = float(np.hypot(*found.errors[method].common[:2]))
        printed = [printed_field(method, axis).value for axis in AXES[:2]]
        both = fixed(float(np.hypot(printed[0], printed[1])), 0)
        listed.append(f"{fixed(across, 0)}″ ({_SHORT_NAMES[method]}, printed {both}″)")
        low, _ = found.replicates.interval(method, "rms")
        if printed[0] < low[0] or printed[1] < low[1]:
            excluded.append(_SHORT_NAMES[method])
    text = f"A wrong principal point turns every attitude alike, by {join_words(listed)} in pitch and yaw together."
    if not excluded:
        return f"{text} The printed errors may contain it."
    return (
        f"{text} The printed errors of {join_words(excluded)} are too small to contain it: the reference attitudes "
        "must have been aligned with the same camera, which the text does not say."
    )


def _lucky(found: FieldExperiment) -> str:
    """How often the proposed method is as good as printed, common rotation included."""
    draws = found.replicates.draws.get(PROPOSED, {}).get("rms", np.empty((0, 3)))
    printed = np.array([printed_field(PROPOSED, axis).value for axis in AXES[:2]])
    hits = int(np.sum(np.all(draws[:, :2] <= printed, axis=1)))
    return (
        f"Against the true attitude the proposed method is in {hits if hits else 'none'} of "
        f"{plural(len(draws), 'repetition')} as good in pitch and yaw as printed, "
        f"{printed[0]:g}″ and {printed[1]:g}″: the principal point of one campaign is not known well enough."
    )


def _errors(found: FieldExperiment) -> list[str]:
    """Which printed errors come out, camera by camera."""
    table = found.table_3().set_index(["method", "quantity"])
    sentences = []
    for method in FIELD_METHODS:
        if method not in found.errors:
            sentences.append(f"{CAMERA_NAMES[method]}: no frame is identified, so that there are no errors.")
            continue
        parts = []
        for axis, name in zip(AXES, _AXIS_NAMES, strict=True):
            row = table.loc[(method, axis)]
            ratio = float(row["printed"]) / float(row["aligned"])
            how = _AGREES[str(row["agrees"])]
            verdict = f"comes out {how}" if row["agrees"] != NEITHER else f"is {significant(ratio)} times ours"
            parts.append(f"{name} {significant(float(row['aligned']), 3)}″, printed {row['printed']}″ {verdict}")
        sentences.append(f"{CAMERA_NAMES[method]}, after alignment: {'; '.join(parts)}.")
    return sentences


def _roll(found: FieldExperiment) -> str:
    """The ratio of roll to pitch, which noise alone decides for a good camera."""
    errors = found.errors.get(PROPOSED)
    if errors is None:
        return "The proposed method identified no frame."
    ours = float(errors.noise[2] / np.hypot(*errors.noise[:2]) * np.sqrt(2.0))
    pitch, yaw, roll = (printed_field(PROPOSED, axis).value for axis in AXES)
    theirs = roll / np.hypot(pitch, yaw) * np.sqrt(2.0)
    return (
        f"Centroid noise makes {significant(ours)} times as much roll as pitch or yaw in a field this narrow. The "
        f"paper prints {significant(theirs)} times for the proposed method, so that its pitch and yaw errors are "
        "mostly something else than noise of the stars."
    )


def _ordering(found: FieldExperiment) -> str:
    """At which tolerances the printed order of the rates appears."""
    strictly, weakly = [], []
    for tolerance in found.tolerances:
        counts = [int(found.sweep[method, tolerance].correct.sum()) for method in FIELD_METHODS]
        if all(a < b for a, b in pairwise(counts)):
            strictly.append(f"{tolerance:g}")
        if all(a <= b for a, b in pairwise(counts)) and counts[0] < counts[-1]:
            weakly.append(f"{tolerance:g}")
    text = "The identification rate is what the tolerance makes of it. The printed order, each camera better than the "
    if strictly:
        text += f"one before, appears at {join_words(strictly)} px."
    elif weakly:
        text += f"one before, appears at none; at {join_words(weakly)} px it appears with ties."
    else:
        text += "one before, appears at none of the tolerances."
    text += f" {_beyond_chance(found)}"
    return f"{text} {_same_rates(found)}"


def _same_rates(found: FieldExperiment) -> str:
    """At which tolerances the printed rates are within the intervals of ours."""
    hits: dict[str, list[float]] = {method: [] for method in FIELD_METHODS}
    for method in FIELD_METHODS:
        value = printed_field(method, RATE).value
        for tolerance in found.tolerances:
            result = found.sweep[method, tolerance]
            low, high = wilson_interval(int(result.correct.sum()), result.n_frames)
            if low <= value / 100.0 <= high:
                hits[method].append(tolerance)
    each = [
        f"that of {_SHORT_NAMES[method]} at {join_words([f'{tolerance:g}' for tolerance in some])} px"
        for method, some in hits.items()
        if some
    ]
    if not each:
        return "None of the printed rates comes out at any of them."
    words = f"Within the interval are, of the printed rates, {join_words(each)}"
    together = [f"{tolerance:g}" for tolerance in found.tolerances if all(tolerance in some for some in hits.values())]
    if together:
        return f"{words}: all four at {join_words(together)} px, found by trying {len(found.tolerances)} tolerances."
    return f"{words}: at no tolerance all four."


def _beyond_chance(found: FieldExperiment) -> str:
    """Which neighbours in the table differ by more than chance, at the main tolerance."""
    from scipy.stats import binomtest

    parts = []
    for worse, better in pairwise(FIELD_METHODS):
        a, b = found.identified(worse).correct, found.identified(better).correct
        # McNemar's exact test: the frames that one of the two identifies and the other does not.
        gained, lost = int(np.sum(b & ~a)), int(np.sum(a & ~b))
        p = float(binomtest(gained, gained + lost).pvalue) if gained + lost else 1.0
        if p < MAX_P:
            parts.append(f"{_SHORT_NAMES[worse]} and {_SHORT_NAMES[better]}")
    counts = [str(int(found.identified(method).correct.sum())) for method in FIELD_METHODS]
    n = found.identified(PROPOSED).n_frames
    numbers = f"At {found.tolerance_px:g} px the four cameras identify {join_words(counts)} of {n} frames"
    if not parts:
        return f"{numbers}; no neighbours in the table differ by more than chance."
    return f"{numbers}; of neighbours in the table, {join_words(parts)} differ by more than chance."


def _printed_rates() -> str:
    """What 200 frames can tell."""
    parts = []
    for method in FIELD_METHODS:
        value = printed_field(method, RATE)
        low, high = wilson_interval(round(value.value * N_CHOSEN / 100.0), N_CHOSEN)
        parts.append(f"{value.text} % ({100.0 * low:.1f} to {100.0 * high:.1f})")
    return (
        f"With {N_CHOSEN} frames the printed rates are {join_words(parts)}: those of the calibrated sensors cannot be "
        "told apart as they are printed."
    )


def _control(found: FieldExperiment) -> str:
    """The true camera has nothing but noise."""
    errors = found.errors[TRUE_CAMERA]
    camera = float(np.max(np.hypot(errors.common, errors.rest)))
    correct = found.identified(TRUE_CAMERA).correct
    roll = errors.total[:, 2] ** 2
    worst = percent(float(roll.max() / roll.sum()))
    return (
        f"Control: with the true camera {int(correct.sum())} of {len(correct)} frames are identified, noise makes "
        f"{_triple(errors.noise)}, and common rotation and rest are {'below 0.001″' if camera < 1e-3 else 'not zero'}. "
        f"One frame makes {worst} of the mean square in roll: the errors of so few frames are uncertain, as their "
        "ranges show."
    )


def _triple(values: FloatArray) -> str:
    """Pitch, yaw and roll in one piece."""
    return " / ".join(significant(float(value), 3) for value in values) + "″"


def assumptions(found: FieldExperiment) -> list[str]:
    """What the paper does not say, and what was assumed."""
    nominal = found.reading.nominal()
    return [
        f"Uncalibrated is a data sheet: {NOMINAL_FOCAL_MM:g} mm (whole millimetres), the principal point at "
        f"the centre, which is {np.hypot(*(nominal.theta - found.reading.truth.theta)[:2]):.0f} px off, no distortion. "
        "Other focal lengths are in a table of their own.",
        f"Sensitivity: {percent(found.frames.share)} of random attitudes gave a frame with more than {MORE_THAN_STARS} "
        f"stars; the paper chose {N_CHOSEN} of {N_TAKEN} frames. The sensor is otherwise the default one.",
        f"{found.campaign_words} Their noise is {significant(found.stars[TRUE_CAMERA].noise_scale, 3)} times what is "
        "stated. Neighbours that displace a star are left out.",
        "The sky is that of the embedded catalogue, seen from space: no air, no turntable.",
        f"Identification: every frame for itself, with tolerances that are the same for all cameras. A frame is "
        f"identified correctly if it has an attitude and no star lies more than {WRONG_PX:g} px from the centroid that "
        "was given its name.",
        "Attitudes: QUEST, stars weighted by their stated noise, in the frames that the same camera identified. Errors "
        "are root mean squares.",
    ]


def table_rows(found: FieldExperiment) -> list[AnyDict]:
    """Table 3: a row for each camera."""
    table = found.table_3().set_index(["method", "quantity"])
    rows = []
    for method in FIELD_METHODS:
        rate = table.loc[(method, RATE)]
        cells = []
        for axis in AXES:
            row = table.loc[(method, axis)]
            known = method in found.errors
            cells.append(
                {
                    "printed": row["printed"],
                    "total": _ranged(row["ours"], row["low"], row["high"]) if known else "–",
                    "aligned": _ranged(row["aligned"], row["aligned_low"], row["aligned_high"]) if known else "–",
                    "agrees": _AGREES[str(row["agrees"])],
                    "good": row["agrees"] != NEITHER,
                }
            )
        rows.append(
            {
                "name": CAMERA_NAMES[method],
                "printed_rate": rate["printed"],
                "rate": f"{rate['ours']:.1f} ({rate['low']:.1f} to {rate['high']:.1f})",
                "rate_good": rate["agrees"] != NEITHER,
                "cells": cells,
            }
        )
    return rows


def part_rows(found: FieldExperiment) -> list[AnyDict]:
    """What the errors consist of: a row for each camera and axis."""
    rows = []
    for record in found.parts().to_dict("records"):
        row = {"camera": CAMERA_NAMES[record["camera"]], "axis": record["axis"]}
        for part in ("rms", "common", "rest", "noise", "sum_of_squares", "aligned"):
            row[part] = _arcsec(abs(record[part]))
        rows.append(row)
    return rows


def source_rows(found: FieldExperiment) -> list[AnyDict]:
    """Each fault by itself: a row for each camera and source."""
    table = found.sources()
    rows = []
    for (camera, source), group in table.groupby(["camera", "source"], sort=False):
        if camera != TRUE_CAMERA:
            cells = [_arcsec(abs(value)) for value in [*group["common"], *group["rest"]]]
            rows.append({"camera": CAMERA_NAMES[camera], "source": source, "cells": cells})
    return rows


def rate_rows(found: FieldExperiment) -> list[AnyDict]:
    """Identification against tolerance: a row for each camera."""
    rows = []
    for camera in FIELD_CAMERAS:
        cells = []
        for tolerance in found.tolerances:
            result = found.sweep[camera, tolerance]
            cells.append(_rate(int(result.correct.sum()), int(result.wrong.sum()), result.n_frames))
        printed = printed_field(camera, RATE).text if camera in FIELD_METHODS else ""
        rows.append({"camera": CAMERA_NAMES[camera], "printed": printed, "cells": cells})
    return rows


def sheet_rows(found: FieldExperiment) -> list[AnyDict]:
    """Other data sheets, the main one first."""
    errors = found.errors.get(UNCALIBRATED)
    aligned = np.full(3, np.nan) if errors is None else errors.aligned
    result = found.identified(UNCALIBRATED)
    sheets = [(NOMINAL_FOCAL_MM, int(result.correct.sum()), int(result.wrong.sum()), result.n_frames, aligned)]
    for row in found.other_data_sheets().to_dict("records"):
        axes = np.array([row[axis] for axis in AXES])
        sheets.append((row["focal_mm"], row["correct"], row["wrong"], row["n_frames"], axes))
    return [
        {"focal": f"{focal:g}", "rate": _rate(correct, wrong, n), "cells": [_arcsec(value) for value in axes]}
        for focal, correct, wrong, n, axes in sheets
    ]


def camera_rows(found: FieldExperiment) -> list[AnyDict]:
    """The cameras: parameters with claimed standard deviations."""
    digits = {"x0": (1.0, 2), "y0": (1.0, 2), "f": (found.reading.truth.pixel_um / 1000.0, 4)}
    digits |= {"k1": (1e9, 2), "k2": (1e16, 1)}
    rows = []
    for name, group in found.camera_table().groupby("camera", sort=False):
        cells = dict.fromkeys(digits, "–")
        for record in group.to_dict("records"):
            factor, decimals = digits[record["parameter"]]
            text = fixed(record["value"] * factor, decimals)
            if np.isfinite(record["sigma"]):
                text += f" ± {fixed(record['sigma'] * factor, decimals)}"
            cells[record["parameter"]] = text
        rows.append({"camera": CAMERA_NAMES[name], "cells": list(cells.values())})
    return rows


def provenance_rows(found: FieldExperiment) -> list[tuple[str, str]]:
    """What is needed to repeat the experiment."""
    record = found.provenance
    settings = ", ".join(f"{k} = {v if isinstance(v, str) else json.dumps(v)}" for k, v in record["settings"].items())
    versions = ", ".join(f"{name} {version}" for name, version in record["versions"].items() if version)
    return [
        ("Stars of the calibration, SHA-256", str(record["data_sha256"])),
        ("Seed", str(record["seed"])),
        ("Settings", settings),
        ("Time", str(record["created_utc"])),
        ("Versions", versions),
    ]


def _rate(correct: int, wrong: int, n: int) -> str:
    text = f"{100.0 * correct / n:.1f}"
    return f"{text} ({wrong} wrong)" if wrong else text


def _arcsec(value: float) -> str:
    if not np.isfinite(value):
        return "–"
    if value < 5e-4:
        return "0.000"
    return fixed(value, 0) if value >= 100.0 else significant(value, 3)


def _ranged(value: float, low: float, high: float) -> str:
    return f"{_arcsec(value)} ({_arcsec(low)} to {_arcsec(high)})"
