"""Facts of a stored file for `baseline.py`: arrays and words by name.

What differs from run to run by itself is left out; the table `VOLATILE` lists it.
"""

from __future__ import annotations

import base64
import csv
import hashlib
import json
import re
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Volatile:
    """A fact that may differ.

    In text, `put` replaces `pattern`; in a document, `key` is left out; in the name of a file,
    `file` is.
    """

    what: str
    pattern: str = ""
    put: str = ""
    key: str = ""
    file: str = ""


VOLATILE = (
    Volatile(
        "times within the making",
        r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(\.\d+)?(Z| UTC|\+00:00)?",
        "<now>",
    ),
    Volatile("days of the making", r"\d{4}-\d\d-\d\d(?![T \d])", "<today>"),
    Volatile(
        "times that a step took, in tables of a page",
        r"(?<=>)[\d.,]+ (ms|s|min)(?=</td>)",
        "<spent>",
    ),
    Volatile("addresses of objects", r"\bat 0x[0-9a-f]+", "at <address>"),
    Volatile(
        "times of an identification, on a page",
        r"(?<=Identified in</dt><dd>)[\d.,]+ (ms|s|min)",
        "<spent>",
    ),
    Volatile(
        "times of an identification, in a terminal",
        r"( identified +\d+ +\d+ +\S+ +)[\d.,]+(?= *$)",
        r"\1<spent>",
    ),
    Volatile("seconds that a step took", key=r"(^|/)(milli)?seconds$"),
    Volatile("hash of a file, which is compared itself", key=r"(^|/)archive_sha256$"),
    Volatile("hash of cells, which hold their seconds", file=r"(?<=part-)[0-9a-f]{16}"),
    Volatile("versions of packages", key=r"(^|/)versions(/|$)"),
    Volatile(
        "size and hash of files, which are compared themselves", key=r"^files/.*/(bytes|sha256)$"
    ),
)


def files(folder: Path) -> dict[str, Path]:
    """Files of a folder by their path in it, without what is volatile in their names."""
    found: dict[str, Path] = {}
    volatile = re.compile("|".join(v.file for v in VOLATILE if v.file))
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        name = str(path.relative_to(folder))
        if volatile.search(name):
            count = sum(volatile.sub("", name) == volatile.sub("", other) for other in found)
            name = volatile.sub(f"{count:016x}", name)
        found[name] = path
    return found


class Cleaner:
    """Text and keys of a job without what is volatile.

    `replaced` are pairs of old and new words, of differences that are meant.
    """

    def __init__(self, record: dict[str, Any], replaced: Sequence[tuple[str, str]] = ()):
        self.replaced = replaced
        self.work = str(record.get("work", ""))
        self.first, self.last = (
            str(record.get("started", ""))[:10],
            str(record.get("ended", ""))[:10],
        )
        self.keys = re.compile("|".join(v.key for v in VOLATILE if v.key))

    def text(self, text: str) -> str:
        """`text` with placeholders."""
        for old, new in self.replaced:
            text = text.replace(old, new)
        if self.work:
            text = text.replace(self.work, "<work>").replace(Path(self.work).name, "<work>")
        for volatile in VOLATILE:
            if volatile.pattern:
                put = partial(self._put, volatile.put)
                text = re.sub(volatile.pattern, put, text, flags=re.MULTILINE)
        return text

    def _put(self, put: str, found: re.Match[str]) -> str:
        # Times of the data are facts.
        if put in ("<now>", "<today>") and not self.first <= found[0][:10] <= self.last:
            return found[0]
        return found.expand(put)

    def leaves_out(self, key: str) -> bool:
        """Whether a key of a document is volatile."""
        return bool(self.keys.search(key))


@dataclass
class Facts:
    """What a file holds: arrays with the sigma that measures them, and words, both by name."""

    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    sigmas: dict[str, np.ndarray] = field(default_factory=dict)
    words: dict[str, list[str]] = field(default_factory=dict)

    def add(self, name: str, values: Any) -> None:
        """A column or array, numbers or words."""
        array = np.asarray(values)
        if array.dtype == object and any(isinstance(value, np.ndarray) for value in array.flat):
            # A column of lists; they may have different lengths.
            lists = [np.asarray([] if value is None else value).ravel() for value in array.flat]
            self.add(f"{name} (lengths)", [len(part) for part in lists])
            array = np.concatenate(lists)
        if array.dtype.kind in "iufcb":
            self.arrays[name] = array
            return
        listed = [
            value.decode() if isinstance(value, bytes) else str(value)
            for value in array.ravel().tolist()
        ]
        try:
            self.arrays[name] = np.array(
                [float(value) if value not in ("", "None") else np.nan for value in listed]
            )
        except ValueError:
            self.words[name] = listed

    def include(self, other: Facts, prefix: str) -> None:
        """The facts of a part."""
        for mine, theirs in (
            (self.arrays, other.arrays),
            (self.sigmas, other.sigmas),
            (self.words, other.words),
        ):
            mine.update({f"{prefix}{name}": value for name, value in theirs.items()})


ESTIMATES = ("theta", "mean", "estimate")
SPREADS = ("sigma", "sd", "formal_sigma", "sigma_marginal")


def table(names: list[str], columns: list[Any], clean: Cleaner) -> Facts:
    """Columns, with the sigma of those that have one in the table."""
    facts = Facts()
    for name, values in zip(names, columns, strict=True):
        if not clean.leaves_out(name):
            facts.add(name, values)
    for name in facts.arrays:
        beside = (f"sigma_{name}", f"{name}_sigma", *(SPREADS if name in ESTIMATES else ()))
        found = [facts.arrays[other] for other in beside if other in facts.arrays]
        if found:
            facts.sigmas[name] = found[0]
    for name, words in facts.words.items():
        facts.words[name] = [clean.text(word) for word in words]
    return facts


def read_csv(path: Path, clean: Cleaner) -> Facts:
    with path.open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.reader(file) if row]
    if not rows or any(len(row) != len(rows[0]) for row in rows):
        return read_lines(path, clean)
    return table(rows[0], list(zip(*rows[1:], strict=True)) or [[] for _ in rows[0]], clean)


def read_parquet(path: Path, clean: Cleaner) -> Facts:
    import pyarrow.parquet as parquet

    content = parquet.read_table(path)
    facts = table(
        content.column_names, [column.to_pandas().to_numpy() for column in content.columns], clean
    )
    for key, value in (content.schema.metadata or {}).items():
        name = f"metadata {key.decode()}"
        if name != "metadata pandas":
            facts.include(document(_parsed(value.decode()), clean), name)
    return facts


def _parsed(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


def document(content: Any, clean: Cleaner, path: str = "") -> Facts:
    """A document's numbers, lists of numbers and sentences by their keys."""
    facts = Facts()
    if clean.leaves_out(path):
        return facts
    if isinstance(content, dict):
        for key, value in content.items():
            facts.include(document(value, clean, f"{path}/{key}" if path else str(key)), "")
        covariance = content.get("covariance")
        for name in ESTIMATES:
            key = f"{path}/{name}" if path else name
            if (
                isinstance(covariance, list)
                and key in facts.arrays
                and np.shape(covariance) == 2 * facts.arrays[key].shape
            ):
                facts.sigmas[key] = np.sqrt(np.diag(np.array(covariance, dtype=float)))
        if not content:
            facts.words[path] = ["{}"]
    elif isinstance(content, list):
        try:
            array = np.array([np.nan if value is None else value for value in content])
        except ValueError:
            array = np.array(None)
        if content and array.dtype.kind in "iuf":
            facts.arrays[path] = array
        elif content and all(isinstance(value, str) for value in content):
            facts.words[path] = [clean.text(value) for value in content]
        elif not content:
            facts.words[path] = ["[]"]
        else:
            for index, value in enumerate(content):
                facts.include(document(value, clean, f"{path}/{index}"), "")
    elif isinstance(content, int | float) and not isinstance(content, bool):
        facts.arrays[path] = np.array(content)
    else:
        facts.words[path] = clean.text(str(content)).splitlines()
    return facts


def read_json(path: Path, clean: Cleaner) -> Facts:
    return document(json.loads(path.read_text("utf-8")), clean)


def read_toml(path: Path, clean: Cleaner) -> Facts:
    facts = document(tomllib.loads(path.read_text("utf-8")), clean)
    facts.words["lines"] = [
        re.sub(NUMBER, "#", line) for line in clean.text(path.read_text("utf-8")).splitlines()
    ]
    return facts


def read_npz(path: Path, clean: Cleaner) -> Facts:
    facts = Facts()
    with np.load(path, allow_pickle=False) as arrays:
        for name in arrays.files:
            if arrays[name].dtype.kind == "U" and not arrays[name].ndim:
                facts.include(document(_parsed(str(arrays[name])), clean), f"{name}/")
            else:
                facts.add(name, arrays[name])
    return facts


def read_netcdf(path: Path, clean: Cleaner) -> Facts:
    import h5py

    facts = Facts()

    def visit(name: str, item: Any) -> None:
        if clean.leaves_out(name):
            return
        for key, value in item.attrs.items():
            if isinstance(value, str | bytes):
                text = value.decode() if isinstance(value, bytes) else value
                facts.include(document(_parsed(text), clean), f"{name}@{key}/")
            elif key not in (
                "DIMENSION_LIST",
                "REFERENCE_LIST",
                "_Netcdf4Dimid",
                "_Netcdf4Coordinates",
            ):
                facts.add(f"{name}@{key}", value)
        if (
            isinstance(item, h5py.Dataset)
            and item.dtype.names is None
            and item.dtype.kind in "iufSOU"
        ):
            facts.add(name, item[()])
            values = facts.arrays.get(name)
            if values is not None and values.dtype.kind == "f" and values.ndim and len(values) > 20:
                facts.sigmas[name] = np.std(values, axis=0)

    with h5py.File(path) as file:
        visit("", file)
        file.visititems(visit)
    return facts


NUMBER = r"(?<![\w.#])[-−+]?\d+\.?\d*(?:[eE][-+]?\d+)?"


def drawing(text: str) -> Facts:
    """An SVG: everything but its numbers, and its numbers."""
    # Names of parts are hashes of their numbers.
    names = {
        name: f"part{n}"
        for n, name in enumerate(dict.fromkeys(re.findall(r"id=['\"]([a-zA-Z][0-9a-f]{10})", text)))
    }
    if names:
        text = re.sub("|".join(names), lambda found: names[found[0]], text)
    number = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?(?![0-9a-f]{6,})")
    lines = text.replace("><", ">\n<").splitlines()
    # Text stays as it is: a label with another number is another label.
    kept = re.compile(r"<!--|<text|<title|xlink:href|xmlns|id=")
    words = [line if kept.search(line) else number.sub("#", line) for line in lines]
    found = [value for line in lines if not kept.search(line) for value in number.findall(line)]
    return Facts({"numbers": np.array([float(value) for value in found])}, {}, {"lines": words})


def read_svg(path: Path, clean: Cleaner) -> Facts:
    return drawing(clean.text(path.read_text("utf-8")))


def read_page(path: Path, clean: Cleaner) -> Facts:
    """A page, its drawings for themselves."""
    facts, text = Facts(), path.read_text("utf-8")

    def take(found: re.Match[str]) -> str:
        count = sum(name.endswith("/lines") for name in facts.words) + 1
        facts.include(drawing(clean.text(found[0])), f"drawing {count}/")
        return f"[drawing {count}]"

    text = re.sub(r"<svg\b.*?</svg>", take, text, flags=re.DOTALL)
    text = re.sub(r"base64,[A-Za-z0-9+/=\s]{200,}", _digest, text)
    facts.words["lines"] = [
        clean.text(line) for line in text.replace("</tr>", "</tr>\n").splitlines()
    ]
    return facts


def _digest(found: re.Match[str]) -> str:
    content = base64.b64decode(re.sub(r"\s", "", found[0].removeprefix("base64,")))
    return f"base64,[{hashlib.sha256(content).hexdigest()[:16]}]"


def read_notebook(path: Path, clean: Cleaner) -> Facts:
    facts = document(json.loads(path.read_text("utf-8")), clean)
    facts.words = {
        name: words
        for name, words in facts.words.items()
        if not re.search(r"cells/\d+/id$|image/", name)
    }
    return facts


def read_picture(path: Path, clean: Cleaner) -> Facts:
    from PIL import Image

    with Image.open(path) as picture:
        return Facts({"pixels": np.asarray(picture).astype(float)})


def read_fits(path: Path, clean: Cleaner) -> Facts:
    from astropy.io import fits

    facts = Facts()
    with fits.open(path) as units:
        for index, unit in enumerate(units):
            facts.words[f"header {index}"] = [
                clean.text(str(card).rstrip()) for card in unit.header.cards
            ]
            if unit.data is not None and unit.data.dtype.names is None:
                facts.arrays[f"data {index}"] = np.asarray(unit.data, dtype=float)
            elif unit.data is not None:
                facts.include(
                    table(list(unit.data.names), [unit.data[n] for n in unit.data.names], clean),
                    f"{index} ",
                )
    return facts


def read_lines(path: Path, clean: Cleaner) -> Facts:
    return Facts(
        words={"lines": clean.text(path.read_bytes().decode("utf-8", "replace")).splitlines()}
    )


def read_terminal(path: Path, clean: Cleaner) -> Facts:
    """What a command printed; a document of --json by its keys."""
    text = path.read_text("utf-8")
    head, end, tail = text.partition("\n\n{")
    body, split, errors = tail.partition("\n--- standard error\n")
    if not end or not split:
        return read_lines(path, clean)
    facts = Facts(words={"lines": clean.text(f"{head}\n{errors}").splitlines()})
    try:
        facts.include(document(json.loads("{" + body), clean), "document ")
    except ValueError:
        return read_lines(path, clean)
    return facts


READERS: dict[str, Callable[[Path, Cleaner], Facts]] = {
    ".csv": read_csv,
    ".parquet": read_parquet,
    ".json": read_json,
    ".covariance": read_json,
    ".toml": read_toml,
    ".npz": read_npz,
    ".nc": read_netcdf,
    ".netcdf": read_netcdf,
    ".arviz": read_netcdf,
    ".svg": read_svg,
    ".html": read_page,
    ".ipynb": read_notebook,
    ".png": read_picture,
    ".fits": read_fits,
}


def read(path: Path, clean: Cleaner) -> Facts:
    """The facts of a file."""
    if path.parent.name == "terminal":
        return read_terminal(path, clean)
    return READERS.get(path.suffix, read_lines)(path, clean)
