"""All sentences: templates by the codes of findings and the names of results.

The ``.toml`` files beside this module are the table. Jinja fills the templates with facts; white
space is worth one blank, and a pilcrow ends a line. A code that is added needs a template there, and
nothing else that knows words.
"""

from __future__ import annotations

import re
import shlex
import tomllib
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from functools import cache, partial
from importlib.resources import files
from itertools import compress
from pathlib import Path
from types import ModuleType
from typing import Any

import jinja2
import numpy as np
from jinja2.bccache import Bucket

from starcal_uq.attitude.earth import DENSITY_SPREAD
from starcal_uq.budgeting.rows import AXIS_LABELS, confidence_text
from starcal_uq.calibration.fallback import fallback_facts
from starcal_uq.core import formatting
from starcal_uq.core.conflicts import words_of
from starcal_uq.core.constants import AXES
from starcal_uq.core.files import default_cache_dir
from starcal_uq.core.findings import Finding
from starcal_uq.core.provenance import installed_version
from starcal_uq.core.remedy import RUN, Remedy
from starcal_uq.core.status import Check, Level
from starcal_uq.core.times import TIMES_IN_NAMES
from starcal_uq.core.types import AnyMapping
from starcal_uq.diagnostics.validation.result import ENOUGH_REPLICATES
from starcal_uq.diagnostics.verdict.draws import propagation_difference
from starcal_uq.diagnostics.verdict.estimate import JACKKNIFE_P, model_facts, star_facts
from starcal_uq.estimation.merging import ALPHA
from starcal_uq.inference.checks import COMPRESSED_BOUND
from starcal_uq.inference.power_scaling import CONFLICT, WEAK
from starcal_uq.planning.open_distortion import AFTER_FRAMES
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words import axes, numbers
from starcal_uq.propagation.coupling import COUPLED
from starcal_uq.propagation.onboard_error import with_cross
from starcal_uq.studies.findings import place_of

# Radii that differ by less than this over the open distortion hardly matter.
LITTLE = 1.2
SCOPE_NAMES = {
    "common": "common rotation",
    "rest": "rest of the calibration",
    "calibration": "calibration",
    "total": "calibration and centroid noise",
}


# In place of the pilcrows of templates: texts that people write may hold these.
_END = "\x1e"
# What an entry for a table has beside the cells of its columns.
_OF_TABLES = ("title", "align", "mark")


class _Absent(jinja2.StrictUndefined):
    """A fact that is not there: false in a condition, an error where it would be printed."""

    def __bool__(self) -> bool:  # type: ignore[override]
        return False


class CompiledTemplates(jinja2.FileSystemBytecodeCache):
    """Compiled templates in the cache folder: compiling those of a report takes 0.3 s.

    They only save time: without the folder everything works.
    """

    def __init__(self) -> None:
        version = installed_version("starcal_uq")
        super().__init__(str(default_cache_dir() / f"templates-{version}"))

    def load_bytecode(self, bucket: Bucket) -> None:
        """Load a template; one that is damaged is compiled again."""
        with suppress(Exception):
            super().load_bytecode(bucket)

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Keep a template where the folder can be written to."""
        with suppress(OSError):
            Path(self.directory).mkdir(parents=True, exist_ok=True)
            super().dump_bytecode(bucket)


@cache
def _entries() -> dict[str, Any]:
    """What the files hold by ``Table.NAME``."""
    paths = files("starcal_uq.presentation.words").iterdir()
    return {
        f"{kind}.{name}": entry
        for path in paths
        if path.name.endswith(".toml")
        for kind, entries in tomllib.loads(path.read_text("utf-8")).items()
        for name, entry in entries.items()
    }


@cache
def templates() -> dict[str, str]:
    """Templates by ``Table.NAME``; of a check, value, bound and sentence as three lines, of a table
    mark and cells as lines, and title and heads as those of ``Heads.NAME``.
    """
    found = {}
    for name, entry in _entries().items():
        kind, _, table = name.partition(".")
        parts = [entry] if isinstance(entry, str) else [*entry.values()]
        if kind == "Rows":
            parts = [entry.get("title", "")]
        if kind == "Table":
            cells = {head: text for head, text in entry.items() if head not in _OF_TABLES}
            parts = [entry.get("mark", ""), *cells.values()]
            found[f"Heads.{table}"] = _END.join([entry.get("title", ""), *cells])
        found[name] = "¶".join(parts).replace("¶", _END)
    return found


def functions(module: ModuleType) -> dict[str, Callable[..., Any]]:
    """What a module makes, for templates."""
    own = (
        one for one in vars(module).values() if getattr(one, "__module__", "") == module.__name__
    )
    return {one.__name__: one for one in own if not one.__name__.startswith("_")}


@cache
def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.DictLoader(templates()),
        undefined=_Absent,
        extensions=["jinja2.ext.do"],
        bytecode_cache=CompiledTemplates(),
    )
    own: dict[str, Callable[..., Any]] = {
        **functions(formatting),
        **functions(axes),
        **functions(numbers),
        "all_finite": lambda values: bool(np.isfinite(values).all()),
        "some_finite": lambda values: bool(np.isfinite(values).any()),
        "brief": _brief,
        "confidence_text": confidence_text,
        "largest": lambda values: int(np.argmax(np.abs(values))),
        "exp": np.exp,
        "mean": np.mean,
        "place_of": place_of,
        "median": np.median,
        "repr": repr,
        "spoken": lambda name: name.replace("_", " "),
        "typed": lambda options: shlex.join(words_of(options)),
    }
    environment.filters |= own
    known: list[Any] = [Counter, fallback_facts, model_facts, propagation_difference]
    known += [say, star_facts, with_cross]
    environment.globals |= {one.__name__: one for one in known}
    environment.globals |= {
        "AFTER_FRAMES": AFTER_FRAMES,
        "ALPHA": ALPHA,
        "AXES": AXES,
        "AXIS_LABELS": AXIS_LABELS,
        "COMPRESSED_BOUND": COMPRESSED_BOUND,
        "COUPLED": COUPLED,
        "CONFLICTS": (CONFLICT, WEAK),
        "DENSITY_SPREAD": DENSITY_SPREAD,
        "ENOUGH_REPLICATES": ENOUGH_REPLICATES,
        "JACKKNIFE_P": JACKKNIFE_P,
        "LITTLE": LITTLE,
        "SCOPE_NAMES": SCOPE_NAMES,
        "TIMES_IN_NAMES": TIMES_IN_NAMES,
        "diagnose": Remedy("diagnose", (RUN,)),
        "infinity": np.inf,
    }
    return environment


def _lines(name: str, facts: AnyMapping) -> list[str]:
    lines = _environment().get_template(name).render(facts).split(_END)
    return [re.sub("[ \n]+", " ", line).strip(" ") for line in lines]


def say(name: str, /, **facts: Any) -> str:
    """The text of a template, as ``Result.camera``, with these facts.

    Raises
    ------
    LookupError
        Where no template has this name.
    """
    return "\n".join(filter(None, _lines(name, facts)))


def table(
    name: str, given: AnyMapping | None = None, without: Collection[str] = (), /, **columns: Any
) -> TextTable:
    """A table by its name, a row for each entry of the columns, which give facts to its cells as
    those that are `given` do to all; the columns under the heads `without` are left out.
    """
    given = given or {}
    title, *heads = _lines(f"Heads.{name}", given)
    rows: Iterable[tuple[Any, ...]] = zip(*columns.values(), strict=True)
    filled = [
        _lines(f"Table.{name}", {**given, **dict(zip(columns, row, strict=True))}) for row in rows
    ]
    kept = [head not in without for head in heads]
    align = _entries()[f"Table.{name}"].get("align", "l" + "r" * (len(heads) - 1))
    return TextTable(
        tuple(compress(heads, kept)),
        tuple(tuple(compress(cells, kept)) for _, *cells in filled),
        title,
        "".join(compress(align, kept)),
        tuple(mark for mark, *_ in filled) if any(mark for mark, *_ in filled) else (),
    )


def rows(name: str, it: Any, first: int | None = None) -> TextTable:
    """A table of a result's data frame, by its name in the table; the first rows alone if so asked."""
    entry = _entries()[f"Rows.{name}"]
    frame = getattr(it, entry.get("frame", "to_dataframe"))
    frame = frame() if callable(frame) else frame
    columns = entry.get("columns", [*frame])
    heads = columns if isinstance(columns, dict) else dict(zip(columns, columns, strict=True))
    instead = entry.get("instead", {})
    shown = {
        old: new for old, new in heads.items() if old in frame and instead.get(old) not in frame
    }
    forms = {
        heads[column]: partial(_filled, text) for column, text in entry.get("forms", {}).items()
    }
    return TextTable.of(
        frame[[*shown]].head(first or entry.get("first", len(frame))).rename(columns=shown),
        say(f"Rows.{name}", it=it, first=first or entry.get("first")),
        formats=forms,
        missing=entry.get("missing", "–"),
    )


def _filled(text: str, value: Any) -> str:
    return _environment().from_string(text).render(it=value)


def told(name: str, it: object, /, **facts: Any) -> str:
    """A text about a result, by its name in the table; empty where there is no result."""
    return "" if it is None else say(f"Result.{name}", it=it, **facts)


def _brief(finding: Finding) -> str:
    """What is wrong by a note, in few words; empty where nothing is."""
    name = f"Brief.{finding.code.name}"
    return say(name, **finding.values) if name in templates() else ""


def wording(finding: Finding) -> Any:
    """The sentence of a finding; of a check value, bound and sentence."""
    name = f"{type(finding.code).__name__}.{finding.code.name}"
    if isinstance(finding, Check):
        good = finding.level is Level.PASS
        return tuple(say(name, good=good, **finding.values, **finding.bounds).split("\n", 2))
    return say(name, **finding.values)
