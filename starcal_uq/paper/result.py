"""The result of a reproduction: one run, replicates, readings, and what became of every printed number."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from starcal_uq.core.display import Shown
from starcal_uq.core.types import AnyDict
from starcal_uq.paper.checks import PaperCheck
from starcal_uq.paper.experiment import PaperRun
from starcal_uq.paper.judgement import Judged, Outcome
from starcal_uq.paper.readings import Readings
from starcal_uq.paper.replicates import Replicates
from starcal_uq.paper.table_2 import RowTest, published_frame, row_tests, table_2, trials_frame

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.paper.interaction import InteractionStudy

REPORT = "reproduction.html"


@dataclass(frozen=True, eq=False)
class Reproduction(Shown):
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

    def outcome(self, kind: Outcome) -> tuple[Judged, ...]:
        """The printed numbers with this outcome."""
        return tuple(one for one in self.judged if one.outcome is kind)

    def published(self) -> pd.DataFrame:
        """Every printed number beside ours; columns as in `table_2.published_frame`."""
        return published_frame(self.judged)

    def table_2(self) -> pd.DataFrame:
        """The paper's Table 2 for every method; columns as in `table_2.table_2`."""
        return table_2(self.run, self.replicates, self.readings, self.judged)

    def errors(self) -> pd.DataFrame:
        """Errors of the one run in px and arcsec; columns as in `PaperRun.errors`."""
        return self.run.errors()

    @cached_property
    def rows(self) -> tuple[RowTest, ...]:
        """Whether each row of the paper's Table 2 can be one draw, its parameters taken together."""
        return row_tests(self.replicates)

    def tables(self) -> dict[str, pd.DataFrame]:
        """Every table by the name of its file, also those that have no method of their own.

        ``trials``: every printed number under every reading (`table_2.trials_frame`); ``checks``: the paper against
        itself (`PaperCheck`); ``rows``: `RowTest`; ``replicates``: `Replicates.table`; ``interaction``:
        `InteractionStudy.table`.
        """
        import pandas as pd

        found = {
            "table_2": self.table_2(),
            "published": self.published(),
            "trials": trials_frame(self.judged),
            "checks": pd.DataFrame([vars(check) for check in self.checks]),
            "rows": pd.DataFrame([vars(row) for row in self.rows], columns=[f.name for f in fields(RowTest)]),
            "errors": self.errors(),
            "replicates": self.replicates.table(),
        }
        return found if self.study is None else found | {"interaction": self.study.table}

    def __repr__(self) -> str:
        counts = ", ".join(f"{len(self.outcome(kind))} {kind.value}" for kind in Outcome if self.outcome(kind))
        return f"Reproduction({len(self.judged)} printed numbers: {counts}; report {str(self.report)!r})"
