"""Refraction that is missing from the directions is found in the residuals."""

from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.status import Level
from starcal_uq.diagnostics.air import air_test
from starcal_uq.diagnostics.verdict import observed
from starcal_uq.diagnostics.verdict.judge import judge
from tests.helpers.outside import (
    campaign,
    cap,
    frame_at,
    random_unit,
    sky_angles,
    through_air,
    zeniths_of_frames,
)

LATITUDE, LONGITUDE = 38.0, -70.0


def night(
    seed: int, *, air=1.0, focal=0.0, skew=0.0, drift=0.0, hours=3.0, above=True, n_frames=10
):
    """Frames of a night, without the package: catalogue directions, pixels as seen through `air` of
    the standard one.

    `focal` is the relative spread of the focal length over frames, `skew` the error in px of the
    axes' scale at the corner, `drift` that of the scale over the night; without `above` the camera
    looks anywhere.
    """
    rng = np.random.default_rng(seed)
    seconds = np.sort(rng.uniform(0.0, 3600.0 * hours, n_frames))
    # Greenwich mean sidereal time, from 2026-11-13T12 on.
    sidereal = np.radians(280.46062 + 360.98564737 * (9813.0 + seconds / 86400.0) + LONGITUDE)
    latitude = np.radians(LATITUDE)
    up = np.column_stack([np.cos(latitude) * np.cos(sidereal), np.cos(latitude) * np.sin(sidereal)])
    up = np.column_stack([up, np.full(n_frames, np.sin(latitude))])
    true_focal, half = 512.0 / np.tan(np.radians(6.0)), 724.0
    columns = {name: [] for name in ("frame", "x_px", "y_px", "ra_deg", "dec_deg", "time_utc")}
    for frame, zenith in enumerate(up):
        level = np.cross(zenith, rng.standard_normal(3))
        altitude = np.radians(rng.uniform(30.0, 85.0))
        where = np.sin(altitude) * zenith + np.cos(altitude) * level / np.linalg.norm(level)
        attitude = frame_at(rng, where if above else rng.standard_normal(3))
        seen = cap(rng, attitude[2], 9.0, 150)
        b = seen @ attitude.T
        f = true_focal * (1.0 + focal * rng.standard_normal())
        d = f * b[:, :2].T / b[:, 2]
        d = d * (1.0 + 3.0 / half**3 * np.sum(d**2, axis=0))
        d = d + skew * np.array([d[0], -d[1]]) / half + drift * (frame / n_frames - 0.5) * d / half
        xy = d + np.array([[500.0], [530.0]]) + 0.1 * rng.standard_normal(d.shape)
        inside = np.flatnonzero((xy.min(axis=0) > 0.0) & (xy.max(axis=0) < 1023.0))[:25]
        seen = seen[inside]
        sine = seen @ zenith
        tangent = np.sqrt(1.0 / sine**2 - 1.0)
        raised = np.radians((58.276 * tangent - 0.0824 * tangent**3) / 3600.0)
        upwards = zenith - sine[:, None] * seen
        r = (
            seen
            - air * np.tan(raised)[:, None] * upwards / np.linalg.norm(upwards, axis=1)[:, None]
        )
        r /= np.linalg.norm(r, axis=1)[:, None]
        time = (datetime(2026, 11, 13, 12) + timedelta(seconds=float(seconds[frame]))).isoformat()
        ra, dec = sky_angles(r)
        values = (np.full(len(inside), frame), *xy[:, inside], ra, dec, np.full(len(inside), time))
        for column, found in zip(columns.values(), values, strict=True):
            column.append(found)
    obs = sc.Observations(**{name: np.concatenate(parts) for name, parts in columns.items()})
    camera = sc.Camera(1024, 1024, 10.0, 0.0101 * true_focal, 511.5, 511.5)
    return obs, sc.calibrate(obs, camera, duplicates="keep"), true_focal


def test_refraction_and_the_place_it_was_seen_from():
    obs, cal, focal = night(0)
    found = air_test(obs, cal)
    assert found.is_air and found.p_value < 1e-3
    assert abs(found.latitude_deg - LATITUDE) < 4.0 * found.latitude_std_deg < 20.0
    assert abs(found.longitude_deg - LONGITUDE) < 4.0 * found.longitude_std_deg
    # The focal length is where it is known not to be, and comes back.
    assert found.f_sigma > 3.0 and abs(cal.theta[2] + found.f_px - focal) < 4.0 * cal.sigmas[2]
    check = observed.directions(obs, cal, found)
    assert check.level is Level.FAIL and "--site SITE" in check.remedy
    assert "° N" in check.sentence and "too short" in check.sentence


def test_frames_of_a_moment_need_no_times():
    obs, cal, _ = night(1, hours=0.02)
    found = air_test(replace(obs, time_utc=None), cal)
    assert found.is_air and np.isnan(found.latitude_deg)
    assert "the times" in observed.directions(obs, cal, found).sentence
    # Directions of stars that were identified in images are made where these are read.
    seen = replace(obs, time_utc=None, meta={**obs.meta, "source": "identified in Gaia DR3"})
    check = observed.directions(seen, cal, found)
    assert check.remedy == "starcal-uq run IMAGES... CAMERA -o RUN --force --site SITE --time UTC"
    assert "--time" in check.sentence and "column" not in check.sentence
    assert "--in-space" in observed.directions(seen, cal).remedy
    assert "calibrate" not in observed.directions(seen, cal).remedy


PATCH = {"n_frames": 60, "patch_stars": 40, "star_sigma_px": 0.03}


def bent(px, bend):
    """A shift of so many px, by the position in the field, in units of the half diagonal, and the
    frame.
    """
    return lambda uv, xy, mag, frame: px * bend(*(uv / 724.0), frame)


def edge(radius, mag, frame):
    return 0.05 * (1.0 + 2.0 * (radius / 0.75) ** 4)


def smear(uv):
    """More noise along x, of these very positions."""
    rng = np.random.default_rng(np.abs(uv).view(np.uint64).ravel()[:4])
    return np.array([0.12 * rng.standard_normal(uv.shape[1]), np.zeros(uv.shape[1])])


def outside(seed, *, air=None, effects="none", meta=None, **options):
    """Frames without times from the simulator of another make, calibrated; `air` is where the
    zenith is.
    """
    rng = np.random.default_rng([seed, 26])
    c = campaign(rng, **{"n_frames": 30} | options)
    if air == "one":
        towards = np.array([0.3, -0.5, 0.8]) / np.sqrt(0.98)
        across = np.cross(towards, random_unit(rng))
        zenith = 0.6 * towards + 0.8 * across / np.linalg.norm(across)
        c = through_air(c, np.broadcast_to(zenith, (len(c.attitudes), 3)))
    elif air is not None:
        turned = air == "each"
        c = through_air(
            c, zeniths_of_frames(rng, c, (20.0, 60.0) if turned else (45.0, 45.0), turned)
        )
    obs = sc.Observations(**c.columns, meta={"directions": "apparent"} | (meta or {}))
    camera = sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0))
    return (
        c,
        obs,
        sc.calibrate(obs, camera, effects=effects, duplicates="keep"),
    )


@pytest.mark.parametrize("effects", ["none", pytest.param("star", marks=pytest.mark.slow)])
def test_errors_of_stars_are_not_refraction(effects):
    for seed in range(2):
        _, obs, cal = outside(seed, effects=effects, **PATCH)
        found = air_test(obs, cal)
        assert not found.is_air and not found.like_others
        assert found.p_value > 1e-3
    # The control: refraction beside the errors of the stars.
    c, obs, cal = outside(0, air="one", effects=effects, **PATCH)
    found = air_test(obs, cal)
    assert found.is_air
    assert abs(cal.theta[2] + found.f_px - c.theta[2]) < 4.0 * cal.sigmas[2] < 0.5 * found.f_px


def test_in_space_there_is_no_air():
    _, obs, cal = outside(1, air="each")
    assert air_test(obs, cal).is_air
    for observer in ("space", "rendered"):
        assert air_test(obs.with_meta(observer=observer), cal) is None


@pytest.mark.parametrize(
    "options", [{}, {"sigma_px": 0.1}, {"field_deg": 5.0}, {"field_deg": 30.0}], ids=str
)
def test_refraction_of_frames_without_times(options):
    c, obs, cal = outside(2, air="each", meta={"observer": "unknown"}, **options)
    found = air_test(obs, cal)
    assert found.is_air and found.p_value < 1e-6 and np.isnan(found.latitude_deg)
    # Not known is the density of the air, which is that of any place up to 4 km.
    assert abs(cal.theta[2] + found.f_px - c.theta[2]) < 0.3 * found.f_px + 3.0 * cal.sigmas[2]
    if options:
        return
    verdict = judge(obs, cal, diagnosis=sc.diagnose(obs, cal, models=(), n_starts=0))
    first = verdict.at(Level.FAIL)[0]
    assert first.name == "Catalogue directions" and "f is too short" in first.sentence
    assert "--site SITE --time UTC" in first.remedy


SKEWED = bent(0.3, lambda u, v, frame: np.array([u, -v]))
LOOKALIKES = {
    "clean": {},
    "focal lengths": {"frame_focal": 3e-4},
    "focal lengths, hardly seen": {"frame_focal": 7e-5},
    "frames of their own shape": {
        "displaced": bent(0.05, lambda u, v, frame: np.array([u, -v]) * np.sin(2.4 * frame**2))
    },
    "drift of f": {
        "displaced": bent(0.3, lambda u, v, frame: np.array([u, v]) * (frame / 30.0 - 0.5))
    },
    "radial": {"displaced": bent(1.0, lambda u, v, frame: np.array([u, v]) * np.hypot(u, v) ** 6)},
    "decentred": {
        "displaced": bent(0.5, lambda u, v, frame: np.array([3.0 * u**2 + v**2, 2.0 * u * v]))
    },
    "waves": {
        "displaced": bent(0.1, lambda u, v, frame: np.array([np.sin(9.0 * v), np.cos(8.0 * u)]))
    },
    "noise at the edge": {"sigma_px": edge},
    "noise of the axes": {"displaced": lambda uv, xy, mag, frame: smear(uv)},
}


@pytest.mark.parametrize(
    "where",
    [{}, pytest.param({"pointings": 1, "drift_px": 3.3}, marks=pytest.mark.slow)],
    ids=str,
)
@pytest.mark.parametrize("name", LOOKALIKES)
def test_without_times_what_is_not_refraction_is_not_named(name, where):
    _, obs, cal = outside(3, **LOOKALIKES[name], **where)
    found = air_test(obs, cal)
    assert found is None or not found.is_air


def test_a_horizon_fixed_in_the_camera_is_like_axes_of_different_scale():
    for options in ({"air": "fixed"}, {"displaced": SKEWED}):
        _, obs, cal = outside(4, meta={"observer": "unknown"}, **options)
        found = air_test(obs, cal)
        assert found.like_others and not found.is_air
        check = observed.directions(obs, cal, found)
        assert check.level is Level.WARN and "cannot be told apart" in check.sentence
        assert "--site" in check.remedy
    _, obs, cal = outside(4, meta={"observer": "unknown"})
    assert "cannot be told apart" not in observed.directions(obs, cal, air_test(obs, cal)).sentence


def test_thinner_air_is_air():
    obs, cal, _ = night(2, air=0.75)
    assert air_test(obs, cal).is_air


@pytest.mark.parametrize(
    "options", [{}, {"focal": 3e-4}, {"skew": 0.5}, {"drift": 0.5}, {"above": False}], ids=str
)
def test_what_is_not_refraction_is_not_named(options):
    obs, cal, _ = night(3, air=0.0, **options)
    found = air_test(obs, cal)
    assert found is None if options == {"above": False} else not found.is_air
    assert observed.directions(obs, cal, found) == observed.directions(obs, cal)


def test_real_frames(real_data):
    camera = sc.Camera.load(real_data / "esa_tetra3_camera.toml")
    path = real_data / "esa_tetra3_observations.csv"
    for columns, is_air in (
        (None, True),
        ({"ra_deg": "ra_apparent_deg", "dec_deg": "dec_apparent_deg"}, False),
    ):
        obs = sc.load_observations(path, camera, columns=columns)
        obs = replace(obs, time_utc=np.full(obs.n_stars, "2019-07-29T20:47:26"))
        found = air_test(obs, sc.calibrate(obs, camera))
        assert found.is_air == is_air
        if is_air:
            # A fit of another program says 52.0 degrees, and 2.2 px in standard air; f follows the
            # density.
            assert abs(found.latitude_deg - 52.0) < 2.0 * found.latitude_std_deg
            assert (
                found.f_px == pytest.approx(2.2, abs=2.2 * found.amplitude_std)
                and found.amplitude_std < 0.15
            )


@pytest.mark.slow
def test_the_rate_of_false_alarms():
    p_values = []
    for seed in range(60):
        obs, cal, _ = night(1000 + seed, air=0.0, n_frames=6)
        found = air_test(obs, cal)
        assert not found.is_air
        p_values.append(found.p_value)
    # One in ten of 60, beyond which chance is once in a thousand.
    assert 1 <= np.count_nonzero(np.array(p_values) < 0.1) <= 15


@pytest.mark.slow
def test_many_nights_with_air():
    apart, left, named = [], [], 0
    for seed in range(30):
        obs, cal, focal = night(6000 + seed)
        found = air_test(obs, cal)
        named += found.is_air
        if found.is_air:
            apart.append((found.latitude_deg - LATITUDE) / found.latitude_std_deg)
            apart.append((found.longitude_deg - LONGITUDE) / found.longitude_std_deg)
            left.append((cal.theta[2] + found.f_px - focal) / cal.sigmas[2])
    assert named >= 28
    # Places within their errors, and the focal length where it belongs.
    assert 0.5 < np.sqrt(np.mean(np.square(apart))) < 1.3
    assert abs(np.mean(left)) < 0.6
