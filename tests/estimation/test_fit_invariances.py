"""What must not change an estimate, or changes it in a known way."""

from functools import cache

import numpy as np
import pytest

import starcal_uq as sc
from tests.helpers.outside import campaign, unit_vectors

SIZE = 1024
# The same minimum by other sums: solvers end within this of it, in standard deviations.
ROUNDING = {"efficient": 1e-5, "three_stage": 1e-3, "tails": 1e-2}
SHIFT, SCALE = 7.25, 2.5


@pytest.fixture(scope="module")
def columns():
    c = campaign(np.random.default_rng(8), n_frames=40, stars_per_frame=12).columns
    return {name: c[name] for name in ("frame", "x_px", "y_px", "ra_deg", "dec_deg")}


def calibrated(columns, how, origin_px=0.0, scale=1.0):
    """The calibration of a detector whose pixels are counted from elsewhere, or are `scale` times
    as many.
    """
    options = {"effects": how} if how == "tails" else {"method": how}
    centre = scale * 0.5 * (SIZE - 1) + origin_px
    camera = sc.Camera(round(scale * SIZE), round(scale * SIZE), 10.0 / scale, 39.0, centre, centre)
    cal = sc.calibrate(sc.Observations(**columns), camera, **options)
    return cal.theta, cal.sigmas


@pytest.fixture(scope="module")
def reference(columns):
    """The calibrations that nothing was done to, made when first asked for."""
    return cache(lambda how: calibrated(columns, how))


def turned_sky(columns, turn):
    x, y, z = turn @ unit_vectors(columns["ra_deg"], columns["dec_deg"]).T
    sky = {"ra_deg": np.degrees(np.arctan2(y, x)) % 360.0}
    # At the pole itself an arc sine has half of the digits.
    return columns | sky | {"dec_deg": np.degrees(np.arctan2(z, np.hypot(x, y)))}


def another_sky(columns, rng):
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    return turned_sky(columns, np.linalg.det(turn) * turn), {}, {}


def sky_at_the_pole(columns, rng):
    """The first star stands at the pole, those of its frame around it at all right ascensions."""
    first = unit_vectors(columns["ra_deg"][:1], columns["dec_deg"][:1])[0]
    across = np.cross(first, [0.3, -0.2, 0.9])
    across /= np.linalg.norm(across)
    return turned_sky(columns, np.array([across, np.cross(first, across), first])), {}, {}


def stars_in_another_order(columns, rng):
    order = rng.permutation(len(columns["frame"]))
    return {name: values[order] for name, values in columns.items()}, {}, {}


def frames_of_other_numbers(columns, rng):
    """In another order as well."""
    names = rng.permutation(10_000)[: columns["frame"].max() + 1] - 5000
    return columns | {"frame": names[columns["frame"]]}, {}, {}


def both_axes_turned_round(columns, rng):
    turned = {name: SIZE - 1.0 - columns[name] for name in ("x_px", "y_px")}
    return columns | turned, {}, {"x0": lambda x: SIZE - 1.0 - x, "y0": lambda y: SIZE - 1.0 - y}


def mirror_of_sky_and_detector(columns, rng):
    mirrored = {"x_px": SIZE - 1.0 - columns["x_px"], "ra_deg": (360.0 - columns["ra_deg"]) % 360.0}
    return columns | mirrored, {}, {"x0": lambda x: SIZE - 1.0 - x}


def pixels_counted_from_elsewhere(columns, rng):
    moved = {name: columns[name] + SHIFT for name in ("x_px", "y_px")}
    return (
        columns | moved,
        {"origin_px": SHIFT},
        {"x0": lambda x: x + SHIFT, "y0": lambda y: y + SHIFT},
    )


def smaller_pixels(columns, rng):
    finer = {name: SCALE * columns[name] for name in ("x_px", "y_px")}
    powers = {"x0": 1, "y0": 1, "f": 1, "k1": -2, "k2": -4}
    return (
        columns | finer,
        {"scale": SCALE},
        {n: lambda v, p=p: v * SCALE**p for n, p in powers.items()},
    )


CHANGES = (
    *(
        another_sky,
        sky_at_the_pole,
        stars_in_another_order,
        frames_of_other_numbers,
        both_axes_turned_round,
    ),
    *(mirror_of_sky_and_detector, pixels_counted_from_elsewhere, smaller_pixels),
)


def moved(columns, reference, how, change):
    """How far a change moves the estimate from where it should, in sigma, and what it multiplies
    the sigmas by.
    """
    theta, sigmas = reference(how)
    other, options, laws = change(columns, np.random.default_rng(5))
    found, stated = calibrated(other, how, **options)
    names = ("x0", "y0", "f", "k1", "k2")
    wanted = np.array(
        [laws.get(name, float)(value) for name, value in zip(names, theta, strict=True)]
    )
    slope = np.array([abs(laws.get(n, float)(1.0) - laws.get(n, float)(0.0)) for n in names])
    return np.max(np.abs(found - wanted) / (slope * sigmas)), stated / (slope * sigmas)


@pytest.mark.parametrize(
    "how", ["efficient", "three_stage", pytest.param("tails", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("change", CHANGES)
def test_estimate_and_sigma_follow(columns, reference, how, change):
    distance, ratio = moved(columns, reference, how, change)
    assert distance < ROUNDING[how]
    assert ratio == pytest.approx(1.0, rel=ROUNDING[how])


def test_other_names_of_frames_in_the_same_order_change_no_bit(columns, reference):
    theta, sigmas = reference("efficient")
    found, stated = calibrated(columns | {"frame": 17 * columns["frame"] + 4}, "efficient")
    assert np.array_equal(found, theta)
    assert np.array_equal(stated, sigmas)


def stretched_in_one_axis(columns, rng):
    # The control: stretched by a thousandth along one axis, which no camera of square pixels can
    # follow.
    return columns | {"x_px": 1.001 * columns["x_px"]}, {}, {}


def test_what_is_no_symmetry_is_seen(columns, reference):
    assert moved(columns, reference, "efficient", stretched_in_one_axis)[0] > 1.0
