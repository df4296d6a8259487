"""Effects estimated: scales by restricted likelihood, selected forward, and marginalised.

Selection, scales and nodes (`scales`) need sums over all stars alone, which `Stars` give: of a table
in memory, or, as `partitioned_effects.FileStars`, of partitions, file by file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.attitude.rotations import (
    exp_rotation,
    rotation_to_quaternion,
)
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.projection import project
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.findings import clause
from starcal_uq.core.settings import WEIGHING
from starcal_uq.core.status import Status
from starcal_uq.core.types import FloatArray
from starcal_uq.estimation.local_effects import local_coefficients
from starcal_uq.estimation.scales import (
    Nodes,
    Restricted,
    forced,
    nodes_around,
    parameters_at,
    penalty,
    selected,
    squares,
)
from starcal_uq.estimation.stages import Stage
from starcal_uq.estimation.zenith import Images, candidates, found_air, pulled
from starcal_uq.likelihood.compressed import (
    GramSums,
    Optimum,
    expanded,
    moved,
    optimum,
    unit_covariance,
)
from starcal_uq.likelihood.effect_likelihood import EffectLikelihood
from starcal_uq.likelihood.effect_sums import Cross, EffectSums, Products, pull_of, stars_of
from starcal_uq.likelihood.effects import Effect, effects_of
from starcal_uq.likelihood.fitted_effects import Effects, FittedEffect
from starcal_uq.likelihood.marginal import MarginalLikelihood, Profile
from starcal_uq.likelihood.shapes import Extent
from starcal_uq.likelihood.zenith import Zeniths
from starcal_uq.maths.linear import scaled_cholesky
from starcal_uq.observations.frames import StarFrames
from starcal_uq.observations.splits import frame_sample

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

_STARS_AT_ONCE = 6_000
# Frames of a sample that the zenith of all is looked for in.
_FRAMES_OF_ZENITH = 100
# Rounds in which the noise beside air is found; moves of the zeniths beside other effects, and the
# gain, nat, that one has to bring.
_ROUNDS, _MOVES, _LEAST_GAIN = 3, 8, 0.02
# What a table does not allow.
Refused = Enum("Refused", "EFFECT")


@dataclass(frozen=True)
class Around:
    """An estimate that sums are taken around: camera, parameters (p,) and their units, and noise;
    and where the likelihood is expanded around it, the whitening (p, p).
    """

    camera: Camera
    theta: FloatArray
    scale: FloatArray
    sigma: float
    whitening: FloatArray | None = None

    @classmethod
    def of(cls, cal: Calibration) -> Around:
        """That of a calibration."""
        return cls(cal.camera, cal.theta, cal.sigmas, cal.sigma)


class Stars:
    """Sums over the stars of a table around an estimate, with the effects that these names have
    below zeniths; `extent` is that of all frames, where the table is a part or a sample of them.
    """

    def __init__(
        self,
        obs: Observations,
        around: Around,
        rotations: FloatArray | None = None,
        extent: Extent | None = None,
    ) -> None:
        self.obs, self.around, self.extent = obs, around, extent
        self.likelihood = MarginalLikelihood(obs, around.camera.distortion, rotations)
        self.dof = self.likelihood.dof
        self._known: tuple[Zeniths | None, dict[str, Effect]] | None = None

    def effects(self, zeniths: Zeniths | None) -> dict[str, Effect]:
        """Every effect that the table allows, by name."""
        if self._known is None or self._known[0] is not zeniths:
            camera, extent = self.around.camera, self.extent
            found = effects_of(self.obs, camera, zeniths=zeniths, extent=extent)
            self._known = zeniths, found
        return self._known[1]

    def sums(
        self,
        names: Sequence[str],
        zeniths: Zeniths | None,
        at: Around,
        *products: Products,
    ) -> EffectSums:
        """Sums around a point, of these products so far; residuals are the first column of an
        expansion, else the last.
        """
        known, place = self.effects(zeniths), -1 if at.whitening is None else 0
        sums = EffectSums([known[n] for n in names], at.theta, at.sigma, place, apart=False)
        sums.parts.extend(products)
        return sums

    def made(
        self, names: Sequence[str], zeniths: Zeniths | None, at: Around
    ) -> tuple[GramSums | None, EffectSums]:
        """Sums with the parameters, in their units, and the residuals; with a whitening, the columns
        of the compressed likelihood, whose own sums come as well.
        """
        sums, likelihood = self.sums(names, zeniths, at), self.likelihood
        if at.whitening is not None:
            known = likelihood.sums(at.theta)
            return expanded(likelihood, at.theta, at.whitening, known, sums.add), sums
        for piece in likelihood.linearised(at.theta, at.scale, None, _STARS_AT_ONCE):
            sums.add(*piece)
        return None, sums


def _whole(exact: EffectLikelihood, found: Cross) -> Cross:
    return replace(found, run=found.run + exact.mean[:, None])


def _of_run(effects: Sequence[Effect]) -> list[Effect]:
    return [effect for effect in effects if effect.grouping == "run"]


def with_effects(
    obs: Observations, cal: Calibration, wanted: Sequence[str] = ("auto",)
) -> Calibration:
    """The calibration with effects estimated and marginalised.

    Parameters
    ----------
    obs, cal
        The table, with the weights of the calibration, and the estimate by its marginal likelihood.
    wanted : sequence of str
        The effects; with ``auto`` also those that the data support beside them.

    Raises
    ------
    CalibrationError
        For an effect that is unknown, or that the table does not allow.
    """
    rotations = cal.rotations
    return with_effects_of(Stars(obs, Around.of(cal), rotations), cal, wanted)


def with_effects_of(stars: Stars, cal: Calibration, wanted: Sequence[str]) -> Calibration:
    """As `with_effects`, of all stars; the calibration has attitudes and residuals of `stars.obs`."""
    began = perf_counter()
    model = _Linearised(stars, cal)
    selecting, asked = "auto" in wanted, tuple(name for name in wanted if name != "auto")
    zeniths = model.zeniths() if selecting or "zenith" in asked else None
    known = stars.effects(zeniths)
    names = tuple(known) if selecting else asked
    for name in asked:
        if name not in known:
            raise CalibrationError(clause(Refused.EFFECT, name=name, known=[*known]))
    restricted = model.restricted(names, zeniths)
    refused: list[tuple[str, float]] = []
    logs, steps = forced(restricted, asked)
    # Noise and tails are candidates as well, of `calibrate`.
    least = penalty(len(names) - len(asked) + len(WEIGHING))
    if selecting:
        logs, steps, refused = selected(restricted, names, logs, steps, least)
    if not logs:
        return replace(
            cal,
            effects=Effects((), selecting, tuple(refused), least),
            provenance=cal.provenance.with_settings(effects=[]),
        )
    if zeniths is not None and "zenith" in logs:
        zeniths, restricted, logs = model.settled(zeniths, restricted, logs)
    effects = [stars.effects(zeniths)[name] for name in logs]
    scale = cal.sigmas
    _, solved, sigma = restricted.at(logs)
    nodes = nodes_around(restricted, logs, sigma)
    ahead, unit = parameters_at(solved, len(scale))
    whitening = scaled_cholesky(unit * np.outer(scale, scale) * sigma**2)
    ahead = cal.theta + scale * ahead
    start = replace(stars.around, theta=ahead, sigma=sigma, whitening=whitening)
    found, grams, joint = _expanded(stars, start, effects, zeniths, nodes)
    sigma, theta = found.sigma, found.theta
    covariance, weights = _mixed(found, grams, nodes)
    theta = theta - 0.5 * found.compressed.whitening @ found.compressed.log_determinant_slope
    obs, extent, of_stars = stars.obs, stars.extent, stars_of(effects)
    seen = Extent.of(obs) if extent is None else extent
    held = Effects(
        (),
        selecting,
        tuple(refused),
        least,
        *joint,
        node_grams=grams,
        node_log_weights=weights,
        temperature_c=seen.warmth,
        time_s=seen.time_s,
        places=tuple((e.name, len(e.prior)) for e in _of_run(effects)),
        zeniths=zeniths if "zenith" in logs else None,
        extent=extent,
        asked=asked,
        stated_px=0.0 if of_stars is None else float(np.sqrt(np.mean(of_stars.stated2))),
    )
    ratio = {
        name: sigma**-2.0 if name in restricted.known else float(np.exp(2.0 * value))
        for name, value in logs.items()
    }
    exact = EffectLikelihood(
        MarginalLikelihood(obs, cal.camera.distortion).frames,
        cal.camera.distortion,
        effects,
        ratio,
        theta,
        cal.rotations,
        sigma,
        None if extent is None else held.coefficients,
    )
    rest = Rest.of(exact, theta)
    fitted = []
    for step in steps:
        sd = nodes.sd.get(step.name, 0.0)
        best = float(np.exp(logs[step.name]) * sigma) if sd else 1.0
        factor = float(np.exp(1.96 * sd))
        worst = int(np.argmax(np.abs(step.moved)))
        fitted.append(
            FittedEffect(
                step.name,
                best,
                best / factor,
                best * factor,
                rest.size(step.name),
                step.gain,
                float(abs(step.moved[worst])),
                cal.parameter_names[worst],
            )
        )
    held = replace(held, fitted=tuple(fitted))
    own = rest.state, rest.coefficients
    held = local_coefficients(held, exact, *own, covariance, sigma)
    if held.zeniths is not None:
        place = held.at("zenith")
        air = held.coefficients[place], held.covariance[place, place]
        held = replace(held, air=found_air(held.zeniths, *air, rest.state.rotations[:, 2]))
    stage = Stage(
        "effects",
        np.array([cal.theta, theta]),
        np.array([cal.chi2, found.sum_of_squares]),
        Status.CONVERGED,
        len(steps),
        perf_counter() - began,
    )
    factors = cal.width_factors
    return cal.moved(
        theta,
        sigma,
        cal.dof,
        cal.status,
        sigma_std=sigma / float(np.sqrt(2.0 * found.dof)),
        covariance=covariance * np.outer(factors, factors),
        stages=(*cal.stages, stage),
        quaternions=rotation_to_quaternion(rest.rotations),
        residuals_px=rest.residuals_px,
        chi2=found.sum_of_squares,
        information=found.information,
        attitude_noise=np.mean(rest.state.inverse, axis=2) * sigma**2,
        compressed=found.compressed,
        provenance=cal.provenance.with_settings(effects=list(logs)),
        effects=held,
    )


@dataclass(frozen=True, eq=False)
class Rest:
    """Images at an estimate beside its effects: attitudes of the camera, residuals, coefficients."""

    exact: EffectLikelihood
    state: Profile
    found: Cross  # Coefficients less those that are expected
    rotations: FloatArray  # (K, 3, 3)
    residuals_px: FloatArray  # (N, 2)

    @classmethod
    def of(cls, exact: EffectLikelihood, theta: FloatArray) -> Rest:
        """Those at theta (p,)."""
        state, _ = exact.profile(theta, exact.rotations)
        rest, found = exact.conditioned(state, state.e[None])
        by_effects = exact.turns(state, _whole(exact, found))
        turned = exact.attitude_response(state, state.e[None]) - by_effects
        rotations = exp_rotation(turned[0].T) @ state.rotations
        return cls(exact, state, found, rotations, exact.frames.in_pixels(rest[0]).T)

    @property
    def coefficients(self) -> Cross:
        """Best coefficients."""
        return _whole(self.exact, self.found)

    def size(self, name: str) -> float:
        """Root mean square, px, of the shifts by an effect."""
        own = self.exact.shifts(self.state, self.exact.of_effect(name, self.coefficients))
        return float(np.sqrt(np.mean(self.exact.frames.in_pixels(own[0]) ** 2)))


class _Linearised:
    """Stars around an estimate."""

    def __init__(self, stars: Stars, cal: Calibration) -> None:
        self._stars, self._cal = stars, cal
        self._rotations = cal.rotations

    def restricted(
        self, names: Sequence[str], zeniths: Zeniths | None, sigma: float | None = None
    ) -> Restricted:
        """Restricted likelihood of the scales of effects; `sigma` is about the noise beside those
        whose scale is known.
        """
        stars, p = self._stars, len(self._cal.theta)
        sums, dof = stars.made(names, zeniths, stars.around)[1], stars.dof
        found = Restricted(sums, p, dof, self._cal.sigma if sigma is None else sigma)
        for _ in range(0 if sigma or not found.known else _ROUNDS):
            found = Restricted(sums, p, dof, found.at(found.known)[2])
        return found

    def zeniths(self) -> Zeniths | None:
        """The zeniths, of a place or of each frame, that have the greater restricted likelihood."""
        obs, rotations, whole = self._stars.obs, self._rotations, self._stars.extent is None
        if not whole:
            # A start; all stars move it.
            obs, places = frame_sample(obs, _FRAMES_OF_ZENITH)
            rotations = rotations[places]
        found = candidates(obs, self._cal, rotations)
        if not whole:
            found = [each.seen_in(self._stars.obs) for each in found if not each.apiece]
        return min(found, key=self._alone) if len(found) > 1 else next(iter(found), None)

    def _alone(self, zeniths: Zeniths) -> float:
        restricted = self.restricted(["zenith"], zeniths)
        return restricted.cost(restricted.known)

    def settled(
        self, zeniths: Zeniths, restricted: Restricted, logs: dict[str, float]
    ) -> tuple[Zeniths, Restricted, dict[str, float]]:
        """The zeniths that are the best beside the other effects, and all scales there."""
        cost, _, sigma = restricted.at(logs)
        for _ in range(_MOVES):
            trial = self._moved(zeniths, restricted, logs)
            now = trial[1].cost(trial[2])
            if now > cost - _LEAST_GAIN:
                break
            (zeniths, restricted, logs), cost = trial, now
        if not zeniths.apiece:
            return zeniths, restricted, logs
        images = Images(self._stars.obs, self._cal, self._rotations)
        for _ in range(_ROUNDS):
            zeniths = pulled(images, zeniths, sigma)
            restricted = self._beside(zeniths, logs, sigma)
            zeniths, restricted, logs = self._moved(zeniths, restricted, logs)
        return zeniths, restricted, logs

    def _moved(
        self, zeniths: Zeniths, restricted: Restricted, logs: dict[str, float]
    ) -> tuple[Zeniths, Restricted, dict[str, float]]:
        """The zeniths that the coefficients point to, and the scales there."""
        _, solved, sigma = restricted.at(logs)
        ahead, unit = parameters_at(solved, restricted.p)
        found = restricted.sums.coefficients(squares(logs))
        pull = sigma**2 * pull_of(_of_run(restricted.sums.effects))
        ahead = ahead - unit @ (pull @ found[:, :-1])
        own = found[:, -1] - found[:, :-1] @ ahead + solved.run_covariance @ pull
        place = restricted.sums.places["zenith"]
        zeniths = zeniths.moved(own[place], self._rotations[:, 2])
        beside = self._beside(zeniths, logs, sigma)
        return zeniths, beside, beside.together(logs)

    def _beside(self, zeniths: Zeniths, logs: Mapping[str, float], sigma: float) -> Restricted:
        return self.restricted(tuple(logs), zeniths, sigma)


def beside_effects(
    obs: Observations,
    cal: Calibration,
    rotations: FloatArray,
    whole: Observations | None = None,
) -> EffectLikelihood:
    """Exact likelihood with the effects of a calibration, for frames of the table `whole` at these
    attitudes (K, 3, 3); by default `obs` is all of it.

    Frames that are not all of the table lack effects of nights.
    """
    held, camera = cal.known_effects, cal.camera
    if whole is None or obs.n_frames == whole.n_frames:
        found = held.of(obs, camera)
    else:
        known = effects_of(whole, camera, seen=obs, zeniths=held.zeniths, extent=held.extent)
        found = [known[name] for name in held.ratio(1.0) if name in known]
    ratio = {effect.name: held.ratio(cal.sigma)[effect.name] for effect in found}
    at = (found, ratio, cal.theta, rotations, cal.sigma)
    return EffectLikelihood(StarFrames.from_observations(obs), camera.distortion, *at)


def without_effects(obs: Observations, cal: Calibration) -> Observations:
    """The stars where the camera of a calibration with effects alone would show them."""
    return shown_by(obs, cal.camera, cal.rotations, cal.residuals_px)


def shown_by(
    obs: Observations, camera: Camera, rotations: FloatArray, residuals_px: FloatArray
) -> Observations:
    """The stars where a camera at these attitudes (K, 3, 3) shows them, with residuals (N, 2)."""
    turned = rotations[np.searchsorted(obs.frame_ids, obs.frame)]
    b = np.einsum("nij,nj->ni", turned, obs.directions_icrs)
    xy = project(camera, b) + residuals_px
    return replace(obs, x_px=xy[:, 0], y_px=xy[:, 1])


_Joint = tuple[FloatArray, FloatArray, FloatArray]


def _expanded(
    stars: Stars,
    start: Around,
    effects: Sequence[Effect],
    zeniths: Zeniths | None,
    nodes: Nodes,
) -> tuple[Optimum, FloatArray, _Joint]:
    """The compressed likelihood at the best scales around its optimum, Gram matrices of the nodes
    there, and coefficients of the run with their covariance and that of the parameters with them.

    `start`: the estimate by the linearised likelihood.
    """
    plain, sums = stars.made([effect.name for effect in effects], zeniths, start)
    theta, whitening = start.theta, start.whitening
    assert plain is not None and whitening is not None, "a start is expanded around"
    solved = [sums.solved(squares(logs)) for logs in nodes.logs]
    made = [
        replace(replace(plain, gram=own.gram).likelihood(theta, whitening), dof=stars.dof)
        for own in solved
    ]
    found = optimum(made[0])
    theta, covariance = found.theta, found.covariance
    here, p = found.compressed, len(theta)
    grams = np.stack([moved(own, here.theta_hat, here.whitening).gram for own in made])
    # Coefficients follow the whitened parameters of the last expansion.
    run = sums.coefficients(squares(nodes.logs[0]))
    follow = np.linalg.solve(whitening.T, run[:, 1 : p + 1].T).T
    own, pull = found.sigma**2 * solved[0].run_covariance, pull_of(_of_run(effects))
    slope = here.log_determinant_slope - 2.0 * (pull @ follow) @ here.whitening
    found = replace(found, compressed=replace(here, log_determinant_slope=slope))
    moved_by = theta - start.theta + covariance @ (pull @ follow)
    joint = (
        run[:, 0] + follow @ moved_by + own @ pull,
        own + follow @ covariance @ follow.T,
        covariance @ follow.T,
    )
    determinants = np.array([own.log_determinant for own in solved])
    nodes.log_weights[:] = nodes.log_weights - 0.5 * (determinants - determinants[0])
    return found, grams, joint


def _mixed(found: Optimum, grams: FloatArray, nodes: Nodes) -> tuple[FloatArray, FloatArray]:
    """Covariance (p, p) of the parameters with the scales integrated, and log weights (J,) of the
    nodes in the mixture of their likelihoods.
    """
    from scipy.special import softmax

    here, p = found.compressed, len(found.theta)
    total = np.zeros((p, p))
    for gram, weight in zip(grams, softmax(nodes.log_posterior), strict=True):
        own = replace(here, gram=gram)
        step = np.linalg.solve(gram[1 : p + 1, 1 : p + 1], -gram[0, 1 : p + 1])
        rest = gram[0, 0] + gram[0, 1 : p + 1] @ step
        shift = here.whitening @ step
        total += weight * (unit_covariance(own) * rest / found.dof + np.outer(shift, shift))
    return total, nodes.log_weights - nodes.log_weights[0]
