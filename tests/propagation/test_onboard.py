"""What effects do to attitudes in flight, against a sensor of a second make that flies on new
frames (NumPy alone): with the camera's parameters aboard, and with effects aboard as well.
"""

from dataclasses import replace

import numpy as np
import pandas as pd

import starcal_uq as sc
from starcal_uq.presentation.words.propagation import onboard_table
from starcal_uq.propagation.attitude_error import AttitudeError
from starcal_uq.propagation.onboard_error import side_by_side
from tests.helpers.effects import breathing, bump, nearest, sheet, table, together
from tests.helpers.outside import attitude_errors, campaign

SHORT = {"n_ensembles": 2, "n_walkers": 32, "n_steps": 100}


def calibrated(seed: int, n_frames: int, field_px: float, frame_px: float):
    """Observations, posterior, and 100 new frames of the same sensor without noise; and its axes
    against those of the camera nearest to it, arcsec.
    """
    rng = np.random.default_rng(seed)
    field = bump(field_px)
    c = campaign(
        rng, n_frames=n_frames, displaced=together(field, breathing(rng, n_frames, frame_px))
    )
    flown = campaign(
        rng, n_frames=100, sigma_px=0.0, displaced=together(field, breathing(rng, 100, frame_px))
    )
    obs = table(c)
    cal = sc.calibrate(obs, sheet(c), effects="field,frame")
    return obs, sc.sample(obs, cal, seed=1, **SHORT), flown, nearest(c.theta, field)[1]


def test_the_rest_of_new_frames_is_that_of_a_sensor_with_a_field_and_frames_of_its_own(tmp_path):
    obs, post, flown, axes = calibrated(3, 30, 0.5, 0.2)
    post.save(tmp_path / "p.nc")
    again = sc.Posterior.load(tmp_path / "p.nc")
    assert again.effects.fitted == post.effects.fitted
    for name in ("coefficients", "covariance", "cross"):
        np.testing.assert_array_equal(getattr(again.effects, name), getattr(post.effects, name))
    frames = table(flown).with_origin(frames="the mission")
    found = sc.propagate(again, frames, alignment=frames, calibrated=obs, n_draws=30)
    errors = attitude_errors(flown, post.mean) - axes
    common = errors.mean(axis=0)
    rest = np.sqrt(np.mean((errors - common) ** 2, axis=0))
    np.testing.assert_allclose(found.rest_arcsec / rest, 1.0, atol=0.3)
    assert np.abs(common / found.common_arcsec).max() < 3.5
    # Controls: parameters alone state far too little, and what is uploaded of a field is less.
    blind = sc.propagate(replace(post, effects=None), frames, alignment=frames, n_draws=30)
    assert (blind.rest_arcsec < 0.7 * rest).all()
    assert not blind.variants
    aboard = sc.propagate(again, frames, alignment=frames, onboard="effects", n_draws=30)
    assert (aboard.rest_arcsec < found.rest_arcsec).all()
    model, effects = found.variants
    np.testing.assert_array_equal(model.rest_arcsec, found.rest_arcsec)
    np.testing.assert_array_equal(effects.rest_arcsec, aboard.rest_arcsec)
    assert {effect.name for effect in found.effects} == {"field", "frame"}
    found.save(tmp_path / "a.csv")
    read = AttitudeError.load(tmp_path / "a.csv")
    assert read.variants[1].effects[0].name == effects.effects[0].name
    np.testing.assert_array_equal(read.variants[1].total_arcsec, effects.total_arcsec)
    # Shares add up to the whole: in squares, but for the two known means of the rest.
    for own in found.variants:
        parts = (own.parameters, *own.effects)
        for whole, kind in ((own.common_arcsec, "common"), (own.rest_arcsec, "rest")):
            spread = sum(np.diag(getattr(part, f"{kind}_covariance_arcsec2")) for part in parts)
            mean = sum(getattr(part, f"{kind}_mean_arcsec") for part in parts)
            np.testing.assert_allclose(np.sqrt(spread + mean**2), whole, rtol=1e-3)
    # Both stand side by side in files, documents and the terminal.
    rows = {row["part"]: row for _, row in side_by_side(found.variants).iterrows()}
    row = rows["rest"]
    cross = np.sqrt(np.mean(np.array([model.rest_arcsec, effects.rest_arcsec])[:, :2] ** 2, axis=1))
    assert [row["onboard_model_arcsec"], row["onboard_effects_arcsec"]] == cross.tolist()
    written = pd.read_csv(tmp_path / "a.csv").set_index(["contributor", "axis"])
    kept = written.loc[("calibration, rest", "roll")]
    assert kept["onboard_effects_arcsec"] == effects.rest_arcsec[2]
    assert np.isnan(written.loc[("centroid noise (NEA)", "roll")]["onboard_model_arcsec"])
    shown = [row[:2] for row in onboard_table(found).rows]
    assert shown[:4] == [
        ("common rotation", "model"),
        ("", "effects"),
        ("rest", "model"),
        ("", "effects"),
    ]
    assert "onboard='model'" in found.text
    assert "effects" in found.text
