"""A second identification with the calibrated camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.pipeline.displacement import mirrored
from starcal_uq.pipeline.refine import identify_and_calibrate
from starcal_uq.sky.apparent import (
    catalogue_directions,
    make_apparent,
)
from tests.helpers.ground_scenes import CAMERA, NOMINAL, SITE, as_centroids, ground_frames


@pytest.fixture(scope="module")
def stars():
    return sc.load_catalogue(max_mag=6.5, epoch=2026.9)


def _bootstrap(obs, stars, site, *, moved=True, flip=False):
    table = as_centroids(obs)
    table = mirrored(table, CAMERA.width_px) if flip else table
    return identify_and_calibrate(
        table,
        NOMINAL,
        stars,
        prepare=lambda found: make_apparent(found, site=site),
        to_catalogue=(lambda seen, times: catalogue_directions(seen, times, site=site))
        if moved
        else None,
    )


def _named(obs):
    return set(zip(obs.frame.tolist(), obs.star_id.tolist(), strict=True))


def test_second_identification_looks_where_stars_are_seen(stars):
    site = replace(SITE, pressure_hpa=1013.25)
    obs = ground_frames(stars, np.random.default_rng(5).uniform(18.0, 31.0, 30), seed=3, site=site)
    found = _bootstrap(obs, stars, site)
    assert found.identification.n_identified == 30
    assert not _named(found.observations) - _named(obs)
    # Hardly a star that was found is given up, and the places are those that were measured.
    given_up = len(_named(found.rounds[0][1]) - _named(found.observations))
    # The others have a neighbour too near to tell which is which.
    assert found.observations.n_stars > 0.98 * obs.n_stars
    measured = dict(
        zip(
            zip(obs.frame, obs.star_id, strict=True),
            zip(obs.x_px, obs.y_px, strict=True),
            strict=True,
        )
    )
    rows = zip(found.observations.frame, found.observations.star_id, strict=True)
    places = np.column_stack([found.observations.x_px, found.observations.y_px])
    assert np.array_equal([measured[row] for row in rows], places)
    assert np.all(np.abs((found.calibration.theta - CAMERA.theta) / found.calibration.sigmas) < 4.0)
    # The control: compared with the catalogue as it stands, the calibrated camera's tolerance loses
    # stars.
    control = _bootstrap(obs, stars, site, moved=False)
    lost = len(_named(control.rounds[0][1]) - _named(control.observations))
    assert lost > given_up
    assert control.observations.n_stars < found.observations.n_stars - 8


def test_mirrored_images_keep_their_camera(stars):
    obs = ground_frames(stars, np.random.default_rng(5).uniform(40.0, 80.0, 12), seed=4)
    found = _bootstrap(obs, stars, SITE, flip=True)
    assert found.identification.parity == "mirrored"
    assert [r[0].n_identified for r in found.rounds] == [12, 12]
    assert not _named(found.observations) - _named(obs)
    # x is counted from the right edge of the mirrored image: the calibration is that of the camera
    # itself.
    assert np.all(np.abs((found.calibration.theta - CAMERA.theta) / found.calibration.sigmas) < 4.0)
