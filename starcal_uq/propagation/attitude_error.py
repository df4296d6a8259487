"""The attitude error of single frames by contributor: the result of
`starcal_uq.propagation.propagate.propagate`.

Every error has two figures, under the same two names wherever it is shown: *if the model holds*, by
the posterior alone, and *with the misfit found*, beside the effects that the data support where
tests of the model find structure. The second is the headline, and it is not assessed, never equal
to the first, until the model has been tested.
Both are computed here and nowhere else.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.constants import AXES, INTERACTION, TOTAL_AXES
from starcal_uq.core.display import Shown
from starcal_uq.core.files import reading, write_csv
from starcal_uq.core.formatting import count, plural
from starcal_uq.core.records import from_plain, to_json
from starcal_uq.core.remedy import RUN, Remedy
from starcal_uq.core.settings import OnboardModel
from starcal_uq.core.types import AnyDict, BoolArray, FloatArray, PathLike, floats
from starcal_uq.maths.circular import mixture_radius
from starcal_uq.maths.intervals import HALF_WIDTH_95, HALF_WIDTH_997
from starcal_uq.maths.linear import root_diagonal
from starcal_uq.propagation.onboard_error import EffectError, OnboardError, with_cross
from starcal_uq.propagation.thermal import ThermalError, ThermalResponse

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.observations.table import Observations

CONTRIBUTORS = (
    "centroid noise (NEA)",
    "calibration, common rotation",
    "calibration, rest",
    "calibration, total",
    INTERACTION,
)
# The rows of the calibration, as parts of what is left with an onboard model.
_OF_CALIBRATION = ("common rotation", "rest", "total")
OBSERVED = "observed frames"
# What alignment was taken to be where nothing is said about it.
SAME_FRAMES = "the frames themselves"
# What stands in the table, as it is called now, and as earlier versions called it.
_NAMES = ("if_model_holds", "p95_if_model_holds", "p997_if_model_holds", "first_order")
_FORMER_NAMES = ("sigma", "p95", "p997", "first_order")
# Columns of a row of a covariance, one for each axis.
_COVARIANCES = tuple(f"covariance_{axis}_arcsec2" for axis in AXES)
_ABSORBED = ("no", "yes", "no", "in part", "no")
# Runs of earlier versions hold the first four only.
_REQUIRED = CONTRIBUTORS[:4]
# A ratio of sigmas below a microarcsecond means nothing.
_SMALLEST_ARCSEC = 1e-6

IF_MODEL_HOLDS, WITH_MISFIT_FOUND = "if the model holds", "with the misfit found"
NOT_ASSESSED = "not assessed"
# Confidences of the half-widths, and the two-sided quantiles of a Gaussian error.
_CONFIDENCES = (0.95, 0.997)
_GAUSSIAN = (HALF_WIDTH_95, HALF_WIDTH_997)


@dataclass(frozen=True, eq=False)
class Agreement(Shown):
    """Sampled over first-order standard deviations.

    Noise, draws and first-order propagation share the same realisations, so that the ratios depart
    from one by what is not linear, and hardly by chance.

    Attributes
    ----------
    contributors : tuple of str
        Rows: centroid noise, common rotation and rest.
    ratio : (3, 3) array
        Sampled over first order; columns are pitch, yaw and roll. NaN where both are below a
        microarcsecond.
    """

    contributors: tuple[str, ...]
    ratio: FloatArray

    @property
    def largest(self) -> float:
        """Largest departure of a ratio from one; 0 where there is none to be had."""
        real = self.ratio[np.isfinite(self.ratio)]
        return float(np.max(np.abs(real - 1.0), initial=0.0))

    def to_dataframe(self) -> pd.DataFrame:
        """One row per contributor and axis: ``contributor``, ``axis``,
        ``sampled_over_first_order``.
        """
        import pandas as pd

        return pd.DataFrame(
            {
                "contributor": np.repeat(self.contributors, 3).astype(object),
                "axis": np.array(AXES * len(self.contributors), dtype=object),
                "sampled_over_first_order": self.ratio.ravel(),
            }
        )


@dataclass(frozen=True, eq=False)
class AttitudeError(Shown):
    """Attitude error of single frames by contributor, arcsec.

    Axes are ``("pitch", "yaw", "roll")``: left rotation vectors about camera +X, +Y and the
    boresight +Z.

    Attributes
    ----------
    nea_arcsec : (3,) array
        Centroid noise: root mean square over frames of the standard deviation.
    common_arcsec : (3,) array
        Standard deviation of the common rotation over the posterior.
    rest_arcsec : (3,) array
        Standard deviation of the rest over the posterior, root mean square over frames.
    p95_arcsec, p997_arcsec : (5, 4) array
        Half-widths that hold 95 % and 99.7 % of the absolute errors: rows are `CONTRIBUTORS`,
        columns the three axes and the angle across the boresight, the root of pitch^2 + yaw^2 (2.45
        and 3.41 sigma per axis if Gaussian).
    analytic_nea_arcsec, analytic_common_arcsec, analytic_rest_arcsec : (3,) array
        Standard deviations by first-order propagation on the same frames, arcsec.
    n_draws, n_frames : int
        Numbers of draws and frames behind the result.
    n_sampled_frames : int
        Frames on which the draws went through QUEST; on the others the result is that of first
        order, and what the sample shows beyond it. 0 in files of a version that took all.
    common_draws_arcsec : (D, 3) array or None
        Common rotation of every draw; None when read from a file.
    rest_rms_per_frame_arcsec : (K, 3) array or None
        Standard deviation of the rest in each frame; None when read from a file.
    nea_per_frame_arcsec : (K, 3) array or None
        Standard deviation from centroid noise in each frame, first order; None when read from a
        file.
    interaction_arcsec : (3,) array
        Root mean square of what noise and a wrong calibration do together beyond the sum of what
        each does alone. To first order there is nothing. NaN when read from a file of a version
        that did not sample it.
    frames : str
        Which frames these are, such as ``observed frames``.
    total_arcsec, analytic_total_arcsec : (3,) array or None
        Standard deviation of common rotation and rest together, which may be correlated, sampled
        and by first order; None in files of a version where they were not.
    rest_constant_arcsec : (3,) array
        Standard deviation of the part of the rest that all of the mission's frames share: a bias
        after alignment.
    covariance_arcsec2 : (5, 3, 3) array
        Covariances of pitch, yaw and roll, arcsec^2, mean over frames; rows are `CONTRIBUTORS`.
        Their diagonals are the squares of the standard deviations.
    alignment : str
        Frames on which alignment is calibrated, which decide what is common.
    alignment_covariance_arcsec2 : (3, 3) array
        Covariance of the alignment itself from the noise of its frames, arcsec^2; NaN in files of a
        version without.
    aligned : Observations or None
        Frames of the alignment; None when read from a file.
    misfit : OnboardError or None
        The calibration's part beside the effects that its data support; what holds if the model
        does where they ask for none. None where that is not assessed.
    seen : Observations or None
        The frames themselves; None when read from a file.
    onboard : {"model", "effects"}
        What the mission's software uses, where the calibration holds effects.
    variants : tuple of OnboardError
        The calibration's part with every onboard model; empty without effects. That of `onboard`
        stands in the other fields as well.
    thermal_response : ThermalResponse or None
        How attitudes follow the temperature of the optics; None without such an effect.
    thermal : ThermalError or None
        The error over a temperature profile; None where none was given.
    effects_per_frame_arcsec : (K, 3) array or None
        Root mean square of what effects of every frame by itself do to each frame; None without
        such, and when read from a file.

    Notes
    -----
    All fields but `misfit` hold if the model does.
    """

    nea_arcsec: FloatArray
    common_arcsec: FloatArray
    rest_arcsec: FloatArray
    p95_arcsec: FloatArray
    p997_arcsec: FloatArray
    analytic_nea_arcsec: FloatArray
    analytic_common_arcsec: FloatArray
    analytic_rest_arcsec: FloatArray
    n_draws: int
    n_frames: int
    common_draws_arcsec: FloatArray | None = None
    rest_rms_per_frame_arcsec: FloatArray | None = None
    nea_per_frame_arcsec: FloatArray | None = None
    interaction_arcsec: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    frames: str = OBSERVED
    misfit: OnboardError | None = None
    seen: Observations | None = None
    total_arcsec: FloatArray | None = None
    analytic_total_arcsec: FloatArray | None = None
    rest_constant_arcsec: FloatArray = field(default_factory=lambda: np.zeros(3))
    covariance_arcsec2: FloatArray = field(
        default_factory=lambda: np.full((len(CONTRIBUTORS), 3, 3), np.nan)
    )
    alignment: str = SAME_FRAMES
    alignment_covariance_arcsec2: FloatArray = field(
        default_factory=lambda: np.full((3, 3), np.nan)
    )
    aligned: Observations | None = None
    n_sampled_frames: int = 0
    onboard: OnboardModel = "model"
    variants: tuple[OnboardError, ...] = ()
    effects_per_frame_arcsec: FloatArray | None = None
    thermal_response: ThermalResponse | None = None
    thermal: ThermalError | None = None

    @property
    def aboard(self) -> OnboardError | None:
        """The calibration's part with the onboard model; None without effects."""
        return next((own for own in self.variants if own.onboard == self.onboard), None)

    @property
    def effects(self) -> tuple[EffectError, ...]:
        """Attitude errors by the effects of the calibration, with the onboard model."""
        return () if self.aboard is None else self.aboard.effects

    @property
    def told_frames(self) -> str:
        """The frames through which draws went, in words."""
        if self.n_sampled_frames in (0, self.n_frames):
            return f"{plural(self.n_frames, 'frame')} ({self.frames})"
        return f"{count(self.n_sampled_frames)} of {plural(self.n_frames, 'frame')} ({self.frames})"

    @property
    def alignment_arcsec(self) -> FloatArray:
        """Standard deviation (3,) of the alignment, which replaces the common rotation afterwards."""
        return root_diagonal(self.alignment_covariance_arcsec2)

    @property
    def stays(self) -> BoolArray:
        """True (3,) where most of the rest is one constant of the mission, as for frames that stare
        at one field.
        """
        return self.rest_constant_arcsec**2 > 0.5 * self.rest_arcsec**2

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the three axes."""
        return AXES

    @property
    def calibration_total_arcsec(self) -> FloatArray:
        """Common rotation and rest together (3,)."""
        return (
            np.hypot(self.common_arcsec, self.rest_arcsec)
            if self.total_arcsec is None
            else self.total_arcsec
        )

    @property
    def agreement(self) -> Agreement:
        """Sampled beside first-order propagation."""
        sampled = np.stack((self.nea_arcsec, self.common_arcsec, self.rest_arcsec))
        first = np.stack(
            (self.analytic_nea_arcsec, self.analytic_common_arcsec, self.analytic_rest_arcsec)
        )
        real = np.maximum(sampled, first) > _SMALLEST_ARCSEC
        ratio = np.where(real, sampled / np.where(first > 0.0, first, np.nan), np.nan)
        return Agreement(CONTRIBUTORS[:3], ratio)

    @property
    def if_model_holds_arcsec(self) -> FloatArray:
        """Standard deviations (5, 4) by the posterior alone.

        Rows are `CONTRIBUTORS`, columns the three axes and the root mean square of the two across
        the boresight.
        """
        rows = (
            self.nea_arcsec,
            self.common_arcsec,
            self.rest_arcsec,
            self.calibration_total_arcsec,
            self.interaction_arcsec,
        )
        return np.stack([with_cross(floats(row)) for row in rows])

    @property
    def with_misfit_found_arcsec(self) -> FloatArray:
        """Standard deviations (5, 4) including the misfit found by the tests of the model; NaN if
        not assessed.
        """
        found, held = self.misfit, self.if_model_holds_arcsec
        if found is None:
            return np.full_like(held, np.nan)
        parts = (found.common_arcsec, found.rest_arcsec, found.total_arcsec)
        return np.stack([held[0], *(with_cross(values) for values in parts), held[4]])

    @property
    def headline_arcsec(self) -> FloatArray:
        """Standard deviations (5, 4) with the misfit found; those if the model holds where that is
        not assessed.
        """
        return self.if_model_holds_arcsec if self.misfit is None else self.with_misfit_found_arcsec

    @property
    def half_widths_with_misfit_found_arcsec(self) -> FloatArray:
        """Half-widths (2, 5, 4) that hold 95 % and 99.7 % of the errors with the misfit found; NaN
        if not assessed.

        What effects add is taken as Gaussian: the excess of the tails over Gaussian ones shrinks
        with its share.
        """
        held, found = self.if_model_holds_arcsec, self.with_misfit_found_arcsec
        share = np.minimum(
            np.where(found > 0.0, held / np.where(found > 0.0, found, 1.0), 1.0), 1.0
        )
        share = share**2
        widths = np.stack((self.p95_arcsec, self.p997_arcsec))
        tails = widths / np.where(held > 0.0, held, np.nan)
        gaussian = np.stack(
            [_gaussian_tails(held, *pair) for pair in zip(_CONFIDENCES, _GAUSSIAN, strict=True)]
        )
        excess = np.nan_to_num(tails - gaussian)
        wanted = np.stack(
            [_gaussian_tails(found, *pair) for pair in zip(_CONFIDENCES, _GAUSSIAN, strict=True)]
        )
        return (wanted + share * excess) * found

    def to_dataframe(self) -> pd.DataFrame:
        """One row per contributor and axis.

        Columns are ``contributor``, ``axis``, the standard deviations ``if_model_holds_arcsec`` and
        ``with_misfit_found_arcsec`` (NaN: not assessed), the half-widths
        ``p95_if_model_holds_arcsec``, ``p95_with_misfit_found_arcsec`` and the same for ``p997``,
        ``first_order_arcsec`` (sigma by first-order propagation) and ``absorbed_by_alignment``
        (yes, no, in part). The cross-boresight rows hold the root mean square of the sigmas of
        pitch and yaw.
        """
        import pandas as pd

        analytic = (
            self.analytic_nea_arcsec,
            self.analytic_common_arcsec,
            self.analytic_rest_arcsec,
            np.hypot(self.analytic_common_arcsec, self.analytic_rest_arcsec)
            if self.analytic_total_arcsec is None
            else self.analytic_total_arcsec,
            0.0 * self.interaction_arcsec,
        )
        p95, p997 = self.half_widths_with_misfit_found_arcsec
        return pd.DataFrame(
            {
                "contributor": np.repeat(CONTRIBUTORS, len(TOTAL_AXES)).astype(object),
                "axis": np.array(TOTAL_AXES * len(CONTRIBUTORS), dtype=object),
                "if_model_holds_arcsec": self.if_model_holds_arcsec.ravel(),
                "with_misfit_found_arcsec": self.with_misfit_found_arcsec.ravel(),
                "p95_if_model_holds_arcsec": self.p95_arcsec.ravel(),
                "p95_with_misfit_found_arcsec": p95.ravel(),
                "p997_if_model_holds_arcsec": self.p997_arcsec.ravel(),
                "p997_with_misfit_found_arcsec": p997.ravel(),
                "first_order_arcsec": np.concatenate([with_cross(values) for values in analytic]),
                "absorbed_by_alignment": np.repeat(_ABSORBED, len(TOTAL_AXES)).astype(object),
            }
        )

    def to_written(self) -> pd.DataFrame:
        """The table as files and JSON have it: ``not assessed`` in words where the model was not
        tested.
        """
        table = self.to_dataframe()
        if self.misfit is None:
            table = table.assign(
                **{name: NOT_ASSESSED for name in table.columns if "with_misfit_found" in name}
            )
        return table

    def save(self, path: PathLike) -> None:
        """Write the table as CSV, atomically and to the last digit; overwritten. Single draws are
        not kept.
        """
        misfit = "" if self.misfit is None else to_json(self.misfit)
        table = self.to_written().assign(
            n_draws=self.n_draws,
            n_frames=self.n_frames,
            n_sampled_frames=self.n_sampled_frames,
            frames=self.frames,
        )
        every = {
            "rest_constant_arcsec": self.rest_constant_arcsec,
            "alignment_sigma_arcsec": self.alignment_arcsec,
        }
        columns = {
            name: np.tile(with_cross(values), len(CONTRIBUTORS)) for name, values in every.items()
        }
        # A line holds its row of the matrix; the angle across the boresight has none.
        for prefix, matrices in (
            ("", self.covariance_arcsec2),
            ("alignment_", self.alignment_covariance_arcsec2),
        ):
            filled = np.full((len(CONTRIBUTORS), len(TOTAL_AXES), 3), np.nan)
            filled[:, :3] = matrices
            columns |= {
                prefix + name: filled[..., i].ravel() for i, name in enumerate(_COVARIANCES)
            }
        table = table.assign(alignment=self.alignment, **columns)
        if self.variants:
            aboard = to_json(_Aboard(self.onboard, self.variants, self.thermal_response))
            table = table.assign(onboard=[aboard] + [""] * (len(table) - 1))
            for own in self.variants:
                figures = np.full((len(CONTRIBUTORS), len(TOTAL_AXES)), np.nan)
                figures[1:4] = [with_cross(own.parts[name]) for name in _OF_CALIBRATION]
                table[f"onboard_{own.onboard}_arcsec"] = figures.ravel()
        # Once is enough: it is the same for all rows.
        write_csv(table.assign(misfit=[misfit] + [""] * (len(table) - 1)), path)

    @classmethod
    def load(cls, path: PathLike) -> AttitudeError:
        """Read a table written by `save`.

        A table of a version that did not sample the interaction is read; the interaction is then
        not known (NaN).

        Raises
        ------
        RunFolderError
            If the file is missing or is not such a table.
        """
        with reading(
            path,
            "a table of attitude errors",
            Remedy("propagate", (RUN,), {"force": True}, "to write it again"),
        ):
            with open(path, newline="", encoding="utf-8") as file:
                rows = {(row["contributor"], row["axis"]): row for row in csv.DictReader(file)}
            known = CONTRIBUTORS if (INTERACTION, AXES[0]) in rows else _REQUIRED

            def numbers(column: str, axes: Sequence[str] = TOTAL_AXES) -> FloatArray:
                """A column by contributor and axis; NaN where nothing stands."""
                found = np.full((len(CONTRIBUTORS), len(axes)), np.nan)
                found[: len(known)] = [
                    [float(rows[one, axis][column] or "nan") for axis in axes] for one in known
                ]
                return found

            first = rows[known[0], TOTAL_AXES[0]]
            names = _NAMES if f"{_NAMES[0]}_arcsec" in first else _FORMER_NAMES
            table = np.array([numbers(f"{name}_arcsec") for name in names])
            if not np.isfinite(table[:, : len(_REQUIRED)]).all():
                raise ValueError("a number is missing")
            sigma, p95, p997, analytic = table
            others: AnyDict = {name: int(first[name]) for name in ("n_draws", "n_frames")}
            others["n_sampled_frames"] = int(first.get("n_sampled_frames") or 0)
            others["frames"] = first.get("frames") or OBSERVED
            others["interaction_arcsec"] = sigma[4, :3]
            # Of an earlier version: estimates of a pattern in squares, which is no assessment.
            misfit = json.loads(first.get("misfit") or "{}")
            if "onboard" in misfit:
                others["misfit"] = from_plain(OnboardError, misfit)
            if first.get("onboard"):
                others |= vars(from_plain(_Aboard, json.loads(first["onboard"])))
            if first.get("alignment"):
                constant = [float(rows[known[0], axis]["rest_constant_arcsec"]) for axis in AXES]
                aligned = [numbers(f"alignment_{name}", AXES)[0] for name in _COVARIANCES]
                others |= {
                    "alignment": first["alignment"],
                    "total_arcsec": sigma[3, :3],
                    "analytic_total_arcsec": analytic[3, :3],
                    "rest_constant_arcsec": np.array(constant),
                    "covariance_arcsec2": np.stack(
                        [numbers(name, AXES) for name in _COVARIANCES], axis=-1
                    ),
                    "alignment_covariance_arcsec2": np.stack(aligned, axis=-1),
                }
        single = [*sigma[:3, :3], p95, p997, *analytic[:3, :3]]
        return cls(*single, **others)


@dataclass(frozen=True, eq=False)
class _Aboard:
    """What a file holds of onboard models."""

    onboard: OnboardModel
    variants: tuple[OnboardError, ...]
    thermal_response: ThermalResponse | None = None


def _gaussian_tails(sigmas: FloatArray, confidence: float, one_axis: float) -> FloatArray:
    """Half-widths over sigmas (5, 4) that Gaussian errors would have: of one axis, and of the angle
    across.
    """
    across = [
        mixture_radius(np.diag(row[:2] ** 2), confidence) / row[3] if row[3] > 0.0 else np.nan
        for row in sigmas
    ]
    return np.column_stack((np.full((len(sigmas), 3), one_axis), across))
