"""The documents that commands print with ``--json``: what each holds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from starcal_uq.cli.results import (
    OWN,
    Attitude,
    Budget,
    Calibration,
    Consistency,
    Coupling,
    Frame,
    Inspected,
    Jackknifed,
    OfStars,
    Posterior,
    Screening,
)
from starcal_uq.core.documents import Number, Of, Part, says
from starcal_uq.core.types import AnyDict


class Simulate(Part):
    """Simulated stars."""

    table: str = says("Table, or folder of partitions")
    n_stars: int = says("Stars")
    n_frames: int = says("Frames")
    n_files: int = says("Files of the table")
    images: str | None = says("Folder of the images; null where none were asked for")
    n_images: int = says("Images")


class Centroid(Part):
    """Stars found in images."""

    table: str = says("Table of the centroids")
    frames: list[Frame] = says("Frames, those that cannot be used among them")
    text: str = says("What was found, in words")


class Identify(Part):
    """Identified stars of every frame."""

    table: str | None = says("Table of the stars; null where no frame is identified")
    frames: Annotated[
        list[Any],
        Of("identification.result:FrameIdentification"),
    ] = says("Frames, identified or not")
    text: str = says("What was identified, in words")


class Calibrate(Part):
    """A calibration."""

    run: str = says("Run folder")
    calibration: Calibration = says("The estimate")
    screening: Screening | None = says("Stars left out by --screen; null without it")


class Filter(Part):
    """A calibration frame by frame."""

    run: str = says("Run folder")
    history: str = says("Table of the estimates after every frame")
    calibration: Calibration = says("The last estimate")


class Merge(Part):
    """Several runs as one."""

    run: str = says("Run folder")
    calibration: Calibration = says("The estimate from all of them")
    consistency: Consistency | None = says(
        "Whether they show the same camera; null where that cannot be said"
    )


class Sample(Part):
    """A sampled posterior."""

    run: str = says("Run folder")
    posterior: Posterior = says("The posterior")


class Couple(Part):
    """What couples with what."""

    run: str = says("Run folder")
    coupling: Coupling = says("The couplings")


class Propagate(Part):
    """What a calibration does to attitudes."""

    run: str = says("Run folder")
    attitude: Attitude = says("Attitude errors")
    spectrum: str | None = says(
        "Spectrum of the errors along a profile, in words; null without a profile"
    )


class Diagnosis(Part):
    """What questions the model of a run."""

    misfit: Annotated[list[Any], Of("diagnostics.misfit:MisfitTest")] = says(
        "Tests for structure in the residuals"
    )
    jackknife: list[Jackknifed] = says(
        "Parameters by the scatter over frames; empty for fewer than three frames"
    )
    stars: list[OfStars] = says(
        "Parameters by the scatter over stars; empty where that is not known"
    )
    models: Annotated[list[Any], Of("diagnostics.models:ModelScore")] = says(
        "Distortion models, the best first; empty where none were compared"
    )
    predictive: Annotated[list[Any], Of("diagnostics.predictive:PredictiveStatistic")] = says(
        "Measured residuals against those that the model makes"
    )
    starts: Annotated[Any | None, Of("diagnostics.diagnose:MultiStart")] = says(
        "Fits from other starts; null where none were"
    )
    notes: list[str] = says("What follows, in words")

    @classmethod
    def take(cls, result: Any) -> Mapping[str, Any]:
        tables = {"jackknife": result.jackknife, "stars": result.stars}
        return {
            "misfit": result.misfit.tests,
            **{key: [] if part is None else part.to_dataframe() for key, part in tables.items()},
            "models": [] if result.comparison is None else result.comparison.scores,
            "predictive": result.predictive.statistics,
            "starts": result.starts,
            "notes": [part.text for part in (result.comparison, result.stars) if part is not None],
        }


class Diagnose(Part):
    """What questions the model of a run."""

    run: str = says("Run folder")
    diagnosis: Diagnosis = says("Tests and comparisons")


class Budgeted(Part):
    """An attitude error budget."""

    run: str = says("Run folder")
    files: list[str] = says("Files that hold it")
    template: str | None = says("Starter file that was written instead; null without --template")
    budget: Budget | None = says("The budget; null with --template")


class Report(Part):
    """A report."""

    run: str = says("Run folder")
    report: str = says("The page, or with --notebook the notebook")


class Inspect(Part):
    """Frames of a run."""

    run: str = says("Run folder")
    page: str = says("The page")
    frames: list[Inspected] = says("Frames that it shows")
    text: str = says("What became of all frames, in words")


class Export(Part):
    """A file for another program."""

    file: str = says("The file")
    to: str = says("Its format")
    error_px: Number = says(
        "Largest distance from the camera over the detector; null for a file without a camera"
    )
    text: str = says("What it holds and how near it is, in words")


class Run(Part):
    """A whole run."""

    run: str = says("Run folder")
    report: str = says("Its report")
    verdict: Annotated[Any, Of("diagnostics.verdict.judge:Verdict")] = says(
        "Whether its numbers may be used"
    )
    calibration: Calibration = says("The estimate")
    screening: Screening | None = says("Stars left out by --screen; null without it")
    posterior: Posterior = says("The posterior")
    coupling: Coupling = says("The couplings")
    attitude: Attitude = says("Attitude errors")
    budget: Budget = says("The error budget")


class Difference(Part):
    """One quantity in which two cameras differ."""

    quantity: str = says("Quantity")
    unit: str = says("Unit of its numbers")
    difference: Number = says("Second minus first", "that of the row")
    expected: Number = says(
        "Standard deviation, or for a map the root mean square, that the uncertainties give"
    )
    ratio: Number = says("Difference over expected")
    p_value: Number = says(
        "Probability of such a difference by chance; null where it is not tested by itself"
    )


class Compare(Part):
    """Two cameras."""

    page: str | None = says("The page; null without -o")
    verdict: str = says("agree, maps differ, parameters differ or not tested")
    agree: bool | None = says("Whether chance explains all; null where that was not tested")
    labels: list[str] = says("Names of the two")
    models: list[str] = says("Their distortion models")
    level: Number = says("Probability of a verdict of difference when nothing differs")
    rule: str = says("How the covariance of the difference comes about")
    p_map: Number = says("Probability of such a map by chance; null where that was not tested")
    p_parameters: Number = says(
        "Probability of such parameters by chance; null where that was not tested"
    )
    rotation_arcsec: list[Number] = says(
        "Rotation between the two, taken out, about the axes of the camera"
    )
    rotation_sigma_arcsec: list[Number] = says("Its standard deviations")
    differences: list[Difference] = says("What is left, and the parameters")
    x_px: list[Number] = says("Columns of the maps")
    y_px: list[Number] = says("Rows of the maps")
    difference_px: list[list[list[Number]]] = says("Map of the difference: rows, columns, x and y")
    sigma_arcsec: list[list[Number]] = says(
        "Map of the expected length of the difference: rows, columns"
    )
    messages: list[str] = says("What deserves attention")
    text: str = says("The verdict in words")
    provenance: AnyDict = says("Of both, and settings")


class Forecast(Part):
    """What a campaign of one size will give."""

    n_frames: int = says("Frames")
    sigma: dict[str, Number] = says(
        "Standard deviation by quantity, whose name ends in the unit; null: not determined"
    )
    noise_relative: Number = says("Relative standard error of the noise")
    radius_arcsec: Number = says("Two-axis error at the confidence")
    radius_low_arcsec: Number = says("Lower end of the range of 90 % of the campaigns")
    radius_high_arcsec: Number = says("Upper end")
    radius_least_arcsec: Number = says(
        "Least over the distortion that the sheet leaves open; null where it leaves none"
    )
    radius_most_arcsec: Number = says("Largest of these")


class Chosen(Part):
    """One frame that was chosen."""

    order: int = says("Place, the most valuable first")
    ra_deg: Number = says("Boresight, ICRS")
    dec_deg: Number = says("Boresight, ICRS")
    roll_deg: Number = says("Position angle of +Y, from north through east")
    qx: Number = says("Quaternion of R_cam_icrs, scalar last")
    qy: Number = says("The same")
    qz: Number = says("The same")
    qw: Number = says("The same")
    n_stars: int = says("Stars")
    score: Number = says(
        "What is left of the uncertainty with it and all before, as the criterion counts it"
    )


class Checked(Part):
    """One quantity of simulated campaigns of one size."""

    n_frames: int = says("Frames")
    quantity: str = says("Quantity, whose name ends in the unit")
    forecast: Number = says("Standard deviation of the forecast")
    stated: Number = says("Standard deviation that the calibrations state, on average")
    ratio: Number = says("Stated over forecast")
    ratio_se: Number = says("Its standard error")
    nees_ratio: Number = says("Squared error over its expectation, all quantities")
    nees_low: Number = says("Lower end of what chance makes of it")
    nees_high: Number = says("Upper end")


class Choice(Part):
    """Frames that help most."""

    frames: list[Chosen] = says("The frames")
    text: str = says("What they are worth, in words")

    @classmethod
    def take(cls, result: Any) -> Mapping[str, Any]:
        return {"frames": result.to_dataframe(), "text": result.text}


class ForecastCheck(Part):
    """Forecast beside simulated campaigns."""

    rows: list[Checked] = says("Quantities by size")
    text: str = says("How near they are, in words")

    @classmethod
    def take(cls, result: Any) -> Mapping[str, Any]:
        return {"rows": result.to_dataframe(), "text": result.text}


class Plan(Part):
    """What a calibration will give."""

    camera: AnyDict = says("The nominal camera, with the keys of a camera file")
    sigma_px: Number = says("Centroid noise, per axis")
    max_mag: Number = says("Magnitude limit", "Gaia G")
    min_stars: int = says("Stars that a frame needs")
    mean_stars: Number = says("Stars in a frame, on average")
    sky_fraction: Number = says("Share of the sky with so many")
    confidence: Number = says("Probability of keeping the target")
    scope: str = says("Part of the error that the target is for")
    target_arcsec: Number = says("Target; null without one")
    needs: Annotated[list[Any], Of("planning.plan:Need")] = says("Frames that it takes")
    forecast: list[Forecast] = says("Campaigns by size")
    text: str = says("The plan in words")
    provenance: AnyDict = says("Time, seed, settings and versions")

    @classmethod
    def take(cls, result: Any) -> Mapping[str, Any]:
        open_radii = {"radius_least_arcsec": None, "radius_most_arcsec": None}
        forecast = [
            open_radii
            | row
            | {"sigma": {key: row[key] for key in row if key not in Forecast.model_fields}}
            for row in result.to_dataframe().to_dict("records")
        ]
        return {**super().take(result), "camera": result.camera.to_dict(), "forecast": forecast}


class Planned(Part):
    """What a calibration will give, and the frames that help."""

    page: str | None = says("The page; null without -o")
    plan: Plan = says("The plan")
    choice: Choice | None = says("Frames that help most; null without --choose")
    check: ForecastCheck | None = says("Beside simulated campaigns; null without --check")
    notes: list[str] = says("What the distortion that is open does, and what each need rests on")


class Quantity(Part):
    """One quantity over simulated replicates."""

    quantity: str = says("Quantity")
    unit: str = says("Unit of its numbers")
    posterior_sd: Number = says("Median standard deviation of the posterior", OWN)
    rms_error: Number = says("Root mean square error of its mean", OWN)
    bias_sd: Number = says("Mean error in standard deviations")
    rms_sd: Number = says("Root mean square error in standard deviations")
    coverage_95: Number = says("Share of 95 % intervals that hold the truth")
    coverage_low: Number = says("Lower end of its binomial interval")
    coverage_high: Number = says("Upper end")
    coverage_p: Number = says("Probability of such a coverage if it is 95 %")
    rank_p: Number = says("Probability of such ranks if they are uniform")


class Validate(Part):
    """Whether intervals are right for a sensor."""

    folder: str | None = says("Folder of figure and table; null without -o")
    ok: bool = says("Whether they are")
    quantities: list[Quantity] = says("Quantities")
    text: str = says("The verdict in words")


class Study(Part):
    """The results of a coupling study."""

    name: str = says("Name")
    question: str = says("What it asks")
    n_cells: int = says("Cells")
    n_ok: int = says("Cells with numbers")
    complete: bool = says("Whether all cells are computed")
    problems: dict[str, int] = says("Cells without numbers by reason")
    answer: list[str] = says("The answer in words")
    advice: list[str] = says("What to do")
    limits: list[str] = says("What it does not say")
    data: str = says("Results (netCDF)")
    table: str = says("Results (Parquet)")
    page: str | None = says("The page; null where no cell has numbers")

    @classmethod
    def take(cls, result: Any) -> Mapping[str, Any]:
        from starcal_uq.presentation.words.studies import study_answer, study_limits
        from starcal_uq.presentation.words.study_advice import study_advice

        found, folder, page = result
        numbers = found.ok.any()
        return {
            "name": found.definition.name,
            "question": found.definition.question,
            "n_cells": found.n_cells,
            "n_ok": int(found.ok.sum()),
            "complete": found.complete,
            "problems": found.problems,
            "answer": study_answer(found) if numbers else [],
            "advice": study_advice(found) if numbers else [],
            "limits": study_limits(found),
            "data": str(Path(folder, "study.nc")),
            "table": str(Path(folder, "study.parquet")),
            "page": page,
        }


class Studied(Part):
    """A coupling study."""

    study: Study = says("Its results")


class Published(Part):
    """One number of the paper beside ours."""

    place: str = says("Where it is printed")
    method: str = says("Method")
    quantity: str = says("Quantity, whose name ends in the unit")
    printed: str = says("As printed")
    outcome: str = says("What comes of it")
    noise_digits: int = says("Printed digits that are noise")
    main_mean: Number = says("Mean over seeds")
    main_spread: Number = says("Standard deviation over seeds")
    main_z: Number = says("Printed minus mean in these")


class Reproduce(Part):
    """The paper run again."""

    report: str = says("The report")
    published: list[Published] = says("Its numbers beside ours")
    text: str = says("The verdict in words")


class OfTable3(Part):
    """One number of Table 3 beside ours."""

    method: str = says("Camera")
    quantity: str = says("Rate in per cent, or error of an axis in arcsec")
    printed: str = says("As printed")
    ours: Number = says("Ours against the true attitude")
    low: Number = says("Lower end of its 95 % range")
    high: Number = says("Upper end")
    aligned: Number = says("About the mean over frames")
    aligned_low: Number = says("Lower end of its 95 % range")
    aligned_high: Number = says("Upper end")
    agrees: str = says("Whether the printed number is in a range, and in which")


class ReproduceField(Part):
    """The paper's Table 3 from rendered frames."""

    report: str = says("The report")
    table_3: list[OfTable3] = says("Its numbers beside ours")
    text: str = says("The verdict in words")


class New(Part):
    """A starter file, or example data."""

    file: str = says("The file, or the folder of an example")
    text: str = says("What to do with it")


class Listed(Part):
    """One schema."""

    name: str = says("Name of the command, or error or verdict")
    version: int = says("Version")
    text: str = says("What its documents hold")


class Schema(Part):
    """The schemas that there are."""

    schemas: list[Listed] = says("The schemas, or the one that was asked for")
    json_schema: AnyDict | None = says("Its JSON Schema; null without NAME")


class Error(Part):
    """Why a command failed; its exit status is not 0 or 1."""

    error: str = says("One sentence with the remedy, as on standard error")
