"""Forecast of a calibration from the information of its frames, before any data.

The covariance of the parameters after n frames is the inverse of the sum of their information. Few
frames make a calibration that depends on which they are: the forecast is therefore the mean over
campaigns of n frames drawn from a set of random ones, with the range of 90 % of the campaigns
beside it.

Everything else is linear in the parameters, so that its variance is the sum over entries of a
matrix times that covariance: parameters in other units, the displacement at the corner of the
detector, and per axis of the attitude the common rotation and the rest, root mean square over the
attitudes of the mission.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, get_args

import numpy as np

from starcal_uq.camera.distortion import get_model, parameters
from starcal_uq.core.constants import ARCSEC, AXES
from starcal_uq.core.errors import PlanningError, check_known
from starcal_uq.core.settings import Scope
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.maths.circular import mixture_radius
from starcal_uq.maths.linear import inverses
from starcal_uq.planning.effects import joint_inverses
from starcal_uq.planning.ties import PlannedTies, tied_campaigns

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.planning.information import FrameSet

# Parts of the attitude error that a target can be set for: what is in the error of one attitude.
SCOPES = get_args(Scope)
BAND = (0.05, 0.95)
N_FRAMES = (10, 30, 100, 300, 1000, 3000)
N_CAMPAIGNS = 200
MAX_FRAMES = 10_000_000
# Attitudes of the mission that quantiles are taken over, and scales of the covariance that they are
# interpolated from.
_MISSION_FRAMES, _SCALES = 200, 9
_TOLERANCE, _GUESS_FRAMES = 0.002, 1000


@dataclass(frozen=True, eq=False)
class Quantity:
    """Something linear in the parameters, whose variance is the sum of ``form * covariance``; its
    name has the unit.
    """

    name: str
    form: FloatArray


@dataclass(frozen=True, eq=False)
class Forecast:
    """What campaigns of n frames will give, for G numbers of frames and Q quantities."""

    n_frames: IntArray  # (G,): frames of a campaign
    names: tuple[str, ...]  # The quantities, with their units
    # `sigma`, `low`, `high`, (G, Q): standard deviation that a calibration will state: mean over
    # campaigns, and the range of 90 % of them.
    sigma: FloatArray
    low: FloatArray
    high: FloatArray
    # `radius`, `radius_low`, `radius_high`, (G,): two-axis error across the boresight at the
    # confidence asked for, arcsec: mean and range of 90 %.
    radius: FloatArray
    radius_low: FloatArray
    radius_high: FloatArray
    noise_sigma: FloatArray  # (G,): relative standard error of the estimated centroid noise

    def of(self, name: str) -> FloatArray:
        """Mean standard deviation (G,) of one quantity."""
        return self.sigma[:, self.names.index(name)]

    def to_dataframe(self) -> pd.DataFrame:
        """One row per number of frames: every quantity, and the radius with its range."""
        import pandas as pd

        table = pd.DataFrame({"n_frames": self.n_frames})
        for j, name in enumerate(self.names):
            table[name] = self.sigma[:, j]
        return table.assign(
            noise_relative=self.noise_sigma,
            radius_arcsec=self.radius,
            radius_low_arcsec=self.radius_low,
            radius_high_arcsec=self.radius_high,
        )


def quantities(mission: FrameSet) -> tuple[Quantity, ...]:
    """Parameters, and per axis the common rotation and the rest over the attitudes of a mission."""
    camera = mission.camera
    known = parameters(camera.distortion)
    unit = np.eye(mission.information.shape[1])
    chosen = [
        _quantity(f"{k.name}_{_suffix(k.unit)}", unit[i : i + 1]) for i, k in enumerate(known)
    ]
    if camera.pixel_um is not None:
        chosen.append(_quantity("f_mm", unit[2:3] * camera.pixel_um / 1000.0))
    if get_model(camera.distortion).lens:
        chosen.append(_quantity("distortion_corner_px", _corner_displacement(mission)))
    for axis, name in enumerate(AXES):
        chosen.append(_quantity(f"common_{name}_arcsec", ARCSEC * mission.common[axis : axis + 1]))
    for axis, name in enumerate(AXES):
        chosen.append(
            _quantity(
                f"rest_{name}_arcsec", ARCSEC * mission.rest[:, axis] / np.sqrt(mission.n_frames)
            )
        )
    joint = mission.joint
    if joint is not None and "temperature" in joint.places:
        slopes = unit[joint.places["temperature"]] * joint.per_kelvin
        for name, row in zip(("x0", "y0", "f"), slopes, strict=True):
            chosen.append(_quantity(f"{name}_px_per_K", row[None]))
    return tuple(chosen)


def _suffix(unit: str) -> str:
    """``px`` as it is, ``px^-2`` as ``per_px2``."""
    base, _, power = unit.partition("^-")
    return f"per_{base}{'' if power == '1' else power}" if power else base


def _quantity(name: str, rows: FloatArray) -> Quantity:
    """The root of the sum of the squares of some rows (m, p), taken at the parameters."""
    return Quantity(name, rows.T @ rows)


def _corner_displacement(mission: FrameSet) -> FloatArray:
    """Displacement (2, p) px by the distortion at the corner that is farthest from the principal
    point.
    """
    camera = mission.camera
    model = get_model(camera.distortion)
    columns = np.zeros((2, mission.information.shape[1]))
    for j, one in enumerate(np.eye(len(model.lens)).tolist()):
        columns[:, 3 + j] = model.displacement(*camera.corner_px, one)
    return columns


def nea_arcsec(mission: FrameSet) -> FloatArray:
    """Noise-equivalent angle (3,): standard deviation by centroid noise, root mean square over
    frames.
    """
    nea: FloatArray = ARCSEC * np.sqrt(np.diagonal(mission.noise, axis1=1, axis2=2).mean(axis=0))
    return nea


def campaigns(
    information: FloatArray,
    n_frames: int,
    n_campaigns: int,
    seed: int,
    start: FloatArray | None,
    n_parameters: int,
) -> FloatArray:
    """Covariances (C, q, q) after campaigns of n frames drawn, with replacement, from those of
    `information` (M, q, q).

    `start` (q, q) is information that is there already; all but the first `n_parameters` have some.
    What a campaign does not determine is infinite.
    """
    m, p = information.shape[:2]
    rng = np.random.default_rng([seed, n_frames])
    counts = rng.multinomial(n_frames, np.full(m, 1.0 / m), size=n_campaigns)
    total = (counts @ information.reshape(m, -1)).reshape(-1, p, p)
    total = total if start is None else total + start
    return inverses(total) if p == n_parameters else joint_inverses(total, n_parameters)


def start_with(mission: FrameSet, start: FloatArray | None) -> FloatArray | None:
    """Information (q, q) that is there already, on the parameters by `start` (p, p) and on effects
    by their prior; None where there is none.
    """
    if mission.joint is None:
        return start
    total = np.diag(mission.joint.prior)
    if start is not None:
        total[: len(start), : len(start)] += start
    return total


def spreads(forms: FloatArray, covariances: FloatArray) -> FloatArray:
    """Standard deviations (..., Q) of quantities with forms (Q, p, p) under covariances (..., p,
    p).
    """
    flat = covariances.reshape(*covariances.shape[:-2], -1)
    known = np.isfinite(flat).all(axis=-1, keepdims=True)
    variances = np.where(known, flat, 0.0) @ forms.reshape(len(forms), -1).T
    return np.where(known, np.sqrt(np.maximum(variances, 0.0)), np.inf)


@dataclass(frozen=True, kw_only=True)
class Outlook:
    """What a forecast is of, beyond its frames.

    `confidence`, `scope`: probability of the two-axis radius, and one of `SCOPES`. `start` (p, p),
    `start_dof`: information that is there already, and the degrees of freedom of those data.
    `ties`: rotations between frames that will be known. `n_campaigns`, `seed`: campaigns to draw.
    """

    confidence: float = 0.997
    scope: str = "common"
    start: FloatArray | None = None
    start_dof: float = 0.0
    ties: PlannedTies | None = None
    n_campaigns: int = N_CAMPAIGNS
    seed: int = 0

    def __post_init__(self) -> None:
        check_known("the scope", self.scope, SCOPES, PlanningError)
        if not 0.0 < self.confidence < 1.0:
            raise PlanningError(
                f"the confidence {self.confidence!r} is no probability: give one such as 0.997."
            )


class Forecaster:
    """Forecasts for one set of frames, one mission and one target.

    `information` (M, p, p): information of each frame that a campaign may take, if it is not that
    of the mission.
    """

    def __init__(
        self, mission: FrameSet, outlook: Outlook, information: FloatArray | None = None
    ) -> None:
        self.mission, self.outlook = mission, outlook
        self.information = mission.information if information is None else information
        scope = outlook.scope
        self.quantities = quantities(mission)
        self._forms = np.stack([q.form for q in self.quantities])
        some = slice(None, None, max(1, mission.n_frames // _MISSION_FRAMES))
        # Centred, so that the common rotation is the same in every scope.
        response = np.zeros((1, *mission.common.shape)) if scope == "common" else mission.rest[some]
        response = response - response.mean(axis=0)
        if scope != "rest":
            response = response + mission.common
        self._response = ARCSEC * response[:, :2]
        self._noise = (
            ARCSEC**2 * mission.noise[some, :2, :2] if scope == "total" else np.zeros((1, 2, 2))
        )
        self._size = np.einsum("kap,kaq->pq", self._response, self._response) / len(self._response)

        self._start = start_with(mission, outlook.start)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the quantities."""
        return tuple(q.name for q in self.quantities)

    def forecast(self, n_frames: Sequence[int]) -> Forecast:
        """What campaigns of each of these numbers of frames will give."""
        rows = []
        for n in n_frames:
            covariances = self.covariances(n)
            sigma, radius = spreads(self._forms, covariances), self.radii(covariances, n)
            rows.append(
                (
                    sigma.mean(axis=0),
                    *_band(sigma),
                    radius.mean(),
                    *_band(radius),
                    self.noise_sigma(n),
                )
            )
        columns = [np.array(column) for column in zip(*rows, strict=True)]
        return Forecast(np.array(n_frames, dtype=np.int64), self.names, *columns)

    def covariances(self, n_frames: int) -> FloatArray:
        """Covariances (C, p, p) of the parameters after drawn campaigns of n frames."""
        outlook = self.outlook
        drawn = (n_frames, outlook.n_campaigns, outlook.seed, self._start)
        if outlook.ties is not None:
            return tied_campaigns(outlook.ties, self.mission, self.information, *drawn)
        return campaigns(self.information, *drawn, len(self.mission.camera.theta))

    def dof(self, n_frames: int) -> float:
        """Independent numbers beyond the parameters, with those of the data that are there
        already.
        """
        tied = 0 if self.outlook.ties is None else 3 * (n_frames - 1)
        p = len(self.mission.camera.theta)
        own = n_frames * (2.0 * self.mission.mean_stars - 3.0) - p + tied
        return float(max(1.0, own + self.outlook.start_dof))

    def noise_sigma(self, n_frames: int) -> float:
        """Relative standard error of the estimated noise."""
        return float(1.0 / np.sqrt(2.0 * self.dof(n_frames)))

    def radii(self, covariances: FloatArray, n_frames: int) -> FloatArray:
        """Two-axis errors (C,) across the boresight at the confidence, arcsec, after some
        campaigns.

        Their size differs from campaign to campaign, their shape hardly: the radius is that of the
        mean covariance, interpolated to the size of each. The noise is estimated, too: quantiles
        are those of Student's distribution.
        """
        sizes = spreads(self._size[None], covariances)[:, 0] ** 2
        known = np.isfinite(sizes)
        if not known.any():
            return np.full(len(sizes), np.inf)
        mean = covariances[known].mean(axis=0)
        shape = self._response @ mean @ np.swapaxes(self._response, 1, 2)
        size = float(np.mean(np.trace(shape, axis1=1, axis2=2)))
        ratios = np.where(known, sizes, size) / size
        grid = np.linspace(np.sqrt(ratios.min()) * 0.999, np.sqrt(ratios.max()) * 1.001, _SCALES)
        at_grid = [
            mixture_radius(g**2 * shape + self._noise, self.outlook.confidence) for g in grid
        ]
        radii = student_factor(self.outlook.confidence, self.dof(n_frames)) * np.interp(
            np.sqrt(ratios), grid, at_grid
        )
        return np.where(known, radii, np.inf)

    def floor_arcsec(self) -> float:
        """Radius that no number of frames goes below: that of the centroid noise, where the scope
        has it.
        """
        return mixture_radius(self._noise, self.outlook.confidence)

    def frames_needed(self, target_arcsec: float, share: float | None = None) -> int | None:
        """Fewest frames whose radius (arcsec) is within a target; None where no number up to ten
        million is enough.

        `share` is the part of the campaigns that keep it, such as 0.95; by default campaigns keep
        it on average.
        """
        if self.floor_arcsec() >= target_arcsec:
            return None

        def kept(n: int) -> bool:
            radii = self.radii(self.covariances(n), n)
            return bool(
                (radii.mean() if share is None else np.quantile(radii, share)) <= target_arcsec
            )

        low, high = self._bracket(target_arcsec, kept)
        while high - low > max(1, int(_TOLERANCE * high)):
            middle = min(max(round(float(np.sqrt(low * high))), low + 1), high - 1)
            low, high = (low, middle) if kept(middle) else (middle, high)
        return high if high <= MAX_FRAMES else None

    def _bracket(self, target_arcsec: float, kept: Callable[[int], bool]) -> tuple[int, int]:
        """Numbers of frames that do not keep a target and that do; the second is beyond ten million
        where none does.
        """
        square = float(np.mean(self.radii(self.covariances(_GUESS_FRAMES), _GUESS_FRAMES))) ** 2
        floor = self.floor_arcsec() ** 2
        guess = _GUESS_FRAMES * (square - floor) / (target_arcsec**2 - floor)
        high = int(min(max(guess, 1.0), MAX_FRAMES)) if np.isfinite(guess) else 1
        low, step = 0, 1.02
        if kept(high):
            while high > 1:
                low = int(high / step)
                if low < 1 or not kept(low):
                    return max(low, 0), high
                high, step = low, step**2
            return 0, 1
        while not kept(high):
            if high >= MAX_FRAMES:
                return MAX_FRAMES, MAX_FRAMES + 1
            low, high, step = high, min(int(np.ceil(high * step)) + 1, MAX_FRAMES), step**2
        return low, high


def student_factor(confidence: float, dof: float) -> float:
    """How much wider a two-axis interval is because the noise is estimated, with that many degrees
    of freedom.
    """
    # Fisher's quantile with 2 and d degrees of freedom is d/2 ((1 - P)^(-2/d) - 1), Rayleigh's the
    # limit of many.
    exponent = -2.0 * float(np.log1p(-confidence)) / dof
    return float(np.sqrt(np.expm1(exponent) / exponent))


def _band(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    finite = np.where(np.isfinite(values), values, np.finfo(np.float64).max)
    low, high = np.quantile(finite, BAND, axis=0, method="closest_observation")
    return tuple(np.where(end < np.finfo(np.float64).max, end, np.inf) for end in (low, high))  # type: ignore[return-value]
