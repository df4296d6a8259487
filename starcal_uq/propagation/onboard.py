"""What effects of a calibration do to the attitudes of a mission.

The software aboard knows the camera's parameters, and what was uploaded of the effects. With R_k
the turn of frame k by the parameters, at the same pixels, and T_k its turn by the effects' columns
of pixel shifts, its attitude errs by

    phi_k = R_k (theta_aboard - theta) + T_k a + T_k a_k,

with a the coefficients of the run, jointly known with theta, and a_k those that every frame draws
for itself. Where theta alone is aboard, all of a is an error: its best value squared and its
covariance; where effects are aboard, what is left is the covariance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import ObservationError
from starcal_uq.core.provenance import Provenance
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.likelihood.effects import Effect, effects_of
from starcal_uq.likelihood.fitted_effects import Effects
from starcal_uq.maths.linear import scaled_inverse
from starcal_uq.propagation.geometry import FrameGeometry
from starcal_uq.propagation.onboard_error import PARAMETERS

if TYPE_CHECKING:
    from starcal_uq.core.settings import OnboardModel
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.likelihood.shapes import View
    from starcal_uq.observations.table import Observations

# Effects whose columns change with what a table states, by its own mean and spread.
_WITH_COVARIATES = {"temperature", "time", "magnitude"}
# The effect of nights: a mission sees others than the calibration.
NIGHT = "epoch"
# Effects of the air, which a mission in space has not.
_OF_AIR = {"zenith"}
# Share of the largest eigenvalue below which one is rounding.
_ROUNDING = 1e-13


@dataclass(frozen=True, eq=False)
class Extended:
    """A calibration with the effects that its data support, as far as attitudes need it.

    Attributes
    ----------
    camera : Camera
        The estimate beside the effects.
    covariance : (p, p) array
        Covariance of its parameters, px units.
    effects : Effects
        The effects, without the nodes of their scales.
    provenance : Provenance
        That of the calibration.
    """

    camera: Camera
    covariance: FloatArray
    effects: Effects
    provenance: Provenance

    SHAPES: ClassVar = "p p: covariance"

    @property
    def mean(self) -> FloatArray:
        """The parameters (p,), px units."""
        return self.camera.theta


@dataclass(frozen=True, eq=False)
class Turns:
    """Turns of K frames, rad.

    `response` (K, 3, q): by the parameters, and by the coefficients of the run with the other sign.
    `own` (K, 3, 3) by effect: covariances of those that every frame draws for itself.
    """

    response: FloatArray
    own: Mapping[str, FloatArray]


@dataclass(frozen=True, eq=False)
class Aboard:
    """Parameters and coefficients that attitudes err by.

    `calibrated` is the table of the calibration, which says what effects change with. `theta` (p,)
    are the parameters aboard; those of the posterior by default.
    """

    post: Posterior | Extended
    calibrated: Observations
    theta: FloatArray | None = None

    @cached_property
    def _effects(self) -> list[Effect]:
        """The effects of the calibration."""
        found = self.post.effects
        if found is None:
            return []
        try:
            effects = found.of(self.calibrated, self.post.camera)
            if _WITH_COVARIATES & set(found.names) and not self._is_of_posterior:
                raise LookupError("covariates of another table")
        except LookupError as error:
            raise ObservationError(
                f"the effects of this posterior ({', '.join(found.names)}) are those of the table "
                "that it was sampled from: give that table as `calibrated`."
            ) from error
        return effects

    @property
    def _is_of_posterior(self) -> bool:
        made_of = self.post.provenance
        # Of partitions, the sample that their calibration keeps stands for all.
        known = None, self.calibrated.data_hash
        return made_of.data_sha256 in known or made_of.partitions.get("sample_sha256") in known[1:]

    @cached_property
    def _run(self) -> dict[str, IntArray]:
        """Places of the coefficients of every effect of the run that a mission shares."""
        sizes = {} if self.post.effects is None else dict(self.post.effects.places)
        ends = np.cumsum([0, *sizes.values()])
        places = zip(sizes, ends[:-1], ends[1:], strict=True)
        # A mission has its own nights, and is above the air.
        own = (NIGHT, *_OF_AIR)
        return {name: np.arange(*ends) for name, *ends in places if name not in own}

    @cached_property
    def _night(self) -> FloatArray:
        """Variances (3,) of x0, y0 and f in another night; none where nights agree."""
        camera, found = self.post.camera, self.post.effects
        corner = np.array([1.0, 1.0, float(camera.focal_px) / camera.corner_radius_px])
        here = found is not None and NIGHT in found.names
        return np.square(found.scale(NIGHT) * corner) if found is not None and here else corner[:0]

    @cached_property
    def places(self) -> dict[str, slice]:
        """Columns of the run's effects, behind those of the parameters; a night comes last."""
        sizes = {name: len(place) for name, place in self._run.items()}
        sizes |= {NIGHT: 3} if len(self._night) else {}
        ends = (len(self.post.mean) + np.cumsum([0, *sizes.values()])).tolist()
        return {n: slice(*at) for n, *at in zip(sizes, ends[:-1], ends[1:], strict=True)}

    @cached_property
    def _joint(self) -> tuple[FloatArray, FloatArray]:
        """Expected values (q,), of the parameters less those aboard, and covariance (q, q)."""
        found, p = self.post.effects, len(self.post.mean)
        off = np.zeros(p) if self.theta is None else self.post.mean - self.theta
        if found is None or not self.places:
            return off, self.post.covariance
        kept = np.concatenate([np.arange(0), *self._run.values()])
        nothing = np.zeros((p + len(kept), len(self._night)))
        # Files do not tell the sizes of arrays that hold nothing.
        m = len(found.coefficients)
        cross = found.cross.reshape(p, m)[:, kept]
        own = found.covariance.reshape(m, m)[np.ix_(kept, kept)]
        covariance = np.block([[self.post.covariance, cross], [cross.T, own]])
        return np.concatenate([off, found.coefficients[kept], nothing[0]]), np.block(
            [[covariance, nothing], [nothing.T, np.diag(self._night)]]
        )

    @cached_property
    def shares(self) -> list[tuple[str, slice, FloatArray]]:
        """Parts of the joint covariance: name, own columns, and a root (q, m); of the parameters
        first, then of what is left of each effect when all before it are known. The squares of the
        roots add up to it.
        """
        left, found = self._joint[1].copy(), []
        for name, at in {PARAMETERS: slice(0, len(self.post.mean)), **self.places}.items():
            unit = np.sqrt(np.diag(left)[at])
            unit = np.where(unit > 0.0, unit, 1.0)
            values, vectors = np.linalg.eigh(left[at, at] / np.outer(unit, unit))
            good = values > _ROUNDING * max(values[-1], 0.0)
            root = left[:, at] @ (vectors[:, good] / (unit[:, None] * np.sqrt(values[good])))
            found.append((name, at, root))
            left = left - root @ root.T
        return found

    def expected(self, onboard: OnboardModel) -> FloatArray:
        """Expected values (q,) of what the software does not correct."""
        expected, _ = self._joint
        return expected if onboard == "model" else np.zeros_like(expected)

    def moments(self, onboard: OnboardModel) -> FloatArray:
        """Second moments (q, q) of what is not known aboard."""
        expected = self.expected(onboard)
        return self._joint[1] + np.outer(expected, expected)

    def draws(self, theta: FloatArray, onboard: OnboardModel, seed: int) -> FloatArray:
        """Draws (n, q) of it that belong to draws (n, p) of the parameters."""
        shift, covariance = theta - self.post.mean, self._joint[1]
        p = shift.shape[1]
        if not self.places:
            return shift
        follow = scaled_inverse(covariance[:p, :p]) @ covariance[:p, p:]
        values, vectors = np.linalg.eigh(covariance[p:, p:] - covariance[p:, :p] @ follow)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        rng = np.random.default_rng((seed, 29))
        own = shift @ follow + rng.standard_normal((len(shift), len(values))) @ root.T
        return np.column_stack((shift, own + self.expected(onboard)[p:]))

    def turns(self, geometry: FrameGeometry, frames: Observations) -> Turns:
        """What parameters and effects do to the attitudes of some frames."""
        found = self.post.effects
        if found is None:
            return Turns(geometry.response, {})
        camera = self.post.camera
        here = effects_of(self.calibrated, camera, seen=frames, extent=found.extent)
        frame = [effect for effect in self._effects if effect.grouping == "frame"]
        shapes = [here[name].columns for name in self._run] + [e.columns for e in frame]

        def columns(view: View) -> FloatArray:
            every = [shape.columns(view) for shape in shapes]
            every.insert(len(self._run), view.parameter_columns[: len(self._night)])
            return np.concatenate(every)

        turned = geometry.turned(frames, camera, columns)
        size = len(self._joint[0]) - len(self.post.mean)
        ends = np.cumsum([size, *(effect.columns.size for effect in frame)])
        own = {}
        for effect, first, last in zip(frame, ends[:-1], ends[1:], strict=True):
            part = turned[:, :, first:last] * (found.scale(effect.name) * effect.prior)
            own[effect.name] = part @ np.swapaxes(part, 1, 2)
        return Turns(np.concatenate([geometry.response, -turned[:, :, :size]], axis=2), own)
