"""The rows of an error budget: one contributor on one axis, and the contributors that no budget may
leave out.

The classes are those of ECSS-E-ST-60-20C (star sensors): bias, thermo-elastic error, field-of-view
spatial error, pixel spatial error, aberration, temporal noise, measurement date error. What a
calibration cannot know is in this list too, so that it is read as "not assessed" and never as zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal
from typing import ClassVar

from starcal_uq.core.constants import AXES, CROSS_BORESIGHT, INTERACTION
from starcal_uq.maths.intervals import HALF_WIDTH_997

AXIS_LABELS = {
    **{name: name for name in AXES},
    CROSS_BORESIGHT: "across the boresight",
}

DISTRIBUTIONS = ("gaussian", "uniform", "arcsine", "rayleigh", "constant")
INTERPRETATIONS = ("ensemble", "temporal", "mixed")
ABSORBED = ("yes", "no", "in part", "caused by it")
SCOPES = ("before alignment", "after alignment")
# After an alignment that absorbs all of what it absorbs in part.
AFTER_AT_LEAST = "after alignment, at the least"
KNOWLEDGE, CONTROL = PARTS = ("knowledge", "control")
SOURCES = ("posterior", "file", "not assessed")
ECSS_CLASSES = (
    "bias",
    "thermo-elastic",
    "FOV spatial",
    "pixel spatial",
    "aberration",
    "temporal noise (NEA)",
    "measurement date",
    "robustness",
    "other",
)

NEA = "centroid noise (NEA)"
COMMON = "calibration, common rotation"
REST = "calibration, rest"
ALIGNMENT = "alignment calibration in flight"
_NAN = float("nan")
# Two-sided 99.7 % quantile of a Gaussian error, standard deviations.
GAUSSIAN_997 = HALF_WIDTH_997


@dataclass(frozen=True)
class Contributor:
    """One contributor to the attitude error on one axis.

    Attributes
    ----------
    name : str
        Name of the row.
    ecss_class : str
        Class of ECSS-E-ST-60-20C, one of `ECSS_CLASSES`.
    axis : str
        ``pitch`` (about camera X), ``yaw`` (about Y) or ``roll`` (about the boresight, Z).
    mean_arcsec, sigma_arcsec : float
        Mean and standard deviation, arcsec; NaN where not assessed.
    distribution : str
        One of `DISTRIBUTIONS`: shape around the mean. ``constant`` has no spread.
    interpretation : str
        Kind of randomness: ``ensemble`` (of calibrations and units: constant in time), ``temporal``
        or ``mixed``.
    absorbed_by_alignment : str
        Does an alignment calibration with the same camera parameters take it up? ``caused by it``
        marks what exists only after it. ``in part`` counts in full for upper bounds, and not at all
        for the least ones.
    correlation_group : str
        Rows with the same text err together, on all axes: their sigmas add. With ``-`` in front
        they err against those without. Empty if it errs alone.
    axis_correlation : tuple of float
        Correlations with pitch, yaw and roll of the same contributor; empty if its axes are
        independent.
    tail_997 : float
        Half-width that holds 99.7 % of the absolute deviations, standard deviations. Above 2.968
        for a Gaussian error whose sigma changes from frame to frame.
    conditions, provenance : str
        Under what conditions it holds, and where the number is from.
    source : str
        ``posterior``, ``file`` or ``not assessed``.
    if_model_holds_arcsec, with_misfit_found_arcsec : float
        Sigma by the posterior alone, and with what the tests of the model found, which is then
        `sigma_arcsec`; NaN where there is no such figure, as in rows of a file or where the model
        was not tested.
    applies : bool
        False where the file states that there is no such error: it then counts as zero, with that
        as its reason.
    part : str
        ``knowledge``, or ``control``: an error of pointing that is no error of knowledge.
    behaviour : str
        How it changes in time, with the time of that; empty if nobody stated it.
    """

    DOCUMENTED: ClassVar = ("assessed", "combination")

    name: str
    ecss_class: str
    axis: str
    mean_arcsec: float = _NAN
    sigma_arcsec: float = _NAN
    distribution: str = "gaussian"
    interpretation: str = "ensemble"
    absorbed_by_alignment: str = "no"
    correlation_group: str = ""
    axis_correlation: tuple[float, ...] = ()
    tail_997: float = GAUSSIAN_997
    conditions: str = ""
    provenance: str = ""
    source: str = "not assessed"
    if_model_holds_arcsec: float = _NAN
    with_misfit_found_arcsec: float = _NAN
    applies: bool = True
    part: str = KNOWLEDGE
    behaviour: str = ""

    @property
    def assessed(self) -> bool:
        """False if the contributor has no number."""
        return self.source != "not assessed"

    @property
    def inflated(self) -> bool:
        """True if sigma is larger than the posterior's own."""
        return self.with_misfit_found_arcsec > self.if_model_holds_arcsec

    @property
    def group(self) -> tuple[str, float]:
        """Correlation group without its sign, and the sign."""
        text = self.correlation_group.strip()
        return (text[1:].strip(), -1.0) if text.startswith("-") else (text, 1.0)

    @property
    def combination(self) -> str:
        """Way in which the row enters the totals."""
        if not self.assessed:
            return "not in the totals"
        if not self.applies:
            return "none"
        if self.part == CONTROL:
            return "in errors of pointing alone"
        if self.distribution == "constant":
            return "mean: linear"
        group = (
            f"linear within group {self.group[0]!r}, then in squares"
            if self.correlation_group
            else ""
        )
        against = " (against the others)" if self.group[1] < 0.0 else ""
        return group + against if group else "in squares"

    def counts(self, scope: str) -> bool:
        """True if it exists in this scope, one of `SCOPES` or `AFTER_AT_LEAST`."""
        if self.absorbed_by_alignment == "yes" or (
            scope == AFTER_AT_LEAST and self.absorbed_by_alignment == "in part"
        ):
            return scope == SCOPES[0]
        if self.absorbed_by_alignment == "caused by it":
            return scope != SCOPES[0]
        return True


@dataclass(frozen=True)
class Expected:
    """A contributor that a star-sensor budget must name, with entries of a `Contributor`; a file
    may state otherwise.

    `what` is the description and usual source of the number, for people.
    """

    name: str
    ecss_class: str
    interpretation: str
    absorbed_by_alignment: str
    distribution: str
    what: str


FROM_POSTERIOR = (
    Expected(
        *(COMMON, "bias", "ensemble", "yes", "gaussian"),
        "error of the camera parameters that turns all attitudes alike",
    ),
    Expected(
        *(REST, "FOV spatial", "mixed", "no", "gaussian"),
        "error of the camera parameters that depends on where the stars are",
    ),
    Expected(
        *(NEA, "temporal noise (NEA)", "temporal", "no", "gaussian"),
        "noise of the centroids",
    ),
)
INTERACTING = Expected(
    *(INTERACTION, "temporal noise (NEA)", "mixed", "no", "gaussian"),
    "what is left when noise and calibration error act together",
)
# Present as long as nobody has tested the model: then its error is in the calibration rows.
UNTESTED = Expected(
    *("misfit of the camera model", "FOV spatial", "mixed", "no", "gaussian"),
    "what the model of camera and noise cannot follow, as long as it was not tested",
)
# Rows that effects of the calibration fill, by effect; two of them are in every budget.
OF_EFFECTS = {
    "axes": Expected(
        *("scale and skew of the axes", "FOV spatial", "mixed", "no", "gaussian"),
        "pixels that are not square, a skewed detector",
    ),
    "field": Expected(
        *("field error", "FOV spatial", "mixed", "no", "gaussian"),
        "errors of the lens that keep their place in the field",
    ),
    "radial": Expected(
        *("radial error of the lens", "FOV spatial", "mixed", "no", "gaussian"),
        "distortion along the radius beyond the model",
    ),
    "frame": Expected(
        *("frame-to-frame error", "temporal noise (NEA)", "temporal", "no", "gaussian"),
        "scale and shears that every frame has by itself",
    ),
    "zenith": Expected(
        *("refraction", "FOV spatial", "temporal", "no", "gaussian"),
        "refraction that the directions of the stars lack, on the ground",
    ),
    "temperature": Expected(
        *("thermo-elastic of the optics", "thermo-elastic", "mixed", "no", "gaussian"),
        "change of focal length and principal point with the temperature",
    ),
    "time": Expected(
        *("drift", "FOV spatial", "mixed", "no", "gaussian"),
        "change of focal length and principal point over the time of the calibration",
    ),
    "epoch": Expected(
        *("night-to-night change", "FOV spatial", "mixed", "no", "gaussian"),
        "change of focal length and principal point to another night",
    ),
    "star": Expected(
        *("star catalogue", "FOV spatial", "mixed", "no", "gaussian"),
        "errors of catalogue positions: proper motion since epoch, parallax, double stars",
    ),
    "phase": Expected(
        *("pixel spatial error", "pixel spatial", "mixed", "no", "gaussian"),
        "centroid interpolation, photo-response and dark-signal non-uniformity, as far as the "
        "calibration frames did "
        "not hold it as noise",
    ),
    "magnitude": Expected(
        *("shift with brightness", "FOV spatial", "mixed", "no", "gaussian"),
        "shift of centroids, and change of scale, with the magnitude",
    ),
}
FROM_FILE = (
    Expected(
        *("on-ground alignment measurement", "bias", "ensemble", "yes", "gaussian"),
        (
            "alignment of the sensor's frame with its mounting reference (cube, feet), as measured "
            "before launch"
        ),
    ),
    Expected(
        *("launch and settling shift", "bias", "ensemble", "yes", "uniform"),
        (
            "change of that alignment from its measurement to the start of the mission: launch "
            "loads, gravity, moisture"
        ),
    ),
    Expected(
        *(ALIGNMENT, "bias", "ensemble", "caused by it", "gaussian"),
        "error of the in-flight estimate that replaces the rows it absorbs, if it is more than "
        "noise of the frames on "
        "which `propagate` aligns",
    ),
    Expected(
        *("thermo-elastic distortion", "thermo-elastic", "temporal", "no", "arcsine"),
        (
            "motion of boresight against mounting reference with temperature and its gradients "
            "over "
            "orbit and season"
        ),
    ),
    Expected(
        *("drift of focal length and distortion", "FOV spatial", "ensemble", "no", "gaussian"),
        "change of the camera since the calibration that no effect of it holds: temperature, "
        "vacuum, ageing",
    ),
    Expected(
        *("chromatic and asymmetric star images", "FOV spatial", "mixed", "no", "gaussian"),
        (
            "shift of centroids with star colour, field position and focus that no distortion "
            "model "
            "holds"
        ),
    ),
    OF_EFFECTS["star"],
    OF_EFFECTS["phase"],
    Expected(
        *("aberration residual", "aberration", "temporal", "no", "arcsine"),
        (
            "what the on-board correction of aberration leaves: velocity error, or the whole "
            "effect "
            "if it is not corrected"
        ),
    ),
    Expected(
        *("measurement date error", "measurement date", "temporal", "no", "uniform"),
        "error of the time tag times the angular rate",
    ),
    Expected(
        *("motion during exposure", "temporal noise (NEA)", "temporal", "no", "gaussian"),
        (
            "smear, jitter and rolling shutter at the mission's rates, beyond those of the "
            "calibration frames"
        ),
    ),
    Expected(
        *("end-of-life noise", "temporal noise (NEA)", "temporal", "no", "gaussian"),
        "growth of the noise with radiation dose, dark current, loss of transmission",
    ),
    Expected(
        *("straylight, particles and false stars", "robustness", "temporal", "no", "gaussian"),
        "added error at the exclusion angles and particle fluxes that the mission has to endure",
    ),
)


def confidence_text(confidence: float) -> str:
    """A confidence in per cent, with the digits it has, all its nines included: 99.7 %,
    99.99999 %.
    """
    share = 100 * Decimal(repr(float(confidence)))
    # Four decimals, and three digits of what misses to 0 or 100.
    decimals = max([4, *(2 - part.adjusted() for part in (share, 100 - share) if part)])
    shown = f"{share:.{decimals}f}"
    return f"{shown.rstrip('0').rstrip('.')}\N{NO-BREAK SPACE}%"


def not_assessed(expected: Expected, axis: str) -> Contributor:
    """A row that says that nobody has put a number on it."""
    return Contributor(
        name=expected.name,
        ecss_class=expected.ecss_class,
        axis=axis,
        distribution=expected.distribution,
        interpretation=expected.interpretation,
        absorbed_by_alignment=expected.absorbed_by_alignment,
        conditions=expected.what,
    )
