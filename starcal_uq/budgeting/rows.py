"""The rows of an error budget: one contributor on one axis, and the contributors that no budget may
leave out.

The classes are those of ECSS-E-ST-60-20C (star sensors): bias, thermo-elastic error, field-of-view
spatial error, pixel spatial error, aberration, temporal noise, measurement date error. What a
calibration cannot know is in this list too, so that it is read as "not assessed" and never as zero.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from decimal import Decimal
from enum import Enum
from pathlib import Path
from typing import ClassVar

from starcal_uq.core.constants import AXES, CROSS_BORESIGHT
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


# What to know of the rows, under what conditions they hold, and where their numbers are from.
Remark = Enum(
    "Remark",
    "REPLACED TWICE NOT_ASSESSED IN_PART OF_HEADS WEIGHTS UNTESTED SUPPORTED OF_DRAWS OF_FRAMES"
    " OF_EFFECT OF_SENSOR",
)


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
    absorbed_by_alignment: str = "no"
    distribution: str = "gaussian"
    what: str = ""


_DECLARED = tomllib.loads(Path(__file__).with_name("contributors.toml").read_text("utf-8"))
FROM_POSTERIOR = tuple(Expected(**entry) for entry in _DECLARED["posterior"])
INTERACTING = Expected(**_DECLARED["interacting"])
UNTESTED = Expected(**_DECLARED["untested"])
# By effect; two of them are in every budget.
OF_EFFECTS = {effect: Expected(**entry) for effect, entry in _DECLARED["effects"].items()}
FROM_FILE = tuple(
    OF_EFFECTS[entry["effect"]] if "effect" in entry else Expected(**entry)
    for entry in _DECLARED["file"]
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
    entries = dict(vars(expected))
    return Contributor(axis=axis, conditions=entries.pop("what"), **entries)
