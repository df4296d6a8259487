"""What every table with one row per star and frame has in common, and how such tables are
written.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from starcal_uq.core.errors import ObservationError
from starcal_uq.core.types import AnyDict, BoolArray, FloatArray, IntArray

_Array = TypeVar("_Array", bound="np.ndarray[Any, Any]")


class FrameRows:
    """Rows sorted by frame; a class that has these columns gets the rest from here.

    `frame` (N,) is the frame number of each row and `frame_ids` (K,) are all of them, both
    ascending; `x_px` and `y_px` (N,) are centroids, px.
    """

    frame: IntArray
    frame_ids: Any
    x_px: FloatArray
    y_px: FloatArray

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def n_stars(self) -> int:
        """Number of rows N: stars summed over frames."""
        return len(self.frame)

    @cached_property
    def frame_starts(self) -> IntArray:
        """First row of each frame, and N, shape (K + 1,): frame k has rows ``starts[k]:starts[k +
        1]``.
        """
        starts = np.searchsorted(self.frame, self.frame_ids).astype(np.int64)
        return locked(np.append(starts, np.int64(len(self.frame))))

    @property
    def stars_per_frame(self) -> IntArray:
        """Number of stars in each frame, shape (K,)."""
        return np.diff(self.frame_starts)

    @cached_property
    def xy(self) -> FloatArray:
        """Centroids, shape (N, 2), pixels."""
        return locked(np.column_stack([self.x_px, self.y_px]))

    def _mask(self, mask: ArrayLike, table: str) -> BoolArray:
        """A mask of rows, checked; `table` is what messages call the table."""
        chosen = np.asarray(mask)
        if chosen.dtype != np.bool_ or chosen.shape != self.frame.shape:
            raise ObservationError(
                f"{table}: the mask is {chosen.dtype} of shape {chosen.shape}; "
                f"give true or false for each of the {len(self)} rows."
            )
        return chosen

    def _frame_numbers(self, ids: ArrayLike, table: str) -> IntArray:
        """Numbers of frames, which must be there."""
        wanted = np.asarray(ids).ravel()
        missing = np.setdiff1d(wanted, self.frame_ids)
        if missing.size:
            raise ObservationError(
                f"{table}: there is no frame {missing[0]}; choose among frame_ids."
            )
        return wanted


def typed(table: str, name: str, values: Any, kind: type) -> Any:
    """A one-dimensional copy of a column in its type; `table` is what messages call the table."""
    try:
        array: Any = np.array(values, dtype=kind)
    except (TypeError, ValueError):
        words = "text" if kind is str else "numbers"
        raise ObservationError(
            f"{table}: column {name} holds other things than {words}; convert it first.",
            column=name,
        ) from None
    if array.ndim != 1:
        raise ObservationError(
            f"{table}: column {name} has shape {array.shape}; give one value per row.", column=name
        )
    return array


def check_lengths(table: str, columns: AnyDict, key: str) -> None:
    """Refuse columns that are not as long as that of the key."""
    n = len(columns[key])
    for name, values in columns.items():
        if len(values) != n:
            raise ObservationError(
                f"{table}: {name} has {len(values)} rows and {key} has {n}; give equal lengths.",
                column=name,
            )


def locked(array: _Array) -> _Array:
    """The array, which can no longer be written to."""
    array.setflags(write=False)
    return array
