"""Objects that hold a result each, in whichever document it stands."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from starcal_uq.core.documents import Number, Of, Part, says
from starcal_uq.core.types import AnyDict

OWN = "that of the parameter"


class Estimate(Part):
    """One parameter of the camera, or the noise, which comes last."""

    parameter: str = says(
        "x0, y0, f, the coefficients of the distortion, then sigma or sigma_scale"
    )
    unit: str = says("Unit of its numbers; 1 for a factor")
    start: Number = says("Value of the nominal camera", OWN)
    estimate: Number = says("Estimate", OWN)
    sigma: Number = says("Standard deviation", OWN)
    low: Number = says("Lower end of the 95 % interval", OWN)
    high: Number = says("Upper end of the 95 % interval", OWN)
    truth: Number = says("Truth of a simulation", OWN)
    z: Number = says("Estimate minus truth, in standard deviations")


class Calibration(Part):
    """An estimate of the camera."""

    status: str = says("CONVERGED, or why not")
    method: str = says("How it was estimated")
    n_stars: int = says("Stars in pixels")
    n_frames: int = says("Frames")
    camera: AnyDict = says("The calibrated camera, with the keys of a camera file")
    focal_mm: Number = says("Focal length; null where the pixel pitch is unknown")
    focal_sigma_mm: Number = says("Its standard deviation; null where the pixel pitch is unknown")
    parameters: list[Estimate] = says("Parameters in order")
    notes: list[str] = says("Sentences on noise and model, where there is something to say")

    @classmethod
    def take(cls, result: Any) -> Mapping[str, Any]:
        from starcal_uq.calibration.fallback import fallback_words
        from starcal_uq.presentation.words.estimation import fitted_noise_text

        cal, truth = result if isinstance(result, list) else (result, None)
        table = cal.to_dataframe()
        true = {} if truth is None else dict(zip(cal.parameter_names, truth.theta, strict=True))
        pitch = cal.camera.pixel_um
        table["truth"] = [true.get(name) for name in table["parameter"]]
        table["z"] = (table["estimate"] - table["truth"].astype(float)) / table["sigma"]
        return {
            **{key: getattr(cal, key) for key in ("method", "n_stars", "n_frames")},
            "status": cal.status.name,
            "camera": cal.camera.to_dict(),
            "focal_mm": cal.camera.focal_mm,
            "focal_sigma_mm": None if pitch is None else cal.sigmas[2] * pitch * 1e-3,
            "parameters": table,
            "notes": [
                words for words in (fitted_noise_text(cal).strip(), fallback_words(cal)) if words
            ],
        }


class Sampled(Part):
    """The posterior of one parameter."""

    parameter: str = says("Name")
    unit: str = says("Unit of its numbers")
    prior_mean: Number = says("Mean of the prior", OWN)
    prior_sd: Number = says("Standard deviation of the prior", OWN)
    mean: Number = says("Mean", OWN)
    sd: Number = says("Standard deviation", OWN)
    low: Number = says("Quantile of 2.5 %", OWN)
    median: Number = says("Median", OWN)
    high: Number = says("Quantile of 97.5 %", OWN)
    mcse: Number = says("Monte Carlo standard error of the mean", OWN)
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
    checks: Annotated[list[Any], Of("core.status:Check")] = says("The checks of the draws")
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
    sigma_marginal: Number = says("Standard deviation", OWN)
    sigma_conditional: Number = says("Standard deviation if all others were known", OWN)
    variance_inflation: Number = says("Square of their ratio")
    crlb_sigma: Number = says("Cramér-Rao bound of the standard deviation", OWN)
    prior_sigma: Number = says("Standard deviation of the prior; null without a posterior", OWN)
    contraction: Number = says("1 - (posterior over prior variance); null without a posterior")
    correlation: dict[str, Number] = says(
        "Correlation with every parameter, and with pitch, yaw and roll"
    )


class Coupling(Part):
    """Couplings of the parameters."""

    parameters: list[Coupled] = says("Parameters in order")
    directions: list[str] = says("Weak directions in words, the least determined first")

    @classmethod
    def take(cls, result: Any) -> Mapping[str, Any]:
        rows = result.to_dataframe().assign(
            prior_sigma=result.prior_sigma, contraction=result.contraction
        )
        parameters = [
            row | {"correlation": {name: row[f"corr_{name}"] for name in result.extended_names}}
            for row in rows.to_dict("records")
        ]
        return {
            "parameters": parameters,
            "directions": [direction.words for direction in result.weak_directions],
        }


class AttitudeRow(Part):
    """What one contributor does to one axis."""

    contributor: str = says("Contributor")
    axis: str = says("pitch, yaw, roll or cross-boresight")
    if_model_holds_arcsec: Number = says("Standard deviation by the posterior alone")
    with_misfit_found_arcsec: Number = says(
        "With what the tests of the model found; null: not assessed"
    )
    p95_if_model_holds_arcsec: Number = says("Half-width that holds 95 %")
    p95_with_misfit_found_arcsec: Number = says("The same with the misfit found")
    p997_if_model_holds_arcsec: Number = says("Half-width that holds 99.7 %")
    p997_with_misfit_found_arcsec: Number = says("The same with the misfit found")
    first_order_arcsec: Number = says("Standard deviation by first-order propagation")
    choice_of_model_arcsec: Number = says(
        "Shift by models as good, in no other figure; null: not assessed"
    )
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
    contributors: Annotated[list[Any], Of("budgeting.rows:Contributor")] = says(
        "Contributors by axis"
    )
    classes: list[ClassSum] = says("Classes of the standard by axis, after alignment")
    totals: Annotated[list[Any], Of("budgeting.totals:Total")] = says(
        "Totals by scope, axis and interpretation"
    )
    requirements: Annotated[
        list[Any],
        Of(
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
        totals = result.totals_dataframe().assign(
            not_assessed=[total.not_assessed for total in result.totals]
        )
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
    formal_sigma: Number = says("Standard deviation if the model holds", OWN)
    jackknife_sigma: Number = says("By leaving out one frame at a time", OWN)
    sandwich_sigma: Number = says("Cluster-robust over frames", OWN)
    ratio: Number = says("Cluster-robust over formal")
    jackknife_ratio: Number = says("Jackknife over formal")
    expected_low: Number = says("Lower end of what chance makes of the ratio")
    expected_high: Number = says("Upper end")
    p_value: Number = says("Probability of such a ratio if the model holds")
    factor: Number = says("Factor on the standard deviation")


class OfStars(Part):
    """Uncertainty of one parameter if stars err alike in every frame."""

    parameter: str = says("Name")
    formal_sigma: Number = says("Standard deviation if all images err independently", OWN)
    star_sigma: Number = says("With the errors of stars that were found", OWN)
    sandwich_sigma: Number = says("Cluster-robust over stars", OWN)
    jackknife_sigma: Number = says("By leaving out one star at a time", OWN)
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
