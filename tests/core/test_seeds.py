"""Whatever is random takes a whole number or a Generator, and states the number that repeats it."""

import inspect

import numpy as np
import pytest

import starcal_uq as sc
from tests.helpers.public import public_functions
from tests.helpers.scenes import observations


def test_every_seed_may_be_a_generator():
    found = 0
    for name, function in public_functions():
        parameters = inspect.signature(function).parameters
        assert "rng" not in parameters, name
        if "seed" in parameters:
            kinds = parameters["seed"].annotation.split(" | ")
            assert "Seed" in kinds and "int" not in kinds, name
            found += 1
    assert found > 35


def test_results_state_the_number_that_was_drawn():
    stars, camera = sc.load_catalogue(max_mag=5.0), sc.paper.paper_camera()
    rng = np.random.default_rng(5)
    one, other = (sc.simulate(stars, camera, n_frames=3, seed=rng) for _ in range(2))
    assert not np.array_equal(one.xy, other.xy)
    drawn = np.random.default_rng(5).integers(1 << 63)
    assert one.origin.seed == drawn
    again = sc.simulate(stars, camera, n_frames=3, seed=one.origin.seed)
    assert np.array_equal(one.xy, again.xy)


def test_draws_of_a_generator_are_repeated_by_the_recorded_seed():
    obs = observations(n_frames=12)
    cal = sc.calibrate(obs, sc.paper.paper_start())
    few = {"n_steps": 20, "n_ensembles": 2}
    one = sc.sample(obs, cal, seed=np.random.default_rng(1), **few)
    again = sc.sample(obs, cal, seed=one.provenance.seed, **few)
    assert np.array_equal(one.draws, again.draws)
    # Negative control: another state of a Generator is another seed.
    assert one.provenance.seed != np.random.default_rng(2).integers(1 << 63)
    assert type(sc.diagnose(obs, cal, seed=np.random.default_rng(1)).provenance.seed) is int


@pytest.mark.parametrize("seed", ["one", 1.5, -1, np.random.RandomState(1)])
def test_what_is_no_seed_is_refused_in_one_sentence(seed):
    with pytest.raises(sc.StarcalError, match=r"seed is .*: give a whole number") as refused:
        sc.observations.split_frames(observations(n_frames=4), "random", seed=seed)
    assert "\n" not in str(refused.value)
