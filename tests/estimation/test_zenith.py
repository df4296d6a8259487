"""Refraction without a site, planted by a sensor of a second make."""

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import CalibrationError
from starcal_uq.inference.exact import ExactMarginal
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.shapes import View
from starcal_uq.likelihood.zenith import Zeniths, frame_axes
from tests.helpers.effects import breathing, sheet, table
from tests.helpers.outside import (
    Campaign,
    campaign,
    one_night,
    random_unit,
    through_air,
    zeniths_of_frames,
)

# That of the product's standard air, whose constants are 57.0 and -0.07 arcsec.
AIR_ARCSEC = 58.0


def night(seed: int, n_frames: int = 10) -> tuple[Campaign, np.ndarray]:
    """Frames of one moment at 20 to 60 degrees from the zenith, and that."""
    rng = np.random.default_rng([seed, 78])
    zenith = random_unit(rng)
    path = one_night(rng, n_frames, zenith)
    c = campaign(rng, n_frames=n_frames, stars_per_frame=25, field_deg=20.0, path=path)
    return through_air(c, np.tile(zenith, (n_frames, 1)), AIR_ARCSEC), zenith


def test_a_zenith_without_site_and_times_is_found_and_frees_the_focal_length() -> None:
    c, zenith = night(3)
    cal = sc.calibrate(table(c), sheet(c), effects="auto")
    assert cal.effects.names == ("zenith",)
    air = cal.effects.air
    assert air.kind == "moment"
    latitude = np.degrees(np.arcsin(zenith[2]))
    assert abs(air.latitude_deg - latitude) < 4.0 * air.latitude_std_deg
    assert air.latitude_std_deg < 2.0
    assert abs(air.density - 1.0) < 4.0 * air.density_std
    assert np.abs((cal.theta - c.theta) / cal.sigmas).max() < 4.0
    # Control: scales and shears of frames leave the mean of the refraction to the focal length.
    other = sc.calibrate(table(c), sheet(c), effects="frame")
    assert (c.theta[2] - other.theta[2]) / other.sigmas[2] > 5.0


def test_times_give_the_place() -> None:
    c, zenith = night(4)
    times = np.full(len(c.columns["frame"]), "2026-03-01T21:00:00")
    cal = sc.calibrate(table(c, time_utc=times), sheet(c), effects="zenith")
    air = cal.effects.air
    assert air.kind == "place"
    at, _ = frame_axes(table(c, time_utc=times))
    x, y, z = at[0] @ zenith
    wanted = np.degrees([np.arcsin(z), np.arctan2(y, x)])
    away = wanted - [air.latitude_deg, air.longitude_deg]
    assert abs(away[0]) < 4.0 * air.latitude_std_deg
    assert abs((away[1] + 180.0) % 360.0 - 180.0) < 4.0 * air.longitude_std_deg


def test_zeniths_of_single_frames_are_found_on_one_side_or_the_other() -> None:
    rng = np.random.default_rng(5)
    c = campaign(rng, n_frames=10, stars_per_frame=60, field_deg=20.0)
    zeniths = zeniths_of_frames(rng, c, (35.0, 60.0))
    cal = sc.calibrate(table(through_air(c, zeniths, AIR_ARCSEC)), sheet(c), effects="zenith")
    assert cal.effects.air.kind == "frames"
    found, boresights = cal.effects.zeniths.places, c.attitudes[:, 2]
    mirrored = 2.0 * np.sum(found * boresights, axis=1)[:, None] * boresights - found
    nearest = np.maximum(np.sum(found * zeniths, axis=1), np.sum(mirrored * zeniths, axis=1))
    away = np.degrees(np.arccos(np.minimum(nearest, 1.0)))
    assert np.median(away) < 3.0 * cal.effects.air.zenith_std_deg
    assert np.mean(np.sum(found * zeniths, axis=1) == nearest) > 0.7
    assert np.abs((cal.theta - c.theta) / cal.sigmas).max() < 4.0


def test_clean_frames_and_breathing_ones_have_no_zenith_and_space_is_not_asked() -> None:
    rng = np.random.default_rng(6)
    zenith = random_unit(rng)
    path = one_night(rng, 12, zenith)
    own = breathing(rng, 12, 0.2)
    clean = campaign(rng, n_frames=12, stars_per_frame=25, field_deg=20.0, path=path)
    rough = campaign(rng, n_frames=12, stars_per_frame=25, field_deg=20.0, path=path, displaced=own)
    nothing = sc.calibrate(table(clean), sheet(clean), effects="auto").effects
    assert not nothing.names
    assert "zenith" in dict(nothing.refused)
    breathes = sc.calibrate(table(rough), sheet(rough), effects="auto").effects
    assert breathes.names == ("frame",)
    obs = table(night(3)[0])
    space = obs.with_origin(directions="apparent", observer="space")
    in_space = sc.calibrate(space, sheet(clean), effects="auto").effects
    assert "zenith" not in {*in_space.names, *dict(in_space.refused)}
    with pytest.raises(CalibrationError, match="refraction may be missing"):
        sc.calibrate(space, sheet(clean), effects="zenith")


@pytest.mark.parametrize("apiece", [False, True])
def test_columns_are_derivatives_of_refraction(apiece: bool) -> None:
    c, zenith = night(7, 4)
    obs = table(c)
    likelihood = MarginalLikelihood(obs, "brown")
    state, _ = likelihood.profile(c.theta)
    view = View.of(likelihood, state, c.theta, slice(None))
    places = np.tile(zenith, (4 if apiece else 1, 1))
    zeniths = Zeniths(obs.frame_ids, frame_axes(obs)[0], places, False)
    boresights = state.rotations[:, 2]
    columns = zeniths.shape(obs).columns(view)
    assert len(columns) == len(zeniths.prior) == len(zeniths.mean)

    def raised(step: np.ndarray) -> np.ndarray:
        own = zeniths.moved(step, boresights).shape(obs).columns(view)
        # With what is odd about the boresight, that of the zenith and not its mirror image's.
        return own[-1] + own[zeniths.sizes[0] : -1].sum(axis=0)

    for index in range(zeniths.sizes[0]):
        step = np.zeros(len(columns))
        step[zeniths.sizes[0] : -1] = 1.0
        ahead, behind = step.copy(), step.copy()
        ahead[index], behind[index] = 1e-4, -1e-4
        slope = (raised(ahead) - raised(behind)) / 2e-4
        np.testing.assert_allclose(columns[index], slope, atol=1e-5 * np.abs(slope).max())


@pytest.mark.parametrize("apiece", [False, True])
def test_sums_are_the_exact_likelihood(apiece: bool) -> None:
    c, _ = night(3)
    if apiece:
        rng = np.random.default_rng(5)
        c = campaign(rng, n_frames=10, stars_per_frame=60, field_deg=20.0)
        c = through_air(c, zeniths_of_frames(rng, c), AIR_ARCSEC)
    obs = table(c)
    cal = sc.calibrate(obs, sheet(c), effects="zenith")
    step = cal.theta + np.random.default_rng(0).standard_normal((6, 5)) * cal.sigmas
    sigma = np.full(6, cal.sigma)
    sums, exact = cal.log_likelihood(step, sigma), ExactMarginal(obs, cal)
    found = exact.log_likelihood(step, sigma)
    np.testing.assert_allclose(np.diff(found), np.diff(sums), atol=0.02)
    # Control: the likelihood without air is another.
    assert (
        np.abs(
            np.diff(MarginalLikelihood(obs, "brown").log_likelihoods(step, sigma)) - np.diff(sums)
        ).max()
        > 1.0
    )


@pytest.mark.slow
def test_place_and_camera_are_covered() -> None:
    z, latitude, chosen, without = [], [], [], []
    for seed in range(20):
        c, zenith = night(seed)
        obs = table(c)
        cal = sc.calibrate(obs, sheet(c), effects="auto")
        chosen.append("zenith" in cal.effects.names)
        z.append((cal.theta - c.theta) / cal.sigmas)
        if cal.effects.air is not None:
            away = cal.effects.air.latitude_deg - np.degrees(np.arcsin(zenith[2]))
            latitude.append(away / cal.effects.air.latitude_std_deg)
        plain = sc.calibrate(obs, sheet(c), effects="frame")
        without.append((plain.theta - c.theta)[2] / plain.sigmas[2])
    assert np.mean(chosen) >= 0.9
    # 100 intervals, few of them independent.
    assert np.mean(np.abs(z) < 1.96) > 0.84
    assert np.mean(np.abs(latitude) < 1.96) > 0.75
    assert 0.6 < np.sqrt(np.mean(np.square(latitude))) < 1.4
    # Control: frames with scales and shears of their own do not cover the focal length.
    assert np.mean(np.abs(without) < 1.96) < 0.3


def test_the_zenith_of_partitions_is_that_of_the_table(tmp_path) -> None:
    c, _ = night(4, 15)
    times = np.full(len(c.columns["frame"]), "2026-03-01T21:00:00")
    obs = table(c, time_utc=times)
    for name, ids in enumerate(np.array_split(obs.frame_ids, 3)):
        obs.select_frames(ids).save(tmp_path / f"{name}.parquet")
    parts = sc.observations.open_partitions(tmp_path)
    one = sc.calibrate(obs, sheet(c), effects="auto")
    many = sc.calibrate(parts, sheet(c), effects="auto")
    assert one.effects.names == many.effects.names == ("zenith",)
    # The moves of the zenith end within the gain that one has to bring.
    assert np.max(np.abs(many.theta - one.theta) / one.sigmas) < 0.01
    np.testing.assert_allclose(many.sigmas, one.sigmas, rtol=1e-3)
    air, other = many.effects.air, one.effects.air
    assert abs(air.latitude_deg - other.latitude_deg) < 0.05 * other.latitude_std_deg
    assert air.density == pytest.approx(other.density, abs=0.05 * other.density_std)
    # Control: without it f is too short.
    assert (one.theta[2] - sc.calibrate(parts, sheet(c)).theta[2]) / one.sigmas[2] > 3.0
