"""The user's part of a budget: contributors that no calibration knows, and requirements, from a
TOML file.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from starcal_uq.attitude.heads import ROTATION, stated_rotation
from starcal_uq.budgeting.behaviour import KEYS as TIME_KEYS
from starcal_uq.budgeting.behaviour import Behaviour, load_series, load_spectrum
from starcal_uq.budgeting.indices import NAMES, Behaviours, Index
from starcal_uq.budgeting.rows import (
    ABSORBED,
    DISTRIBUTIONS,
    ECSS_CLASSES,
    FROM_FILE,
    FROM_POSTERIOR,
    INTERACTING,
    INTERPRETATIONS,
    OF_EFFECTS,
    PARTS,
    SCOPES,
    Contributor,
    Expected,
)
from starcal_uq.budgeting.shapes import HALF_WIDTHS, RAYLEIGH_MEAN
from starcal_uq.core.constants import AXES, CROSS_BORESIGHT
from starcal_uq.core.errors import BudgetError, SensorError
from starcal_uq.core.files import listed
from starcal_uq.core.remedy import RUN, Remedy
from starcal_uq.core.settings import KEYS
from starcal_uq.core.toml import Key, Section, keys_of, read_toml
from starcal_uq.core.types import AnyDict, AnyMapping, FloatArray, PathLike
from starcal_uq.simulation.sensor import Sensor

# As people write them: X and Y are across the boresight, Z is along it.
_AXIS_NAMES = {
    **{name: (name,) for name in AXES},
    **{letter: (name,) for letter, name in zip("xyz", AXES, strict=True)},
    CROSS_BORESIGHT: AXES[:2],
    "all": AXES,
}

_REQUIREMENT_AXES = {key: names for key, names in _AXIS_NAMES.items() if key != "all"}
# What the starter's names bring along, and nobody can guess for others.
_OWN_KEYS = ("ecss_class", "interpretation", "absorbed_by_alignment")
_OWN = Expected("", "other", "ensemble")
# What a file may state by name alone.
_STATED = (*FROM_FILE, *OF_EFFECTS.values())
# Names as similar as this are one name mistyped.
_SAME_NAME = 0.9
JUDGED_BY = ("both", "rule", "sampling")

# What may stand in the tables, but for words of a list.
_KEYS = {
    name: keys_of(table)
    for name, table in tomllib.loads(
        Path(__file__).with_name("keys.toml").read_text("utf-8")
    ).items()
}
BUDGET_KEYS = _KEYS["budget"]
CONTRIBUTOR_KEYS = {
    **_KEYS["contributor"],
    "ecss_class": Key.choice(ECSS_CLASSES),
    "axis": Key.choice(tuple(_AXIS_NAMES), required=True),
    "distribution": Key.choice(DISTRIBUTIONS),
    "interpretation": Key.choice(INTERPRETATIONS),
    "absorbed_by_alignment": Key.choice(ABSORBED),
    "part": Key.choice(PARTS),
    **_KEYS["behaviour"],
}
BEHAVIOUR_KEYS = {
    "name": _KEYS["contributor"]["name"],
    "axis": Key.choice(tuple(_AXIS_NAMES)),
    **_KEYS["behaviour"],
}
INDEX_KEYS = {"kind": Key.choice(NAMES, required=True), **_KEYS["times"]}
REQUIREMENT_KEYS = {
    **_KEYS["requirement"],
    "axis": Key.choice(tuple(_REQUIREMENT_AXES), required=True),
    "scope": Key.choice(SCOPES),
    "interpretation": Key.choice(INTERPRETATIONS),
    "judged_by": Key.choice(JUDGED_BY),
    "index": Key.choice(NAMES),
    **_KEYS["times"],
}
SENSOR = "sensor"
_FRAME = Section({"rotation": ROTATION}, BudgetError)
_HEAD, _DOCUMENT, _CONTRIBUTOR, _REQUIREMENT, _BEHAVIOUR, _INDEX = (
    Section(keys, BudgetError)
    for keys in (
        *(BUDGET_KEYS, _KEYS["document"], CONTRIBUTOR_KEYS),
        *(REQUIREMENT_KEYS, BEHAVIOUR_KEYS, INDEX_KEYS),
    )
)
_LISTS = ("contributor", "behaviour", "index", "requirement")
# Distributions of errors that behave so in time, unless the file states another.
_SHAPES = {"periodic": "arcsine", "drift": "uniform"}
# Keys of earlier versions, and why to delete them.
_GONE = {"time_class": "interpretation alone decides how a row is combined"}


@dataclass(frozen=True)
class Requirement:
    """A limit for a total.

    Attributes
    ----------
    name : str
        Number or title.
    axis : str
        ``pitch``, ``yaw``, ``roll`` or ``cross-boresight`` (the angle of both axes together).
    limit_arcsec : float
        Limit of the error, arcsec.
    confidence : float
        For this share of all cases.
    scope : str
        ``before alignment`` or ``after alignment`` calibration.
    interpretation : str
        Cases of what: ``mixed``, ``ensemble`` or ``temporal``.
    judged_by : str
        ``rule``, ``sampling``, or ``both``: the larger of the two bounds.
    frame : str
        Frame whose axes are meant: ``sensor``, or one that the file names.
    index : str
        Error index that is limited, one of `starcal_uq.budgeting.indices.NAMES`.
    window_seconds, stability_seconds : float
        Times of the index, as of an `Index`; NaN where it has none.
    """

    name: str
    axis: str
    limit_arcsec: float
    confidence: float
    scope: str = SCOPES[1]
    interpretation: str = "mixed"
    judged_by: str = "both"
    frame: str = SENSOR
    index: str = "AKE"
    window_seconds: float = math.nan
    stability_seconds: float = math.nan

    @property
    def limited(self) -> Index:
        """The index with its times."""
        return Index(self.index, self.window_seconds, self.stability_seconds)


@dataclass(frozen=True)
class BudgetFile:
    """Contents of a budget file.

    Attributes
    ----------
    contributors : tuple of Contributor
        One per contributor and axis.
    requirements : tuple of Requirement
        In the order of the file.
    title : str
        Title of the budget.
    confidence : float or None
        Probability of the totals; None to leave it to the caller.
    path : str
        Path that it was read from.
    frames : dict of str to (3, 3) array
        Rotations R of the frames that requirements may name, with v_frame = R v_sensor.
    indices : tuple of Index
        Error indices to be shown beside the totals.
    behaviours : dict
        Behaviour in time by name and axis of a contributor.
    frame_seconds, rate_deg_s : float or None
        Time between frames, s; angular rate of the sensor, deg/s. None where not stated.
    document : dict of str
        Title block of the budget to sign: project, number, issue, prepared, checked, approved.
    sensor : Sensor or None
        The sensor, whose rate and age fill rows.
    sensor_path : str
        Path that it was read from.
    """

    contributors: tuple[Contributor, ...] = field(default=())
    requirements: tuple[Requirement, ...] = field(default=())
    title: str = ""
    confidence: float | None = None
    path: str = ""
    frames: Mapping[str, FloatArray] = field(default_factory=dict)
    indices: tuple[Index, ...] = field(default=())
    behaviours: Behaviours = field(default_factory=dict)
    frame_seconds: float | None = None
    rate_deg_s: float | None = None
    document: Mapping[str, str] = field(default_factory=dict)
    sensor: Sensor | None = None
    sensor_path: str = ""


def stated_in(file: BudgetFile | PathLike | None) -> BudgetFile:
    """A budget file that is read already, that of a path, or none, which states nothing."""
    if file is None:
        return BudgetFile()
    return file if isinstance(file, BudgetFile) else load_budget_file(file)


def _read(data: Any, where: str, section: Section) -> AnyDict:
    """Checked values of one table, texts without the space around them."""
    if not isinstance(data, Mapping):
        raise BudgetError(
            f"{where}: is no table; write {listed([f'[[{name}]]' for name in _LISTS])} above its "
            "keys."
        )
    for key in data:
        if key in _GONE:
            raise BudgetError(
                f"{where}: key {key} is no longer read, because {_GONE[key]}; delete the line."
            )
    values = section.check(data, where)
    if "confidence" in values:
        checked_confidence(values["confidence"], f"{where}: key confidence")
    return {
        key: value.strip() if isinstance(value, str) else value for key, value in values.items()
    }


def checked_confidence(value: float, where: str) -> float:
    """A confidence between 0 and 1, or a `BudgetError`."""
    if not KEYS["probability"].holds(value):
        hint = f"; write {value / 100:g} for {value:g} %" if 1.0 < value < 100.0 else ""
        raise BudgetError(
            f"{where} is {value!r}, but a confidence lies between 0 and 1, such as 0.997{hint}."
        )
    return value


def load_budget_file(path: PathLike, others: Sequence[str] = ()) -> BudgetFile:
    """Read and check a budget file, in which `others` may stand as well.

    Raises
    ------
    BudgetError
        If it cannot be read, or a key is unknown, missing or wrong; the sentence names file, table
        and key.
    """
    starter = Remedy("budget", (RUN,), {"template": "FILE"})
    missing = f"check the path, or write a starter with `{starter.words}`"
    content = read_toml(path, "budget", BudgetError, missing)
    for key in content:
        if key not in ("budget", "document", "frame", *_LISTS, *others):
            raise BudgetError(
                f"{path}: {key} is not known; write [budget], [document], [frame.NAME], "
                f"{listed([f'[[{name}]]' for name in _LISTS])} tables only."
            )
    frames = _frames(content.get("frame", {}), path)
    head = _read(content.get("budget", {}), f"{path}, [budget]", _HEAD)
    if "sensor" in head:
        head["sensor_path"] = str(Path(path).parent / head["sensor"])
        try:
            head["sensor"] = Sensor.load(head["sensor_path"])
        except SensorError as error:
            raise BudgetError(f"{path}, [budget], key sensor: {error}") from None
    rows: list[Contributor] = []
    behaviours: dict[tuple[str, str], Behaviour] = {}
    for table, where in _tables(content, "contributor", path):
        found, behaviour = _contributor(table, where, Path(path).parent)
        rows += found
        if behaviour is not None:
            behaviours |= {(row.name, row.axis): behaviour for row in found}
    for table, where in _tables(content, "behaviour", path):
        behaviours |= _of_known(table, where, Path(path).parent)
    indices = tuple(
        _index(_read(table, where, _INDEX), where)
        for table, where in _tables(content, "index", path)
    )
    _no_doubles([(row.name, row.axis) for row in rows], f"{path}: contributor")
    asked: AnyDict = {"confidence": 0.997} | head
    requirements = tuple(
        _requirement(table, where, asked["confidence"], tuple(frames))
        for table, where in _tables(content, "requirement", path)
    )
    _no_doubles([(requirement.name,) for requirement in requirements], f"{path}: requirement")
    return BudgetFile(
        contributors=tuple(rows),
        requirements=requirements,
        title=head.pop("title", ""),
        path=str(path),
        frames=frames,
        indices=indices,
        behaviours=behaviours,
        document=_read(content.get("document", {}), f"{path}, [document]", _DOCUMENT),
        **head,
    )


def _index(table: AnyMapping, where: str) -> Index:
    try:
        return Index(**table)
    except BudgetError as error:
        raise BudgetError(f"{where}: {error}") from None


def _behaviour(table: AnyMapping, where: str, folder: Path) -> Behaviour | None:
    """The behaviour in time that a table states; files are beside the budget file."""
    stated = [(kind, key) for kind, key in TIME_KEYS.items() if key in table]
    if len(stated) > 1:
        raise BudgetError(
            f"{where}: keys {stated[0][1]} and {stated[1][1]} both state a behaviour in time; "
            "write one."
        )
    for kind, key in stated:
        if kind == "spectrum":
            return load_spectrum(folder / table[key])
        return load_series(folder / table[key]) if kind == "series" else Behaviour(kind, table[key])
    return None


def _of_known(data: Any, where: str, folder: Path) -> dict[tuple[str, str], Behaviour]:
    """Behaviour of rows that the calibration fills."""
    table = _read(data, where, _BEHAVIOUR)
    behaviour = _behaviour(table, where, folder)
    if behaviour is None:
        raise BudgetError(
            f"{where}: no key states a behaviour in time; write one of "
            f"{listed(list(TIME_KEYS.values()))}."
        )
    name, close = _known_name(table["name"])
    if name not in {entry.name for entry in (*_STATED, *FROM_POSTERIOR, INTERACTING)}:
        hint = f"did you mean {close!r}? " if close else ""
        raise BudgetError(
            f"{where}: key name: {hint}The budget has no such row of its own; state the behaviour "
            "of yours in its [[contributor]]."
        )
    return {(name, axis): behaviour for axis in _AXIS_NAMES[table.get("axis", "all")]}


def _frames(tables: Any, path: PathLike) -> dict[str, FloatArray]:
    """Rotations by frame: a matrix, or a quaternion with its scalar last."""
    if not isinstance(tables, Mapping) or not all(
        isinstance(table, Mapping) for table in tables.values()
    ):
        raise BudgetError(f"{path}: frame needs a name; write [frame.payload] above its rotation.")
    frames = {}
    for name, data in tables.items():
        where = f"{path}, [frame.{name}]"
        table = _read(data, where, _FRAME)
        if name == SENSOR:
            raise BudgetError(f"{where}: this is the frame of the rows; give yours another name.")
        words = f"v_{name} = R v_sensor"
        frames[name] = stated_rotation(table["rotation"], where, words, BudgetError)
    return frames


def _tables(content: AnyMapping, key: str, path: PathLike) -> Iterator[tuple[Any, str]]:
    """The tables of one kind, and how messages call each: by its number and name."""
    found = content.get(key, [])
    if not isinstance(found, list):
        raise BudgetError(
            f"{path}: [{key}] must be written with two brackets, [[{key}]], because there may be "
            "several."
        )
    for number, table in enumerate(found, start=1):
        name = table.get("name") if isinstance(table, Mapping) else None
        named = f" ({name.strip()!r})" if isinstance(name, str) and name.strip() else ""
        yield table, f"{path}, [[{key}]] {number}{named}"


def _no_doubles(names: Sequence[tuple[str, ...]], where: str) -> None:
    for index, name in enumerate(names):
        if name in names[:index]:
            shown = ", axis ".join(name)
            raise BudgetError(
                f"{where} {shown} is stated twice; keep one, or give them different names."
            )


def _contributor(data: Any, where: str, folder: Path) -> tuple[list[Contributor], Behaviour | None]:
    table = _read(data, where, _CONTRIBUTOR)
    name, close = _known_name(table["name"])
    if name in {entry.name for entry in (*FROM_POSTERIOR, INTERACTING)}:
        raise BudgetError(
            f"{where}: key name: this row is filled by the posterior; give yours another name, "
            "or propagate over other "
            "frames."
        )
    known = {entry.name: entry for entry in _STATED}.get(name)
    if known is None:
        _check_own(table, where, name, close)
    stated: AnyDict = {
        key: table[key]
        for key in ("correlation_group", "conditions", "provenance", "applies", "part")
        if key in table
    }
    behaviour = _behaviour(table, where, folder)
    shape = _SHAPES.get("" if behaviour is None else behaviour.kind)
    for key in ("distribution", *_OWN_KEYS):
        usual = shape if key == "distribution" and shape else getattr(known or _OWN, key)
        stated[key] = table.get(key, usual)
    if not table.get("applies", True):
        mean, sigma = 0.0, 0.0
    elif behaviour is not None and not math.isnan(behaviour.sigma_arcsec):
        mean, sigma = _measured(table, where, behaviour)
    else:
        mean, sigma = _moments(table, where, stated["distribution"])
    rows = [
        Contributor(
            name=name, axis=axis, mean_arcsec=mean, sigma_arcsec=sigma, source="file", **stated
        )
        for axis in _AXIS_NAMES[table["axis"]]
    ]
    return rows, behaviour


def _measured(table: AnyDict, where: str, behaviour: Behaviour) -> tuple[float, float]:
    """Mean and standard deviation of a spectrum or a time series."""
    for key in ("sigma_arcsec", "half_width_arcsec"):
        if key in table:
            raise BudgetError(
                f"{where}: key {key}: the {behaviour.kind} states the size; delete the line."
            )
    return table.get("mean_arcsec", behaviour.mean_arcsec), behaviour.sigma_arcsec


def _known_name(written: str) -> tuple[str, str]:
    """The name as the starter has it, whatever its case; else as written, with the most similar one
    of the starter.
    """
    names = {entry.name.lower(): entry.name for entry in (*_STATED, *FROM_POSTERIOR, INTERACTING)}
    plain = " ".join(written.lower().split())
    if plain in names:
        return names[plain], ""
    close = difflib.get_close_matches(plain, names, n=1)
    return written, names[close[0]] if close else ""


def _check_own(table: AnyDict, where: str, name: str, close: str) -> None:
    """Refuse a mistyped name of the starter, and a contributor of the user's own that leaves out
    what it is.
    """
    similar = (
        difflib.SequenceMatcher(None, close.lower(), " ".join(name.lower().split())).ratio()
        if close
        else 0.0
    )
    if similar >= _SAME_NAME:
        raise BudgetError(
            f"{where}: key name: did you mean {close!r}? Write that, or a name of your own that "
            "differs more."
        )
    missing = [key for key in _OWN_KEYS if key not in table]
    if missing and table.get("applies", True):
        hint = f"did you mean {close!r}? " if close else ""
        raise BudgetError(
            f"{where}: {hint}The starter has no such name, and a contributor of your own must "
            "state "
            f"{', '.join(missing)} as well."
        )


def _moments(table: AnyDict, where: str, distribution: str) -> tuple[float, float]:
    """Mean and standard deviation as the file states them."""
    stated = [key for key in ("sigma_arcsec", "half_width_arcsec") if key in table]
    if distribution == "constant":
        if stated:
            raise BudgetError(
                f"{where}: key {stated[0]}: a constant has no spread; give mean_arcsec alone."
            )
        if "mean_arcsec" not in table:
            raise BudgetError(
                f"{where}: key mean_arcsec is missing; add the number of arcsec that is always "
                "there."
            )
        return table["mean_arcsec"], 0.0
    if len(stated) != 1:
        what = "is missing" if not stated else "and half_width_arcsec are both given"
        raise BudgetError(
            f"{where}: key sigma_arcsec {what}; write either sigma_arcsec or half_width_arcsec."
        )
    value = table[stated[0]]
    if stated[0] == "half_width_arcsec":
        if distribution not in HALF_WIDTHS:
            raise BudgetError(
                f"{where}: key half_width_arcsec: a {distribution} error has no end; write "
                "sigma_arcsec, or "
                "distribution = 'uniform' or 'arcsine'."
            )
        value /= HALF_WIDTHS[distribution]
    return table.get(
        "mean_arcsec", RAYLEIGH_MEAN * value if distribution == "rayleigh" else 0.0
    ), value


def _requirement(data: Any, where: str, confidence: float, frames: tuple[str, ...]) -> Requirement:
    table: AnyDict = {"confidence": confidence} | _read(data, where, _REQUIREMENT)
    frame = table.get("frame", SENSOR)
    if frame not in (SENSOR, *frames):
        raise BudgetError(
            f"{where}: key frame is {frame!r}, which no table of the file describes; write "
            f"[frame.{frame}] with its "
            "rotation."
        )
    axis = table.pop("axis")
    asked = Requirement(
        axis=axis if axis == CROSS_BORESIGHT else _REQUIREMENT_AXES[axis][0], **table
    )
    times = {name: table[name] for name in _KEYS["times"] if name in table}
    _index({"kind": asked.index, **times}, where)
    return asked
