"""The report on the reproduction as one HTML file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.camera.distortion import parameters
from starcal_uq.core.formatting import count, decimals_for, fixed, percent, pretty_unit, significant, with_sigma
from starcal_uq.paper.errors import MAXIMUM, REPROJECTION
from starcal_uq.paper.judgement import Judged, Outcome, trial
from starcal_uq.paper.published import N_STARS, PAPER_METHODS, Printed, printed
from starcal_uq.paper.readings import AS_PRINTED
from starcal_uq.paper.show import reproduction_words as words
from starcal_uq.paper.show.reproduction_words import METHOD_NAMES, minus, reading_text, signed
from starcal_uq.paper.table_2 import scaled_unit
from starcal_uq.presentation.html import embedded_image, template_environment
from starcal_uq.presentation.report.tables import symbol

if TYPE_CHECKING:
    from markupsafe import Markup

    from starcal_uq.paper.result import Reproduction

TEMPLATE = "reproduce.html.j2"


_MAP_DPI = 130


def draw_figures(found: Reproduction) -> dict[str, bytes]:
    """Every figure as PNG, by name."""
    from starcal_uq.presentation.figures.style import DPI, png_bytes

    # The maps are smooth: fewer pixels show as much of them.
    smooth = {"error_fields": _MAP_DPI}
    drawn = {
        "printed_numbers": found.plot_printed_numbers(),
        "trajectories": found.plot_trajectories(),
        "error_fields": found.plot_error_fields(),
        "replicates": found.replicates.plot(),
    }
    if found.study is not None:
        drawn["interaction"] = found.study.plot()
    return {name: png_bytes(figure, smooth.get(name, DPI)) for name, figure in drawn.items()}


def render(found: Reproduction, figures: Mapping[str, bytes]) -> str:
    """The report.

    Parameters
    ----------
    found
        What to report.
    figures
        PNG images by the names of `draw_figures`; a missing one is left out.
    """
    return template_environment().get_template(TEMPLATE).render(context(found, figures)) + "\n"


def context(found: Reproduction, figures: Mapping[str, bytes]) -> dict[str, Any]:
    """What the template shows."""
    versions = found.provenance["versions"]
    reprojection, maximum = (error_reading_rows(found, q) for q in ("reprojection_px", "max_residual_px"))
    return {
        "found": found,
        "created": found.provenance["created_utc"],
        "version": versions.get("starcal_uq") or "",
        "headline": words.headline(found),
        "method_verdicts": words.method_verdicts(found),
        "data_sentence": words.data_sentence(found),
        "frames_warning": words.frames_warning(found),
        "focal_sentence": words.focal_sentence(found),
        "ratio_sentence": words.ratio_sentence(found),
        "rows_sentence": words.rows_sentence(found),
        "checks_sentence": words.checks_sentence(found.checks),
        "method_sentences": words.method_sentences(found),
        "table_heads": table_heads(found),
        "table_rows": table_rows(found),
        "printed_rows": printed_rows(found.judged),
        "not_reproduced": printed_rows(found.outcome(Outcome.NOT_REPRODUCED)),
        "checks": found.checks,
        "reprojection_rows": reprojection,
        "reprojection_sentence": words.one_reading_sentence(reprojection),
        "maximum_rows": maximum,
        "maximum_sentence": words.one_reading_sentence(maximum),
        "printed_errors": words.printed_errors(),
        "error_rows": error_rows(found),
        "replicate_rows": replicate_rows(found),
        "replicate_sentences": words.replicate_sentences(found),
        "study_verdict": "" if found.study is None else found.study.verdict,
        "n_stars": count(N_STARS),
        "equation": words.EQUATIONS[found.run.convention],
        "provenance_rows": words.provenance_rows(found),
        "images": {name: embedded_image(png) for name, png in figures.items()},
    }


Row = dict[str, Any]


LEVELS = {
    Outcome.REPRODUCED: "pass",
    Outcome.WITHIN_NOISE: "pass",
    Outcome.AGAINST_TEXT: "warning",
    Outcome.BY_CHOICE: "warning",
    Outcome.NOT_REPRODUCED: "fail",
}


_COLUMNS = ("f_mm", "x0_px", "y0_px", "k1", "k2", "reprojection_px")


_PLAIN_NAMES = {
    "reprojection_px": "reprojection error",
    "max_residual_px": "largest residual",
    "y0_error_px": "error of y₀",
}


def quantity_symbol(quantity: str) -> Markup:
    """A quantity as a mathematical symbol, or in words."""
    from markupsafe import Markup

    if quantity in _PLAIN_NAMES:
        return Markup("{}").format(_PLAIN_NAMES[quantity])
    return symbol(quantity.partition("_")[0])


def unit_text(quantity: str) -> str:
    """The unit in which a quantity is shown."""
    return pretty_unit(scaled_unit(quantity)[1])


def printed_markup(number: Printed, noise_digits: int = 0) -> Markup:
    """A printed number in the unit shown, its last digits grey where they are noise."""
    from markupsafe import Markup

    text = minus(number.text.partition("e")[0])
    keep, left = len(text), noise_digits
    while left > 0 and keep > 0:
        keep -= 1
        left -= text[keep].isdigit()
    if keep == len(text):
        return Markup("{}").format(text)
    return Markup('{}<span class="noise">{}</span>').format(text[:keep], text[keep:])


def _number(value: float, spread: float, quantity: str) -> str:
    """Mean and spread in the unit shown."""
    scale = scaled_unit(quantity)[0]
    if not np.isfinite(spread) or spread <= 1e-9 * abs(value):
        return significant(value / scale, 3)
    return f"{with_sigma(value / scale, spread / scale)} ± {significant(spread / scale)}"


def table_rows(found: Reproduction) -> list[Row]:
    """Table 2: one row per method, one cell per quantity."""
    table = found.table_2()
    judged = {(j.printed.method, j.printed.quantity): j for j in reversed(found.judged)}
    rows = []
    for method in found.run.methods:
        mine = table[table["method"] == method.label].set_index("quantity")
        cells: list[Row] = []
        for quantity in _COLUMNS:
            if quantity not in mine.index:
                cells.append({})
                continue
            row = mine.loc[quantity]
            one = judged.get((method.method, quantity)) if row["printed"] else None
            scale = scaled_unit(quantity)[0]
            spread = float(row["spread"]) / scale
            decimals = decimals_for(spread) if np.isfinite(spread) else 0
            ours = float(row["ours"]) / scale
            cells.append(
                {
                    "ours": fixed(ours, decimals) if np.isfinite(spread) and spread > 0.0 else significant(ours),
                    "mean": fixed(float(row["mean"]) / scale, decimals) if row["n"] else "",
                    "spread": significant(spread) if np.isfinite(spread) else "",
                    "claimed": _optional(float(row["sigma_claimed"]) / scale),
                    "bound": _optional(float(row["sigma_crlb"]) / scale),
                    "printed": "" if one is None else printed_markup(one.printed, one.noise_digits),
                    "z": signed(float(row["z_printed"])),
                    "level": "" if one is None else LEVELS[one.outcome],
                }
            )
        rows.append({"label": method.label, "description": method.description, "cells": cells})
    return rows


def _optional(value: float) -> str:
    return significant(value) if np.isfinite(value) else ""


def table_heads(found: Reproduction) -> list[Row]:
    """Columns of Table 2: symbol, unit and truth."""
    truth = found.run.truth
    values = {"f_mm": truth.focal_mm, "x0_px": truth.x0_px, "y0_px": truth.y0_px}
    values |= {p.name: k / p.scale for p, k in zip(parameters(truth.distortion)[3:], truth.coefficients, strict=True)}
    return [
        {"symbol": quantity_symbol(q), "unit": unit_text(q), "truth": minus(f"{values[q]:g}") if q in values else "0"}
        for q in _COLUMNS
    ]


def printed_rows(judged: Sequence[Judged]) -> list[Row]:
    """Every printed number with its main and its best reading."""
    rows = []
    for one in judged:
        number, main, best = one.printed, one.main, one.best
        rows.append(
            {
                "method": METHOD_NAMES[number.method],
                "symbol": quantity_symbol(number.quantity),
                "unit": unit_text(number.quantity),
                "times": " ×" if number.quantity.startswith("k") else "",
                "place": number.place,
                "printed": printed_markup(number, one.noise_digits),
                "main": _number(main.mean, main.spread, number.quantity),
                "z": signed(main.z),
                "best": "" if best is main else reading_text(best),
                "best_value": "" if best is main else _number(best.mean, best.spread, number.quantity),
                "best_z": "" if best is main else signed(best.z),
                "chance": "" if np.isnan(one.by_chance) else percent(one.by_chance),
                "outcome": one.outcome.value,
                "level": LEVELS[one.outcome],
            }
        )
    return rows


def error_reading_rows(found: Reproduction, quantity: str) -> list[Row]:
    """The paper's three methods under every reading of one error size: is there one that fits all three?"""
    readings = REPROJECTION if quantity == "reprojection_px" else MAXIMUM
    rows = []
    for reading in readings:
        cells = []
        for method in PAPER_METHODS:
            draws = found.readings.of(AS_PRINTED, method, quantity, reading.key)
            if len(draws) < 2:
                cells.append({"value": "", "z": "", "accepted": False})
                continue
            one = trial(printed(method, quantity), reading.words, reading.faithful, draws)
            value = _number(one.mean, one.spread, quantity)
            cells.append({"value": value, "z": signed(one.z), "accepted": one.accepted})
        words = reading.words if reading.faithful else f"{reading.words} (against the text)"
        rows.append({"words": words, "cells": cells, "all": all(cell["accepted"] for cell in cells)})
    return rows


def error_rows(found: Reproduction) -> list[Row]:
    """Errors of the one run, in px and arcsec."""
    rows = []
    for row in found.errors().to_dict("records"):
        shown = {str(key): significant(float(value)) for key, value in row.items() if key != "method"}
        boresight = float(np.hypot(row["pitch_arcsec"], row["yaw_arcsec"]))
        rows.append({"method": row["method"], **shown, "boresight_arcsec": significant(boresight)})
    return rows


def replicate_rows(found: Reproduction) -> list[Row]:
    """Bias, spread and claims of every method and parameter."""
    rows = []
    by_name = {p.name: p for p in parameters(found.run.truth.distortion)}
    previous = ""
    for row in found.replicates.table().to_dict("records"):
        p = by_name[str(row["parameter"])]
        bias, bias_se = float(row["bias"]) / p.scale, float(row["bias_se"]) / p.scale
        classical = float(row["claimed_classical_over_spread"])
        rows.append(
            {
                "method": row["method"] if row["method"] != previous else "",
                "n": count(int(row["n"])),
                "symbol": symbol(p.name),
                "unit": pretty_unit(p.scaled_unit),
                "bias": f"{with_sigma(bias, bias_se)} ± {significant(bias_se)}",
                "spread": significant(float(row["spread"]) / p.scale),
                "bound": significant(float(row["crlb"]) / p.scale),
                "rmse": significant(float(row["rmse_over_crlb"])),
                "efficiency": "–" if row["biased"] else fixed(float(row["efficiency"]), 2),
                "ratio": fixed(float(row["claimed_over_spread"]), 2),
                "ratio_range": _range(row, "claimed_over_spread"),
                "classical": fixed(classical, 2) if np.isfinite(classical) else "",
                "coverage": percent(float(row["coverage95"]), 3),
                "wrong": bool(row["claim_wrong"]),
                "biased": bool(row["biased"]),
            }
        )
        previous = str(row["method"])
    return rows


def _range(row: dict[Any, Any], name: str) -> str:
    return f"{fixed(float(row[f'{name}_low']), 2)} to {fixed(float(row[f'{name}_high']), 2)}"


def axis_names(judged: Sequence[Judged]) -> list[str]:
    """Labels of the printed numbers for a figure."""
    latex = {p.name: p.latex for p in parameters("brown")}
    names = []
    for one in judged:
        quantity = one.printed.quantity
        text = _PLAIN_NAMES.get(quantity) or latex[quantity.partition("_")[0]]
        place = one.printed.place.partition(";")[0]
        method = METHOD_NAMES[one.printed.method]
        names.append(f"{place} ({method}): {text}")
    return names
