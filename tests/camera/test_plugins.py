"""Distortion models of other packages: the example of the documentation, from an entry point to an
estimate, on stars that NumPy alone has made.
"""

import json
import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_uq.camera import Coefficient, DistortionModel, distortion
from starcal_uq.core.errors import DistortionError

PLUGIN = Path(__file__).parents[2] / "docs" / "how-to" / "plugin"
FOCAL, CENTRE, D1, SIGMA = 2000.0, np.array([515.0, 508.0]), -4e-8, 0.05

CAMERA = """
[camera]
width_px = 1024
height_px = 1024
pixel_um = 10.0
focal_px = 2000.0
x0_px = 511.5
y0_px = 511.5
distortion = "division"
"""


def install(folder: Path) -> None:
    """The example as an installer leaves it: a module, and the entry point beside it."""
    project = tomllib.loads((PLUGIN / "pyproject.toml").read_text())["project"]
    shutil.copy(PLUGIN / "starcal_uq_division.py", folder)
    about = folder / "starcal_uq_division-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: 1\n")
    lines = [
        line
        for group, entries in project["entry-points"].items()
        for line in (f"[{group}]", *(f"{name} = {value}" for name, value in entries.items()))
    ]
    (about / "entry_points.txt").write_text("\n".join(lines) + "\n")


def stars(path: Path, seed: int) -> None:
    """Forty frames of twenty stars behind a lens of the division model."""
    rng = np.random.default_rng(seed)
    rows = ["frame,star_id,x_px,y_px,ra_deg,dec_deg"]
    for frame in range(40):
        seen = rng.uniform(20.0, 1003.0, (20, 2))
        offset = seen - CENTRE
        ideal = offset / (1.0 + D1 * (offset**2).sum(1, keepdims=True))
        body = np.c_[ideal / FOCAL, np.ones(20)]
        body /= np.linalg.norm(body, axis=1, keepdims=True)
        x, y, z = (body @ Rotation.random(random_state=rng).as_matrix()).T
        seen += rng.normal(0.0, SIGMA, (20, 2))
        ra, dec = np.degrees(np.arctan2(y, x)) % 360.0, np.degrees(np.arcsin(z))
        rows += [
            f"{frame},{20 * frame + i},{seen[i, 0]:.6f},{seen[i, 1]:.6f},{ra[i]:.10f},{dec[i]:.10f}"
            for i in range(20)
        ]
    path.write_text("\n".join(rows) + "\n")


def command(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """The command, in a process that looks for packages in this folder too."""
    root = str(Path(__file__).parents[2])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([root, str(folder)])}
    call = [sys.executable, "-m", "starcal_uq", *words]
    return subprocess.run(call, cwd=folder, env=environment, capture_output=True, text=True)


def test_model_of_another_package(tmp_path: Path) -> None:
    """The lens is found within its uncertainty, by the name in the camera's file or that of the
    option; without the package, the error names what is missing.
    """
    install(tmp_path)
    stars(tmp_path / "stars.csv", 5)
    (tmp_path / "camera.toml").write_text(CAMERA)
    (tmp_path / "plain.toml").write_text(CAMERA.replace("division", "none"))
    estimates = []
    for name, *more in (["camera"], ["plain", "--model", "division+axes"]):
        call = "calibrate", "stars.csv", f"{name}.toml", "-o", name, "--effects", "none", *more
        made = command(tmp_path, *call)
        assert made.returncode == 0, made.stdout + made.stderr
        found = json.loads((tmp_path / name / "calibration.json").read_text())
        sigma = np.sqrt(np.diag(found["covariance"]))
        truth = np.array([*CENTRE, FOCAL, D1, 0.0, 0.0])[: len(sigma)]
        assert (np.abs(found["theta"] - truth) < 4.0 * sigma).all()
        assert sigma[3] < 1e-2 * abs(D1)
        estimates.append(found["parameter_names"])
    assert estimates == [["x0", "y0", "f", "d1"], ["x0", "y0", "f", "d1", "stretch", "skew"]]

    (tmp_path / "starcal_uq_division-1.0.dist-info" / "entry_points.txt").unlink()
    lost = command(tmp_path, "calibrate", "stars.csv", "camera.toml", "-o", "again")
    assert lost.returncode == 2
    assert "install the package that offers it" in " ".join(lost.stderr.split())


def _offset(u: float, v: float, k: Sequence[float]) -> tuple[float, float]:
    return 1.0 + k[0], 0.0


@pytest.mark.parametrize(
    ("lens", "formula", "problem"),
    [
        (Coefficient("k1", "px^-1", 1.0, "px^-1", "another k1", 2), None, "rename"),
        (Coefficient("e1", "px^-1", 1.0, "px^-1", "offset", 2), _offset, "not zero"),
    ],
)
def test_models_that_do_not_fit(
    monkeypatch: pytest.MonkeyPatch, lens: Coefficient, formula: Any, problem: str
) -> None:
    """A coefficient of another meaning, and a lens that bends light without coefficients."""
    radial = distortion.get_model("k1").formula
    model = DistortionModel("theirs", (lens,), "forward", formula or radial, "this test")
    monkeypatch.setattr(EntryPoint, "load", lambda entry: model)
    offered = EntryPoints([EntryPoint("theirs", "their.module:MODEL", distortion.GROUP)])
    monkeypatch.setattr("importlib.metadata.entry_points", offered.select)
    with pytest.raises(DistortionError, match=problem):
        distortion.get_model("theirs")
    assert distortion.PARAMETERS.get(lens.name) != lens
