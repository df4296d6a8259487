"""Attitude error over a temperature profile: its definition on frames, NumPy alone, and files of
profiles.
"""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import AttitudeProfileError, CalibrationError
from starcal_uq.presentation.figures.propagation import plot_thermal
from starcal_uq.presentation.words.propagation import thermal_table
from starcal_uq.propagation.attitude_error import AttitudeError
from starcal_uq.propagation.thermal import (
    TemperatureProfile,
    ThermalResponse,
    load_temperature_profile,
    read_again,
    thermal_error,
)

ARCSEC = 648000.0 / np.pi


def response(n_frames: int = 7) -> tuple[ThermalResponse, np.ndarray, np.ndarray]:
    """A response of random frames, their turns (K, 3, 3), and those in common (3, 3)."""
    rng = np.random.default_rng(4)
    turns = 1e-4 * rng.standard_normal((n_frames, 3, 5))
    together = 1e-4 * rng.standard_normal((3, 5))
    root = 0.02 * rng.standard_normal((3, 3))
    effects = SimpleNamespace(
        names=("field", "temperature"),
        at=lambda name: slice(2, 5),
        temperature_c=(-10.0, 8.0),
        coefficients=np.array([9.0, 9.0, 0.1, -0.05, 0.3]),
        covariance=np.pad(root @ root.T, ((2, 0), (2, 0))),
    )
    post = SimpleNamespace(effects=effects)
    seen = SimpleNamespace(temperature_c=np.array([-22.0, np.nan, 5.0]))
    found = ThermalResponse.of(post, seen, turns, together)
    return found, turns[:, :, :3], together[:, :3]


def orbit(n: int = 40, low: float = -40.0, high: float = 12.0) -> TemperatureProfile:
    """Uneven times, and a temperature that rises slowly and falls at once."""
    rng = np.random.default_rng(7)
    time = np.cumsum(rng.uniform(20.0, 90.0, n))
    return TemperatureProfile(time, np.linspace(low, high, n) + rng.normal(0.0, 1.0, n), "orbit")


def test_the_error_over_a_profile_is_that_of_every_frame_at_every_time() -> None:
    found, turns, together = response()
    profile = orbit()
    error = found.over(profile)
    rng = np.random.default_rng(1)
    changes = rng.multivariate_normal(found.change, found.covariance, 4000)
    warmth = (profile.temperature_c + 10.0) / 8.0
    # Alignment sees the mean over time, half of both steps for every sample.
    time = profile.time_s
    mean = np.sum(0.5 * (warmth[1:] + warmth[:-1]) * np.diff(time)) / (time[-1] - time[0])
    weights = np.gradient(time)
    weights[[0, -1]] /= 2.0
    weights /= weights.sum()
    assert error.aligned_c == pytest.approx(-10.0 + 8.0 * mean)
    for known, sizes, own in (
        (np.zeros(3), error.model_arcsec, error.model),
        (found.change, error.effects_arcsec, error.effects),
    ):
        wrong = changes - known
        common = -mean * wrong @ together.T * ARCSEC
        errors = -np.einsum("t,kij,nj->tkni", warmth, turns, wrong) * ARCSEC - common
        at_time = np.sqrt(np.mean(errors**2, axis=(1, 2)))
        np.testing.assert_allclose(sizes, at_time, rtol=0.03)
        whole = np.sqrt(weights @ at_time**2)
        np.testing.assert_allclose(own.rest_arcsec, whole, rtol=0.03)
        np.testing.assert_allclose(
            own.common_arcsec, np.sqrt(np.mean(common**2, axis=0)), rtol=0.03
        )
    # Both software models meet where alignment was calibrated, if mission and alignment see alike.
    assert (error.effects_arcsec < error.model_arcsec).all()
    assert (error.peak_arcsec("model") >= error.model.rest_arcsec).all()
    assert error.outside.sum() == np.sum(
        (profile.temperature_c < -22) | (profile.temperature_c > 5)
    )
    # Control: errors that alignment absorbs are left out.
    blind = np.sqrt(np.mean(np.einsum("t,kij,nj->tkni", warmth, turns, changes) ** 2, axis=(1, 2)))
    assert np.abs(blind * ARCSEC / error.model_arcsec - 1.0).max() > 0.2


def test_beyond_the_temperatures_that_were_seen_the_error_grows() -> None:
    found, *_ = response()
    times = np.arange(200.0)
    small, large = (
        found.over(TemperatureProfile(times, -10.0 + size * np.sin(times))).effects.rest_arcsec
        for size in (8.0, 32.0)
    )
    np.testing.assert_allclose(large / small, 4.0, rtol=1e-2)


def test_a_response_is_stored_with_the_attitude_error(tmp_path: Path) -> None:
    from tests.budgeting.test_budget_effects import EFFECTS, with_shares

    found, *_ = response()
    error = with_shares(*EFFECTS)
    error.__dict__["thermal_response"] = found
    error.save(tmp_path / "attitude.csv")
    again = AttitudeError.load(tmp_path / "attitude.csv")
    over = found.over(orbit())
    over.save(tmp_path / "thermal.csv")
    profile = read_again(tmp_path / "thermal.csv")
    assert profile.name == "orbit"
    np.testing.assert_array_equal(
        thermal_error(again.thermal_response, profile).model_arcsec, over.model_arcsec
    )


def test_the_table_the_words_and_the_figure() -> None:
    error = response()[0].over(orbit())
    table = error.to_dataframe()
    assert list(table) == [
        *("time_s", "temperature_c", "axis", "onboard_model_arcsec", "onboard_effects_arcsec")
    ]
    assert len(table) == 4 * 40
    row = table[table["axis"] == "roll"].iloc[3]
    assert row["onboard_effects_arcsec"] == error.effects_arcsec[3, 2]
    assert "alignment at −" in error.text
    assert "of the time are outside of the calibration's −22.0 to 5.0 °C" in error.text
    assert thermal_table(error).rows[2][:2] == ("rest, rms over the profile", "model")
    assert len(plot_thermal(error).axes) == 2


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("time_s,t\n0,1\n", "p.csv: column temperature_c is missing; give it, in degrees Celsius,"),
        ("temperature_c\n1\n2\n", "p.csv: column time_s or time_utc is missing; add one of them."),
        (
            "time_s,temperature_c\n0,1\n\n# eclipse\n5,cold\n",
            "p.csv, line 5: temperature_c is 'cold', not a number; repair it.",
        ),
        (
            "time_s,temperature_c\n0,283.2\n5,284\n",
            "p.csv, line 2: temperature_c is 283.2, outside of -150 to 150; give degrees Celsius.",
        ),
        (
            "time_s,temperature_c\n0,1\n5,2\n5,3\n",
            "p.csv, line 4: the time 5 s does not come after 5 s; sort the rows by time and remove",
        ),
        ("time_s,temperature_c\n0,1\n", "p.csv, line 2: is the only one; give temperatures at two"),
    ],
)
def test_bad_files_are_one_sentence(tmp_path: Path, content: str, sentence: str) -> None:
    path = tmp_path / "p.csv"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(AttitudeProfileError) as caught:
        load_temperature_profile(path)
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_times_may_be_utc_and_no_effect_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "p.csv"
    path.write_text(
        "time_utc,temperature_c\n2026-01-01T00:00:00,1\n2026-01-01T00:01:30,3\n", encoding="utf-8"
    )
    profile = load_temperature_profile(path)
    np.testing.assert_array_equal(profile.time_s, [0.0, 90.0])
    assert sc.propagation.load_temperature_profile(path).name == "p.csv"
    with pytest.raises(CalibrationError):
        thermal_error(None, path)
