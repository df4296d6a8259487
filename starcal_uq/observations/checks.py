"""Checks of every row of an observations table, and the sentence that reports them.

All bad rows are found before any is reported: whoever repairs a file wants the whole list.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from starcal_uq.core.errors import ObservationError
from starcal_uq.core.texts import Texts
from starcal_uq.core.types import AnyMapping, BoolArray, FloatArray, IntArray
from starcal_uq.observations.columns import COLUMNS

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera

_MIN_STARS = 3
_REPAIR = "correct or remove the row"
# Stars that would not all be in one corner of the detector by chance.
_MANY = 10
_TIME = re.compile(r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d)(:\d\d(?:\.\d+)?)?(?:Z|[+-]00:?00)?")


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong in a row, from 0; `column` is None if the whole row is at fault.

    Reason and remedy are clauses for the message; `other` is a row that this one repeats.
    """

    row: int
    column: str | None
    reason: str
    remedy: str = _REPAIR
    other: int | None = None


def check_mapping(names: Iterable[str]) -> None:
    """Refuse a name of the package that is to be read from another column, and is no column of
    observations.
    """
    for name in names:
        if name not in COLUMNS:
            raise ObservationError(
                f"columns: {name!r} is no column of observations; use {', '.join(COLUMNS)}.",
                column=name,
            )


def _number(text: str) -> float:
    # Python reads 1_000 as a number; in a table the underscore is a slip.
    if "_" in text:
        raise ValueError(text)
    return float(text)


def _whole(text: str) -> int:
    try:
        if "_" in text:
            raise ValueError(text)
        value = int(text)
    except ValueError:
        number = _number(text)
        if not number.is_integer():
            raise
        value = int(number)
    if abs(value) >= 2**63:
        raise ValueError(text)
    return value


def _iso_utc(text: str) -> str:
    """`text` as YYYY-MM-DDTHH:MM:SS[.f], all its digits kept."""
    match = _TIME.fullmatch(text.strip())
    if match is None:
        raise ValueError(text)
    day, minute, second = match[1], match[2], match[3] or ":00"
    # datetime knows no leap second, UTC does.
    whole_second = second[:3].replace(":60", ":59") if minute == "23:59" else second[:3]
    datetime.fromisoformat(f"{day}T{minute}{whole_second}")
    return f"{day}T{minute}{second}"


def _parse(
    name: str,
    cells: Iterable[str],
    convert: Callable[[str], Any],
    empty: Any,
    reason: str,
    remedy: str,
) -> tuple[list[Any], list[Problem]]:
    """Convert cell by cell; a bad cell becomes `empty` and a problem."""
    values, problems = [], []
    for row, cell in enumerate(cells):
        value = empty
        if cell.strip():
            try:
                value = convert(cell)
            except ValueError:
                problems.append(Problem(row, name, f"{cell!r} {reason}", remedy))
        elif not COLUMNS[name].gaps:
            problems.append(
                Problem(row, name, "the value is missing", "fill it in or remove the row")
            )
        values.append(value)
    return values, problems


def parse_numbers(name: str, cells: Sequence[str]) -> tuple[FloatArray, list[Problem]]:
    """Numbers of a column of texts, shape (N,); NaN where a cell is bad."""
    try:
        # The common case, a clean column, at the speed of the interpreter's own loop.
        return np.array(list(map(_number, cells)), dtype=np.float64), []
    except ValueError:
        values, problems = _parse(name, cells, _number, np.nan, "is not a number", _REPAIR)
        return np.array(values, dtype=np.float64), problems


def parse_whole(name: str, cells: Sequence[str]) -> tuple[IntArray, list[Problem]]:
    """Whole numbers of a column of texts, shape (N,); 0 where a cell is bad."""
    values, problems = _parse(name, cells, _whole, 0, "is not a whole number", _REPAIR)
    return np.array(values, dtype=np.int64), problems


def parse_times(name: str, cells: Sequence[str]) -> tuple[Texts, list[Problem]]:
    """Times of a column of texts as YYYY-MM-DDTHH:MM:SS[.f], shape (N,); empty where a cell is
    bad.
    """
    texts = Texts.of(cells)
    remedy = "write UTC as in 2026-11-21T01:02:03.5"
    # All stars of a frame share their time.
    values, found = _parse(
        name, texts.names.tolist(), _iso_utc, "", "is not an ISO 8601 time in UTC", remedy
    )
    bad = {problem.row: problem for problem in found}
    rows = np.flatnonzero(np.isin(texts.codes, list(bad)))
    problems = [replace(bad[texts.codes[row]], row=int(row)) for row in rows]
    return Texts.placed(texts.codes, values), problems


def check_columns(
    columns: AnyMapping, camera: Camera | None = None, unknown_frame: BoolArray | None = None
) -> list[Problem]:
    """Everything that is wrong with the columns (N,) of a table, where a camera is given also for
    its detector.

    `unknown_frame` (N,) are rows whose frame number could not be read.
    """
    problems: list[Problem] = []
    for name, values in columns.items():
        if COLUMNS[name].kind == "number":
            wrong = np.isinf(values) if COLUMNS[name].gaps else ~np.isfinite(values)
            problems += _each(name, values, wrong, "is not a finite number")
    if "time_utc" in columns:
        problems += parse_times("time_utc", columns["time_utc"])[1]
    ra, dec = columns["ra_deg"], columns["dec_deg"]
    # 360 is let pass: rounding to a few decimals turns 359.99999999 into it.
    outside = (ra < 0.0) | (ra > 360.0)
    problems += _each("ra_deg", ra, outside, "is outside 0..360 deg", _unit_remedy(outside))
    swapped = bool(np.all(np.abs(ra) <= 90.0) and np.all((dec >= 0.0) & (dec <= 360.0)))
    remedy = (
        "exchange ra_deg and dec_deg, which look swapped"
        if swapped
        else _unit_remedy(np.abs(dec) > 90.0)
    )
    problems += _each("dec_deg", dec, np.abs(dec) > 90.0, "is outside -90..90 deg", remedy)
    for name, wrongly, reason in (
        ("sigma_px", np.less_equal, "is not above 0"),
        ("direction_mas", np.less, "is below 0"),
    ):
        if name in columns:
            problems += _each(name, columns[name], wrongly(columns[name], 0.0), reason)
    if camera is not None:
        problems += _in_millimetres(columns, camera)
        for name, size in (("x_px", camera.width_px), ("y_px", camera.height_px)):
            values = columns[name]
            outside = (values < -0.5) | (values > size - 0.5)
            reason = f"is outside the detector, -0.5..{size - 0.5} px"
            problems += _each(name, values, outside, reason, _pixel_remedy(columns, camera))
    rows = np.arange(len(ra))
    if unknown_frame is not None and unknown_frame.any():
        # Which frame has too few stars is not known while some rows belong to none.
        return problems + _check_repeats(columns, rows[~unknown_frame])
    return problems + _check_counts(columns["frame"]) + _check_repeats(columns, rows)


def _unit_remedy(outside: BoolArray) -> str:
    """Not single rows are to blame where most are outside."""
    most = 2 * np.count_nonzero(outside) > len(outside)
    return "check the unit of the whole column, or its factor" if most else _REPAIR


def _in_millimetres(columns: AnyMapping, camera: Camera) -> list[Problem]:
    """Many stars, all of them in the corner that a detector in millimetres would fill."""
    if camera.pixel_um is None or len(columns["x_px"]) < _MANY:
        return []
    pitch_mm = 1e-3 * camera.pixel_um
    xy = np.column_stack([columns["x_px"], columns["y_px"]])
    size_mm = pitch_mm * np.array([camera.width_px, camera.height_px])
    if np.any((xy < 0.0) | (xy > size_mm)):
        return []
    reason = "looks like millimetres, as all values of x_px and y_px do"
    remedy = f"divide both columns by the pixel pitch, {pitch_mm:g} mm"
    return [Problem(0, "x_px", f"{xy[0, 0].item()!r} {reason}", remedy)]


def _pixel_remedy(columns: AnyMapping, camera: Camera) -> str:
    x, y, width, height = columns["x_px"], columns["y_px"], camera.width_px, camera.height_px
    if np.all((y >= -0.5) & (y <= width - 0.5) & (x >= -0.5) & (x <= height - 0.5)):
        return "exchange x_px and y_px, which look swapped"
    return "check the camera file, or " + _REPAIR


def _each(
    name: str, values: Any, wrong: BoolArray, reason: str, remedy: str = _REPAIR
) -> list[Problem]:
    return [
        Problem(int(i), name, f"{values[i].item()!r} {reason}", remedy)
        for i in np.flatnonzero(wrong)
    ]


def _check_counts(frame: IntArray) -> list[Problem]:
    ids, first, counts = np.unique(frame, return_index=True, return_counts=True)
    return [
        Problem(
            int(first[i]),
            "frame",
            (
                f"frame {ids[i]} has {counts[i]} star{'s' if counts[i] > 1 else ''}, and "
                f"{_MIN_STARS} are needed"
            ),
            "add stars or remove the frame",
        )
        for i in np.flatnonzero(counts < _MIN_STARS)
    ]


def _check_repeats(columns: AnyMapping, rows: IntArray) -> list[Problem]:
    """Stars that a frame holds twice, by name, direction or place, among `rows`."""
    frame = columns["frame"]
    names = columns.get("star_id", Texts.unknown(len(frame)))
    # A star without a name repeats none.
    named = rows[names[rows] != ""]
    searches = (
        ("star_id", "the same star", named, [names.codes]),
        ("ra_deg", "the same direction", rows, [columns["ra_deg"], columns["dec_deg"]]),
        ("x_px", "the same pixel position", rows, [columns["x_px"], columns["y_px"]]),
    )
    repeats: dict[int, Problem] = {}
    for name, what, among, keys in searches:
        for late, early in repeated_rows(frame[among], *(key[among] for key in keys)):
            row, other = int(among[late]), int(among[early])
            # A row pasted twice agrees in everything; one reason is enough.
            reason = f"{what} occurs twice in frame {frame[row]}"
            repeats.setdefault(row, Problem(row, name, reason, "remove one of them", other))
    return list(repeats.values())


def repeated_rows(*keys: Any) -> list[tuple[int, int]]:
    """(row, earlier row) for each row that agrees with an earlier one in all keys."""
    hashed = np.sort(row_hashes(*keys))
    if not np.any(hashed[1:] == hashed[:-1]):
        # The common case, at a tenth of the price.
        return []
    order = np.lexsort(keys)
    same = np.all([key[order[1:]] == key[order[:-1]] for key in keys], axis=0)
    return sorted(zip(order[1:][same].tolist(), order[:-1][same].tolist(), strict=True))


def row_hashes(*keys: Any) -> NDArray[np.uint64]:
    """Numbers (N,) that are equal where all keys (N,) are, and hardly ever elsewhere.

    Bits go through the finaliser of SplitMix64 (Steele, Lea & Flood 2014). The hashes of pandas
    would load it with every table that is read.
    """
    mixed = np.zeros(len(keys[0]), dtype=np.uint64)
    with np.errstate(over="ignore"):
        for key in keys:
            # Adding zero makes -0.0 and 0.0, which compare equal, agree in their bits.
            wide = np.asarray(key, dtype=np.int64 if key.dtype.kind in "biu" else np.float64) + 0
            bits = np.ascontiguousarray(wide).view(np.uint64)
            mixed = (mixed + np.uint64(0x9E3779B97F4A7C15)) ^ bits
            mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            mixed ^= mixed >> np.uint64(31)
    return mixed


def raise_problems(source: str, word: str, numbers: IntArray, problems: Sequence[Problem]) -> None:
    """Report problems in a file, if there are any: the first bad row by its "line" or "row" number,
    and how many more.

    Of several for one cell the first is kept; one for a whole row replaces those of its cells.
    """
    whole_rows = {p.row for p in problems if p.column is None}
    kept: dict[tuple[int, str | None], Problem] = {}
    for p in problems:
        if p.column is None or p.row not in whole_rows:
            kept.setdefault((p.row, p.column), p)
    if not kept:
        return
    ordered = sorted(kept.values(), key=lambda p: p.row)
    sentences = []
    for p in ordered:
        place = f"{source}, {word} {numbers[p.row]}" + (f", column {p.column}" if p.column else "")
        also = f" (also in {word} {numbers[p.other]})" if p.other is not None else ""
        sentences.append(f"{place}: {p.reason}{also}; {p.remedy}")
    others = len({p.row for p in ordered}) - 1
    more = f" ({others} more bad row{'s' if others > 1 else ''})" if others else ""
    raise ObservationError(
        f"{sentences[0]}{more}.",
        row=int(numbers[ordered[0].row]),
        column=ordered[0].column,
        problems=[f"{sentence}." for sentence in sentences],
    )
