"""The observations table: measured star positions with the directions they belong to, frame by
frame.

It is the only thing that passes from images, or a simulation, to the estimators.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from starcal_uq.attitude.rotations import unit_vectors
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import ObservationError
from starcal_uq.core.settings import Directions
from starcal_uq.core.texts import Texts
from starcal_uq.core.times import utc_text
from starcal_uq.core.types import AnyDict, FloatArray, IntArray, PathLike, StrArray
from starcal_uq.core.units import plain
from starcal_uq.observations.checks import check_columns, raise_problems
from starcal_uq.observations.columns import COLUMNS
from starcal_uq.observations.files import checked_table, read_table
from starcal_uq.observations.origin import Sourced
from starcal_uq.observations.rows import FrameRows, check_lengths, locked, typed
from starcal_uq.observations.written import astropy_table, write_table

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera

_DTYPES: dict[str, type] = {
    "whole": np.int64,
    "number": np.float64,
    "text": np.str_,
    "time": np.str_,
}


@dataclass(frozen=True, eq=False)
class Observations(FrameRows, Sourced, Shown):
    """Stars measured in pixels, with their directions; one row per star and frame, sorted by frame.

    Rows given in another order are sorted by frame; within a frame they keep their order. The
    arrays are copies and cannot be written to. Columns of texts are views that NumPy takes as
    arrays of str: ``codes`` (N,), places in the few different ``names`` (see
    `starcal_uq.core.texts.Texts`).

    Attributes
    ----------
    frame : array of int64, shape (N,)
        Frame number.
    x_px, y_px : array, shape (N,)
        Centroid, pixels; (0, 0) is the centre of the first pixel, y grows downwards.
    ra_deg, dec_deg : array, shape (N,)
        Direction in ICRS axes, degrees; `origin` says whether aberration is in it.
    sigma_px : array, shape (N,), or None
        Centroid noise per axis, pixels.
    star_id : array of str, shape (N,), or None
        Name in a catalogue; empty where unknown.
    mag : array, shape (N,), or None
        Magnitude; NaN where unknown.
    direction_mas : array, shape (N,), or None
        Error of the direction per axis that its catalogue states, milliarcseconds; NaN where
        unknown. Used where star errors are asked for.
    time_utc : array of str, shape (N,), or None
        Middle of the exposure, UTC, such as ``2026-11-21T01:02:03.5``.
    temperature_c : array, shape (N,), or None
        Temperature of the optics, Celsius; NaN where unknown.
    meta : dict
        Plain values about the table, as they stand in files: your own, and the facts of `origin`,
        such as ``directions`` ("apparent", "catalogue" or "undeclared") and ``source``.
    stated_px : array, shape (N,), or None
        Noise that the stars state, px, NaN where they state none, of a table whose `sigma_px` comes
        from a fitted noise model (see `weighted`); None for all other tables.
    noise_axes : array, shape (2, 2), or None
        Covariance of the noise of x and y in units of `sigma_px` squared, of determinant one, of a
        fitted noise model whose axes differ; None where they are alike.

    Raises
    ------
    ObservationError
        If the columns differ in length or cannot be converted to their types.
    """

    frame: IntArray
    x_px: FloatArray
    y_px: FloatArray
    ra_deg: FloatArray
    dec_deg: FloatArray
    sigma_px: FloatArray | None = None
    star_id: StrArray | None = None
    mag: FloatArray | None = None
    direction_mas: FloatArray | None = None
    time_utc: StrArray | None = None
    temperature_c: FloatArray | None = None
    meta: AnyDict = field(default_factory=dict)
    stated_px: FloatArray | None = None
    noise_axes: FloatArray | None = None

    def __post_init__(self) -> None:
        columns = {name: _array(name, plain(name, values)) for name, values in self.columns.items()}
        n = len(columns["frame"])
        check_lengths("observations", columns, "frame")
        frame = columns["frame"]
        if np.any(frame[1:] < frame[:-1]):
            order = np.argsort(frame, kind="stable")
            columns = {name: values[order] for name, values in columns.items()}
            if self.stated_px is not None:
                object.__setattr__(self, "stated_px", locked(self.stated_px[order]))
        for name, values in columns.items():
            # A column without a single value is as good as absent, and files do not tell the two
            # apart.
            gap = values == "" if isinstance(values, Texts) else np.isnan(values)
            absent = COLUMNS[name].gaps and n > 0 and bool(np.all(gap))
            object.__setattr__(self, name, None if absent else locked(values))
        object.__setattr__(self, "meta", {**self.meta, "directions": self.origin.directions})

    @property
    def columns(self) -> AnyDict:
        """The columns that are present, in their fixed order: name to array of shape (N,)."""
        return {name: getattr(self, name) for name in COLUMNS if getattr(self, name) is not None}

    @property
    def n_frames(self) -> int:
        """Number of frames K."""
        return len(self.frame_ids)

    @cached_property
    def frame_ids(self) -> IntArray:
        """Frame numbers that occur, ascending, shape (K,)."""
        later = self.frame[1:]
        return locked(np.concatenate([self.frame[:1], later[later != self.frame[:-1]]]))

    @cached_property
    def directions_icrs(self) -> FloatArray:
        """Unit vectors of the directions, shape (N, 3), ICRS axes."""
        return locked(np.ascontiguousarray(self.direction_rows.T))

    @cached_property
    def direction_rows(self) -> FloatArray:
        """Unit vectors of the directions with the star axis last, shape (3, N), ICRS axes."""
        return locked(np.ascontiguousarray(unit_vectors(self.ra_deg, self.dec_deg).T))

    @property
    def sigma_or_one(self) -> FloatArray:
        """Noise that the stars state, shape (N,), px per axis; one where they state none."""
        return np.ones(self.n_stars) if self.sigma_px is None else self.sigma_px

    @property
    def named(self) -> Texts:
        """Names of the stars, shape (N,), by their codes; empty where unknown."""
        return Texts.unknown(len(self)) if self.star_id is None else Texts.of(self.star_id)

    @cached_property
    def timed(self) -> bool:
        """Whether every row has a time."""
        return self.time_utc is not None and bool((self.time_utc != "").all())

    @cached_property
    def data_hash(self) -> str:
        """SHA-256 (hex) of the columns that are present; the same for the same table from any file
        format.

        A noise model changes nothing in it: the data are what was measured and stated.
        """
        digest = hashlib.sha256()
        for name, values in self.unweighted.columns.items():
            digest.update(f"{name}:{len(values)};".encode())
            if isinstance(values, Texts):
                # The length before each text: without it ("ab", "c") and ("a", "bc") would agree.
                pieces = [f"{len(text)}:{text}".encode() for text in values.names.tolist()]
                digest.update(b"".join(np.array(pieces, dtype=object)[values.codes]))
            else:
                # Adding zero makes -0.0 and 0.0, which compare equal, agree in their bytes.
                values = values + values.dtype.type(0)
                digest.update(values.astype(values.dtype.newbyteorder("<"), copy=False))
        return digest.hexdigest()

    def select(self, mask: ArrayLike) -> Observations:
        """The rows where `mask` (bool, shape (N,)) is true."""
        chosen = self._mask(mask, "observations")
        columns = {name: values[chosen] for name, values in self.columns.items()}
        return replace(
            self, **columns, stated_px=None if self.stated_px is None else self.stated_px[chosen]
        )

    def weighted(self, sigma_px: FloatArray, noise_axes: FloatArray | None = None) -> Observations:
        """The same data with another noise, (N,) px, in `sigma_px`, and its axes: those of a fitted
        noise model.
        """
        stated = self.unweighted.sigma_px
        kept = np.full(len(self), np.nan) if stated is None else stated
        return replace(
            self, sigma_px=sigma_px, stated_px=locked(np.array(kept)), noise_axes=noise_axes
        )

    @property
    def unweighted(self) -> Observations:
        """The table as it was stated, without the noise of a fitted model."""
        if self.stated_px is None:
            return self
        stated = None if np.isnan(self.stated_px).all() else self.stated_px
        return replace(self, sigma_px=stated, stated_px=None, noise_axes=None)

    def select_frames(self, ids: ArrayLike) -> Observations:
        """The rows of the frames with these numbers.

        Raises
        ------
        ObservationError
            If a frame does not occur in the table.
        """
        wanted = self._frame_numbers(ids, "observations")
        return self.select(np.isin(self.frame, wanted))

    def in_ranges(self, ranges: Sequence[tuple[int, int]]) -> Observations:
        """The rows of the frames with numbers in these ranges, from first to last.

        Raises
        ------
        ObservationError
            If a range holds no frame of the table.
        """
        frame = self.frame
        chosen = np.zeros(len(self), dtype=np.bool_)
        for first, last in ranges:
            inside = (frame >= first) & (frame <= last)
            if not inside.any():
                asked = str(first) if first == last else f"{first}-{last}"
                raise ObservationError(
                    f"there is no frame {asked}: the table has {frame[0]} to {frame[-1]}."
                )
            chosen |= inside
        return self.select(chosen)

    def with_meta(self, **entries: Any) -> Observations:
        """The same table with entries of `meta` added or changed, such as
        ``directions="apparent"``.
        """
        return replace(self, meta={**self.meta, **entries})

    def check(self, camera: Camera | None = None) -> None:
        """Apply the checks of `load_observations` to a table made in memory.

        Raises
        ------
        ObservationError
            If a row is bad; rows are numbered from 1 in the order of this table.
        """
        rows = np.arange(1, len(self) + 1)
        raise_problems("observations", "row", rows, check_columns(self.columns, camera))

    def to_dataframe(self) -> Any:
        """The columns as a pandas DataFrame; `meta` is in its ``attrs``."""
        import pandas as pd

        frame = pd.DataFrame({name: values.copy() for name, values in self.columns.items()})
        frame.attrs.update(self.meta)
        return frame

    def to_table(self) -> Any:
        """The columns as an astropy Table with units and descriptions; `meta` is in its
        ``meta``.
        """
        return astropy_table(self.columns, self.meta)

    def head(self, n: int = 5) -> Any:
        """The first `n` rows as a pandas DataFrame."""
        return self.select(np.arange(len(self)) < n).to_dataframe()

    def save(self, path: PathLike, force: bool = False, camera: Camera | None = None) -> None:
        """Write the table without loss of digits; the ending decides what as.

        ECSV, Parquet and FITS (``.ecsv``, ``.parquet``, ``.fits``) carry `meta`; CSV is plain, so
        that every spreadsheet opens it, and loses `meta`. A ``.corr`` file is astrometry.net's,
        with its pixels counted from (1, 1): one for each frame, named after it (``night_3.corr``)
        where there are several.

        Parameters
        ----------
        path
            The file.
        force
            Whether a file may be replaced.
        camera
            For ``.corr``: says where each star was expected, ``index_x``, and which direction was
            seen, ``field_ra``.

        Raises
        ------
        ObservationError
            If the ending is unknown.
        RunFolderError
            If the file exists and `force` is false, or cannot be written.
        """
        write_table(self.columns, self.meta, path, force, camera)

    @classmethod
    def from_matches(
        cls, solutions: Any, *, camera: Camera | None = None, times: Sequence[str] | None = None
    ) -> Observations:
        """Matches that tetra3, cedar-solve or tetra3rs found, one solution for each frame.

        Parameters
        ----------
        solutions
            A solution or a list of them, in which those that failed keep their frame number and
            have no rows. Of tetra3 and cedar-solve, what ``solve_from_centroids(...,
            return_matches=True)`` returned (rows before columns, from the corner of the image); of
            tetra3rs a tuple (result, centroids, database).
        camera
            The size of its detector says where the middle of the image is, from which tetra3rs
            counts; by default what the result says.
        times
            Middle of the exposure of each frame, UTC.

        Raises
        ------
        ObservationError
            If a solution was found and has no matches, or they are of another form.
        """
        from starcal_uq.observations.matches import matched_columns

        size = None if camera is None else (camera.width_px, camera.height_px)
        columns, meta = matched_columns(solutions, size, times)
        obs = cls(**columns, meta=meta)
        obs.check(camera)
        return obs

    @classmethod
    def from_table(
        cls,
        table: Any,
        *,
        camera: Camera | None = None,
        columns: Mapping[str, str] | None = None,
        directions: Directions | None = None,
        time: Any = None,
    ) -> Observations:
        """A table in memory, checked as one in a file is; also called `from_dataframe`.

        Parameters
        ----------
        table
            A DataFrame of pandas, polars or another library with Arrow's interface, a Table or
            QTable of astropy, or a Dataset of xarray. Units that it states are converted, and a
            column of astropy times is read as UTC.
        camera, columns
            As for `load_observations`.
        directions : {"undeclared", "catalogue", "apparent"}, optional
            What the directions are; by default what the table's metadata say.
        time : str, datetime or astropy Time, optional
            Middle of the exposure of the rows without a time, UTC.

        Raises
        ------
        ObservationError
            If a column is missing or a row is bad; rows are numbered from 1.
        """
        from starcal_uq.observations.memory import raw_table

        read = partial(raw_table, table)
        values, meta = checked_table(Path("table"), read, camera, columns or {})
        obs = cls(**values, meta=meta)
        if directions is not None:
            obs = obs.with_origin(directions=directions)
        return obs if time is None else obs.with_time(time)

    from_dataframe = from_table

    def with_time(self, time: Any) -> Observations:
        """The same table with a time (UTC; text, datetime or astropy Time) for rows without one."""
        text = utc_text(time)
        there = Texts.unknown(len(self)) if self.time_utc is None else Texts.of(self.time_utc)
        return replace(self, time_utc=there.map(lambda stated: stated or text))

    def __repr__(self) -> str:
        return (
            f"Observations({self.n_stars} stars, {self.n_frames} frames; {', '.join(self.columns)})"
        )


def load_observations(
    path: PathLike | Sequence[PathLike],
    camera: Camera | None = None,
    columns: Mapping[str, str] | None = None,
) -> Observations:
    """Read and check a table of observations.

    It is one that `Observations.save` wrote (``.csv``, ``.ecsv``, ``.parquet``, ``.fits``), a
    ``.corr`` file of astrometry.net, or matches of tetra3 or tetra3rs as JSON (see
    `Observations.from_matches`). ``index_id`` and ``match_weight`` of astrometry.net are not used:
    the first counts stars within one of its indexes and names none.

    Parameters
    ----------
    path
        The file, or several, whose frames are then numbered one after the other. In CSV and ECSV,
        lines that start with ``#`` are comments.
    camera
        If given, every centroid must lie on its detector.
    columns
        Names in the file of columns that are called otherwise, such as ``{"ra_deg":
        "ra_apparent_deg"}``. Columns that are not needed are ignored and listed in
        ``origin.ignored_columns``.

    Raises
    ------
    ObservationError
        If the file cannot be read or a row is bad; the message names the first bad row and counts
        the others, and ``problems`` of the error lists them all.
    """
    if isinstance(path, str | os.PathLike):
        values, meta = read_table(path, camera, columns or {})
        return Observations(**values, meta=meta)
    tables = [load_observations(one, camera, columns) for one in path]
    if not tables:
        raise ObservationError("observations: there is no file; give at least one.")
    joined = joined_columns(tables)
    for name in joined.keys() - set.intersection(*(set(table.columns) for table in tables)):
        del joined[name]
    starts = np.cumsum([0, *(table.n_frames for table in tables)])
    joined["frame"] = np.concatenate(
        [np.searchsorted(t.frame_ids, t.frame) + n for t, n in zip(tables, starts, strict=False)]
    )
    kinds = {table.origin.directions for table in tables}
    meta = {**tables[0].meta, "source": [str(one) for one in path]}
    meta["directions"] = kinds.pop() if len(kinds) == 1 else "undeclared"
    return Observations(**joined, meta=meta)


def _array(name: str, values: Any) -> Any:
    """A one-dimensional copy of `values` in the type of column `name`."""
    kind = COLUMNS[name].kind
    if kind in ("text", "time") and np.ndim(values) == 1:
        return Texts.of(values)
    array = np.asarray(values)
    if (
        kind == "whole"
        and array.dtype.kind == "f"
        and not all(v.is_integer() for v in array.tolist())
    ):
        raise ObservationError(
            f"observations: {name} holds fractions; give whole numbers.", column=name
        )
    return typed("observations", name, array, _DTYPES[kind])


def joined_columns(tables: Sequence[Observations], **instead: Sequence[FloatArray]) -> AnyDict:
    """All rows of several tables; a column that only some have is filled, or left out where it may
    have no gaps.
    """
    columns: AnyDict = {}
    for name, column in COLUMNS.items():
        values: Sequence[Any] = instead.get(name) or [getattr(table, name) for table in tables]
        missing = [value is None for value in values]
        if all(missing) or (any(missing) and not column.gaps):
            continue
        gaps: Any = Texts.unknown if column.kind == "text" else partial(np.full, fill_value=np.nan)
        parts = [
            gaps(len(table)) if v is None else v for table, v in zip(tables, values, strict=True)
        ]
        columns[name] = (Texts.joined if isinstance(parts[0], Texts) else np.concatenate)(parts)
    return columns
