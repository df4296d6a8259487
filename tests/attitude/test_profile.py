"""Attitude profiles from files, their interpolation, and the frames of a mission along them."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from starcal_uq.attitude.profile import AttitudeProfile, load_attitude_profile
from starcal_uq.attitude.rotations import left_error, quaternion_to_rotation
from starcal_uq.attitude.wahba import quest
from starcal_uq.camera.projection import project
from starcal_uq.core.errors import (
    AttitudeProfileError,
    CatalogueError,
    ObservationError,
    SettingError,
)
from starcal_uq.simulation.mission import mission_frames, profile_frames
from starcal_uq.sky.catalogue import load_catalogue
from tests.helpers.profiles import slew
from tests.helpers.scenes import camera, observations, with_sigmas


def table(profile: AttitudeProfile) -> pd.DataFrame:
    return profile.to_dataframe()


def write(frame: pd.DataFrame, path: Path) -> Path:
    if path.suffix == ".csv":
        path.write_text("# a comment, with a comma\n" + frame.to_csv(index=False))
    elif path.suffix == ".parquet":
        frame.to_parquet(path)
    else:
        from astropy.table import Table

        Table.from_pandas(frame).write(path, format="ascii.ecsv", delimiter=",")
    return path


@pytest.mark.parametrize("ending", [".csv", ".ecsv", ".parquet"])
def test_every_format_says_the_same(tmp_path: Path, ending: str) -> None:
    profile = slew()
    loaded = load_attitude_profile(write(table(profile), tmp_path / f"slew{ending}"))
    np.testing.assert_allclose(loaded.time_s, profile.time_s, rtol=0, atol=0)
    np.testing.assert_allclose(loaded.quaternions, profile.quaternions, atol=1e-15)
    assert loaded.name == f"slew{ending}"
    assert loaded.messages == ()
    assert "61 attitudes over 600 s" in loaded._repr_html_()


def test_utc_times_are_seconds_since_the_first(tmp_path: Path) -> None:
    profile = slew(4, step_s=0.25)
    frame = table(profile).drop(columns="time_s")
    frame["time_utc"] = [f"2026-12-31T23:59:{second:05.2f}Z" for second in 59.0 + profile.time_s]
    for name in ("slew.csv", "slew.parquet"):
        np.testing.assert_allclose(
            load_attitude_profile(write(frame, tmp_path / name)).time_s, profile.time_s, atol=1e-8
        )
    stamps = frame.assign(time_utc=pd.to_datetime(frame["time_utc"].str.rstrip("Z")))
    found = load_attitude_profile(write(stamps, tmp_path / "stamps.parquet")).time_s
    np.testing.assert_allclose(found, profile.time_s, atol=1e-8)
    frame.loc[2, "time_utc"] = "yesterday"
    with pytest.raises(AttitudeProfileError, match=r"bad\.csv: The time 'yesterday'"):
        load_attitude_profile(write(frame, tmp_path / "bad.csv"))


def test_order_and_sense_of_quaternions_are_stated_or_refused(tmp_path: Path) -> None:
    profile = slew()
    q = profile.quaternions
    numbered = pd.DataFrame(
        {"time_s": profile.time_s, **{f"q{i}": q[:, (i + 3) % 4] for i in range(4)}}
    )
    path = write(numbered, tmp_path / "numbered.csv")
    with pytest.raises(AttitudeProfileError, match="do not say which is the scalar part; name"):
        load_attitude_profile(path)
    np.testing.assert_allclose(
        load_attitude_profile(path, scalar="first").quaternions, q, atol=1e-15
    )
    last = numbered.set_axis(["time_s", "q1", "q2", "q3", "q4"], axis=1)
    other = load_attitude_profile(write(last, tmp_path / "last.csv"), scalar="last").quaternions
    # Control: the wrong order is another attitude.
    assert np.abs(left_error(other, q)).max() > 0.1

    back = load_attitude_profile(
        write(table(profile), tmp_path / "back.csv"), sense="camera_to_icrs"
    ).quaternions
    np.testing.assert_allclose(
        quaternion_to_rotation(back), np.swapaxes(quaternion_to_rotation(q), 1, 2), atol=1e-14
    )


def test_what_is_given_is_copied_and_kept_from_change() -> None:
    time, q = np.arange(3.0), np.tile([0.0, 0.0, 0.0, 1.0], (3, 1))
    profile = AttitudeProfile(time, q)
    for given, kept in ((time, profile.time_s), (q, profile.quaternions)):
        assert not np.shares_memory(given, kept)
        with pytest.raises(ValueError):
            kept[0] = 2.0


def test_signs_are_made_continuous() -> None:
    profile = slew()
    signs = np.random.default_rng(0).choice([-1.0, 1.0], len(profile.time_s))
    mixed = AttitudeProfile(profile.time_s, profile.quaternions * signs[:, None])
    assert np.all(np.sum(mixed.quaternions[1:] * mixed.quaternions[:-1], axis=1) > 0.99)
    times = np.linspace(0.0, 600.0, 77)
    assert np.abs(left_error(mixed.at(times), profile.at(times))).max() < 1e-12


def test_interpolation_turns_steadily() -> None:
    coarse, fine = slew(61, 10.0), slew(6001, 0.1)
    at = coarse.at_rate(10.0)
    np.testing.assert_allclose(at.time_s, fine.time_s, atol=1e-9)
    assert np.abs(left_error(at.quaternions, fine.quaternions)).max() < 1e-12
    np.testing.assert_allclose(at.rate_deg_s, 0.1, rtol=1e-6)
    # Control: the nearest sample would be up to half a degree off.
    nearest = coarse.quaternions[np.rint(fine.time_s / 10.0).astype(int)]
    assert np.degrees(np.abs(left_error(nearest, fine.quaternions)).max()) > 0.4
    # Neither the last instant nor the rounding of a rate loses a frame.
    assert len(coarse.at_rate(0.1).time_s) == 61
    assert len(slew(4, 1.0 / 3.0).at_rate(3.0).time_s) == 4
    with pytest.raises(AttitudeProfileError, match="covers 0 s to 600 s"):
        coarse.at(np.array([601.0]))
    for rate, error, words in (
        (1e-4, AttitudeProfileError, "choose one that gives 2 to"),
        (1e6, AttitudeProfileError, "choose one that gives 2 to"),
        (0.0, SettingError, "rate_hz is 0.0: give a number from"),
        (1e9, SettingError, "rate_hz is 1000000000.0: give a number from"),
    ):
        with pytest.raises(error, match=words):
            coarse.at_rate(rate)


def test_nearly_unit_quaternions_are_normalised_and_said() -> None:
    profile = slew()
    q = profile.quaternions.copy()
    q[[3, 5]] *= 1.0 + 3e-5
    mended = AttitudeProfile(profile.time_s, q)
    np.testing.assert_allclose(mended.quaternions, profile.quaternions, atol=1e-15)
    assert mended.messages == (
        "2 quaternions differed from unit length by up to 3.0×10⁻⁵ and were normalised.",
    )
    assert AttitudeProfile(profile.time_s, profile.quaternions * (1.0 + 1e-7)).messages == ()


def test_wide_steps_are_said() -> None:
    (message,) = slew(61, rate_deg_s=4.0).messages
    assert slew(61, rate_deg_s=4.0).at_rate(0.1).messages == (message,)
    assert message.startswith("60 steps of the profile turn the camera by more than 30 degrees")


def broken(frame: pd.DataFrame, change: str) -> pd.DataFrame:
    if change == "back":
        frame.loc[4, "time_s"] = 10.0
    elif change == "repeat":
        frame.loc[4, "time_s"] = frame.loc[3, "time_s"]
    elif change == "length":
        frame.loc[4, ["qx", "qy", "qz", "qw"]] *= 1.0015
    elif change == "nan":
        frame.loc[4, "qz"] = np.nan
    elif change == "text":
        frame = frame.astype({"qz": object})
        frame.loc[4, "qz"] = "north"
    elif change == "column":
        frame = frame.rename(columns={"qz": "z"})
    elif change == "time":
        frame = frame.rename(columns={"time_s": "t"})
    elif change == "short":
        frame = frame.iloc[:1]
    return frame.iloc[:0] if change == "empty" else frame


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("back", r"line 7: the time 10 s does not come after 30 s; sort the rows"),
        ("repeat", r"line 7: the time 30 s does not come after 30 s"),
        ("length", r"line 7: the quaternion has the length 1\.0015, not 1"),
        ("nan", r"line 7: qz is '', not a number"),
        ("text", r"line 7: qz is 'north', not a number"),
        ("column", "column qz is missing; give qx, qy, qz, qw beside time_s or time_utc \\(the"),
        ("time", r"column time_s or time_utc is missing"),
        ("short", r"holds 1 attitude; give at least two"),
        ("empty", r"holds no rows"),
    ],
)
def test_bad_files_are_refused_in_one_sentence(tmp_path: Path, change: str, message: str) -> None:
    path = write(broken(table(slew(8)), change), tmp_path / "bad.csv")
    with pytest.raises(AttitudeProfileError, match=message) as caught:
        load_attitude_profile(path)
    assert "bad.csv" in str(caught.value)
    assert "\n" not in str(caught.value)
    if change == "length":
        with pytest.raises(AttitudeProfileError, match=r"bad.parquet: row 5: the quaternion"):
            load_attitude_profile(write(broken(table(slew(8)), change), tmp_path / "bad.parquet"))


def test_frames_show_what_the_camera_sees() -> None:
    stars, profile = load_catalogue(max_mag=6.0, epoch=2026.9), slew()
    frames = profile_frames(stars, camera(), profile, 0.5)
    times = np.array(frames.meta["frame_times_s"])
    assert frames.n_frames == len(times) == 301
    assert frames.meta["skipped_frames"] == 0
    rotations = quaternion_to_rotation(profile.at(times))
    b = np.einsum("nij,nj->ni", rotations[frames.frame], frames.directions_icrs)
    np.testing.assert_allclose(project(camera(), b), frames.xy, atol=1e-9)
    # Nothing on the detector is missing: the counts are those of all stars projected one frame at a
    # time.
    for k in (0, 17, 300):
        b = stars.directions_icrs @ rotations[k].T
        b = b[b[:, 2] > 0.95]
        xy = project(camera(), b)
        inside = np.all((xy > -0.5) & (xy < 1023.5), axis=1)
        assert inside.sum() == np.sum(frames.frame == k)
    own = profile_frames(stars, camera(), profile)
    assert own.meta["frame_times_s"] == profile.time_s.tolist()
    assert own.meta["frames"] == "attitude profile slew, 600 s"


def test_instants_with_few_stars_are_left_out_and_counted() -> None:
    stars, profile = load_catalogue(max_mag=4.5, epoch=2026.9), slew(601, 10.0)
    frames = profile_frames(stars, camera(), profile, min_stars=4)
    counts = np.diff(frames.frame_starts)
    assert counts.min() == 4
    skipped = frames.meta["skipped_frames"]
    assert 0 < skipped == 601 - frames.n_frames
    assert f"{skipped} instants with fewer than 4 stars left out" in frames.meta["frames"]
    np.testing.assert_array_equal(profile.time_s[frames.frame_ids], frames.meta["frame_times_s"])
    with pytest.raises(CatalogueError, match="none of the 601 attitudes of the profile shows 90"):
        profile_frames(stars, camera(), profile, min_stars=90)
    with pytest.raises(ValueError):
        profile_frames(stars, camera(), profile, min_stars=1)


def test_random_frames_repeat_and_are_free_of_noise() -> None:
    stars = load_catalogue(max_mag=6.0, epoch=2026.9)
    one, again, other = (
        mission_frames(stars, camera(), n_frames=30, min_stars=7, seed=s) for s in (1, 1, 2)
    )
    assert one.data_hash == again.data_hash != other.data_hash
    assert np.diff(one.frame_starts).min() >= 7
    from starcal_uq.camera.projection import unproject

    sigma = np.radians(1e-6 / 3600.0)
    found = quest(
        unproject(camera(), one.xy), one.directions_icrs, one.frame_starts, sigma_rad=sigma
    )
    assert np.sqrt(np.mean(found.taste / found.dof)) < 1.0
    assert "faintest star of magnitude 6.0" in one.meta["frames"]


def test_stated_noise_goes_along_a_profile_too() -> None:
    stars, like = load_catalogue(max_mag=6.0, epoch=2026.9), with_sigmas(observations())
    frames = profile_frames(stars, camera(), slew(), noise_like=like)
    assert frames.meta["noise"] == "median stated noise by magnitude"
    assert np.median(like.sigma_px) == pytest.approx(np.median(frames.sigma_px), rel=0.1)
    import dataclasses

    plain = profile_frames(stars, camera(), slew(), noise_like=dataclasses.replace(like, mag=None))
    assert np.all(plain.sigma_px == np.median(like.sigma_px))
    with pytest.raises(ObservationError, match="noise_like has no column sigma_px"):
        profile_frames(stars, camera(), slew(), noise_like=observations())
