"""Scales of effects: their restricted likelihood, which effects it takes up, and nodes over which
what it says of the scales is integrated.

The restricted likelihood of the scales has attitudes, camera parameters and all coefficients
integrated out and the noise profiled (Patterson & Thompson 1971). An effect is taken up where it
gains more than chance gives the best of all candidates once in a hundred campaigns without any
(Self & Liang 1987: a variance on its bound). What the data say of the scales is then integrated
over a design of nodes around the best ones, as INLA does (Rue, Martino & Chopin 2009), so that the
posterior of the camera holds their uncertainty.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from starcal_uq.core.types import FloatArray
from starcal_uq.likelihood.effect_sums import EffectSums, Solved
from starcal_uq.maths.differences import derivatives
from starcal_uq.maths.linear import root_diagonal

# False alarms of the whole selection on data without effects.
_ALPHA = 0.01
_MOST = 6
# Standard deviation of the half-normal prior of a scale, px at the corner.
PRIOR_PX = 10.0
# Range of the log of a scale in units of sigma; below it an effect is none.
_RANGE = (-7.0, 7.0)
# Half width of the differences that give the curvature in the logs of the scales.
_STEP = 0.1


class Restricted:
    """Restricted likelihood of the scales of effects, linearised at an estimate."""

    def __init__(self, sums: EffectSums, p: int, dof: int, sigma: float) -> None:
        self.sums, self.p, self.dof = sums, p, dof - p
        # Logs of scales that are known, px, in units of the noise that is found about there.
        self.known = {e.name: -float(np.log(sigma)) for e in sums.effects if e.known}

    def at(self, logs: Mapping[str, float]) -> tuple[float, Solved, float]:
        """Minus the log likelihood where the logs of the scales in units of sigma are these, the
        normal equations, and the noise there.
        """
        solved = self.sums.solved(squares(logs))
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


def squares(logs: Mapping[str, float]) -> dict[str, float]:
    """Squares of scales with these logs."""
    return {name: float(np.exp(2.0 * value)) for name, value in logs.items()}


def penalty(candidates: int) -> float:
    """Gain of the restricted log likelihood that the best of so many candidates exceeds once in a
    hundred without any effect.
    """
    from scipy.special import chdtri

    return 0.5 * float(chdtri(1.0, 2.0 * _ALPHA / max(candidates, 1)))


@dataclass(frozen=True)
class Step:
    """An effect that was taken up: its name, gain, and the parameters before and after."""

    name: str
    gain: float
    moved: FloatArray  # (p,): change of the parameters in their standard deviations


def parameters_at(solved: Solved, p: int) -> tuple[FloatArray, FloatArray]:
    """Parameters (p,) and their unit covariance (p, p), in the sums' own scale."""
    gram = solved.gram
    inverse = np.linalg.inv(gram[:p, :p])
    return inverse @ gram[:p, p], np.asarray(inverse)


def selected(
    restricted: Restricted,
    candidates: Sequence[str],
    logs: dict[str, float],
    steps: list[Step],
    least: float,
) -> tuple[dict[str, float], list[Step], list[tuple[str, float]]]:
    """Logs of the scales of the effects that the data support beside those of `logs`, how they were
    taken up, and what the others would gain. `least`: gain that an effect has to exceed.
    """
    asked = tuple(logs)
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
        before = parameters_at(solved, restricted.p)
        logs = restricted.together({**logs, name: tried[name][0]})
        stay = (name, *asked)
        logs = {n: v for n, v in logs.items() if n in stay or v > _RANGE[0] + 0.1}
        steps = [step for step in steps if step.name in logs]
        now, solved, sigma = restricted.at(logs)
        after = parameters_at(solved, restricted.p)
        steps.append(Step(name, gain, (after[0] - before[0]) / (sigma * root_diagonal(after[1]))))


@dataclass(frozen=True, eq=False)
class Nodes:
    """Scales at which what the data say of them is summed up, the best ones first."""

    logs: list[dict[str, float]]
    log_weights: FloatArray  # (J,): of the rule, and the prior there
    log_posterior: FloatArray  # (J,): with the restricted likelihood
    sd: dict[str, float]  # Standard deviation of the log of every scale that is not known


def nodes_around(restricted: Restricted, logs: Mapping[str, float], sigma: float) -> Nodes:
    """A centre and points on a sphere in the principal axes, whose weights reproduce the moments of
    a Gaussian; each counts as the posterior is there.
    """
    names = [name for name in logs if name not in restricted.known]
    d, centre = len(names), np.array([logs[name] for name in names])
    if not names:
        return Nodes([dict(logs)], np.zeros(1), np.zeros(1), {})

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
    return Nodes([named(x) for x in at], weights, weights - costs, sd)


def _spread(density: Callable[[FloatArray], float], centre: FloatArray) -> FloatArray:
    """Square root (d, d) of the covariance of a density with this mode, by differences."""

    def around(steps: FloatArray) -> FloatArray:
        return np.array([density(centre + step) for step in steps])

    _, _, hessian = derivatives(around, len(centre), _STEP)
    values, vectors = np.linalg.eigh(-hessian)
    # Where the data say little of a scale, its log is known to a factor of three.
    return np.asarray(vectors / np.sqrt(np.maximum(values, 0.8)))


def forced(restricted: Restricted, names: Sequence[str]) -> tuple[dict[str, float], list[Step]]:
    """Logs of the scales of effects that were asked for, and what each gains beside the others."""
    logs: dict[str, float] = {}
    if not names:
        return logs, []
    for name in names:
        logs[name] = restricted.alone(logs, name)[0]
    logs = restricted.together(logs)
    cost, solved, sigma = restricted.at(logs)
    best, unit = parameters_at(solved, restricted.p)
    steps = []
    for name in names:
        without = restricted.at(_but(logs, name))
        moved_by = best - parameters_at(without[1], restricted.p)[0]
        steps.append(Step(name, without[0] - cost, moved_by / (sigma * root_diagonal(unit))))
    return logs, steps
