"""Rotations of the camera between frames that were measured without stars: by a gyro, a turntable,
or the Earth under a fixed mount.

The file is CSV, ECSV or Parquet with ``frame_a``, ``frame_b``, a scalar-last quaternion ``qx, qy,
qz, qw`` and ``sigma_arcsec``, or ``sigma_x_arcsec``, ``sigma_y_arcsec`` and ``sigma_z_arcsec``, in
each row. The quaternion is that of ``D = R_b R_a^T``, which turns vectors from the camera frame of
frame a into that of frame b.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from starcal_uq.attitude.earth import earth_axes
from starcal_uq.attitude.profile import NAMED, TableColumns, check_quaternions, read_columns
from starcal_uq.attitude.rotations import rotation_to_quaternion
from starcal_uq.core.errors import AttitudeProfileError
from starcal_uq.core.types import FloatArray, IntArray, PathLike

_ALIKE = "sigma_arcsec"
_APART = ("sigma_x_arcsec", "sigma_y_arcsec", "sigma_z_arcsec")


@dataclass(frozen=True, eq=False)
class RelativeAttitudes:
    """Known rotations between frames, ``R_b R_a^T = exp([w]x) D``, with errors w about the axes of
    the camera in frame b.

    Attributes
    ----------
    frame_a, frame_b : (T,) array of int
        Numbers of the two frames. Where `frame_a` is empty, the camera is on a fixed mount: every
        rotation is that of the Earth in `frame_b`, and the attitude of the mount is unknown.
    quaternions : (T, 4) array
        Scalar-last unit quaternions of D.
    sigma_arcsec : (T, 3) array
        Standard deviations of w about x, y and z, arcsec; one column stands for all three.
    alignment_arcsec : float
        How well the axes of the instrument that measured the rotations are known in the camera,
        standard deviation about each axis: an error of these axes is common to all rotations, and
        shifts the principal point as an attitude does. Up to a few hundred arcsec.

    Raises
    ------
    AttitudeProfileError
        For quaternions far from unit length, errors that are not above zero, a frame tied to
        itself, and a pair of frames that is given twice.
    """

    frame_a: IntArray
    frame_b: IntArray
    quaternions: FloatArray
    sigma_arcsec: FloatArray
    alignment_arcsec: float = 0.0

    def __post_init__(self) -> None:
        q = np.array(self.quaternions, dtype=float).reshape(-1, 4)
        a, b = (np.array(own, dtype=np.int64).ravel() for own in (self.frame_a, self.frame_b))
        sigma = np.array(self.sigma_arcsec, dtype=float)
        sigma = np.broadcast_to(sigma.reshape(len(sigma) if sigma.ndim else 1, -1), (len(q), 3))
        table = _Table(a, b, q, sigma, np.arange(1, len(q) + 1))
        table.check()
        if not 0.0 <= self.alignment_arcsec < float("inf"):
            raise AttitudeProfileError(
                f"alignment_arcsec is {self.alignment_arcsec!r}: state how well the axes of the "
                "instrument are known in the camera, or 0."
            )
        length = np.linalg.norm(q, axis=1, keepdims=True)
        # What was normalised before keeps its bits.
        q = np.where(np.abs(length - 1.0) < 1e-14, q, q / length)
        found = (a, b, q, sigma.copy())
        names = ("frame_a", "frame_b", "quaternions", "sigma_arcsec")
        for name, array in zip(names, found, strict=True):
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def of_mount(self) -> bool:
        """Whether the camera is on a fixed mount."""
        return not len(self.frame_a)

    def __len__(self) -> int:
        return len(self.frame_b)

    def scaled(self, factor: float) -> RelativeAttitudes:
        """The same rotations with errors so many times as large."""
        return replace(self, sigma_arcsec=factor * self.sigma_arcsec)

    @classmethod
    def of_earth(
        cls, frames: IntArray, time_utc: Sequence[str], sigma_arcsec: float
    ) -> RelativeAttitudes:
        """Those of a fixed mount: the Earth at the times (K,) of all frames (K,).

        `sigma_arcsec` is how far the mount moves from frame to frame, about each axis. UT1 - UTC is
        the same for all frames and turns the unknown mount, so that it is not needed.
        """
        q = rotation_to_quaternion(earth_axes(list(time_utc)))
        none = np.zeros(0, dtype=np.int64)
        return cls(none, frames, q, np.full((len(q), 1), sigma_arcsec))


def load_relative_attitudes(path: PathLike) -> RelativeAttitudes:
    """Read known rotations between frames (``.csv``, ``.ecsv`` or ``.parquet``).

    Parameters
    ----------
    path
        A table with ``frame_a``, ``frame_b``, ``qx, qy, qz, qw`` and ``sigma_arcsec``, or
        ``sigma_x_arcsec, sigma_y_arcsec, sigma_z_arcsec``. Comments start with ``#``.

    Raises
    ------
    AttitudeProfileError
        When the file cannot be read, or as for `RelativeAttitudes`.
    """
    columns = read_columns(path, "a pair of frames, a quaternion and its error")
    sigmas = _APART if _APART[0] in columns.cells else (_ALIKE,)
    for name in ("frame_a", "frame_b", *NAMED, *sigmas):
        if name not in columns.cells:
            raise AttitudeProfileError(
                f"{path}: column {name} is missing; give frame_a, frame_b, {', '.join(NAMED)} and "
                f"{_ALIKE}, or {', '.join(_APART)}."
            )
    a, b = (_whole(columns, name) for name in ("frame_a", "frame_b"))
    q = np.column_stack([columns.numbers_of(name) for name in NAMED])
    sigma = np.column_stack([columns.numbers_of(name) for name in sigmas])
    sigma = np.broadcast_to(sigma, (len(q), 3))
    _Table(a, b, q, sigma, columns.numbers, columns.word, f"{path}: ").check()
    return RelativeAttitudes(a, b, q, sigma)


def _whole(columns: TableColumns, name: str) -> IntArray:
    values = columns.numbers_of(name)
    bad = ~(np.isfinite(values) & (values == np.round(values)))
    if bad.any():
        raise AttitudeProfileError(
            f"{columns.path}, {columns.word} {columns.numbers[bad][0]}: {name} is "
            f"{values[bad][0]:g}, not the number of a frame; repair it."
        )
    return np.asarray(values.astype(np.int64))


@dataclass(frozen=True, eq=False)
class _Table:
    """Rows as they are given, and what their numbers count."""

    a: IntArray
    b: IntArray
    q: FloatArray
    sigma: FloatArray
    numbers: IntArray
    word: str = "row"
    where: str = "relative attitudes: "

    def check(self) -> None:
        """Refuse what cannot be."""
        if len(self.b) != len(self.q) or len(self.a) not in (0, len(self.q)):
            raise AttitudeProfileError(
                f"{self.where}there are {len(self.a)} and {len(self.b)} frames for {len(self.q)} "
                "rotations; give two frames for each."
            )
        if not len(self.q):
            raise AttitudeProfileError(f"{self.where}holds no rotation; leave it out.")
        check_quaternions(self.where, self.word, self.numbers, self.q)
        bad = ~np.all((self.sigma > 0.0) & np.isfinite(self.sigma), axis=1)
        self._refuse(bad, "the error is not above zero", "state the standard deviation in arcsec")
        if not len(self.a):
            return
        self._refuse(self.a == self.b, "a frame is tied to itself", "remove it")
        pairs = np.sort(np.column_stack([self.a, self.b]), axis=1)
        first = np.unique(pairs, axis=0, return_index=True)[1]
        again = np.ones(len(pairs), dtype=bool)
        again[first] = False
        self._refuse(again, "the two frames are tied by an earlier row", "keep one of them")

    def _refuse(self, bad: Any, what: str, remedy: str) -> None:
        if not np.any(bad):
            return
        i = int(np.argmax(bad))
        frames = f"frame {self.b[i]}"
        if len(self.a):
            frames = f"frames {self.a[i]} and {self.b[i]}"
        raise AttitudeProfileError(
            f"{self.where}{self.word} {self.numbers[i]} ({frames}): {what}; {remedy}."
        )
