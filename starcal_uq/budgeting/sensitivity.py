"""What the totals of a budget depend on: noise, stars, frames, temperature, and each parameter of
the camera.

The rows say how: centroid noise follows the noise of a star and the root of their number; what the
calibration leaves follows the information of its data, which grows with frames and stars and falls
with the square of the noise, as far as the data and not the prior decide it. Each frame of m stars
gives 2 m - 3 numbers beyond its attitude.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.budgeting.budget import in_time
from starcal_uq.budgeting.file import BudgetFile, stated_in
from starcal_uq.budgeting.indices import Index, seen_by
from starcal_uq.budgeting.rows import ALIGNMENT, COMMON, NEA, REST, SCOPES, Contributor
from starcal_uq.core.constants import AXES, INTERACTION, TOTAL_AXES
from starcal_uq.core.errors import BudgetError, check_known, require
from starcal_uq.core.settings import Seed, bounded, seed_of
from starcal_uq.core.types import FloatArray, PathLike
from starcal_uq.maths.linear import root_diagonal
from starcal_uq.propagation.geometry import FrameGeometry
from starcal_uq.propagation.tolerance import sensitivities as turns

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.budgeting.result import Budget
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.table import Observations
    from starcal_uq.propagation.spectrum import ErrorSpectrum

SETTINGS = ("noise", "stars", "frames", "temperature")
# Factors on inputs: numbers, or arrays of one shape.
Inputs = Mapping[str, Any]
_THERMAL = "thermo-elastic"
_STEP, _SAME, _SAMPLES = 1e-4, 1e-6, 256
_HEADS = (
    *("of_index", "scope", "axis", "input", "unit", "value", "elasticity", "per_unit_arcsec"),
    *("error_per_unit_arcsec", "first_order", "total_order"),
)


@dataclass(frozen=True, eq=False)
class BudgetSensitivities:
    """Sensitivities of the totals of a budget, in the mixed interpretation, to its inputs.

    Attributes
    ----------
    table : pandas.DataFrame
        One row per total (``of_index``, ``scope``, ``axis``) and ``input``: ``noise``, ``stars``
        (of a frame), ``frames`` (of the calibration), ``temperature`` (excursion behind the rows of
        class thermo-elastic), or a parameter of the camera, of which the input is the standard
        deviation. ``unit`` and ``value`` of the input; ``elasticity``, the relative change of the
        total's standard deviation by that of the input; ``per_unit_arcsec``, the change of the
        total's bound by one unit; ``error_per_unit_arcsec``, the attitude error that the confidence
        of the budget keeps below by an error of one unit of a parameter
        (`starcal_uq.propagation.sensitivities`; NaN for settings and windows); ``first_order`` and
        ``total_order``, Sobol shares of the input in the variance of the standard deviation, NaN
        where they were not asked for.
    """

    table: pd.DataFrame

    def of(self, name: str, axis: str, scope: str = SCOPES[1], index: str = "AKE") -> pd.Series:
        """The row of one input and total; KeyError where there is none."""
        keys = list(_HEADS[:4])
        return self.table.set_index(keys, drop=False).loc[(index, scope, axis, name)]

    def to_dataframe(self) -> pd.DataFrame:
        """The table."""
        return self.table.copy()


@bounded
def sensitivities(
    budget: Budget,
    post: Posterior,
    obs: Observations,
    mission: Observations | None = None,
    *,
    file: BudgetFile | PathLike | None = None,
    spectrum: ErrorSpectrum | None = None,
    temperature_k: float = float("nan"),
    vary: Mapping[str, float] | None = None,
    seed: Seed = 0,
) -> BudgetSensitivities:
    """Sensitivities of every total of a budget.

    Parameters
    ----------
    budget : Budget
        The budget of this posterior.
    post : Posterior
        The calibration.
    obs : Observations
        Its frames.
    mission : Observations, optional
        Frames that the attitude errors are of; `obs` by default.
    file, spectrum
        Budget file and error spectrum that the budget was made with, which indices over windows
        need.
    temperature_k : float, optional
        Excursion of the temperature that the rows of class thermo-elastic are for, K.
    vary : dict, optional
        Half-widths, relative to the value, over which ``noise``, ``stars``, ``frames`` or
        ``temperature`` vary evenly, such as ``{"noise": 0.2, "stars": 0.3}``: Sobol shares are then
        found (`scipy.stats.sobol_indices`; Saltelli et al. 2010).
    seed : int or Generator
        Seed of the samples behind the shares.

    Raises
    ------
    BudgetError
        For an unknown input, a half-width that is no share, or an index whose rows behave in time
        as `file` and `spectrum` do not say.
    """
    seed = seed_of(seed)
    import pandas as pd

    vary = vary or {}
    for name, width in vary.items():
        check_known("an input", name, SETTINGS, BudgetError)
        share = f"vary: {name} is {width!r}; give a share below 1."
        require(BudgetError, (0.0 < width < 1.0, share))
    stated = stated_in(file)
    frames = obs if mission is None else mission
    mean_stars = obs.n_stars / obs.n_frames
    sizes = _Sizes.of(post, frames, mean_stars)
    behaviours = in_time(budget.rows, stated, post.camera, spectrum)
    own = turns(post.calibrated_camera, frames)
    noise_unit = "px" if post.sigma_name == "sigma" else "of the stated noise"
    values = float(np.mean(post.sigma_draws)), mean_stars, obs.n_frames, temperature_k
    inputs = list(zip(SETTINGS, (noise_unit, "", "", "K"), values, strict=True))
    known = zip(post.parameters, root_diagonal(post.covariance), strict=False)
    inputs += [(parameter.name, parameter.unit, sd) for parameter, sd in known]
    rows = []
    for label in dict.fromkeys(t.of_index for t in (*budget.totals, *budget.index_totals)):
        index = Index.of(label)
        seen, _ = seen_by(index, budget.rows, behaviours)
        for scope in SCOPES:
            counted = [r for r in seen if r.counts(scope) and r.assessed and r.applies]
            totals = [budget.total(axis, scope, index=label) for axis in TOTAL_AXES]
            if not counted:
                continue
            off = sizes.sigmas(counted, {}) - [total.sigma_arcsec for total in totals]
            if np.any(np.abs(off) > _SAME * np.max([total.sigma_arcsec for total in totals])):
                raise BudgetError(
                    f"the totals of {label} rest on how rows behave in time: give the file and the "
                    "spectrum that the budget was made with."
                )
            shares = sizes.sobol(counted, vary, seed) if vary else {}
            for name, unit, value in inputs:
                elasticity = sizes.elasticity(counted, name)
                first, every = shares.get(name, np.full((2, 4), np.nan))
                for place, total in enumerate(totals):
                    error = np.nan
                    if name not in SETTINGS and not index.windowed:
                        asked = name, total.axis, budget.confidence, scope == SCOPES[1]
                        error = own.error_arcsec(*asked)
                    change = elasticity[place]
                    bound = total.factor * total.sigma_arcsec * change / value
                    found = (change, bound, error, first[place], every[place])
                    rows.append((label, scope, total.axis, name, unit, value, *found))
    return BudgetSensitivities(pd.DataFrame(rows, columns=list(_HEADS)))


@dataclass(frozen=True, eq=False)
class _Sizes:
    """How rows follow inputs.

    `data` has for each row and axis of the calibration the share of its variance that the data
    decide, `weights` the share of it that each parameter brings with its correlations, and
    `mean_stars` is the number of stars of a frame.
    """

    data: dict[tuple[str, str], float]
    weights: dict[tuple[str, str], dict[str, float]]
    mean_stars: float

    @classmethod
    def of(cls, post: Posterior, frames: Observations, mean_stars: float) -> _Sizes:
        response = FrameGeometry.of(post, frames).response
        common = response.mean(axis=0, keepdims=True)
        sigma, information = post.covariance, post.information
        data, weights = {}, {}
        for name, turned in ((COMMON, common), (REST, response - common)):
            for place, axis in enumerate(AXES):
                rows = turned[:, place]
                moved = rows @ sigma
                own = np.sum(moved * rows, axis=0)
                if own.sum() > 0.0:
                    decided = np.sum((moved @ information) * moved) / own.sum()
                    data[name, axis] = min(float(decided), 1.0)
                    weights[name, axis] = dict(zip(post.camera_names, own / own.sum(), strict=True))
        return cls(data, weights, mean_stars)

    def factor(self, row: Contributor, inputs: Inputs) -> Any:
        """Factor on the sigma of a row when inputs change by factors, numbers or arrays of them."""
        noise, stars = inputs.get("noise", 1.0), inputs.get("stars", 1.0)
        informed = (2.0 * stars * self.mean_stars - 3.0) / (2.0 * self.mean_stars - 3.0)
        gain = inputs.get("frames", 1.0) * informed / noise**2
        centroids = noise**2 / stars
        ours = row.source == "posterior"
        if row.ecss_class == _THERMAL:
            return inputs.get("temperature", 1.0)
        if row.name == NEA or (row.name == ALIGNMENT and ours):
            return np.sqrt(centroids)
        if row.name == INTERACTION:
            return np.sqrt(centroids / gain)
        place = row.name, row.axis
        if place not in self.data:
            return 1.0
        # What the misfit adds to a row follows none of the inputs.
        held = 1.0
        if row.if_model_holds_arcsec < row.with_misfit_found_arcsec:
            held = (row.if_model_holds_arcsec / row.with_misfit_found_arcsec) ** 2
        share = held * self.data[place]
        scale = np.sqrt(1.0 - share + share / gain)
        for name, weight in self.weights[place].items():
            scale = scale * inputs.get(name, 1.0) ** (held * weight)
        return scale

    def sigmas(self, rows: Sequence[Contributor], inputs: Inputs) -> FloatArray:
        """Standard deviation (4, ...) of the total on `TOTAL_AXES`, arcsec: rows of a group err as
        one.
        """
        sums: dict[str, dict[str, Any]] = {axis: {} for axis in AXES}
        for row in rows:
            group, sign = row.group
            of_axis, amount = sums[row.axis], sign * row.sigma_arcsec * self.factor(row, inputs)
            place = group or str(len(of_axis))
            of_axis[place] = of_axis.get(place, 0.0) + amount
        x, y, z = (sum(amount**2 for amount in of_axis.values()) for of_axis in sums.values())
        return np.asarray(np.sqrt(np.stack(np.broadcast_arrays(x, y, z, 0.5 * (x + y)))))

    def elasticity(self, rows: Sequence[Contributor], name: str) -> FloatArray:
        """Relative change (4,) of the totals' standard deviations by that of one input."""
        up, down = (self.sigmas(rows, {name: 1.0 + step}) for step in (_STEP, -_STEP))
        return np.asarray(np.log(up / down) / (2.0 * np.arctanh(_STEP)))

    def sobol(
        self, rows: Sequence[Contributor], vary: Mapping[str, float], seed: int
    ) -> dict[str, FloatArray]:
        """First-order and total shares (2, 4) of each input that varies."""
        from scipy.stats import sobol_indices, uniform

        found = sobol_indices(
            func=lambda points: self.sigmas(rows, dict(zip(vary, points, strict=True))),
            n=_SAMPLES,
            dists=[uniform(1.0 - width, 2.0 * width) for width in vary.values()],
            rng=np.random.default_rng(seed),
        )
        both = np.stack([found.first_order, found.total_order]).reshape(2, 4, -1)
        return dict(zip(vary, np.moveaxis(both, 2, 0), strict=True))
