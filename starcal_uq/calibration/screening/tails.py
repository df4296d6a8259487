"""Are the stars wrong, or is the model? Rejections that neither noise nor wrong identifications
explain.

Wrong identifications lie anywhere: over the area around a star's place their squared distances are
even, and few of them are only just beyond the limit of noise. Where more stars are there than noise
and such a share let expect, the tails are those of the noise, or of a model that does not fit; so
are rejections that do not settle. Then stars are judged by the tails that they have: a Student t in
two dimensions, fitted to what hangs together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.calibration.screening.result import MARGINAL
from starcal_uq.core.types import AnyDict, BoolArray, FloatArray, floats
from starcal_uq.likelihood.student import DOF_RANGE

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.estimation.outliers import StarResiduals
    from starcal_uq.estimation.result import Calibration

# Probability that rejections of right noise and wrong stars are blamed on the model.
BLAME_P = 1e-3
# Probability that Gaussian noise is taken for one with tails.
_TAILS_P = 1e-3
_ROUNDS, _NU = 30, 40
# Stars of a cell of the detector, cells along a side at most, and the fewest stars of a cell that
# counts.
_PER_CELL, _MOST_CELLS, _FEWEST = 25, 12, 5


def allowed_near(
    statistic: FloatArray, threshold: FloatArray, expected_false: float
) -> tuple[int, int]:
    """Stars rejected just beyond the limit, and how many noise and wrong stars let be there.

    That is exceeded with probability `BLAME_P`, if squared distances of wrong stars are even.
    `statistic` (n,) is the squared distance of each rejected star in units of its variance,
    infinite for one elsewhere, `threshold` its limit, and `expected_false` are the right stars that
    the limit lets expect.
    """
    from scipy.special import pdtr

    near = statistic < MARGINAL * threshold
    far = statistic[~near & np.isfinite(statistic)]
    expected = expected_false
    if len(far):
        limit = float(np.median(threshold))
        # Wrong stars reach as far as the farthest.
        width = float(np.max(far)) - MARGINAL * limit
        expected += len(far) * (MARGINAL - 1.0) * limit / max(width, (MARGINAL - 1.0) * limit)
    allowed = 0
    while pdtr(allowed, expected) < 1.0 - BLAME_P:
        allowed += 1
    return int(np.count_nonzero(near)), allowed


@dataclass(frozen=True)
class Tails:
    """Squared distances as those of a Student t in two dimensions."""

    # `nu`, `scale2`: degrees of freedom, and squared scale per axis in the unit of the squared
    # distances.
    nu: float
    scale2: float
    gain: float  # By how much it is likelier than a Gaussian, nat
    within: BoolArray  # (n,): stars that belong to it

    @property
    def heavy(self) -> bool:
        """Whether a Gaussian is rejected: the ratio of likelihoods at the edge, half a chi-square
        with one degree.
        """
        from scipy.special import chdtri

        return 2.0 * self.gain > float(chdtri(1.0, 2.0 * _TAILS_P))


def fit_tails(t: FloatArray, p_value: float) -> Tails:
    """Tails of squared distances t (n,), and the stars beyond them with less than this probability.

    From the nearer half outwards: a star belongs to the tails as long as those before it let expect
    it.
    """
    within = t <= float(np.median(t[np.isfinite(t)])) * 10.0
    nu, scale2, gain = DOF_RANGE[1], 1.0, 0.0
    for _ in range(_ROUNDS):
        nu, scale2, gain = _fit(t[within])
        grown = t <= _limit(nu, scale2, p_value)
        if np.array_equal(grown, within):
            break
        within = grown
    return Tails(nu, scale2, gain, within)


def _limit(nu: float, scale2: float, p_value: float) -> float:
    """Squared distance that a Student t exceeds with this probability."""
    return nu * scale2 * float(np.expm1(-2.0 * np.log(p_value) / nu))


def _fit(t: FloatArray) -> tuple[float, float, float]:
    """Degrees of freedom and squared scale of the greatest likelihood over a grid, and its gain
    over the Gaussian.
    """
    n = len(t)
    gaussian = 0.5 * float(np.mean(t))
    plain = -n * (1.0 + np.log(gaussian))
    best = (DOF_RANGE[1], gaussian, 0.0)
    for nu in np.geomspace(*DOF_RANGE, _NU):
        scale2 = gaussian
        # Reweighting (Lange, Little & Taylor 1989).
        for _ in range(100):
            before, scale2 = scale2, 0.5 * float(np.mean(t * (nu + 2.0) / (nu + t / scale2)))
            if abs(scale2 - before) < 1e-6 * scale2:
                break
        value = -(0.5 * nu + 1.0) * float(np.sum(np.log1p(t / (nu * scale2)))) - n * np.log(scale2)
        if value - plain > best[2]:
            best = (float(nu), scale2, float(value - plain))
    return best


def follows_place(xy: FloatArray, cal: Calibration) -> bool:
    """Whether residuals follow the place on the detector, as those of a lens without its model do,
    and no tails.

    Their directions alone are summed, cell by cell: the spatial signs of Mottonen & Oja (1995),
    which tails of any kind leave as they are. Of n directions that are even, twice the squared
    length of the sum over n is a chi-square of two.
    """
    from scipy.special import chdtri

    e = floats(cal.residuals_px)
    length = np.hypot(*e.T)
    sign = e / np.where(length > 0.0, length, 1.0)[:, None]
    side = int(np.clip(np.sqrt(len(xy) / _PER_CELL), 2, _MOST_CELLS))
    place = np.clip(xy / [cal.camera.width_px, cal.camera.height_px] * side, 0, side - 1).astype(
        np.int64
    )
    cell = place @ [side, 1]
    count = np.bincount(cell, minlength=side**2)
    sums = np.stack([np.bincount(cell, part, side**2) for part in sign.T])
    filled = count >= _FEWEST
    statistic = 2.0 * float(np.sum(sums[:, filled] ** 2 / count[filled]))
    return statistic > float(chdtri(2.0 * np.count_nonzero(filled), BLAME_P))


def mark_beyond(
    table: pd.DataFrame, residuals: StarResiduals, tails: Tails, p_value: float
) -> None:
    """State in the table of rejected rows, in place, how far beyond the tails single stars are."""
    single = table["reason"].isin(["displaced", "taste"]).to_numpy()
    rows = table["row"].to_numpy()[single]
    table.loc[single, "reason"] = "displaced"
    table.loc[single, "statistic"] = residuals.t[rows] / residuals.variance()
    table.loc[single, "threshold"] = _limit(tails.nu, tails.scale2, p_value) / residuals.variance()


def blamed(
    near: int, allowed: int, n_rounds: int, stable: bool, cal: Calibration, follows: bool
) -> AnyDict:
    """Facts of a model that is to blame: by what that is known, and what became of the stars."""
    return {
        "near": int(near),
        "allowed": int(allowed),
        "n_rounds": n_rounds,
        "stable": bool(stable),
        "robust": cal.has_tails,
        "follows_place": bool(follows),
    }
