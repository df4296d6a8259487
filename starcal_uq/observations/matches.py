"""Matched stars as other solvers have them: FITS tables, astrometry.net's ``.corr``, matches of
tetra3 and tetra3rs.

Pixels are counted differently everywhere: ours have (0, 0) in the centre of the first pixel;
astrometry.net counts it (1, 1), as FITS does; tetra3 and cedar-solve have rows before columns, from
the corner of the image, so that it is (0.5, 0.5); tetra3rs counts from the middle of the image.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.attitude.rotations import ra_dec_deg, unit_vectors
from starcal_uq.attitude.wahba import quest
from starcal_uq.camera.projection import project, unproject
from starcal_uq.core.errors import ObservationError
from starcal_uq.core.extras import extra
from starcal_uq.core.files import as_plain, check_fits, check_size
from starcal_uq.core.types import AnyDict, AnyMapping, floats
from starcal_uq.observations.columns import COLUMNS

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera

# Centre of the first pixel in FITS, and from the corner of the image.
_FITS_PIXEL, _CORNER_PIXEL = 1.0, 0.5
_NAME, _META = "OBSERVATIONS", "SCMETA"
# Bytes in which the headers before a table end, and the card that ends each.
_HEADERS, _END = 100 * 2880, b"END".ljust(80)
_UNITS = {"pix": "pixel", "deg_C": ""}
# Ours to those of a .corr file, which has no column for the others.
_CORR = {"x_px": "field_x", "y_px": "field_y", "ra_deg": "index_ra", "dec_deg": "index_dec"}
_CORR_NAMES = (
    "field_x",
    "field_y",
    "field_ra",
    "field_dec",
    "index_x",
    "index_y",
    "index_ra",
    "index_dec",
    "index_id",
    "field_id",
    "match_weight",
)
_OTHERS = tuple(name for name in COLUMNS if name not in _CORR and name != "frame")


def fits_content(columns: AnyMapping, meta: AnyDict) -> bytes:
    """A FITS file with all columns, in a table named OBSERVATIONS."""
    units = {name: _UNITS.get(COLUMNS[name].unit, COLUMNS[name].unit) for name in columns}
    return _written({name: (values, units[name]) for name, values in columns.items()}, meta)


def corr_content(columns: AnyMapping, meta: AnyDict, camera: Camera | None) -> bytes:
    """One frame as astrometry.net writes its ``.corr`` files, pixels counted from (1, 1).

    ``field_ra``, ``field_dec`` and ``index_x``, ``index_y``, the star where the camera saw it and
    where it should have, follow from the frame's best attitude; without a camera they are NaN.
    ``index_id`` numbers the stars of this file.
    """
    n = len(columns["frame"])
    measured, sky = (
        np.column_stack([columns[name] for name in names])
        for names in (("x_px", "y_px"), ("ra_deg", "dec_deg"))
    )
    seen_deg, expected_px = (np.full((n, 2), np.nan) for _ in range(2))
    if camera is not None:
        b, r = unproject(camera, measured), unit_vectors(*sky.T)
        rotation = quest(b, r, np.array([0, n]), covariance=False).rotations[0]
        expected_px = project(camera, r @ rotation.T)
        seen_deg = np.column_stack(ra_dec_deg(b @ rotation))
    pairs = ((measured, "pixel"), (seen_deg, "deg"), (expected_px, "pixel"), (sky, "deg"))
    table: dict[str, tuple[Any, str]] = {}
    for values, unit in pairs:
        for column in (values + (_FITS_PIXEL if unit == "pixel" else 0.0)).T:
            table[_CORR_NAMES[len(table)]] = column, unit
    number = np.arange(n, dtype=np.int32)
    table |= {"index_id": (number, ""), "field_id": (number, ""), "match_weight": (np.ones(n), "")}
    table |= {name: (columns[name], "") for name in _OTHERS if name in columns}
    return _written(table, meta, FRAME=int(columns["frame"][0]) if n else 0)


def _written(columns: Mapping[str, tuple[Any, str]], meta: AnyDict, **cards: Any) -> bytes:
    with extra("images", "FITS tables"):
        from astropy.io import fits

    kinds = {"f": "D", "i": "J"}
    made = []
    for name, (values, unit) in columns.items():
        text = values.dtype.kind == "U"
        kind = f"{max(values.dtype.itemsize // 4, 1)}A" if text else kinds[values.dtype.kind]
        if values.dtype == np.int64:
            kind = "K"
        array = np.char.encode(values, "ascii", "replace") if text else values
        made.append(fits.Column(name, kind, unit=unit or None, array=array))
    table = fits.BinTableHDU.from_columns(made, name=_NAME)
    for key, value in cards.items():
        table.header[key] = value
    table.header["COMMENT"] = (
        "field_x, field_y, index_x, index_y: the first pixel's centre is (1, 1)"
        if cards
        else ("x_px, y_px: the first pixel's centre is (0, 0)")
    )
    table.header[_META] = json.dumps(meta, default=as_plain)
    stream = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(stream)
    return stream.getvalue()


def is_fits_table(path: Path) -> bool:
    """Whether a file is a FITS binary table without an image before it, be it compressed in a
    table.
    """
    try:
        with open(path, "rb") as file:
            head = file.read(_HEADERS)
    except OSError:
        return False
    cards = [head[place : place + 80] for place in range(0, len(head), 80)]
    if not head.startswith(b"SIMPLE") or _END not in cards or _value(cards, b"NAXIS") != b"0":
        return False
    # A file starts without data of its own, in blocks of 36 cards; the next header is that of the
    # table.
    second = cards[36 * (cards.index(_END) // 36 + 1) :]
    return (
        _value(second, b"XTENSION").strip(b"' ") == b"BINTABLE"
        and _value(second, b"ZIMAGE") != b"T"
    )


def _value(cards: Sequence[bytes], key: bytes) -> bytes:
    """What the first header among cards states, as it is written; empty where it does not."""
    for card in cards:
        if card == _END:
            break
        if card.startswith(key.ljust(8) + b"="):
            return card[9:].partition(b"/")[0].strip()
    return b""


def read_fits(path: Path, data: bytes) -> tuple[AnyDict, AnyDict, dict[str, str]]:
    """Columns under our names, metadata and units of a FITS table or ``.corr`` file; texts as
    lists, or else arrays.
    """
    with extra("images", "FITS tables"):
        from astropy.io import fits

    check_fits(data)
    with fits.open(io.BytesIO(data), memmap=False) as hdus:
        tables = [hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU)]
        if not tables:
            raise ObservationError(
                f"{path}: the file holds no table; give one of observations, or a .corr file."
            )
        header, rows = tables[0].header, tables[0].data
        check_size(int(header["NAXIS1"]) * int(header["NAXIS2"]), len(data))
        columns: AnyDict = {}
        units = {column.name.lower(): str(column.unit or "").strip() for column in rows.columns}
        for name in rows.names:
            values = np.asarray(rows[name])
            plain = values.dtype.newbyteorder("=")
            columns[name.lower()] = (
                values.astype(plain) if plain.kind in "fiub" else [str(v).strip() for v in values]
            )
        meta: Any = json.loads(header[_META]) if _META in header else {}
        frame = int(header.get("FRAME", 0))
    if not isinstance(meta, dict):
        raise ValueError("its metadata are no table")
    if "field_x" in columns:
        for own, other in _CORR.items():
            if other in columns:
                columns[own] = columns[other] - (_FITS_PIXEL if own in ("x_px", "y_px") else 0.0)
                units[own] = units[other]
        columns["frame"] = np.full(len(rows), frame, dtype=np.int64)
        columns = {name: values for name, values in columns.items() if name not in _CORR_NAMES}
    return columns, meta, units


def read_json(path: Path, data: bytes) -> tuple[AnyDict, AnyDict]:
    """Columns and metadata of matches of tetra3 or tetra3rs: a solution, a list of them, or a list
    named "frames".
    """
    document: Any = json.loads(data)
    if isinstance(document, dict) and "frames" in document:
        document = document["frames"]
    return matched_columns(document, None, where=str(path))


def matched_columns(
    solutions: Any,
    size_px: tuple[int, int] | None,
    times: Sequence[str] | None = None,
    where: str = "matches",
) -> tuple[AnyDict, AnyDict]:
    """Columns and metadata of solutions; see
    `starcal_uq.observations.table.Observations.from_matches`. `where` is what errors name.
    """
    given = [solutions] if isinstance(solutions, Mapping | tuple) else list(solutions)
    parts: list[AnyDict] = []
    unsolved = []
    for number, solution in enumerate(given):
        found = _matches(f"{where}: solution {number}", solution, size_px)
        if found is None:
            unsolved.append(number)
            continue
        time = solution.get("time_utc") if isinstance(solution, Mapping) else ""
        time = str((time if times is None else times[number]) or "")
        n = len(found["mag"])
        parts.append({"frame": np.full(n, number), **found, "time_utc": np.full(n, time)})
    if not any(len(part["frame"]) for part in parts):
        raise ObservationError(
            f"{where}: no solution has matched stars; give solutions that were found."
        )
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    if (columns["time_utc"] == "").any():
        del columns["time_utc"]
    return columns, {"source": "matches", "frames_without_matches": unsolved}


_HOW = {
    "tetra3": "call solve_from_centroids or solve_from_image with return_matches=True",
    "tetra3rs": "give centroids (x, y), matched_centroids (their places), matched_stars (ra, dec in "
    "degrees), "
    "image_width and image_height",
}


def _matches(where: str, solution: Any, size_px: tuple[int, int] | None) -> AnyDict | None:
    """Columns (n,) of a solution; None for a failed one."""
    if isinstance(solution, tuple):
        solution = _of_tetra3rs(*solution)
    if not solution:
        return None
    if not isinstance(solution, Mapping):
        raise ObservationError(f"{where} is no dict; {_HOW['tetra3']}.")
    by_place = "centroids" in solution
    how = _HOW["tetra3rs" if by_place else "tetra3"]
    if solution.get("RA", 0.0) is None:
        return None
    if missing := [
        key for key in ("matched_centroids", "matched_stars") if solution.get(key) is None
    ]:
        raise ObservationError(f"{where} has no {missing[0]}; {how}.")
    try:
        stars = np.array(
            [[*map(float, star), np.nan][:3] for star in solution["matched_stars"]]
        ).reshape(-1, 3)
        if by_place:
            size = size_px or (int(solution["image_width"]), int(solution["image_height"]))
            places = np.array(solution["matched_centroids"], dtype=np.int64)
            xy = floats(solution["centroids"])[places, :2] + 0.5 * np.array(size) - _CORNER_PIXEL
        else:
            rows_first = floats(solution["matched_centroids"]).reshape(-1, 2)
            xy = rows_first[:, ::-1] - _CORNER_PIXEL
    except (KeyError, TypeError, ValueError, IndexError) as error:
        what = (
            f"has no {error.args[0]}"
            if isinstance(error, KeyError)
            else "has matches of another form"
        )
        raise ObservationError(f"{where} {what}; {how}.") from None
    ids = solution.get("matched_catID", solution.get("matched_catalog_ids"))
    if len(xy) != len(stars) or (ids is not None and len(ids) != len(stars)):
        raise ObservationError(f"{where} pairs {len(xy)} centroids with {len(stars)} stars; {how}.")
    texts = [""] * len(xy) if ids is None else ids
    names = ["-".join(map(str, np.ravel(name).tolist())) for name in texts]
    values = zip(("x_px", "y_px", "ra_deg", "dec_deg", "mag"), (*xy.T, *stars.T), strict=True)
    return {**dict(values), "star_id": np.array(names, dtype=np.str_)}


def _of_tetra3rs(result: Any, centroids: Any, database: Any) -> AnyDict | None:
    """What a result of tetra3rs says, with its centroids, and the directions that its database
    knows.
    """
    if not result:
        return None
    stars = [database.get_star_by_id(int(number)) for number in result.matched_catalog_ids]
    camera = result.camera_model
    return {
        "centroids": centroids,
        "matched_centroids": result.matched_centroids,
        "matched_stars": [(star.ra_deg, star.dec_deg, star.magnitude) for star in stars],
        "matched_catalog_ids": result.matched_catalog_ids,
        "image_width": camera.image_width,
        "image_height": camera.image_height,
    }
