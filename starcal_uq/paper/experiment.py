"""One run of the paper's experiment: every method on the same simulated stars."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.core.types import FloatArray
from starcal_uq.estimation.calibrate import calibrate
from starcal_uq.estimation.calibration import Calibration
from starcal_uq.observations.frames import StarFrames
from starcal_uq.observations.table import Observations
from starcal_uq.paper.camera import paper_camera, paper_start
from starcal_uq.paper.errors import PointErrors, map_error, reprojection_error_px
from starcal_uq.paper.methods import METHODS, Method
from starcal_uq.paper.published import MAX_MAG, MIN_STARS, N_FRAMES, SIGMA_PX
from starcal_uq.paper.replicates import crlb_sigmas
from starcal_uq.simulation.frames import Campaign
from starcal_uq.sky.catalogue import load_catalogue

if TYPE_CHECKING:
    import pandas as pd

# Draws of the centroid noise for the noisy error measures start here, away from those of the observations.
_NOISE_STREAM = 16


@dataclass(frozen=True, eq=False)
class PaperRun:
    """One run of every method on the same stars.

    `crlb` (p,) is the Cramer-Rao bound on the standard deviations with all parameters and attitudes unknown, px units;
    `noise_px` (N, 2) the centroid noise of the noisy error measures, which take the measured places for noise-free
    ones.
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
        """The calibration of the first method with this name in `calibrate`."""
        return next(c for m, c in zip(self.methods, self.calibrations, strict=True) if m.method == name)

    def label(self, name: str) -> str:
        """The label of that method."""
        return next(method.label for method in self.methods if method.method == name)

    def errors(self) -> pd.DataFrame:
        """Errors of every method in px and arcsec, without and with noise.

        ``eq16_*``: the paper's eq. 16 at the stars, root mean square and largest without noise, and with it.
        ``residual_px``: what each method's fit leaves over, with noise and fitted attitudes. ``map_*``: directions
        against the true ones after the best rotation, at the stars and over the detector. ``pitch_arcsec`` and so on:
        the rotation removed, which every attitude takes up.
        """
        import pandas as pd

        rows = []
        for method, calibration in zip(self.methods, self.calibrations, strict=True):
            xy = self.observations.xy
            errors = partial(reprojection_error_px, self.truth, calibration.camera, xy)
            found, noisy = errors(), errors(noise_px=self.noise_px)
            at_stars = map_error(self.truth, calibration.camera, xy)
            over_field = map_error(self.truth, calibration.camera)
            pitch, yaw, roll = over_field.rotation_arcsec.tolist()
            rows.append(
                {
                    "method": method.label,
                    "eq16_px": found.rms_px,
                    "eq16_max_px": found.max_px,
                    "eq16_noisy_px": noisy.rms_px,
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


def run_paper(*, convention: str = "eq14", n_frames: int = N_FRAMES, seed: int = 2017) -> PaperRun:
    """Run the paper's experiment once, with its noise and its least number of stars.

    Raises
    ------
    CalibrationError
        When a method gives no good result.
    """
    truth, start = paper_camera(convention), paper_start(convention)
    obs = Campaign(n_frames, MIN_STARS, SIGMA_PX, MAX_MAG).simulate(load_catalogue(max_mag=MAX_MAG), truth, seed)
    rng = np.random.default_rng((seed, _NOISE_STREAM))
    return PaperRun(
        convention=convention,
        truth=truth,
        start=start,
        observations=obs,
        methods=METHODS,
        # As tables, not as streams: the residuals of every method are wanted.
        calibrations=tuple(calibrate(obs, start, method=m.method, recursion=m.recursion) for m in METHODS),
        crlb=crlb_sigmas(StarFrames.from_observations(obs), truth, SIGMA_PX),
        noise_px=SIGMA_PX * rng.standard_normal((obs.n_stars, 2)),
    )
