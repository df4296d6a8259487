"""Frames of several cameras in one table are told by their own focal lengths."""

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.calibration.cameras import MixedCameras, frame_focals, frame_ranges
from starcal_uq.core.errors import CalibrationError, ObservationError
from starcal_uq.core.status import Level
from starcal_uq.diagnostics.verdict import estimate
from tests.helpers.outside import campaign


def mixed(seed: int, ratio: float, second: int, n_frames: int = 10, **options):
    """Observations whose last frames are of a camera with a focal length `ratio` times as long, and
    a data sheet.
    """
    rng = np.random.default_rng(seed)
    own = {"stars_per_frame": 12, "sigma_px": 0.1, "corner_px": (3.0, -1.0)} | options
    field = 2.0 * np.degrees(np.arctan(np.tan(np.radians(7.5)) / ratio))
    c = campaign(rng, n_frames=n_frames - second, field_deg=15.0, **own)
    columns = dict(c.columns)
    if second:
        other = campaign(rng, n_frames=second, field_deg=field, **own).columns
        other["frame"] = other["frame"] + n_frames - second
        columns = {name: np.concatenate([columns[name], other[name]]) for name in columns}
    return (
        sc.Observations(**columns),
        sc.Camera(**c.camera_toml(0.03), coefficients=(0.0, 0.0)),
        c.theta[2],
    )


@pytest.mark.parametrize(("ratio", "second"), [(1.4, 4), (1.4, 1), (1.01, 4), (0.5, 5)])
def test_groups_of_frames_and_their_focal_lengths(ratio, second):
    obs, camera, focal = mixed(0, ratio, second)
    found = frame_focals(obs, camera)
    assert found.n_groups == 2 and found.p_value < 1e-3
    other = np.arange(10) >= 10 - second
    assert np.array_equal(found.group == int(ratio > 1.0), other)
    assert np.median(found.focal_px[~other]) == pytest.approx(focal, rel=5e-3)
    assert np.median(found.focal_px[other]) == pytest.approx(ratio * focal, rel=5e-3)
    assert np.all(found.sigma_px < 0.01 * focal)


def test_three_cameras():
    obs, camera, _ = mixed(1, 1.4, 4)
    third, _, _ = mixed(2, 1.0, 0, n_frames=4)
    apart = 2.0 * third.xy - third.xy.mean(axis=0)
    inside = np.all((apart > 0.0) & (apart < 1023.0), axis=1)
    columns = {
        name: np.concatenate([getattr(obs, name), getattr(third, name)[inside]])
        for name in ("ra_deg", "dec_deg")
    }
    frame = np.concatenate([obs.frame, third.frame[inside] + 10])
    xy = np.concatenate([obs.xy, apart[inside]])
    found = frame_focals(sc.Observations(frame, xy[:, 0], xy[:, 1], **columns), camera)
    assert found.n_groups == 3


def test_a_failing_calibration_names_the_cameras_and_the_frames_to_take():
    obs, camera, _ = mixed(0, 1.4, 4)
    with pytest.raises(CalibrationError, match=r"of 2 cameras.* in frames 0-5 and .* in frames"):
        sc.calibrate(obs, camera)
    assert sc.calibrate(obs.in_ranges([(0, 5)]), camera).status.ok


def test_a_calibration_of_two_like_cameras_fails_a_check():
    obs, camera, _ = mixed(0, 1.005, 4)
    cal = sc.calibrate(obs, camera)
    found = MixedCameras.of(obs, cal.camera)
    check = estimate.one_camera(found)
    assert check.level is Level.FAIL and check.remedy.endswith("--only-frames 0-5")


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"stars_per_frame": 5},
        {"sigma_px": 1.0},
        {"corner_px": (30.0, -10.0)},
        {"frame_focal": 1e-3},
    ],
    ids=str,
)
def test_frames_of_one_camera_stay_together(options):
    for seed in range(4):
        obs, camera, _ = mixed(seed, 1.0, 0, n_frames=12, **options)
        assert frame_focals(obs, camera).n_groups == 1


@pytest.mark.slow
def test_the_rate_of_false_alarms():
    groups, p_values = [], []
    for seed in range(80):
        obs, camera, _ = mixed(seed, 1.0, 0)
        found = frame_focals(obs, camera)
        groups.append(found.n_groups)
        p_values.append(found.p_value)
    assert max(groups) == 1
    # At a tenth, at most 8 of 80 are expected; beyond 17 is one in a thousand.
    assert np.count_nonzero(np.array(p_values) < 0.1) <= 17


def test_ranges_of_frames():
    assert frame_ranges(np.array([0, 1, 2, 5, 7, 8])) == "0-2,5,7-8"
    obs, _, _ = mixed(0, 1.0, 0)
    assert obs.in_ranges([(0, 2), (5, 5), (8, 99)]).frame_ids.tolist() == [0, 1, 2, 5, 8, 9]
    with pytest.raises(ObservationError):
        obs.in_ranges([(20, 30)])
