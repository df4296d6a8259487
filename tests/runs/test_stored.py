"""The two files of a calibration belong together, and what a run was made from is not exchanged
behind its back.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import RunFolderError
from starcal_uq.estimation.result import Calibration
from starcal_uq.presentation.report.words import provenance_rows
from tests.helpers.scenes import observations

PREVIOUS = Path(__file__).parent / "data" / "previous"
FILES = ("calibration.json", "calibration.npz")


@pytest.fixture
def folders(tmp_path: Path) -> dict[str, Path]:
    """One calibration as an earlier version wrote it, and two of equal sizes as this one does:
    "one" and "other".
    """
    before = Calibration.load(PREVIOUS / "calibration.json")
    changes = {"one": 0.0, "other": 0.5}
    for name, shift in changes.items():
        (tmp_path / name).mkdir()
        moved = dataclasses.replace(
            before, theta=before.theta + shift, residuals_px=before.residuals_px + shift
        )
        moved.save(tmp_path / name / FILES[0])
    return {name: tmp_path / name for name in changes} | {"before": PREVIOUS}


@pytest.mark.parametrize(
    ("document", "archive"), [("one", "other"), ("other", "one"), ("other", "before")]
)
def test_a_document_is_not_read_with_the_archive_of_another(
    folders: dict[str, Path], tmp_path: Path, document: str, archive: str
) -> None:
    (tmp_path / "mixed").mkdir()
    for source, name in zip((document, archive), FILES, strict=True):
        shutil.copy(folders[source] / name, tmp_path / "mixed" / name)
    with pytest.raises(
        RunFolderError,
        match=r"calibration\.json: is not of the same calibration as calibration\.npz",
    ):
        Calibration.load(tmp_path / "mixed" / FILES[0])


def test_files_of_one_calibration_are_read_and_those_of_before_too(
    folders: dict[str, Path],
) -> None:
    for folder in folders.values():
        assert Calibration.load(folder / FILES[0]).status.ok
    assert "archive_sha256" in json.loads((folders["one"] / FILES[0]).read_text())
    assert "archive_sha256" not in json.loads((PREVIOUS / FILES[0]).read_text())


def test_a_reader_between_two_files_that_are_exchanged_is_refused(folders: dict[str, Path]) -> None:
    """The archive is written first: whoever reads then, or after a crash there, gets a sentence."""
    other = Calibration.load(folders["other"] / FILES[0])
    replace = dataclasses.replace
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("starcal_uq.estimation.result.write_json", lambda *_: None)
        replace(other, residuals_px=other.residuals_px + 1.0).save(folders["one"] / FILES[0])
    with pytest.raises(
        RunFolderError,
        match=r"is not of the same calibration .*; read it again .*, or run `starcal-uq",
    ):
        Calibration.load(folders["one"] / FILES[0])


def test_an_information_that_is_not_positive_definite_is_refused_when_it_is_read(
    folders: dict[str, Path],
) -> None:
    path = folders["one"] / FILES[0]
    good = json.loads(path.read_text())
    information = np.array(good["information"])
    scale = np.sqrt(np.diag(information))
    indefinite = np.outer(scale, scale) * (np.eye(len(scale)) + 1.5 * (np.eye(len(scale))[::-1]))
    for wrong in (-information, indefinite, np.triu(information), np.zeros_like(information)):
        path.write_text(json.dumps(good | {"information": wrong.tolist()}))
        with pytest.raises(
            RunFolderError,
            match=r"json: is not a calibration \(its information matrix is not positive",
        ):
            Calibration.load(path)
    # What the data leave open has none; less than none has nothing.
    weak = information.copy()
    weak[-1, :] = weak[:, -1] = 0.0
    open_one = good | {"undetermined": [good["parameter_names"][-1]], "status": "SINGULAR"}
    path.write_text(json.dumps(open_one | {"information": weak.tolist()}))
    assert Calibration.load(path).undetermined
    path.write_text(json.dumps(open_one | {"information": (-information).tolist()}))
    with pytest.raises(RunFolderError):
        Calibration.load(path)


def test_a_camera_that_was_changed_in_a_run_is_said_to_be_changed(tmp_path: Path) -> None:
    run = sc.Run(tmp_path / "run")
    run.calibrate(observations(n_frames=30), sc.paper.paper_start())
    told: list[str] = []
    _ = sc.Run(run.path, tell=told.append).results
    assert told == []
    path = run.folder.camera
    path.write_text(path.read_text().replace("focal_mm = 72", "focal_mm = 70"))
    again = sc.Run(run.path, tell=told.append)
    rows = dict(provenance_rows(again.results))
    assert (
        told == [rows["Nominal camera"]]
        and "camera.toml: was changed after the run was made" in told[0]
    )
    assert again.calibration.nominal.focal_mm == 72.0
    with pytest.raises(
        RunFolderError, match=r"camera\.toml: is not the file that this run has written"
    ):
        _ = again.camera
