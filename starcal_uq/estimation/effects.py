"""Effects estimated: scales by restricted maximum likelihood, selected forward, and marginalised.

The restricted likelihood of the scales has attitudes, camera parameters and all coefficients
integrated out and the noise profiled (Patterson & Thompson 1971). An effect is taken up where it
gains more than chance gives the best of all candidates once in a hundred campaigns without any
(Self & Liang 1987: a variance on its bound). What the data say of the scales is then integrated
over a design of nodes around the best ones, as INLA does (Rue, Martino & Chopin 2009), so that the
posterior of the camera holds their uncertainty.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.attitude.rotations import (
    exp_rotation,
    quaternion_to_rotation,
    rotation_to_quaternion,
)
from starcal_uq.camera.projection import project
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.status import Status
from starcal_uq.core.types import FloatArray
from starcal_uq.estimation.local_effects import local_coefficients
from starcal_uq.estimation.stages import Stage
from starcal_uq.estimation.zenith import Images, candidates, found_air, pulled
from starcal_uq.likelihood.compressed import (
    Optimum,
    expanded,
    moved,
    optimum,
    unit_covariance,
)
from starcal_uq.likelihood.effect_sums import EffectLikelihood, EffectSums, Solved, pull_of
from starcal_uq.likelihood.effects import Effect, effects_of, zenith_effect
from starcal_uq.likelihood.fitted_effects import Effects, FittedEffect
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.shapes import seconds_utc
from starcal_uq.likelihood.zenith import Zeniths
from starcal_uq.maths.linear import scaled_cholesky

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

# False alarms of the whole selection on data without effects.
_ALPHA = 0.01
_MOST = 6
# Standard deviation of the half-normal prior of a scale, px at the corner.
PRIOR_PX = 10.0
# Range of the log of a scale in units of sigma; below it an effect is none.
_RANGE = (-7.0, 7.0)
# Half width of the differences that give the curvature in the logs of the scales.
_STEP = 0.1
_STARS_AT_ONCE = 2_000
# Rounds in which the noise beside air is found; moves of the zeniths beside other effects, and the
# gain, nat, that one has to bring.
_ROUNDS, _MOVES, _LEAST_GAIN = 3, 8, 0.02


class _Restricted:
    """Restricted likelihood of the scales of effects, linearised at an estimate."""

    def __init__(self, sums: EffectSums, p: int, dof: int, sigma: float) -> None:
        self.sums, self.p, self.dof = sums, p, dof - p
        # Logs of scales that are known, px, in units of the noise that is found about there.
        self.known = {e.name: -float(np.log(sigma)) for e in sums.effects if e.known}

    def at(self, logs: Mapping[str, float]) -> tuple[float, Solved, float]:
        """Minus the log likelihood where the logs of the scales in units of sigma are these, the
        normal equations, and the noise there.
        """
        solved = self.sums.solved(_squares(logs))
        gram, p = solved.gram, self.p
        rest = float(gram[p, p] - gram[:p, p] @ np.linalg.solve(gram[:p, :p], gram[:p, p]))
        value = self.dof * np.log(rest) + np.linalg.slogdet(gram[:p, :p])[1]
        return (
            float(0.5 * (value + solved.log_determinant)),
            solved,
            float(np.sqrt(rest / self.dof)),
        )

    def cost(self, logs: Mapping[str, float]) -> float:
        """Minus the log likelihood alone."""
        return self.at(logs)[0]

    def alone(self, logs: Mapping[str, float], name: str) -> tuple[float, float]:
        """Best log of one scale beside others as they are, and the cost there."""
        from scipy.optimize import minimize_scalar

        if name in self.known:
            return self.known[name], self.cost({**logs, name: self.known[name]})
        grid = np.linspace(*_RANGE, 8)
        costs = [self.cost({**logs, name: float(value)}) for value in grid]
        best = int(np.argmin(costs))
        low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
        found = minimize_scalar(
            lambda value: self.cost({**logs, name: float(value)}),
            bounds=(low, high),
            method="bounded",
            options={"xatol": 0.01},
        )
        return float(found.x), float(found.fun)

    def together(self, logs: Mapping[str, float]) -> dict[str, float]:
        """Best logs of all scales, from these."""
        from scipy.optimize import minimize

        logs = {name: self.known.get(name, value) for name, value in logs.items()}
        names = [name for name in logs if name not in self.known]
        if len(names) == 1:
            return logs | {names[0]: self.alone(_but(logs, names[0]), names[0])[0]}
        if not names:
            return logs
        found = minimize(
            lambda x: self.cost(logs | dict(zip(names, x.tolist(), strict=True))),
            np.array([logs[name] for name in names]),
            method="L-BFGS-B",
            bounds=[_RANGE] * len(names),
            options={"eps": 1e-3, "ftol": 1e-9},
        )
        return logs | dict(zip(names, found.x.tolist(), strict=True))


def _but(logs: Mapping[str, float], name: str) -> dict[str, float]:
    return {other: value for other, value in logs.items() if other != name}


def _squares(logs: Mapping[str, float]) -> dict[str, float]:
    """Squares of scales with these logs."""
    return {name: float(np.exp(2.0 * value)) for name, value in logs.items()}


def _of_run(effects: Sequence[Effect]) -> list[Effect]:
    return [effect for effect in effects if effect.grouping == "run"]


def penalty(candidates: int) -> float:
    """Gain of the restricted log likelihood that the best of so many candidates exceeds once in a
    hundred without any effect.
    """
    from scipy.special import chdtri

    return 0.5 * float(chdtri(1.0, 2.0 * _ALPHA / max(candidates, 1)))


@dataclass(frozen=True)
class _Step:
    """An effect that was taken up: its name, gain, and the parameters before and after."""

    name: str
    gain: float
    moved: FloatArray  # (p,): change of the parameters in their standard deviations


def _parameters(solved: Solved, p: int) -> tuple[FloatArray, FloatArray]:
    """Parameters (p,) and their unit covariance (p, p), in the sums' own scale."""
    gram = solved.gram
    inverse = np.linalg.inv(gram[:p, :p])
    return inverse @ gram[:p, p], np.asarray(inverse)


def _selected(
    restricted: _Restricted, candidates: Sequence[str]
) -> tuple[dict[str, float], list[_Step], list[tuple[str, float]]]:
    """Logs of the scales of the effects that the data ask for, how they were taken up, and what the
    others would gain.
    """
    logs: dict[str, float] = {}
    steps: list[_Step] = []
    least = penalty(len(candidates))
    now, solved, sigma = restricted.at(logs)
    while True:
        tried = {n: restricted.alone(logs, n) for n in candidates if n not in logs}
        gains = sorted(((now - cost, name) for name, (_, cost) in tried.items()), reverse=True)
        if not gains or gains[0][0] < least or len(steps) == _MOST:
            return logs, steps, [(name, gain) for gain, name in gains]
        gain, name = gains[0]
        if name == "frame" and "zenith" in tried:
            # Air is there wherever a camera may stand on the ground: what it explains about as well
            # is no breathing.
            air = now - tried["zenith"][1]
            gain, name = (air, "zenith") if air > max(least, gain - least) else (gain, name)
        before = _parameters(solved, restricted.p)
        logs = restricted.together({**logs, name: tried[name][0]})
        logs = {n: v for n, v in logs.items() if n == name or v > _RANGE[0] + 0.1}
        steps = [step for step in steps if step.name in logs]
        now, solved, sigma = restricted.at(logs)
        after = _parameters(solved, restricted.p)
        steps.append(
            _Step(name, gain, (after[0] - before[0]) / (sigma * np.sqrt(np.diag(after[1]))))
        )


@dataclass(frozen=True, eq=False)
class _Nodes:
    """Scales at which what the data say of them is summed up, the best ones first."""

    logs: list[dict[str, float]]
    log_weights: FloatArray  # (J,): of the rule, and the prior there
    log_posterior: FloatArray  # (J,): with the restricted likelihood
    sd: dict[str, float]  # Standard deviation of the log of every scale that is not known


def _nodes(restricted: _Restricted, logs: Mapping[str, float], sigma: float) -> _Nodes:
    """A centre and points on a sphere in the principal axes, whose weights reproduce the moments of
    a Gaussian; each counts as the posterior is there.
    """
    names = [name for name in logs if name not in restricted.known]
    d, centre = len(names), np.array([logs[name] for name in names])
    if not names:
        return _Nodes([dict(logs)], np.zeros(1), np.zeros(1), {})

    def named(x: FloatArray) -> dict[str, float]:
        return dict(logs) | dict(zip(names, x.tolist(), strict=True))

    def prior(x: FloatArray) -> float:
        # Of the log of the scale.
        return float(np.sum(-0.5 * (np.exp(x) * sigma / PRIOR_PX) ** 2 + x))

    spread = _spread(lambda x: prior(x) - restricted.cost(named(x)), centre)
    square = max(3.0 / d, 1.3)
    axial = np.concatenate([np.eye(d), -np.eye(d)]) * np.sqrt(square * d)
    corners = np.array(list(product((-1.0, 1.0), repeat=d))) * np.sqrt(square)
    corners = corners[np.prod(corners, axis=1) > 0.0] if d > 4 else corners[: 0 if d == 1 else None]
    points = np.concatenate([np.zeros((1, d)), axial, corners])
    rule = np.full(len(points), -np.log(square * (len(points) - 1)) + 0.5 * square * d)
    rule[0] = np.log(1.0 - 1.0 / square)
    at = [np.clip(centre + spread @ point, *_RANGE) for point in points]
    weights = rule + np.array([prior(x) for x in at])
    costs = np.array([restricted.cost(named(x)) for x in at])
    sd = dict(zip(names, np.sqrt(np.sum(spread**2, axis=1)).tolist(), strict=True))
    return _Nodes([named(x) for x in at], weights, weights - costs, sd)


def _spread(density: Callable[[FloatArray], float], centre: FloatArray) -> FloatArray:
    """Square root (d, d) of the covariance of a density with this mode, by differences."""
    d, unit = len(centre), _STEP * np.eye(len(centre))
    here = density(centre)
    hessian = np.zeros((d, d))
    for i in range(d):
        for j in range(i, d):
            signs = ((1, 1, 1.0), (1, -1, -1.0), (-1, 1, -1.0), (-1, -1, 1.0))
            if i == j:
                own = density(centre + unit[i]) + density(centre - unit[i]) - 2.0 * here
                hessian[i, i] = own / _STEP**2
                continue
            crossed = sum(s * density(centre + a * unit[i] + b * unit[j]) for a, b, s in signs)
            hessian[i, j] = hessian[j, i] = crossed / (4.0 * _STEP**2)
    values, vectors = np.linalg.eigh(-hessian)
    # Where the data say little of a scale, its log is known to a factor of three.
    return np.asarray(vectors / np.sqrt(np.maximum(values, 0.8)))


def with_effects(obs: Observations, cal: Calibration, wanted: Sequence[str] = ()) -> Calibration:
    """The calibration with effects estimated and marginalised.

    Parameters
    ----------
    obs, cal
        The table, with the weights of the calibration, and the estimate by its marginal likelihood.
    wanted : sequence of str
        The effects; those that the data ask for where it is empty.

    Raises
    ------
    CalibrationError
        For an effect that is unknown, or that the table does not allow.
    """
    began = perf_counter()
    likelihood = MarginalLikelihood(obs, cal.camera.distortion, axes=True)
    rotations = quaternion_to_rotation(cal.quaternions)
    model = _Linearised(obs, cal, likelihood, rotations)
    zeniths = model.zeniths() if not wanted or "zenith" in wanted else None
    known = effects_of(obs, cal.camera, zeniths=zeniths)
    names = tuple(wanted) or tuple(known)
    for name in names:
        if name not in known:
            raise CalibrationError(_impossible(name, known))
    restricted = model.restricted([known[name] for name in names])
    refused: list[tuple[str, float]] = []
    if not wanted:
        logs, steps, refused = _selected(restricted, names)
    else:
        logs, steps = _forced(restricted, names)
    least = penalty(len(names))
    if not logs:
        return replace(
            cal,
            effects=Effects((), True, tuple(refused), least),
            provenance=cal.provenance.with_settings(effects=[]),
        )
    if zeniths is not None and "zenith" in logs:
        zeniths, restricted, logs = model.settled(zeniths, restricted, logs)
        known = effects_of(obs, cal.camera, zeniths=zeniths)
    scale = cal.sigmas
    _, solved, sigma = restricted.at(logs)
    nodes = _nodes(restricted, logs, sigma)
    ahead, unit = _parameters(solved, len(scale))
    start = cal.theta + scale * ahead, unit * np.outer(scale, scale) * sigma**2, sigma
    likelihood.use_rotations(rotations)
    found, grams, joint = _expanded(likelihood, start, [known[name] for name in logs], nodes)
    sigma, theta = found.sigma, found.theta
    covariance, weights = _mixed(found, grams, nodes)
    theta = theta - 0.5 * found.compressed.whitening @ found.compressed.log_determinant_slope
    effects = [known[name] for name in logs]
    ratio = {
        name: sigma**-2.0 if name in restricted.known else float(np.exp(2.0 * value))
        for name, value in logs.items()
    }
    exact = EffectLikelihood(
        likelihood.frames, likelihood.model_name, effects, ratio, theta, rotations, sigma
    )
    state, _ = exact.profile(theta, exact.rotations)
    rest, coefficients = exact.conditioned(state, state.e[None])
    coefficients = replace(coefficients, run=coefficients.run + exact.mean[:, None])
    turned = exact.attitude_response(state, state.e[None]) - exact.turns(state, coefficients)
    fitted = []
    for step in steps:
        sd = nodes.sd.get(step.name, 0.0)
        best = float(np.exp(logs[step.name]) * sigma) if sd else 1.0
        own = exact.shifts(state, exact.of_effect(step.name, coefficients))
        shift = likelihood.frames.in_pixels(own[0])
        worst = int(np.argmax(np.abs(step.moved)))
        factor = float(np.exp(1.96 * sd))
        fitted.append(
            FittedEffect(
                step.name,
                best,
                best / factor,
                best * factor,
                float(np.sqrt(np.mean(shift**2))),
                step.gain,
                float(abs(step.moved[worst])),
                cal.parameter_names[worst],
            )
        )
    effects_found = Effects(
        tuple(fitted),
        not wanted,
        tuple(refused),
        least,
        *joint,
        node_grams=grams,
        node_log_weights=weights,
        temperature_c=_moments(obs.temperature_c),
        time_s=_range(obs),
        places=tuple((e.name, len(e.prior)) for e in _of_run(effects)),
    )
    effects_found = local_coefficients(
        effects_found, exact, state, coefficients, theta, covariance, sigma
    )
    if zeniths is not None and "zenith" in logs:
        air = found_air(effects_found, zeniths, state.rotations)
        effects_found = replace(effects_found, zeniths=zeniths, air=air)
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
        quaternions=rotation_to_quaternion(exp_rotation(turned[0].T) @ state.rotations),
        residuals_px=likelihood.frames.in_pixels(rest[0]).T,
        chi2=found.sum_of_squares,
        information=found.information,
        attitude_noise=np.mean(state.inverse, axis=2) * sigma**2,
        compressed=found.compressed,
        provenance=cal.provenance.with_settings(effects=list(logs)),
        effects=effects_found,
    )


def _impossible(name: str, known: Mapping[str, Effect]) -> str:
    """Why a table does not allow an effect, and which it allows."""
    lacking = "needs what does not vary in this table"
    if name == "zenith":
        lacking = (
            "needs directions in which refraction may be missing, and stars that were above one "
            "horizon"
        )
    return f"the effect {name!r} {lacking}: use some of {', '.join(known)}."


class _Linearised:
    """A table around an estimate."""

    def __init__(
        self,
        obs: Observations,
        cal: Calibration,
        likelihood: MarginalLikelihood,
        rotations: FloatArray,
    ) -> None:
        self._obs, self._cal = obs, cal
        self._likelihood, self._rotations = likelihood, rotations

    def restricted(self, effects: Sequence[Effect], sigma: float | None = None) -> _Restricted:
        """Restricted likelihood of the scales of effects; `sigma` is about the noise beside those
        whose scale is known.
        """
        cal, likelihood = self._cal, self._likelihood
        sums, scale = EffectSums(effects, cal.theta, cal.sigma, apart=False), cal.sigmas
        for part, state, rows in likelihood.pieces(cal.theta, self._rotations, _STARS_AT_ONCE):
            h = part.derivatives(cal.theta, state) * scale[:, None, None]
            columns = part.project_out(state, np.concatenate([h, state.e[None]]))
            sums.add(part, state, columns, rows)
        p, dof = len(cal.theta), likelihood.dof
        found = _Restricted(sums, p, dof, cal.sigma if sigma is None else sigma)
        for _ in range(0 if sigma or not found.known else _ROUNDS):
            found = _Restricted(sums, p, dof, found.at(found.known)[2])
        return found

    def zeniths(self) -> Zeniths | None:
        """The zeniths, of a place or of each frame, that have the greater restricted likelihood."""
        found = candidates(self._obs, self._cal, self._rotations)
        return min(found, key=self._alone, default=None)

    def _alone(self, zeniths: Zeniths) -> float:
        restricted = self.restricted([zenith_effect(self._obs, zeniths)])
        return restricted.cost(restricted.known)

    def settled(
        self, zeniths: Zeniths, restricted: _Restricted, logs: dict[str, float]
    ) -> tuple[Zeniths, _Restricted, dict[str, float]]:
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
        images = Images(self._obs, self._cal, self._rotations)
        for _ in range(_ROUNDS):
            zeniths = pulled(images, zeniths, sigma)
            restricted = self._beside(zeniths, logs, sigma)
            zeniths, restricted, logs = self._moved(zeniths, restricted, logs)
        return zeniths, restricted, logs

    def _moved(
        self, zeniths: Zeniths, restricted: _Restricted, logs: dict[str, float]
    ) -> tuple[Zeniths, _Restricted, dict[str, float]]:
        """The zeniths that the coefficients point to, and the scales there."""
        _, solved, sigma = restricted.at(logs)
        ahead, unit = _parameters(solved, restricted.p)
        found = restricted.sums.coefficients(_squares(logs))
        pull = sigma**2 * pull_of(_of_run(restricted.sums.effects))
        ahead = ahead - unit @ (pull @ found[:, :-1])
        own = found[:, -1] - found[:, :-1] @ ahead + solved.run_covariance @ pull
        place = restricted.sums.places["zenith"]
        zeniths = zeniths.moved(own[place], self._rotations[:, 2])
        beside = self._beside(zeniths, logs, sigma)
        return zeniths, beside, beside.together(logs)

    def _beside(self, zeniths: Zeniths, logs: Mapping[str, float], sigma: float) -> _Restricted:
        known = effects_of(self._obs, self._cal.camera, zeniths=zeniths)
        return self.restricted([known[name] for name in logs], sigma)


def without_effects(obs: Observations, cal: Calibration) -> Observations:
    """The stars where the camera of a calibration with effects alone would show them."""
    turned = quaternion_to_rotation(cal.quaternions)[np.searchsorted(obs.frame_ids, obs.frame)]
    b = np.einsum("nij,nj->ni", turned, obs.directions_icrs)
    xy = project(cal.camera, b) + cal.residuals_px
    return replace(obs, x_px=xy[:, 0], y_px=xy[:, 1])


def _moments(values: FloatArray | None) -> tuple[float, float]:
    if values is None:
        return np.nan, np.nan
    return float(np.nanmean(values)), float(np.nanstd(values))


def _range(obs: Observations) -> tuple[float, float]:
    seconds = None if obs.time_utc is None else seconds_utc(obs.time_utc)
    return (np.nan, np.nan) if seconds is None else (float(seconds.min()), float(seconds.max()))


def _forced(restricted: _Restricted, names: Sequence[str]) -> tuple[dict[str, float], list[_Step]]:
    """Logs of the scales of effects that were asked for, and what each gains beside the others."""
    logs: dict[str, float] = {}
    for name in names:
        logs[name] = restricted.alone(logs, name)[0]
    logs = restricted.together(logs)
    cost, solved, sigma = restricted.at(logs)
    best, unit = _parameters(solved, restricted.p)
    steps = []
    for name in names:
        without = restricted.at(_but(logs, name))
        moved_by = best - _parameters(without[1], restricted.p)[0]
        steps.append(_Step(name, without[0] - cost, moved_by / (sigma * np.sqrt(np.diag(unit)))))
    return logs, steps


_Joint = tuple[FloatArray, FloatArray, FloatArray]


def _expanded(
    likelihood: MarginalLikelihood,
    start: tuple[FloatArray, FloatArray, float],
    effects: Sequence[Effect],
    nodes: _Nodes,
) -> tuple[Optimum, FloatArray, _Joint]:
    """The compressed likelihood at the best scales around its optimum, Gram matrices of the nodes
    there, and coefficients of the run with their covariance and that of the parameters with them.

    `start`: estimate (p,), covariance (p, p) and noise by the linearised likelihood.
    """
    theta, covariance, sigma = start
    sums, whitening = EffectSums(effects, theta, sigma, 0, apart=False), scaled_cholesky(covariance)
    plain = expanded(likelihood, theta, whitening, likelihood.sums(theta), sums.add)
    solved = [sums.solved(_squares(logs)) for logs in nodes.logs]
    made = [
        replace(replace(plain, gram=own.gram).likelihood(theta, whitening), dof=likelihood.dof)
        for own in solved
    ]
    found = optimum(made[0])
    theta, covariance, sigma = found.theta, found.covariance, found.sigma
    here, p = found.compressed, len(theta)
    grams = np.stack([moved(own, here.theta_hat, here.whitening).gram for own in made])
    # Coefficients follow the whitened parameters of the last expansion.
    run = sums.coefficients(_squares(nodes.logs[0]))
    follow = np.linalg.solve(whitening.T, run[:, 1 : p + 1].T).T
    own, pull = found.sigma**2 * solved[0].run_covariance, pull_of(_of_run(effects))
    slope = here.log_determinant_slope - 2.0 * (pull @ follow) @ here.whitening
    found = replace(found, compressed=replace(here, log_determinant_slope=slope))
    moved_by = theta - start[0] + covariance @ (pull @ follow)
    joint = (
        run[:, 0] + follow @ moved_by + own @ pull,
        own + follow @ covariance @ follow.T,
        covariance @ follow.T,
    )
    determinants = np.array([own.log_determinant for own in solved])
    nodes.log_weights[:] = nodes.log_weights - 0.5 * (determinants - determinants[0])
    return found, grams, joint


def _mixed(found: Optimum, grams: FloatArray, nodes: _Nodes) -> tuple[FloatArray, FloatArray]:
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
