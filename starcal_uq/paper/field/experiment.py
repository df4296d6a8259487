"""`field_experiment`: the paper's field experiment by simulation, from rendered frames to its Table
3.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.files import atomic_write_text
from starcal_uq.core.manifest import making
from starcal_uq.core.provenance import provenance
from starcal_uq.core.settings import Seed, seed_of
from starcal_uq.core.store import Kept
from starcal_uq.core.types import AnyDict, FloatArray, PathLike, Progress
from starcal_uq.paper.commands import Bar, write_tables
from starcal_uq.paper.field.attitudes import (
    Repetition,
    attitude_errors,
    identified_stars,
    replicate_field,
)
from starcal_uq.paper.field.frames import (
    WRONG_PX,
    FieldFrames,
    FieldIdentification,
    identify_all,
    take_frames,
    true_pixels,
)
from starcal_uq.paper.field.published import (
    FIELD_CAMERAS,
    NOMINAL_FOCAL_MM,
    OTHER_NOMINAL_FOCAL_MM,
    READINGS,
    TRUE_CAMERA,
    UNCALIBRATED,
    FieldReading,
)
from starcal_uq.paper.field.result import FIELD_REPORT, FieldExperiment
from starcal_uq.paper.published import PAPER_METHODS
from starcal_uq.paper.show.pages import field_figures, field_page
from starcal_uq.pipeline.refine import identify_and_calibrate
from starcal_uq.sky.catalogue import load_catalogue
from starcal_uq.sky.neighbours import without_disturbed

if TYPE_CHECKING:
    from starcal_uq.observations.table import Observations
    from starcal_uq.pipeline.refine import ImageCalibration
    from starcal_uq.sky.catalogue import StarCatalogue

# What the camera may misplace a star by in the corner of the field. A star tracker in flight takes
# its calibration for right, and allows for little more than noise.
TOLERANCE_PX = 0.5
TOLERANCES_PX = (0.1, 0.2, TOLERANCE_PX, 1.0, 2.0, 5.0)
# Identified with stars down to so much beyond the limit.
_CATALOGUE_MORE_MAG = 1.0
# The first identification knows the data sheet only: the principal point within a tenth of the
# detector.
_FIRST_TOLERANCES = {
    "focal_tolerance": 0.03,
    "centre_tolerance_px": 150.0,
    "distortion_tolerance_px": 5.0,
}
_N_REPLICATES = 100
_LEAST = 20
# Work of each part in common units, for the progress bar.
_SHARES = {"frames": 45, "identification": 35, "replicates": 15, "report": 5}


def field_experiment(
    out: PathLike,
    *,
    n_frames: int = 200,
    n_calibration_frames: int = 200,
    reading: str = "window",
    seed: Seed = 2017,
    n_replicates: int = _N_REPLICATES,
    workers: int | None = None,
    progress: Progress | None = None,
    force: bool = False,
) -> FieldExperiment:
    """Simulate the field experiment of Ye & Yang 2017 and set its Table 3 beside the outcome.

    Frames of their field unit are rendered, searched for stars and identified. Some calibrate the
    sensor by three methods; the others are identified and solved by QUEST with the uncalibrated
    sensor, the three calibrations, and the truth as a control.

    `out`: folder to write: ``field.html`` (self-contained), the tables of `FieldExperiment.tables`
    as CSV, and the
        figures as PNG in ``figures``, when everything is computed. Until then what is done is kept
        in the folder, and an interrupted call resumes from it.
    `n_frames`, `n_calibration_frames`, `n_replicates`: frames of the test, of which the paper has
    200, and of the
        calibration, of which it does not say; repetitions with other noise, from which the ranges
        of the errors come. Each at least 20.
    `reading`: how the printed sensor is read (`READINGS`).
    """
    seed = seed_of(seed)
    if reading not in READINGS:
        raise CalibrationError(
            f"reading {reading!r} of the field unit is unknown: use one of {', '.join(READINGS)}."
        )
    sizes = {
        "n_frames": n_frames,
        "n_calibration_frames": n_calibration_frames,
        "n_replicates": n_replicates,
    }
    for name, number in sizes.items():
        if number < _LEAST:
            raise CalibrationError(
                f"{name} is {number}: the field experiment needs at least {_LEAST}."
            )
    bar = Bar(progress, _SHARES)
    with making(out, "reproduce-field", FIELD_REPORT, force=force) as stage:
        experiment = _experiment(
            Path(out),
            n_frames,
            n_calibration_frames,
            READINGS[reading],
            seed,
            n_replicates,
            workers,
            bar,
        )
        figures = field_figures(experiment)
        page = field_page(experiment, figures)
        write_tables(stage, experiment.tables(), figures)
        atomic_write_text(stage / FIELD_REPORT, page)
    bar.finish("report")
    return experiment


def _experiment(
    folder: Path,
    n_frames: int,
    n_calibration_frames: int,
    sensor: FieldReading,
    seed: int,
    n_replicates: int,
    workers: int | None,
    bar: Bar,
) -> FieldExperiment:
    """All numbers; frames, identifications and repetitions that are done are kept in the folder."""
    stars = load_catalogue(max_mag=sensor.limit_mag + _CATALOGUE_MORE_MAG)
    made_of = ["field", sensor.name, n_calibration_frames, n_frames, seed, stars.source]
    taken = take_frames(
        sensor, n_calibration_frames + n_frames, seed, workers, bar.part("frames"), keep=folder
    )
    campaign = taken.part(0, n_calibration_frames)
    frames = taken.part(n_calibration_frames, len(taken.rotations))
    found, counts = _campaign(campaign, sensor, stars)
    calibrations = {
        name: calibrate(found.observations, sensor.nominal(), method=name) for name in PAPER_METHODS
    }
    cameras = {
        UNCALIBRATED: sensor.nominal().replace(distortion="none"),
        **{name: cal.camera for name, cal in calibrations.items()},
        TRUE_CAMERA: sensor.truth,
    }
    sheets = {f: sensor.nominal(f).replace(distortion="none") for f in OTHER_NOMINAL_FOCAL_MM}
    # The long ones first, so that no process waits for another at the end.
    jobs: list[tuple[Camera, float]] = [(camera, TOLERANCE_PX) for camera in sheets.values()]
    named = [(name, tolerance) for name in FIELD_CAMERAS for tolerance in TOLERANCES_PX]
    jobs += [(cameras[name], tolerance) for name, tolerance in named]
    kept = Kept(folder, [*made_of, jobs], (FieldIdentification, Camera))
    results = identify_all(
        frames, sensor.truth, stars, jobs, workers, bar.part("identification"), kept
    )
    sweep = dict(zip(named, results[len(sheets) :], strict=True))
    seen = {
        name: identified_stars(frames, sensor.truth, stars, sweep[name, TOLERANCE_PX])
        for name in FIELD_CAMERAS
    }
    tests = {name: chosen for name, chosen in seen.items() if chosen is not None}
    data_sheets = {}
    for focal_mm, result in zip(sheets, results, strict=False):
        chosen = identified_stars(frames, sensor.truth, stars, result)
        data_sheets[focal_mm] = (
            result,
            None if chosen is None else attitude_errors(chosen, result.camera),
        )
    repetition = Repetition(
        campaign=found.observations,
        campaign_px=_true_campaign(campaign, found.observations, sensor.truth),
        scale=tests[TRUE_CAMERA].noise_scale,
        nominal=sensor.nominal(),
        tests=tests,
        cameras=cameras,
        seed=seed,
    )
    kept = Kept(folder, [*made_of, cameras])
    replicates = replicate_field(repetition, n_replicates, workers, bar.part("replicates"), kept)
    settings: AnyDict = {
        "reading": sensor.name,
        "n_frames": n_frames,
        "n_calibration_frames": n_calibration_frames,
    }
    settings |= {
        "tolerance_px": TOLERANCE_PX,
        "n_replicates": n_replicates,
        "nominal_focal_mm": NOMINAL_FOCAL_MM,
    }
    return FieldExperiment(
        path=folder,
        reading=sensor,
        tolerance_px=TOLERANCE_PX,
        frames=frames,
        calibrations=calibrations,
        cameras=cameras,
        campaign_counts=counts,
        sweep=sweep,
        data_sheets=data_sheets,
        stars=tests,
        errors={name: attitude_errors(chosen, cameras[name]) for name, chosen in tests.items()},
        replicates=replicates,
        provenance=provenance(seed, settings, found.observations.data_hash),
    )


def _campaign(
    frames: FieldFrames, reading: FieldReading, stars: StarCatalogue
) -> tuple[ImageCalibration, dict[str, int]]:
    """Identify the frames of the calibration from the data sheet; and how many of them it is."""
    nominal, width_px = reading.nominal(), reading.sensor.psf_sigma_px

    def prepare(obs: Observations) -> Observations:
        # Rendered stars are where the catalogue has them.
        return without_disturbed(obs.with_origin(directions="apparent"), stars, nominal, width_px)

    found = identify_and_calibrate(
        frames.centroids, nominal, stars, prepare=prepare, identification=_FIRST_TOLERANCES
    )
    obs = found.observations
    place = _true_campaign(frames, obs, reading.truth)
    wrong = int(np.sum(np.hypot(obs.x_px - place[:, 0], obs.y_px - place[:, 1]) > WRONG_PX))
    counts = {"frames": len(frames.rotations), "identified": found.identification.n_identified}
    return found, counts | {"stars": obs.n_stars, "wrong": wrong}


def _true_campaign(frames: FieldFrames, obs: Observations, truth: Camera) -> FloatArray:
    """Where the stars of observations truly are, (m, 2) px."""
    return true_pixels(truth, frames.rotations[obs.frame], obs.directions_icrs)
