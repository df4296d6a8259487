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
from starcal_uq.estimation.stages import Stage
from starcal_uq.likelihood.compressed import (
    Optimum,
    expanded,
    moved,
    optimum,
    unit_covariance,
)
from starcal_uq.likelihood.effects import Effect, EffectLikelihood, EffectSums, Solved, effects_of
from starcal_uq.likelihood.fitted_effects import Effects, FittedEffect
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.shapes import seconds_utc
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
_STARS_AT_ONCE = 10_000


class _Restricted:
    """Restricted likelihood of the scales of effects, linearised at an estimate."""

    def __init__(self, sums: EffectSums, p: int, dof: int) -> None:
        self._sums, self.p, self.dof = sums, p, dof - p
        self.names = tuple(effect.name for effect in sums.effects)

    def at(self, logs: Mapping[str, float]) -> tuple[float, Solved, float]:
        """Minus the log likelihood where the logs of the scales in units of sigma are these, the
        normal equations, and the noise there.
        """
        solved = self._sums.solved({name: float(np.exp(2.0 * v)) for name, v in logs.items()})
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

        names = list(logs)
        if len(names) == 1:
            return {names[0]: self.alone({}, names[0])[0]}
        found = minimize(
            lambda x: self.cost(dict(zip(names, x.tolist(), strict=True))),
            np.array([logs[name] for name in names]),
            method="L-BFGS-B",
            bounds=[_RANGE] * len(names),
            options={"eps": 1e-3, "ftol": 1e-9},
        )
        return dict(zip(names, found.x.tolist(), strict=True))


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
    sd: FloatArray  # (d,): standard deviation of the log of every scale


def _nodes(restricted: _Restricted, logs: Mapping[str, float], sigma: float) -> _Nodes:
    """A centre and points on a sphere in the principal axes, whose weights reproduce the moments of
    a Gaussian; each counts as the posterior is there.
    """
    names = list(logs)
    d, centre = len(names), np.array([logs[name] for name in names])

    def named(x: FloatArray) -> dict[str, float]:
        return dict(zip(names, x.tolist(), strict=True))

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
    return _Nodes(
        [named(x) for x in at], weights, weights - costs, np.sqrt(np.sum(spread**2, axis=1))
    )


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
    known = effects_of(obs, cal.camera)
    names = tuple(wanted) or tuple(known)
    for name in names:
        if name not in known:
            raise CalibrationError(
                f"the effect {name!r} needs what does not vary in this table: use some of "
                f"{', '.join(known)}."
            )
    rotations = quaternion_to_rotation(cal.quaternions)
    sums, scale = EffectSums([known[name] for name in names], cal.theta, cal.sigma), cal.sigmas
    for part, state, rows in likelihood.pieces(cal.theta, rotations, _STARS_AT_ONCE):
        h = part.derivatives(cal.theta, state) * scale[:, None, None]
        columns = part.project_out(state, np.concatenate([h, state.e[None]]))
        sums.add(part, state, columns, rows)
    restricted = _Restricted(sums, len(cal.theta), likelihood.dof)
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
    ratio = {name: float(np.exp(2.0 * value)) for name, value in logs.items()}
    exact = EffectLikelihood(
        likelihood.frames, likelihood.model_name, effects, ratio, theta, rotations, sigma
    )
    state, _ = exact.profile(theta, exact.rotations)
    rest, coefficients = exact.conditioned(state, state.e[None])
    turned = exact.attitude_response(state, state.e[None]) - exact.turns(state, coefficients)
    fitted = []
    for step, sd in zip(steps, nodes.sd, strict=True):
        best = float(np.exp(logs[step.name]) * sigma)
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
        places=tuple((e.name, len(e.prior)) for e in effects if e.grouping == "run"),
    )
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
        without = restricted.at({other: value for other, value in logs.items() if other != name})
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
    sums, whitening = EffectSums(effects, theta, sigma), scaled_cholesky(covariance)
    plain = expanded(likelihood, theta, whitening, likelihood.sums(theta), sums.add)
    solved = [
        sums.solved({name: float(np.exp(2.0 * value)) for name, value in logs.items()})
        for logs in nodes.logs
    ]
    made = [
        replace(replace(plain, gram=own.gram).likelihood(theta, whitening), dof=likelihood.dof)
        for own in solved
    ]
    found = optimum(made[0])
    theta, covariance, sigma = found.theta, found.covariance, found.sigma
    here, p = found.compressed, len(theta)
    grams = np.stack([moved(own, here.theta_hat, here.whitening).gram for own in made])
    # Coefficients follow the whitened parameters of the last expansion.
    outer = sums.sums[1]
    run = solved[0].coefficients(outer).run
    z = made[0].whiten(theta)[0]
    follow = run[:, 1 : p + 1]
    root = solved[0].run_root
    half = np.linalg.solve(solved[0].run_factor, np.diag(root))
    by_theta = np.linalg.solve(whitening, covariance).T
    joint = (
        run[:, 0] + follow @ z,
        found.sigma**2 * half.T @ half + follow @ np.linalg.solve(whitening, by_theta) @ follow.T,
        by_theta @ follow.T,
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
