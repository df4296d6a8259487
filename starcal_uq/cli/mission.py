"""What an analyst asks after the calibration: budget, compare, plan."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

import starcal_uq as sc
from starcal_uq.cli.answers import Answer
from starcal_uq.cli.console import STYLES, note, print_table, progress_bar, say, tell
from starcal_uq.cli.options import check_same_sensor, parse_labels
from starcal_uq.cli.settings import (
    SIGMA_PX,
    BudgetFiles,
    CampaignSettings,
    ChoiceSettings,
    EffectSettings,
    ForecastSettings,
    TieSettings,
    TrackerSettings,
)
from starcal_uq.core import settings
from starcal_uq.core.files import check_new_folder, ensure_new
from starcal_uq.core.settings import KEYS
from starcal_uq.core.types import AnyDict

if TYPE_CHECKING:
    from starcal_uq.budgeting.result import Budget
    from starcal_uq.camera.camera import Camera
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.likelihood.noise_model import NoiseModel
    from starcal_uq.planning.check import ForecastCheck
    from starcal_uq.planning.design import FrameChoice
    from starcal_uq.planning.planned import Plan
    from starcal_uq.planning.ties import PlannedTies
    from starcal_uq.simulation.noise import Noise


def check_output(out: Path | None, command: str, force: bool) -> None:
    """Refuse a folder that holds something, and one of another command's results even with
    `force`.
    """
    from starcal_uq.core.manifest import refuse_others

    if out is not None:
        refuse_others(out, (command,))
        check_new_folder(out, force)


def budget_command(
    files: BudgetFiles,
    run: Path | None = None,
    heads: Path | None = None,
    file: Path | None = None,
    confidence: float | None = None,
    temperature_profile: Path | None = None,
    seed: int = 0,
    force: bool = False,
) -> Answer:
    """Attitude error budget in the terms of ECSS; status 1 when a requirement is violated."""
    from starcal_uq.presentation.pages.budgeting import FORMATS

    template, out = files.template, files.named(run)
    if template is not None and file is not None and template.resolve() == file.resolve():
        raise typer.BadParameter(f"--template would write over {file}: name another file.")
    for path in out:
        if path.suffix.lower() not in FORMATS:
            raise typer.BadParameter(
                f"{path}: the ending names the format; use one of {', '.join(FORMATS)}."
            )
        ensure_new(path, force)
    if heads is not None and run is None:
        if any(one is not None for one in (file, template, temperature_profile)):
            raise typer.BadParameter(
                "--heads takes budgets of the heads as they are: give --budget, --template and "
                "--temperature-profile to the budget of each."
            )
        found = sc.budgeting.array_budget(heads, confidence=confidence, seed=seed)
        return _deliver(found, heads, [], out)
    if run is None or heads is not None:
        raise typer.BadParameter(
            "give the run folder RUN, or --heads FILE with those of the heads."
        )
    opened = sc.Run(run, tell=note)
    if template is not None:
        rows = sc.budget(opened.posterior, opened.observations, opened.attitude, seed=seed).rows
        sc.budgeting.write_budget_template(template, rows, force=force)
        say(
            f"Budget file to fill in: {template}. Next: starcal-uq budget {run} --budget {template}"
        )
        return Answer({"run": run, "files": [], "template": template, "budget": None})
    # Without a question of its own, the call shows what is there.
    asked: AnyDict = {
        "file": file,
        "confidence": confidence,
        "temperature_profile": temperature_profile,
    }
    if opened.has("budget") and not force and all(value is None for value in asked.values()):
        found = opened.error_budget
    else:
        found = opened.budget(**asked, seed=seed, force=force)
    return _deliver(found, run, [run / "budget.csv"], out)


def _deliver(found: Budget, of: Path, written: list[Path], out: list[Path]) -> Answer:
    """Write a budget of a run or of heads where it is not, and show it."""
    from starcal_uq.presentation.pages.write import write_page

    for path in out:
        write_page(found, path)
    show_budget(found)
    files = [*written, *out]
    if files:
        say(f"Budget: {', '.join(map(str, files))}")
    tell_violations(found)
    results = {"run": of, "files": files, "template": None, "budget": found}
    return Answer(results, int(bool(found.violations)))


def show_budget(found: Budget) -> None:
    """Contributors, totals, requirements and what must be read with them, in the terminal."""
    from starcal_uq.presentation.words.budgeting import (
        contributors_table,
        explanations,
        indices_table,
        totals_table,
    )
    from starcal_uq.presentation.words.sentences import rows

    print_table(contributors_table(found))
    print_table(totals_table(found))
    if found.index_totals:
        print_table(indices_table(found))
    if found.filter:
        print_table(rows("filter", found))
    for sentence in (*explanations(found), *found.notes):
        say(sentence)
    for outcome in found.outcomes:
        say(outcome.text, style=STYLES[outcome.level])
    say(found.text)


def tell_violations(found: Budget) -> None:
    """Say which requirements are violated."""
    for outcome in found.violations:
        tell(f"violated: {outcome.text}")


def compare_command(
    runs: list[Path],
    out: Path | None = None,
    split: settings.Split | None = None,
    labels: str | None = None,
    same_data: bool | None = None,
    level: float = 0.01,
    seed: int = 0,
    force: bool = False,
) -> Answer:
    """Do two calibrations differ by more than chance? The rotation between them is taken out and
    stated.
    """
    from starcal_uq.presentation.pages.write import write_page
    from starcal_uq.presentation.words.sentences import rows

    if len(runs) != (2 if split is None else 1):
        raise typer.BadParameter(
            "give two run folders, or one with --split odd-even."
            if split is None
            else f"--split compares parts of one run: leave out {runs[-1]}."
        )
    check_output(out, "compare", force)
    options: dict[str, Any] = {"level": level, "seed": seed}
    names = parse_labels(labels)
    if split is None:
        found = sc.runs.compare_runs(*runs, labels=names, same_data=same_data, **options)
    else:
        found = sc.runs.compare_split(
            runs[0], split, **(options if names is None else options | {"labels": names})
        )
    page = None if out is None else write_page(found, out)
    print_table(rows("compared", found))
    say(found.text)
    if page is not None:
        say(f"Page: {page.resolve()}")
    own = {
        "page": page,
        "differences": found.to_dataframe(),
        "text": found.text,
        "agree": found.agree,
    }
    return Answer({**found.to_dict(), **own, "rotation_sigma_arcsec": found.rotation_sigma_arcsec})


def plan_command(
    camera: Path,
    forecast: ForecastSettings,
    campaign: CampaignSettings,
    tracker: TrackerSettings,
    choices: ChoiceSettings,
    rotations: TieSettings,
    expected: EffectSettings,
    out: Path | None = None,
    force: bool = False,
) -> Answer:
    """What a calibration of this camera will give, and the frames it needs, before any data."""
    from starcal_uq.planning.effects import PlannedEffects
    from starcal_uq.planning.forecast import N_FRAMES
    from starcal_uq.presentation.pages.write import write_page
    from starcal_uq.presentation.tables import TextTable

    check_output(out, "plan", force)
    after, choose, check = campaign.after, choices.choose, choices.check
    heads = None if choices.heads is None else sc.attitude.load_heads(choices.heads)
    if after is not None and check is not None:
        raise typer.BadParameter(
            "--check simulates campaigns from nothing: leave it out with --after."
        )
    ties = _planned_ties(rotations)
    if ties is not None and (choose is not None or check is not None):
        raise typer.BadParameter(
            "--choose and --check know no rotations between frames: leave them out, or leave out "
            "--relative-attitudes-arcsec and --mount-sigma-arcsec."
        )
    planned = None
    if expected.effects is not None:
        planned = PlannedEffects.parsed(
            expected.effects, expected.temperature_range, expected.nights
        )
        if choose is not None or check is not None:
            raise typer.BadParameter(
                "--choose and --check plan calibrations without effects: leave them out."
            )
    sheet, known = sc.Camera.load(camera), None
    noise: Noise = SIGMA_PX
    if after is not None:
        known, noise = _known(after, sheet, camera)
        sheet = known.camera
    seen = tracker.options(sheet, campaign.sigma, noise)
    # Deeper than the sensor, so that the sweep over the magnitude limit has somewhere to go.
    deepest = min(forecast.max_mag + 1.0, KEYS["magnitude"].high)
    deep = sc.load_catalogue(max_mag=deepest, epoch=campaign.epoch)
    stars = deep.select(deep.mag <= forecast.max_mag)
    names = ("min_stars", "max_stars", "seed")
    common: AnyDict = {name: getattr(forecast, name) for name in names}
    sizes = tuple(campaign.frames or N_FRAMES)
    with progress_bar("points of the sweeps") as progress:
        found = sc.plan(
            sheet,
            deep,
            n_frames=sizes,
            after=known,
            ties=ties,
            effects=planned,
            progress=progress,
            **seen,
            **vars(forecast),
        )
    choice = simulated = None
    if choose is not None:
        choice = sc.planning.choose_frames(
            sheet,
            stars,
            n_frames=choose,
            criterion=choices.criterion,
            scope="calibration" if forecast.scope == "total" else forecast.scope,
            after=known,
            **seen,
            **common,
        )
    if check is not None:
        with progress_bar("simulated campaigns") as progress:
            simulated = sc.planning.check_forecast(
                sheet,
                stars,
                n_frames=sizes,
                n_campaigns=check,
                progress=progress,
                **seen,
                **common,
            )
    page = None if out is None else write_page(found, out, choice=choice, check=simulated)
    notes = _show_plan(found, choice, simulated)
    geometry = None if heads is None else heads.geometry(found.attitude_noise)
    if geometry is not None:
        title = "Centroid noise of one frame about X, Y and Z of the body, 1 sigma"
        print_table(TextTable.of(geometry, title))
    if page is not None:
        say(f"Page: {page.resolve()}")
    results = {"page": page, "plan": found, "choice": choice, "check": simulated, "notes": notes}
    results["heads"] = geometry
    return Answer(results, int(forecast.target_arcsec is not None and found.frames_needed is None))


def _planned_ties(rotations: TieSettings) -> PlannedTies | None:
    """Rotations that will be known, of a chain or of a fixed mount."""
    chain, mount = rotations.relative_attitudes_arcsec, rotations.mount_sigma_arcsec
    alignment = rotations.relative_alignment_arcsec
    if chain is not None and mount is not None:
        raise typer.BadParameter(
            "--relative-attitudes-arcsec and --mount-sigma-arcsec exclude each other: leave one of "
            "them out."
        )
    if chain is None and alignment:
        raise typer.BadParameter(
            "--relative-alignment-arcsec needs --relative-attitudes-arcsec: give both, or leave it "
            "out."
        )
    sigma = mount if chain is None else chain
    return None if sigma is None else sc.planning.PlannedTies(sigma, alignment, mount is not None)


def _show_plan(
    found: Plan, choice: FrameChoice | None, simulated: ForecastCheck | None
) -> list[str]:
    """Show the plan; the sentences beside its own text."""
    from starcal_uq.presentation.words.planning import costs_table
    from starcal_uq.presentation.words.sentences import rows, told

    print_table(rows("plan", found))
    costs = found.effects
    if costs is not None:
        print_table(costs_table(costs))
    notes = [
        told("costs", costs),
        told("open_distortion", found),
        told("planned_ties", found),
        *(told("need_by_part", need, spread=found.distortion) for need in found.needs),
    ]
    notes = [sentence for sentence in notes if sentence]
    words = [found.text, *notes]
    if choice is not None:
        print_table(rows("choice", choice))
        words.append(choice.text)
    if simulated is not None:
        words.append(simulated.text)
    for sentence in words:
        say(sentence)
    return notes


def _known(run: Path, sheet: Camera, path: Path) -> tuple[Calibration, float | NoiseModel]:
    """Calibration of a run of this sensor, and its noise in px: the median where stars state their
    own.
    """
    from dataclasses import replace

    import numpy as np

    known = sc.Run(run)
    obs, calibration = known.observations, known.calibration
    check_same_sensor(calibration.camera, run, sheet, path)
    model = calibration.noise_model
    if model is not None and model.varies and not model.multiplies:
        return calibration, replace(model, level_px=model.level_px * calibration.sigma)
    stated = (
        1.0
        if obs.sigma_px is None or calibration.sigma_name == "sigma"
        else float(np.median(obs.sigma_px))
    )
    return calibration, float(calibration.sigma) * stated
