"""All commands of the command line, each loaded when it is called, and the sentences about a
wrong call.
"""

from __future__ import annotations

import re
import tomllib
from collections import defaultdict
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, get_args

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from starcal_uq.cli import HELP, VERSION_LINE
from starcal_uq.cli.runfiles import typed
from starcal_uq.core.conflicts import EARLIER
from starcal_uq.core.files import shown
from starcal_uq.core.settings import wanted
from starcal_uq.core.types import AnyDict

_MODULES = tomllib.loads(Path(__file__).with_name("commands.toml").read_text("utf-8"))


class _Command(TyperCommand):
    """A command whose help lists options under what they are for, and arguments as one types them."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        arguments = (one for one in self.get_params(ctx) if one.param_type_name == "argument")
        words = ((one.required, _word(one)) for one in arguments)
        return ["[OPTIONS]", *(word if needed else f"[{word}]" for needed, word in words)]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        sections: AnyDict = defaultdict(list)
        for parameter in self.get_params(ctx):
            kind = f"{parameter.param_type_name.capitalize()}s"
            section = getattr(parameter, "rich_help_panel", None) or kind
            row = parameter.get_help_record(ctx)
            if row is not None and kind == "Arguments":
                # Typer adds the type, in the words of Python.
                row = _word(parameter), row[1]
            sections[section].append(row)
        for section, rows in sections.items():
            if any(rows):
                with formatter.section(section):
                    formatter.write_dl(filter(None, rows))


class _Program(TyperGroup):
    """The program, whose help loads no command."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        formatter.write(HELP.read_text("utf-8"))


class _Commands(Mapping[str, Any]):
    """The commands by their names."""

    def __getitem__(self, name: str) -> Any:
        return _command(name)

    def __iter__(self) -> Iterator[str]:
        return iter(_MODULES)

    def __len__(self) -> int:
        return len(_MODULES)


@cache
def _command(name: str) -> Any:
    from starcal_uq.cli.settings import unfolded

    module = import_module(f"starcal_uq.cli.{_MODULES[name]}")
    function = getattr(module, f"{name.replace('-', '_')}_command")
    alone = typer.Typer(add_completion=False, rich_markup_mode=None)
    wide = {"max_content_width": 100}
    alone.command(name, cls=_Command, context_settings=wide)(unfolded(name, function))
    return get_command(alone)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(VERSION_LINE)
        raise typer.Exit


def _common(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    """Options of the program itself."""


app: Any = get_command(
    typer.Typer(name="starcal-uq", cls=_Program, callback=_common, rich_markup_mode=None)
)
app.commands = _Commands()


def usage_sentence(error: Exception) -> str:
    """What is wrong with a call, and where to look."""
    parameter, cause = getattr(error, "param", None), error.__cause__
    if isinstance(error, typer.BadParameter) and parameter is not None:
        if not error.message and cause is None:
            return _missing(error.ctx, parameter)
        name = (
            max(parameter.opts, key=len)
            if parameter.opts[0].startswith("-")
            else parameter.display_name_raw
        )
        problems: list[AnyDict] = getattr(cause, "errors", list)()
        # A value of a run file is corrected there.
        file = "" if not typed() or _is_typed(parameter) else f"{typed()[1]}: "
        words = _problem(parameter, problems[0]["input"]) if problems else error.message
        return f"{file}{name} {words}"
    if isinstance(error, typer.BadParameter):
        return str(error.message)
    option, context = getattr(error, "option_name", ""), getattr(error, "ctx", None)
    if option in EARLIER and context is not None and context.command.name in ("calibrate", "run"):
        return f"{option} is no option any more: give --effects {EARLIER[option]} in its place."
    form = getattr(error, "format_message", None)
    message = form() if callable(form) else str(error)
    name = f" {context.command.name}" if context is not None and context.parent else ""
    return f"{message.strip().rstrip('.')}; see `starcal-uq{name} --help`."


def _is_typed(parameter: Any) -> bool:
    """Whether an option stands on the command line beside a run file, or a change of its key."""
    keys = {option[2:].replace("-", "_") for option in parameter.opts}
    words = [word.removeprefix("--set=") for word in typed()]
    return any(word.partition("=")[0] in (*parameter.opts, *keys) for word in words[2:])


def _missing(context: Any, parameter: Any) -> str:
    """A parameter that a call lacks, what it is, and all that the command cannot do without."""
    command = context.command
    call = " ".join(
        ["starcal-uq", command.name, *(_word(other) for other in command.params if other.required)]
    )
    what = re.split(r"[.:;(]", parameter.help or "")[0].strip()
    what = what if what[:2].isupper() else what[:1].lower() + what[1:]
    return f"{_word(parameter)} is missing{f' ({what})' if what else ''}: give `{call}`."


def _word(parameter: Any) -> str:
    """A parameter as one types it."""
    value = str(parameter.metavar or parameter.name.upper())
    return f"{min(parameter.opts, key=len)} {value}" if parameter.opts[0].startswith("-") else value


def _problem(parameter: Any, value: object) -> str:
    """What is wrong with a value that does not fit the declaration of its parameter."""
    kind = parameter.type_descriptor
    if kind.choices is not None:
        return f"{shown(value)} is unknown: use one of {', '.join(kind.choices)}."
    kinds = {kind.annotation, *get_args(kind.annotation)}
    return f"{shown(value)}: {wanted(parameter.min, parameter.max, int in kinds)}."
