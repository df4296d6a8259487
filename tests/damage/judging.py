"""What a loader makes of a damaged file: a result, the package's own error, or something worse."""

from __future__ import annotations

import dataclasses
import hashlib
import random
import re
import shutil
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import starcal_uq as sc
from starcal_uq.core.errors import StarcalError
from tests.damage.mutants import mutant
from tests.damage.samples import LAST, SAMPLES, Sample, content, write_samples


@dataclass(frozen=True)
class Outcome:
    """What became of a file."""

    # ``same`` (the numbers of the valid file), ``other`` (a result with others), ``refused``,
    # ``words`` (refused with a bad sentence), or ``escaped``.
    kind: str
    detail: str = ""  # The sentence, or what escaped and where


_CLASS_NAMES = re.compile(
    r"\b[A-Z]\w*(Error|Exception)\b|NoneType|Traceback|object is not| at 0x[0-9a-f]{6}|<class "
)


def faults(message: str, path: Path) -> Iterator[str]:
    """What is wrong with a sentence."""
    if "\n" in message or "\r" in message:
        yield "more than one line"
    if len(message) - len(str(path.parent)) >= 400:
        yield f"{len(message)} characters"
    if path.stem not in message:
        yield "does not name the file"
    if match := _CLASS_NAMES.search(message):
        yield f"says {match.group()!r}"
    if not message.isprintable():
        yield "has characters that do not print"
    if message[-1:] not in ".?":
        yield "is no sentence"


def judge(sample: Sample, path: Path, valid: str = "") -> Outcome:
    """Load a file; `valid` is the `digest` of what the valid one holds."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            result = sample.load(path)
            # Absurd numbers overflow when they are squared; that is said, and no failure.
            warnings.simplefilter("ignore", RuntimeWarning)
            use(result)
    except StarcalError as error:
        wrong = list(faults(str(error), path))
        return (
            Outcome("words", f"{'; '.join(wrong)}: {error}"[:1000])
            if wrong
            else Outcome("refused", str(error))
        )
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        own = [f for f in frames if "starcal_uq" in f.filename]
        place = f"{Path(own[-1].filename).name}:{own[-1].lineno} {own[-1].name}" if own else "?"
        return Outcome("escaped", f"{type(error).__name__} at {place}: {str(error)[:120]}")
    return Outcome("same" if digest(result) == valid else "other")


def use(result: Any) -> None:
    """What is done first with a result: it is shown, and made a table."""
    if isinstance(result, list | tuple):
        for item in result:
            use(item)
        return
    repr(result)
    for name in ("to_dataframe", "summary"):
        method = getattr(result, name, None)
        if callable(method) and hasattr(sc, type(result).__module__.split(".")[1]):
            method()


def digest(value: Any) -> str:
    """A hash of all numbers and texts of a result."""
    sha = hashlib.sha256()
    _feed(value, sha.update, set())
    return sha.hexdigest()


def _feed(value: Any, put: Callable[[bytes], None], seen: set[int]) -> None:
    if isinstance(value, np.ndarray | np.generic):
        array = np.asarray(value)
        put(
            f"{array.dtype.str}{array.shape}".encode()
            + (repr(array.tolist()).encode() if array.size else b"")
        )
    elif isinstance(value, Mapping):
        for key in sorted(value, key=str):
            put(str(key).encode())
            _feed(value[key], put, seen)
    elif isinstance(value, list | tuple):
        put(f"[{len(value)}".encode())
        for item in value:
            _feed(item, put, seen)
    elif type(value).__module__.partition(".")[0] in ("pandas", "pyarrow", "xarray"):
        put(repr(value.to_dict() if hasattr(value, "to_dict") else value.to_pylist()).encode())
    elif type(value).__module__.startswith("starcal_uq") and hasattr(value, "__dict__"):
        if id(value) in seen:
            return
        seen.add(id(value))
        own = (
            {f.name for f in dataclasses.fields(value)}
            if dataclasses.is_dataclass(value)
            else set(vars(value))
        )
        for name in sorted(own):
            if name not in ("path", "source", "name", "seconds"):
                put(name.encode())
                _feed(getattr(value, name), put, seen)
    else:
        put(repr(value).encode())


class Bench:
    """A folder in which samples are damaged and judged, one at a time."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "valid").mkdir(parents=True, exist_ok=True)
        if not (folder / "valid" / LAST).exists():
            write_samples(folder / "valid")
        self._known: dict[str, tuple[bytes, str, Path]] = {}

    def valid(self, sample: Sample) -> tuple[bytes, str, Path]:
        """Content of the valid file, the digest of its result, and where damaged ones are put."""
        if sample.file not in self._known:
            place = self.folder / "at" / sample.file.replace(".", "-")
            place.mkdir(parents=True, exist_ok=True)
            for name in (sample.file, *sample.beside):
                shutil.copy(self.folder / "valid" / name, place / name)
            path = place / sample.file
            expected = sample.load(path) if sample.file != "chain.toml" else None
            self._known[sample.file] = (path.read_bytes(), digest(expected), path)
        return self._known[sample.file]

    def damaged(self, sample: Sample, rng: random.Random) -> tuple[bytes, Outcome]:
        """One mutant, and what became of it."""
        data, expected, path = self.valid(sample)
        other = content(self.folder / "valid" / SAMPLES[rng.randrange(len(SAMPLES))].file)
        made = mutant(sample, data, rng, other)
        return made, self.judged(sample, made, expected, path)

    def judged(
        self, sample: Sample, made: bytes, expected: str = "", path: Path | None = None
    ) -> Outcome:
        """What becomes of the sample with this content."""
        if path is None:
            _, expected, path = self.valid(sample)
        path.write_bytes(made)
        return judge(sample, path, expected)
