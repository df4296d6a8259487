"""Attitudes over time from a file: a slew, an orbit, a scan law.

The file is CSV, ECSV or Parquet with a time (``time_s``, or ``time_utc``) and a quaternion in each
row. Quaternions are those of R_cam_icrs, scalar last: they turn ICRS vectors into the camera frame,
b = R r, with the sense of ``scipy.spatial.transform.Rotation``. Columns ``qx, qy, qz, qw`` say
which component is which; numbered ones do not, and are refused unless the order is stated.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from starcal_uq.attitude.rotations import left_error
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import AttitudeProfileError, CatalogueError
from starcal_uq.core.files import listed, reading, shown, table_ending
from starcal_uq.core.findings import clause
from starcal_uq.core.formatting import plural, significant
from starcal_uq.core.settings import Scalar, Sense, bounded
from starcal_uq.core.tables import WHAT, read_cells
from starcal_uq.core.times import julian_days
from starcal_uq.core.types import AnyDict, FloatArray, IntArray, PathLike, floats

_UNIT = 1e-6
_NEARLY_UNIT = 1e-3
# Between two samples farther apart than this, the shortest turn need not be the one that was flown.
_FAR_DEG = 30.0
# A step so many times the usual one is told.
_GAP = 10.0
# What is odd about the times of a profile.
Steps = Enum("Steps", "FAR MISSING")
_MAX_FRAMES = 1_000_000


@dataclass(frozen=True, eq=False)
class AttitudeProfile(Shown):
    """Attitudes of the camera over time.

    Attributes
    ----------
    time_s : (K,) array
        Strictly increasing times, s.
    quaternions : (K, 4) array
        Scalar-last unit quaternions of R_cam_icrs, with signs such that neighbours lie in one half.
    name : str
        Origin, such as the path of a file.
    messages : tuple of str
        Sentences on what was mended or looks doubtful.
    """

    time_s: FloatArray
    quaternions: FloatArray
    name: str = ""
    messages: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        time, q = np.array(self.time_s, dtype=float), np.array(self.quaternions, dtype=float)
        where = f"{self.name or 'attitude profile'}: "
        if time.ndim != 1 or q.shape != (len(time), 4):
            raise AttitudeProfileError(
                f"{where}times have shape {time.shape} and quaternions {q.shape}; give (K,) and "
                "(K, 4)."
            )
        if len(time) < 2:
            raise AttitudeProfileError(
                f"{where}holds {plural(len(time), 'attitude')}; give at least two."
            )
        rows = np.arange(1, len(time) + 1)
        messages = (*self.messages, *check_samples(where, "row", rows, time, q))
        q /= np.linalg.norm(q, axis=1, keepdims=True)
        flips = np.cumprod(np.where(np.sum(q[1:] * q[:-1], axis=1) < 0.0, -1.0, 1.0))
        q[1:] *= flips[:, None]
        for array in (time, q):
            array.setflags(write=False)
        object.__setattr__(self, "time_s", time)
        object.__setattr__(self, "quaternions", q)
        steps = np.diff(time)
        far = self.rate_deg_s * steps > _FAR_DEG
        if far.any():
            messages += (clause(Steps.FAR, n=far.sum(), most_deg=_FAR_DEG),)
        longest = int(np.argmax(steps))
        times = steps[longest] / float(np.median(steps))
        if times > _GAP:
            ends_s = time[longest : longest + 2]
            messages += (clause(Steps.MISSING, ends_s=ends_s, times=times),)
        object.__setattr__(self, "messages", tuple(dict.fromkeys(messages)))

    @property
    def duration_s(self) -> float:
        """Time from the first to the last attitude, s."""
        return float(self.time_s[-1] - self.time_s[0])

    @property
    def rate_deg_s(self) -> FloatArray:
        """Speed of the turn between neighbouring samples (K-1,), degrees per second."""
        angle = np.linalg.norm(left_error(self.quaternions[1:], self.quaternions[:-1]), axis=1)
        rate: FloatArray = np.degrees(angle) / np.diff(self.time_s)
        return rate

    @bounded
    def at(self, time_s: FloatArray) -> FloatArray:
        """Attitudes (n, 4) at some times (n,), s, on the shortest arc between neighbouring samples
        (slerp).

        Raises
        ------
        AttitudeProfileError
            For times outside the profile.
        """
        from scipy.spatial.transform import Rotation, Slerp

        wanted = np.asarray(time_s, dtype=float)
        slack = 1e-9 * self.duration_s
        if np.any((wanted < self.time_s[0] - slack) | (wanted > self.time_s[-1] + slack)):
            raise AttitudeProfileError(
                f"{self.name or 'attitude profile'}: covers {self.time_s[0]:g} s to "
                f"{self.time_s[-1]:g} s; it is not "
                "continued beyond."
            )
        wanted = np.clip(wanted, self.time_s[0], self.time_s[-1])
        q: FloatArray = Slerp(self.time_s, Rotation.from_quat(self.quaternions))(wanted).as_quat()
        return q

    @bounded
    def at_rate(self, rate_hz: float) -> AttitudeProfile:
        """The profile with `rate_hz` attitudes per second from its first instant on.

        Raises
        ------
        AttitudeProfileError
            When that gives fewer than two attitudes, or more than a million.
        """
        n = int(np.floor(self.duration_s * rate_hz * (1.0 + 1e-12))) + 1 if rate_hz > 0.0 else 0
        if not 2 <= n <= _MAX_FRAMES:
            raise AttitudeProfileError(
                f"a rate of {rate_hz:g} Hz over {significant(self.duration_s, 3)} s gives {n} "
                "frames; choose one that "
                f"gives 2 to {_MAX_FRAMES}."
            )
        time = self.time_s[0] + np.arange(n) / rate_hz
        return AttitudeProfile(time, self.at(time), self.name, self.messages)

    def to_dataframe(self) -> Any:
        """Columns ``time_s``, ``qx``, ``qy``, ``qz``, ``qw``, one row per instant."""
        import pandas as pd

        components = dict(zip(("qx", "qy", "qz", "qw"), self.quaternions.T, strict=True))
        return pd.DataFrame({"time_s": self.time_s, **components})


def load_attitude_profile(
    path: PathLike, *, scalar: Scalar | None = None, sense: Sense = "icrs_to_camera"
) -> AttitudeProfile:
    """Read an attitude profile (``.csv``, ``.ecsv`` or ``.parquet``).

    Parameters
    ----------
    path
        A table with ``time_s`` (seconds) or ``time_utc`` (ISO 8601) and ``qx, qy, qz, qw``.
        Comments start with ``#``.
    scalar : {"first", "last"}, optional
        Which of numbered columns (``q0`` to ``q3``, or ``q1`` to ``q4``) is the scalar part;
        refused if not stated.
    sense : {"icrs_to_camera", "camera_to_icrs"}
        Direction of the quaternions. The default is b = R r, ICRS vectors into the camera frame.

    Raises
    ------
    AttitudeProfileError
        When the file cannot be read, times do not increase, or a quaternion is far from unit
        length.
    """
    table = read_columns(path, "a time and a quaternion")
    q = np.column_stack([table.numbers_of(name) for name in _components(table, scalar)])
    time_s = table.time_s
    messages = check_samples(f"{path}: ", table.word, table.numbers, time_s, q)
    if sense == "camera_to_icrs":
        q = q * np.array([-1.0, -1.0, -1.0, 1.0])
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    return AttitudeProfile(time_s, q, os.path.basename(os.fspath(path)), messages)


def check_samples(
    where: str, word: str, numbers: IntArray, time_s: FloatArray, q: FloatArray
) -> tuple[str, ...]:
    """Refuse times that do not increase and quaternions far from unit length; say which were
    normalised.
    """
    bad = ~(np.isfinite(q).all(axis=1) & np.isfinite(time_s))
    if bad.any():
        raise AttitudeProfileError(
            f"{where}{word} {numbers[bad][0]} holds a value that is not finite; repair it."
        )
    check_order(where, word, numbers, time_s)
    off = check_quaternions(where, word, numbers, q)
    uneven = int(np.sum(off > _UNIT))
    if not uneven:
        return ()
    return (
        f"{plural(uneven, 'quaternion')} differed from unit length by up to "
        f"{significant(off.max())} and "
        f"{'was' if uneven == 1 else 'were'} normalised.",
    )


def check_order(where: str, word: str, numbers: IntArray, time_s: FloatArray) -> None:
    """Refuse times that do not increase."""
    back = np.flatnonzero(np.diff(time_s) <= 0.0)
    if back.size:
        i = back[0] + 1
        raise AttitudeProfileError(
            f"{where}{word} {numbers[i]}: the time {time_s[i]:.9g} s does not come after "
            f"{time_s[i - 1]:.9g} s; sort the rows by time and remove repeated ones."
        )


def check_quaternions(where: str, word: str, numbers: IntArray, q: FloatArray) -> FloatArray:
    """Refuse quaternions (K, 4) far from unit length; by how much each length is off, (K,)."""
    with np.errstate(over="ignore"):
        length = np.linalg.norm(q, axis=1)
    off: FloatArray = np.abs(length - 1.0)
    bad = ~(off <= _NEARLY_UNIT)
    if np.any(bad):
        i = int(np.argmax(bad))
        raise AttitudeProfileError(
            f"{where}{word} {numbers[i]}: the quaternion has the length {length[i]:.6g}, not 1; "
            "check its columns."
        )
    return off


NAMED = ("qx", "qy", "qz", "qw")
_NUMBERED = (("q0", "q1", "q2", "q3"), ("q1", "q2", "q3", "q4"))
_DAY_S = 86_400.0


@dataclass(frozen=True)
class TableColumns:
    """Cells of a file by column, and the line (CSV, ECSV) or row from 1 (Parquet) of each."""

    path: Path
    cells: AnyDict
    numbers: IntArray
    word: str

    def numbers_of(self, name: str) -> FloatArray:
        """One column (K,) as numbers."""
        cells = self.cells[name]
        if isinstance(cells, np.ndarray):
            return floats(cells)
        values = []
        for number, cell in zip(self.numbers, cells, strict=True):
            try:
                values.append(float(cell))
            except ValueError:
                raise AttitudeProfileError(
                    f"{self.path}, {self.word} {number}: {name} is {shown(cell.strip())}, not a "
                    "number; repair it."
                ) from None
        return np.array(values)

    @property
    def time_s(self) -> FloatArray:
        """Times (K,), s; of UTC times the seconds since the first."""
        if "time_s" in self.cells:
            return self.numbers_of("time_s")
        if "time_utc" not in self.cells:
            raise AttitudeProfileError(
                f"{self.path}: column time_s or time_utc is missing; add one of them."
            )
        try:
            tt, _, inverse = julian_days([str(text) for text in self.cells["time_utc"]])
        except CatalogueError as error:
            raise AttitudeProfileError(f"{self.path}: {error}") from None
        days = tt[inverse] - tt[inverse[0]]
        # Two-part Julian dates are good to 1e-11 s; the text states at most nanoseconds.
        return floats(np.round(days.sum(axis=1) * _DAY_S, 9))


def read_columns(path: PathLike, content: str) -> TableColumns:
    """Read a table; AttitudeProfileError for one without rows, each of which should hold
    `content`.
    """
    path = Path(path)
    with reading(path, WHAT, "check the path, or write it again", AttitudeProfileError):
        ending = table_ending(path)
        raw = read_cells(path, path.read_bytes(), ending)
        for row, why in raw.uneven.items():
            raise AttitudeProfileError(f"{path}, line {raw.numbers[row]}: holds {why}; repair it.")
        if not len(raw.numbers):
            raise AttitudeProfileError(
                f"{path}: holds no rows; give a table with {content} per row."
            )
        return TableColumns(path, raw.columns, raw.numbers, raw.word)


def _components(table: TableColumns, scalar: str | None) -> tuple[str, ...]:
    """Names of the columns in the order x, y, z, w."""
    for names in (NAMED, *_NUMBERED):
        if not all(name in table.cells for name in names):
            continue
        if names == NAMED or scalar == "last":
            return names
        if scalar is None:
            raise AttitudeProfileError(
                f"{table.path}: the columns {', '.join(names)} do not say which is the scalar part; "
                f"name them {', '.join(NAMED)} (qw is the scalar), or state scalar='first' or "
                "scalar='last'."
            )
        return (*names[1:], names[0])
    missing = [name for name in NAMED if name not in table.cells]
    raise AttitudeProfileError(
        f"{table.path}: column {missing[0]} is missing; give {', '.join(NAMED)} beside time_s or "
        f"time_utc (the file has {listed(list(table.cells)) or 'no columns'})."
    )
