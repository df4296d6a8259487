"""The result of the field experiment: cameras, identifications and attitude errors beside the
paper's Table 3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from starcal_uq.camera.camera import Camera
from starcal_uq.core.display import Shown
from starcal_uq.core.provenance import Provenance
from starcal_uq.core.types import AnyDict
from starcal_uq.estimation.result import Calibration
from starcal_uq.maths.intervals import wilson_interval
from starcal_uq.paper.field.attitudes import (
    PARTS,
    SOURCES,
    AttitudeErrors,
    FieldReplicates,
    FieldStars,
    attitude_errors,
    single_faults,
)
from starcal_uq.paper.field.frames import FieldFrames, FieldIdentification
from starcal_uq.paper.field.published import AXES, FIELD_METHODS, RATE, FieldReading, printed_field

FIELD_REPORT = "field.html"
AS_IT_STANDS = "against the true attitude"
ALIGNED = "after alignment"
BOTH = "either way"
NEITHER = "no"


@dataclass(frozen=True, eq=False)
class FieldExperiment(Shown):
    """The paper's field experiment, simulated; the report is in the folder `path`.

    Cameras go by their names: ``uncalibrated``, the three methods, ``truth``. `sweep` has the
    identifications by camera and tolerance in px, of which `tolerance_px` is that of the main
    table; `stars` and `errors` are those of the main table, for cameras that identified a frame.
    `data_sheets` has identification and, if there is any, attitude errors of a camera with another
    nominal focal length (mm). `campaign_counts` says how many frames of the calibration there are,
    are ``identified``, and the ``stars`` of these, of which so many are ``wrong``.
    """

    path: Path
    reading: FieldReading
    tolerance_px: float
    frames: FieldFrames
    calibrations: Mapping[str, Calibration]
    cameras: Mapping[str, Camera]
    campaign_counts: Mapping[str, int]
    sweep: Mapping[tuple[str, float], FieldIdentification]
    data_sheets: Mapping[float, tuple[FieldIdentification, AttitudeErrors | None]]
    stars: Mapping[str, FieldStars]
    errors: Mapping[str, AttitudeErrors]
    replicates: FieldReplicates
    provenance: Provenance

    @property
    def report(self) -> Path:
        """The report, which needs no other file."""
        return self.path / FIELD_REPORT

    @property
    def tolerances(self) -> tuple[float, ...]:
        """Tolerances of the sweep, px, ascending."""
        return tuple(sorted({tolerance for _, tolerance in self.sweep}))

    def identified(self, camera: str) -> FieldIdentification:
        """The identification of the main table."""
        return self.sweep[camera, self.tolerance_px]

    def table_3(self) -> pd.DataFrame:
        """The paper's Table 3 beside ours: one row for each printed number.

        Columns: method, quantity, printed; ours, low, high: identification rate with its Wilson
        interval, or error against the true attitude with the range of 95 % of repetitions; aligned,
        aligned_low, aligned_high: the same about the mean over the frames; common (with its sign),
        rest, noise: the parts; agrees: whether the printed number is in the range, and in which
        one. Errors are root mean squares in arcsec.
        """
        return pd.DataFrame(
            [self._row(method, name) for method in FIELD_METHODS for name in (RATE, *AXES)]
        )

    def _row(self, method: str, quantity: str) -> AnyDict:
        number = printed_field(method, quantity)
        row: AnyDict = {"method": method, "quantity": quantity, "printed": number.text}
        if quantity == RATE:
            counts = _counts(self.identified(method))
            rate, low, high = (100.0 * counts[name] for name in ("rate", "low", "high"))
            agrees = "yes" if low <= number.value <= high else NEITHER
            return row | {"ours": rate, "low": low, "high": high, "agrees": agrees}
        if method not in self.errors:
            return row | {"agrees": NEITHER}
        parts = self._parts(method, AXES.index(quantity))
        for end in ("", "_low", "_high"):
            row[end.removeprefix("_") or "ours"] = parts[f"rms{end}"]
        names = ("aligned", "aligned_low", "aligned_high", "common", "rest", "noise")
        row |= {name: parts[name] for name in names}
        stands, aligned = (
            parts[f"{part}_low"] <= number.value <= parts[f"{part}_high"]
            for part in ("rms", "aligned")
        )
        either = ALIGNED if aligned else NEITHER
        return row | {"agrees": (BOTH if aligned else AS_IT_STANDS) if stands else either}

    def _parts(self, camera: str, axis: int) -> AnyDict:
        """Parts of the errors about an axis, arcsec, with their ranges over repetitions."""
        found: AnyDict = {}
        for part in PARTS:
            low, high = self.replicates.interval(camera, part)
            found[part] = float(getattr(self.errors[camera], part)[axis])
            found[f"{part}_low"], found[f"{part}_high"] = float(low[axis]), float(high[axis])
        return found

    def rates(self) -> pd.DataFrame:
        """Identification against tolerance: camera, tolerance_px, n_frames, correct, wrong, rate,
        low, high.
        """
        return pd.DataFrame(
            [
                {"camera": camera, "tolerance_px": tolerance, **_counts(found)}
                for (camera, tolerance), found in self.sweep.items()
            ]
        )

    def parts(self) -> pd.DataFrame:
        """What the errors consist of: a row for each camera and axis, arcsec.

        Columns: camera, axis, rms, sum_of_squares (root of the squares of the three parts),
        aligned, common, rest, noise, and for each of the parts the range over repetitions in
        ``_low`` and ``_high``.
        """
        rows = []
        for camera, errors in self.errors.items():
            for index, axis in enumerate(AXES):
                row: AnyDict = {"camera": camera, "axis": axis.removesuffix("_arcsec")}
                row["sum_of_squares"] = float(errors.sum_of_squares[index])
                rows.append(row | self._parts(camera, index))
        return pd.DataFrame(rows)

    def sources(self) -> pd.DataFrame:
        """Each fault of each camera by itself, without noise: camera, source, axis, common, rest
        (arcsec).

        The faults of an estimated camera make up for each other, so that together they do less than
        each alone.
        """
        rows = []
        for camera, stars in self.stars.items():
            faults = single_faults(self.reading.truth, self.cameras[camera])
            for source in SOURCES:
                errors = attitude_errors(stars, faults[source])
                for axis, common, rest in zip(
                    AXES, errors.common.tolist(), errors.rest.tolist(), strict=True
                ):
                    row = {"camera": camera, "source": source, "axis": axis.removesuffix("_arcsec")}
                    rows.append(row | {"common": common, "rest": rest})
        return pd.DataFrame(rows)

    def other_data_sheets(self) -> pd.DataFrame:
        """Other nominal focal lengths: focal_mm, identification as in `rates`, errors after
        alignment (arcsec).
        """
        rows = []
        for focal_mm, (found, errors) in self.data_sheets.items():
            aligned = np.full(3, np.nan) if errors is None else errors.aligned
            axes = dict(zip(AXES, aligned.tolist(), strict=True))
            rows.append({"focal_mm": focal_mm, **_counts(found), **axes})
        return pd.DataFrame(rows)

    def camera_table(self) -> pd.DataFrame:
        """The cameras: camera, parameter, value, sigma (claimed; empty where none is), truth; px
        units.
        """
        truth = self.reading.truth
        true = dict(zip(truth.parameter_names, truth.theta.tolist(), strict=True))
        rows = []
        for name, camera in self.cameras.items():
            known = self.calibrations.get(name)
            sigmas = [np.nan] * len(camera.theta) if known is None else known.sigmas.tolist()
            for parameter, value, sigma in zip(
                camera.parameter_names, camera.theta.tolist(), sigmas, strict=True
            ):
                row = {
                    "camera": name,
                    "parameter": parameter,
                    "value": value,
                    "sigma": sigma,
                    "truth": true[parameter],
                }
                rows.append(row)
        return pd.DataFrame(rows)

    def frame_table(self) -> pd.DataFrame:
        """Every test frame with every camera: camera, frame, n_stars, correct, wrong, pitch, yaw,
        roll (arcsec).
        """
        tables = []
        for camera in self.cameras:
            found = self.identified(camera)
            n = np.bincount(found.frame, minlength=found.n_frames)
            error = np.full((found.n_frames, 3), np.nan)
            if camera in self.errors:
                error[found.correct] = self.errors[camera].total
            columns: AnyDict = {"camera": camera, "frame": np.arange(found.n_frames), "n_stars": n}
            columns |= {"correct": found.correct, "wrong": found.wrong}
            columns |= {name: error[:, index] for index, name in enumerate(AXES)}
            tables.append(pd.DataFrame(columns))
        return pd.concat(tables, ignore_index=True)

    def tables(self) -> dict[str, pd.DataFrame]:
        """Every table by the name of its file."""
        return {
            "table_3": self.table_3(),
            "rates": self.rates(),
            "parts": self.parts(),
            "sources": self.sources(),
            "data_sheets": self.other_data_sheets(),
            "cameras": self.camera_table(),
            "frames": self.frame_table(),
        }

    def __repr__(self) -> str:
        return (
            f"FieldExperiment({self.reading.name}, {len(self.frames.rotations)} frames; report "
            f"{str(self.report)!r})"
        )


def _counts(found: FieldIdentification) -> AnyDict:
    correct = int(found.correct.sum())
    low, high = wilson_interval(correct, found.n_frames)
    counts = {"n_frames": found.n_frames, "correct": correct, "wrong": int(found.wrong.sum())}
    return counts | {"rate": correct / found.n_frames, "low": low, "high": high}
