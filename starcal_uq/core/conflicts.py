"""Options that exclude each other: one table for functions, the command line and the remedies of
checks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from starcal_uq.core.errors import CalibrationError

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
        Values of the other one with which it makes sense; None stands for its default.
    """

    name: str
    values: tuple[object, ...]
    other: str
    allowed: tuple[object, ...]

    def broken(self, settings: Mapping[str, object]) -> bool:
        """Whether settings, by the names of their options, are against it; what they lack is not
        given.
        """
        value = settings.get(self.name)
        concerned = value in self.values if self.values else is_given(value)
        other = settings.get(self.other)
        return concerned and (other if is_given(other) else None) not in self.allowed


def is_given(value: object) -> bool:
    """Whether a value of an option asks for anything."""
    return value not in (None, False, "none")


# "likelihood" and "dof" are those of the estimate; "sampled" and "sampled_dof" those of the draws.
RULES = (
    Rule("likelihood", ("student_t",), "method", (None, "efficient")),
    Rule("noise", ("model",), "method", (None, "efficient")),
    Rule("star_errors", (True,), "method", (None, "efficient")),
    Rule("effects", (), "method", (None, "efficient")),
    Rule("effects", (), "star_errors", (None,)),
    Rule("relative_attitudes", (), "mount", (None,)),
    Rule("mount_sigma_arcsec", (), "mount", ("fixed",)),
    *(
        Rule(name, (), *other)
        for name in ("relative_attitudes", "mount")
        for other in (
            ("method", (None, "efficient")),
            ("star_errors", (None,)),
            ("effects", (None,)),
            ("partitioned", (None,)),
        )
    ),
    Rule("dof", (), "likelihood", ("student_t",)),
    Rule("recursion", (), "method", _RECURSIVE),
    Rule("method", _IN_MEMORY, "partitioned", (None,)),
    Rule("likelihood", ("student_t",), "partitioned", (None,)),
    Rule("noise", ("model",), "partitioned", (None,)),
    Rule("star_errors", (True,), "partitioned", (None,)),
    Rule("duplicates", ("drop",), "partitioned", (None,)),
    Rule("screening", (True,), "partitioned", (None,)),
    Rule("frames", (), "partitioned", (None,)),
    Rule("scheduler", (), "partitioned", (True,)),
    Rule("workers", (), "partitioned", (True,)),
    Rule("sampled_dof", (), "sampled", ("student_t",)),
    Rule("sampled", ("marginal",), "likelihood", (None, "marginal")),
    Rule("sampled", (*_COMPOSITE, "student_t"), "star_errors", (None,)),
    Rule("sampled", (*_COMPOSITE, "student_t"), "effects", (None,)),
    Rule("sampled", (*_COMPOSITE, "student_t"), "partitioned", (None,)),
    Rule("evaluation", ("exact",), "partitioned", (None,)),
    Rule("sampled", _COMPOSITE, "method", (None, "efficient", *_IN_MEMORY)),
    Rule("site", (), "in_space", (None,)),
    Rule("site", (), "observer_velocity", (None,)),
    Rule("site", (), "directions", (None, "catalogue")),
    Rule("alignment_frames", (), "alignment", (None, "random")),
)


# Options of a run that have another name on the command line, or stand for a value; of the flags,
# their values.
_TYPED = {"--likelihood": "sampled", "--dof": "sampled_dof", "--only-frames": "frames"}
_FLAGS: dict[str, tuple[str, object]] = {
    "--robust": ("likelihood", "student_t"),
    "--screen": ("screening", True),
    "--star-errors": ("star_errors", True),
    "--in-space": ("in_space", True),
    "--force": ("force", True),
    "--json": ("json", True),
}


def parsed(words: Sequence[str]) -> tuple[list[str], Options]:
    """Command and files of a command line, and its options."""
    places: list[str] = []
    options: Options = {}
    rest = iter(words)
    for word in rest:
        if not word.startswith("--"):
            places.append(word)
            continue
        name, equals, value = word.partition("=")
        given = value if equals else None if name in _FLAGS else next(rest, None)
        options[name] = (*options.get(name, ()), given)
    return places, options


def sampled_by_default(settings: Mapping[str, object]) -> object:
    """The likelihood of the draws: that of the estimate, unless star errors or effects give its
    stars known weights.
    """
    known = settings.get("star_errors") or is_given(settings.get("effects"))
    return None if known else settings.get("likelihood")


def arguments_of(options: Mapping[str, Sequence[str | None]]) -> dict[str, Any]:
    """Options as they are typed by the names that the rules have for them; a tuple where one is
    given several times.
    """
    found: dict[str, Any] = {}
    for option, values in options.items():
        value: Any = values[0] if len(values) == 1 else tuple(values)
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


def refuse_conflicts(**settings: object) -> None:
    """CalibrationError, in the words of Python, where arguments cannot be given together."""
    rule = conflict(settings)
    if rule is None:
        return
    value = settings[rule.name]
    given = f"{rule.name}={value!r}" if isinstance(value, str | int | float) else rule.name
    if rule.other == "partitioned" and True in rule.allowed:
        needed = (
            "needs partitioned observations (sc.observations.open_partitions, a folder of "
            "Parquet files): leave"
        )
        raise CalibrationError(f"{given} {needed} it out.")
    if rule.other == "partitioned":
        raise CalibrationError(
            f"{given} and partitioned observations exclude each other: leave it out, or "
            "calibrate the frames of "
            "`obs.sample()` with it."
        )
    wanted = " or ".join(repr(allowed) for allowed in rule.allowed if allowed is not None)
    raise CalibrationError(
        f"{given} needs {rule.other}={wanted}, and {rule.other} is {settings.get(rule.other)!r}: "
        "change one of them."
    )
