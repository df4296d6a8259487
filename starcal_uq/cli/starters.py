"""Starter files: one with comments for each file that people write, and an example to try
everything on.
"""

from __future__ import annotations

from pathlib import Path

import typer

import starcal_uq as sc
from starcal_uq.cli.answers import Answer
from starcal_uq.cli.console import say
from starcal_uq.core import runfile, settings


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
        files = ", ".join(
            str(path / name)
            for name in ("stars.ecsv", "camera.toml", "site.toml", "NOTICE (whose data)")
        )
        following = f"starcal-uq run {path / 'stars.ecsv'} {path / 'camera.toml'} -o RUN"
    elif what == "run":
        runfile.write_template(path, force)
        following = f"put in your files and options, then starcal-uq run {path}"
    elif what == "camera":
        start = sc.paper.paper_start()
        # The centre of the detector, where the paper has a corner of its four middle pixels.
        x0, y0 = start.centre_px
        start.replace(name="my camera", x0_px=x0, y0_px=y0).save(path, force=force)
        following = f"put in the numbers of your data sheet, then starcal-uq run OBS {path} -o RUN"
    elif what == "sensor":
        sc.simulation.Sensor().save(path, force=force)
        following = (
            f"put in the numbers of your tracker, then starcal-uq plan CAMERA --sensor {path}"
        )
    elif what == "site":
        example = sc.sky.Site(
            52.0, 4.4, 10.0, pressure_hpa=1013.0, temperature_c=15.0, relative_humidity=0.5
        )
        (example if near is None else sc.sky.Site(*near)).save(path, force=force)
        following = (
            f"put in where the camera stood, then starcal-uq run OBS CAMERA -o RUN --site {path}"
        )
    elif what == "budget":
        sc.budgeting.write_budget_template(path, force=force)
        following = (
            f"take away the marks before what you know, then starcal-uq budget RUN --budget {path}"
        )
    else:
        sc.studies.write_study_template(template or "fov-distortion", path, force)
        following = f"change what is varied, then starcal-uq study {path} -o DIR"
    say(f"{files if what == 'example' else path}: {following}")
    return Answer({"file": path, "text": following})
