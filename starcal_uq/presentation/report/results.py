"""What a report is made from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from starcal_uq.budgeting.result import requirement_checks
from starcal_uq.camera.camera import Camera
from starcal_uq.core.display import Shown
from starcal_uq.core.remedy import Remedy
from starcal_uq.core.status import Note
from starcal_uq.estimation.result import Calibration
from starcal_uq.observations.table import Observations

if TYPE_CHECKING:
    from starcal_uq.budgeting.result import Budget
    from starcal_uq.diagnostics.diagnose import Diagnosis
    from starcal_uq.diagnostics.verdict.judge import Verdict
    from starcal_uq.diagnostics.verdict.remedies import Place
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.pipeline.record import ImageRecord
    from starcal_uq.propagation.attitude_error import AttitudeError
    from starcal_uq.propagation.coupling import Coupling
    from starcal_uq.propagation.distortion import DistortionCurve
    from starcal_uq.propagation.field import FieldMap


@dataclass(frozen=True)
class Missing:
    """A part that the report lacks, in words, and what makes it."""

    what: str
    remedy: Remedy


@dataclass(frozen=True, eq=False)
class Results(Shown):
    """Everything that a report is made from; None for what the run does not hold.

    The couplings are those of the posterior if there is one, else of the estimate; `truth` is the
    camera of a simulation, `place` where the run is. That the file of the nominal camera was
    changed after the run was made is a sentence in `camera_changed`, empty if not.
    """

    name: str
    observations: Observations
    calibration: Calibration
    posterior: Posterior | None = None
    coupling: Coupling | None = None
    attitude: AttitudeError | None = None
    field_map: FieldMap | None = None
    diagnosis: Diagnosis | None = None
    truth: Camera | None = None
    images: ImageRecord | None = None
    budget: Budget | None = None
    missing: tuple[Missing, ...] = ()
    camera_changed: str = ""
    place: Place | None = None

    @cached_property
    def verdict(self) -> Verdict:
        """Every check of the run, judged once."""
        from starcal_uq.diagnostics.verdict.judge import judge

        known = (self.observations, self.calibration, self.posterior, self.truth, self.attitude)
        required = requirement_checks(self.budget)
        return judge(*known, diagnosis=self.diagnosis, place=self.place, requirements=required)

    @property
    def failed(self) -> bool:
        """Whether the numbers must not be used, whatever is required of them."""
        return self.verdict.summary.code is Note.NOT_USABLE

    def command(self, remedy: Remedy) -> str:
        """A command with the files of this run in place of its words in capitals."""
        return (remedy if self.place is None else self.place.of(remedy)).command

    @cached_property
    def distortion_curve(self) -> DistortionCurve | None:
        """Distortion against radius with its bands; None without a posterior or distortion, or
        where a draw folds.
        """
        from starcal_uq.core.errors import DistortionError
        from starcal_uq.propagation.distortion import distortion_curve

        if self.posterior is None:
            return None
        try:
            return distortion_curve(self.posterior, self.observations)
        except DistortionError:
            return None
