"""The coupling report on the paper's sensor, and its formulas on matrices with known answers."""

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.propagation.coupling import weak_directions
from tests.helpers.scenes import observations


@pytest.fixture(scope="module")
def calibrated():
    return sc.calibrate(observations(n_frames=300), sc.paper.paper_start())


@pytest.fixture(scope="module")
def found(calibrated):
    return sc.coupling(calibrated)


def test_correlations_of_the_paper_set_up(found):
    """Focal length and distortion trade against each other; the principal point is on its own
    (DESIGN's figures).
    """
    c = found.correlation
    assert c[2, 3] == pytest.approx(-0.94, abs=0.02)
    assert c[2, 4] == pytest.approx(0.84, abs=0.03)
    assert c[3, 4] == pytest.approx(-0.97, abs=0.01)
    assert np.max(np.abs(c[:2, 2:])) < 0.2
    assert [pair[:2] for pair in found.pairs()] == [("k1", "k2"), ("f", "k1"), ("f", "k2")]


@pytest.mark.parametrize("r", [0.25, 0.5, -0.9])
def test_directions_of_two_correlated_parameters(r):
    """Variances 1 + r and 1 - r: within 0.7 and 1.4 times that of uncoupled parameters nothing is
    coupled.
    """
    first, *rest = weak_directions(
        np.array([[1.0, r, 0.0], [r, 1.0, 0.0], [0.0, 0.0, 1.0]]), ("a", "b", "c")
    )
    assert [d.variance for d in (first, *rest)] == pytest.approx([1.0 + abs(r), 1.0, 1.0 - abs(r)])
    assert rest[0].words == "c: not coupled to the others"
    for direction, word, together in ((first, "poorly", r > 0.0), (rest[1], "well", r < 0.0)):
        names, said = direction.words.split(": ")
        if abs(r) < 0.3:
            assert said == "not coupled to the others"
            continue
        assert said == (
            f"{word} determined, {direction.variance:.2g} times the variance of uncoupled "
            "parameters"
        )
        assert names in (
            {"a and b together", "b and a together"} if together else {"a against b", "b against a"}
        )


def test_common_rotation_is_what_a_wrong_principal_point_does():
    """The analytic response against attitudes solved again with a shifted principal point."""
    from starcal_uq.attitude.rotations import rotation_vector
    from starcal_uq.likelihood.marginal import MarginalLikelihood

    obs = observations(n_frames=40)
    cal = sc.calibrate(obs, sc.paper.paper_start())
    likelihood = MarginalLikelihood(obs, "brown")
    base = cal.rotations
    for index, step in ((0, 0.5), (1, 0.5), (2, 1.0), (3, 1e-9)):
        theta = cal.theta.copy()
        theta[index] += step
        turned = rotation_vector(likelihood.profile(theta)[0].rotations @ base.transpose(0, 2, 1))
        expected = cal.rotation_per_theta[:, index] * step
        assert np.allclose(np.mean(turned, axis=0), expected, rtol=5e-3, atol=2e-9)
