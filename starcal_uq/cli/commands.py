"""All commands of the command line, and what is said of a wrong call."""

from __future__ import annotations

from typing import Annotated, Any, get_args

import typer

from starcal_uq.cli import filter as cli_filter
from starcal_uq.cli import images as cli_images
from starcal_uq.cli import mission as cli_mission
from starcal_uq.cli import paper as cli_paper
from starcal_uq.cli import run as cli_run
from starcal_uq.cli import statistics as cli_statistics
from starcal_uq.cli import steps as cli_steps
from starcal_uq.cli import study as cli_study
from starcal_uq.core.files import shown
from starcal_uq.core.settings import wanted
from starcal_uq.core.types import AnyDict

app = typer.Typer(
    name="starcal-uq",
    help="Probabilistic calibration of star sensors: from identified stars to a posterior and its attitude error.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    epilog="Start with `starcal-uq demo`: the experiment of Ye & Yang 2017, from a star catalogue to a report.",
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from starcal_uq.core.provenance import installed_version

        print(f"starcal-uq {installed_version('starcal-uq')}")
        raise typer.Exit


@app.callback()
def common(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Probabilistic calibration of star sensors: from identified stars to a posterior and its attitude error."""


for module in (cli_run, cli_steps, cli_mission, cli_study, cli_images, cli_filter, cli_statistics, cli_paper):
    module.register(app)


def usage_sentence(error: Exception) -> str:
    """What is wrong with a call, and where to look."""
    parameter, cause = getattr(error, "param", None), error.__cause__
    if isinstance(error, typer.BadParameter) and parameter is not None:
        name = max(parameter.opts, key=len) if parameter.opts[0].startswith("-") else parameter.display_name_raw
        problems: list[AnyDict] = getattr(cause, "errors", list)()
        return f"{name} {_problem(parameter, problems[0]['input']) if problems else error.message}"
    words = getattr(error, "format_message", None)
    message = words() if callable(words) else str(error)
    return f"{message.strip().rstrip('.')}; see `starcal-uq --help`."


def _problem(parameter: Any, value: object) -> str:
    """What is wrong with a value that does not fit the declaration of its parameter."""
    kind = parameter.type_descriptor
    if kind.choices is not None:
        return f"{shown(value)} is unknown: use one of {', '.join(kind.choices)}."
    kinds = {kind.annotation, *get_args(kind.annotation)}
    return f"{shown(value)}: {wanted(parameter.min, parameter.max, int in kinds)}."
