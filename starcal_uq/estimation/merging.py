"""Several calibrations of one camera as one: their compressed likelihoods added up.

The likelihood of all stars is the product over runs, and each run stores its own as a small Gram
matrix. Moved to a common point (`compressed`), the matrices add: no star is looked at again, and
the result is what a calibration on all stars gives. Whether the runs show the same camera is tested
on the way.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import combinations
from time import perf_counter
from typing import TYPE_CHECKING, get_args

import numpy as np

from starcal_uq.attitude.rotations import rotation_to_quaternion
from starcal_uq.camera.distortion import sigma_parameter
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import CalibrationError, RepeatedFramesError, check_known
from starcal_uq.core.findings import clause
from starcal_uq.core.provenance import Provenance, data_hashes, provenance
from starcal_uq.core.records import from_plain, to_plain
from starcal_uq.core.settings import MergedNoise
from starcal_uq.core.status import Status
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.types import AnyDict, FloatArray, IntArray
from starcal_uq.estimation.duplicates import check_duplicates, fingerprints_of
from starcal_uq.estimation.kept import KeptFrames
from starcal_uq.estimation.result import Calibration
from starcal_uq.estimation.stages import Stage
from starcal_uq.likelihood.compressed import Optimum, combined, optimum, scaled, total
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.maths.linear import correlation_of, root_diagonal
from starcal_uq.observations.repeats import Fingerprints, shared
from starcal_uq.observations.table import Observations

if TYPE_CHECKING:
    import pandas as pd

NOISES = get_args(MergedNoise)
# Up to this many sigmas of a run, its quadratic expansion was never wrong by more than 0.15 nat,
# even with five frames. Runs of one camera stay within five.
MAX_DISTANCE = 8.0
# How runs differ.
Apart = Enum("Apart", "ODD CAMERAS NOISES UNCHECKED SHARED")


@one_thread()
def merge(
    calibrations: Sequence[Calibration],
    observations: Observations | None = None,
    *,
    names: Sequence[str] | None = None,
    noise: str = "auto",
    allow_inconsistent: bool = False,
    duplicates: str = "refuse",
) -> Calibration:
    """Combine calibrations of the same camera on different frames.

    Parameters
    ----------
    calibrations : sequence of Calibration
        At least two, with the same detector and distortion model. The start values (`nominal`) of
        the first become those of the result, and with them the centre of the default priors.
    observations : Observations, optional
        All stars, from `join_observations`. With them, residuals and attitudes are those at the
        merged estimate; without, they are the runs' own.
    names : sequence of str, optional
        Names of the runs in messages; ``run 1``... otherwise.
    noise : {"auto", "common", "own"}
        ``common``: one noise for all runs, estimated again. ``own``: each run keeps its own estimate
        as stated noise, and the result has a common factor on it (`sigma_scale`), which also allows
        runs with and without stated noises. ``auto``: ``own`` where the runs' noises differ
        (Bartlett's test at 0.1 %) or are of different kinds.
    allow_inconsistent : bool
        Merge runs that do not show the same camera; the result says so.
    duplicates : {"refuse", "keep"}
        What to do with frames that hold the same measurement in two runs: they would count twice.
        `merge_runs` can also drop them.

    Returns
    -------
    Calibration
        ``method`` is ``merged``, the covariance is that of the efficient estimator, and
        `consistency_of` gives the comparison of the runs.

    Raises
    ------
    CalibrationError
        For runs that cannot be merged: other camera, other kind of noise, shared data, unsound
        estimates, a shift of more than `MAX_DISTANCE` sigmas, or, unless allowed, significantly
        different cameras.
    RepeatedFramesError
        For runs with the same measurements, unless they are kept.
    """
    began = perf_counter()
    names = [f"run {i}" for i in range(1, len(calibrations) + 1)] if names is None else list(names)
    check_mergeable(calibrations, names, noise, duplicates)
    if any(cal.partitions is not None for cal in calibrations):
        # What a run of partitions holds is a sample of its frames, which does not add up with the
        # frames of others.
        nothing: AnyDict = {
            "frame_ids": np.zeros(0, dtype=np.int64),
            "quaternions": np.zeros((0, 4)),
        }
        nothing |= {"residuals_px": np.zeros((0, 2)), "fingerprints": None, "partitions": None}
        calibrations, observations = [replace(cal, **nothing) for cal in calibrations], None
    marks = _fingerprints(calibrations, observations)
    unchecked = [name for name, mark in zip(names, marks, strict=True) if mark is None]
    if duplicates == "refuse":
        refuse_shared(calibrations, marks, names)
    runs = [optimum(cal.compressed) for cal in calibrations]
    noise = merging_noise(calibrations, noise)
    units = [run.sigma if noise == "own" else 1.0 for run in runs]
    parts = [scaled(cal.compressed, unit) for cal, unit in zip(calibrations, units, strict=True)]
    best = optimum(total(parts))
    sigma_name = sigma_parameter(True).name if noise == "own" else calibrations[0].sigma_name
    found = consistency_between(
        names, calibrations[0].parameter_names, runs, best, noise, unchecked
    )
    if len({cal.sigma_name for cal in calibrations}) > 1:
        found = replace(found, noise_p_value=float("nan"))
    _check_consistent(found, allow_inconsistent)
    theta = best.theta - 0.5 * best.compressed.whitening @ best.compressed.log_determinant_slope
    stage = Stage(
        "merging",
        best.trajectory,
        best.cost,
        Status.CONVERGED,
        len(best.cost),
        perf_counter() - began,
    )
    frame_ids, shifts = renumbered([cal.frame_ids for cal in calibrations])
    quaternions, residuals = _frames(calibrations, observations, theta)
    frames = np.array([cal.n_frames for cal in calibrations], dtype=np.float64)
    pair_theta, pair_covariance = combined(
        [cal.pair_theta for cal in calibrations], [cal.pair_covariance for cal in calibrations]
    )
    unit_noise = [
        cal.attitude_noise * (u / cal.sigma) ** 2
        for cal, u in zip(calibrations, units, strict=True)
    ]
    marked = None
    if not unchecked:
        marked = Fingerprints.joined([mark for mark in marks if mark is not None])
    record = _provenance(calibrations, observations, names, noise, found, shifts, runs)
    return Calibration.of(
        calibrations[0].nominal,
        KeptFrames(frame_ids, quaternions, residuals, marked, noise == "own", None),
        {"method": "merged", "solver": "newton"},
        theta=theta,
        sigma=best.sigma,
        dof=best.dof,
        status=Status.CONVERGED,
        record=record,
        covariance=best.covariance,
        sigma_name=sigma_name,
        stages=(stage,),
        chi2=float(best.compressed.sum_of_squares(best.compressed.whiten(theta))[0]),
        information=best.information,
        rotation_per_theta=np.average(
            [cal.rotation_per_theta for cal in calibrations], axis=0, weights=frames
        ),
        attitude_noise=np.average(unit_noise, axis=0, weights=frames) * best.sigma**2,
        pair_theta=pair_theta,
        pair_covariance=pair_covariance,
        compressed=best.compressed,
    )


def merging_noise(calibrations: Sequence[Calibration], noise: str) -> str:
    """``common`` or ``own``: as given, or as the runs' noises need it where that is ``auto``."""
    if noise != "auto":
        return noise
    one_kind = len({cal.sigma_name for cal in calibrations}) == 1
    # Where noises differ unnoticed, the common one costs weight, not coverage: the covariance from
    # the mean square of all residuals is right where runs have their share of the information by
    # their share of the stars.
    equal = one_kind and _bartlett([optimum(cal.compressed) for cal in calibrations]) >= ALPHA
    return "common" if equal else "own"


def _fingerprints(
    calibrations: Sequence[Calibration], observations: Observations | None
) -> list[Fingerprints | None]:
    """Those of each run; of runs that lack them, from the rows of all runs, which stand one after
    the other.
    """
    if observations is None or len(observations) != sum(
        len(cal.residuals_px) for cal in calibrations
    ):
        return [cal.fingerprints for cal in calibrations]
    ends = np.cumsum([0, *(len(cal.residuals_px) for cal in calibrations)])
    place = np.arange(len(observations))
    return [
        cal.fingerprints
        or fingerprints_of(cal, observations.select((place >= first) & (place < last)))
        for cal, first, last in zip(calibrations, ends[:-1], ends[1:], strict=True)
    ]


def refuse_shared(
    calibrations: Sequence[Calibration], marks: Sequence[Fingerprints | None], names: Sequence[str]
) -> None:
    """Raise for the first two runs that hold the same measurements."""
    for (i, first), (j, later) in combinations(enumerate(marks), 2):
        pairs = np.empty((0, 2)) if first is None or later is None else shared(first, later)
        if len(pairs):
            ids = np.column_stack(
                [calibrations[i].frame_ids[pairs[:, 0]], calibrations[j].frame_ids[pairs[:, 1]]]
            )
            facts = {
                "names": (names[i], names[j]),
                "frames": ids[0],
                "more": len(np.unique(pairs[:, 1])) - 1,
                "n_frames": calibrations[j].n_frames,
            }
            raise RepeatedFramesError(clause(Apart.SHARED, **facts), pairs=ids.tolist())


def renumbered(frame_ids: Sequence[IntArray]) -> tuple[IntArray, list[int]]:
    """Frame numbers of all runs in a row, and what was added to those of each run.

    The numbers of the first run stay; those of each further run are shifted to follow the ones
    before.
    """
    shifts, following = [], None
    for ids in frame_ids:
        if not len(ids):
            # Of a run that has kept no frames.
            shifts.append(0)
            continue
        shifts.append(0 if following is None else following - int(ids.min()))
        following = int(ids.max()) + shifts[-1] + 1
    return np.concatenate(
        [ids + shift for ids, shift in zip(frame_ids, shifts, strict=True)]
    ), shifts


def check_mergeable(
    calibrations: Sequence[Calibration],
    names: Sequence[str],
    noise: str,
    duplicates: str = "refuse",
) -> None:
    """Refuse runs that cannot be merged, whatever their estimates."""
    check_duplicates(duplicates)
    check_known("noise", noise, NOISES, CalibrationError)
    if len(calibrations) < 2:
        raise CalibrationError("merging needs at least two runs: name another.")
    if len(names) != len(calibrations):
        raise CalibrationError(
            f"{len(names)} names were given for {len(calibrations)} runs: give one for each."
        )
    first = calibrations[0]
    seen: dict[str, str] = {}
    for cal, name in zip(calibrations, names, strict=True):
        if not cal.status.ok:
            raise CalibrationError(
                f"{name}: the calibration did not converge ({cal.status.name}): {cal.remedy}."
            )
        for what in ("width_px", "height_px", "pixel_um", "distortion"):
            ours, theirs = getattr(first.camera, what), getattr(cal.camera, what)
            if ours != theirs:
                raise CalibrationError(
                    f"{name}: {what} is {theirs}, but {ours} in {names[0]}: only runs of the "
                    "same detector and "
                    "distortion model can be merged; calibrate again with the same camera file."
                )
        if noise == "common" and cal.sigma_name != first.sigma_name:
            raise CalibrationError(
                f"{name}: the noise is {cal.sigma_name!r}, but {first.sigma_name!r} in "
                f"{names[0]}: merge with noise "
                "'own', which states each run's noise."
            )
        if cal.has_tails:
            raise CalibrationError(
                f"{name}: was calibrated with the likelihood 'student_t', which does not add up in "
                "compressed form: calibrate it with the marginal likelihood, or calibrate all "
                "observations together."
            )
        if fitted := cal.known_effects.fitted:
            held = ", ".join(effect.name for effect in fitted)
            raise CalibrationError(
                f"{name}: holds effects ({held}), whose scales and coefficients all runs share, "
                "and its likelihood has integrated them: calibrate the observations of all runs "
                "together with these effects (sc.runs.join_observations makes one table of "
                "theirs), or calibrate each run without any (--effects none) and merge those."
            )
        if cal.ties is not None:
            raise CalibrationError(
                f"{name}: holds known rotations between its frames, and attitudes of a merged run "
                "are free: calibrate all observations together with them, or calibrate it without."
            )
        for value in data_hashes(cal.provenance) if duplicates == "refuse" else ():
            if value in seen:
                raise CalibrationError(
                    f"{name}: holds the same observations as {seen[value]}, which would count "
                    "twice: leave one out."
                )
            seen[value] = name


def _check_consistent(consistency: Consistency, allow_inconsistent: bool) -> None:
    worst = int(np.argmax(consistency.distance_sigma))
    if consistency.distance_sigma[worst] > MAX_DISTANCE:
        raise CalibrationError(
            f"{consistency.names[worst]}: its optimum is {consistency.distance_sigma[worst]:.1f} "
            "of its own sigmas "
            f"from the merged one, beyond the {MAX_DISTANCE:g} within which its compressed "
            "likelihood holds (p = "
            f"{consistency.p_value:.2g} that the runs show the same camera): leave it out, or "
            "calibrate all "
            "observations together.",
            Status.INCONSISTENT,
        )
    if consistency.p_value < ALPHA and not allow_inconsistent:
        raise CalibrationError(
            f"the runs do not show the same camera (p = {consistency.p_value:.2g}; "
            f"{consistency.odd_one_out}): merge "
            "only runs between which nothing has moved, or allow inconsistent runs, whose sigmas "
            "are then too small.",
            Status.INCONSISTENT,
        )


def _frames(
    calibrations: Sequence[Calibration], observations: Observations | None, theta: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Quaternions (K, 4) and residuals (N, 2): at theta where the stars are known, else those of
    the runs.
    """
    if observations is None:
        return (
            np.concatenate([cal.quaternions for cal in calibrations]),
            np.concatenate([cal.residuals_px for cal in calibrations]),
        )
    likelihood = MarginalLikelihood(observations, calibrations[0].camera.distortion)
    state, _ = likelihood.profile(theta)
    return rotation_to_quaternion(state.rotations), likelihood.frames.in_pixels(state.e).T


def _provenance(
    calibrations: Sequence[Calibration],
    observations: Observations | None,
    names: Sequence[str],
    noise: str,
    consistency: Consistency,
    shifts: Sequence[int],
    runs: Sequence[Optimum],
) -> Provenance:
    parts: list[AnyDict] = [
        {
            "name": name,
            "n_frames": cal.n_frames,
            "n_stars": cal.n_stars,
            "sigma": run.sigma,
            "frame_shift": shift,
            "data_sha256": sorted(data_hashes(cal.provenance)),
        }
        for name, cal, shift, run in zip(names, calibrations, shifts, runs, strict=True)
    ]
    if observations is None:
        together = "".join(value for part in parts for value in part["data_sha256"])
        data_hash = hashlib.sha256(together.encode()).hexdigest()
    else:
        data_hash = observations.data_hash
    settings = {"method": "merged", "noise": noise, "distortion": calibrations[0].camera.distortion}
    record = {
        "parts": parts,
        "has_observations": observations is not None,
        "consistency": to_plain(consistency, null=True),
    }
    return provenance(None, settings, data_hash).adding(merge=record)


# Below this probability, chance is no explanation that a mission would accept.
ALPHA = 1e-3


@dataclass(frozen=True, eq=False)
class Consistency(Shown):
    """Comparison of R runs with what they give together.

    Attributes
    ----------
    names : tuple of str
        The runs.
    parameter_names : tuple of str
        The p camera parameters.
    statistic : float
        F.
    dof : (int, float)
        Degrees of freedom of the statistic: (R - 1) p, and those that the runs' noise estimates
        leave it.
    p_value : float
        Probability of a larger F if all runs show the same camera.
    distance_sigma : array (R,)
        Distance of each run's optimum from the merged one, in that run's own sigmas (Mahalanobis).
    run_p_value : array (R,)
        Probability of a larger deviation of the run from all others, if it shows the same camera.
    z : array (R, p)
        Deviation of each parameter of the run from the merged one, in units of the deviation's
        standard deviation.
    sigma : array (R,)
        Noise of each run.
    noise_p_value : float
        Probability of noises that differ as much, if they are the same; NaN where they are of
        different kinds.
    messages : tuple of str
        Sentences on what deserves attention.
    """

    names: tuple[str, ...]
    parameter_names: tuple[str, ...]
    statistic: float
    dof: tuple[int, float]
    p_value: float
    distance_sigma: FloatArray
    run_p_value: FloatArray
    z: FloatArray
    sigma: FloatArray
    noise_p_value: float
    messages: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """True if nothing deserves attention: neither cameras nor noises differ, and all frames
        could be compared.
        """
        return not self.messages

    @property
    def odd_one_out(self) -> str:
        """The run that deviates most, in words."""
        run = int(np.argmin(self.run_p_value))
        # Jointly: strongly coupled parameters can each stay within their sigma while their
        # combination does not.
        return clause(Apart.ODD, name=self.names[run], distance_sigma=self.distance_sigma[run])

    def to_dataframe(self) -> pd.DataFrame:
        """One row per run: noise, distance, probability, and the deviation of every parameter in
        sigmas.
        """
        import pandas as pd

        table = pd.DataFrame(
            {
                "run": self.names,
                "sigma": self.sigma,
                "distance_sigma": self.distance_sigma,
                "p_value": self.run_p_value,
            }
        )
        for i, name in enumerate(self.parameter_names):
            table[f"z_{name}"] = self.z[:, i]
        return table


def consistency_of(calibration: Calibration) -> Consistency | None:
    """The comparison stored with a merged calibration; None for one that was not merged."""
    record = calibration.provenance.merge
    return from_plain(Consistency, record["consistency"]) if record else None


def consistency_between(
    names: Sequence[str],
    parameter_names: Sequence[str],
    runs: Sequence[Optimum],
    merged: Optimum,
    noise: str,
    unchecked: Sequence[str] = (),
) -> Consistency:
    """Compare the optima of runs with each other and with the merged one.

    Every run is weighed by its own noise, however they are merged: what differs by noise is then no
    sign of another camera. `noise` is how they are merged, and `unchecked` names runs that may
    share frames with others.
    """
    p = len(merged.theta)
    weighed = optimum(total([scaled(run.compressed, run.sigma) for run in runs]))
    square = max(weighed.sum_of_squares - sum(run.dof for run in runs), 0.0)
    scale = correlation_of(weighed.covariance)[1]
    information = np.array([run.information for run in runs]) * np.outer(scale, scale)
    together = np.linalg.inv(information.sum(axis=0))
    dof = np.array([run.dof for run in runs], dtype=np.float64)
    statistic, second, p_value = welch_james(square, information, dof)
    distance, run_p, z = [], [], []
    for i, run in enumerate(runs):
        away = (run.theta - merged.theta) / scale
        distance.append(float(np.sqrt(away @ information[i] @ away)))
        shift = (run.theta - weighed.theta) / scale
        # The covariance of a difference from a mean it is part of is the difference.
        difference = np.linalg.inv(information[i]) - together
        others = np.delete(np.arange(len(runs)), i)
        share = np.array([np.trace(together @ information[j]) for j in others])
        rest = 1.0 / float(np.sum((share / share.sum()) ** 2 / dof[others]))
        alone = np.array([information[i], information[others].sum(axis=0)])
        distant = float(shift @ np.linalg.solve(difference, shift))
        run_p.append(welch_james(max(distant, 0.0), alone, np.array([dof[i], rest]))[2])
        z.append(shift / root_diagonal(difference))
    found = Consistency(
        names=tuple(names),
        parameter_names=tuple(parameter_names),
        statistic=statistic,
        dof=((len(runs) - 1) * p, second),
        p_value=p_value,
        distance_sigma=np.array(distance),
        run_p_value=np.array(run_p),
        z=np.array(z),
        sigma=np.array([run.sigma for run in runs]),
        noise_p_value=_bartlett(runs),
        messages=(),
    )
    return _with_messages(found, noise, unchecked)


def welch_james(
    square: float, information: FloatArray, dof: FloatArray
) -> tuple[float, float, float]:
    """F, its second degrees of freedom, and p of R estimates weighed by their own estimated noises.

    The statistic ``sum (theta_i - mean)^T I_i (theta_i - mean)`` is a chi-square with q = (R - 1) p
    degrees of freedom where the noises are known. Of noises with nu_i degrees of freedom its mean
    is q + 2 A and its variance 2 q + 12 A + 2 B to first order in 1 / nu, with A = sum tr((1 -
    G_i)^2) / nu_i, B = sum tr(1 - G_i)^2 / nu_i and G_i the share of run i in the whole
    information. c F with q and q (q + 2) / (2 A + B) degrees of freedom has the same mean and
    variance; for one parameter this is the test of Welch (1951), and for p > 1 it is to unknown
    scalars what James (1954) and Johansen (1980) are to unknown matrices.

    `information` (R, p, p): information of each estimate at its own noise.
    `dof` (R,): degrees of freedom of each noise.
    """
    from scipy.special import fdtrc

    n, p = information.shape[:2]
    q = (n - 1) * p
    lost = np.eye(p) - np.linalg.solve(information.sum(axis=0), information)
    a = float(np.sum(np.einsum("rij,rji->r", lost, lost) / dof))
    b = float(np.sum(np.einsum("rii->r", lost) ** 2 / dof))
    second = q * (q + 2.0) / (2.0 * a + b)
    f = square / (q + 2.0 * a - 2.0 * q / second)
    return float(f), float(second), float(fdtrc(q, second, f))


def _with_messages(consistency: Consistency, noise: str, unchecked: Sequence[str]) -> Consistency:
    noisy = noise == "common" and consistency.noise_p_value < ALPHA
    rows = (
        (consistency.p_value < ALPHA, Apart.CAMERAS),
        (noisy, Apart.NOISES),
        (bool(unchecked), Apart.UNCHECKED),
    )
    messages = [clause(code, it=consistency, unchecked=unchecked) for holds, code in rows if holds]
    return replace(consistency, messages=tuple(messages))


def _bartlett(runs: Sequence[Optimum]) -> float:
    """p-value of Bartlett's test (1937) that all runs have the same noise."""
    from scipy.special import chdtrc

    dof = np.array([run.dof for run in runs], dtype=np.float64)
    variance = np.array([run.sigma**2 for run in runs])
    pooled = float(dof @ variance / dof.sum())
    statistic = float(dof.sum() * np.log(pooled) - dof @ np.log(variance))
    correction = 1.0 + (np.sum(1.0 / dof) - 1.0 / dof.sum()) / (3.0 * (len(runs) - 1))
    return float(chdtrc(len(runs) - 1, max(statistic, 0.0) / correction))
