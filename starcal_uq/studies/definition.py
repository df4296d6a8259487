"""What a study is: a base camera and observation, what is varied around them, and how cells are
counted.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import Any, TypeVar, get_args

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import COEFFICIENTS, PARAMETERS, parameter_names
from starcal_uq.core.display import public_names
from starcal_uq.core.errors import PriorError, StarcalError, StudyError, check_known
from starcal_uq.core.files import atomic_write_text, ensure_new, shown
from starcal_uq.core.records import hash_of
from starcal_uq.core.remedy import Remedy
from starcal_uq.core.settings import KEYS, LIMITS, StudyTemplate
from starcal_uq.core.toml import Key, Section, keys_of, read_toml, unknown_key
from starcal_uq.core.types import AnyDict, AnyMapping, PathLike
from starcal_uq.inference.priors import PRIORS
from starcal_uq.simulation.exclusion import Exclusion
from starcal_uq.simulation.sensor import Sensor
from starcal_uq.studies.axes import (
    AXES,
    EFFECT_AXES,
    EXCLUSIVE,
    FLAT,
    NOISE_AXES,
    SENSOR_AXES,
    base_settings,
    camera_of,
)

T = TypeVar("T", Camera, Sensor)
MODES = ("fisher", "simulate")
POSTERIORS = ("importance", "ensemble", "none")
# One of each, in the order in which a reader would try them.
TEMPLATES = get_args(StudyTemplate)
MAX_CELLS = int(KEYS["values"].high)
# Changes whenever the same settings would give other numbers: results from before are then computed
# anew.
VERSION = 1
_SECTIONS = ("study", "camera", "sensor", "observation", "sweep", "priors")
_SPACINGS = ("linear", "log")

_DECLARED = tomllib.loads(Path(__file__).with_name("study.toml").read_text("utf-8"))
_STUDY = Section(keys_of(_DECLARED["keys"]), StudyError)
_SPAN = keys_of(_DECLARED["span"])
_RANGE = {name: key for name, key in _SPAN.items() if name != "n"}


@dataclass(frozen=True)
class Cell:
    """One combination of settings, the value of every axis that has one; another seed is another
    sky, other noise.
    """

    settings: AnyDict
    seed_index: int


@dataclass(frozen=True, eq=False)
class StudyDefinition:
    """Definition of a study: the varied settings, the base case, and the repetitions.

    Attributes
    ----------
    camera : Camera
        Base camera.
    sweep : dict
        Values of each axis of the grid, which is their product.
    observation : dict
        Base values of the axes that are not varied.
    latin : dict
        Ranges of the axes of a Latin hypercube: ``start``, ``stop`` and ``spacing``; each of its
        points is combined with the grid.
    latin_n : int
        Points of the hypercube.
    priors : dict
        Named prior sets: entries as of a ``[priors]`` table, of which those that are given count.
    name, question : str
        Title, and what a reader wants to know.
    mode : {"fisher", "simulate"}
        Information of the frames, or frames drawn, calibrated and sampled.
    seeds : tuple of int
        Repetitions of every combination.
    seed : int
        Root of all that is random.
    target_arcsec : float or None
        Error that is aimed at: the frame-dependent one, 1 sigma per axis across the boresight.
    target_sigma : dict
        Errors of single parameters that are aimed at, px units.
    epoch : float
        Julian year of the star positions.
    geometries : int
        Frames at random attitudes that campaigns are drawn from, at most.
    posterior : {"importance", "ensemble", "none"}
        Sampling of a simulated cell: by importance around the Laplace approximation, or by one
        ensemble of emcee.
    draws : int
        Draws of a simulated cell.
    sensor : Sensor or None
        What centroid noise follows from, in place of ``sigma_px``, and exclusion.
    time_utc : str or None
        When Sun and Moon are where the sensor excludes them.
    position_km : list of float or None
        The spacecraft from the Earth's centre, ICRS axes, km, where the sensor excludes the Earth.
    """

    __dir__ = public_names

    camera: Camera
    sweep: dict[str, tuple[Any, ...]]
    observation: AnyDict = field(default_factory=dict)
    latin: dict[str, AnyDict] = field(default_factory=dict)
    latin_n: int = 0
    priors: dict[str, AnyDict] = field(default_factory=dict)
    name: str = "Study"
    question: str = ""
    mode: str = "fisher"
    seeds: tuple[int, ...] = (0,)
    seed: int = 0
    target_arcsec: float | None = None
    target_sigma: dict[str, float] = field(default_factory=dict)
    epoch: float = 2026.9
    geometries: int = 300
    posterior: str = "importance"
    draws: int = 1000
    sensor: Sensor | None = None
    time_utc: str | None = None
    position_km: list[float] | None = None

    @classmethod
    def load(cls, path: PathLike) -> StudyDefinition:
        """Read a STUDY.toml.

        Raises
        ------
        StudyError
            If the file cannot be read or makes no sense; the message names file, key and remedy.
        """
        remedy = f"write one with `{Remedy('new study').words}`"
        return cls.from_dict(
            read_toml(path, "study", StudyError, remedy), str(path), Path(path).parent
        )

    @classmethod
    def from_dict(
        cls, content: AnyMapping, where: str = "study", folder: Path | None = None
    ) -> StudyDefinition:
        """A definition from the tables of a STUDY.toml; `folder` is where a camera's path starts
        from.

        Raises
        ------
        StudyError
            If they make no sense; the message names key and remedy.
        """
        for name, table in content.items():
            if name not in _SECTIONS:
                raise StudyError(
                    f"{where}: {unknown_key(name, _SECTIONS).replace('key', 'section', 1)}."
                )
            if not isinstance(table, Mapping):
                raise StudyError(f"{where}: {name} is no section; write [{name}] above its keys.")
        study = _STUDY.check(content.get("study", {}), f"{where}, section [study]")
        camera = _part(Camera, "camera", content, study.pop("camera", None), where, folder)
        sensor = _part(Sensor, "sensor", content, study.pop("sensor", None), where, folder)
        if camera is None:
            raise StudyError(
                f'{where}: the camera is missing; write a section [camera], or camera = "camera.toml" '
                "in [study]."
            )
        sweep, latin, latin_n = _swept(dict(content.get("sweep", {})), f"{where}, section [sweep]")
        given = _observation(content.get("observation", {}), f"{where}, section [observation]")
        priors = {
            name: _prior(name, table, where) for name, table in content.get("priors", {}).items()
        }
        seeds = study.pop("seeds", 1)
        if isinstance(seeds, int) and not KEYS["seeds"].holds(seeds):
            wanted = KEYS["seeds"].wanted().replace("give", "write", 1)
            raise StudyError(
                f"{where}, section [study]: key seeds is {shown(seeds)}; {wanted}, or a list of "
                "them."
            )
        study["seeds"] = tuple(range(seeds)) if isinstance(seeds, int) else tuple(seeds)
        made = cls(
            camera=camera,
            sweep=sweep,
            observation=given,
            latin=latin,
            latin_n=latin_n,
            priors=priors,
            sensor=sensor,
            **study,
        )
        made.check(where)
        return made

    def to_dict(self) -> AnyDict:
        """The tables of a STUDY.toml, as `from_dict` reads them."""
        plain = ("name", "question", "mode", "seed", "epoch", "geometries", "posterior", "draws")
        study: AnyDict = {name: getattr(self, name) for name in plain} | {"seeds": list(self.seeds)}
        if self.target_arcsec is not None:
            study["target_arcsec"] = self.target_arcsec
        if self.target_sigma:
            study["target_sigma"] = self.target_sigma
        sweep: AnyDict = {name: list(values) for name, values in self.sweep.items()}
        if self.latin:
            sweep["latin"] = {"n": self.latin_n, **self.latin}
        tables = {
            "study": study,
            "camera": self.camera.to_dict(),
            "observation": self.observation,
            "sweep": sweep,
        }
        if self.sensor is not None:
            tables["sensor"] = self.sensor.to_dict()
            when = {"time_utc": self.time_utc, "position_km": self.position_km}
            study |= {name: value for name, value in when.items() if value is not None}
        return tables | ({"priors": self.priors} if self.priors else {})

    def check(self, where: str = "study") -> None:
        """Raise `StudyError` for an invalid study; `where` names the file."""
        for good, text in (
            (self.mode in MODES, f"mode is {self.mode!r}; write one of {', '.join(MODES)}"),
            (
                self.posterior in POSTERIORS,
                f"posterior is {self.posterior!r}; write one of {', '.join(POSTERIORS)}",
            ),
            (
                len(self.seeds) > 0
                and len(set(self.seeds)) == len(self.seeds)
                and LIMITS["seed"].holds(self.seeds),
                (
                    "seeds holds no number, one twice, below 0 or beyond 64 bits; write how many "
                    "repetitions you want"
                ),
            ),
        ):
            if not good:
                raise StudyError(f"{where}, section [study]: {text}.")
        for section, name, values in (
            *(("sweep", name, values) for name, values in self.sweep.items()),
            *(("observation", name, (value,)) for name, value in self.observation.items()),
            *(
                ("sweep.latin", name, (span["start"], span["stop"]))
                for name, span in self.latin.items()
            ),
        ):
            axis = _axis(name, f"{where}, section [{section}]")
            if section != "sweep.latin" or axis.kind != "whole":
                for value in values:
                    axis.check(value, f"{where}, section [{section}]")
        try:
            self.exclusion  # noqa: B018
        except StarcalError as error:
            raise StudyError(f"{where}: {error}") from None
        every = {**self.observation, **self.sweep, **self.latin}
        self._check_names(every, where)
        for name in self.target_sigma:
            if name not in self.parameter_names or not KEYS["target_sigma"].holds(
                self.target_sigma[name]
            ):
                low, high = KEYS["target_sigma"].low, KEYS["target_sigma"].high
                raise StudyError(
                    f"{where}, section [study]: target_sigma of {name} is no error from {low:g} "
                    f"to {high:g} of one of "
                    f"{', '.join(self.parameter_names)}; correct it."
                )
        if not self.sweep and not self.latin:
            raise StudyError(
                f"{where}, section [sweep]: nothing is varied; add an axis such as frames = [50, "
                "200]."
            )
        if self.n_cells > MAX_CELLS:
            raise StudyError(
                f"{where}, section [sweep]: the axes make {self.n_cells:,} cells, more than "
                f"{MAX_CELLS:,}; use fewer "
                "values, or a Latin hypercube."
            )
        try:
            camera_of(self.camera, self._fixed)
        except StudyError as error:
            raise StudyError(f"{where}, section [camera]: {error}") from None

    def _check_names(self, every: AnyDict, where: str) -> None:
        for one, other in EXCLUSIVE:
            if one in every and other in every:
                raise StudyError(
                    f"{where}: {one} and {other} set the same thing; leave one of them out."
                )
        for name in every:
            if self.sensor is None and name in SENSOR_AXES:
                raise StudyError(
                    f"{where}: {name} varies a sensor, and there is none; add a section [sensor], "
                    f'or sensor = "sensor.toml" in [study].'
                )
            if self.sensor is not None and name in NOISE_AXES:
                raise StudyError(
                    f"{where}: {name} and the sensor both set the noise; leave one of them out."
                )
            if name in COEFFICIENTS and name not in self.parameter_names:
                raise StudyError(
                    f"{where}: {name} is no coefficient of distortion "
                    f"{' or '.join(map(repr, self.models))}; remove "
                    "it, or use another model."
                )
            if self.mode == "fisher" and name in ("method", "likelihood"):
                raise StudyError(
                    f"{where}: {name} makes no difference to Fisher information; set mode to "
                    "'simulate', or remove it."
                )
            if self.mode != "fisher" and name in EFFECT_AXES:
                raise StudyError(
                    f"{where}: {name} is studied by Fisher information; set mode to 'fisher', or "
                    "remove it."
                )
        for name in (*self.sweep.get("prior", ()), self.observation.get("prior", FLAT)):
            if name != FLAT and name not in self.priors:
                raise StudyError(
                    f"{where}: prior {name!r} is not defined; add a section [priors.{name}]."
                )

    @property
    def models(self) -> tuple[str, ...]:
        """Distortion models that occur."""
        base = self.observation.get("distortion", self.camera.distortion)
        return tuple(dict.fromkeys(self.sweep.get("distortion", (base,))))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Parameters of all models, in the order of the registry."""
        used = {name for model in self.models for name in parameter_names(model)}
        return tuple(name for name in PARAMETERS if name in used)

    @cached_property
    def exclusion(self) -> Exclusion | None:
        """Cones of the sky that the sensor keeps out of."""
        if self.sensor is None:
            return None
        return Exclusion.of(self.sensor, self.time_utc, self.position_km)

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        return (
            math.prod(len(values) for values in self.sweep.values())
            * max(1, self.latin_n)
            * len(self.seeds)
        )

    @cached_property
    def axes(self) -> dict[str, tuple[Any, ...]]:
        """Values of every axis that is varied, those of a hypercube in ascending order."""
        points = {name: tuple(sorted(point[name] for point in self._points)) for name in self.latin}
        return {**self.sweep, **points}

    @cached_property
    def _points(self) -> list[AnyDict]:
        """Points of the Latin hypercube; one without any axis where there is none."""
        if not self.latin:
            return [{}]
        from scipy.stats import qmc

        unit = qmc.LatinHypercube(len(self.latin), rng=np.random.default_rng(self.seed)).random(
            self.latin_n
        )
        columns = {}
        for (name, span), u in zip(self.latin.items(), unit.T, strict=True):
            ends = span["start"], span["stop"]
            if span["spacing"] == "log":
                values = np.exp(np.interp(u, (0.0, 1.0), np.log(ends)))
            else:
                values = np.interp(u, (0.0, 1.0), ends)
            columns[name] = (
                np.round(values).astype(int).tolist()
                if AXES[name].kind == "whole"
                else values.tolist()
            )
        return [
            dict(zip(columns, point, strict=True)) for point in zip(*columns.values(), strict=True)
        ]

    @property
    def _fixed(self) -> AnyDict:
        """Settings that the sweep does not change."""
        return {k: v for k, v in self.observation.items() if k not in self.sweep}

    def cells(self) -> list[Cell]:
        """Every cell: the grid, the hypercube within it, and the repetitions within that."""
        fixed = base_settings(self._fixed)
        made = []
        for values in product(*self.sweep.values()):
            grid = fixed | dict(zip(self.sweep, values, strict=True))
            for point in self._points:
                settings = grid | point
                if self.sensor is not None:
                    own = {name: settings[name] for name in SENSOR_AXES if name in settings}
                    settings["sensor"] = self.sensor.replace(**own).to_dict()
                if self.exclusion is not None:
                    settings["exclusion"] = asdict(self.exclusion)
                made += [Cell(settings, index) for index in self.seeds]
        return made

    def key(self, cell: Cell, stars: str) -> str:
        """Hash of all that the numbers of a cell depend on; `stars` is that of the catalogue to its
        magnitude limit.
        """
        return _hash(
            {
                "version": VERSION,
                "camera": {k: v for k, v in self.camera.to_dict().items() if k != "name"},
                "settings": cell.settings,
                "prior": self.priors.get(cell.settings["prior"]),
                "seeds": [self.seed, cell.seed_index],
                "stars": stars,
                "how": [self.mode, self.geometries]
                if self.mode == "fisher"
                else [self.mode, self.posterior, self.draws],
            }
        )


def template(name: str) -> str:
    """Text of a commented STUDY.toml that comes with the package.

    StudyError for a name that is not one of `TEMPLATES`.
    """
    check_known("template", name, TEMPLATES, StudyError)
    text = (files("starcal_uq.studies") / "templates" / f"{name}.toml").read_text("utf-8")
    return text.replace("{command}", Remedy("study", ("STUDY.toml",), {"out": "DIR"}).command)


def write_study_template(name: str, path: PathLike, force: bool = False) -> None:
    """Write the template of that name to a file."""
    text = template(name)
    ensure_new(path, force)
    atomic_write_text(path, text)


def _hash(value: Any) -> str:
    return hash_of(value)[:32]


def _part(
    kind: type[T], name: str, content: AnyMapping, path: str | None, where: str, folder: Path | None
) -> T | None:
    """A camera or a sensor, of its own section or of a file; None where there is neither."""
    if name in content and path is not None:
        raise StudyError(
            f"{where}: the {name} is given twice; leave out the section [{name}], or the key "
            f"{name} of [study]."
        )
    try:
        if path is not None:
            return kind.load((folder or Path()) / path)
        return kind.from_dict(content[name]) if name in content else None
    except StarcalError as error:
        raise StudyError(
            str(error) if path is not None else f"{where}, section [{name}]: {error}"
        ) from None


def _observation(table: AnyMapping, where: str) -> AnyDict:
    return {name: _axis(name, where).check(value, where) for name, value in table.items()}


def _axis(name: str, where: str) -> Any:
    if name not in AXES:
        hint = unknown_key(name, AXES)
        raise StudyError(f"{where}: {hint}{'' if hint.endswith('?') else '.'}")
    return AXES[name]


def _swept(
    table: AnyDict, where: str
) -> tuple[dict[str, tuple[Any, ...]], dict[str, AnyDict], int]:
    """Grid, ranges and points of the hypercube."""
    latin = table.pop("latin", None)
    grid = {name: _values(name, value, where) for name, value in table.items()}
    if latin is None:
        return grid, {}, 0
    inside = f"{where[:-1]}.latin]"
    if not isinstance(latin, Mapping):
        raise StudyError(f"{where}: latin is no section; write [sweep.latin] above its keys.")
    n = latin.get("n")
    if (
        not isinstance(n, int)
        or isinstance(n, bool)
        or not KEYS["values"].holds(n)
        or len(latin) < 2
    ):
        raise StudyError(
            f"{inside}: write n, a number of points from 1 to {MAX_CELLS}, and at least one axis."
        )
    ranges = {}
    for name, span in latin.items():
        if name == "n":
            continue
        axis = _axis(name, inside)
        if name in grid:
            raise StudyError(f"{inside}: {name} stands in [sweep] too; leave one of them out.")
        if axis.kind == "name" or not isinstance(span, Mapping):
            raise StudyError(
                f"{inside}: {name} is {span!r}; write a range of numbers such as {{start = 1, "
                "stop = 2}."
            )
        ranges[name] = {"spacing": "linear"} | _span(axis, span, _RANGE, inside)
    return grid, ranges, n


def _values(name: str, value: Any, where: str) -> tuple[Any, ...]:
    axis = _axis(name, where)
    if isinstance(value, Mapping):
        if axis.kind == "name":
            raise StudyError(
                f"{where}: {name} is {dict(value)!r}; write a list of names in quotes."
            )
        span = _span(axis, value, _SPAN, where)
        spread = np.geomspace if span.get("spacing") == "log" else np.linspace
        numbers = spread(span["start"], span["stop"], span["n"]).tolist()
        # Twelve digits, so that 0.1 is 0.1 on every machine.
        values = [round(v) if axis.kind == "whole" else float(f"{v:.12g}") for v in numbers]
        return tuple(dict.fromkeys(values))
    if not isinstance(value, (list, tuple)):
        raise StudyError(
            f"{where}: {name} is {value!r}; write a list, or {{start = 1, stop = 2, n = 5}}."
        )
    if not value:
        raise StudyError(f"{where}: {name} is an empty list; give at least one value.")
    values = [axis.check(v, where) for v in value]
    if len(set(values)) < len(values):
        raise StudyError(f"{where}: {name} holds a value twice; remove one of them.")
    return tuple(values)


def _span(axis: Any, span: AnyMapping, keys: dict[str, Key], where: str) -> AnyDict:
    inside = f"{where}, {axis.name}"
    checked = Section(keys, StudyError).check(span, inside)
    if checked.get("spacing", "linear") not in _SPACINGS:
        raise StudyError(
            f"{inside}: spacing is {checked['spacing']!r}; write one of {', '.join(_SPACINGS)}."
        )
    for end in ("start", "stop"):
        if axis.kind != "whole":
            axis.check(checked[end], f"{inside}, {end}")
        elif not axis.limit.low <= checked[end] <= axis.limit.high:
            raise StudyError(f"{inside}, {end}: {axis.name} is {checked[end]:g}; {axis.wanted}.")
    if checked.get("spacing") == "log" and min(checked["start"], checked["stop"]) <= 0.0:
        raise StudyError(
            f"{inside}: a range with spacing 'log' starts and stops above zero; correct it."
        )
    return checked


def _prior(name: str, table: Any, where: str) -> AnyDict:
    inside = f"{where}, section [priors.{name}]"
    if name == FLAT or not isinstance(table, Mapping):
        raise StudyError(
            f"{inside}: write a table under another name than {FLAT!r}, which is no prior at all."
        )
    try:
        return PRIORS.check(table, inside)
    except PriorError as error:
        raise StudyError(str(error)) from None
