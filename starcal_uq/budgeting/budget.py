"""The mission error budget: what the calibration contributes, what the user knows, and what nobody
has assessed.

Rows that the posterior knows are filled from it, and inflated where the tests of the model demand
it. The others come from the user's file, or read "not assessed": they are never taken for zero, and
the totals then say "at least".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.budgeting.behaviour import Behaviour
from starcal_uq.budgeting.file import BudgetFile, Requirement, checked_confidence, stated_in
from starcal_uq.budgeting.filters import filter_states
from starcal_uq.budgeting.indices import Behaviours, Index, seen_by
from starcal_uq.budgeting.posterior import (
    alignment_rows,
    effect_rows,
    misfit_notes,
    posterior_rows,
    stated_instead,
)
from starcal_uq.budgeting.result import Budget, Outcome, by_contributor, judge
from starcal_uq.budgeting.rows import (
    AXIS_LABELS,
    FROM_FILE,
    NEA,
    OF_EFFECTS,
    REST,
    UNTESTED,
    Contributor,
    Expected,
    Remark,
    not_assessed,
)
from starcal_uq.budgeting.sampling import N_SAMPLES
from starcal_uq.budgeting.totals import Total, totals
from starcal_uq.budgeting.tracker import sensor_rows
from starcal_uq.core.constants import AXES, INTERACTION
from starcal_uq.core.errors import BudgetError
from starcal_uq.core.findings import clause
from starcal_uq.core.formatting import join_words
from starcal_uq.core.provenance import provenance
from starcal_uq.core.settings import Seed, bounded, check_memory, seed_of
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.types import AnyDict, PathLike
from starcal_uq.propagation.thermal import thermal_error

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.diagnostics.diagnose import Diagnosis
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.table import Observations
    from starcal_uq.propagation.attitude_error import AttitudeError
    from starcal_uq.propagation.spectrum import ErrorSpectrum
    from starcal_uq.propagation.thermal import TemperatureProfile

_CONFIDENCE = 0.997
# A row of the file that may hold what effects fill rows with.
_DRIFT = "drift of focal length and distortion"
_OF_TIME_OR_WARMTH = [OF_EFFECTS[name].name for name in ("temperature", "time", "epoch")]


@bounded
@one_thread()
def budget(
    post: Posterior,
    obs: Observations,
    attitude: AttitudeError | None = None,
    *,
    file: BudgetFile | PathLike | None = None,
    confidence: float | None = None,
    misfit: Diagnosis | None = None,
    temperature_profile: TemperatureProfile | PathLike | None = None,
    spectrum: ErrorSpectrum | None = None,
    indices: Sequence[Index] = (),
    n_samples: int = N_SAMPLES,
    seed: Seed = 0,
) -> Budget:
    """Attitude error budget in the terms of ECSS-E-ST-60-20C, combined after ECSS-E-ST-60-10C and
    by sampling.

    Parameters
    ----------
    post : Posterior
        Posterior of the calibration.
    obs : Observations
        The frames it was made from.
    attitude : AttitudeError, optional
        The propagated posterior, over the mission's frames if they differ; over `obs` if it is left
        out.
    file : BudgetFile or path, optional
        The user's contributors and requirements.
    confidence : float, optional
        Probability of the totals; that of the file, or 0.997. Requirements have their own.
    misfit : Diagnosis, optional
        The tests of the model (`starcal_uq.diagnose`), for an attitude error that does not hold
        what they found.
    temperature_profile : TemperatureProfile or path, optional
        Temperatures of the optics over an orbit, from which the row *thermo-elastic of the optics*
        is filled; those with which `attitude` was propagated by default.
    spectrum : ErrorSpectrum, optional
        Spectrum of the calibration's error along an attitude profile, from which indices know how
        *calibration, rest* and the centroid noise behave in time.
    indices : sequence of Index
        Error indices beside those of the file.
    n_samples, seed : int
        Number and seed of the sampled totals.

    Raises
    ------
    BudgetError
        If the file is wrong, or the confidence is not between 0 and 1.
    AttitudeProfileError, CalibrationError
        If the temperature profile is wrong, or the calibration holds no effect of the temperature.
    """
    seed = seed_of(seed)
    if attitude is None:
        from starcal_uq.propagation.propagate import propagate

        attitude = propagate(post, obs)
    if temperature_profile is not None:
        thermal = thermal_error(attitude.thermal_response, temperature_profile)
        attitude = replace(attitude, thermal=thermal)
    stated = stated_in(file)
    chosen = confidence_of(stated, confidence, n_samples)
    if misfit is not None and attitude.misfit is None:
        from starcal_uq.diagnostics.found import with_misfit

        attitude = with_misfit(attitude, misfit, post, obs)
    untested = () if attitude.misfit is not None else (UNTESTED,)
    effects, replaced = stated_instead(effect_rows(attitude, post), stated.contributors)
    known = (*alignment_rows(attitude), *effects, *_of_sensor(stated, attitude, post, obs))
    filled = from_file(stated, (*untested, *FROM_FILE), known)
    # Effects stand beside the other rows of the calibration.
    ours = {row.name for row in effects} - {entry.name for entry in FROM_FILE}
    beside = tuple(row for row in filled if row.name in ours)
    rows = (
        *posterior_rows(attitude, post),
        *beside,
        *(row for row in filled if row.name not in ours),
    )
    behaviours = in_time(rows, stated, post.camera, spectrum)
    rows = tuple(_described(row, behaviours, stated.rate_deg_s) for row in rows)
    combined = combination(rows, stated, behaviours, chosen, n_samples, seed, indices)
    settings: AnyDict = {
        "confidence": chosen,
        "n_samples": n_samples,
        "file": stated.path,
        "alignment": attitude.alignment,
    }
    if attitude.thermal is not None:
        settings["temperature_profile"] = attitude.thermal.profile.name
    if stated.frames:
        settings["frames"] = {name: rotation.tolist() for name, rotation in stated.frames.items()}
    return Budget(
        **combined,
        title=stated.title or "Attitude error budget",
        notes=(
            f"After alignment: an alignment calibration on {attitude.alignment}.",
            *misfit_notes(attitude),
            *_effect_notes(effects, replaced, stated),
            *row_notes(rows),
        ),
        provenance=provenance(seed, settings, post.provenance.data_sha256),
        document=stated.document,
        configuration={
            "camera": post.calibrated_camera.to_dict(),
            "effects": [] if post.effects is None else list(post.effects.names),
            "n_frames": obs.n_frames,
            "n_stars": obs.n_stars,
        },
    )


def _of_sensor(
    stated: BudgetFile, attitude: AttitudeError, post: Posterior, obs: Observations
) -> tuple[Contributor, ...]:
    """Rows of the sensor of a file, at the rate that the file states or its own."""
    sensor = stated.sensor
    if sensor is None:
        return ()
    if stated.rate_deg_s is not None:
        sensor = sensor.replace(rate_deg_s=stated.rate_deg_s)
    frames = obs if attitude.seen is None else attitude.seen
    return sensor_rows(sensor, post.calibrated_camera, frames, stated.sensor_path)


def confidence_of(stated: BudgetFile, confidence: float | None, n_samples: int) -> float:
    """The confidence of totals, of which so many samples are to say something."""
    chosen = confidence if confidence is not None else stated.confidence
    chosen = checked_confidence(
        _CONFIDENCE if chosen is None else chosen, "the confidence of the budget"
    )
    if n_samples < 10_000:
        raise BudgetError(
            f"n_samples is {n_samples}, too few for the tails of an error; use at least 10000."
        )
    check_memory(f"n_samples={n_samples}", 8.0 * 12 * n_samples)
    return chosen


def combination(
    rows: tuple[Contributor, ...],
    stated: BudgetFile,
    behaviours: Behaviours,
    confidence: float,
    n_samples: int,
    seed: int,
    indices: Sequence[Index] = (),
) -> AnyDict:
    """Totals of rows and indices, and the requirements of a file: fields of a `Budget`."""
    index_totals: list[Total] = []
    outcomes: dict[Requirement, Outcome] = {}
    asked = (Index("AKE"), *indices, *stated.indices, *(one.limited for one in stated.requirements))
    for label, index in {index.label: index for index in asked}.items():
        seen, at_most = seen_by(index, rows, behaviours)
        made, samples = totals(
            *(seen, confidence), of_index=label, at_most=at_most, n_samples=n_samples, seed=seed
        )
        index_totals += made
        limits = [one for one in stated.requirements if one.limited.label == label]
        judged = judge(limits, seen, samples, stated.frames, at_most)
        outcomes |= dict(zip(limits, judged, strict=True))
    return {
        "rows": rows,
        "totals": tuple(entry for entry in index_totals if entry.of_index == "AKE"),
        "outcomes": tuple(outcomes[one] for one in stated.requirements),
        "confidence": confidence,
        "index_totals": tuple(entry for entry in index_totals if entry.of_index != "AKE"),
        "filter": filter_states(rows, behaviours),
    }


def in_time(
    rows: Sequence[Contributor],
    stated: BudgetFile,
    camera: Camera,
    spectrum: ErrorSpectrum | None,
) -> dict[tuple[str, str], Behaviour]:
    """Behaviour in time of the rows: as stated, from the spectrum, or by class and rate."""
    found = dict(stated.behaviours)
    step = stated.frame_seconds or (None if spectrum is None else spectrum.step_s)
    if step is not None:
        # What noise and calibration do together is as new in every frame as the noise.
        noise = Behaviour("white", step)
        found = {(name, axis): noise for name in (NEA, INTERACTION) for axis in AXES} | found
    if spectrum is not None:
        f = spectrum.frequency_hz
        for axis, density in zip(AXES, spectrum.psd_arcsec2_hz.T, strict=True):
            if np.any(density > 0.0):
                lines = Behaviour("series", spectrum.step_s, f, density * f[0])
                found.setdefault((REST, axis), lines)
    rate = stated.rate_deg_s
    if rate is None:
        return found
    extent_deg = {
        "FOV spatial": float(max(camera.fov_deg)),
        "pixel spatial": float(np.degrees(1.0 / camera.focal_px)),
    }
    for row in rows:
        if row.interpretation == "mixed" and row.ecss_class in extent_deg:
            crossing = Behaviour("constant")
            if rate > 0.0:
                crossing = Behaviour("periodic", extent_deg[row.ecss_class] / rate)
            found.setdefault((row.name, row.axis), crossing)
    return found


def _described(row: Contributor, behaviours: Behaviours, rate_deg_s: float | None) -> Contributor:
    """A row with its behaviour in time; at rest, a spatial error is a bias."""
    behaviour = behaviours.get((row.name, row.axis))
    if behaviour is None:
        return row
    if rate_deg_s == 0.0 and behaviour.kind == "constant" and row.interpretation == "mixed":
        row = replace(row, ecss_class="bias", interpretation="ensemble")
    return replace(row, behaviour=behaviour.text)


def from_file(
    stated: BudgetFile, expected: tuple[Expected, ...], known: tuple[Contributor, ...]
) -> tuple[Contributor, ...]:
    """Expected contributors as the file states them, as known without it, or not assessed; then the
    user's own.

    Each is there on three axes.
    """
    given = {(row.name, row.axis): row for row in (*known, *stated.contributors)}
    rows = [
        given.pop((entry.name, axis), not_assessed(entry, axis))
        for entry in expected
        for axis in AXES
    ]
    for name in dict.fromkeys(name for name, _ in given):
        first = next(row for row in given.values() if row.name == name)
        rows += [given.get((name, axis), _silent(first, axis)) for axis in AXES]
    return tuple(rows)


def _silent(stated: Contributor, axis: str) -> Contributor:
    """A contributor of the user's own on an axis that the file leaves out: not known, and so not
    zero.
    """
    return replace(
        stated,
        axis=axis,
        mean_arcsec=math.nan,
        sigma_arcsec=math.nan,
        correlation_group="",
        axis_correlation=(),
        conditions="",
        provenance="",
        source="not assessed",
        applies=True,
    )


def _effect_notes(
    effects: tuple[Contributor, ...], replaced: tuple[Contributor, ...], stated: BudgetFile
) -> tuple[str, ...]:
    """What the file states in place of computed rows, and what may be stated twice."""
    notes = []
    for name, axes in by_contributor(replaced).items():
        sizes = {
            AXIS_LABELS[axis]: math.hypot(row.mean_arcsec, row.sigma_arcsec)
            for axis, row in axes.items()
        }
        notes.append(clause(Remark.REPLACED, name=name, sizes_arcsec=sizes))
    computed = {row.name for row in effects if row.applies} & set(_OF_TIME_OR_WARMTH)
    if computed and any(row.name == _DRIFT and row.applies for row in stated.contributors):
        notes.append(clause(Remark.TWICE, name=_DRIFT, computed=sorted(computed)))
    return tuple(notes)


def row_notes(rows: tuple[Contributor, ...]) -> tuple[str, ...]:
    """What rows leave open, and what alignment absorbs in part."""
    part = [row.name for row in rows if row.absorbed_by_alignment == "in part" and row.assessed]
    named = {
        Remark.NOT_ASSESSED: _missing(rows),
        Remark.IN_PART: tuple(dict.fromkeys(part)),
    }
    return tuple(clause(code, names=names) for code, names in named.items() if names)


def _missing(rows: tuple[Contributor, ...]) -> tuple[str, ...]:
    """Contributors that are not assessed, with the axes where they are so on some only."""
    names = []
    for name, axes in by_contributor(rows).items():
        absent = [axis for axis, row in axes.items() if not row.assessed]
        if absent:
            some = (
                ""
                if len(absent) == len(axes)
                else f" (in {join_words([AXIS_LABELS[axis] for axis in absent])})"
            )
            names.append(name + some)
    return tuple(names)
