"""The documents that commands print with ``--json``: what each holds, declared once.

Validation, JSON Schema and the reference page follow from these classes. A document may get further keys; where a key
goes or changes its meaning, the version of its schema rises. NaN and infinity are null: not known, not determined, or
not assessed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from importlib import import_module
from inspect import getdoc
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, create_model, model_validator
from pydantic_core import CoreSchema

from starcal_uq.core.types import AnyDict

PREFIX = "starcal-uq/"
Number = float | None
# Endings of keys that tell the unit.
_UNITS = {
    "arcsec": "arcsec",
    "px": "px",
    "mm": "mm",
    "deg": "deg",
    "percent": "%",
    "seconds": "s",
    "milliseconds": "ms",
}


def says(text: str, unit: str = "") -> Any:
    """What a key holds; its unit where the name does not end in it."""
    return Field(description=text, json_schema_extra={"unit": unit} if unit else None)


def plain(value: Any) -> Any:
    """Numbers, texts, lists and mappings for JSON; a result among them is left to the part that takes it."""
    if isinstance(value, np.generic | np.ndarray):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Enum):
        return plain(value.value)
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return plain(value.to_dict("records")) if hasattr(value, "iterrows") else value


class Part(BaseModel):
    """An object of a document."""

    # Names such as model_... are free, and what no call needs is not built.
    model_config = ConfigDict(defer_build=True, protected_namespaces=())

    @model_validator(mode="before")
    @classmethod
    def _taken(cls, value: Any) -> Any:
        taken = value if isinstance(value, Mapping) else cls.take(value)
        return {key: plain(item) for key, item in taken.items()}

    @classmethod
    def take(cls, result: Any) -> Mapping[str, Any]:
        """What a result holds, by key."""
        return {key: getattr(result, key) for key in cls.model_fields}


@cache
def _part_of(record: type) -> type[Part]:
    """The part with the fields of a record of ours, whose docstring says what they are."""
    said: dict[str, str] = {}
    for names, text in re.findall(r"^(\w[\w, ]*) : .*\n((?: {4}.*\n?)+)", getdoc(record) or "", re.MULTILINE):
        said |= dict.fromkeys(names.split(", "), " ".join(text.split()).removesuffix("."))
    hints = get_type_hints(record)
    keys: AnyDict = {field.name: (_kind(hints[field.name]), says(said[field.name])) for field in fields(record)}
    return create_model(record.__name__, __base__=Part, __doc__=(getdoc(record) or "").partition("\n")[0], **keys)


def _kind(hint: Any) -> Any:
    """The type in JSON of an annotation of a record."""
    origin, args = get_origin(hint), get_args(hint)
    if hint is float or hint is np.float64:
        return Number
    if origin in (Union, UnionType):
        return Union[tuple(_kind(arg) for arg in args)]  # noqa: UP007
    if origin is np.ndarray:
        return list[Number]
    if origin in (tuple, list):
        return list[_kind(args[0])]  # type: ignore[misc]
    if isinstance(hint, type) and issubclass(hint, Enum):
        return str
    return _part_of(hint) if is_dataclass(hint) and isinstance(hint, type) else hint


class _Of:
    """A part made of a record, given as ``module:Class``, and more keys; loaded when it is asked for."""

    def __init__(self, record: str, **more: tuple[Any, str]) -> None:
        self._record, self._more = record, more

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        module, name = self._record.split(":")
        part = _part_of(getattr(import_module(f"starcal_uq.{module}"), name))
        if self._more:
            keys: AnyDict = {key: (kind, says(text)) for key, (kind, text) in self._more.items()}
            part = create_model(name, __base__=part, __doc__=part.__doc__, **keys)
        return handler.generate_schema(list[part] if get_origin(source) is list else part | None)  # type: ignore[valid-type]


# --- parts -----------------------------------------------------------------------------------------------------------

_OWN = "that of the parameter"


class Estimate(Part):
    """One parameter of the camera, or the noise, which comes last."""

    parameter: str = says("x0, y0, f, the coefficients of the distortion, then sigma or sigma_scale")
    unit: str = says("Unit of its numbers; 1 for a factor")
    start: Number = says("Value of the nominal camera", _OWN)
    estimate: Number = says("Estimate", _OWN)
    sigma: Number = says("Standard deviation", _OWN)
    low: Number = says("Lower end of the 95 % interval", _OWN)
    high: Number = says("Upper end of the 95 % interval", _OWN)
    truth: Number = says("Truth of a simulation", _OWN)
    z: Number = says("Estimate minus truth, in standard deviations")


class Calibration(Part):
    """An estimate of the camera."""

    status: str = says("CONVERGED, or why not")
    method: str = says("How it was estimated")
    n_stars: int = says("Stars in pixels")
    n_frames: int = says("Frames")
    camera: AnyDict = says("The calibrated camera, with the keys of a camera file")
    focal_mm: Number = says("Focal length")
    focal_sigma_mm: Number = says("Its standard deviation")
    parameters: list[Estimate] = says("Parameters in order")
    notes: list[str] = says("Sentences on noise and model, where there is something to say")

    @classmethod
    def take(cls, result: Any) -> Mapping[str, Any]:
        from starcal_uq.estimation.fallback import fallback_words
        from starcal_uq.presentation.words.estimation import fitted_noise_text

        cal, truth = result if isinstance(result, list) else (result, None)
        table = cal.to_dataframe()
        true = {} if truth is None else dict(zip(cal.parameter_names, truth.theta, strict=True))
        table["truth"] = [true.get(name) for name in table["parameter"]]
        table["z"] = (table["estimate"] - table["truth"].astype(float)) / table["sigma"]
        return {
            **{key: getattr(cal, key) for key in ("method", "n_stars", "n_frames")},
            "status": cal.status.name,
            "camera": cal.camera.to_dict(),
            "focal_mm": cal.camera.focal_mm,
            "focal_sigma_mm": cal.sigmas[2] * cal.camera.pixel_um * 1e-3,
            "parameters": table,
            "notes": [words for words in (fitted_noise_text(cal).strip(), fallback_words(cal)) if words],
        }


class Check(Part):
    """One check."""

    key: str = says("Its name for programs")
    name: str = says("Its name")
    value: str = says("What was found, with its unit")
    bound: str = says("What was asked for")
    sentence: str = says("What it means")
    remedy: str = says("Command or Python call that may mend it; empty where nothing of the kind helps")
    level: str = says("pass, warning or fail")
    question: str = says("converged or trustworthy: the question that it helps to answer")

    @classmethod
    def take(cls, result: Any) -> Mapping[str, Any]:
        return {**super().take(result), "question": result.question.name.lower()}


class Verdict(Part):
    """Whether the numbers of a run may be used."""

    level: str = says("pass, warning or fail: the worst of the checks")
    headline: str = says("The verdict in a sentence")
    checks: list[Check] = says("Every check")


class Sampled(Part):
    """The posterior of one parameter."""

    parameter: str = says("Name")
    unit: str = says("Unit of its numbers")
    prior_mean: Number = says("Mean of the prior", _OWN)
    prior_sd: Number = says("Standard deviation of the prior", _OWN)
    mean: Number = says("Mean", _OWN)
    sd: Number = says("Standard deviation", _OWN)
    low: Number = says("Quantile of 2.5 %", _OWN)
    median: Number = says("Median", _OWN)
    high: Number = says("Quantile of 97.5 %", _OWN)
    mcse: Number = says("Monte Carlo standard error of the mean", _OWN)
    rhat: Number = says("R-hat over separately seeded ensembles")
    ess_bulk: Number = says("Effective draws for the mean")
    ess_tail: Number = says("Effective draws for the ends of the interval")

    @classmethod
    def of(cls, summary: Any) -> Any:
        """Rows of `Posterior.summary`."""
        return summary.rename(columns={"q2.5": "low", "q50": "median", "q97.5": "high"})


class Posterior(Part):
    """Draws, in numbers."""

    n_draws: int = says("Draws")
    level: str = says("pass, warning or fail: the worst of the checks of the draws")
    checks: list[Check] = says("The checks of the draws")
    parameters: list[Sampled] = says("Parameters in order")

    @classmethod
    def take(cls, result: Any) -> Mapping[str, Any]:
        return {
            "n_draws": len(result.draws),
            "level": result.diagnostics.level,
            "checks": result.diagnostics.checks,
            "parameters": Sampled.of(result.summary()),
        }


class Coupled(Part):
    """What not knowing the others costs one parameter."""

    parameter: str = says("Name")
    unit: str = says("Unit of its numbers")
    sigma_marginal: Number = says("Standard deviation", _OWN)
    sigma_conditional: Number = says("Standard deviation if all others were known", _OWN)
    variance_inflation: Number = says("Square of their ratio")
    crlb_sigma: Number = says("Cramér-Rao bound of the standard deviation", _OWN)
    prior_sigma: Number = says("Standard deviation of the prior; null without a posterior", _OWN)
    contraction: Number = says("1 - (posterior over prior variance); null without a posterior")
    correlation: dict[str, Number] = says("Correlation with every parameter, and with pitch, yaw and roll")


class Coupling(Part):
    """Couplings of the parameters."""

    parameters: list[Coupled] = says("Parameters in order")
    directions: list[str] = says("Weak directions in words, the least determined first")

    @classmethod
    def take(cls, result: Any) -> Mapping[str, Any]:
        rows = result.to_dataframe().assign(prior_sigma=result.prior_sigma, contraction=result.contraction)
        parameters = [
            row | {"correlation": {name: row[f"corr_{name}"] for name in result.extended_names}}
            for row in rows.to_dict("records")
        ]
        return {"parameters": parameters, "directions": [direction.words for direction in result.weak_directions]}


class AttitudeRow(Part):
    """What one contributor does to one axis."""

    contributor: str = says("Contributor")
    axis: str = says("pitch, yaw, roll or cross-boresight")
    if_model_holds_arcsec: Number = says("Standard deviation by the posterior alone")
    with_misfit_found_arcsec: Number = says("With what the tests of the model found; null: not assessed")
    p95_if_model_holds_arcsec: Number = says("Half-width that holds 95 %")
    p95_with_misfit_found_arcsec: Number = says("The same with the misfit found")
    p997_if_model_holds_arcsec: Number = says("Half-width that holds 99.7 %")
    p997_with_misfit_found_arcsec: Number = says("The same with the misfit found")
    first_order_arcsec: Number = says("Standard deviation by first-order propagation")
    absorbed_by_alignment: str = says("yes, no or in part")


class Attitude(Part):
    """Attitude error that the calibration contributes."""

    frames: str = says("Frames whose attitudes these are")
    alignment: str = says("Frames on which alignment is calibrated")
    contributors: list[AttitudeRow] = says("Contributors by axis")
    text: str = says("What follows, in words")

    @classmethod
    def take(cls, result: Any) -> Mapping[str, Any]:
        return {**vars(result), "contributors": result.to_dataframe(), "text": result.text}


class ClassSum(Part):
    """One class of contributors on one axis."""

    ecss_class: str = says("Class of ECSS-E-ST-60-20C")
    axis: str = says("pitch, yaw or roll")
    sigma_arcsec: Number = says("Standard deviation; null where nothing of it is assessed")
    at_least: bool = says("Whether contributors are missing")


class Budget(Part):
    """An attitude error budget."""

    title: str = says("Title")
    confidence: Number = says("Confidence of the totals")
    contributors: Annotated[
        list[Any],
        _Of(
            "budgeting.rows:Contributor",
            assessed=(bool, "Whether anybody has put a number on it"),
            combination=(str, "How it enters the totals"),
        ),
    ] = says("Contributors by axis")
    classes: list[ClassSum] = says("Classes of the standard by axis, after alignment")
    totals: Annotated[list[Any], _Of("budgeting.totals:Total", at_least=(bool, "Whether contributors are missing"))] = (
        says("Totals by scope, axis and interpretation")
    )
    requirements: Annotated[
        list[Any],
        _Of(
            "budgeting.file:Requirement",
            rule_arcsec=(Number, "Bound by the rule"),
            sampled_arcsec=(Number, "Quantile of the sampled error"),
            least_arcsec=(Number, "The least that the error is"),
            bound_arcsec=(Number, "The bound that is held against the limit"),
            margin_arcsec=(Number, "Limit minus bound"),
            verdict=(str, "met, violated or open"),
            at_least=(bool, "Whether contributors are missing"),
        ),
    ] = says("Requirements")
    violations: list[str] = says("Names of the requirements that are violated")
    not_assessed: list[str] = says("Contributors without a number")
    notes: list[str] = says("Sentences that must be read with it")
    provenance: AnyDict = says("Time, seed, settings, versions, hash of the data")

    @classmethod
    def take(cls, result: Any) -> Mapping[str, Any]:
        totals = result.totals_dataframe().assign(not_assessed=[total.not_assessed for total in result.totals])
        return {**result.to_dict(), "totals": totals}


class Frame(Part):
    """One frame of centroids."""

    frame: int = says("Number")
    image: str = says("File")
    time_utc: str = says("Middle of the exposure, ISO 8601; empty where it is not known")
    n_stars: int = says("Stars found")
    background: Number = says("Background", "counts")
    noise: Number = says("Noise of a pixel", "counts")
    psf_sigma_px: Number = says("Width of the star images")
    problem: str = says("Why it cannot be used; empty where it can")


class Inspected(Part):
    """What became of one image."""

    frame: int = says("Number")
    image: str = says("File")
    time_utc: str = says("Middle of the exposure, ISO 8601; empty where it is not known")
    outcome: str = says("identified, or why not")
    n_detected: int = says("Stars found")
    n_matched: int = says("Stars identified by the last search")
    n_identified: int = says("Stars used by the calibration")
    rms_px: Number = says("Root mean square of the residuals, per axis")
    seconds: Number = says("Time that it took to find and identify them")


class Jackknifed(Part):
    """Uncertainty of one parameter from the scatter over frames."""

    parameter: str = says("Name")
    formal_sigma: Number = says("Standard deviation if the model holds", _OWN)
    jackknife_sigma: Number = says("By leaving out one frame at a time", _OWN)
    sandwich_sigma: Number = says("Cluster-robust over frames", _OWN)
    ratio: Number = says("Cluster-robust over formal")
    jackknife_ratio: Number = says("Jackknife over formal")
    expected_low: Number = says("Lower end of what chance makes of the ratio")
    expected_high: Number = says("Upper end")
    p_value: Number = says("Probability of such a ratio if the model holds")
    factor: Number = says("Factor on the standard deviation")


class OfStars(Part):
    """Uncertainty of one parameter if stars err alike in every frame."""

    parameter: str = says("Name")
    formal_sigma: Number = says("Standard deviation if all images err independently", _OWN)
    star_sigma: Number = says("With the errors of stars that were found", _OWN)
    sandwich_sigma: Number = says("Cluster-robust over stars", _OWN)
    jackknife_sigma: Number = says("By leaving out one star at a time", _OWN)
    widening: Number = says("With errors of stars over formal")


class Merged(Part):
    """One run beside all of them."""

    run: str = says("Run")
    sigma: Number = says("Its noise", "px, or a factor")
    distance_sigma: Number = says("Distance from the merged optimum, in its own sigmas")
    p_value: Number = says("Probability of such a deviation from the others")
    z: dict[str, Number] = says("Deviation of every parameter in its standard deviation")


class Consistency(Part):
    """Whether runs show the same camera."""

    names: list[str] = says("The runs")
    p_value: Number = says("Probability of such differences if they do")
    messages: list[str] = says("What deserves attention; empty where they agree")
    runs: list[Merged] = says("The runs one by one")

    @classmethod
    def take(cls, result: Any) -> Mapping[str, Any]:
        rows = [
            row | {"z": {name: row[f"z_{name}"] for name in result.parameter_names}}
            for row in result.to_dataframe().to_dict("records")
        ]
        return {**vars(result), "runs": rows}


class Screening(Part):
    """Stars that were left out."""

    n_rejected: int = says("Stars left out")
    counts: dict[str, int] = says("Stars by reason")
    warnings: list[str] = says("What a user should look at")
    text: str = says("All of it in words")


# --- documents -------------------------------------------------------------------------------------------------------


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
        _Of("identification.result:FrameIdentification"),
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
    consistency: Consistency | None = says("Whether they show the same camera; null where that cannot be said")


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
    spectrum: str | None = says("Spectrum of the errors along a profile, in words; null without a profile")


class Diagnosis(Part):
    """What questions the model of a run."""

    misfit: Annotated[list[Any], _Of("diagnostics.misfit:MisfitTest")] = says("Tests for structure in the residuals")
    jackknife: list[Jackknifed] = says("Parameters by the scatter over frames; empty for fewer than three frames")
    stars: list[OfStars] = says("Parameters by the scatter over stars; empty where that is not known")
    models: Annotated[list[Any], _Of("diagnostics.models:ModelScore")] = says(
        "Distortion models, the best first; empty where none were compared"
    )
    predictive: Annotated[list[Any], _Of("diagnostics.predictive:PredictiveStatistic")] = says(
        "Measured residuals against those that the model makes"
    )
    starts: Annotated[Any, _Of("diagnostics.diagnose:MultiStart")] = says(
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
    error_px: Number = says("Largest distance from the camera over the detector; null for a file without a camera")
    text: str = says("What it holds and how near it is, in words")


class Run(Part):
    """A whole run."""

    run: str = says("Run folder")
    report: str = says("Its report")
    verdict: Verdict = says("Whether its numbers may be used")
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
    expected: Number = says("Standard deviation, or for a map the root mean square, that the uncertainties give")
    ratio: Number = says("Difference over expected")
    p_value: Number = says("Probability of such a difference by chance; null where it is not tested by itself")


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
    p_parameters: Number = says("Probability of such parameters by chance; null where that was not tested")
    rotation_arcsec: list[Number] = says("Rotation between the two, taken out, about the axes of the camera")
    rotation_sigma_arcsec: list[Number] = says("Its standard deviations")
    differences: list[Difference] = says("What is left, and the parameters")
    x_px: list[Number] = says("Columns of the maps")
    y_px: list[Number] = says("Rows of the maps")
    difference_px: list[list[list[Number]]] = says("Map of the difference: rows, columns, x and y")
    sigma_arcsec: list[list[Number]] = says("Map of the expected length of the difference: rows, columns")
    messages: list[str] = says("What deserves attention")
    text: str = says("The verdict in words")
    provenance: AnyDict = says("Of both, and settings")


class Need(Part):
    """Frames that a target takes."""

    scope: str = says("Part of the error")
    frames: int | None = says("Frames; null where none suffice")
    frames_surely: int | None = says("Frames that suffice for 95 % of the campaigns; null where none do")
    floor_arcsec: Number = says("What is left with any number of frames")


class Forecast(Part):
    """What a campaign of one size will give."""

    n_frames: int = says("Frames")
    sigma: dict[str, Number] = says("Standard deviation by quantity, whose name ends in the unit; null: not determined")
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
    score: Number = says("What is left of the uncertainty with it and all before, as the criterion counts it")


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
    needs: list[Need] = says("Frames that it takes")
    forecast: list[Forecast] = says("Campaigns by size")
    text: str = says("The plan in words")
    provenance: AnyDict = says("Time, seed, settings and versions")

    @classmethod
    def take(cls, result: Any) -> Mapping[str, Any]:
        open_radii = {"radius_least_arcsec": None, "radius_most_arcsec": None}
        forecast = [
            open_radii | row | {"sigma": {key: row[key] for key in row if key not in Forecast.model_fields}}
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
    posterior_sd: Number = says("Median standard deviation of the posterior", _OWN)
    rms_error: Number = says("Root mean square error of its mean", _OWN)
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

    template: str | None = says("STUDY that was written instead; null without --template")
    study: Study | None = says("Its results; null with --template")


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


# Name -> version and content: of commands by their names, and of what is no answer of one.
SCHEMAS: Mapping[str, tuple[int, type[Part]]] = {
    "demo": (1, Run),
    "run": (1, Run),
    "new": (1, New),
    "plan": (1, Planned),
    "simulate": (1, Simulate),
    "study": (1, Studied),
    "validate": (1, Validate),
    "centroid": (1, Centroid),
    "identify": (1, Identify),
    "calibrate": (1, Calibrate),
    "sample": (1, Sample),
    "coupling": (1, Couple),
    "propagate": (1, Propagate),
    "diagnose": (1, Diagnose),
    "budget": (1, Budgeted),
    "report": (1, Report),
    "inspect": (1, Inspect),
    "export": (1, Export),
    "compare": (1, Compare),
    "merge": (1, Merge),
    "filter": (1, Filter),
    "reproduce": (1, Reproduce),
    "reproduce-field": (1, ReproduceField),
    "schema": (1, Schema),
    "verdict": (1, Verdict),
    "error": (1, Error),
}
_HEAD = {
    "schema": "Name of the schema",
    "version": "Its version",
    "exit_status": "0, 1 for a result that should not be trusted, 2 for bad input, 130 or 143 after an interrupt",
}


def document(name: str, results: Mapping[str, Any], status: int) -> AnyDict:
    """The document of a schema that holds some results."""
    version, part = SCHEMAS[name]
    return {"schema": PREFIX + name, "version": version, "exit_status": status} | part.model_validate(
        results
    ).model_dump()


def json_schema(name: str) -> AnyDict:
    """The JSON Schema of a document; ``unit`` says the unit of a number."""
    version, part = SCHEMAS[name]
    schema = part.model_json_schema(mode="serialization")
    for place in (schema, *schema.get("$defs", {}).values()):
        for key, content in place.get("properties", {}).items():
            content.pop("title", None)
            unit = content.get("unit") or _UNITS.get(key.rsplit("_", 1)[-1])
            content |= {"unit": unit} if unit else {}
    head: AnyDict = {key: {"description": text} for key, text in _HEAD.items()}
    head["schema"] |= {"const": PREFIX + name}
    head["version"] |= {"const": version}
    head["exit_status"] |= {"type": "integer"}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **schema,
        "title": f"{PREFIX}{name} {version}",
        "properties": head | schema["properties"],
        "required": [*head, *schema["required"]],
    }


def keys(name: str) -> Iterator[tuple[str, str, str, str]]:
    """Every key of a document with its type, unit and meaning; ``a[].b`` is b of every object in the list a."""
    schema = json_schema(name)
    yield from _keys(schema, schema.get("$defs", {}), "")


def _keys(place: AnyDict, parts: AnyDict, above: str) -> Iterator[tuple[str, str, str, str]]:
    for key, content in place["properties"].items():
        kind, inner = type_words(content), _inner(content)
        yield f"{above}{key}", kind, content.get("unit", ""), content.get("description", "")
        if inner:
            yield from _keys(parts[inner], parts, f"{above}{key}{'[]' if kind.startswith('list') else ''}.")


def type_words(content: AnyDict) -> str:
    """The type of a key in words."""
    if "const" in content:
        return f'"{content["const"]}"' if isinstance(content["const"], str) else str(content["const"])
    if "anyOf" in content:
        return " or ".join(map(type_words, content["anyOf"]))
    kind = content.get("type", "object")
    if kind == "array":
        return f"list of {_several(content['items'])}"
    values = content.get("additionalProperties")
    return f"object of {_several(values)}" if isinstance(values, dict) else str(kind)


def _several(content: AnyDict) -> str:
    return type_words(content).replace(" or ", "s or ") + "s"


def _inner(content: AnyDict) -> str:
    """The name of the part that a key, or a list of it, is made of; empty where there is none."""
    within = [content.get("items", {}), *content.get("anyOf", ())]
    return str(content["$ref"].rpartition("/")[2]) if "$ref" in content else "".join(map(_inner, filter(None, within)))
