"""All commands of the command line, and what is said of a wrong call."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Annotated, Any, get_args

import typer

from starcal_uq.cli import VERSION_LINE
from starcal_uq.cli import filter as cli_filter
from starcal_uq.cli import images as cli_images
from starcal_uq.cli import mission as cli_mission
from starcal_uq.cli import paper as cli_paper
from starcal_uq.cli import run as cli_run
from starcal_uq.cli import schema as cli_schema
from starcal_uq.cli import starters as cli_starters
from starcal_uq.cli import statistics as cli_statistics
from starcal_uq.cli import steps as cli_steps
from starcal_uq.cli import study as cli_study
from starcal_uq.cli.answers import Answer
from starcal_uq.cli.runfiles import typed
from starcal_uq.cli.settings import unfolded
from starcal_uq.core.conflicts import EARLIER
from starcal_uq.core.files import shown
from starcal_uq.core.settings import wanted
from starcal_uq.core.types import AnyDict

app = typer.Typer(
    name="starcal-uq",
    help=(
        "Probabilistic calibration of star sensors: from identified stars to a posterior and its "
        "attitude error."
    ),
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    epilog=(
        "Start with `starcal-uq demo`: the experiment of Ye & Yang 2017, from a star catalogue "
        "to a report."
    ),
)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(VERSION_LINE)
        raise typer.Exit


@app.callback()
def common(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    """Probabilistic calibration of star sensors: from identified stars to a posterior and its
    attitude error.
    """


# What one wants -> the commands, in the order of the help.
GROUPS: Mapping[str, list[Callable[..., Answer]]] = {
    "All at once": [cli_run.demo, cli_run.run_command],
    "Before there are data": [
        cli_starters.new_command,
        cli_mission.plan_command,
        cli_steps.simulate_command,
        cli_study.study_command,
        cli_statistics.validate_command,
    ],
    "From images to stars": [cli_images.centroid_command, cli_images.identify_command],
    "A run, step by step": [
        cli_steps.calibrate_command,
        cli_steps.sample_command,
        cli_steps.coupling_command,
        cli_steps.propagate_command,
        cli_statistics.diagnose_command,
        cli_mission.budget_command,
        cli_steps.report_command,
        cli_images.inspect_command,
        cli_steps.export_command,
    ],
    "Several runs, and streams": [
        cli_mission.compare_command,
        cli_statistics.merge_command,
        cli_filter.filter_command,
    ],
    "The paper": [cli_paper.reproduce_command, cli_paper.reproduce_field_command],
    "For programs": [cli_schema.schema_command],
}
for group, commands in GROUPS.items():
    for command in commands:
        name = command.__name__.removesuffix("_command").replace("_", "-")
        app.command(name, rich_help_panel=group)(unfolded(name, command))


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
    return f"{message.strip().rstrip('.')}; see `starcal-uq --help`."


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
