"""The attitude error of single frames by contributor: the result of `starcal_uq.propagation.propagate.propagate`."""

from __future__ import annotations

import csv
import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.constants import AXES, INTERACTION, TOTAL_AXES
from starcal_uq.core.display import Shown
from starcal_uq.core.files import reading, write_csv
from starcal_uq.core.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd

CONTRIBUTORS = (
    "centroid noise (NEA)",
    "calibration, common rotation",
    "calibration, rest",
    "calibration, total",
    INTERACTION,
)
OBSERVED = "observed frames"
_ABSORBED = ("no", "yes", "no", "in part", "no")
# Runs of earlier versions hold the first four only.
_REQUIRED = CONTRIBUTORS[:4]
# A ratio of sigmas below a microarcsecond means nothing.
_SMALLEST_ARCSEC = 1e-6


@dataclass(frozen=True, eq=False)
class Agreement(Shown):
    """Sampled over first-order standard deviations.

    Noise, draws and first-order propagation share the same realisations, so that the ratios depart from one by what is
    not linear, and hardly by chance.

    Attributes
    ----------
    contributors : tuple of str
        Rows: centroid noise, common rotation and rest.
    ratio : (3, 3) array
        Sampled over first order; columns are pitch, yaw and roll. NaN where both are below a microarcsecond.
    """

    contributors: tuple[str, ...]
    ratio: FloatArray

    @property
    def largest(self) -> float:
        """Largest departure of a ratio from one; 0 where there is none to be had."""
        real = self.ratio[np.isfinite(self.ratio)]
        return float(np.max(np.abs(real - 1.0), initial=0.0))

    def to_dataframe(self) -> pd.DataFrame:
        """One row per contributor and axis: ``contributor``, ``axis``, ``sampled_over_first_order``."""
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

    Axes are ``("pitch", "yaw", "roll")``: left rotation vectors about camera +X, +Y and the boresight +Z.

    Attributes
    ----------
    nea_arcsec : (3,) array
        Centroid noise: root mean square over frames of the standard deviation.
    common_arcsec : (3,) array
        Standard deviation of the common rotation over the posterior.
    rest_arcsec : (3,) array
        Standard deviation of the rest over the posterior, root mean square over frames.
    p95_arcsec, p997_arcsec : (5, 4) array
        Half-widths that hold 95 % and 99.7 % of the absolute errors: rows are `CONTRIBUTORS`, columns the three axes
        and the angle across the boresight, the root of pitch^2 + yaw^2 (2.45 and 3.41 sigma per axis if Gaussian).
    analytic_nea_arcsec, analytic_common_arcsec, analytic_rest_arcsec : (3,) array
        Standard deviations by first-order propagation on the same frames, arcsec.
    n_draws, n_frames : int
        Numbers of draws and frames behind the result.
    common_draws_arcsec : (D, 3) array or None
        Common rotation of every draw; None when read from a file.
    rest_rms_per_frame_arcsec : (K, 3) array or None
        Standard deviation of the rest in each frame; None when read from a file.
    nea_per_frame_arcsec : (K, 3) array or None
        Standard deviation from centroid noise in each frame, first order; None when read from a file.
    interaction_arcsec : (3,) array
        Root mean square of what noise and a wrong calibration do together beyond the sum of what each does alone. To
        first order there is nothing. NaN when read from a file of a version that did not sample it.
    frames : str
        Which frames these are, such as ``observed frames``.
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

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the three axes."""
        return AXES

    @property
    def calibration_total_arcsec(self) -> FloatArray:
        """Common rotation and rest together (3,), which are uncorrelated by construction."""
        return np.hypot(self.common_arcsec, self.rest_arcsec)

    @property
    def agreement(self) -> Agreement:
        """Sampled beside first-order propagation."""
        sampled = np.stack((self.nea_arcsec, self.common_arcsec, self.rest_arcsec))
        first = np.stack((self.analytic_nea_arcsec, self.analytic_common_arcsec, self.analytic_rest_arcsec))
        real = np.maximum(sampled, first) > _SMALLEST_ARCSEC
        ratio = np.where(real, sampled / np.where(first > 0.0, first, np.nan), np.nan)
        return Agreement(CONTRIBUTORS[:3], ratio)

    def to_dataframe(self) -> pd.DataFrame:
        """One row per contributor and axis.

        Columns are ``contributor``, ``axis``, ``sigma_arcsec``, ``p95_arcsec``, ``p997_arcsec``,
        ``first_order_arcsec`` (sigma by first-order propagation) and ``absorbed_by_alignment`` (yes, no, in part).
        The cross-boresight rows hold the root mean square of the sigmas of pitch and yaw.
        """
        import pandas as pd

        sampled = (
            self.nea_arcsec,
            self.common_arcsec,
            self.rest_arcsec,
            self.calibration_total_arcsec,
            self.interaction_arcsec,
        )
        analytic = (
            self.analytic_nea_arcsec,
            self.analytic_common_arcsec,
            self.analytic_rest_arcsec,
            np.hypot(self.analytic_common_arcsec, self.analytic_rest_arcsec),
            0.0 * self.interaction_arcsec,
        )
        return pd.DataFrame(
            {
                "contributor": np.repeat(CONTRIBUTORS, len(TOTAL_AXES)).astype(object),
                "axis": np.array(TOTAL_AXES * len(CONTRIBUTORS), dtype=object),
                "sigma_arcsec": np.concatenate([with_cross(values) for values in sampled]),
                "p95_arcsec": self.p95_arcsec.ravel(),
                "p997_arcsec": self.p997_arcsec.ravel(),
                "first_order_arcsec": np.concatenate([with_cross(values) for values in analytic]),
                "absorbed_by_alignment": np.repeat(_ABSORBED, len(TOTAL_AXES)).astype(object),
            }
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the table as CSV, atomically and to the last digit; overwritten. Single draws are not kept."""
        table = self.to_dataframe().assign(n_draws=self.n_draws, n_frames=self.n_frames, frames=self.frames)
        write_csv(table, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> AttitudeError:
        """Read what `save` wrote.

        A table of a version that did not sample the interaction is read; the interaction is then not known (NaN).

        Raises
        ------
        RunFolderError
            If the file is missing or is not such a table.
        """
        names = ("sigma", "p95", "p997", "first_order")
        with reading(path, "a table of attitude errors", "run `starcal-uq propagate RUN` to write it"):
            with open(path, newline="", encoding="utf-8") as file:
                rows = {(row["contributor"], row["axis"]): row for row in csv.DictReader(file)}
            known = CONTRIBUTORS if (INTERACTION, AXES[0]) in rows else _REQUIRED
            chosen = [[rows[contributor, axis] for axis in TOTAL_AXES] for contributor in known]
            table = np.full((len(names), len(CONTRIBUTORS), len(TOTAL_AXES)), np.nan)
            table[:, : len(known)] = [
                [[float(row[f"{name}_arcsec"] or "nan") for row in line] for line in chosen] for name in names
            ]
            if not np.isfinite(table[:, : len(_REQUIRED)]).all():
                raise ValueError("a number is missing")
            first = chosen[0][0]
            counts = {name: int(first[name]) for name in ("n_draws", "n_frames")}
            frames = first.get("frames") or OBSERVED
        sigma, p95, p997, analytic = table
        return cls(
            *(sigma[0, :3], sigma[1, :3], sigma[2, :3], p95, p997),
            *(analytic[0, :3], analytic[1, :3], analytic[2, :3]),
            n_draws=counts["n_draws"],
            n_frames=counts["n_frames"],
            interaction_arcsec=sigma[4, :3],
            frames=frames,
        )


def with_cross(sigma: FloatArray) -> FloatArray:
    """Sigmas of the three axes (3,), then the root mean square of the two across the boresight: (4,)."""
    return np.append(sigma, np.sqrt(np.mean(sigma[:2] ** 2)))
