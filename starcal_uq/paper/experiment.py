"""One run of the paper's experiment: every method on the same simulated stars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.core.types import FloatArray
from starcal_uq.estimation.calibrate import calibrate
from starcal_uq.estimation.calibration import Calibration
from starcal_uq.observations.frames import StarFrames
from starcal_uq.observations.table import Observations
from starcal_uq.paper.camera import paper_camera, paper_start
from starcal_uq.paper.errors import MapError, PointErrors, map_error, reprojection_error_px
from starcal_uq.paper.methods import METHODS, Method
from starcal_uq.paper.published import MAX_MAG, MIN_STARS, N_FRAMES, SIGMA_PX
from starcal_uq.paper.replicates import crlb_sigmas
from starcal_uq.simulation.frames import simulate
from starcal_uq.sky.catalogue import load_catalogue

if TYPE_CHECKING:
    import pandas as pd

# Draws of the centroid noise for the noisy error measures start here, away from those of the observations.
_NOISE_STREAM = 16


@dataclass(frozen=True, eq=False)
class PaperRun:
    """One run.

    Attributes
    ----------
    convention : str
        Equation of the paper that the simulated distortion follows.
    truth, start : Camera
        What is simulated, and where every method starts.
    observations : Observations
        The stars.
    methods : tuple of Method
        The methods.
    calibrations : tuple of Calibration
        Their results, in the same order.
    crlb : (p,) array
        Cramer-Rao bound on the standard deviations with all parameters and attitudes unknown, px units.
    noise_px : (N, 2) array
        Centroid noise of the noisy error measures, which take the measured places for noise-free ones.
    """

    convention: str
    truth: Camera
    start: Camera
    observations: Observations
    methods: tuple[Method, ...]
    calibrations: tuple[Calibration, ...]
    crlb: FloatArray
    noise_px: FloatArray

    def of(self, name: str) -> Calibration:
        """The calibration of the first method with this name in `calibrate`.

        Raises
        ------
        KeyError
            When it was not run.
        """
        for method, calibration in zip(self.methods, self.calibrations, strict=True):
            if method.method == name:
                return calibration
        raise KeyError(f"the method {name!r} was not run.")

    def label(self, name: str) -> str:
        """The label of that method."""
        return next(method.label for method in self.methods if method.method == name)

    def reprojection(self, calibration: Calibration, *, noisy: bool = False) -> PointErrors:
        """The paper's eq. 16 at the places of the stars, without or with centroid noise."""
        noise = self.noise_px if noisy else None
        return reprojection_error_px(self.truth, calibration.camera, self.observations.xy, noise_px=noise)

    def errors(self) -> pd.DataFrame:
        """Errors of every method in px and arcsec, without and with noise.

        Columns
        -------
        method
            Label.
        eq16_px, eq16_max_px, eq16_noisy_px
            The paper's eq. 16 at the stars: root mean square and largest without noise, root mean square with noise.
        residual_px
            Root mean square length of what each method's fit leaves over, with noise and fitted attitudes.
        map_stars_px, map_px, map_max_px
            Directions against the true ones after the best rotation: root mean square at the stars, over the detector,
            and the largest on the detector.
        map_arcsec, map_max_arcsec
            The same over the detector, as angles.
        pitch_arcsec, yaw_arcsec, roll_arcsec
            The rotation removed, which every attitude takes up.
        """
        import pandas as pd

        rows = []
        for method, calibration in zip(self.methods, self.calibrations, strict=True):
            found, at_stars = self.reprojection(calibration), self._map(calibration, stars=True)
            over_field = self._map(calibration)
            pitch, yaw, roll = over_field.rotation_arcsec.tolist()
            rows.append(
                {
                    "method": method.label,
                    "eq16_px": found.rms_px,
                    "eq16_max_px": found.max_px,
                    "eq16_noisy_px": self.reprojection(calibration, noisy=True).rms_px,
                    "residual_px": PointErrors(calibration.residuals_px).rms_px,
                    "map_stars_px": at_stars.rms_px,
                    "map_px": over_field.rms_px,
                    "map_max_px": over_field.max_px,
                    "map_arcsec": over_field.rms_arcsec,
                    "map_max_arcsec": over_field.max_arcsec,
                    "pitch_arcsec": pitch,
                    "yaw_arcsec": yaw,
                    "roll_arcsec": roll,
                }
            )
        return pd.DataFrame(rows)

    def _map(self, calibration: Calibration, stars: bool = False) -> MapError:
        return map_error(self.truth, calibration.camera, self.observations.xy if stars else None)


def run_paper(
    *,
    convention: str = "eq14",
    n_frames: int = N_FRAMES,
    min_stars: int = MIN_STARS,
    sigma_px: float = SIGMA_PX,
    seed: int = 2017,
    methods: Sequence[Method] = METHODS,
) -> PaperRun:
    """Run the paper's experiment once.

    Parameters
    ----------
    convention : {"eq14", "eq6"}
        As in `paper_camera`.
    n_frames, min_stars, sigma_px, seed
        As in `simulate`.
    methods : sequence of Method
        What to run.

    Raises
    ------
    CalibrationError
        When a method gives no good result.
    """
    truth, start = paper_camera(convention), paper_start(convention)
    stars = load_catalogue(max_mag=MAX_MAG)
    obs = simulate(stars, truth, n_frames=n_frames, min_stars=min_stars, sigma_px=sigma_px, seed=seed)
    rng = np.random.default_rng((seed, _NOISE_STREAM))
    return PaperRun(
        convention=convention,
        truth=truth,
        start=start,
        observations=obs,
        methods=tuple(methods),
        # As tables, not as streams: the residuals of every method are wanted.
        calibrations=tuple(calibrate(obs, start, method=m.method, recursion=m.recursion) for m in methods),
        crlb=crlb_sigmas(StarFrames.from_observations(obs), truth, sigma_px),
        noise_px=sigma_px * rng.standard_normal((obs.n_stars, 2)),
    )
