"""The uncertainties of the paper's sensor, measured."""

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.diagnostics.validation.replicates import Replication
from starcal_uq.diagnostics.validation.validate import validate, validate_study
from starcal_uq.simulation.frames import Campaign
from tests.helpers import validation_controls as controls

pytestmark = pytest.mark.slow

COVERED = ("x0", "y0", "f", "k1", "k2", "sigma", "pitch", "yaw", "roll")


@pytest.fixture(scope="module")
def fixed():
    """120 replicates of the paper's camera: NEES/p is known to 0.058, a coverage to 0.02."""
    return validate(sc.paper.paper_camera(), n_replicates=120, seed=1, workers=0)


def calibration_ratio(found):
    """As `Validation.nees_ratio`, for estimate and covariance of the calibrations."""
    return found.nees_calibration.mean() / found.n_parameters


def show(name, found):
    """Measured values, for those who run the tests with -s."""
    print(
        f"\n{name}: "
        f"{found.text}\n{found.to_dataframe().to_string(float_format=lambda v: f'{v:.4g}')}"
    )
    print(f"NEES/p = {found.nees_ratio:.4f} (calibration {calibration_ratio(found):.4f})")


def test_coverage_and_squared_errors(fixed):
    show("fixed truth", fixed)
    assert fixed.ok, fixed.text
    coverage = dict(zip(fixed.quantities, fixed.coverage, strict=True))
    assert all(0.90 <= coverage[q] <= 0.995 for q in COVERED), coverage
    assert 0.87 <= fixed.nees_ratio <= 1.13
    assert 0.87 <= calibration_ratio(fixed) <= 1.13
    assert np.abs(fixed.compression_error).max() < 0.1


def test_ranks_of_a_fixed_truth(fixed):
    assert fixed.n_replicates == 120
    assert (fixed.rank_p_value > 1e-3).all(), fixed.rank_p_value


def test_ranks_of_truths_from_the_prior():
    found = validate(sc.paper.paper_camera(), n_replicates=100, truth="prior", seed=2, workers=0)
    show("truth from the prior", found)
    assert found.ok, found.text
    assert (found.rank_p_value > 1e-3).all(), found.rank_p_value
    assert 0.87 <= found.nees_ratio <= 1.13


def few_frames(**options):
    truth = sc.paper.paper_camera()
    start = truth.replace(x0_px=511.5, y0_px=511.5, coefficients=(0.0, 0.0))
    return Replication(truth, start, sc.Priors.default(start), "fixed", Campaign(12), 1, **options)


def excess(found):
    """Mean ratio of squared errors by the draws to those by the calibration, which leaves the
    sampler's part.
    """
    return np.exp(np.mean(np.log(found.nees / found.nees_calibration)))


def test_biased_moves_are_found():
    """emcee's DESnookerMove, as half of the moves, makes squared errors 1.23 times too large."""
    sizes = {"n_walkers": 64, "n_steps": 100, "n_burn": 60, "thin": 10}
    stars = sc.load_catalogue(max_mag=6.0)
    half, without = (
        validate_study(few_frames(moves=moves, **sizes), stars, 30)
        for moves in (controls.snooker_half, controls.evolution)
    )
    print(f"excess {excess(half):.3f}, without {excess(without):.3f}")
    assert excess(half) > 1.12
    # The moves without it are right, but for the 2 % of few draws.
    assert excess(without) < 1.06
