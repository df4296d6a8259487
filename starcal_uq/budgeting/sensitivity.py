"""What the totals of a budget depend on: noise, stars, frames, temperature, and each parameter of
the camera.

The rows say how: centroid noise follows the noise of a star and the root of their number; what the
calibration leaves follows the information of its data, which grows with frames and stars and falls
with the square of the noise, as far as the data and not the prior decide it. Each frame of m stars
gives 2 m - 3 numbers beyond its attitude.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.budgeting.budget import in_time
from starcal_uq.budgeting.file import BudgetFile, load_budget_file
from starcal_uq.budgeting.indices import Index, seen_by
from starcal_uq.budgeting.rows import ALIGNMENT, COMMON, NEA, REST, SCOPES, Contributor
from starcal_uq.budgeting.totals import Total
from starcal_uq.core.constants import AXES, INTERACTION, TOTAL_AXES
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import BudgetError, check_known, require
from starcal_uq.core.settings import bounded
from starcal_uq.core.types import FloatArray, PathLike
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
Inputs = Mapping[str, float | FloatArray]
_THERMAL = "thermo-elastic"
_STEP = 1e-4
_SAME = 1e-6


@dataclass(frozen=True)
class BudgetSensitivity:
    """How one total depends on one input.

    Attributes
    ----------
    of_index, scope, axis : str
        The total: error index with its times, scope, axis; mixed interpretation.
    name, unit : str
        One of ``noise``, ``stars`` (of a frame), ``frames`` (of the calibration), ``temperature``
        (excursion behind the rows of class thermo-elastic), or a parameter of the camera, whose
        input is its standard deviation.
    value : float
        The input as it is.
    elasticity : float
        Relative change of the total's standard deviation by that of the input.
    per_unit_arcsec : float
        Change of the bound of the total by one unit of the input.
    error_per_unit_arcsec : float
        Attitude error that the confidence of the budget keeps below, by an error of one unit of a
        parameter (`starcal_uq.propagation.sensitivities`); of absolute errors, NaN elsewhere.
    first_order, total_order : float
        Sobol shares of the input in the variance of the total's standard deviation, alone and with
        all others; NaN where they were not asked for.
    """

    of_index: str
    scope: str
    axis: str
    name: str
    unit: str
    value: float
    elasticity: float
    per_unit_arcsec: float
    error_per_unit_arcsec: float = float("nan")
    first_order: float = float("nan")
    total_order: float = float("nan")


@dataclass(frozen=True, eq=False)
class BudgetSensitivities(Shown):
    """`BudgetSensitivity` of every total and input."""

    entries: tuple[BudgetSensitivity, ...]

    def of(
        self, name: str, axis: str, scope: str = SCOPES[1], index: str = "AKE"
    ) -> BudgetSensitivity:
        """That of one input and total; KeyError where there is none."""
        for entry in self.entries:
            if (entry.name, entry.axis, entry.scope, entry.of_index) == (name, axis, scope, index):
                return entry
        raise KeyError(f"{name} of {index}, {axis}, {scope}")

    def to_dataframe(self) -> pd.DataFrame:
        """One row per total and input, with the attributes of a `BudgetSensitivity`."""
        import pandas as pd

        return pd.DataFrame([vars(entry) for entry in self.entries])


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
    n_samples: int = 256,
    seed: int = 0,
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
    n_samples, seed : int
        Samples behind the shares, a power of two, and their seed.

    Raises
    ------
    BudgetError
        For an unknown input, a half-width that is no share, or an index whose rows behave in time
        as `file` and `spectrum` do not say.
    """
    for name, width in (vary or {}).items():
        check_known("an input", name, SETTINGS, BudgetError)
        require(
            BudgetError, (0.0 < width < 1.0, f"vary: {name} is {width!r}; give a share below 1.")
        )
    require(
        BudgetError,
        (
            n_samples > 0 and n_samples & (n_samples - 1) == 0,
            f"n_samples is {n_samples}: give a power of two, such as 256.",
        ),
    )
    stated = file
    if not isinstance(stated, BudgetFile):
        stated = BudgetFile() if stated is None else load_budget_file(stated)
    frames = obs if mission is None else mission
    sizes = _Sizes.of(post, frames, obs.n_stars / obs.n_frames)
    behaviours = in_time(budget.rows, stated, post.camera, spectrum)
    own = turns(post.calibrated_camera, frames)
    inputs = _inputs(post, obs, temperature_k)
    entries: list[BudgetSensitivity] = []
    for label in dict.fromkeys(t.of_index for t in (*budget.totals, *budget.index_totals)):
        index = Index.of(label)
        seen, _ = seen_by(index, budget.rows, behaviours)
        for scope in SCOPES:
            counted = [r for r in seen if r.counts(scope) and r.assessed and r.applies]
            shares = sizes.sobol(counted, vary, n_samples, seed) if vary and counted else {}
            totals = [budget.total(axis, scope, index=label) for axis in TOTAL_AXES]
            for entry in sizes.of_totals(totals, counted, inputs):
                if entry.name not in SETTINGS and not index.windowed:
                    asked = entry.name, entry.axis, budget.confidence, scope == SCOPES[1]
                    entry = replace(entry, error_per_unit_arcsec=own.error_arcsec(*asked))
                if entry.name in shares:
                    place = TOTAL_AXES.index(entry.axis)
                    first, every = (float(share[place]) for share in shares[entry.name])
                    entry = replace(entry, first_order=first, total_order=every)
                entries.append(entry)
    return BudgetSensitivities(tuple(entries))


def _inputs(
    post: Posterior, obs: Observations, temperature_k: float
) -> dict[str, tuple[str, float]]:
    """Unit and value of every input."""
    noise_unit = "px" if post.sigma_name == "sigma" else "of the stated noise"
    found = {
        "noise": (noise_unit, float(np.mean(post.sigma_draws))),
        "stars": ("", obs.n_stars / obs.n_frames),
        "frames": ("", float(obs.n_frames)),
        "temperature": ("K", float(temperature_k)),
    }
    names = post.camera_names
    deviations = np.sqrt(np.diag(post.covariance)).tolist()
    units = {parameter.name: parameter.unit for parameter in post.parameters}
    return found | {n: (units[n], sd) for n, sd in zip(names, deviations, strict=True)}


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
                variance = float(np.sum(moved * rows))
                if not variance > 0.0:
                    continue
                decided = float(np.sum((moved @ information) * moved)) / variance
                data[name, axis] = min(decided, 1.0)
                own = np.sum(moved * rows, axis=0) / variance
                weights[name, axis] = dict(zip(post.camera_names, own.tolist(), strict=True))
        return cls(data, weights, mean_stars)

    def factor(self, row: Contributor, inputs: Inputs) -> FloatArray | float:
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
        return np.asarray(scale)

    def sigmas(self, rows: Sequence[Contributor], inputs: Inputs) -> FloatArray:
        """Standard deviation (4, ...) of the total on `TOTAL_AXES`, arcsec: rows of a group err as
        one.
        """
        sums: dict[tuple[str, str], FloatArray] = {}
        for number, row in enumerate(rows):
            group, sign = row.group
            place = group or str(number), row.axis
            amount = sign * row.sigma_arcsec * self.factor(row, inputs)
            sums[place] = sums.get(place, np.zeros(())) + amount
        squares = [
            sum((size**2 for (_, own), size in sums.items() if own == axis), np.zeros(()))
            for axis in AXES
        ]
        sigmas: FloatArray = np.sqrt(
            np.stack(np.broadcast_arrays(*squares, 0.5 * (squares[0] + squares[1])))
        )
        return sigmas

    def of_totals(
        self,
        totals: Sequence[Total],
        rows: list[Contributor],
        inputs: Mapping[str, tuple[str, float]],
    ) -> Iterator[BudgetSensitivity]:
        """What totals on `TOTAL_AXES`, made of some rows, depend on."""
        before = self.sigmas(rows, {})
        for total, sigma in zip(totals, before, strict=True):
            if rows and not abs(sigma - total.sigma_arcsec) <= _SAME * total.sigma_arcsec:
                raise BudgetError(
                    f"the totals of {total.of_index} rest on how rows behave in time: give the file "
                    "and the spectrum that the budget was made with."
                )
        turned = 2.0 * np.arctanh(_STEP)
        for name, (unit, value) in inputs.items():
            up, down = (self.sigmas(rows, {name: 1.0 + step}) for step in (_STEP, -_STEP))
            for total, ratio in zip(totals, up / down, strict=True):
                if not total.sigma_arcsec > 0.0:
                    continue
                elasticity = float(np.log(ratio) / turned)
                bound = total.factor * total.sigma_arcsec
                yield BudgetSensitivity(
                    *(total.of_index, total.scope, total.axis, name, unit, value, elasticity),
                    per_unit_arcsec=bound * elasticity / value,
                )

    def sobol(
        self, rows: list[Contributor], vary: Mapping[str, float], n_samples: int, seed: int
    ) -> dict[str, tuple[FloatArray, FloatArray]]:
        """First-order and total shares (4,) of each input that varies."""
        from scipy.stats import sobol_indices, uniform

        names = list(vary)

        def totals(points: FloatArray) -> FloatArray:
            return self.sigmas(rows, dict(zip(names, points, strict=True)))

        found = sobol_indices(
            func=totals,
            n=n_samples,
            dists=[uniform(1.0 - width, 2.0 * width) for width in vary.values()],
            rng=np.random.default_rng(seed),
        )
        first, every = (np.reshape(v, (4, -1)) for v in (found.first_order, found.total_order))
        return {name: (first[:, i], every[:, i]) for i, name in enumerate(names)}
