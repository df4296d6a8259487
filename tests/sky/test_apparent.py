"""Earth's velocity and aberration, against astropy, erfa's chain and an independent formula."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone

import erfa
import numpy as np
import pytest

from starcal_uq.core.errors import CatalogueError, ObservationError
from starcal_uq.observations.table import Observations
from starcal_uq.sky.apparent import aberrate, earth_velocity_km_s, make_apparent
from starcal_uq.sky.positions import ra_dec_deg, unit_vectors

TIMES = ["2019-07-29T20:47:26", "2026-11-21T03:04:05.678", "2024-02-29"]
UAS = np.pi / (180.0 * 3600.0 * 1e6)


def random_directions(n: int, seed: int = 3) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def boost(directions: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Aberration as a Lorentz boost of the photon's four-momentum: nothing in common with erfa's
    formula.
    """
    speed = np.linalg.norm(beta)
    gamma = 1.0 / np.sqrt(1.0 - speed**2)
    axis = beta / speed
    # The photon flies along -u with unit energy; in the moving frame its momentum along the axis
    # mixes with its energy.
    momentum = -directions
    along = momentum @ axis
    boosted = momentum + np.outer((gamma - 1.0) * along - gamma * speed, axis)
    return -boosted / np.linalg.norm(boosted, axis=1, keepdims=True)


def observations(**changes: object) -> Observations:
    n = 4
    columns: dict[str, object] = {
        "frame": np.array([0, 0, 1, 1]),
        "x_px": np.arange(n) * 10.0,
        "y_px": np.arange(n) * 20.0,
        "ra_deg": np.array([10.0, 14.0, 200.0, 203.0]),
        "dec_deg": np.array([-40.0, -42.0, 88.0, 89.0]),
        "time_utc": np.array([TIMES[0], TIMES[0], TIMES[1], TIMES[1]]),
        "meta": {"directions": "catalogue", "source": "test"},
    }
    return Observations(**{**columns, **changes})  # type: ignore[arg-type]


def test_earth_velocity_against_astropy() -> None:
    from astropy.coordinates import get_body_barycentric_posvel, solar_system_ephemeris
    from astropy.time import Time
    from astropy.utils import iers

    with iers.conf.set_temp("auto_download", False), solar_system_ephemeris.set("builtin"):
        _, expected = get_body_barycentric_posvel("earth", Time(TIMES, scale="utc"))
    velocity = earth_velocity_km_s(TIMES)
    assert velocity.shape == (3, 3)
    assert np.allclose(velocity, expected.xyz.to_value("km/s").T, rtol=0, atol=1e-6)
    assert np.allclose(np.linalg.norm(velocity, axis=1), 29.8, atol=0.6)


def test_times_in_every_form_mean_the_same() -> None:
    reference = earth_velocity_km_s("2026-11-21T03:04:05")
    assert reference.shape == (3,)
    forms = [
        "2026-11-21T03:04:05Z",
        "2026-11-21 03:04:05",
        "2026-11-21T05:04:05+02:00",
        "2026-11-20T20:34:05-0630",
        np.datetime64("2026-11-21T03:04:05"),
        datetime(2026, 11, 21, 3, 4, 5, tzinfo=UTC),
        datetime(2026, 11, 21, 4, 4, 5, tzinfo=timezone(timedelta(hours=1))),
    ]
    for form in forms:
        assert np.allclose(earth_velocity_km_s(form), reference, rtol=0, atol=1e-9), form
    assert earth_velocity_km_s([]).shape == (0, 3)
    # A leap second is a time like any other; the far future has no known leap seconds and is read
    # without complaint.
    assert np.isfinite(earth_velocity_km_s(["2016-12-31T23:59:60.5", "2090-01-01"])).all()


@pytest.mark.parametrize(
    "bad", ["noon", "2026-13-01", "2026-11-21T24:30", "2026-02-30", "1492-10-12", "2026", ""]
)
def test_unreadable_times_are_named(bad: str) -> None:
    with pytest.raises(CatalogueError, match=rf"'{bad}' \(number 2\) .* write it as"):
        earth_velocity_km_s(["2026-11-21", bad])


def test_aberration_against_the_chain_of_erfa() -> None:
    """`erfa.apci13` and `erfa.atciqz` with the Sun's deflection switched off and the axes left at
    ICRS.
    """
    from astropy.time import Time
    from astropy.utils import iers

    with iers.conf.set_temp("auto_download", False):
        tdb = Time(TIMES[1], scale="utc").tdb
        context, _ = erfa.apci13(tdb.jd1, tdb.jd2)
    context = context.copy()
    context["bpn"] = np.eye(3)
    context["em"] = 1e9
    directions = random_directions(100, seed=5)
    ra, dec = (np.radians(angle) for angle in ra_dec_deg(directions))
    chain = unit_vectors(*(np.degrees(angle) for angle in erfa.atciqz(ra, dec, context)))
    ours = aberrate(directions, earth_velocity_km_s(TIMES[1]))
    assert np.linalg.norm(ours - chain, axis=1).max() < 1.0 * UAS
    assert np.degrees(np.linalg.norm(ours - directions, axis=1)).max() * 3600.0 == pytest.approx(
        20.5, abs=0.5
    )


def test_one_velocity_for_each_direction() -> None:
    directions = random_directions(3)
    velocities = np.array([[30.0, 0.0, 0.0], [0.0, -30.0, 1.0], [3.0, 4.0, 5.0]])
    together = aberrate(directions, velocities)
    for row in range(3):
        assert np.allclose(
            together[row], aberrate(directions[row], velocities[row]), rtol=0, atol=1e-16
        )
    assert np.allclose(aberrate(directions, (0.0, 0.0, 0.0)), directions, rtol=0, atol=1e-16)


def test_make_apparent_adds_the_earths_velocity_of_each_row() -> None:
    obs = observations()
    apparent = make_apparent(obs)
    expected = aberrate(
        unit_vectors(obs.ra_deg, obs.dec_deg), earth_velocity_km_s([TIMES[0]] * 2 + [TIMES[1]] * 2)
    )
    assert np.allclose(
        unit_vectors(apparent.ra_deg, apparent.dec_deg), expected, rtol=0, atol=1e-15
    )
    assert apparent.meta["directions"] == "apparent"
    assert apparent.meta["source"] == "test"
    mean = earth_velocity_km_s(TIMES[:2]).mean(axis=0)
    assert apparent.meta["observer_velocity_km_s"] == pytest.approx(mean.tolist())
    assert np.array_equal(apparent.x_px, obs.x_px)
    assert obs.meta["directions"] == "catalogue"


def test_make_apparent_adds_the_observers_own_velocity() -> None:
    obs, orbit = observations(), np.array([0.0, 7.6, 0.0])
    apparent = make_apparent(obs, orbit)
    total = earth_velocity_km_s(obs.time_utc) + orbit
    expected = aberrate(unit_vectors(obs.ra_deg, obs.dec_deg), total)
    assert np.allclose(
        unit_vectors(apparent.ra_deg, apparent.dec_deg), expected, rtol=0, atol=1e-15
    )
    per_row = make_apparent(obs, np.tile(orbit, (4, 1)))
    assert np.array_equal(per_row.ra_deg, apparent.ra_deg)


def test_make_apparent_refuses_what_it_cannot_do() -> None:
    obs = observations()
    with pytest.raises(ObservationError):
        make_apparent(make_apparent(obs))
    with pytest.raises(ObservationError, match="no column 'time_utc'") as caught:
        make_apparent(observations(time_utc=None))
    assert caught.value.column == "time_utc"
    with pytest.raises(ObservationError, match=r"'time_utc'.*'noon'"):
        make_apparent(observations(time_utc=np.array([TIMES[0], TIMES[0], TIMES[1], "noon"])))
    with pytest.raises(CatalogueError):
        make_apparent(obs, (1.0, float("nan"), 0.0))
    with pytest.raises(CatalogueError):
        make_apparent(obs, np.zeros((3, 3)))
