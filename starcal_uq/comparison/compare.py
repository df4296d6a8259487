"""Compare two calibrated cameras: best rotation removed, difference over the detector, and what
chance explains.

At each pixel of a grid, e = R^T b_B - b_A is the difference of the directions that the two cameras
assign, after the rotation R that fits best over the detector area is removed; every attitude takes
that rotation up. To first order e is linear in the errors of both sets of parameters,

    e = D_B delta_B - D_A delta_A,    D = B + A K    (as in the field map),

so that its covariance, and that of the rotation, follow from those of the parameters. Two tests use
them:

- *the map*: the mean square of e over the detector area is a weighted sum of squared normal
  variables, with the eigenvalues of the covariance as weights; its p-value is exact for Gaussian
  errors, the degrees of freedom of the noise estimates included. It answers whether the maps differ
  by more arcsec than they should.
- *the parameters*: the Mahalanobis length of the whole difference, chi-square (or F). It weighs
  every direction in which the two can differ by its own uncertainty, and answers whether the two
  can be the same camera. Where stars cover the detector evenly all directions bend the map by
  nearly the same amount, and the two tests nearly coincide; where they leave parts of it empty, the
  first is decided there and the second is not.
"""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.attitude.rotations import rotation_vector
from starcal_uq.attitude.wahba import aligned
from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.camera.distortion import parameters, shared_names
from starcal_uq.camera.fields import area_weights, detector_axes, grid_points, tangent_axes
from starcal_uq.camera.projection import project, unproject
from starcal_uq.comparison.covariance import Rule, difference_rule
from starcal_uq.comparison.result import CameraComparison
from starcal_uq.comparison.significance import (
    DifferenceTests,
    Estimate,
    difference_matrix,
    difference_tests,
    estimate_of,
    linearised,
    one_noise,
)
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.errors import ComparisonError
from starcal_uq.core.findings import clause
from starcal_uq.core.provenance import Provenance
from starcal_uq.core.settings import Seed, bounded, seed_of
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.types import AnyDict
from starcal_uq.maths.linear import root_diagonal
from starcal_uq.observations.splits import split_frames, split_labels

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.repeats import Fingerprints
    from starcal_uq.observations.table import Observations

# A prior that is less than so many times wider than the posterior has a say in it.
_WIDE_PRIOR = 5.0
# What to know when reading a comparison.
Differs = Enum("Differs", "MODELS OUTSIDE PITCH EQUALLY_CERTAIN MAP_ALONE NOT_CONVERGED BY_PRIOR")


@bounded
@one_thread()
def compare(
    a: Calibration | Posterior,
    b: Calibration | Posterior,
    *,
    labels: tuple[str, str] = ("A", "B"),
    same_data: bool | None = None,
    observations: tuple[Observations, Observations] | None = None,
    fingerprints: tuple[Fingerprints | None, Fingerprints | None] | None = None,
    n: int = 25,
    level: float = 0.01,
    n_draws: int = 4000,
    seed: Seed = 0,
) -> CameraComparison:
    """Difference of the directions of two cameras, B minus A, and whether chance explains it.

    Parameters
    ----------
    a, b : Calibration or Posterior
        Results for detectors with the same number of pixels; their distortion models may differ.
    labels : (str, str)
        Names of the two in words and figures.
    same_data : bool, optional
        Whether both rest on the same frames. Without it, the hashes of their data say so,
        `observations` and `fingerprints`.
    observations : pair of Observations, optional
        The frames of each; shared ones are then found even where the tables differ.
    fingerprints : pair of Fingerprints or None, optional
        Those of the frames, by which images that were measured again are found as well; a
        calibration brings its own.
    n : int
        Grid points along each side of the detector.
    level : float
        Probability at most of a verdict "differ" when nothing does.
    n_draws : int
        Monte Carlo draws for the p-value of the worst pixel.
    seed : int or Generator
        Seed of the draws.

    Raises
    ------
    ComparisonError
        For detectors of different size, a calibration that did not converge, or a level outside (0,
        1).
    DistortionError
        When the distortion of a camera folds over within the detector.
    """
    seed = seed_of(seed)
    _check(a, b, labels, level)
    marks = fingerprints or (getattr(a, "fingerprints", None), getattr(b, "fingerprints", None))
    rule = difference_rule(a, b, labels, same_data, observations, marks)
    first, second = one_noise(estimate_of(a), estimate_of(b), rule)
    x, y = detector_axes(first.camera, n)
    xy, weight = grid_points(x, y), area_weights(n)
    direction = unproject(first.camera, xy)
    turned, rotation = aligned(unproject(second.camera, xy), direction, weight)
    axes = tangent_axes(direction)
    e = np.einsum("nij,nj->ni", axes, turned - direction)
    difference_px = project(first.camera, turned) - xy
    linear = linearised(first, second, xy, weight)
    length = np.linalg.norm(e, axis=1) * ARCSEC
    tests = difference_tests(first, second, linear, rule, e, weight, n_draws, seed)
    worst = int(np.argmax(tests.ratio if np.isfinite(tests.p_map) else length))
    shared = _shared_parameters(first, second, rule)
    spread = linear[0].rotation, linear[1].rotation
    return CameraComparison(
        labels=(str(labels[0]), str(labels[1])),
        models=(first.camera.distortion, second.camera.distortion),
        data=rule.data,
        rule=rule.words,
        level=level,
        x_px=x,
        y_px=y,
        difference_arcsec=e.reshape(n, n, 2) * ARCSEC,
        difference_px=difference_px.reshape(n, n, 2),
        sigma_arcsec=tests.sigma.reshape(n, n),
        ratio=tests.ratio.reshape(n, n),
        rotation_arcsec=rotation_vector(rotation) * ARCSEC,
        rotation_covariance_arcsec2=difference_matrix(rule, spread, (first, second)) * ARCSEC**2,
        rms_arcsec=float(np.sqrt(weight @ length**2)),
        rms_px=float(np.sqrt(weight @ np.sum(difference_px**2, axis=1))),
        expected_rms_arcsec=tests.expected,
        largest_arcsec=float(length.max()),
        largest_px=float(np.hypot(*difference_px.T).max()),
        p_map=tests.p_map,
        p_parameters=tests.p_parameters,
        statistic=tests.statistic,
        n_directions=tests.n_directions,
        p_worst=tests.p_worst,
        p_worst_error=tests.p_worst_error,
        worst_x_px=float(xy[worst, 0]),
        worst_y_px=float(xy[worst, 1]),
        worst_ratio=float(tests.ratio[worst]),
        outside_arcsec=tests.outside,
        messages=_messages(a, b, labels, rule, tests),
        provenance=Provenance(
            a=a.provenance,
            b=b.provenance,
            settings={"n": n, "n_draws": n_draws, "seed": seed, "same_data": same_data},
        ),
        **shared,
    )


@bounded
def compare_halves(
    obs: Observations,
    camera: Camera,
    how: str = "odd-even",
    *,
    seed: Seed = 0,
    method: str = "efficient",
    **options: Any,
) -> CameraComparison:
    """Calibrate two halves of the frames by themselves and compare them.

    Parameters
    ----------
    obs : Observations
        The frames.
    camera : Camera
        Start of both calibrations.
    how : {"odd-even", "halves", "random"}
        Rule of `split_frames`.
    seed : int or Generator
        Seed of a random half, and of the comparison.
    method : str
        Method of `calibrate`.
    **options
        Further options of `compare`.

    Raises
    ------
    ComparisonError
        For an unknown split or a single frame.
    CalibrationError
        When a half does not determine the camera.
    """
    seed = seed_of(seed)
    first, second = (
        calibrate(part, camera, model=camera.model, method=method, duplicates="keep")
        for part in split_frames(obs, how, seed=seed)
    )
    options = {"labels": split_labels(how), **options}
    return compare(first, second, seed=seed, **options)


def _check(a: Any, b: Any, labels: tuple[str, str], level: float) -> None:
    if not 0.0 < level < 1.0:
        raise ComparisonError(
            f"level {level:g} is not a probability of a false alarm: use one such as 0.01."
        )
    for result, name in zip((a, b), labels, strict=True):
        status = getattr(result, "status", None)
        if status is not None and not status.ok:
            raise ComparisonError(
                f"{name}: the calibration did not converge ({status.name}), so it cannot be "
                f"compared: {status.remedy}."
            )
    sizes = [(r.camera.width_px, r.camera.height_px) for r in (a, b)]
    if sizes[0] != sizes[1]:
        (w, h), (wide, high) = sizes
        raise ComparisonError(
            f"{labels[0]} has {w} x {h} pixels and {labels[1]} {wide} x {high}: directions are "
            "compared "
            "pixel by pixel, so compare runs of one detector, with the same windowing."
        )


def _shared_parameters(a: Estimate, b: Estimate, rule: Rule) -> AnyDict:
    """Parameters that mean the same in both models."""
    specs = {p.name: (i, p.unit) for i, p in enumerate(parameters(a.camera.distortion))}
    common = shared_names(b.camera.distortion, a.camera.distortion)
    names = [*b.camera.parameter_names[:3], *common]
    rows_a = [specs[name][0] for name in names]
    rows_b = [b.camera.parameter_names.index(name) for name in names]
    variances = [np.diag(a.covariance)[rows_a], np.diag(b.covariance)[rows_b]]
    rows = np.eye(a.theta.size)[rows_a], np.eye(b.theta.size)[rows_b]
    difference = root_diagonal(difference_matrix(rule, rows, (a, b)))
    return {
        "parameter_names": tuple(names),
        "parameter_units": tuple(specs[name][1] for name in names),
        "theta_a": a.theta[rows_a],
        "theta_b": b.theta[rows_b],
        "sd_a": np.sqrt(variances[0]),
        "sd_b": np.sqrt(variances[1]),
        "sd_difference": difference,
    }


def _messages(
    a: Any, b: Any, labels: tuple[str, str], rule: Rule, tests: DifferenceTests
) -> tuple[str, ...]:
    """What should be known when reading the result."""
    cameras = a.camera, b.camera
    models = tuple(camera.distortion for camera in cameras)
    differ, told = models[0] != models[1], rule.signs is not None
    outside, pitches = tests.outside, [c.pixel_um for c in cameras if c.pixel_um is not None]
    equal, by_frames = np.isnan(tests.p_map), np.isnan(tests.p_parameters)
    rows: tuple[tuple[Any, Differs, AnyDict], ...] = (
        (differ, Differs.MODELS, {"models": models}),
        (
            differ and outside > 0.0 and outside > 0.1 * tests.expected,
            Differs.OUTSIDE,
            {"outside_arcsec": outside},
        ),
        (len(set(pitches)) > 1, Differs.PITCH, {"pitches_um": pitches}),
        (told and equal, Differs.EQUALLY_CERTAIN, {}),
        (told and not equal and by_frames, Differs.MAP_ALONE, {}),
    )
    messages = [clause(code, **facts) for holds, code, facts in rows if holds]
    for result, name in zip((a, b), labels, strict=True):
        messages += _posterior_messages(result, name, rule)
    return tuple(messages)


def _posterior_messages(result: Any, name: str, rule: Rule) -> list[str]:
    priors, diagnostics = getattr(result, "priors", None), getattr(result, "diagnostics", None)
    messages = []
    if diagnostics is not None and not diagnostics.ok:
        messages.append(clause(Differs.NOT_CONVERGED, name=name))
    if priors is None or rule.signs is None:
        return messages
    ratio = priors.sd(result.camera_names) / root_diagonal(result.covariance)
    least = int(np.argmin(ratio))
    if ratio[least] < _WIDE_PRIOR:
        narrow = {"parameter": result.camera_names[least], "times": ratio[least]}
        messages.append(clause(Differs.BY_PRIOR, name=name, **narrow))
    return messages
