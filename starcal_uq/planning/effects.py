"""Effects that a calibration will hold: what frames will say of them and of the camera together,
before any data.

The coefficients of an effect of the run stand beside the camera's parameters, with the inverse of
their prior variance as information that is there already; those of single frames are eliminated from
each frame's information. Both follow from the columns that a calibration uses (`likelihood.effects`)
at noise-free stars.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, get_args

import numpy as np

from starcal_uq.core.errors import PlanningError
from starcal_uq.core.settings import WEIGHING, EffectName
from starcal_uq.core.types import BoolArray, FloatArray, StrArray
from starcal_uq.likelihood.effect_sums import Columns
from starcal_uq.likelihood.effects import Effect, effects_of
from starcal_uq.likelihood.elimination import products_by_frame
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.maths.linear import inverses
from starcal_uq.observations.frames import StarFrames
from starcal_uq.observations.table import Observations

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera

# Effects whose columns follow from stars at random attitudes: those of stars couple frames, air
# needs a place, and others weigh stars.
_NOT_PLANNED = ("star", "zenith", *WEIGHING)
PLANNED = tuple(name for name in get_args(EffectName) if name not in _NOT_PLANNED)
# Scale of an effect where none is given, px at the corner of the field.
SCALE_PX = 1.0
_HOURS, _START = 8.0, np.datetime64("2026-01-01T20:00:00", "ms")


@dataclass(frozen=True)
class PlannedEffects:
    """Effects of a calibration that is planned.

    Attributes
    ----------
    scales : mapping of str to float
        Scale of every effect, px at the corner of the field.
    temperature_range_c : float
        Width of the range over which temperatures of frames are spread evenly.
    nights : int
        Nights over which frames are spread, eight hours each.

    Raises
    ------
    PlanningError
        For effects that cannot be planned, or settings that cannot be.
    """

    scales: Mapping[str, float]
    temperature_range_c: float = 20.0
    nights: int = 3

    def __post_init__(self) -> None:
        for name, scale in self.scales.items():
            if name not in PLANNED:
                raise PlanningError(
                    f"the effect {name!r} cannot be planned: use some of {', '.join(PLANNED)}."
                )
            if not 0.0 < scale < np.inf:
                raise PlanningError(
                    f"the scale of the effect {name!r} is {scale:g} px: give a size above zero."
                )
        if not 0.0 < self.temperature_range_c < np.inf:
            raise PlanningError(
                f"temperature_range_c is {self.temperature_range_c:g}: give a width above zero."
            )
        if self.nights < (2 if "epoch" in self.scales else 1):
            raise PlanningError(f"nights is {self.nights}: the effect 'epoch' needs at least 2.")

    @classmethod
    def parsed(
        cls, text: str, temperature_range_c: float = 20.0, nights: int = 3
    ) -> PlannedEffects:
        """Effects of ``field,temperature=0.2``: names, with their scales in px where these are not
        1 px.
        """
        scales = {}
        for part in filter(None, (part.strip() for part in text.split(","))):
            name, given, size = part.partition("=")
            try:
                scales[name.strip()] = float(size) if given else SCALE_PX
            except ValueError:
                raise PlanningError(
                    f"{part!r} is no effect with its scale in px, such as field=0.3."
                ) from None
        if not scales:
            raise PlanningError(f"no effect is named: use some of {', '.join(PLANNED)}.")
        return cls(scales, temperature_range_c, nights)

    def seen(self, n_frames: int, seed: int) -> SeenEffects:
        """The effects with temperature and time of M frames."""
        rng = np.random.default_rng([seed, 28])
        warmth = self.temperature_range_c * (rng.random(n_frames) - 0.5)
        hours = 24.0 * rng.integers(0, self.nights, n_frames) + _HOURS * rng.random(n_frames)
        times = _START + (3.6e6 * hours).astype("timedelta64[ms]")
        return SeenEffects(self, 20.0 + warmth, times.astype(str))


@dataclass(frozen=True, eq=False)
class JointMatrices:
    """What M frames say of p parameters and m coefficients together, q = p + m.

    The last coefficients stand for what frames of a mission have for themselves, where there is
    such an effect. `information` (M, q, q), attitudes and the frames' own effects eliminated;
    `response` (M, 3, q), the errors of an attitude by errors of these, rad; `noise` (M, 3, 3),
    covariance of an attitude by centroid noise, rad^2; `prior` (q,), information on each before
    any data; `places`, coefficients of each effect; `per_kelvin`, slope for a coefficient of one of
    the effect of temperature.
    """

    information: FloatArray
    response: FloatArray
    noise: FloatArray
    prior: FloatArray
    places: Mapping[str, slice] = field(default_factory=dict)
    per_kelvin: float = np.nan


@dataclass(frozen=True, eq=False)
class SeenEffects:
    """Effects with temperature and time of M frames."""

    planned: PlannedEffects
    temperature_c: FloatArray
    time_utc: StrArray

    def only(self, names: Collection[str]) -> SeenEffects:
        """Some of the effects, over the same frames."""
        scales = {name: scale for name, scale in self.planned.scales.items() if name in names}
        return replace(self, planned=replace(self.planned, scales=scales))

    def of(self, kept: BoolArray) -> SeenEffects:
        """Those of some of the frames."""
        return replace(self, temperature_c=self.temperature_c[kept], time_utc=self.time_utc[kept])

    def _known(self, camera: Camera, frames: StarFrames, mag: FloatArray) -> list[Effect]:
        """The effects, as columns at the stars of the frames."""
        member = np.repeat(np.arange(frames.n_frames), frames.sizes)
        obs = Observations(
            frame=member,
            x_px=frames.pixel[0],
            y_px=frames.pixel[1],
            ra_deg=np.degrees(np.arctan2(frames.r[1], frames.r[0])) % 360.0,
            dec_deg=np.degrees(np.arcsin(np.clip(frames.r[2], -1.0, 1.0))),
            mag=mag,
            temperature_c=self.temperature_c[member],
            time_utc=self.time_utc[member],
        )
        known = effects_of(obs, camera)
        for name in self.planned.scales:
            if name not in known:
                raise PlanningError(f"the effect {name!r} does not vary over these frames.")
        # Effects of the run in the order of the names, whatever else stands between them.
        return [known[name] for name in self.planned.scales]

    def matrices(
        self, camera: Camera, frames: StarFrames, rotations: FloatArray, mag: FloatArray
    ) -> JointMatrices:
        """What noise-free frames at the camera's own parameters say."""
        effects, scales = self._known(camera, frames, mag), self.planned.scales
        run = [effect for effect in effects if effect.grouping == "run"]
        likelihood = MarginalLikelihood(frames, camera.distortion)
        state, _ = likelihood.profile(camera.theta, rotations)
        columns = Columns.of(effects, likelihood, state, camera.theta, slice(None))
        slopes = state.slopes
        turns = -likelihood.attitudes(state).coefficients(slopes)
        run_turns = columns.attitudes.coefficients(columns.raw)
        response = np.concatenate([turns, -run_turns]).transpose(2, 1, 0)
        every = np.concatenate([likelihood.project_out(state, slopes), columns.run])
        information = _products(frames, every)
        prior = [np.zeros(len(camera.theta))]
        prior += [(scales[effect.name] * effect.prior) ** -2.0 for effect in run]
        ends = np.cumsum([len(part) for part in prior]).tolist()
        places = {e.name: slice(*at) for e, *at in zip(run, ends[:-1], ends[1:], strict=True)}
        if columns.frame.size:
            variance = np.full(len(columns.frame), scales["frame"] ** 2)
            cross = products_by_frame(frames, columns.frame, every)
            own = products_by_frame(frames, columns.frame, columns.frame)
            taken = np.linalg.solve(own + np.diag(1.0 / variance), cross)
            information = information - np.swapaxes(cross, 1, 2) @ taken
            # Frames of a mission have their own, of which only the prior is known, and which are
            # not common.
            turned = columns.frame_turns.transpose(2, 1, 0) * np.sqrt(variance)
            response = np.concatenate([response, turned - turned.mean(axis=0)], axis=2)
            prior.append(np.ones(len(variance)))
            wider = (0, len(variance))
            information = np.pad(information, ((0, 0), wider, wider))
        spread = float(np.std(np.repeat(self.temperature_c, frames.sizes)))
        noise = np.ascontiguousarray(state.inverse.transpose(2, 0, 1))
        every_prior = np.concatenate(prior)
        return JointMatrices(information, response, noise, every_prior, places, 1.0 / spread)


def joint_inverses(information: FloatArray, p: int) -> FloatArray:
    """Covariances (..., q, q) of p parameters and coefficients that have a prior; infinite where
    the parameters are not determined.
    """
    inner = np.linalg.inv(information[..., p:, p:])
    follow = inner @ information[..., p:, :p]
    own = inverses(information[..., :p, :p] - information[..., :p, p:] @ follow)
    good = np.isfinite(own).all(axis=(-2, -1), keepdims=True)
    known = np.where(good, own, 0.0)
    back = -follow @ known
    found = np.empty_like(information)
    found[..., :p, :p], found[..., p:, :p] = known, back
    found[..., :p, p:] = np.swapaxes(back, -1, -2)
    found[..., p:, p:] = inner - back @ np.swapaxes(follow, -1, -2)
    return np.where(good, found, np.inf)


def _products(frames: StarFrames, columns: FloatArray) -> FloatArray:
    """Products (K, q, q) of columns (q, 2, N) among themselves; frame by frame, since those of all
    stars would not fit into memory.
    """
    found = np.empty((frames.n_frames, len(columns), len(columns)))
    for k, ends in enumerate(zip(frames.starts[:-1], frames.starts[1:], strict=True)):
        own = columns[:, :, slice(*ends)].reshape(len(columns), -1)
        found[k] = own @ own.T
    return found
