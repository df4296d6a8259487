"""What is printed to try, followed to its end, on tables with one planted misfit each."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import starcal_uq as sc
from starcal_uq.cli.commands import app
from starcal_uq.cli.runfiles import expand
from starcal_uq.core.conflicts import conflict, named, parsed
from tests.helpers.ground_scenes import NOMINAL, ground_frames
from tests.helpers.outside import campaign

CORNER = 512.0 * np.sqrt(2.0)
# Enough for the checks of the draws, and small in all else.
SMALL = ("--draws", "50", "--alignment-frames", "20")
LONGEST = 8
# A command line -> status, standard output, standard error.
Call = Callable[[Sequence[str]], tuple[int, str, str]]


def _out(uv: Any) -> Any:
    return uv / np.maximum(np.hypot(*uv), 1e-9)


def _rho(uv: Any) -> Any:
    return np.hypot(*uv) / CORNER


# Shifts of stars in px by what the model of the camera does not hold.
DISPLACED: dict[str, Callable[[Any, Any, Any, int], Any]] = {
    "k3, 1 px at the corner": lambda uv, xy, mag, frame: 1.0 * _rho(uv) ** 7 * _out(uv),
    "decentring, 0.5 px": lambda uv, xy, mag, frame: (
        0.5 * np.stack([_rho(uv) ** 2 + 2 * (uv[0] / CORNER) ** 2, 2 * uv[0] * uv[1] / CORNER**2])
    ),
    "radial wave, 0.3 px": lambda uv, xy, mag, frame: 0.3 * np.sin(2 * np.pi * _rho(uv)) * _out(uv),
    "fast radial wave, 0.2 px": lambda uv, xy, mag, frame: (
        0.2 * np.sin(6 * np.pi * _rho(uv)) * _out(uv)
    ),
    "twist, 0.3 px": lambda uv, xy, mag, frame: (
        0.3 * _rho(uv) ** 3 * np.stack([-_out(uv)[1], _out(uv)[0]])
    ),
    "scale of x against y, 0.3 px": lambda uv, xy, mag, frame: (
        0.3 / CORNER * np.stack([uv[0], -uv[1]])
    ),
    "skew of the axes, 0.3 px": lambda uv, xy, mag, frame: 0.3 / CORNER * np.stack([uv[1], uv[0]]),
    "waves over the field, 0.2 px": lambda uv, xy, mag, frame: 0.2 * np.sin(uv / 90.0),
    "one corner bent, 1 px": lambda uv, xy, mag, frame: (
        np.where((uv[0] > 250) & (uv[1] > 250), 1.0, 0.0) * _out(uv)
    ),
    "pixel phase in x, 0.08 px": lambda uv, xy, mag, frame: np.stack(
        [0.08 * np.sin(2 * np.pi * xy[0]), 0 * xy[1]]
    ),
    "pixel phase in y, 0.08 px": lambda uv, xy, mag, frame: np.stack(
        [0 * xy[0], 0.08 * np.sin(2 * np.pi * xy[1])]
    ),
    "shift with magnitude, 0.1 px": lambda uv, xy, mag, frame: np.outer([0.1, -0.05], mag - 4.0),
    "scale with magnitude, 0.2 px": lambda uv, xy, mag, frame: 0.2 * uv / CORNER * (mag - 4.0),
    "drift of f, 0.5 px": lambda uv, xy, mag, frame: 0.5 * uv / CORNER * (frame - 12.0) / 12.0,
    "drift of the centre, 0.3 px": lambda uv, xy, mag, frame: (
        0.3 * (frame - 12.0) / 12.0 * np.stack([uv[0] ** 2, uv[0] * uv[1]]) / CORNER**2
    ),
    "another camera from the middle on": lambda uv, xy, mag, frame: 0.01 * uv * (frame >= 12),
    "f of each frame, 0.3 px": lambda uv, xy, mag, frame: 0.3 * uv / CORNER * np.sin(7.0 * frame),
}
NOISY: dict[str, dict[str, Any]] = {
    "none": {},
    "noise grows with radius": {"sigma_px": lambda radius, mag, frame: 0.03 * (1.0 + 3.0 * radius)},
    "noise grows with magnitude": {
        "sigma_px": lambda radius, mag, frame: 0.02 * 1.6 ** (mag - 2.0)
    },
    "noise of each frame": {"sigma_px": lambda radius, mag, frame: 0.05 * (1.0 + (frame % 3))},
    "noise of 3 px": {"sigma_px": 3.0},
    "strong distortion": {"corner_px": (40.0, -10.0)},
    "errors of the stars, 0.05 px": {"patch_stars": 30, "star_sigma_px": 0.05},
    "errors of the stars, 0.3 px": {"patch_stars": 30, "star_sigma_px": 0.3},
}
ALTERED = (
    "2 % wrong stars",
    "10 % wrong stars",
    "heavy tails",
    "noise of x four times that of y",
)
ON_THE_GROUND = (
    "refraction, with times",
    "refraction, without times",
)
PLANTED = (*NOISY, *DISPLACED, *ALTERED, *ON_THE_GROUND)


def plant(name: str, folder: Path, seed: int = 7) -> tuple[str, ...]:
    """Write a table with the misfit and a data sheet; the words of the command that runs them."""
    table, sheet = folder / "table.csv", folder / "sheet.toml"
    declared = ("--directions", "apparent", "--in-space")
    if name in ON_THE_GROUND:
        stars = sc.load_catalogue(max_mag=6.5, epoch=2026.9)
        obs = ground_frames(stars, np.linspace(25.0, 80.0, 16), seed=seed)
        if "without" in name:
            obs = sc.Observations(
                **{key: value for key, value in obs.columns.items() if key != "time_utc"}
            )
        NOMINAL.save(sheet)
        obs.save(table)
        declared = ("--directions", "apparent" if "without" in name else "catalogue")
        return ("run", str(table), str(sheet), *declared, *SMALL)
    rng = np.random.default_rng(seed)
    options = NOISY.get(name, {"displaced": DISPLACED[name]} if name in DISPLACED else {})
    c = campaign(rng, n_frames=24, stars_per_frame=20, **options)
    columns = dict(c.columns)
    n = len(columns["frame"])
    if "wrong stars" in name:
        wrong = rng.random(n) < float(name.split(" %")[0]) / 100.0
        columns["x_px"] = columns["x_px"] + wrong * rng.uniform(3.0, 30.0, n)
    if name == "heavy tails":
        columns |= {
            axis: columns[axis] + 0.04 * rng.standard_t(2.0, n) for axis in ("x_px", "y_px")
        }
    if name.startswith("noise of x"):
        columns["x_px"] = columns["x_px"] + 0.19 * rng.standard_normal(n)
    on = [(columns[axis] > 0.0) & (columns[axis] < 1023.0) for axis in ("x_px", "y_px")]
    sc.Observations(**{key: values[on[0] & on[1]] for key, values in columns.items()}).save(table)
    sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0)).save(sheet)  # type: ignore[arg-type]
    return ("run", str(table), str(sheet), *declared, *SMALL)


@dataclass(frozen=True)
class Step:
    """One command and how it ended: options, exit status, checks that failed or warned, commands
    that are printed.
    """

    options: dict[str, tuple[str | None, ...]]
    status: int
    doubts: tuple[int, int]
    commands: tuple[str, ...]
    said: str


def printed(out: str) -> tuple[str, ...]:
    """The commands that are to be tried."""
    whole = re.sub(r"\s*\\\n\s*", " ", out)
    return tuple(
        line.strip().removeprefix("try: ")
        for line in whole.splitlines()
        if line.strip().startswith("try: ")
    )


def options_of(words: Sequence[str]) -> dict[str, tuple[str | None, ...]]:
    """Options of a command line; those of a run file, with its edits, are those that it holds."""
    options = parsed(expand(words, app.commands))[1]
    return {name: values for name, values in options.items() if name != "--out"}


def follow(call: Call, words: Sequence[str], folder: Path) -> list[Step]:
    """Follow the first command that is printed, literally, until there is none; all are checked on
    the way.

    AssertionError where a command does not run, changes nothing, repeats an option, or was there
    before.
    """
    steps: list[Step] = []
    lines = [[*words, "-o", str(folder / "run"), "--force"]]
    while True:
        for line in lines:
            status, out, err = call(line)
            assert status in (0, 1), (line, status, err[-400:])
        options = options_of(lines[-1])
        assert options not in [step.options for step in steps], (lines[-1], "was there before")
        assert all(len(values) == 1 for name, values in options.items() if name != "--column"), (
            lines[-1]
        )
        found = re.search(r"Checks: (.*) of \d+", out)
        assert found is not None, (lines, out[-600:])
        counts = {
            word: int(number)
            for number, word in re.findall(r"(\d+) (passed|gave|failed)", found[1])
        }
        commands = printed(out)
        assert len(commands) <= 3
        runs = [
            command
            for command in commands
            if command.split(" && ")[-1].startswith("starcal-uq run ")
        ]
        for command in runs:
            asked = options_of(shlex.split(command.split(" && ")[-1])[1:])
            assert conflict(named(asked)) is None, command
            assert asked not in [*(step.options for step in steps), options], command
            assert not {"UTC", "SITE", "OBS", "CAMERA"} & set(shlex.split(command)), command
        whole = " ".join(out.split())
        said = whole if "no model here explains this" in whole else ""
        doubts = counts.get("failed", 0), counts.get("gave", 0)
        # A failure that nothing is left to try against is said to be one, with the data that would
        # tell.
        assert bool(said) == (bool(doubts[0]) and not commands), (options, out[-1500:])
        assert not said or all(
            words in said for words in ("Not usable, because ", "would tell: ")
        ), said
        summary = out.splitlines()
        # The table of the calibration begins like the summary, which stands last.
        begun = [i for i, line in enumerate(summary) if re.match(r"\S+: [\d\W]+ stars? in", line)]
        assert len(summary[begun[-1] :]) <= 24, out[-2500:]
        steps.append(Step(options, status, doubts, commands, said))
        for command in set(commands) - set(runs):
            status, _, err = call(shlex.split(command)[1:])
            assert status in (0, 1), (command, status, err[-400:])
        if not runs:
            return steps
        assert len(steps) < LONGEST, [step.options for step in steps]
        lines = [shlex.split(line)[1:] for line in runs[0].split(" && ")]


def row(name: str, steps: Sequence[Step]) -> tuple[str, str, str, str]:
    """A misfit, what it failed at first, what was tried, and how it ended, for a table."""
    start = steps[0].options
    tried = []
    for step in steps[1:]:
        words = [
            word
            for name, values in step.options.items()
            if start.get(name) != values
            for word in (name, *values)
        ]
        shown = " ".join(
            "SITE" if str(word).endswith(".toml") else str(word) for word in words if word
        )
        tried.append(f"`{shown}` {step.doubts[0]}, {step.doubts[1]}")
    last = steps[-1]
    end = (
        "passes"
        if last.doubts == (0, 0)
        else "warnings, no command left"
        if last.doubts[0] == 0
        else "no model here"
    )
    end = "more frames (`plan`)" if last.commands else end
    return name, f"{steps[0].doubts[0]}, {steps[0].doubts[1]}", " → ".join(tried) or "–", end
