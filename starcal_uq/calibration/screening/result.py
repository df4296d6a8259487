"""What a screening found: the rows left out, each with its reason, in tables for people and for
files.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.display import Shown
from starcal_uq.core.files import ensure_new, write_csv
from starcal_uq.core.findings import clause
from starcal_uq.core.types import AnyDict, BoolArray, FloatArray, IntArray, PathLike, floats
from starcal_uq.estimation.consensus import MIN_STARS
from starcal_uq.estimation.outliers import StarResiduals, star_threshold

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.camera.camera import Camera
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

# Reason codes of rejected rows, in the words of tables.
REASONS: dict[str, str] = {
    "elsewhere": "the catalogue direction is far from where the star was measured: another star",
    "displaced": "the star is farther from the prediction of the others than noise explains",
    "taste": "the frame fails its chi-square test (TASTE) with this star",
    "frame_disturbed": "the frame fails its chi-square test (TASTE) and no single stars are to blame",
    "frame_dropped": "no three stars of the frame agree: none of them can be trusted",
    "frame_too_small": "the frame has fewer than three stars",
}
COLUMNS = (
    "row", "frame", "star_id", "x_px", "y_px", "residual_px", "offset_deg", "statistic", "threshold", "reason",
)  # fmt: skip
_MANY_REJECTED = 0.25
# What rejected stars say together.
Rejections = Enum("Rejections", "MANY AT_THE_EDGE")
_PATTERN_P, _PATTERN_ROWS = 1e-3, 5
# Wrong identifications are rarely this near: statistics below this many thresholds are noise with
# heavy tails.
MARGINAL = 4.0


@dataclass(frozen=True)
class ScreeningRound:
    """One round: calibrate on what is in use, then test."""

    n_in_use: int  # Stars calibrated on
    n_changed: int  # Stars that the tests then rejected or took back
    sigma: float  # Estimated noise, px (or the factor on the stated noise)
    theta: FloatArray  # (p,): estimate


@dataclass(frozen=True, eq=False, repr=False)
class Screening(Shown):
    """Result of `screen`; N rows were given, K frames.

    Attributes
    ----------
    kept : (N,) bool array
        Rows that the calibration uses.
    observations : Observations
        Rows that were kept; ``origin.screening`` says what they were taken from.
    rejected : DataFrame
        The other rows, one line each: ``row`` (from 0, in the observations given), ``frame``,
        ``star_id``, ``x_px``, ``y_px``, ``residual_px`` (measurement minus prediction of the other
        stars, length), ``offset_deg`` (the same as an angle), ``statistic``, ``threshold`` and
        ``reason`` (a key of `REASONS`). The statistic is the squared distance over its variance
        (chi-square with 2 degrees of freedom where the noise is known well), TASTE of the frame for
        the reasons ``taste`` and ``frame_disturbed``, and NaN in other frames that were dropped, of
        which the residual is the distance from what most of their stars agree on.
    rounds : tuple of ScreeningRound
        How it went.
    calibration : Calibration
        Calibration of the kept rows; rows of its residuals are those of `observations`.
    significance, control
        Settings of the screening.
    expected_false : float
        Bound on the number of right stars expected to be rejected.
    star_p_value, frame_p_value : float
        Limits below which a star, or a frame, is rejected.
    star_threshold : float
        The first as a squared distance in units of its variance.
    sigma_shrinkage : float
        Fraction by which cutting off the tails makes the estimated sigma too small.
    frame_ids : (K,) array of int
        Frames.
    frame_count : (K,) array of int
        Stars kept in each; 0 for a frame that was dropped.
    taste, taste_p_value : (K,) arrays
        Chi-square of the kept stars with ``2 * frame_count - 3`` degrees of freedom, and its
        p-value; NaN and 1 for a frame that was dropped.
    focal_ratio : float
        Focal length that the interstar angles asked for before the calibration, over the nominal
        one.
    n_pre_screened : int
        Rows that were set aside before the first calibration (later rounds may have taken some
        back).
    stable : bool
        Whether the last round changed nothing.
    warnings : tuple of str
        Sentences on what a user should look at.
    model_is_wrong : bool
        Whether more was to be rejected than noise and wrong stars explain, or the rounds did not
        settle: then only stars beyond the tails of all others are rejected, and tails that are not
        Gaussian are fitted as Student's.
    """

    kept: BoolArray
    observations: Observations
    rejected: pd.DataFrame
    rounds: tuple[ScreeningRound, ...]
    calibration: Calibration
    significance: float
    control: str
    expected_false: float
    star_p_value: float
    frame_p_value: float
    star_threshold: float
    sigma_shrinkage: float
    frame_ids: IntArray
    frame_count: IntArray
    taste: FloatArray
    taste_p_value: FloatArray
    focal_ratio: float
    n_pre_screened: int
    stable: bool
    warnings: tuple[str, ...]
    model_is_wrong: bool = False

    @property
    def n_rejected(self) -> int:
        """Rows left out."""
        return len(self.rejected)

    @property
    def dropped_frames(self) -> IntArray:
        """Frames of which nothing is kept."""
        dropped: IntArray = self.frame_ids[self.frame_count == 0]
        return dropped

    @property
    def counts(self) -> dict[str, int]:
        """Rejected rows per reason, only reasons that occur, in the order of `REASONS`."""
        found = self.rejected["reason"].value_counts()
        return {reason: int(found[reason]) for reason in REASONS if reason in found}

    def to_dataframe(self) -> pd.DataFrame:
        """The rejected rows."""
        return self.rejected.copy()

    def save_rejected(self, path: PathLike, force: bool = False) -> None:
        """Write the rejected rows as CSV; a header alone says that nothing was rejected.

        Raises
        ------
        RunFolderError
            If the file exists and `force` is false, or cannot be written.
        """
        ensure_new(path, force)
        write_csv(self.rejected, path)

    def __repr__(self) -> str:
        reasons = ", ".join(f"{number} {reason}" for reason, number in self.counts.items())
        return (
            f"Screening({self.n_rejected} of {len(self.kept)} stars "
            f"rejected{': ' if reasons else ''}{reasons})"
        )


def rejected_table(
    obs: Observations,
    residuals: StarResiduals,
    star_p_value: float,
    frame_p_value: float,
    shrinkage: float,
) -> pd.DataFrame:
    """Every row that is not in use, with what speaks against it."""
    import pandas as pd

    sizes = obs.stars_per_frame
    rows = np.flatnonzero(~residuals.in_use)
    frame = np.repeat(np.arange(obs.n_frames), sizes)[rows]
    statistic, dof = residuals.studentised(shrinkage)
    statistic, threshold = statistic[rows], star_threshold(star_p_value, dof[rows])
    reason = np.full(len(rows), "displaced", dtype=object)
    reason[np.isinf(statistic)] = "elsewhere"
    by_frame = statistic <= threshold
    reason[by_frame] = "taste"
    taste, limit = _taste_with(residuals, rows, frame, frame_p_value, shrinkage)
    statistic[by_frame], threshold[by_frame] = taste[by_frame], limit[by_frame]
    dropped = residuals.frame_count[frame] == 0
    reason[dropped] = np.where(
        sizes[frame[dropped]] < MIN_STARS, "frame_too_small", "frame_dropped"
    )
    statistic[dropped] = threshold[dropped] = np.nan
    data: AnyDict = {
        "row": rows,
        "frame": obs.frame[rows],
        "star_id": obs.named[rows].tolist(),
        "x_px": obs.x_px[rows],
        "y_px": obs.y_px[rows],
        "residual_px": residuals.residual_px[rows],
        "offset_deg": np.degrees(residuals.offset_rad[rows]),
        "statistic": statistic,
        "threshold": threshold,
        "reason": reason,
    }
    return pd.DataFrame(data, columns=list(COLUMNS))


def add_dropped_frames(
    table: pd.DataFrame,
    obs: Observations,
    camera: Camera,
    vote_rad: FloatArray,
    disturbed: FloatArray,
    frame_p_value: float,
) -> None:
    """Fill in rows of dropped frames: the distance from what most of the frame's stars agree on,
    and TASTE.

    `vote_rad` (N,) is the angle from that agreement; `disturbed` (K,) is TASTE of frames dropped
    for it (without stars that are far off), NaN for others. The table is changed in place.
    """
    from scipy.special import chdtri

    rows = table["row"].to_numpy()
    lost = table["reason"].isin(["frame_dropped", "frame_too_small"]).to_numpy()
    table.loc[lost, "residual_px"] = vote_rad[rows[lost]] * camera.focal_px
    table.loc[lost, "offset_deg"] = np.degrees(vote_rad[rows[lost]])
    frame = np.searchsorted(obs.frame_ids, obs.frame[rows])
    blamed = lost & ~np.isnan(disturbed[frame])
    table.loc[blamed, "reason"] = "frame_disturbed"
    table.loc[blamed, "statistic"] = disturbed[frame[blamed]]
    table.loc[blamed, "threshold"] = chdtri(
        2 * obs.stars_per_frame[frame[blamed]] - 3, frame_p_value
    )


def _taste_with(
    residuals: StarResiduals,
    rows: IntArray,
    frame: IntArray,
    frame_p_value: float,
    shrinkage: float,
) -> tuple[FloatArray, FloatArray]:
    """TASTE of the rows' frames with the star put back, and its limit."""
    from scipy.special import chdtri

    taste = (residuals.frame_cost[frame] + residuals.t[rows]) / residuals.variance(shrinkage)
    limit = chdtri(np.maximum(2 * residuals.frame_count[frame] - 1, 1), frame_p_value)
    return taste, floats(limit)


def warnings_about(
    obs: Observations, camera: Camera, kept: BoolArray, rejected: pd.DataFrame
) -> tuple[str, ...]:
    """What the pattern of the rejections says against the model or the data."""
    warnings = []
    share = 1.0 - np.count_nonzero(kept) / len(kept)
    if share > _MANY_REJECTED:
        warnings.append(clause(Rejections.MANY, share=share))
    displaced = rejected[rejected["reason"] == "displaced"]
    if len(displaced) < _PATTERN_ROWS:
        return tuple(warnings)
    radius = np.hypot(*(obs.xy - camera.theta[:2]).T)
    if _farther_p_value(radius[displaced["row"].to_numpy()], radius[kept]) < _PATTERN_P:
        warnings.append(clause(Rejections.AT_THE_EDGE))
    return tuple(warnings)


def _farther_p_value(sample: FloatArray, others: FloatArray) -> float:
    """Rank test (Mann-Whitney, normal approximation, one-sided) that `sample` tends to be
    larger.
    """
    from scipy.special import ndtr

    n, m = len(sample), len(others)
    below = np.searchsorted(np.sort(others), sample)
    z = (float(np.sum(below)) - 0.5 * n * m) / np.sqrt(n * m * (n + m + 1) / 12.0)
    return float(ndtr(-z))
