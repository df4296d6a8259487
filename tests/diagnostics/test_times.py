"""A wrong time is named by what it does to the directions."""

from dataclasses import replace
from datetime import datetime, timedelta
from functools import lru_cache

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.formatting import significant
from starcal_uq.core.status import Level
from starcal_uq.diagnostics import time_test, unseen_aberration
from starcal_uq.diagnostics.verdict import observed
from starcal_uq.diagnostics.verdict.judge import judge
from starcal_uq.sky.apparent import make_apparent
from tests.helpers.outside import aberrated, campaign, frame_at, sky_angles

DAYS, LATITUDE, LONGITUDE, EPOCH = 9813.0, 38.0, -70.0, 2026.87
SITE = sc.sky.Site(LATITUDE, LONGITUDE)
CATALOGUE = sc.load_catalogue(max_mag=7.0)


def earth(days):
    """The Earth's velocity (km/s) from its elliptical orbit, days since J2000."""
    anomaly = np.radians(357.528 + 0.9856003 * days)
    longitude = np.radians(280.46 + 0.9856474 * days + 1.915 * np.sin(anomaly))
    perihelion, tilt = np.radians(282.9), np.radians(23.439)
    along = 29.785 * np.array(
        [
            np.sin(longitude) + 0.0167 * np.sin(perihelion),
            -np.cos(longitude) - 0.0167 * np.cos(perihelion),
        ]
    )
    return np.array([along[0], along[1] * np.cos(tilt), along[1] * np.sin(tilt)])


@lru_cache(maxsize=4)
def seen(seed, *, n_frames=30, field_deg=12.0, sigma_px=0.05, years=0.0, air=0.0):
    """A table of catalogue directions and true times, pixels as a moving observer saw them; the
    proper motion alone is of the package's catalogue.
    """
    rng = np.random.default_rng(seed)
    focal, half = 512.0 / np.tan(np.radians(0.5 * field_deg)), 724.0
    table, now = (CATALOGUE.at_epoch(EPOCH + late).directions_icrs for late in (0.0, years))
    rows = []
    while len(rows) < n_frames:
        days = DAYS + 0.125 * len(rows) / n_frames
        sidereal, latitude = (
            np.radians(280.46062 + 360.98564737 * days + LONGITUDE),
            np.radians(LATITUDE),
        )
        zenith = np.array(
            [*(np.cos(latitude) * np.array([np.cos(sidereal), np.sin(sidereal)])), np.sin(latitude)]
        )
        where = rng.standard_normal(3)
        where /= np.linalg.norm(where)
        if air and where @ zenith < 0.5:
            continue
        attitude = frame_at(rng, where)
        near = np.flatnonzero(now @ where > np.cos(np.radians(0.72 * field_deg)))
        b = now[near] + earth(days) / 299792.458
        b /= np.linalg.norm(b, axis=1)[:, None]
        if air:
            sine = b @ zenith
            level = zenith - sine[:, None] * b
            cosine = np.linalg.norm(level, axis=1)
            tangent = cosine / sine
            for _ in range(3):
                raised = np.radians((58.276 * tangent - 0.0824 * tangent**3) / 3600.0)
                tangent = np.tan(np.arctan2(cosine, sine) - raised)
            b = b * np.cos(raised)[:, None] + level / cosine[:, None] * np.sin(raised)[:, None]
        b = b @ attitude.T
        d = focal * b[:, :2].T / b[:, 2]
        xy = d * (1.0 + 3.0 / half**3 * np.sum(d**2, axis=0)) + np.array([[500.0], [530.0]])
        xy += sigma_px * rng.standard_normal(xy.shape)
        inside = np.flatnonzero((xy.min(axis=0) > 0.0) & (xy.max(axis=0) < 1023.0))[:20]
        if len(inside) > 5:
            ra, dec = sky_angles(table[near[inside]])
            time = (datetime(2000, 1, 1, 12) + timedelta(days=days)).isoformat(timespec="seconds")
            rows.append(
                (
                    np.full(len(inside), len(rows)),
                    *xy[:, inside],
                    ra,
                    dec,
                    np.full(len(inside), time),
                )
            )
    names = ("frame", "x_px", "y_px", "ra_deg", "dec_deg", "time_utc")
    obs = sc.Observations(
        **dict(zip(names, map(np.concatenate, zip(*rows, strict=True)), strict=True))
    )
    return obs, sc.Camera(1024, 1024, 10.0, 0.0101 * focal, 511.5, 511.5)


def stated(obs, hours):
    """The table with times that are so much too early."""
    times = obs.time_utc.astype("datetime64[s]") - np.timedelta64(round(3600 * hours), "s")
    return replace(obs, time_utc=times.astype(str))


SLIPS = {
    "date": ({}, lambda obs: make_apparent(stated(obs, 24 * 60)), "date", 60.0),
    "hour": ({"air": 1.0}, lambda obs: make_apparent(stated(obs, 1.0), site=SITE), "hour", 1.0),
    "J2000": ({"years": 26.9}, make_apparent, "epoch", 26.9),
    "a century": ({"years": -100.0}, make_apparent, "epoch", -100.0),
    "undeclared": ({}, lambda obs: replace(obs, time_utc=None), "no aberration", None),
    "wrongly declared": (
        {},
        lambda obs: obs.with_meta(directions="apparent"),
        "no aberration",
        None,
    ),
    "twice": (
        {},
        lambda obs: make_apparent(make_apparent(obs).with_meta(directions="catalogue")),
        "aberration twice",
        None,
    ),
}


@pytest.mark.parametrize("slip", SLIPS)
def test_a_wrong_time_is_named(slip):
    sky, change, cause, later = SLIPS[slip]
    obs, camera = seen(1, **sky)
    obs = change(obs)
    cal = sc.calibrate(obs, camera)
    found = time_test(obs, cal)
    assert found.cause == cause
    if later is not None:
        # Years are half a century's rate at the ends of a century.
        assert abs(found.later - later) < 3.5 * found.later_std < 0.6 * abs(later)
    check = observed.directions(obs, cal, None, found)
    assert check.level is (Level.FAIL if found.moves_sigma > 1.0 else Level.WARN)
    words = {"date": "days later than stated", "hour": "further east", "epoch": "By proper motion"}
    assert words.get(cause, "annual aberration") in check.sentence


@pytest.mark.parametrize(("sigma_px", "n_frames", "years"), [(0.2, 25, -100.0), (1.0, 6, 0.0)])
def test_a_fit_that_fails_by_a_wrong_time_says_so(sigma_px, n_frames, years):
    obs, camera = seen(2, n_frames=n_frames, field_deg=2.0, sigma_px=sigma_px, years=years)
    with pytest.raises(CalibrationError, match="do not determine x0 and y0: more frames") as caught:
        sc.calibrate(make_apparent(obs), camera, model="brown")
    words = str(sc.explain(caught.value, make_apparent(obs)))
    named = (
        "First, by proper motion the stars are those of an epoch 100 ± 7.5 years earlier" in words
    )
    # Too much noise is the fault of no time.
    assert named == ("First" in words) == bool(years)


def field(seed, *, twice, dated=True, **options):
    """Frames of another make with directions that are apparent, or aberrated once more;
    calibrated.
    """
    c = campaign(np.random.default_rng([seed, 6]), **{"n_frames": 25} | options)
    shown = aberrated(c, earth(DAYS)) if twice else c
    columns = dict(shown.columns)
    if dated:
        columns["time_utc"] = np.full(len(columns["frame"]), "2026-11-13T12:00:00")
    obs = sc.Observations(**columns, meta={"directions": "apparent", "observer": "space"})
    cal = sc.calibrate(
        obs, sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0)), duplicates="keep"
    )
    return c, obs, cal


STARING = {"pointings": 1, "drift_px": 3.3}


@pytest.mark.parametrize("dated", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_f_of_one_field_rests_on_aberration(dated):
    _, obs, cal = field(8, twice=False, dated=dated, **STARING)
    found = unseen_aberration(obs, cal)
    _, again, wrong = field(8, twice=True, dated=dated, **STARING)
    moved = abs(wrong.theta[2] - cal.theta[2])
    # Without times it is the largest of the year.
    assert (
        moved == pytest.approx(found.f_px, rel=0.05) if dated else moved < found.f_px < 1.5 * moved
    )
    assert found.f_sigma == pytest.approx(found.f_px / cal.sigmas[2]) and found.f_sigma > 1.5
    assert time_test(again, wrong) is None
    for table, made in ((obs, cal), (again, wrong)):
        verdict = judge(table, made, diagnosis=sc.diagnose(table, made, models=(), n_starts=0))
        check = next(check for check in verdict.checks if check.name == "Catalogue directions")
        for text in (verdict.headline, check.sentence):
            assert "rests on annual aberration" in text and f"{significant(found.f_px)} px" in text
    assert check.level is Level.PASS
    # Data of a simulation know no aberration.
    assert not observed.rests_on_aberration(obs.with_meta(source="simulated"), found)


def test_f_of_the_whole_sky_does_not_rest_on_aberration():
    _, obs, cal = field(2, twice=False, n_frames=40)
    assert unseen_aberration(obs, cal) is None
    _, again, wrong = field(2, twice=True, n_frames=40)
    assert time_test(again, wrong).cause == "aberration twice"
    verdict = judge(obs, cal, diagnosis=sc.diagnose(obs, cal, models=(), n_starts=0))
    assert "rests on" not in verdict.headline


def hard(obs, kind, rng):
    """The table with what looks like something else."""
    u, v = (obs.x_px - 512.0) / 512.0, (obs.y_px - 512.0) / 512.0
    n, frame = len(u), obs.frame
    dx, dy, d_dec = np.zeros((3, n))
    if kind == "focal":
        dx, dy = 0.15 * rng.standard_normal(frame.max() + 1)[frame] * np.array([u, v])
    elif kind == "drift":
        dx, dy = 0.5 * (frame / (frame.max() + 1) - 0.5) * np.array([u, v])
    elif kind == "shape":
        dx, dy = 0.3 * np.sin(6.0 * u), 0.3 * np.cos(5.0 * v)
    elif kind == "stars":
        own = np.unique(np.round(obs.directions_icrs, 7), axis=0, return_inverse=True)[1].ravel()
        d_dec = rng.standard_normal(own.max() + 1)[own] / 3600.0
    elif kind == "wrong":
        dx = np.where(rng.random(n) < 0.03, rng.normal(0.0, 5.0, n), 0.0)
    elif kind == "tails":
        dx, dy = 0.1 * rng.standard_t(2.5, (2, n))
    x, y = (np.clip(a, 0.0, 1023.0) for a in (obs.x_px + dx, obs.y_px + dy))
    return replace(obs, x_px=x, y_px=y, dec_deg=obs.dec_deg + d_dec)


HARD = ("", "focal", "drift", "shape", "stars", "wrong", "tails")


def blamed(seed, kind, **conditions):
    obs, camera = seen(seed, **conditions)
    obs = hard(
        make_apparent(obs, site=SITE if conditions.get("air") else None),
        kind,
        np.random.default_rng(seed),
    )
    return time_test(obs, sc.calibrate(obs, camera, duplicates="keep"))


@pytest.mark.parametrize("kind", ["", "shape"])
def test_control_a_right_time_is_not_blamed(kind):
    assert blamed(2, kind, n_frames=10, air=1.0) is None


@pytest.mark.slow
@pytest.mark.parametrize("kind", HARD)
def test_control_no_good_table_is_blamed(kind):
    for seed in range(10, 14):
        rng = np.random.default_rng(seed)
        field, noise, n = (
            rng.choice([5.0, 12.0, 25.0]),
            rng.choice([0.02, 0.1, 0.3]),
            int(rng.choice([3, 8, 25])),
        )
        found = blamed(seed, kind, n_frames=n, field_deg=field, sigma_px=noise, air=float(seed % 2))
        assert found is None, found
