"""The columns of an observations table: one list for the table, its files and its checks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Column:
    """One column of the table, as it is called in files, with its unit (or none) and content in
    words.

    `required` columns are in every table; with `gaps`, single values may be missing (NaN, or an
    empty text).
    """

    name: str
    kind: Literal["whole", "number", "text", "time"]
    unit: str
    required: bool
    gaps: bool
    description: str


COLUMNS: dict[str, Column] = {
    column.name: column
    for column in (
        Column("frame", "whole", "", True, False, "frame number"),
        Column(
            "x_px", "number", "pix", True, False, "centroid; 0 is the centre of the first pixel"
        ),
        Column("y_px", "number", "pix", True, False, "centroid, y downwards; 0 as for x_px"),
        Column("ra_deg", "number", "deg", True, False, "right ascension, ICRS axes"),
        Column("dec_deg", "number", "deg", True, False, "declination, ICRS axes"),
        Column("sigma_px", "number", "pix", False, False, "centroid noise per axis"),
        Column("star_id", "text", "", False, True, "name of the star in its catalogue"),
        Column("mag", "number", "mag", False, True, "magnitude"),
        Column(
            "direction_mas", "number", "mas", False, True, "stated error of the direction per axis"
        ),
        Column("time_utc", "time", "", False, False, "middle of the exposure, UTC, ISO 8601"),
        Column(
            "temperature_c", "number", "deg_C", False, True, "temperature of the optics, Celsius"
        ),
    )
}
