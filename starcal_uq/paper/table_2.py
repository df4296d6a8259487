"""The paper's numbers beside ours: draws for every printed number, and the tables that are written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.paper.errors import REPROJECTION, reprojection_error_px
from starcal_uq.paper.judgement import Judged, trial
from starcal_uq.paper.published import PAPER_METHODS, PUBLISHED, SAMAAN, TABLE_2, Printed
from starcal_uq.paper.readings import AS_PRINTED, DIAGONAL, READINGS

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.camera.camera import Camera
    from starcal_uq.paper.experiment import PaperRun
    from starcal_uq.paper.readings import Readings
    from starcal_uq.paper.replicates import Replicates

# Parameter of a camera -> quantity as the paper prints it.
QUANTITIES = {"f": "f_mm", "x0": "x0_px", "y0": "y0_px", "k1": "k1", "k2": "k2"}
_DIAGONAL_WORDS = next(reading.words for reading in READINGS if reading.key == DIAGONAL)


def per_px(camera: Camera, parameter: str) -> float:
    """Factor from px units to the unit of the printed quantity: the focal length is printed in mm."""
    return camera.pixel_um / 1000.0 if parameter == "f" else 1.0


def replicate_draws(replicates: Replicates, number: Printed, pair_covariance: str = "full") -> FloatArray:
    """Values over seeds (n,) of a printed quantity, in its unit.

    Empty for a quantity that replicates do not have (eq. 16 is a sum over stars, and theirs is over the detector), and
    for a method that was not replicated with this covariance of pairs.
    """
    for index, method in enumerate(replicates.methods):
        assumed = "full" if method.recursion is None else method.recursion.pair_covariance
        if (method.method, assumed) == (number.method, pair_covariance):
            values = _replicated(replicates, index, number.quantity)
            good: FloatArray = values[np.isfinite(values)]
            return good
    return np.empty(0)


def _replicated(replicates: Replicates, index: int, quantity: str) -> FloatArray:
    if quantity == "y0_error_px":
        return np.abs(replicates.estimates[index, :, 1] - replicates.truth.y0_px)
    for parameter, name in QUANTITIES.items():
        if name == quantity:
            column = replicates.truth.parameter_names.index(parameter)
            return np.asarray(replicates.estimates[index, :, column] * per_px(replicates.truth, parameter))
    return np.empty(0)


@dataclass(frozen=True)
class RowTest:
    """Whether the p parameters of one printed row can be one draw, all taken together, by n replicates.

    `t2` is Hotelling's T^2 of the row as a new draw, with the variance of rounding; `p_value` is from its F
    distribution.
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
        numbers = [number for number in TABLE_2 if number.method == method and not number.is_error_size]
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
    """Every printed number under every reading.

    Raises
    ------
    CalibrationError
        When a method gave too few results to compare with.
    """
    judged = []
    for number in PUBLISHED:
        trials = []
        for position, (words, faithful, draws) in enumerate(readings.trials_of(number)):
            # The main reading is what the replicates are: more seeds of the same experiment.
            more = replicate_draws(replicates, number) if position == 0 else np.empty(0)
            trials.append(trial(number, words, faithful, more if len(more) >= len(draws) else draws))
        if number.method == SAMAAN and len(draws := replicate_draws(replicates, number, DIAGONAL)) > 1:
            trials.append(trial(number, _DIAGONAL_WORDS, True, draws))
        if not trials:
            raise CalibrationError(
                f"no reading of the experiment gave {number.quantity} of the method {number.method!r}: use more frames."
            )
        judged.append(Judged(number, tuple(trials)))
    return tuple(judged)


def published_frame(judged: tuple[Judged, ...]) -> pd.DataFrame:
    """One row per printed number: place, outcome, and its main and best reading.

    `noise_digits` are printed digits that are noise, `n_readings` readings were tried, `by_chance` as in `Judged`.
    """
    import pandas as pd

    rows = []
    for one in judged:
        main, best = one.main, one.best
        row = _place(one.printed) | {"outcome": one.outcome.value, "noise_digits": one.noise_digits}
        row |= {"n_readings": len(one.trials), "by_chance": one.by_chance}
        row |= {f"main_{name}": getattr(main, name) for name in ("mean", "spread", "n", "z")}
        row |= {f"best_{name}": getattr(best, name) for name in ("reading", "mean", "spread", "n", "z", "faithful")}
        rows.append(row)
    return pd.DataFrame(rows)


def trials_frame(judged: tuple[Judged, ...]) -> pd.DataFrame:
    """One row per printed number and reading: what was tried, in the units of the printed number."""
    import pandas as pd

    names = ("reading", "faithful", "n", "mean", "spread", "z", "accepted")
    return pd.DataFrame(
        [_place(one.printed) | {name: getattr(t, name) for name in names} for one in judged for t in one.trials]
    )


def _place(number: Printed) -> AnyDict:
    row = {name: getattr(number, name) for name in ("place", "method", "quantity")}
    return row | {"printed": number.text}


def table_2(run: PaperRun, replicates: Replicates, readings: Readings, judged: tuple[Judged, ...]) -> pd.DataFrame:
    """The paper's Table 2 for every method: one row per method and quantity, in the units of the paper.

    `ours` with `sigma_claimed` is the one run, `z_truth` its distance from the truth in these; `mean` and `spread` are
    over the replicates, of the reprojection error over the draws of the main reading; `z_printed` is the distance of
    the printed number from our mean in standard deviations of a new draw, and `sigma_crlb` the bound of the run's
    design.
    """
    import pandas as pd

    main = {(j.printed.method, j.printed.quantity): j for j in judged if j.printed in TABLE_2}
    rows: list[AnyDict] = []
    for method, cal in zip(run.methods, run.calibrations, strict=True):
        as_in_paper = method.recursion is None and method.method in PAPER_METHODS
        over_seeds = replicates.estimates[replicates.labels.index(method.label)]
        for parameter in sorted(cal.parameter_names, key=list(QUANTITIES).index):
            i, quantity = cal.parameter_names.index(parameter), QUANTITIES[parameter]
            unit = per_px(run.truth, parameter)
            draws = over_seeds[np.isfinite(over_seeds[:, i]), i] * unit
            one = main.get((method.method, quantity)) if as_in_paper else None
            claimed = float(cal.sigmas[i])
            rows.append(
                {
                    "method": method.label,
                    "quantity": quantity,
                    "truth": float(run.truth.theta[i]) * unit,
                    "printed": "" if one is None else one.printed.text,
                    "z_printed": np.nan if one is None else one.main.z,
                    "ours": float(cal.theta[i]) * unit,
                    "sigma_claimed": claimed * unit,
                    "mean": float(np.mean(draws)) if len(draws) else np.nan,
                    "spread": float(np.std(draws, ddof=1)) if len(draws) > 1 else np.nan,
                    "n": len(draws),
                    "sigma_crlb": float(run.crlb[i]) * unit,
                    "z_truth": float(cal.theta[i] - run.truth.theta[i]) / claimed,
                }
            )
        draws = readings.of(AS_PRINTED, method.method, "reprojection_px", REPROJECTION[0].key)
        rows.append(_reprojection_row(run, method.label, cal.camera, draws if as_in_paper else np.empty(0)))
        if as_in_paper and (one := main.get((method.method, "reprojection_px"))) is not None:
            rows[-1] |= {"printed": one.printed.text, "z_printed": one.main.z}
    return pd.DataFrame(rows)


def _reprojection_row(run: PaperRun, label: str, camera: Camera, draws: FloatArray) -> AnyDict:
    return {
        "method": label,
        "quantity": "reprojection_px",
        "truth": 0.0,
        "printed": "",
        "z_printed": np.nan,
        "ours": reprojection_error_px(run.truth, camera, run.observations.xy).rms_px,
        "sigma_claimed": np.nan,
        "mean": float(np.mean(draws)) if len(draws) else np.nan,
        "spread": float(np.std(draws, ddof=1)) if len(draws) > 1 else np.nan,
        "n": len(draws),
        "sigma_crlb": np.nan,
        "z_truth": np.nan,
    }
