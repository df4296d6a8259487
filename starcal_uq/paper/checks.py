"""The paper against itself: what follows from its own printed numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.core.formatting import fixed, significant
from starcal_uq.core.types import FloatArray
from starcal_uq.paper.errors import ERROR_READINGS, error_size, point_errors
from starcal_uq.paper.published import (
    CLAIMED_RATIO,
    CLAIMED_Y0_ERROR_PX,
    LEAST_SQUARES,
    PAPER_METHODS,
    PROPOSED,
    SAMAAN,
    Printed,
    printed,
)

# Where the stars were is not printed; it moves a root mean square over the field by about one per
# cent.
_AGREES = 0.05
# Two runs differ by less than this many standard deviations of their difference.
_NOISE = 3.0
YES, WITHIN_NOISE, NO = "yes", "within noise", "no"


@dataclass(frozen=True)
class PaperCheck:
    """A printed statement, its place and text, what follows from the paper's other numbers, and
    whether it agrees.

    `agrees` is ``yes``, ``within noise`` or ``no``.
    """

    statement: str
    place: str
    text: str
    follows: str
    agrees: str


def printed_camera(truth: Camera, method: str, coefficients_from: str = "Table 2") -> Camera:
    """The camera that the paper prints for a method; `coefficients_from` is a place (Table 2 or
    section 3.3).
    """
    f, x0, y0 = (printed(method, name).value for name in ("f_mm", "x0_px", "y0_px"))
    changes: dict[str, object] = {"focal_mm": f, "x0_px": x0, "y0_px": y0}
    if method == LEAST_SQUARES:
        return truth.replace(**changes, distortion="none", coefficients=())
    k = tuple(printed(method, name, coefficients_from).value for name in ("k1", "k2"))
    return truth.replace(**changes, coefficients=k)


def paper_checks(
    truth: Camera, xy_px: FloatArray, sigmas: Mapping[str, Mapping[str, float]]
) -> tuple[PaperCheck, ...]:
    """Every printed error and claim against the paper's own numbers.

    `xy_px` (N, 2) is where stars are seen, for errors that are means over stars; `sigmas` are the
    standard deviations of one run, px units, by method and parameter: what two runs may differ by.
    """
    return (
        *(_reprojection(truth, xy_px, method) for method in PAPER_METHODS),
        *(_largest(truth, xy_px, method) for method in PAPER_METHODS),
        _y0_error(truth, sigmas),
        _others_y0(truth),
        *_ratios(),
        *_coefficients(sigmas),
    )


def _values(quantity: str, truth: Camera, camera: Camera, xy_px: FloatArray) -> dict[str, float]:
    """Each reading without noise, by its words; the main one first."""
    return {
        reading.words: error_size(quantity, reading, *point_errors(reading, truth, camera, xy_px))
        for reading in ERROR_READINGS[quantity]
        if not reading.noisy
    }


def _compare(number: Printed, statement: str, values: dict[str, float]) -> PaperCheck:
    distance = {words: abs(float(np.log(value / number.value))) for words, value in values.items()}
    main, best = next(iter(values)), min(distance, key=lambda words: distance[words])
    follows = f"{significant(values[main])} ({main})"
    if best != main:
        follows += f"; nearest reading {significant(values[best])} ({best})"
    return PaperCheck(
        statement, number.place, number.text, follows, YES if distance[best] <= _AGREES else NO
    )


def _reprojection(truth: Camera, xy_px: FloatArray, method: str) -> PaperCheck:
    number = printed(method, "reprojection_px")
    values = _values(number.quantity, truth, printed_camera(truth, method), xy_px)
    row = PAPER_METHODS.index(method) + 1
    return _compare(number, f"Reprojection error of row {row}, px", values)


def _largest(truth: Camera, xy_px: FloatArray, method: str) -> PaperCheck:
    number = printed(method, "max_residual_px")
    places = ("Table 2",) if method == LEAST_SQUARES else ("Table 2", "section 3.3")
    values: dict[str, float] = {}
    for place in places:
        camera = printed_camera(truth, method, place)
        some = _values(number.quantity, truth, camera, xy_px)
        values |= {
            words if len(places) == 1 else f"{words}, k of {place}": value
            for words, value in some.items()
        }
    figure = 4 + PAPER_METHODS.index(method)
    return _compare(number, f"Largest residual of Fig. {figure}, px", values)


def _twice(first: Printed, second: Printed, sigma: float) -> str:
    """Whether two prints of one quantity agree, or differ as two runs do."""
    apart = abs(first.value - second.value)
    if apart < max(first.unit_in_last_place, second.unit_in_last_place):
        return YES
    return WITHIN_NOISE if apart <= _NOISE * float(np.sqrt(2.0)) * sigma else NO


def _y0_error(truth: Camera, sigmas: Mapping[str, Mapping[str, float]]) -> PaperCheck:
    number = printed(PROPOSED, "y0_error_px")
    y0 = printed(PROPOSED, "y0_px")
    error = abs(y0.value - truth.y0_px)
    text = f"{fixed(error, 2)} ({y0.place}: {y0.text})"
    other = Printed(PROPOSED, "y0_error_px", fixed(error, 2), y0.place)
    agrees = _twice(number, other, sigmas[PROPOSED]["y0"])
    return PaperCheck(
        "Error of the proposed method in y₀, px", number.place, number.text, text, agrees
    )


def _others_y0(truth: Camera) -> PaperCheck:
    errors = [
        abs(printed(method, "y0_px").value - truth.y0_px) for method in (LEAST_SQUARES, SAMAAN)
    ]
    low, high = CLAIMED_Y0_ERROR_PX
    return PaperCheck(
        "Error of both other methods in y₀, px",
        "section 3.2",
        f"more than {low:g} to {high:g}",
        " and ".join(fixed(error, 2) for error in errors) + " (Table 2)",
        YES if min(errors) >= low else NO,
    )


def _ratios() -> tuple[PaperCheck, ...]:
    checks = []
    for quantity, what in (
        ("max_residual_px", "largest residuals"),
        ("reprojection_px", "reprojection errors"),
    ):
        best = printed(PROPOSED, quantity).value
        ratios = [printed(method, quantity).value / best for method in (LEAST_SQUARES, SAMAAN)]
        statement = f"“Two orders of magnitude” better than both other methods: ratio of the {what}"
        follows = " and ".join(fixed(ratio, 0) for ratio in ratios)
        agrees = YES if min(ratios) >= 0.5 * CLAIMED_RATIO else NO
        place = "abstract, section 3.3, conclusion"
        checks.append(PaperCheck(statement, place, f"{CLAIMED_RATIO:g}", follows, agrees))
    return tuple(checks)


def _coefficients(sigmas: Mapping[str, Mapping[str, float]]) -> tuple[PaperCheck, ...]:
    """One experiment, printed twice."""
    checks = []
    for method, name in ((SAMAAN, "Samaan’s"), (PROPOSED, "the proposed")):
        table, section = (
            [printed(method, k, place) for k in ("k1", "k2")]
            for place in ("Table 2", "section 3.3")
        )
        found = [
            _twice(a, b, sigmas[method][a.quantity]) for a, b in zip(table, section, strict=True)
        ]
        same = next(answer for answer in (NO, WITHIN_NOISE, YES) if answer in found)
        checks.append(
            PaperCheck(
                f"Coefficients k₁, k₂ of {name} method",
                "section 3.3",
                ", ".join(_power(number) for number in section),
                ", ".join(_power(number) for number in table) + " (Table 2)",
                same,
            )
        )
    return tuple(checks)


def _power(number: Printed) -> str:
    return significant(number.value, len(number.text.partition("e")[0].strip("-").replace(".", "")))
