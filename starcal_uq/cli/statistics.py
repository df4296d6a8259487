"""Commands that question results: validate, diagnose, merge."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import starcal_uq as sc
from starcal_uq.cli.answers import Answer
from starcal_uq.cli.console import note, print_table, progress_bar, say, show_calibration
from starcal_uq.cli.settings import ValidationSettings
from starcal_uq.core import settings
from starcal_uq.core.files import atomic_write_bytes, write_csv


def validate_command(
    camera: Path,
    study: ValidationSettings,
    out: Path | None = None,
    force: bool = False,
) -> Answer:
    """Show that the intervals are right for this sensor and this volume of data, by
    simulation-based calibration.

    With `-o`, replicates are kept as they are made: an interrupted command resumes, also with more
    of them.
    """
    from starcal_uq.core.manifest import making
    from starcal_uq.presentation.words.sentences import rows

    sensor = sc.Camera.load(camera)
    with (
        nullcontext()
        if out is None
        else making(out, "validate", "validation.npz", force=force) as stage
    ):
        with progress_bar("replicates") as progress:
            found = sc.validate(sensor, **vars(study), progress=progress, keep=out)
        if found.interrupted:
            raise KeyboardInterrupt
        table = found.to_dataframe()
        if stage is not None:
            from starcal_uq.presentation.figures.style import png_bytes

            found.save(stage / "validation.npz")
            write_csv(table, stage / "validation.csv")
            atomic_write_bytes(stage / "validation.png", png_bytes(found.plot.ranks()))
    print_table(rows("validation", found))
    say(found.text, style="green" if found.ok else "red")
    if out is not None:
        say(f"Figure: {(out / 'validation.png').resolve()}")
    results = {"folder": out, "ok": found.ok, "quantities": table, "text": found.text}
    return Answer(results, int(not found.ok))


def diagnose_command(
    run: Path,
    starts: int = 5,
    seed: int = 0,
    force: bool = False,
) -> Answer:
    """Question the model: misfit, jackknife, other distortion models, predictive checks, other
    starts.
    """
    from starcal_uq.presentation.words.diagnostics import (
        jackknife_table,
        misfit_table,
        models_table,
        predictive_table,
        star_table,
    )

    with progress_bar("diagnosis") as progress:
        found = sc.Run(run, tell=note).diagnose(
            n_starts=starts, seed=seed, force=force, progress=progress
        )
    print_table(misfit_table(found.misfit, found_only=True))
    if found.jackknife is not None:
        print_table(jackknife_table(found.jackknife))
    if found.stars is not None:
        print_table(star_table(found.stars))
    if found.comparison is not None:
        print_table(models_table(found.comparison))
    print_table(predictive_table(found.predictive))
    for part in (found.comparison, found.stars):
        if part is not None:
            say(part.text)
    return Answer({"run": run, "diagnosis": found})


def merge_command(
    runs: list[Path],
    out: Path,
    noise: settings.MergedNoise = "auto",
    allow_inconsistent: bool = False,
    duplicates: settings.Duplicates = "refuse",
    force: bool = False,
) -> Answer:
    """Combine the likelihoods of several runs into one, without going back to the stars; tests that
    they agree.
    """
    from starcal_uq.presentation.words.sentences import rows

    merged = sc.runs.merge_runs(
        runs,
        out,
        noise=noise,
        allow_inconsistent=allow_inconsistent,
        duplicates=duplicates,
        force=force,
    )
    agreement = sc.estimation.consistency_of(merged)
    if agreement is not None:
        print_table(rows("consistency", agreement))
        words = agreement.messages or ("The runs agree.",)
        say(f"{' '.join(words)} (p = {agreement.p_value:.2g})")
    show_calibration(merged)
    say(f"Run folder: {out}. Next: starcal-uq sample {out}")
    return Answer({"run": out, "calibration": merged, "consistency": agreement})
