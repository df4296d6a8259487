"""Starter files: one with comments for each file that people write, and an example to try
everything on.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import typer

import starcal_uq as sc
from starcal_uq.cli.answers import Answer
from starcal_uq.cli.console import say
from starcal_uq.core import runfile, settings

_WORDS = tomllib.loads(Path(__file__).with_name("starters.toml").read_text("utf-8"))


def new_command(
    what: settings.Starter,
    out: Path | None = None,
    template: settings.StudyTemplate | None = None,
    near: tuple[float, float] | None = None,
    force: bool = False,
) -> Answer:
    """Write a starter file with comments (run, camera, sensor, site, budget, study), or real data
    to try everything on.
    """
    if template is not None and what != "study":
        raise typer.BadParameter(f"--template belongs to a study, and this is a new {what}.")
    if near is not None and what != "site":
        raise typer.BadParameter(f"--near belongs to a site, and this is a new {what}.")
    path = Path("esa" if what == "example" else f"{what}.toml") if out is None else out
    if what == "example":
        sc.example_data("esa").save(path, force=force)
    elif what == "run":
        runfile.write_template(path, force)
    elif what == "camera":
        start = sc.paper.paper_start()
        # The centre of the detector, where the paper has a corner of its four middle pixels.
        x0, y0 = start.centre_px
        start.replace(name="my camera", x0_px=x0, y0_px=y0).save(path, force=force)
    elif what == "sensor":
        sc.simulation.Sensor().save(path, force=force)
    elif what == "site":
        example = sc.sky.Site(
            52.0, 4.4, 10.0, pressure_hpa=1013.0, temperature_c=15.0, relative_humidity=0.5
        )
        (example if near is None else sc.sky.Site(*near)).save(path, force=force)
    elif what == "budget":
        sc.budgeting.write_budget_template(path, force=force)
    else:
        sc.studies.write_study_template(template or "fov-distortion", path, force)
    following = _WORDS["following"][what].format(path=path)
    files = _WORDS["files"].get(what, "{path}").format(path=path)
    say(f"{files}: {following}")
    return Answer({"file": path, "text": following})
