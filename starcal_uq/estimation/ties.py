"""The estimate with attitudes tied by known rotations between frames."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.attitude.relative import RelativeAttitudes
from starcal_uq.attitude.rotations import (
    exp_rotation,
    rotation_to_quaternion,
)
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.provenance import Provenance
from starcal_uq.core.status import Status
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.estimation.assemble import PairEstimate, assemble
from starcal_uq.estimation.stages import Search, Stage
from starcal_uq.estimation.undetermined import coma_record, undetermined
from starcal_uq.likelihood.compressed import settled, unit_covariance
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.sums import Attitudes
from starcal_uq.likelihood.ties import FittedTies, FixedMount, TiedLikelihood, Ties
from starcal_uq.maths.linear import root_diagonal, scaled_inverse, symmetric_inverse

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

# Rotations whose errors are so many times the stated ones are those of other frames or axes.
_ASTRAY = 100.0
# Standard deviations of the last step, which Newton's method on the expansion follows.
_STEP = 1e-3


def ties_of(obs: Observations, given: RelativeAttitudes | FixedMount) -> Ties:
    """The ties between frames of a table.

    CalibrationError for frames that it does not hold, and for a fixed mount without times.
    """
    if isinstance(given, FixedMount):
        if obs.time_utc is None:
            raise CalibrationError(
                "a fixed mount turns with the Earth, and the table states no time_utc: add the "
                "times of the frames, or leave the mount out."
            )
        times = obs.time_utc[obs.frame_starts[:-1]]
        given = RelativeAttitudes.of_earth(obs.frame_ids, times.tolist(), given.sigma_arcsec)
    return Ties.of(obs.frame_ids, given)


def with_ties(
    obs: Observations, cal: Calibration, given: RelativeAttitudes | FixedMount
) -> Calibration:
    """The calibration with known rotations between its frames.

    Parameters
    ----------
    obs, cal
        The table, with the weights of the calibration, and the estimate by its marginal
        likelihood, which may leave parameters open.
    given : RelativeAttitudes or FixedMount
        The rotations.

    Raises
    ------
    CalibrationError
        For frames that the table does not hold, for a fixed mount without times, and for
        rotations that have nothing to do with these frames.
    """
    began = perf_counter()
    ties = ties_of(obs, given)
    likelihood = TiedLikelihood(obs, cal.camera.distortion, ties, cal.sigma, cal.rotations)
    before = _Squares(likelihood, cal.theta, cal.sigmas)
    _refuse_others(before, likelihood.ties)
    dof = likelihood.dof - len(cal.theta)
    found = Search(tolerance=_STEP**2 / dof).minimum(likelihood.evaluate, cal.theta)
    theta, sigma, status = found.theta, float(np.sqrt(found.normal.cost / dof)), found.status
    names, factors = undetermined(
        likelihood, theta, found.normal.matrix, sigma, cal.nominal, status
    )
    covariance = scaled_inverse(found.normal.matrix) * sigma**2
    compressed = likelihood.compressed(theta, covariance)
    if not names:
        compressed = settled(compressed)
        sigma = float(np.sqrt(compressed.gram[0, 0] / dof))
        covariance = unit_covariance(compressed) * sigma**2
    theta = compressed.theta_hat - 0.5 * compressed.whitening @ compressed.log_determinant_slope
    trajectory = np.vstack([found.trajectory, theta])
    cost = np.append(found.costs, compressed.gram[0, 0])
    seconds = perf_counter() - began
    stage = Stage("ties", trajectory, cost, status, found.evaluations, seconds)
    residuals, turned, attitudes = _tied(likelihood, theta)
    after = _Squares(likelihood, theta, root_diagonal(covariance))
    wide = factors * _tails(cal)
    known = likelihood.ties.known
    settings: AnyDict = {"relative_attitudes": len(known)}
    if known.of_mount:
        settings = {"mount": "fixed", "mount_sigma_arcsec": float(known.sigma_arcsec[0, 0])}
    provenance = _with_coma(cal, factors)
    return cal.moved(
        theta,
        sigma,
        dof,
        Status.SINGULAR if names else status,
        covariance=covariance * np.outer(wide, wide),
        stages=(*cal.stages, stage),
        undetermined=names,
        quaternions=rotation_to_quaternion(turned),
        residuals_px=residuals.T,
        chi2=float(compressed.gram[0, 0]),
        information=symmetric_inverse(covariance),
        rotation_per_theta=np.mean(attitudes.response, axis=2),
        attitude_noise=np.mean(attitudes.inverse, axis=2) * sigma**2,
        compressed=compressed,
        provenance=provenance.with_settings(**settings),
        ties=_checked(cal, likelihood.ties, after, before.free),
    )


def without_ties(obs: Observations, cal: Calibration) -> Calibration:
    """The estimate before known rotations were added, whose residuals the stars alone decide; that
    with them where the stars leave parameters open.

    `obs`: the table, with the weights of the calibration.
    """
    if cal.ties is None:
        return cal
    likelihood = MarginalLikelihood(obs, cal.camera.distortion, cal.rotations)
    stages, settings = [*cal.stages[:-1]], dict(cal.provenance.settings)
    found = assemble(
        obs,
        cal.nominal,
        likelihood,
        stages,
        Status.CONVERGED,
        lambda: PairEstimate(cal.pair_theta, cal.pair_covariance),
        settings,
    )
    if not found.status.ok:
        return cal
    provenance = _with_coma(cal, found.width_factors)
    wide = _tails(cal)
    return replace(
        found,
        covariance=found.covariance * np.outer(wide, wide),
        provenance=provenance,
        star_weights=cal.star_weights,
    )


def _tails(cal: Calibration) -> FloatArray:
    """Factors (p,) on sigmas of the weights of tails; ones where there are none."""
    return np.ones(len(cal.theta)) if cal.tail_factors is None else cal.tail_factors


def _with_coma(cal: Calibration, factors: FloatArray) -> Provenance:
    """The provenance of a calibration with other factors (p,) in place of its `without_coma`."""
    kept = {name: entry for name, entry in cal.provenance.items() if name != "without_coma"}
    return Provenance(kept | coma_record(cal.nominal, factors))


def _tied(
    likelihood: TiedLikelihood, theta: FloatArray
) -> tuple[FloatArray, FloatArray, Attitudes]:
    """Residuals (2, N), px, and attitudes (K, 3, 3) that the ties leave, and those of each frame
    alone.
    """
    attitudes = likelihood.sums(theta)[1]
    turned = exp_rotation(likelihood.tied(attitudes).turns().T) @ attitudes.at(theta)
    return likelihood.frames.in_pixels(likelihood.residuals(theta, turned)), turned, attitudes


class _Squares:
    """Least sums of squares with ties of any errors, parameters following, around an estimate; in
    units of the noise without ties.
    """

    def __init__(self, likelihood: TiedLikelihood, theta: FloatArray, scale: FloatArray) -> None:
        self._sums, self._attitudes = super(TiedLikelihood, likelihood).sums(theta)
        self._ties, self._sigma, self._scale = likelihood.ties, likelihood.sigma, scale
        self.free = self._sums.cost / self._sigma**2

    def of(self, factor: float) -> float:
        """With errors that are `factor` times the stated ones."""
        at, scale = self._attitudes, self._scale
        ties = replace(self._ties, known=self._ties.known.scaled(factor))
        tied = ties.around(at.at(at.theta), at.inverse, self._sigma)
        columns = np.column_stack([tied.rest, tied.columns(at.response) * scale])
        gram = columns.T @ tied.solve(columns)
        matrix = self._sums.matrix * np.outer(scale, scale) + gram[1:, 1:]
        slope = self._sums.gradient * scale + gram[1:, 0]
        least = self._sums.cost + gram[0, 0] - slope @ np.linalg.solve(matrix, slope)
        return float(least) / self._sigma**2


def _refuse_others(squares: _Squares, ties: Ties) -> None:
    """CalibrationError for rotations that have nothing to do with the frames."""
    if squares.of(_ASTRAY) - squares.free < ties.dof:
        return
    what = "a fixed mount contradicts" if ties.known.of_mount else "the rotations contradict"
    raise CalibrationError(
        f"{what} the stars: errors would have to be more than {_ASTRAY:g} times the stated "
        "ones; check the numbers and times of the frames and the sense of the quaternions, or "
        "leave the known rotations out."
    )


def _checked(cal: Calibration, ties: Ties, squares: _Squares, free: float) -> FittedTies:
    """How the ties agree with the stars: `squares` around the estimate with them, `free` those of
    the calibration without.
    """
    from scipy.optimize import brentq
    from scipy.special import fdtrc

    def excess(log: float) -> float:
        return squares.of(float(np.exp(log))) - free - ties.dof

    chi2, factor, top = max(squares.of(1.0) - free, 0.0), 1.0, float(np.log(_ASTRAY))
    if chi2 > ties.dof:
        factor = float(np.exp(brentq(excess, 0.0, top, xtol=1e-3))) if excess(top) < 0 else np.inf
    return FittedTies(
        ties.known,
        chi2,
        ties.dof,
        float(fdtrc(ties.dof, cal.dof, chi2 / ties.dof)),
        factor,
        cal.sigma,
        cal.sigmas,
    )
