"""Options that exclude each other: one table for functions, the command line and the remedies of
checks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.settings import WEIGHING, effect_names, joined_effects

# Options as they are typed, each with its values in the order given; None where it stands alone.
Options: TypeAlias = dict[str, tuple[str | None, ...]]
_RECURSIVE = ("samaan", "griffith")
_IN_MEMORY = ("three_stage", "least_squares")
_COMPOSITE = ("pairs", "pairs_naive")


@dataclass(frozen=True)
class Rule:
    """What an option needs of another one.

    Attributes
    ----------
    name : str
        The option.
    values : tuple
        Values of it that the rule is about; any that is given where empty.
    other : str
        The other option; "partitioned" stands for observations that are a folder of files.
    allowed : tuple
        Values of the other one with which it makes sense, of effects their kind
        (`kind_of_effects`) or, with ``auto`` among them, their names; None stands for its default.
    """

    name: str
    values: tuple[object, ...]
    other: str
    allowed: tuple[object, ...]

    @property
    def of_kinds(self) -> bool:
        """Whether `allowed` are kinds of effects, and not their names."""
        return self.other == "effects" and "auto" not in self.allowed

    def value(self, settings: Mapping[str, object]) -> object:
        """The option's value; of effects the first that the rule is about."""
        value: Any = settings.get(self.name)
        if self.name == "effects" and self.values:
            return next((name for name in effect_names(value) if name in self.values), None)
        return value

    def broken(self, settings: Mapping[str, object]) -> bool:
        """Whether settings, by the names of their options, are against it; what they lack is not
        given.
        """
        value = self.value(settings)
        concerned = value in self.values if self.values else is_given(value)
        other: Any = settings.get(self.other)
        if self.of_kinds:
            other = kind_of_effects(other)
        elif self.other == "effects" and other is not None:
            other = next((name for name in effect_names(other) if name in self.allowed), "others")
        return concerned and (other if is_given(other) else None) not in self.allowed


def is_given(value: object) -> bool:
    """Whether a value of an option asks for anything."""
    return value not in (None, False, "none")


def kind_of_effects(effects: Any) -> str | None:
    """Effects by what draws have to know of them: ``shifts``, where some move stars; ``tails``
    alone; None where there are none of these.
    """
    names = effect_names(effects)
    if set(names) - set(WEIGHING):
        return "shifts"
    return "tails" if "tails" in names else None


# "sampled" and "sampled_dof" are likelihood and degrees of freedom of the draws.
RULES = (
    Rule("effects", (), "method", (None, "efficient")),
    # Errors of the stars and weights need all stars in memory.
    Rule("effects", (*WEIGHING, "star"), "partitioned", (None,)),
    Rule("relative_attitudes", (), "mount", (None,)),
    Rule("mount_sigma_arcsec", (), "mount", ("fixed",)),
    *(
        Rule(name, (), *other)
        for name in ("relative_attitudes", "mount")
        for other in (
            ("method", (None, "efficient")),
            ("effects", (None, "tails")),
            ("partitioned", (None,)),
        )
    ),
    Rule("recursion", (), "method", _RECURSIVE),
    Rule("method", _IN_MEMORY, "partitioned", (None,)),
    Rule("duplicates", ("drop",), "partitioned", (None,)),
    Rule("screening", (True,), "partitioned", (None,)),
    Rule("frames", (), "partitioned", (None,)),
    Rule("scheduler", (), "partitioned", (True,)),
    Rule("workers", (), "partitioned", (True,)),
    Rule("sampled_dof", (), "sampled", ("student_t",)),
    Rule("sampled", ("marginal",), "effects", (None, "shifts")),
    Rule("sampled", (*_COMPOSITE, "student_t"), "effects", (None, "tails")),
    Rule("sampled", (*_COMPOSITE, "student_t"), "partitioned", (None,)),
    Rule("sampled", (*_COMPOSITE, "student_t"), "relative_attitudes", (None,)),
    Rule("sampled", (*_COMPOSITE, "student_t"), "mount", (None,)),
    Rule("evaluation", ("exact",), "partitioned", (None,)),
    Rule("sampled", _COMPOSITE, "method", (None, "efficient", *_IN_MEMORY)),
    Rule("site", (), "in_space", (None,)),
    Rule("site", (), "observer_velocity", (None,)),
    Rule("site", (), "directions", (None, "catalogue")),
    Rule("alignment_frames", (), "alignment", (None, "random")),
    Rule("temperature_profile", (), "effects", (None, "auto", "temperature")),
)


# Options of a run that have another name on the command line, or stand for a value; of the flags,
# their values.
_TYPED = {"--likelihood": "sampled", "--dof": "sampled_dof", "--only-frames": "frames"}
_FLAGS: dict[str, tuple[str, object]] = {
    "--screen": ("screening", True),
    "--in-space": ("in_space", True),
    "--force": ("force", True),
    "--json": ("json", True),
}
# Words by which earlier versions were asked for effects, as their run folders hold them.
EARLIER = {"--robust": "tails", "--star-errors": "star", "--noise": "noise"}


def parsed(words: Sequence[str]) -> tuple[list[str], Options]:
    """Command and files of a command line, and its options."""
    places: list[str] = []
    options: Options = {}
    rest = iter(words)
    for word in rest:
        if not word.startswith("--"):
            places.append(word)
            continue
        name = word.partition("=")[0]
        options[name] = (*options.get(name, ()), _value(word, rest))
    return places, options


def without(words: Sequence[str], option: str) -> tuple[list[str], list[str | None]]:
    """A command line without an option, and the values that this had."""
    kept: list[str] = []
    values: list[str | None] = []
    rest = iter(words)
    for word in rest:
        if word.partition("=")[0] == option:
            values.append(_value(word, rest))
        else:
            kept.append(word)
    return kept, values


def _value(word: str, rest: Iterator[str]) -> str | None:
    """Value of an option: in its own word, or in the next of the rest; None where it stands
    alone.
    """
    name, equals, value = word.partition("=")
    alone = name in _FLAGS or name in ("--robust", "--star-errors")
    return value if equals else None if alone else next(rest, None)


def sampled_by_default(settings: Mapping[str, object]) -> object:
    """The likelihood of the draws: that of the estimate, unless effects that shift stars or known
    rotations give them known weights.
    """
    tied = is_given(settings.get("mount")) or is_given(settings.get("relative_attitudes"))
    tails = kind_of_effects(settings.get("effects")) == "tails" and not tied
    return "student_t" if tails else None


def asked(options: Mapping[str, Any], partitioned: bool) -> dict[str, Any]:
    """Settings of `starcal_uq.run` by the names that the rules have for them."""
    return {
        "observer_velocity": options.get("observer_velocity_km_s"),
        **options,
        "partitioned": partitioned,
        "sampled": options.get("likelihood") or sampled_by_default(options),
        "sampled_dof": options.get("dof"),
    }


def with_effects(options: dict[str, Any], partitioned: bool) -> dict[str, Any]:
    """Settings of `starcal_uq.run`, which looks for effects where none are stated and nothing
    excludes them.
    """
    selecting = {"effects": "auto", **options}
    return options if conflict(asked(selecting, partitioned)) else selecting


def arguments_of(options: Mapping[str, Sequence[str | None]]) -> dict[str, Any]:
    """Options as they are typed by the names that the rules have for them; a tuple where one is
    given several times.
    """
    found: dict[str, Any] = {}
    for option, values in options.items():
        if option in EARLIER:
            if values != ("common",):
                found["effects"] = joined_effects(found.get("effects"), EARLIER[option])
            continue
        value: Any = values[0] if len(values) == 1 else tuple(values)
        if option == "--effects":
            value = joined_effects(found.get("effects"), values[-1])
        name = _TYPED.get(option, option[2:].replace("-", "_"))
        name, value = _FLAGS.get(option, (name, value))
        found[name] = value
    return found


def named(options: Mapping[str, Sequence[str | None]]) -> dict[str, Any]:
    """Options as they are typed for `conflict`: draws are of the likelihood of the estimate."""
    arguments = arguments_of(options)
    return {"sampled": sampled_by_default(arguments)} | arguments


def words_of(arguments: Mapping[str, Any]) -> list[str]:
    """Options, by the names that the rules have for them, as the words that are typed."""
    words: list[str] = []
    for name, given in arguments.items():
        for value in given if type(given) is tuple else (given,):
            words += _words(name, value)
    return words


def _words(name: str, value: Any) -> list[str]:
    for option, meaning in _FLAGS.items():
        if meaning == (name, value):
            return [option]
    if isinstance(value, Mapping):
        value = ",".join(f"{key}={number:.6g}" for key, number in value.items())
    options = {meaning: option for option, meaning in _TYPED.items()}
    return [options.get(name, "--" + name.replace("_", "-")), str(value)]


def typed(name: str, value: object) -> str:
    """An option, by the name that the rules have for it, as it is typed."""
    return " ".join(_words(name, value))


def conflict(settings: Mapping[str, object]) -> Rule | None:
    """The first rule that settings break, None where they can be given together."""
    return next((rule for rule in RULES if rule.broken(settings)), None)


def refusal(
    settings: Mapping[str, object], spell: Callable[[str, object], str] = typed
) -> str | None:
    """What is wrong with settings that cannot be given together, each spelt by a function; None
    where nothing is.
    """
    rule = conflict(settings)
    if rule is None:
        return None
    given, other = spell(rule.name, rule.value(settings)), settings.get(rule.other)
    if rule.other == "partitioned":
        kind = "a folder of partitions" if True in rule.allowed else "one table, and no folder"
        return f"{given} needs {kind}: leave {given} out."
    wanted = [] if rule.of_kinds else [v for v in rule.allowed if v is not None]
    if wanted:
        needed = " or ".join(spell(rule.other, value) for value in wanted)
        return f"{given} needs {needed}: give both, or leave {given} out."
    return f"{given} and {spell(rule.other, other)} exclude each other: leave one of them out."


def refuse_conflicts(**settings: object) -> None:
    """CalibrationError, in the words of Python, where arguments cannot be given together."""
    words = refusal(settings, _argument)
    if words is not None:
        raise CalibrationError(words)


def _argument(name: str, value: object) -> str:
    return f"{name}={value!r}" if isinstance(value, str | int | float) else name
