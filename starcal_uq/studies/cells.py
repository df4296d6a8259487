"""One cell of a study: from its settings to its numbers, by Fisher information.

The covariance after n frames is that of an estimate which weighs images by their whole variance,

    C = (n F + P)^-1 (n F + P + n A + n (n - 1) B) (n F + P)^-1,

with F the mean information of a frame (attitudes eliminated) and P the prior's precision. A and B
are there where stars bring errors into all of their images: what these add to the variance of a
frame's score, and the covariance of the scores of two frames. Everything else follows from C: it is
what `coupling` says of a posterior, before there is any.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import parameter_names, simpler_models
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.errors import StarcalError, StudyError
from starcal_uq.core.types import AnyDict, AnyMapping, FloatArray
from starcal_uq.inference.priors import Priors
from starcal_uq.maths.linear import correlation_of, inverses, root_diagonal
from starcal_uq.planning.effects import JointMatrices, PlannedEffects, joint_inverses
from starcal_uq.propagation.coupling import weak_directions
from starcal_uq.studies.axes import CAMERA_AXES, camera_of, planned_effects
from starcal_uq.studies.definition import Cell, StudyDefinition
from starcal_uq.studies.geometry import (
    Geometry,
    GeometryKey,
    Heaven,
    NoiseShape,
    Statements,
    geometry_key,
    mission_key,
    noise_shape,
    offset_of,
    star_noise,
    statements,
    take_frames,
)

# Numbers of frames, relative to a cell's own, at which its errors are kept: what a target takes
# follows from them.
FRAME_FACTORS = 10.0 ** np.arange(-3.0, 3.01, 0.25)
# Entries of a `priors` table, and the parameters that they are about.
_PRIOR_OF = {
    "principal_point_px": slice(0, 2),
    "focal_fraction": slice(2, 3),
    "distortion_corner_px": slice(3, None),
}
# Sets of frames that are kept: the last ones, and those of the mission for the patterns of a
# camera.
_KEPT = 8
UNDETERMINED = (
    "the frames do not determine every parameter: use more stars, a simpler model, or a prior."
)
Numbers = AnyDict


class Cells(ABC):
    """Numbers of cells, one after the other; what neighbours share is kept from one to the next."""

    def __init__(self, definition: StudyDefinition, heaven: Heaven) -> None:
        self.definition, self.heaven = definition, heaven
        self._camera: tuple[Any, Camera] | None = None

    def camera(self, cell: Cell) -> Camera:
        """Camera of a cell, the last one if it is the same."""
        key = tuple(cell.settings.get(name) for name in CAMERA_AXES)
        if self._camera is None or self._camera[0] != key:
            self._camera = key, camera_of(self.definition.camera, cell.settings)
        return self._camera[1]

    def numbers(self, cell: Cell) -> Numbers:
        """All numbers of a cell; `status` is a sentence where there are none."""
        try:
            return self._numbers(cell, self.camera(cell)) | {"status": "ok"}
        except StarcalError as error:
            return {"status": str(error)}
        except np.linalg.LinAlgError:
            return {"status": UNDETERMINED}

    @abstractmethod
    def _numbers(self, cell: Cell, camera: Camera) -> Numbers:
        """Numbers of a cell by name."""


class FisherCells(Cells):
    """Cells by Fisher information."""

    def __init__(self, definition: StudyDefinition, heaven: Heaven) -> None:
        super().__init__(definition, heaven)
        self._geometries: dict[GeometryKey, Geometry | StudyError] = {}
        self._stated: tuple[Any, Statements] | None = None

    def _numbers(self, cell: Cell, camera: Camera) -> Numbers:
        settings = cell.settings
        stated, scale = self.stated(cell, camera)
        n = settings["frames"]
        counts = self._campaign(cell, n, len(stated.information)) / scale**2
        prior = prior_precision(self.definition.priors.get(settings["prior"]), camera)
        return campaign_numbers(stated, counts, prior, n, scale)

    def _campaign(self, cell: Cell, n: int, m: int) -> FloatArray:
        """How often each of m frames is in a campaign of n."""
        if cell.settings["pointing"] != "random" or cell.settings["direction_mas"] > 0.0:
            return np.full(m, n / m)
        rng = np.random.default_rng([self.definition.seed, cell.seed_index, n, 12])
        if 4 * n <= m:
            counts = np.zeros(m)
            counts[rng.choice(m, n, replace=False)] = 1.0
            return counts
        return rng.multinomial(n, np.full(m, 1.0 / m)).astype(np.float64)

    def geometry(self, key: GeometryKey) -> Geometry:
        """Frames of that key, as they are or from before."""
        if key not in self._geometries:
            if len(self._geometries) >= _KEPT:
                self._geometries.clear()
            try:
                self._geometries[key] = take_frames(key, self.heaven, self.definition.geometries)
            except StudyError as error:
                self._geometries[key] = error
        found = self._geometries[key]
        if isinstance(found, StudyError):
            raise found
        return found

    def stated(self, cell: Cell, camera: Camera) -> tuple[Statements, float]:
        """What the frames of a cell say, and do to attitudes of a mission, and the noise to scale
        it by.
        """
        settings = cell.settings
        key = geometry_key(camera, settings, self.definition.seed, cell.seed_index, False)
        offset = offset_of(camera, settings)
        shape, scale = noise_shape(settings, camera.focal_px)
        effects = planned_effects(settings)
        if effects is not None and offset > 0.0:
            raise StudyError(
                "effects and errors of the stars are not studied together: leave effects or "
                "direction_mas out."
            )
        if isinstance(shape, tuple) and (offset > 0.0 or effects is not None):
            # Two sizes of noise have no common factor, and noise none with effects of frames.
            shape, scale = (settings["sigma_px"], *shape[1:]), 1.0
        whole = (key, settings.get("stars"), shape, offset, effects)
        if self._stated is None or self._stated[0] != whole:
            stated = self._state(*whole)
            if key.pointing != "random":
                stated = stated.for_mission(self._state(mission_key(key), *whole[1:]))
            self._stated = whole, stated
        return self._stated[1], scale

    def _state(
        self,
        key: GeometryKey,
        stars: int | None,
        shape: NoiseShape,
        offset: float,
        effects: PlannedEffects | None,
    ) -> Statements:
        chosen = self.geometry(key).brightest(stars)
        return statements(chosen, star_noise(chosen.mag, shape), offset, effects)


def prior_precision(table: AnyMapping | None, camera: Camera) -> FloatArray | None:
    """Precision (p,) of the entries that a prior set states; None for no prior."""
    if table is None:
        return None
    precision = np.zeros(len(camera.theta))
    stated = Priors.default(camera).replace(**table).sd(parameter_names(camera.distortion))
    for entry, place in _PRIOR_OF.items():
        if entry in table:
            precision[place] = stated[place] ** -2.0
    return precision


def campaign_numbers(
    stated: Statements, counts: FloatArray, prior: FloatArray | None, n: int, scale: float = 1.0
) -> Numbers:
    """What a campaign of n frames says, frame k counted `counts[k]` times; noise `scale` times that
    stated.
    """
    camera = stated.camera
    frame = np.tensordot(counts, stated.information, 1) / n
    found = coupling_numbers(frame, prior, n, stated)
    own = frame if stated.joint is None else without_effects(frame, stated.joint, n)
    found |= simpler_numbers(own, n, float(counts @ stated.weights), stated)
    return found | {
        "n_frames": n,
        "mean_stars": stated.mean_stars,
        "field_deg": camera.fov_deg[0],
        "truth": camera.theta,
        "nea_arcsec": ARCSEC * scale * np.sqrt(stated.noise),
    }


def without_effects(frame: FloatArray, joint: JointMatrices, n: int) -> FloatArray:
    """Mean information (p, p) on the parameters of n frames, effects eliminated."""
    p = int(np.count_nonzero(joint.prior == 0.0))
    inner = frame[p:, p:] + np.diag(joint.prior[p:]) / n
    return frame[:p, :p] - frame[:p, p:] @ np.linalg.solve(inner, frame[p:, :p])


def covariances(
    frame: FloatArray,
    prior: FloatArray,
    spread: tuple[FloatArray, FloatArray] | None,
    n: FloatArray,
    p: int,
) -> FloatArray:
    """Covariances (k, q, q) of p parameters, and of what has a prior behind them, after numbers of
    frames (k,): the module's formula.
    """
    total = n[:, None, None] * frame + np.diag(prior)
    inverse = inverses(total) if p == len(frame) else joint_inverses(total, p)
    if spread is None:
        return inverse
    a, b = spread
    extra = n[:, None, None] * a + (n * np.maximum(n - 1.0, 0.0))[:, None, None] * b
    return inverse + inverse @ extra @ inverse


def coupling_numbers(
    frame: FloatArray,
    prior: FloatArray | None,
    n: int,
    stated: Statements,
) -> Numbers:
    """What couples after n frames with a mean information of `frame` each."""
    p, joint = len(stated.camera.theta), stated.joint
    plain = np.zeros(len(frame)) if joint is None else joint.prior
    precision = plain.copy()
    precision[:p] += 0.0 if prior is None else prior
    numbers = np.concatenate([[1.0], FRAME_FACTORS]) * n
    every = covariances(frame, precision, stated.star_spread, numbers, p)
    if not np.isfinite(every[0]).all():
        raise StudyError(UNDETERMINED)
    data = (
        every[0]
        if prior is None
        else covariances(frame, plain, stated.star_spread, numbers[:1], p)[0]
    )
    common, forms = stated.common, stated.rest_forms
    cross = 0.5 * (forms[0] + forms[1])
    with np.errstate(invalid="ignore"):
        curve = ARCSEC * np.sqrt(np.einsum("kpq,pq->k", every[1:], cross))
        sigma_curve = np.sqrt(np.diagonal(every[1:], axis1=1, axis2=2))[:, :p]
    total = n * frame + np.diag(precision)
    slopes: Numbers = {}
    if joint is not None:
        total = np.linalg.inv(every[0][:p, :p])
        if "temperature" in joint.places:
            sigma = root_diagonal(every[0])[joint.places["temperature"]] * joint.per_kelvin
            slopes = dict(zip(("slope_x0", "slope_y0", "slope_f"), sigma.tolist(), strict=True))
    return (
        slopes
        | covariance_numbers(every[0], stated.camera.distortion, common, forms)
        | {
            "sigma_data": root_diagonal(data)[:p],
            "condition_number": condition(total),
            "error_curve_arcsec": curve,
            "sigma_curve": sigma_curve.T,
        }
    )


def covariance_numbers(
    covariance: FloatArray, model: str, common: FloatArray, forms: FloatArray
) -> Numbers:
    """What couples in a covariance (q, q) of parameters and effects, and what it does to
    attitudes.
    """
    names = parameter_names(model)
    correlation, sigma = correlation_of(covariance[: len(names), : len(names)])
    conditional = sigma / root_diagonal(np.linalg.inv(correlation))
    weakest = weak_directions(correlation, names)[0]
    rotation = common @ covariance @ common.T
    turn = root_diagonal(rotation)
    return {
        "sigma": sigma,
        "sigma_conditional": conditional,
        "variance_inflation": (sigma / conditional) ** 2,
        "correlation": correlation,
        "weak_direction": weakest.weights,
        "weak_variance": weakest.variance,
        "weak_words": weakest.words,
        "attitude_correlation": (covariance @ common.T)[: len(names)] / np.outer(sigma, turn),
        "common_rotation_arcsec": ARCSEC * turn,
        "frame_error_arcsec": ARCSEC * np.sqrt(np.einsum("pq,apq->a", covariance, forms)),
    }


def condition(information: FloatArray) -> float:
    """Condition number of an information matrix scaled to a unit diagonal."""
    scale = 1.0 / root_diagonal(information)
    return float(np.linalg.cond(information * np.outer(scale, scale)))


def simpler_numbers(frame: FloatArray, n: int, weight: float, stated: Statements) -> Numbers:
    """What goes wrong when a simpler model is fitted, to first order in the coefficients that it
    lacks.

    The fit of the common parameters s to data with coefficients c of the others moves by ``F_ss^-1
    F_sc c``; what remains of the residuals after every attitude is the error of directions over the
    field.
    """
    camera = stated.camera
    names = list(camera.parameter_names)
    forms = stated.rest_forms[:, : len(names), : len(names)]
    found: Numbers = {
        "model_bias_arcsec": {},
        "model_bias_attitude_arcsec": {},
        "model_bias_sigma": {},
    }
    for model in simpler_models(camera.distortion):
        kept = np.array([name in parameter_names(model) for name in names])
        inner = frame[np.ix_(kept, kept)]
        inverse = inverses(inner[None])[0]
        # Where a prior alone determines a parameter, a fit without it has no answer.
        inverse = inverse if np.isfinite(inverse).all() else np.full(inner.shape, np.nan)
        shift: FloatArray = inverse @ frame[np.ix_(kept, ~kept)] @ camera.theta[~kept]
        error = np.zeros(len(names))
        error[kept], error[~kept] = shift, -camera.theta[~kept]
        # Two coordinates to a star.
        rms = np.sqrt(np.maximum(n * error @ frame @ error / (2.0 * weight), 0.0))
        sigmas = np.full(len(names), np.nan)
        sigmas[kept] = shift / np.sqrt(np.diag(inverse) / n)
        found["model_bias_arcsec"][model] = ARCSEC * rms / camera.focal_px
        found["model_bias_attitude_arcsec"][model] = ARCSEC * np.sqrt(
            np.maximum(np.einsum("p,apq,q->a", error, forms, error), 0.0)
        )
        found["model_bias_sigma"][model] = sigmas
    return found
