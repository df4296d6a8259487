"""Two exposures of one field are no repeated measurement."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import starcal_uq as sc
from starcal_uq.calibration.noise_floor import settle_noise
from starcal_uq.core.errors import RepeatedFramesError
from tests.helpers.outside import sky_angles

SIZE, FOCAL_PX, STARS = 1024, 4000.0, 25


def folder(seed, factor, *, copied=False):
    """Eight frames of one camera, of which frame 7 sees the field of frame 6, and two of a longer
    lens.

    Frame 7 is another exposure, or with `copied` the same one, measured again to within a tenth of
    the noise.
    """
    rng = np.random.default_rng(seed)
    sigma = np.exp(rng.uniform(np.log(0.02), np.log(0.1), (10, STARS, 1)))
    turns = Rotation.random(10, random_state=rng).as_matrix()
    places = rng.uniform(20.0, SIZE - 20.0, (10, STARS, 2))
    turns[7], places[7], sigma[7] = turns[6], places[6], sigma[6]
    measured = places + sigma * rng.standard_normal(places.shape)
    if copied:
        measured[7] = measured[6] + 0.1 * sigma[6] * rng.standard_normal((STARS, 2))
    focal = FOCAL_PX * np.where(np.arange(10) > 7, factor, 1.0)[:, None, None]
    ahead = np.concatenate([(places - 0.5 * (SIZE - 1)) / focal, np.ones((10, STARS, 1))], axis=2)
    sky = (ahead / np.linalg.norm(ahead, axis=2, keepdims=True) @ turns).reshape(-1, 3)
    (x, y), (ra, dec) = measured.reshape(-1, 2).T, sky_angles(sky)
    return sc.Observations(
        frame=np.repeat(np.arange(10), STARS),
        x_px=x,
        y_px=y,
        ra_deg=ra,
        dec_deg=dec,
        sigma_px=sigma.ravel(),
        meta={"directions": "apparent"},
    )


def nominal():
    centre = 0.5 * (SIZE - 1)
    return sc.Camera(SIZE, SIZE, 5.0, 5e-3 * FOCAL_PX, centre, centre)


@pytest.mark.parametrize("seed", range(4))
def test_a_longer_lens_in_the_folder_makes_no_exposure_a_copy(seed):
    obs = folder(seed, 1.01)
    cal = sc.calibrate(obs, nominal())
    # The campaign is far from what its centroids state.
    assert cal.sigma > 10.0
    # With the floor that the residuals ask for it is the same.
    settled = settle_noise(obs, sc.calibrate(obs, nominal(), duplicates="keep"))
    assert settled.meta["noise_floor_px"] > 0.5
    assert sc.calibrate(settled, nominal()).n_frames == 10


@pytest.mark.parametrize("factor", [1.0, 1.01])
def test_a_copy_is_found_in_any_folder(factor):
    with pytest.raises(RepeatedFramesError):
        sc.calibrate(folder(0, factor, copied=True), nominal())


def test_exposures_of_one_camera_are_kept():
    assert sc.calibrate(folder(0, 1.0), nominal()).n_frames == 10
