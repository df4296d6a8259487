"""The centroids table: star positions measured in images, frame by frame, before any star has a
name.

It is what passes from the images to the identification.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from starcal_uq.core.display import Shown
from starcal_uq.core.errors import ObservationError
from starcal_uq.core.extras import extra
from starcal_uq.core.files import (
    as_plain,
    atomic_path,
    ensure_new,
    read_bytes,
    reading,
    table_ending,
)
from starcal_uq.core.remedy import Remedy
from starcal_uq.core.tables import WHAT, read_cells, write_parquet
from starcal_uq.core.types import (
    AnyDict,
    BoolArray,
    FloatArray,
    IntArray,
    PathLike,
    StrArray,
)
from starcal_uq.observations.origin import CentroidsOrigin
from starcal_uq.observations.rows import FrameRows, check_lengths, locked, typed

if TYPE_CHECKING:
    from collections.abc import Iterable

# Name -> (type, description), of one row per star and of one entry per frame.
COLUMNS: dict[str, tuple[type, str]] = {
    "frame": (np.int64, "frame number"),
    "x_px": (np.float64, "centroid; 0 is the centre of the first pixel"),
    "y_px": (np.float64, "centroid, y downwards; 0 as for x_px"),
    "var_x_px2": (np.float64, "variance of x_px"),
    "var_y_px2": (np.float64, "variance of y_px"),
    "cov_xy_px2": (np.float64, "covariance of x_px and y_px"),
    "flux": (np.float64, "electrons, or counts where the gain is unknown"),
    "snr": (np.float64, "flux over its standard deviation"),
    "peak": (np.float64, "highest pixel, counts with background"),
    "saturated": (np.bool_, "a pixel of its core is saturated"),
    "blended": (np.bool_, "another star is near"),
    "edge": (np.bool_, "the image ends within its light"),
}
FRAME_COLUMNS: dict[str, tuple[type, str]] = {
    "frame_ids": (np.int64, "frame number"),
    "image": (np.str_, "name of the image"),
    "time_utc": (np.str_, "middle of the exposure, UTC; empty where unknown"),
    "background": (np.float64, "median background, counts"),
    "noise": (np.float64, "noise of the background per pixel, counts"),
    "psf_sigma_px": (np.float64, "width of the star images"),
    "problem": (np.str_, "why the frame was left out; empty where it was used"),
}


@dataclass(frozen=True, eq=False)
class Centroids(FrameRows, Shown):
    """Star positions with their covariances; one row per star and frame, sorted by frame.

    Rows given in another order are sorted by frame; within a frame they keep their order, which
    `extract_centroids` makes brightest first. The arrays are copies and cannot be written to.

    Attributes
    ----------
    frame : array of int64, shape (N,)
        Frame number.
    x_px, y_px : array, shape (N,)
        Centroid, pixels; (0, 0) is the centre of the first pixel, y grows downwards.
    var_x_px2, var_y_px2, cov_xy_px2 : array, shape (N,)
        Covariance of the centroid, square pixels.
    flux : array, shape (N,)
        Electrons if the gain is known, else counts (``meta["flux_unit"]``).
    snr : array, shape (N,)
        Flux over its standard deviation.
    peak : array, shape (N,)
        Highest pixel of the star, counts, background included.
    saturated, blended, edge : array of bool, shape (N,)
        A pixel of its core is saturated; another star is near; the image ends within its light.
    frame_ids : array of int64, shape (K,)
        Frame numbers, ascending; a frame without stars keeps its place.
    image, time_utc : array of str, shape (K,)
        Name of the image; middle of the exposure, UTC, empty where unknown.
    background, noise : array, shape (K,)
        Median background and noise per pixel, counts; NaN for a frame that was left out.
    psf_sigma_px : array, shape (K,)
        Width of the star images before integration over pixels; NaN for a frame that was left out.
    problem : array of str, shape (K,)
        Why the frame was left out; empty where it was used.
    messages : tuple of str
        Notes for the user, one sentence each.
    meta : dict
        Settings, gain, hash of the images.

    Raises
    ------
    ObservationError
        If columns differ in length, cannot be converted, or a row belongs to no frame.
    """

    frame: IntArray
    x_px: FloatArray
    y_px: FloatArray
    var_x_px2: FloatArray
    var_y_px2: FloatArray
    cov_xy_px2: FloatArray
    flux: FloatArray
    snr: FloatArray
    peak: FloatArray
    saturated: BoolArray
    blended: BoolArray
    edge: BoolArray
    frame_ids: IntArray
    image: StrArray
    time_utc: StrArray
    background: FloatArray
    noise: FloatArray
    psf_sigma_px: FloatArray
    problem: StrArray
    messages: tuple[str, ...] = ()
    meta: AnyDict = field(default_factory=dict)

    def __post_init__(self) -> None:
        for names, key in ((COLUMNS, "frame"), (FRAME_COLUMNS, "frame_ids")):
            arrays = {
                name: typed("centroids", name, getattr(self, name), kind)
                for name, (kind, _) in names.items()
            }
            check_lengths("centroids", arrays, key)
            order = np.argsort(arrays[key], kind="stable")
            for name, values in arrays.items():
                object.__setattr__(self, name, locked(values[order]))
        if np.any(self.frame_ids[1:] == self.frame_ids[:-1]):
            raise ObservationError(
                "centroids: frame_ids holds a number twice; number the frames differently."
            )
        if len(stray := np.setdiff1d(self.frame, self.frame_ids)):
            raise ObservationError(
                f"centroids: frame {stray[0]} is not among frame_ids; list every frame there."
            )
        object.__setattr__(self, "messages", tuple(self.messages))
        object.__setattr__(self, "meta", dict(self.meta))

    @property
    def origin(self) -> CentroidsOrigin:
        """The facts in `meta` that decide how the table is treated."""
        return CentroidsOrigin.of(self.meta)

    @property
    def n_frames(self) -> int:
        """Number of frames K, those without stars and those left out included."""
        return len(self.frame_ids)

    @property
    def n_left_out(self) -> int:
        """Number of frames that could not be used."""
        return int(np.count_nonzero(self.problem != ""))

    @property
    def sigma_px(self) -> FloatArray:
        """Centroid noise per axis, shape (N,): the root of the mean of both variances, pixels."""
        sigma: FloatArray = np.sqrt(0.5 * (self.var_x_px2 + self.var_y_px2))
        return sigma

    def select(self, mask: ArrayLike) -> Centroids:
        """The rows where `mask` (bool, shape (N,)) is true; every frame keeps its place."""
        chosen = self._mask(mask, "centroids")
        return replace(self, **self._arrays(COLUMNS, chosen))

    def select_frames(self, ids: ArrayLike) -> Centroids:
        """The frames with these numbers, and their rows.

        Raises
        ------
        ObservationError
            If there is no such frame.
        """
        wanted = self._frame_numbers(ids, "centroids")
        kept = np.isin(self.frame_ids, wanted)
        rows = self._arrays(COLUMNS, np.isin(self.frame, wanted))
        return replace(self, **rows, **self._arrays(FRAME_COLUMNS, kept))

    def _arrays(self, names: Iterable[str], chosen: Any = ...) -> AnyDict:
        return {name: getattr(self, name)[chosen] for name in names}

    def with_meta(self, **entries: Any) -> Centroids:
        """The same table with entries of `meta` added or changed."""
        return replace(self, meta={**self.meta, **entries})

    def to_dataframe(self) -> Any:
        """The rows as a pandas DataFrame; `meta` is in its ``attrs``."""
        import pandas as pd

        table = pd.DataFrame(self._arrays(COLUMNS), copy=True)
        table.attrs.update(self.meta)
        return table

    def frames_dataframe(self) -> Any:
        """One row per frame as a pandas DataFrame, with ``n_stars``."""
        import pandas as pd

        table = pd.DataFrame(self._arrays(FRAME_COLUMNS), copy=True)
        table.insert(1, "n_stars", self.stars_per_frame)
        return table.rename(columns={"frame_ids": "frame"})

    def save(self, path: PathLike, force: bool = False) -> None:
        """Write the table without loss; the ending decides: ``.csv``, ``.ecsv`` or ``.parquet``.

        The frames, `messages` and `meta` go along: in CSV as comments at the top.

        Raises
        ------
        ObservationError
            If the ending is unknown.
        RunFolderError
            If the file exists and `force` is false, or cannot be written.
        """
        ending = table_ending(Path(path))
        ensure_new(path, force)
        frames = {
            # JSON has no NaN: null stands for it.
            name: [None if v != v else v for v in values.tolist()]
            for name, values in self._arrays(FRAME_COLUMNS).items()
        }
        document = {"frames": frames, "messages": list(self.messages), "meta": self.meta}
        text = json.dumps(document, default=as_plain)
        with atomic_path(path) as temporary:
            if ending == ".csv":
                rows = self.to_dataframe().to_csv(index=False, lineterminator="\n")
                temporary.write_text(f"{_MARK}{text}\n{rows}", encoding="utf-8", newline="\n")
            elif ending == ".ecsv":
                self._table(text).write(temporary, format="ascii.ecsv", delimiter=",")
            else:
                write_parquet(self._arrays(COLUMNS), temporary, text, _KEY.encode())

    def _table(self, text: str) -> Any:
        with extra("images", "ECSV tables"):
            from astropy.table import Table

        table = Table(self._arrays(COLUMNS), meta={_KEY: text})
        for name, (_, description) in COLUMNS.items():
            table[name].description = description
        return table

    @classmethod
    def load(cls, path: PathLike) -> Centroids:
        """Read a table that `save` wrote.

        Raises
        ------
        ObservationError
            If the file cannot be read or is no table of centroids.
        """
        path = Path(path)
        ending = table_ending(path)
        data = read_bytes(path, "a table of centroids", ObservationError)
        with reading(path, WHAT, "write it again", ObservationError):
            cells = read_cells(path, data, ending, key=_KEY.encode())
            document: AnyDict = cells.meta
            if ending == ".csv" and data.startswith(_MARK.encode()):
                document = json.loads(data.partition(b"\n")[0].removeprefix(_MARK.encode()))
            elif _KEY in document:
                document = json.loads(document[_KEY])
            if not document:
                raise ObservationError(
                    f"{path}: the list of frames is missing; give a table that "
                    f"`{Remedy('centroid').words}` or Centroids.save wrote."
                )
            if missing := [name for name in COLUMNS if name not in cells.columns]:
                raise ObservationError(
                    f"{path}: column {missing[0]} is missing; write the table again.",
                    column=missing[0],
                )
            columns = {
                name: _typed(cells.columns[name], kind) for name, (kind, _) in COLUMNS.items()
            }
            frames: AnyDict = {name: document["frames"][name] for name in FRAME_COLUMNS}
            messages, meta = tuple(map(str, document["messages"])), dict(document["meta"])
            return cls(**columns, **frames, messages=messages, meta=meta)

    def __repr__(self) -> str:
        return (
            f"Centroids({self.n_stars} stars, {self.n_frames} frames, {self.n_left_out} left out)"
        )


_KEY = "starcal_uq_centroids"
_TRUTH = {"True": True, "False": False}
_MARK = f"# {_KEY} "


def _typed(cells: Any, kind: type) -> Any:
    """A column of texts in its type."""
    if kind is np.bool_ and not isinstance(cells, np.ndarray):
        return [_TRUTH[cell] for cell in cells]
    return cells if isinstance(cells, np.ndarray) else np.array(cells, str).astype(kind)
