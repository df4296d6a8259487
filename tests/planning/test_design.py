"""Which frames to take next: optimal choice against random pointing, in theory and by
simulation.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.attitude.rotations import quaternion_to_rotation, random_rotations
from starcal_uq.core.errors import PlanningError, SettingError
from starcal_uq.planning.design import FrameChoice, choose_frames
from tests.helpers.scenes import camera, observations


@lru_cache
def sky() -> sc.StarCatalogue:
    return sc.load_catalogue(max_mag=6.0)


@lru_cache
def chosen(n_frames: int = 30, **options: object) -> FrameChoice:
    return fresh(n_frames, **options)


def fresh(n_frames: int = 30, **options: object) -> FrameChoice:
    settings = {"candidates": 800, "n_geometries": 300, **options}
    return choose_frames(camera(), sky(), n_frames=n_frames, **settings)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "options",
    [{"criterion": "D"}, {"scope": "common"}, {"scope": "rest"}, {"scope": "calibration"}],
)
def test_chosen_frames_beat_every_random_set(options):
    found = chosen(**options)
    for name in ("x0_px", "f_px", "common_pitch_arcsec", "rest_yaw_arcsec"):
        mean, low, high = found.factor(name)
        assert 1.25 < low < mean < high
        assert found.factors[:, found.names.index(name)].min() > 1.0
    assert (np.diff(found.score_path) < 0.0).all()
    assert (found.score_path < found.random_path).all()


def test_each_criterion_is_best_at_its_own():
    found = {scope: chosen(scope=scope) for scope in ("common", "rest")} | {
        "D": chosen(criterion="D")
    }

    def cross(choice, part):
        values = [
            choice.after[choice.names.index(f"{part}_{axis}_arcsec")] for axis in ("pitch", "yaw")
        ]
        return np.hypot(*values)

    for part in ("common", "rest"):
        assert all(
            cross(found[part], part) <= cross(other, part) * (1.0 + 1e-9)
            for other in found.values()
        )


def test_greedy_with_exchange_finds_the_best_of_all_sets():
    """Few enough candidates to try every set."""
    from itertools import combinations

    from starcal_uq.maths.linear import inverses
    from starcal_uq.planning.forecast import quantities, spreads
    from starcal_uq.planning.information import look_at, random_frames
    from starcal_uq.simulation.frames import Tracker

    rotations = random_rotations(16, np.random.default_rng(4))
    found = choose_frames(
        camera(), sky(), n_frames=4, candidates=rotations, min_stars=6, n_geometries=100
    )
    tracker = Tracker(camera(), min_stars=6)
    pool = look_at(sky(), tracker, rotations)
    mission = random_frames(sky(), tracker, n_frames=100, seed=0)
    forms = {q.name: q.form for q in quantities(mission)}
    weights = forms["common_pitch_arcsec"] + forms["common_yaw_arcsec"]
    sets = np.array(list(combinations(range(pool.n_frames), 4)))
    scores = spreads(weights[None], inverses(pool.information[sets].sum(axis=1)))[:, 0]
    own = spreads(weights[None], inverses(pool.information[found.candidate].sum(axis=0)))[0]
    assert own <= scores.min() * 1.01
    # Control: the typical set is far from it.
    assert np.median(scores) > 1.1 * own


def test_data_that_are_there_already_change_the_choice():
    cal = sc.calibrate(observations(), camera())
    found = fresh(after=cal)
    assert np.isfinite(found.before).all()
    assert (found.after < found.before).all()
    assert not np.isfinite(chosen().before).any()
    # Beside 60 frames, 30 more matter less.
    assert found.factor("x0_px")[0] < chosen().factor("x0_px")[0]


def test_table_points_where_the_frames_are():
    table = chosen().to_dataframe()
    assert list(table["order"]) == list(range(1, 31))
    rotations = quaternion_to_rotation(table[["qx", "qy", "qz", "qw"]].to_numpy())
    assert rotations == pytest.approx(chosen().rotations, abs=1e-12)
    ra, dec, roll = (
        np.radians(table[name].to_numpy()) for name in ("ra_deg", "dec_deg", "roll_deg")
    )
    boresight = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    assert rotations[:, 2] == pytest.approx(boresight, abs=1e-12)
    north = np.stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)], axis=1)
    east = np.stack([-np.sin(ra), np.cos(ra), np.zeros_like(ra)], axis=1)
    assert rotations[:, 1] == pytest.approx(
        np.cos(roll)[:, None] * north + np.sin(roll)[:, None] * east, abs=1e-9
    )
    assert len(set(table["candidate"])) == 30


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"n_frames": 0}, "n_frames is 0"),
        ({"criterion": "E"}, "use one of D, A"),
        ({"scope": "total"}, "cannot be optimised"),
        ({"min_stars": 2}, "at least 3"),
        ({"candidates": np.eye(3)}, "rotation matrices"),
        ({"candidates": 20}, "fewer than the 30 frames"),
    ],
)
def test_settings_that_cannot_work_are_refused(options, words):
    with pytest.raises((PlanningError, SettingError), match=words):
        choose_frames(camera(), sky(), **{"n_frames": 30, **options})


@pytest.mark.slow
def test_chosen_frames_beat_random_ones_in_simulated_campaigns():
    """Errors of calibrations, not their forecast: rms principal-point error smaller by the factor
    that is stated.
    """
    found = choose_frames(camera(), sky(), n_frames=30, candidates=3000, seed=1)
    errors = {"chosen": [], "random": []}
    for seed in range(75):
        for name, options in (("chosen", {"attitudes": found.rotations}), ("random", {})):
            obs = sc.simulate(
                sky(), camera(), n_frames=30, min_stars=10, seed=1000 + seed, **options
            )
            errors[name].append(sc.calibrate(obs, camera()).theta[:2] - camera().theta[:2])
    rms = {name: np.sqrt(np.mean(np.square(values))) for name, values in errors.items()}
    stated = found.factor("x0_px")[0]
    # 150 numbers each know an rms to 6 %, a ratio to 8 %.
    assert rms["random"] / rms["chosen"] == pytest.approx(stated, rel=0.25)
    assert rms["random"] / rms["chosen"] > 1.3
