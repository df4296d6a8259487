"""A calibration of any kind comes back from its file to the last bit."""

import dataclasses

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import RunFolderError
from tests.helpers.effects import breathing, sheet, table
from tests.helpers.outside import campaign
from tests.helpers.same import assert_same
from tests.helpers.scenes import observations
from tests.helpers.ties import gyro, known_of


def calibrated(kind: str) -> sc.Calibration:
    rng = np.random.default_rng(5)
    if kind == "plain":
        return sc.calibrate(observations(), sc.paper.paper_start())
    if kind == "stream":
        obs = observations(n_frames=20)
        frames = iter([obs.select_frames([k]) for k in obs.frame_ids])
        return sc.calibrate(frames, sc.paper.paper_start(), method="samaan")
    patch = {"patch_stars": 40, "star_sigma_px": 0.03} if kind == "star" else {}
    shifts = breathing(rng, 12, 0.3) if kind == "frame,field" else None
    c = campaign(rng, n_frames=12, stars_per_frame=25, displaced=shifts, **patch)
    obs = table(c)
    if kind == "ties":
        return sc.calibrate(obs, sheet(c), relative_attitudes=known_of(gyro(rng, c, 10.0)))
    if kind == "tails":
        obs = dataclasses.replace(obs, sigma_px=rng.uniform(0.02, 0.1, len(obs)))
    return sc.calibrate(obs, sheet(c), effects=kind)


@pytest.mark.parametrize(
    "kind", ["plain", "stream", "ties", "tails", "noise", "star", "frame,field", "zenith"]
)
def test_a_calibration_is_read_as_it_was_written(kind, tmp_path):
    cal = calibrated(kind)
    cal.save(tmp_path / "calibration.json")
    assert_same(cal, sc.Calibration.load(tmp_path / "calibration.json"))
    assert kind in ("plain", "stream", "ties") or cal.effects.names == tuple(kind.split(","))
    assert "focal length" in cal._repr_html_()


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(RunFolderError, match=r"missing\.json"):
        sc.Calibration.load(tmp_path / "missing.json")
