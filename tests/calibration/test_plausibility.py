"""A slip in the table or the camera file is named where a calibration fails."""

import dataclasses
import re

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.calibration import plausibility
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.status import Status
from starcal_uq.paper.recursive.folder import filter_run
from tests.helpers.outside import campaign, sky_angles

FIELDS = (8.0, 45.0)
# Clauses that blame the table or the camera file.
BLAMES = (
    "looks like",
    "look like",
    "look swapped",
    "mirrored",
    "frame number",
    "fit a focal length",
    "principal point",
    "belong",
)


def seen(field, seed=1, **departures):
    return campaign(np.random.default_rng(seed), field_deg=field, **({"n_frames": 30} | departures))


def sheet(c, **changes):
    known = c.camera_toml() | changes
    return sc.Camera(**known, coefficients=(0.0, 0.0))


def wrong_share(c, share):
    rng = np.random.default_rng(5)
    wrong = rng.random(len(c.columns["x_px"])) < share
    return {
        name: np.where(wrong, rng.uniform(0, c.size_px - 1, len(wrong)), c.columns[name])
        for name in ("x_px", "y_px")
    }


def shuffled(values):
    return np.random.default_rng(6).permutation(values)


# What is done to the columns, and what is then said.
TABLES = {
    "hours": (lambda c: {"ra_deg": c["ra_deg"] / 15.0}, "ra_deg looks like hours .*: multiply it"),
    "radians": (
        lambda c: {name: np.radians(c[name]) for name in ("ra_deg", "dec_deg")},
        "ra_deg and dec_deg look like radians .*: multiply them by 180/pi",
    ),
    "ra in radians": (lambda c: {"ra_deg": np.radians(c["ra_deg"])}, "ra_deg looks like radians"),
    "dec in radians": (lambda c: {"dec_deg": np.radians(c["dec_deg"])}, "dec_deg looks like"),
    "x and y": (lambda c: {"x_px": c["y_px"], "y_px": c["x_px"]}, "the image is mirrored: .*"),
    "x": (lambda c: {"x_px": 1023.0 - c["x_px"]}, "the image is mirrored: count x_px from the"),
    "y": (lambda c: {"y_px": 1023.0 - c["y_px"]}, "the image is mirrored: .* or y_px from the"),
    "frames": (lambda c: {"frame": shuffled(c["frame"])}, "frame numbers"),
    "one frame": (lambda c: {"frame": 0 * c["frame"]}, "all rows have one frame number"),
    "rows": (
        lambda c: dict(
            zip(
                ("ra_deg", "dec_deg"),
                shuffled(np.array([c["ra_deg"], c["dec_deg"]]).T).T,
                strict=True,
            )
        ),
        (
            "farther apart in the sky than the camera sees .*: their frame numbers or directions "
            "belong to other rows"
        ),
    ),
}
CAMERAS = {
    "micrometres": (lambda f: {"focal_mm": 1000.0 * f}, "focal_mm looks like micrometres .*:"),
    "pixels": (lambda f: {"focal_mm": 100.0 * f}, "focal_mm looks like pixels .* by the pixel"),
    "pitch": (lambda f: {"pixel_um": 0.01}, "pixel_um looks like millimetres \\(0.01\\): multiply"),
    "another": (lambda f: {"focal_mm": 2.2 * f}, "the stars fit a focal length of about .*"),
}


def slipped(slip, field):
    """A table and a camera file with a slip in one of them, and what is to be said of it."""
    c = seen(field)
    if slip in TABLES:
        change, words = TABLES[slip]
        return sc.Observations(**(c.columns | change(c.columns))), sheet(c), words
    change, words = CAMERAS[slip]
    return sc.Observations(**c.columns), sheet(c, **change(sheet(c).focal_mm)), words


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("slip", [*TABLES, *CAMERAS])
def test_a_slip_is_named(slip, field):
    obs, camera, words = slipped(slip, field)
    assert re.search(words, plausibility.find_reason(obs, camera, Status.MAX_ITERATIONS) or "")


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("hours", "x and y"),
        ("radians", "y"),
        ("hours", "dec in radians"),
        ("hours", "micrometres"),
        ("x", "another"),
    ],
)
def test_two_slips_at_once_are_both_named(one, other, field):
    c = seen(field)
    (first, said), (second, more) = ((TABLES | CAMERAS)[slip] for slip in (one, other))
    columns, camera = c.columns | first(c.columns), sheet(c)
    if other in TABLES:
        columns |= second(columns)
    else:
        camera = sheet(c, **second(camera.focal_mm))
    reason = (
        plausibility.find_reason(sc.Observations(**columns), camera, Status.MAX_ITERATIONS) or ""
    )
    assert re.search(f"{said}.*; and .*{more.replace(', ra_deg does not', '')}", reason), reason


def test_a_stream_is_explained_by_its_first_frames(tmp_path):
    c = seen(8.0)
    obs = sc.Observations(**(c.columns | TABLES["hours"][0](c.columns)))
    obs.save(tmp_path / "obs.parquet")
    frames = [obs.select_frames([number]) for number in obs.frame_ids]
    for fails in (
        lambda: sc.calibrate(frames, sheet(c), method="griffith"),
        lambda: filter_run(tmp_path / "obs.parquet", sheet(c), tmp_path / "run"),
    ):
        with pytest.raises(CalibrationError, match=TABLES["hours"][1]):
            fails()
    # What has been read and is gone is not asked for again.
    with pytest.raises(CalibrationError, match="far worse than centroid noise"):
        sc.calibrate(iter(frames), sheet(c), method="griffith")


def test_the_error_of_a_calibration_names_the_slip():
    obs, camera, words = slipped("x", 8.0)
    with pytest.raises(CalibrationError, match=words) as caught:
        sc.calibrate(obs, camera)
    assert not caught.value.status.ok and str(caught.value).endswith(".")
    assert "max_iterations" not in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("slip", CAMERAS)
def test_from_a_wrong_focal_length_the_right_one_is_found_or_the_slip_named(slip, field):
    obs, camera, words = slipped(slip, field)
    try:
        found = sc.calibrate(obs, camera)
    except CalibrationError as error:
        assert re.search(words, str(error))
    else:
        assert found.theta[:3] == pytest.approx(seen(field).theta[:3], rel=2e-3)


def test_few_wrong_stars_are_named_where_the_others_agree():
    c = seen(15.0)
    stars = sc.Observations(**(c.columns | wrong_share(c, 0.005)))
    with pytest.raises(
        CalibrationError, match=r"about (0\.[2-9]|1|2) % of the stars .*calibration\.screen"
    ):
        sc.calibrate(stars, sheet(c))
    screened = sc.calibration.screen(stars, sheet(c)).calibration
    assert screened.theta[:3] == pytest.approx(c.theta[:3], abs=1.0)


@pytest.mark.parametrize("field", FIELDS)
def test_wrong_stars_and_noise_are_told_apart(field):
    c = seen(field)
    half = sc.Observations(**(c.columns | wrong_share(c, 0.5)))
    with pytest.raises(
        CalibrationError,
        match=r"about (4|5)\d % of the stars do not fit the others .*calibration\.screen",
    ):
        sc.calibrate(half, sheet(c))
    most = sc.Observations(**(c.columns | wrong_share(c, 0.9)))
    with pytest.raises(CalibrationError, match=r"fit no common attitude|identify them again"):
        sc.calibration.screen(most, sheet(c))
    noisy = seen(field, sigma_px=12.0)
    with pytest.raises(CalibrationError, match=r"the stars scatter by about 1\d px around their"):
        sc.calibrate(sc.Observations(**noisy.columns), sheet(noisy))
    # Five pixels are noise that a wide field bears; a narrow one no longer tells the principal
    # point from the pointing.
    noisy = seen(field, sigma_px=5.0)
    if field > 20.0:
        assert sc.calibrate(sc.Observations(**noisy.columns), sheet(noisy)).sigma == pytest.approx(
            5.0, rel=0.1
        )
    else:
        with pytest.raises(CalibrationError, match=r"the data do not determine x0: more frames"):
            sc.calibrate(sc.Observations(**noisy.columns), sheet(noisy), model="brown")


def test_swapped_directions_near_the_equinox_are_named():
    c = seen(8.0, n_frames=400)
    obs = sc.Observations(**c.columns)
    highest = np.maximum.reduceat(obs.ra_deg, obs.frame_starts[:-1])
    lowest = np.minimum.reduceat(obs.dec_deg, obs.frame_starts[:-1])
    part = obs.select_frames(obs.frame_ids[(highest < 80.0) & (lowest > 5.0)])
    assert part.n_frames > 20
    swapped = dataclasses.replace(part, ra_deg=part.dec_deg, dec_deg=part.ra_deg)
    reason = plausibility.find_reason(swapped, sheet(c), Status.STALLED)
    assert reason == "ra_deg and dec_deg look swapped: exchange the two columns"


HARD = {
    "few stars": {"stars_per_frame": 4},
    "few frames": {"stars_per_frame": 5, "n_frames": 6},
    "noise": {"sigma_px": 5.0, "stars_per_frame": 5},
    "more noise": {"sigma_px": 15.0},
    "barrel": {"corner_px": (-100.0, 30.0)},
    "pincushion": {"corner_px": (60.0, -10.0)},
    "one patch": {"patch_stars": 25, "n_frames": 15},
    "one frame": {"n_frames": 1, "stars_per_frame": 20},
}


@pytest.mark.parametrize("conditions", HARD)
def test_control_no_slip_is_blamed_on_good_tables_that_are_hard(conditions):
    """Asked as if the calibration had failed, for fields from 3 to 80 degrees."""
    for field, seed in ((3.0, 100), (8.0, 101), (20.0, 100), (80.0, 101)):
        c = seen(field, seed, **HARD[conditions])
        reason = (
            plausibility.find_reason(sc.Observations(**c.columns), sheet(c), Status.MAX_ITERATIONS)
            or ""
        )
        assert not [words for words in BLAMES if words in reason], reason


def test_control_a_field_near_the_pole_and_one_near_the_equinox():
    """Numbers that could be hours or radians, and right ascensions from all around."""
    c = seen(3.0)
    frames = []
    for axis in (np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.01, 0.01])):
        turn = _turning_to(axis)
        r = sc.Observations(**c.columns).directions_icrs @ (turn @ c.attitudes[0]).T
        mine = c.columns["frame"] == 0
        columns = {name: c.columns[name][mine] for name in ("frame", "x_px", "y_px")}
        columns["ra_deg"], columns["dec_deg"] = sky_angles(r[mine])
        frames.append(columns)
    for columns in frames:
        assert (
            plausibility.find_reason(sc.Observations(**columns), sheet(c), Status.STALLED) is None
        )


def _turning_to(axis):
    """A rotation that takes +z to an axis."""
    z = axis / np.linalg.norm(axis)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def test_nothing_is_looked_for_while_all_is_well(monkeypatch):
    def never(*_, **__):
        raise AssertionError("a calibration that succeeds looks for no reason.")

    monkeypatch.setattr(plausibility, "find_reason", never)
    c = seen(8.0)
    assert sc.calibrate(sc.Observations(**c.columns), sheet(c)).status.ok


def test_a_model_that_the_stars_do_not_determine_keeps_its_remedy():
    c = seen(8.0, n_frames=1, stars_per_frame=4)
    with pytest.raises(CalibrationError) as caught:
        sc.calibrate(sc.Observations(**c.columns), sheet(c), model="brown")
    assert not [words for words in BLAMES if words in str(caught.value)]
