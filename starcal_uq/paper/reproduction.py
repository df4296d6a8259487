"""`reproduce`: the paper's experiment again, from simulation to report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.files import (
    PathLike,
    atomic_path,
    atomic_write_bytes,
    atomic_write_text,
    check_new_folder,
    new_folder,
)
from starcal_uq.core.provenance import provenance
from starcal_uq.core.types import AnyDict
from starcal_uq.paper.published import PAPER_METHODS

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.core.tasks import Progress
    from starcal_uq.paper.experiment import PaperRun
    from starcal_uq.paper.result import Reproduction

# Replicates of every reading, and of the study: enough for z-values to ten per cent, and for the figure.
N_READING_DRAWS = 12
N_STUDY_REPLICATES = 8
# Work of each part in common units, for the progress bar.
_SHARES = {"run": 10, "readings": 150, "replicates": 640, "study": 150, "report": 50}


def reproduce(
    out: PathLike,
    *,
    n_replicates: int = 200,
    n_frames: int = 1000,
    seed: int = 2017,
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
        Folder to write: ``reproduction.html`` (self-contained), ``table_2.csv``, ``rows.csv``, ``published.csv``,
        ``trials.csv``, ``checks.csv``, ``errors.csv``, ``replicates.csv``, ``replicates.npz``, ``interaction.csv``, and
        the figures as PNG in ``figures``. Nothing is written before everything is computed.
    n_replicates : int
        Data sets over which every method is repeated, at least 8; the filter that takes pairs as independent, a slow
        option, has a quarter of them.
    n_frames : int
        Frames in each; at least 20. The paper has 1000.
    seed : int
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
        Write into a folder that holds files already; those of the same names are replaced.

    Returns
    -------
    Reproduction

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
        After Ctrl-C; nothing is written then.
    """
    from starcal_uq.paper.camera import paper_camera, paper_start
    from starcal_uq.paper.checks import paper_checks
    from starcal_uq.paper.experiment import run_paper
    from starcal_uq.paper.interaction import interaction_study
    from starcal_uq.paper.readings import run_readings
    from starcal_uq.paper.replicates import replicate_shared
    from starcal_uq.paper.result import Reproduction
    from starcal_uq.paper.table_2 import judge_all

    folder = Path(out)
    check_new_folder(folder, force)
    _check_sizes(n_replicates, n_frames)
    bar = _Bar(progress, study)
    truth, start = paper_camera(convention), paper_start(convention)
    run = run_paper(convention=convention, n_frames=n_frames, seed=seed)
    bar.finish("run")
    readings, interrupted = run_readings(
        convention=convention,
        n_draws=min(N_READING_DRAWS, n_replicates),
        n_frames=n_frames,
        seed=seed,
        workers=workers,
        progress=bar.part("readings"),
    )
    _stop_if(interrupted)
    replicates = replicate_shared(
        truth,
        start,
        n_replicates=n_replicates,
        n_frames=n_frames,
        seed=seed,
        workers=workers,
        progress=bar.part("replicates"),
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
        )
        _stop_if(varied.interrupted)
    settings: AnyDict = {"convention": convention, "n_replicates": n_replicates, "n_frames": n_frames}
    settings |= {"n_reading_draws": readings.n_draws, "study": study}
    found = Reproduction(
        path=folder,
        run=run,
        replicates=replicates,
        readings=readings,
        judged=judge_all(readings, replicates),
        checks=paper_checks(truth, run.observations.xy, _sigmas(run)),
        study=varied,
        provenance=provenance(seed, settings, run.observations.data_hash),
    )
    _write(found)
    bar.finish("report")
    return found


class _Bar:
    """One progress bar for several parts."""

    def __init__(self, progress: Progress | None, study: bool) -> None:
        self.progress = progress
        self.shares = {name: share for name, share in _SHARES.items() if study or name != "study"}
        self.total = sum(self.shares.values())
        self.done = 0

    def part(self, name: str) -> Progress:
        """A progress callback for one part; the parts come in their order."""
        before, share = self.done, self.shares[name]

        def move(done: int, total: int) -> None:
            self.done = before + share * done // max(total, 1)
            self._show()

        return move

    def finish(self, name: str) -> None:
        """A part that has no steps is done."""
        self.done += self.shares[name]
        self._show()

    def _show(self) -> None:
        if self.progress is not None:
            self.progress(self.done, self.total)


def _check_sizes(n_replicates: int, n_frames: int) -> None:
    if n_replicates < 8:
        raise CalibrationError(f"n_replicates is {n_replicates}: a comparison over seeds needs at least 8.")
    if n_frames < 20:
        raise CalibrationError(f"n_frames is {n_frames}: the experiment needs at least 20.")


def _stop_if(interrupted: bool) -> None:
    if interrupted:
        raise KeyboardInterrupt


def _sigmas(run: PaperRun) -> dict[str, dict[str, float]]:
    """Claimed standard deviations of the paper's methods, px units."""
    found = {}
    for name in PAPER_METHODS:
        cal = run.of(name)
        found[name] = dict(zip(cal.parameter_names, cal.sigmas.tolist(), strict=True))
    return found


def _write(found: Reproduction) -> None:
    """Everything that is computed, the report last: it is there only if all else is."""
    from starcal_uq.paper.show.reproduction import draw_figures, render

    figures = draw_figures(found)
    page = render(found, figures)
    new_folder(found.path)
    folder = new_folder(found.path / "figures")
    for name, png in figures.items():
        atomic_write_bytes(folder / f"{name}.png", png)
    for name, table in _tables(found).items():
        with atomic_path(found.path / f"{name}.csv") as temporary:
            table.to_csv(temporary, index=False, lineterminator="\n")
    found.replicates.save(found.path / "replicates.npz")
    if found.study is not None:
        found.study.save_csv(found.path / "interaction.csv")
    atomic_write_text(found.report, page)


def _tables(found: Reproduction) -> dict[str, pd.DataFrame]:
    return {
        "table_2": found.table_2(),
        "published": found.published(),
        "trials": found.trials(),
        "checks": found.checks_frame(),
        "rows": found.rows_frame(),
        "errors": found.errors(),
        "replicates": found.replicates.table(),
    }
