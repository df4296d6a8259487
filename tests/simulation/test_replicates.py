"""The loop of Monte Carlo replicates: seeds, failures, what is kept."""

import signal
from functools import partial

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import CalibrationError, CatalogueError, SamplingError
from starcal_uq.simulation.replicates import Trials


def drawn(scale, number, seeds):
    return number, scale * np.random.default_rng(seeds).standard_normal()


def unlucky(number, seeds):
    if number % 3 == 1:
        raise CalibrationError("add frames." if number == 1 else "add stars.")
    return number


def trials(scale=1.0, **options):
    return Trials(partial(drawn, scale), "call", 2, **options)


def test_a_trial_depends_on_the_seed_and_its_number_alone():
    expected = [
        (i, np.random.default_rng(np.random.SeedSequence(7, spawn_key=(i,))).standard_normal())
        for i in range(5)
    ]
    assert trials().run(5, 7, workers=0).good == expected
    assert trials().run(5, 7, workers=2).good == expected
    assert trials().run(3, 7, workers=0).good == expected[:3]
    # Control: another seed.
    assert trials().run(3, 8, workers=0).good != expected[:3]


def test_consecutive_trials_have_common_random_numbers():
    values = [value for _, value in trials(common=3).run(6, 7, workers=0).good]
    assert values[:3] == values[:1] * 3 and values[3:] == values[3:4] * 3
    assert values[0] != values[3]


def test_failures_are_outcomes_and_counted():
    found = Trials(partial(unlucky), "call", 1).run(6, 0, workers=0)
    assert found.results == [0, None, 2, 3, None, 5]
    assert found.failures == ("add frames.", "add stars.")
    assert not found.interrupted and found.good == [0, 2, 3, 5]


def test_errors_of_settings_end_the_study():
    def dark(number, seeds):
        raise CatalogueError("no stars.")

    with pytest.raises(CatalogueError):
        Trials(partial(dark), "call", 1).run(2, 0, workers=0)
    with pytest.raises(CalibrationError):
        Trials(partial(unlucky), "call", 1, fatal=(CalibrationError,)).run(2, 0, workers=0)


def test_without_a_result_the_commonest_reason_is_given():
    def fail(number, seeds):
        raise SamplingError("rare." if number == 0 else "common.")

    found = Trials(partial(fail), "call", 1).run(3, 0, workers=0)
    with pytest.raises(CalibrationError, match=r"commonest reason: common\.$"):
        _ = found.good


def test_what_is_kept_belongs_to_the_study_that_made_it(tmp_path):
    def press(done, total):
        if done == 2:
            signal.raise_signal(signal.SIGINT)

    assert trials().run(4, 7, workers=0, keep=tmp_path, progress=press).interrupted
    with pytest.raises(KeyboardInterrupt):
        trials().run(4, 8, workers=0, keep=tmp_path, progress=press, whole=True)

    def computed(scale, seed):
        steps = []
        found = trials(scale).run(
            4, seed, workers=0, keep=tmp_path, progress=lambda done, _: steps.append(done)
        )
        assert found.good == trials(scale).run(4, seed, workers=0).good
        return steps

    # Of other seeds and other studies nothing is taken.
    assert computed(1.0, 7) == [3, 4]
    assert computed(1.0, 9) == [1, 2, 3, 4]
    assert computed(2.0, 7) == [1, 2, 3, 4]


def test_a_keyword_that_no_study_has_is_an_error():
    for study in (partial(sc.validate, sc.paper.paper_camera()), sc.paper.interaction_study):
        with pytest.raises(TypeError, match="n_workers"):
            study(n_workers=2)
