"""`reproduce`: the paper's experiment again, from simulation to report."""

from __future__ import annotations

from pathlib import Path

from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.files import atomic_write_text
from starcal_uq.core.manifest import making
from starcal_uq.core.provenance import provenance
from starcal_uq.core.settings import Seed, bounded, seed_of
from starcal_uq.core.types import AnyDict, PathLike, Progress
from starcal_uq.paper.camera import paper_camera, paper_start
from starcal_uq.paper.checks import paper_checks
from starcal_uq.paper.commands import Bar, write_tables
from starcal_uq.paper.interaction import interaction_study
from starcal_uq.paper.published import PAPER_METHODS
from starcal_uq.paper.readings import run_readings
from starcal_uq.paper.replicates import replicate
from starcal_uq.paper.result import REPORT, Reproduction, judge_all, run_paper
from starcal_uq.paper.show.pages import reproduction_figures, reproduction_page

# Replicates of every reading, and of the study: enough for z-values to ten per cent, and for the
# figure.
N_READING_DRAWS = 12
N_STUDY_REPLICATES = 8
# Work of each part in common units, for the progress bar.
_SHARES = {"run": 10, "readings": 150, "replicates": 640, "study": 150, "report": 50}


@bounded
def reproduce(
    out: PathLike,
    *,
    n_replicates: int = 200,
    n_frames: int = 1000,
    seed: Seed = 2017,
    convention: str = "eq14",
    workers: int | None = None,
    progress: Progress | None = None,
    study: bool = True,
    force: bool = False,
) -> Reproduction:
    """Run the experiment of Ye & Yang 2017 again and set each of their numbers beside ours.

    Parameters
    ----------
    out : path
        Folder to write: ``reproduction.html`` (self-contained), ``table_2.csv``, ``rows.csv``,
        ``published.csv``, ``trials.csv``, ``checks.csv``, ``errors.csv``, ``replicates.csv``,
        ``replicates.npz``, ``interaction.csv``, and the figures as PNG in ``figures``. They are
        written when everything is computed; until then data sets that are done are kept in the
        folder, and an interrupted call resumes from them.
    n_replicates : int
        Data sets over which every method is repeated, at least 8; the filter that takes pairs as
        independent, a slow option, has a quarter of them.
    n_frames : int
        Frames in each; at least 20. The paper has 1000.
    seed : int or Generator
        The same seed gives the same numbers, for any number of processes.
    convention : {"eq14", "eq6"}
        The equation of the paper that the simulated distortion follows in the main reading.
    workers : int, optional
        Processes; as many as there are processors by default, 0 for none beside this one.
    progress : callable, optional
        Called as ``progress(done, total)``, in units of work.
    study : bool
        Also vary the experiment along four axes (`interaction_study`).
    force : bool
        Replace earlier results, when those of this call are complete; other files in the folder
        stay.

    Raises
    ------
    RunFolderError
        If the folder holds files and `force` is false, or cannot be written.
    CalibrationError
        For numbers that are too small, or when a method never gave a result.
    CameraError
        For an unknown convention.
    SamplingError
        If processes cannot be used.
    KeyboardInterrupt
        After Ctrl-C; the same call then resumes.
    """
    seed = seed_of(seed)
    if n_replicates < 8:
        raise CalibrationError(
            f"n_replicates is {n_replicates}: a comparison over seeds needs at least 8."
        )
    if n_frames < 20:
        raise CalibrationError(f"n_frames is {n_frames}: the experiment needs at least 20.")
    bar = Bar(
        progress, {name: share for name, share in _SHARES.items() if study or name != "study"}
    )
    with making(out, "reproduce", REPORT, force=force) as stage:
        found = _reproduced(
            Path(out), n_replicates, n_frames, seed, convention, workers, study, bar
        )
        figures = reproduction_figures(found)
        page = reproduction_page(found, figures)
        write_tables(stage, found.tables(), figures)
        found.replicates.save(stage / "replicates.npz")
        atomic_write_text(stage / REPORT, page)
    bar.finish("report")
    return found


def _reproduced(
    folder: Path,
    n_replicates: int,
    n_frames: int,
    seed: int,
    convention: str,
    workers: int | None,
    study: bool,
    bar: Bar,
) -> Reproduction:
    """All numbers; data sets that are done are kept in the folder."""
    truth, start = paper_camera(convention), paper_start(convention)
    run = run_paper(convention=convention, n_frames=n_frames, seed=seed)
    bar.finish("run")
    readings = run_readings(
        convention=convention,
        n_draws=min(N_READING_DRAWS, n_replicates),
        n_frames=n_frames,
        seed=seed,
        workers=workers,
        progress=bar.part("readings"),
        keep=folder,
    )
    replicates = replicate(
        truth=truth,
        start=start,
        share_slow=True,
        n_replicates=n_replicates,
        n_frames=n_frames,
        seed=seed,
        workers=workers,
        progress=bar.part("replicates"),
        keep=folder,
    )
    _stop_if(replicates.interrupted)
    varied = None
    if study:
        varied = interaction_study(
            truth=truth,
            start=start,
            n_replicates=N_STUDY_REPLICATES,
            seed=seed,
            workers=workers,
            progress=bar.part("study"),
            keep=folder,
        )
        _stop_if(varied.interrupted)
    settings: AnyDict = {
        "convention": convention,
        "n_replicates": n_replicates,
        "n_frames": n_frames,
    }
    settings |= {"n_reading_draws": readings.n_draws, "study": study}
    calibrations = {name: run.of(name) for name in PAPER_METHODS}
    sigmas = {
        name: dict(zip(c.parameter_names, c.sigmas.tolist(), strict=True))
        for name, c in calibrations.items()
    }
    return Reproduction(
        path=folder,
        run=run,
        replicates=replicates,
        readings=readings,
        judged=judge_all(readings, replicates),
        checks=paper_checks(truth, run.observations.xy, sigmas),
        study=varied,
        provenance=provenance(seed, settings, run.observations.data_hash),
    )


def _stop_if(interrupted: bool) -> None:
    if interrupted:
        raise KeyboardInterrupt
