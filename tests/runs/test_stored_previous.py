"""Files that the version before wrote are read. They are small ones of every kind, in
``data/previous``.
"""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from starcal_uq.budgeting.result import Budget
from starcal_uq.camera.camera import Camera
from starcal_uq.comparison.result import CameraComparison
from starcal_uq.core.records import from_plain, read_arrays, to_plain, write_json
from starcal_uq.core.status import Status
from starcal_uq.diagnostics.diagnose import Diagnosis
from starcal_uq.diagnostics.validation.result import Validation
from starcal_uq.estimation.merging import Consistency
from starcal_uq.estimation.result import Calibration
from starcal_uq.observations.table import load_observations
from starcal_uq.paper.recursive.stream import RecursiveCalibration
from starcal_uq.paper.replicates import Replicates
from starcal_uq.pipeline.record import ImageRecord
from starcal_uq.propagation.attitude_error import AttitudeError
from starcal_uq.propagation.field import FieldMap
from starcal_uq.propagation.spectrum import ErrorSpectrum
from starcal_uq.simulation.sensor import Sensor
from starcal_uq.sky.site import Site

PREVIOUS = Path(__file__).parent / "data" / "previous"
SAVED: dict[str, Any] = {
    "attitude.csv": AttitudeError,
    "budget.csv": Budget,
    "calibration.json": Calibration,
    "camera.toml": Camera,
    "diagnosis.json": Diagnosis,
    "field_map.npz": FieldMap,
    "filtered.json": Calibration,
    "images.json": ImageRecord,
    "replicates.npz": Replicates,
    "sensor.toml": Sensor,
    "site.toml": Site,
    "spectrum.npz": ErrorSpectrum,
    "validation.npz": Validation,
}


def content(path: Path) -> Any:
    """What a file holds, whatever the order of the names in it, and the comments."""
    if path.suffix == ".toml":
        return tomllib.loads(path.read_text(encoding="utf-8"))
    if path.suffix != ".npz":
        return path.read_bytes()
    arrays = read_arrays(path)
    text = str(arrays.pop("document")) if "document" in arrays else "{}"
    return json.loads(text), {
        name: (value.dtype, value.tobytes()) for name, value in arrays.items()
    }


# Columns that tables no longer have; they may have further ones.
GONE: dict[str, set[str]] = {
    "budget.csv": {"time_class", "raw_sigma_arcsec"},
    "attitude.csv": {"sigma_arcsec", "p95_arcsec", "p997_arcsec"},
}


def holds(again: Any, before: Any) -> bool:
    """Is all that was in a document still in it? Records may have further fields."""
    if isinstance(before, dict):
        return all(key in again and holds(again[key], value) for key, value in before.items())
    if isinstance(before, list):
        return len(again) == len(before) and all(map(holds, again, before))
    return repr(again) == repr(before)


@pytest.mark.parametrize("name", SAVED)
def test_a_result_is_read_and_written_again_as_it_was(tmp_path: Path, name: str) -> None:
    SAVED[name].load(PREVIOUS / name).save(tmp_path / name)
    if name in GONE:
        again, before = (
            pd.read_csv(folder / name, dtype=str).fillna("") for folder in (tmp_path, PREVIOUS)
        )
        kept = [column for column in before if column in again]
        assert set(before) - set(kept) == GONE[name]
        assert again[kept][: len(before)].equals(before[kept])
        return
    arrays = PREVIOUS / name.replace(".json", ".npz")
    if name in ("calibration.json", "filtered.json"):
        assert content(tmp_path / arrays.name) == content(arrays)
    if name in ("diagnosis.json", "images.json", "calibration.json", "filtered.json"):
        assert holds(
            json.loads((tmp_path / name).read_text()), json.loads((PREVIOUS / name).read_text())
        )
        return
    if name == "sensor.toml":
        again, before = (
            tomllib.loads((folder / name).read_text("utf-8")) for folder in (tmp_path, PREVIOUS)
        )
        assert holds(again, before)
        return
    assert content(tmp_path / name) == content(PREVIOUS / name)


def test_a_comparison_is_read_and_written_again_as_it_was(tmp_path: Path) -> None:
    comparison = CameraComparison.load(PREVIOUS / "comparison.json")
    write_json(
        {"verdict": comparison.verdict, **to_plain(comparison, null=True)},
        tmp_path / "comparison.json",
    )
    assert content(tmp_path / "comparison.json") == content(PREVIOUS / "comparison.json")


def test_the_consistency_of_merged_runs_is_read() -> None:
    plain = json.loads((PREVIOUS / "consistency.json").read_text(encoding="utf-8"))
    assert to_plain(from_plain(Consistency, plain), null=True) == plain


def test_results_hold_what_they_held() -> None:
    calibration = Calibration.load(PREVIOUS / "calibration.json")
    observations = load_observations(PREVIOUS / "observations.parquet")
    assert calibration.status is Status.CONVERGED
    assert calibration.provenance["data_sha256"] == observations.data_hash
    assert calibration.residuals_px.shape == (observations.n_stars, 2)
    assert [stage.name for stage in calibration.stages] == [
        "optics",
        "distortion",
        "all",
        "refinement",
    ]
    diagnosis = Diagnosis.load(PREVIOUS / "diagnosis.json")
    assert diagnosis.is_of(calibration)
    assert any(np.isnan(test.size_px) for test in diagnosis.misfit.tests)


def test_a_recursive_calibration_goes_on_from_its_state(tmp_path: Path) -> None:
    steps = RecursiveCalibration.load(PREVIOUS / "state.npz")
    observations = load_observations(PREVIOUS / "observations.parquet")
    whole = RecursiveCalibration(steps.nominal, steps.method, steps.options)
    whole.update(observations)
    assert steps.n_frames == observations.n_frames and steps._digest == whole._digest
    assert np.allclose(steps.step.theta, whole.step.theta, rtol=1e-9, atol=0.0)
    steps.save(tmp_path / "state.npz")
    again = RecursiveCalibration.load(tmp_path / "state.npz")
    for one in (steps, again, whole):
        one.update(observations)
    assert np.array_equal(steps.step.theta, again.step.theta)
    assert np.allclose(steps.step.theta, whole.step.theta, rtol=1e-9, atol=0.0)
