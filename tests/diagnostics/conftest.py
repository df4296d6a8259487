"""Sixty frames of the paper's camera, and their calibration."""

import pytest

import starcal_uq as sc
from tests.helpers.scenes import observations


@pytest.fixture(scope="module")
def obs():
    return observations(n_frames=60)


@pytest.fixture(scope="module")
def cal(obs):
    return sc.calibrate(obs, sc.paper.paper_start())
