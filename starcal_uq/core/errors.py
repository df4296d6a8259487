"""Errors that a user can act on.

Every message is one complete sentence that names what is wrong, where, and the remedy; the command
line prints it as it stands and exits with status 2.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from starcal_uq.core.status import Status


class StarcalError(Exception):
    """Base of all errors that this package raises on purpose.

    The message is one line that prints: what a file holds may stand in it, however long or odd.
    """

    def __init__(self, message: str = "") -> None:
        super().__init__(_one_line(message))


# A word that is longer is cut, and so is a message, whose remedy stands at its end.
_LONGEST_WORD, _LONGEST = 250, 450


def printable(text: str) -> str:
    """A text with escapes for what does not print; line feeds are among it."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def _one_line(message: str) -> str:
    if message.isprintable() and len(message) <= _LONGEST_WORD:
        return message
    line = printable(" ".join(message.splitlines()))
    line = re.sub(
        rf"\S{{{_LONGEST_WORD},}}", lambda word: f"{word[0][:40]}...{word[0][-20:]}", line
    )
    return line if len(line) <= _LONGEST else f"{line[:290]} ... {line[-100:]}"


def check_known(what: str, name: str, known: Collection[str], error: type[Exception]) -> None:
    """Refuse a name that is none of those that are known."""
    if name not in known:
        raise error(f"{what} {name!r} is unknown: use one of {', '.join(known)}.")


def require(error: type[Exception], *conditions: tuple[bool, str]) -> None:
    """Raise an error with the text of the first condition that does not hold."""
    for good, text in conditions:
        if not good:
            raise error(text)


class SettingError(StarcalError, ValueError):
    """A setting lies outside its limits."""


class MissingExtraError(StarcalError, ImportError):
    """A library that only some users need is not installed; the message has the command that
    installs it.
    """


class CameraError(StarcalError):
    """A camera description is incomplete, inconsistent or unreadable."""


class SensorError(StarcalError):
    """A sensor description is inconsistent or unreadable, or asks for an image that cannot be
    rendered.
    """


class DistortionError(StarcalError):
    """A distortion model is unknown, or cannot be inverted where it was asked for."""


class ObservationError(StarcalError):
    """An observations table has bad rows.

    Parameters
    ----------
    message
        The sentence shown to the user.
    row
        The first bad row: the line in a CSV or ECSV file (the header counts), the row number from 1
        otherwise.
    column
        The column of the first problem.
    problems
        Every problem found, one sentence each.
    """

    def __init__(
        self,
        message: str,
        row: int | None = None,
        column: str | None = None,
        problems: Sequence[str] = (),
    ) -> None:
        super().__init__(message)
        self.row = row
        self.column = column
        self.problems = tuple(problems)


class AttitudeProfileError(StarcalError):
    """A profile over time is unreadable, or its times, quaternions or temperatures cannot be used."""


class HeadError(StarcalError):
    """Heads of a star tracker, or their mountings, cannot be used as they are given."""


class CatalogueError(StarcalError):
    """A star catalogue cannot be read or does not hold what was asked for."""


class SiteError(StarcalError):
    """A site on the ground is incomplete, out of range or unreadable."""


class IdentificationError(StarcalError):
    """Stars cannot be identified with what was given."""


class CalibrationError(StarcalError):
    """The estimate was not found; `status` says why and what to do, `undetermined` names what the
    data leave open.

    `calibration` is what was found, where it has residuals to look at. The message is the `outcome`,
    and after it the reason or what to do, where that is given.
    """

    def __init__(
        self,
        message: str,
        status: Status | None = None,
        undetermined: Sequence[str] = (),
        calibration: Any = None,
        *,
        reason: str = "",
    ) -> None:
        super().__init__(f"{message}: {reason}." if reason else message)
        self.outcome, self.status = message, status
        self.undetermined = tuple(undetermined)
        self.calibration = calibration


class RepeatedFramesError(CalibrationError):
    """Frames hold the same measurement; `pairs` has their numbers, the frame that stays and the one
    that repeats it.
    """

    def __init__(self, message: str, pairs: Sequence[Sequence[int]] = ()) -> None:
        super().__init__(message)
        self.pairs = tuple((int(first), int(later)) for first, later in pairs)


class PriorError(StarcalError):
    """A prior is improper or misspelt."""


class SamplingError(StarcalError):
    """The posterior could not be sampled from the given start."""


class PlanningError(StarcalError):
    """A calibration cannot be planned with what was given, or its aim cannot be reached."""


class StudyError(StarcalError):
    """The definition of a study is unreadable or makes no sense, or its results are not there."""


class ComparisonError(StarcalError):
    """Two calibrations cannot be compared, or a table of frames cannot be split."""


class ImageError(StarcalError):
    """An image file is missing, damaged, empty or of the wrong size."""


class BudgetError(StarcalError):
    """An error budget is incomplete, contradicts itself or is unreadable."""


class ClusterError(StarcalError):
    """Processes, of this machine or of a Dask cluster, cannot do the work."""


class RunFileError(StarcalError):
    """A run file that cannot be read, or has a key that no option has."""


class RunFolderError(StarcalError):
    """A run folder lacks a file, or holds one that would be overwritten."""
