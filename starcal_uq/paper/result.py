"""A reproduction: one run of the paper's experiment, replicates, readings, and what became of every
printed number.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.camera.camera import Camera
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.provenance import Provenance
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.estimation.result import Calibration
from starcal_uq.observations.frames import StarFrames
from starcal_uq.observations.table import Observations
from starcal_uq.paper.camera import paper_camera, paper_start
from starcal_uq.paper.checks import PaperCheck
from starcal_uq.paper.errors import ERROR_READINGS, PointErrors, map_error, reprojection_error_px
from starcal_uq.paper.judgement import Judged, Outcome, trial
from starcal_uq.paper.published import (
    MAX_MAG,
    MIN_STARS,
    N_FRAMES,
    PAPER_METHODS,
    PUBLISHED,
    SAMAAN,
    SIGMA_PX,
    TABLE_2,
    Printed,
)
from starcal_uq.paper.readings import AS_PRINTED, DIAGONAL, READINGS, Readings
from starcal_uq.paper.replicates import METHODS, Method, Replicates, crlb_sigmas
from starcal_uq.simulation.frames import Campaign
from starcal_uq.sky.catalogue import load_catalogue

if TYPE_CHECKING:
    from starcal_uq.paper.interaction import InteractionStudy

REPORT = "reproduction.html"
# Draws of the centroid noise for the noisy error measures start here, away from those of the
# observations.
_NOISE_STREAM = 16
# Parameter of a camera -> quantity as the paper prints it.
QUANTITIES = {"f": "f_mm", "x0": "x0_px", "y0": "y0_px", "k1": "k1", "k2": "k2"}
_TABLE_2_COLUMNS = (
    *(
        "method",
        "quantity",
        "truth",
        "printed",
        "z_printed",
        "ours",
        "sigma_claimed",
        "mean",
        "spread",
        "n",
    ),
    *("sigma_crlb", "z_truth"),
)
_DIAGONAL_WORDS = next(reading.words for reading in READINGS if reading.key == DIAGONAL)


@dataclass(frozen=True, eq=False)
class PaperRun:
    """One run of every method on the same stars.

    `crlb` (p,) is the Cramer-Rao bound on the standard deviations with all parameters and attitudes
    unknown, px units; `noise_px` (N, 2) the centroid noise of the noisy error measures, which take
    the measured places for noise-free ones.
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
        return next(
            c for m, c in zip(self.methods, self.calibrations, strict=True) if m.method == name
        )

    def label(self, name: str) -> str:
        """The label of that method."""
        return next(method.label for method in self.methods if method.method == name)

    def errors(self) -> pd.DataFrame:
        """Errors of every method in px and arcsec, without and with noise.

        ``eq16_*``: the paper's eq. 16 at the stars, root mean square and largest without noise, and
        with it. ``residual_px``: what each method's fit leaves over, with noise and fitted
        attitudes. ``map_*``: directions against the true ones after the best rotation, at the stars
        and over the detector. ``pitch_arcsec`` and so on: the rotation removed, which every
        attitude takes up.
        """
        rows = []
        for method, calibration in zip(self.methods, self.calibrations, strict=True):
            camera, xy = calibration.camera, self.observations.xy
            found = reprojection_error_px(self.truth, camera, xy)
            noisy = reprojection_error_px(self.truth, camera, xy, noise_px=self.noise_px)
            field = map_error(self.truth, camera)
            pitch, yaw, roll = field.rotation_arcsec.tolist()
            rows.append(
                {
                    "method": method.label,
                    "eq16_px": found.rms_px,
                    "eq16_max_px": found.max_px,
                    "eq16_noisy_px": noisy.rms_px,
                    "residual_px": PointErrors(calibration.residuals_px).rms_px,
                    "map_stars_px": map_error(self.truth, camera, xy).rms_px,
                    "map_px": field.rms_px,
                    "map_max_px": field.max_px,
                    "map_arcsec": field.rms_arcsec,
                    "map_max_arcsec": field.max_arcsec,
                    "pitch_arcsec": pitch,
                    "yaw_arcsec": yaw,
                    "roll_arcsec": roll,
                }
            )
        return pd.DataFrame(rows)


def run_paper(*, convention: str = "eq14", n_frames: int = N_FRAMES, seed: int = 2017) -> PaperRun:
    """Run the paper's experiment once, with its noise and its least number of stars."""
    truth, start = paper_camera(convention), paper_start(convention)
    obs = Campaign(n_frames, MIN_STARS, SIGMA_PX, MAX_MAG).simulate(
        load_catalogue(max_mag=MAX_MAG), truth, seed
    )
    rng = np.random.default_rng((seed, _NOISE_STREAM))
    return PaperRun(
        convention=convention,
        truth=truth,
        start=start,
        observations=obs,
        methods=METHODS,
        # As tables, not as streams: the residuals of every method are wanted.
        calibrations=tuple(
            calibrate(obs, start, method=m.method, recursion=m.recursion) for m in METHODS
        ),
        crlb=crlb_sigmas(StarFrames.from_observations(obs), truth, SIGMA_PX),
        noise_px=SIGMA_PX * rng.standard_normal((obs.n_stars, 2)),
    )


def per_px(camera: Camera, parameter: str) -> float:
    """Factor from px units to the unit of the printed quantity: the focal length is printed in
    mm.
    """
    return camera.length_mm(1.0) if parameter == "f" else 1.0


def replicate_draws(
    replicates: Replicates, number: Printed, pair_covariance: str = "full"
) -> FloatArray:
    """Values over seeds (n,) of a printed quantity, in its unit; empty where the replicates do not
    have it.

    They have no errors by eq. 16, which is a sum over stars: theirs are over the detector.
    """
    for index, method in enumerate(replicates.methods):
        assumed = "full" if method.recursion is None else method.recursion.pair_covariance
        if (method.method, assumed) == (number.method, pair_covariance):
            values = _replicated(replicates, index, number.quantity)
            return values[np.isfinite(values)]
    return np.empty(0)


def _replicated(replicates: Replicates, index: int, quantity: str) -> FloatArray:
    if quantity == "y0_error_px":
        return np.abs(replicates.estimates[index, :, 1] - replicates.truth.y0_px)
    for parameter, name in QUANTITIES.items():
        if name == quantity:
            column = replicates.truth.parameter_names.index(parameter)
            return replicates.estimates[index, :, column] * per_px(replicates.truth, parameter)
    return np.empty(0)


@dataclass(frozen=True)
class RowTest:
    """Whether the p parameters of one printed row can be one draw, all taken together, by n
    replicates.

    `t2` is Hotelling's T^2 of the row as a new draw, with the variance of rounding; `p_value` is
    from its F distribution.
    """

    method: str
    place: str
    n: int
    p: int
    t2: float
    p_value: float


def row_tests(replicates: Replicates) -> tuple[RowTest, ...]:
    """Every row of the paper's Table 2 as one draw; rows with too few replicates are left out."""
    from scipy.stats import f as f_distribution

    found = []
    for method in PAPER_METHODS:
        numbers = [
            number for number in TABLE_2 if number.method == method and not number.is_error_size
        ]
        draws = np.column_stack([replicate_draws(replicates, number) for number in numbers])
        n, p = draws.shape
        if n < p + 2:
            continue
        scale = draws.std(axis=0, ddof=1)
        offset = (np.array([number.value for number in numbers]) - draws.mean(axis=0)) / scale
        rounding = np.array([number.unit_in_last_place for number in numbers]) / scale
        covariance = np.corrcoef(draws.T) * (1.0 + 1.0 / n) + np.diag(rounding**2 / 12.0)
        t2 = float(offset @ np.linalg.solve(covariance, offset))
        p_value = float(f_distribution.sf(t2 * (n - p) / (p * (n - 1)), p, n - p))
        found.append(RowTest(method, numbers[0].place, n, p, t2, p_value))
    return tuple(found)


def judge_all(readings: Readings, replicates: Replicates) -> tuple[Judged, ...]:
    """Every printed number under every reading; a CalibrationError where a method gave too few
    results.
    """
    judged = []
    for number in PUBLISHED:
        trials = []
        for position, (words, faithful, draws) in enumerate(readings.trials_of(number)):
            # The main reading is what the replicates are: more seeds of the same experiment.
            more = replicate_draws(replicates, number) if position == 0 else np.empty(0)
            trials.append(
                trial(number, words, faithful, more if len(more) >= len(draws) else draws)
            )
        if (
            number.method == SAMAAN
            and len(draws := replicate_draws(replicates, number, DIAGONAL)) > 1
        ):
            trials.append(trial(number, _DIAGONAL_WORDS, True, draws))
        if not trials:
            raise CalibrationError(
                f"no reading of the experiment gave {number.quantity} of the method "
                f"{number.method!r}: use more frames."
            )
        judged.append(Judged(number, tuple(trials)))
    return tuple(judged)


@dataclass(frozen=True, eq=False)
class Reproduction(Shown):
    """The paper's experiment beside ours; report, tables and figures are in the folder `path`.

    `run` is one run (Table 2, Figs. 3 to 6), `replicates` every method over seeds, `readings` the
    paper's methods over seeds under every reading of the experiment; `judged` has every printed
    number and what became of it, `checks` the paper against its own numbers, and `study` optics
    against distortion, None where it was left out.
    """

    path: Path
    run: PaperRun
    replicates: Replicates
    readings: Readings
    judged: tuple[Judged, ...]
    checks: tuple[PaperCheck, ...]
    study: InteractionStudy | None
    provenance: Provenance

    @property
    def report(self) -> Path:
        """The report, which needs no other file."""
        return self.path / REPORT

    def outcome(self, kind: Outcome) -> tuple[Judged, ...]:
        """The printed numbers with this outcome."""
        return tuple(one for one in self.judged if one.outcome is kind)

    def published(self) -> pd.DataFrame:
        """One row per printed number: place, outcome, and its main and best reading.

        `noise_digits` are printed digits that are noise, `n_readings` readings were tried,
        `by_chance` as in `Judged`.
        """
        rows = []
        for one in self.judged:
            row = _place(one.printed) | {
                "outcome": one.outcome.value,
                "noise_digits": one.noise_digits,
            }
            row |= {"n_readings": len(one.trials), "by_chance": one.by_chance}
            row |= {
                f"main_{name}": getattr(one.main, name) for name in ("mean", "spread", "n", "z")
            }
            names = ("reading", "mean", "spread", "n", "z", "faithful")
            rows.append(row | {f"best_{name}": getattr(one.best, name) for name in names})
        return pd.DataFrame(rows)

    def table_2(self) -> pd.DataFrame:
        """The paper's Table 2 for every method: one row per method and quantity, in the units of
        the paper.

        `ours` with `sigma_claimed` is the one run, `z_truth` its distance from the truth in these;
        `mean` and `spread` are over the replicates, of the reprojection error over the draws of the
        main reading; `z_printed` is the distance of the printed number from our mean in standard
        deviations of a new draw, and `sigma_crlb` the bound of the run's design.
        """
        run, rows = self.run, []
        judged = {
            (j.printed.method, j.printed.quantity): j for j in self.judged if j.printed in TABLE_2
        }
        for method, cal in zip(run.methods, run.calibrations, strict=True):
            in_paper = method.recursion is None and method.method in PAPER_METHODS
            over_seeds = self.replicates.estimates[self.replicates.labels.index(method.label)]
            columns: dict[str, tuple[FloatArray, AnyDict]] = {}
            for parameter in sorted(cal.parameter_names, key=list(QUANTITIES).index):
                i, unit = cal.parameter_names.index(parameter), per_px(run.truth, parameter)
                truth, ours, sigma = run.truth.theta[i], cal.theta[i], cal.sigmas[i]
                numbers = {
                    "truth": truth * unit,
                    "ours": ours * unit,
                    "sigma_claimed": sigma * unit,
                    "sigma_crlb": run.crlb[i] * unit,
                    "z_truth": (ours - truth) / sigma,
                }
                good = np.isfinite(over_seeds[:, i])
                columns[QUANTITIES[parameter]] = over_seeds[good, i] * unit, numbers
            main = ERROR_READINGS["reprojection_px"][0].key
            draws = self.readings.of(AS_PRINTED, method.method, "reprojection_px", main)
            size = reprojection_error_px(run.truth, cal.camera, run.observations.xy).rms_px
            found = draws if in_paper else draws[:0]
            columns["reprojection_px"] = found, {"truth": 0.0, "ours": size}
            for quantity, (draws, numbers) in columns.items():
                row: AnyDict = {"method": method.label, "quantity": quantity, **numbers}
                row |= {"printed": "", "n": len(draws)}
                one = judged.get((method.method, quantity)) if in_paper else None
                if one is not None:
                    row |= {"printed": one.printed.text, "z_printed": one.main.z}
                if len(draws):
                    row["mean"] = float(np.mean(draws))
                if len(draws) > 1:
                    row["spread"] = np.std(draws, ddof=1)
                rows.append(row)
        return pd.DataFrame(rows, columns=list(_TABLE_2_COLUMNS))

    def errors(self) -> pd.DataFrame:
        """Errors of the one run in px and arcsec; columns as in `PaperRun.errors`."""
        return self.run.errors()

    @cached_property
    def rows(self) -> tuple[RowTest, ...]:
        """Whether each row of the paper's Table 2 can be one draw, its parameters taken
        together.
        """
        return row_tests(self.replicates)

    def tables(self) -> dict[str, pd.DataFrame]:
        """Every table by the name of its file, also those that have no method of their own.

        ``trials``: every printed number under every reading, in the units of the printed number;
        ``checks``: the paper against itself (`PaperCheck`); ``rows``: `RowTest`; ``replicates``:
        `Replicates.table`; ``interaction``: `InteractionStudy.table`.
        """
        tried = ("reading", "faithful", "n", "mean", "spread", "z", "accepted")
        trials = [
            _place(one.printed) | {x: getattr(t, x) for x in tried}
            for one in self.judged
            for t in one.trials
        ]
        found = {
            "table_2": self.table_2(),
            "published": self.published(),
            "trials": pd.DataFrame(trials),
            "checks": pd.DataFrame([vars(check) for check in self.checks]),
            "rows": pd.DataFrame(
                [vars(row) for row in self.rows], columns=[f.name for f in fields(RowTest)]
            ),
            "errors": self.errors(),
            "replicates": self.replicates.table(),
        }
        return found if self.study is None else found | {"interaction": self.study.table}

    def __repr__(self) -> str:
        counts = ", ".join(
            f"{len(self.outcome(kind))} {kind.value}" for kind in Outcome if self.outcome(kind)
        )
        return (
            f"Reproduction({len(self.judged)} printed numbers: {counts}; report "
            f"{str(self.report)!r})"
        )


def _place(number: Printed) -> AnyDict:
    row = {name: getattr(number, name) for name in ("place", "method", "quantity")}
    return row | {"printed": number.text}
