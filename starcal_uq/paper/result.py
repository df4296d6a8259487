"""The result of a reproduction: one run, replicates, readings, and what became of every printed number."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcal_uq.core.types import AnyDict
from starcal_uq.paper.checks import PaperCheck
from starcal_uq.paper.errors import detector_grid, map_error, reprojection_error_px
from starcal_uq.paper.experiment import PaperRun
from starcal_uq.paper.judgement import Judged, Outcome
from starcal_uq.paper.published import PAPER_METHODS, printed
from starcal_uq.paper.readings import Readings
from starcal_uq.paper.replicates_result import Replicates
from starcal_uq.paper.table_2 import RowTest, published_frame, row_tests, table_2, trials_frame

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.paper.interaction_result import InteractionStudy

REPORT = "reproduction.html"
# Points along each side of the maps of the error.
_MAP_POINTS = 49


@dataclass(frozen=True, eq=False)
class Reproduction:
    """The paper's experiment beside ours.

    Attributes
    ----------
    path : Path
        Folder of the report, the tables and the figures.
    run : PaperRun
        One run: Table 2, Figs. 3 to 6.
    replicates : Replicates
        Every method over seeds.
    readings : Readings
        The paper's methods over seeds under every reading of the experiment.
    judged : tuple of Judged
        Every printed number and what became of it.
    checks : tuple of PaperCheck
        The paper against its own numbers.
    study : InteractionStudy or None
        Optics against distortion; None where it was left out.
    provenance : dict
        Seed, settings, versions, time and hash of the run's data.
    """

    path: Path
    run: PaperRun
    replicates: Replicates
    readings: Readings
    judged: tuple[Judged, ...]
    checks: tuple[PaperCheck, ...]
    study: InteractionStudy | None
    provenance: AnyDict

    @property
    def report(self) -> Path:
        """The report, which needs no other file."""
        return self.path / REPORT

    @property
    def verdict(self) -> str:
        """What comes out and what does not, in plain words."""
        from starcal_uq.paper.show.reproduction_words import headline, verdict

        return f"{headline(self)} {verdict(self)}"

    def outcome(self, kind: Outcome) -> tuple[Judged, ...]:
        """The printed numbers with this outcome."""
        return tuple(one for one in self.judged if one.outcome is kind)

    def published(self) -> pd.DataFrame:
        """Every printed number beside ours; columns as in `comparison.published_frame`."""
        return published_frame(self.judged)

    def table_2(self) -> pd.DataFrame:
        """The paper's Table 2 for every method; columns as in `comparison.table_2`."""
        return table_2(self.run, self.replicates, self.readings, self.judged)

    def trials(self) -> pd.DataFrame:
        """Every printed number under every reading; columns as in `comparison.trials_frame`."""
        return trials_frame(self.judged)

    def errors(self) -> pd.DataFrame:
        """Errors of the one run in px and arcsec; columns as in `PaperRun.errors`."""
        return self.run.errors()

    @cached_property
    def rows(self) -> tuple[RowTest, ...]:
        """Whether each row of the paper's Table 2 can be one draw, its parameters taken together."""
        return row_tests(self.replicates)

    def rows_frame(self) -> pd.DataFrame:
        """The same as a table: method, place, n, p, t2, p_value."""
        import pandas as pd

        return pd.DataFrame([vars(row) for row in self.rows], columns=[f.name for f in fields(RowTest)])

    def checks_frame(self) -> pd.DataFrame:
        """The paper against itself: statement, place, text, follows, agrees."""
        import pandas as pd

        return pd.DataFrame([vars(check) for check in self.checks])

    def plot_trajectories(self) -> Any:
        """The paper's Fig. 3: f, x0 and y0 on their way to the estimate; returns the matplotlib Figure."""
        from starcal_uq.paper.show.figures import plot_trajectories

        values = {
            self.run.label(method): [printed(method, name).value for name in ("f_mm", "x0_px", "y0_px")]
            for method in PAPER_METHODS
        }
        calibrations = {self.run.label(method): self.run.of(method) for method in PAPER_METHODS}
        return plot_trajectories(calibrations, self.run.truth, values)

    def plot_error_fields(self) -> Any:
        """The paper's Figs. 4 to 6, and the same for the efficient method; returns the matplotlib Figure."""
        from starcal_uq.paper.show.figures import plot_error_fields

        truth, names = self.run.truth, (*PAPER_METHODS, "efficient")
        xy, _ = detector_grid(truth, _MAP_POINTS)
        cameras = {name: self.run.of(name).camera for name in names}
        fields = {
            name: (xy, reprojection_error_px(truth, camera, xy).error_px, map_error(truth, camera, xy).error_px)
            for name, camera in cameras.items()
        }
        titles = {name: self.run.label(name) for name in names}
        largest: Mapping[str, str] = {name: printed(name, "max_residual_px").text for name in PAPER_METHODS}
        return plot_error_fields(fields, titles, largest)

    def plot_printed_numbers(self) -> Any:
        """Every printed number as a distance from our draws; returns the matplotlib Figure."""
        from starcal_uq.paper.show.figures import plot_printed_numbers
        from starcal_uq.paper.show.reproduction import axis_names

        return plot_printed_numbers(self.judged, axis_names(self.judged))

    def _repr_html_(self) -> str:
        from html import escape

        columns = ["place", "method", "quantity", "printed", "main_mean", "main_spread", "main_z", "outcome"]
        table = self.published()[columns].to_html(index=False, border=0, float_format=lambda v: f"{v:.6g}")
        return f"<p><b>Ye &amp; Yang 2017 reproduced</b>: {escape(self.verdict)}</p>{table}"

    def __repr__(self) -> str:
        counts = ", ".join(f"{len(self.outcome(kind))} {kind.value}" for kind in Outcome if self.outcome(kind))
        return f"Reproduction({len(self.judged)} printed numbers: {counts}; report {str(self.report)!r})"
