"""The richest distortion model that the data determine, where they do not determine the one of the
camera.

One rule: what is asked for by name (``model="brown"``, ``--model brown``) is fitted or refused, and
the refusal names the model that would converge; the model of a camera's sheet is a start, and a
simpler one is taken where it fails. Where the simpler model is asked for, it leaves out as much:
its record is the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from starcal_uq.calibration.plausibility import find_reason
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model, next_simpler, simpler_models
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.findings import clause
from starcal_uq.core.status import Status
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.estimation.result import Calibration
from starcal_uq.estimation.undetermined import (
    COMA_MATTERS,
    EXPLAINED,
    Open,
    open_parameters,
    remedy_of,
)
from starcal_uq.estimation.weights import weighed
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.maths.linear import principal, unit_diagonal
from starcal_uq.observations.table import Observations

# Ends that a better start may mend.
_BETTER_START = (Status.MAX_ITERATIONS, Status.STALLED)
# Terms that the data want with less probability than this if they are zero are not to be left out.
_WANTED_P = 1e-3
_ABSORBED = 1e-12


def fit_determined(
    obs: Observations,
    camera: Camera,
    fit: Callable[[Camera], Calibration],
    *,
    sheet: str,
    asked: bool,
    throw: bool = True,
) -> Calibration:
    """The calibration by `fit` with the model of a camera, or with the richest simpler one that the
    data determine.

    `camera`: nominal, with the model wanted.
    `fit`: nominal camera to calibration; it may raise `CalibrationError`. `sheet`: model of the
    camera's sheet.
    `asked`: whether the model was asked for by name: then it is that or, with `throw`, an error
    naming one that
        converges.
    `throw`: whether a calibration that did not end well is of no use.
    CalibrationError as `fit`, where no simpler model is to be had.
    """
    failure, found = None, None
    try:
        found = fit(camera)
        status, names = found.status, found.undetermined
    except CalibrationError as error:
        if error.status is None:
            raise
        failure, status, names = error, error.status, error.undetermined
    if not status.ok and not (asked and not throw) and status in EXPLAINED:
        simpler = _simpler(obs, camera, fit, status)
        if simpler is not None and simpler.camera.distortion == camera.distortion:
            return simpler
        if simpler is not None:
            used = simpler.camera.distortion
            if asked:
                if get_model(camera.distortion).tilts and _converges(
                    camera.replace(distortion=next_simpler(camera.distortion)), fit
                ):
                    used = next_simpler(camera.distortion)
                raise CalibrationError(
                    f"the calibration failed ({status.name})",
                    status,
                    names,
                    found,
                    reason=(
                        f"{remedy_of(status, names, camera.distortion)}; {used!r} converges (--model {used}, or "
                        f"model={used!r} in Python)"
                    ),
                ) from failure
            return _conditional(simpler, camera.distortion, status, names)
    if failure is not None:
        raise failure
    assert found is not None
    if asked and status.ok and camera.distortion in simpler_models(sheet):
        left_open = _left_open(obs, found, sheet)
        if left_open is not None:
            return _conditional(found, sheet, Status.SINGULAR, left_open)
    return found


def _conditional(
    cal: Calibration, model: str, status: Status, names: tuple[str, ...]
) -> Calibration:
    """The calibration with the record of the richer model that the data do not determine, and
    why.
    """
    because = clause(Open.RICHER, names=names, status=status)
    record: AnyDict = {"model": model, "used": cal.camera.distortion, "status": status.name}
    record |= {"undetermined": list(names), "because": because}
    return replace(cal, provenance=cal.provenance.adding(fallback=record))


def _left_open(obs: Observations, cal: Calibration, richer: str) -> tuple[str, ...] | None:
    """What the data leave open of a richer model around a calibration; None where they determine
    all of it.
    """
    likelihood, theta = _as_richer(obs, cal, richer)
    if likelihood.dof < len(theta):
        return ()
    camera = cal.nominal.replace(distortion=richer)
    return open_parameters(likelihood.evaluate(theta).matrix, cal.sigma, camera) or None


def _as_richer(
    obs: Observations, cal: Calibration, richer: str
) -> tuple[MarginalLikelihood, FloatArray]:
    """The likelihood of a richer model, and the estimate of a calibration in it: what it lacks is
    zero.
    """
    likelihood = MarginalLikelihood(weighed(obs, cal), richer, cal.rotations)
    return likelihood, cal.camera.replace(distortion=richer).theta


def _simpler(
    obs: Observations, camera: Camera, fit: Callable[[Camera], Calibration], status: Status
) -> Calibration | None:
    """The calibration with the richest simpler model that converges, or with the model itself from
    a better start.

    None where the stars do not agree, so that no model is to blame, or where they ask for the terms
    left out.
    """
    names = sorted(
        simpler_models(camera.distortion), key=lambda name: -len(get_model(name).coefficients)
    )
    if not names or find_reason(obs, camera, status) is not None:
        return None
    for name in names:
        try:
            found = fit(camera.replace(distortion=name))
        except CalibrationError:
            continue
        if not found.status.ok:
            continue
        if status in _BETTER_START:
            optics = found.camera.replace(distortion=camera.distortion)
            try:
                again = fit(optics)
            except CalibrationError:
                again = found
            if again.status.ok and again is not found:
                return replace(again, nominal=camera)
        return None if _wanted(obs, found, camera.distortion) else found
    return None


def _converges(camera: Camera, fit: Callable[[Camera], Calibration]) -> bool:
    try:
        return fit(camera).status.ok
    except CalibrationError:
        return False


def _wanted(obs: Observations, cal: Calibration, richer: str) -> bool:
    """Whether the residuals of a calibration ask for the terms of a richer model: the score test,
    an F statistic.
    """
    from scipy.special import fdtrc

    if cal.has_tails:
        # Of wrong stars a Gaussian test would ask for anything.
        return False
    likelihood, theta = _as_richer(obs, cal, richer)
    normal = likelihood.evaluate(theta)
    scaled, scale = unit_diagonal(normal.matrix)
    values, vectors = principal(scaled, _ABSORBED)
    gain = float(np.sum((vectors.T @ (scale * normal.gradient)) ** 2 / values))
    terms, dof = len(values) - len(cal.theta), likelihood.dof - len(values)
    if terms < 1 or dof < 1 or not 0.0 < gain < normal.cost:
        return False
    return bool(fdtrc(terms, dof, gain / terms / ((normal.cost - gain) / dof)) < _WANTED_P)


def fallback_facts(cal: Calibration) -> AnyDict:
    """What the data do not determine of the camera's model, and what the sigmas rest on; empty
    where they do.
    """
    record, factors = cal.provenance.fallback, cal.coma_factors
    if record:
        left_out = [c.name for c in get_model(record["model"]).coefficients]
        return {
            "used": str(record["used"]),
            "model": str(record["model"]),
            "because": str(record["because"]),
            "left_out": tuple(name for name in left_out if name not in cal.parameter_names),
        }
    if factors is None or np.max(factors) < COMA_MATTERS:
        return {}
    x0, y0 = (float(sigma) for sigma in cal.sigmas[:2])
    return {"x0_px": x0, "y0_px": y0, "times": float(np.max(factors))}
