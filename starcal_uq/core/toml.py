"""Tables of TOML files that people write: read and checked in one way, with one sentence for
whatever is wrong.
"""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

from starcal_uq.core.display import public_names
from starcal_uq.core.errors import StarcalError
from starcal_uq.core.files import atomic_write_text, ensure_new, shown
from starcal_uq.core.settings import KEYS, LIMITS, Limit
from starcal_uq.core.types import AnyDict, PathLike
from starcal_uq.core.units import plain

if TYPE_CHECKING:
    from pydantic import BaseModel


def read_toml(
    path: PathLike, name: str, error: type[StarcalError], missing: str = "check the path"
) -> AnyDict:
    """Content of a TOML file in UTF-8, with or without a byte order mark.

    `name` is its subject in messages, such as "camera", and `missing` the remedy for a file that
    does not exist.
    """
    path = Path(path)
    if os.path.isdir(path):
        raise error(f"{path}: is a directory; name the TOML file of the {name}.")
    where = f"{path}: the {name} file"
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except FileNotFoundError:
        raise error(f"{where} does not exist; {missing}.") from None
    except OSError as problem:
        raise error(
            f"{where} cannot be read ({problem.strerror}); check its permissions."
        ) from problem
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as problem:
        if path.suffix.lower() != ".toml":
            raise error(
                f"{path}: is no TOML, as a {name} file is; check the order of the arguments."
            ) from None
        if isinstance(problem, tomllib.TOMLDecodeError):
            raise error(f"{where} is not valid TOML: {problem}; correct that line.") from None
        raise error(f"{where} is not UTF-8 text; save it as TOML in UTF-8.") from None
    except ValueError:
        raise error(f"{where} holds a number with too many digits; correct it.") from None
    except RecursionError:
        raise error(f"{where} nests its values too deeply; write plain tables and lists.") from None


def read_section(
    path: PathLike, name: str, error: type[StarcalError], *, alone: bool = True
) -> AnyDict:
    """The table ``[name]`` of a TOML file; with `alone`, nothing may stand outside it."""
    content = read_toml(path, name, error)
    write = f"write [{name}] above its keys"
    if name not in content:
        empty = "" if content else f"the {name} file is empty: "
        other = next(
            (
                f", and [{key}] is there"
                for key, value in content.items()
                if isinstance(value, dict)
            ),
            "",
        )
        remedy = f"give another file, or {write}" if other else write
        raise error(f"{path}: {empty}section [{name}] is missing{other}; {remedy}.")
    section = content.pop(name)
    if not isinstance(section, dict):
        raise error(f"{path}: {name} is no section; {write}.")
    if content and alone:
        first = next(iter(content))
        raise error(
            f"{path}: {first} stands outside section [{name}]; remove it or move it below [{name}]."
        )
    return section


def write_section(
    path: PathLike, name: str, table: Mapping[str, Any], header: str, force: bool
) -> None:
    """Write a table ``[name]`` without loss of digits, below comments that explain its keys."""
    import tomli_w

    ensure_new(path, force)
    atomic_write_text(path, header + tomli_w.dumps({name: dict(table)}))


def unknown_key(key: str, known: Collection[str], what: str = "key") -> str:
    """Remedy for a key that is unknown: the most similar one that is known, or all of them."""
    near = difflib.get_close_matches(key, known, n=1)
    hint = f"did you mean {near[0]}?" if near else f"remove it (known: {', '.join(known)})"
    return f"{what} {key} is unknown; {hint}"


class Key:
    """What may stand under a key: its type, and the text of what to write, said wherever it is
    missing or wrong.

    A whole number may stand for a float, but neither text nor a truth value for a number. The
    bounds are limits as of `pydantic.Field`, such as ``gt=0``.
    """

    words: tuple[str, ...] = ()

    def __init__(self, kind: Any, wanted: str, *, required: bool = False, **bounds: Any) -> None:
        self.kind, self.wanted, self.required, self.bounds = kind, wanted, required, bounds

    @classmethod
    def choice(cls, words: Sequence[str], *, required: bool = False) -> Key:
        """One of these words, in any case."""
        key = cls(str, f"one of {', '.join(map(repr, words))}", required=required)
        key.words = tuple(words)
        return key

    def word(self, text: str) -> str:
        """The word of the list that is meant."""
        for word in self.words:
            if word.lower() == text.strip().lower():
                return word
        raise ValueError

    @classmethod
    def number(cls, limit: Limit, words: str, *, required: bool = False) -> Key:
        """A number within limits, which is `words`."""
        kind, range_ = (int if limit.whole else float), limit.wanted().removeprefix("give ")
        return cls(kind, f"{words}, {range_}", required=required, ge=limit.low, le=limit.high)


_TYPES: AnyDict = {kind.__name__: kind for kind in (bool, float, int, str)}
_TYPES |= {"list[float]": list[float], "int | list[int]": int | list[int]}
_TYPES |= {"dict[str, float]": dict[str, float]}


def keys_of(table: Mapping[str, AnyDict]) -> dict[str, Key]:
    """Keys as data state them: the words to choose from, or what to write, with a type and bounds
    or the name of a limit.
    """
    return {name: _key(dict(stated)) for name, stated in table.items()}


def _key(stated: AnyDict) -> Key:
    if "words" in stated:
        return Key.choice(**stated)
    if limit := stated.pop("limit", ""):
        return Key.number((LIMITS | KEYS)[limit], stated.pop("wanted"), **stated)
    return Key(_TYPES[stated.pop("type")], **stated)


@dataclass(frozen=True)
class Section:
    """Schema of a table: its keys, and the error to raise."""

    keys: Mapping[str, Key]
    error: type[StarcalError]
    name: str = ""
    header: str = ""

    @classmethod
    def of_data(cls, package: str | None, name: str, error: type[StarcalError]) -> Section:
        """The schema that a package holds as data, ``NAME.toml``: keys, and comments for a file."""
        content = tomllib.loads((files(package or "") / f"{name}.toml").read_text("utf-8"))
        return cls(keys_of(content["keys"]), error, name, content["header"])

    @cached_property
    def _schema(self) -> type[BaseModel]:
        from pydantic import AfterValidator, ConfigDict, Field, create_model

        fields: AnyDict = {}
        for name, key in self.keys.items():
            options: AnyDict = {**key.bounds} if key.required else {"default": None, **key.bounds}
            kind = Annotated[str, AfterValidator(key.word)] if key.words else key.kind
            fields[name] = (kind, Field(**options))
        config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
        return create_model("Table", __config__=config, **fields)

    def check(self, table: Mapping[str, Any], where: str) -> AnyDict:
        """Checked values of the keys that are given; `where` names the table in messages."""
        from pydantic import ValidationError

        try:
            return self._schema.model_validate(dict(table)).model_dump(exclude_unset=True)
        except ValidationError as error:
            problems = [self._problem(e["type"], str(e["loc"][0]), table) for e in error.errors()]
        others = len(problems) - 1
        more = f" ({others} more bad key{'s' if others > 1 else ''})" if others else ""
        end = "" if problems[0].endswith("?") and not more else "."
        raise self.error(f"{where}: {problems[0]}{more}{end}")

    def _problem(self, kind: str, key: str, table: Mapping[str, Any]) -> str:
        if kind == "missing":
            return f"key {key} is missing; add {self.keys[key].wanted}"
        if kind == "extra_forbidden":
            return self.unknown(key)
        return f"key {key} is {shown(table[key])}; write {self.keys[key].wanted}"

    def unknown(self, key: str) -> str:
        """What is said of a key that the section does not have."""
        return unknown_key(key, self.keys)


class Stated:
    """What people state in a table of a TOML file, which `SECTION` checks: base of a frozen record."""

    __dir__ = public_names

    SECTION: ClassVar[Section]

    def __post_init__(self) -> None:
        given = {name: plain(name, value) for name, value in self.to_dict().items()}
        given = {n: value.item() if hasattr(value, "item") else value for n, value in given.items()}
        for name, value in self.SECTION.check(given, self.SECTION.name).items():
            object.__setattr__(self, name, value)

    def to_dict(self) -> AnyDict:
        """Keys and values of the table; what is not given is left out."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], where: str = "") -> Self:
        """From keys and values of the table, which `where` names in messages; what is left out has
        its default. The error of the section for a key that is unknown, missing or wrong.
        """
        return cls(**cls.SECTION.check(table, where or cls.SECTION.name))

    @classmethod
    def load(cls, path: PathLike) -> Self:
        """From a TOML file with this table. The error of the section if the file cannot be read or
        its content does not fit; the message names file, key and remedy.
        """
        name = cls.SECTION.name
        table = read_section(path, name, cls.SECTION.error)
        return cls.from_dict(table, f"{path}, section [{name}]")

    def save(self, path: PathLike, force: bool = False) -> None:
        """Write a TOML file without loss of digits; `force` allows to write over one."""
        section = self.SECTION
        write_section(path, section.name, self.to_dict(), section.header, force)
