"""The methods that are compared, each as one call of `calibrate`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from starcal_uq.estimation.calibrate import calibrate
from starcal_uq.estimation.recursive.start import RECURSIVE_METHODS, RecursionOptions

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.estimation.calibration import Calibration
    from starcal_uq.observations.table import Observations


@dataclass(frozen=True)
class Method:
    """A way to calibrate: its label in tables and figures, what it does in one line, and arguments of `calibrate`."""

    label: str
    description: str
    method: str
    recursion: RecursionOptions | None = None

    def calibrate(self, obs: Observations, start: Camera) -> Calibration:
        """Calibrate observations; recursive methods as a stream.

        A stream gives them the same estimate and covariance, and no residuals and attitudes, which take time.

        Raises
        ------
        CalibrationError
            When the method gives no good result.
        """
        source = [obs] if self.method in RECURSIVE_METHODS else obs
        return calibrate(source, start, method=self.method, recursion=self.recursion)


METHODS = (
    Method("least squares", "optics by least squares on interstar angles, distortion ignored", "least_squares"),
    Method(
        "samaan",
        "optics by a Kalman filter on interstar angles with their full covariance, distortion linearly afterwards",
        "samaan",
    ),
    Method(
        "samaan, diagonal",
        "the same with the angles of a frame taken as independent, as in the historical filters",
        "samaan",
        RecursionOptions(pair_covariance="diagonal"),
    ),
    Method(
        "griffith",
        "optics by recursive least squares on interstar angles, one frame at a time, distortion ignored",
        "griffith",
    ),
    Method(
        "griffith, all", "the same for optics and distortion together", "griffith", RecursionOptions(parameters="all")
    ),
    Method(
        "three stages",
        "optics and distortion together by least squares on interstar angles (Ye & Yang 2017)",
        "three_stage",
    ),
    Method(
        "efficient",
        "three stages, then the likelihood of the star positions with the attitudes eliminated",
        "efficient",
    ),
)
