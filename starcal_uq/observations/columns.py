"""The columns of an observations table: one list for the table, its files and its checks."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class Column:
    """One column of the table, as it is called in files, with its unit (or none) and content in
    words.

    `required` columns are in every table; with `gaps`, single values may be missing (NaN, or an
    empty text).
    """

    name: str
    description: str
    kind: Literal["whole", "number", "text", "time"] = "number"
    unit: str = ""
    required: bool = False
    gaps: bool = False


COLUMNS = {
    name: Column(name, **entry)
    for name, entry in tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8")).items()
}
