"""What alignment removes: against a star sensor of a second make that aligns on some frames and
flies on others.
"""

from copy import copy
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import DistortionError, ObservationError, SettingError
from starcal_uq.core.provenance import Provenance
from starcal_uq.observations.table import Observations
from starcal_uq.propagation.alignment import alignment_frames, random_sky
from starcal_uq.propagation.attitude_error import AttitudeError
from starcal_uq.propagation.propagate import propagate

ARCSEC = 648_000.0 / np.pi
THETA = np.array([500.0, 530.0, 5800.0, 2.0e-10, -3.5e-15])
# Standard deviations and one strong correlation: the principal point is loose, the focal length
# coarse.
SIGMA = np.array([0.3, 0.3, 0.6, 1.0e-10, 2.0e-16])
NOISE_PX = 0.05


class Draws:
    """A posterior of the second make: Gaussian draws of the camera and its noise."""

    def __init__(self, n: int = 4000) -> None:
        rng = np.random.default_rng(7)
        self.theta_draws = THETA + SIGMA * rng.standard_normal((n, 5))
        self.sigma_draws = np.full(n, NOISE_PX)
        self.draws = np.column_stack((self.theta_draws, self.sigma_draws))
        self.mean, self.covariance = (
            self.theta_draws.mean(axis=0),
            np.cov(self.theta_draws, rowvar=False),
        )
        self.sigma_name = "sigma"
        self.provenance = Provenance()
        self.star_error_px = 0.0
        self.effects = None
        self.camera = sc.Camera(
            width_px=1024, height_px=1024, pixel_um=12.0, focal_mm=69.6, x0_px=500.0, y0_px=530.0,
            distortion="brown", coefficients=(2.0e-10, -3.5e-15),
        )  # fmt: skip

    def thin(self, n: int, seed: int) -> np.ndarray:
        return self.draws[np.random.default_rng(seed).permutation(len(self.draws))[:n]]


POST = Draws()


def table(pixels: list[np.ndarray]) -> Observations:
    """Frames of such pixels, wherever the camera looks."""
    xy = np.concatenate(pixels)
    b = directions(POST.mean, xy)
    return Observations(
        frame=np.repeat(np.arange(len(pixels)), [len(p) for p in pixels]),
        x_px=xy[:, 0],
        y_px=xy[:, 1],
        ra_deg=np.degrees(np.arctan2(b[:, 1], b[:, 0])) % 360.0,
        dec_deg=np.degrees(np.arcsin(b[:, 2])),
    )


def directions(theta: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Brown's model turned round by fixed-point iteration."""
    x0, y0, f, k1, k2 = theta
    seen = xy - [x0, y0]
    ideal = seen
    for _ in range(30):
        r2 = np.sum(ideal**2, axis=1, keepdims=True)
        ideal = seen / (1.0 + k1 * r2 + k2 * r2**2)
    b = np.column_stack((ideal, np.full(len(xy), f)))
    return b / np.linalg.norm(b, axis=1, keepdims=True)


def turn(theta: np.ndarray, xy: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Left rotation vector (3,) arcsec of the best attitude, by singular values, from that of the
    true directions.
    """
    u, _, vt = np.linalg.svd(directions(theta, xy).T @ true)
    r = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return 0.5 * ARCSEC * np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])


def skies(rng: np.random.Generator, n_frames: int, stars: int = 12) -> list[np.ndarray]:
    return [rng.uniform(0.0, 1023.0, (stars, 2)) for _ in range(n_frames)]


def slew(rng: np.random.Generator, n_frames: int) -> list[np.ndarray]:
    """Stars that move along x, 100 px a frame."""
    stars = np.column_stack(
        (rng.uniform(0.0, 1023.0 + 100.0 * n_frames, 24), rng.uniform(0.0, 1023.0, 24))
    )
    frames = []
    for k in range(n_frames):
        xy = stars - [100.0 * k, 0.0]
        frames.append(xy[(xy[:, 0] > 0.0) & (xy[:, 0] < 1023.0)])
    return frames


def flown(
    align: list[np.ndarray],
    mission: list[np.ndarray],
    thetas: np.ndarray,
    n_noise: int,
    *,
    old: bool = False,
) -> dict[str, np.ndarray]:
    """Root mean squares (3,) arcsec: what alignment removes, what it leaves of the camera, and its
    own noise.

    Attitudes of the alignment are weighted by the inverse of their covariance from noise.
    """
    rng = np.random.default_rng(3)
    true = [[directions(POST.mean, p) for p in frames] for frames in (align, mission)]
    weights = np.array([np.sum(np.eye(3) - b[:, :, None] * b[:, None, :], axis=0) for b in true[0]])
    weights = np.linalg.inv(weights.sum(axis=0)) @ weights

    def aligned(turns: np.ndarray) -> np.ndarray:
        return np.einsum("nij,nj->i", weights, turns)

    common, rest = [], []
    for theta in thetas:
        phi = np.array([turn(theta, p, b) for p, b in zip(mission, true[1], strict=True)])
        found = aligned(np.array([turn(theta, p, b) for p, b in zip(align, true[0], strict=True)]))
        common.append(phi.mean(axis=0) if old else found)
        rest.append(np.sqrt(np.mean((phi - common[-1]) ** 2, axis=0)))
    noise = [
        aligned(
            np.array(
                [
                    turn(POST.mean, p + NOISE_PX * rng.standard_normal(p.shape), b)
                    for p, b in zip(align, true[0], strict=True)
                ]
            )
        )
        for _ in range(n_noise)
    ]
    values = {"common": common, "rest": rest, "noise": noise or [np.zeros(3)]}
    return {name: np.sqrt(np.mean(np.square(found), axis=0)) for name, found in values.items()}


def sigma_points() -> np.ndarray:
    """Ten cameras that have the mean and the covariance of the posterior."""
    steps = np.sqrt(5.0) * np.linalg.cholesky(POST.covariance).T
    return POST.mean + np.concatenate((steps, -steps))


@lru_cache
def scenes() -> dict[str, tuple[list[np.ndarray], list[np.ndarray]]]:
    """Frames of alignment, and of the mission."""
    rng = np.random.default_rng(5)
    align = skies(rng, 12)
    return {
        "stare": (align, [skies(rng, 1)[0]] * 6),
        "slew": (align, slew(rng, 10)),
        "random": (align, skies(rng, 10)),
    }


@pytest.mark.parametrize("mission", ["stare", "slew", "random"])
def test_what_alignment_leaves_is_that_of_sensors_that_align_and_fly(mission: str) -> None:
    align, flight = scenes()[mission]
    found: AttitudeError = propagate(POST, table(flight), n_draws=20, alignment=table(align))  # type: ignore[arg-type]
    seen = flown(align, flight, sigma_points(), 60)
    np.testing.assert_allclose(found.common_arcsec, seen["common"], rtol=0.01)
    np.testing.assert_allclose(found.rest_arcsec, seen["rest"], rtol=0.01)
    # Standard deviations of 60 alignments are good to 9 %.
    np.testing.assert_allclose(found.alignment_arcsec, seen["noise"], rtol=0.3)
    assert found.stays.all() == (mission == "stare")
    # Control: the split of before takes the mean over the mission's own frames for common.
    old = flown(flight, flight, sigma_points(), 0, old=True)["rest"]
    assert (np.abs(old / found.rest_arcsec - 1.0) > 0.02).any()
    if mission == "stare":
        assert old.max() < 1e-9 < 1e-3 < found.rest_arcsec.min()


def test_a_random_sky_is_the_default_and_is_said() -> None:
    align, stare = scenes()["stare"]
    frames = table(stare)
    found = propagate(POST, frames, n_draws=20)  # type: ignore[arg-type]
    assert found.alignment == "100 frames of random sky"
    assert "Alignment is on 100 frames of random sky, whose noise leaves" in found.text
    assert "the rest in pitch, yaw and roll is a bias that stays" in found.text
    other = propagate(POST, frames, n_draws=20, alignment="random", alignment_frames=400)  # type: ignore[arg-type]
    np.testing.assert_allclose(found.alignment_arcsec / other.alignment_arcsec, 2.0, rtol=0.1)
    # Noise of n frames falls with their root.
    single = propagate(POST, table(align), n_draws=2, alignment="observed").nea_arcsec  # type: ignore[arg-type]
    np.testing.assert_allclose(10.0 * found.alignment_arcsec, single, rtol=0.2)
    # Control: an alignment on the stare itself takes the error of its field for common.
    own = propagate(POST, frames, n_draws=20, alignment="observed")  # type: ignore[arg-type]
    assert own.rest_arcsec.max() < 1e-6 < 1e-3 < found.rest_arcsec.min()
    np.testing.assert_allclose(found.calibration_total_arcsec, own.common_arcsec, rtol=1e-3)


def test_a_random_sky_is_uniform_on_the_sphere_and_off_folded_places() -> None:
    wide = copy(POST)
    wide.mean = np.array([511.5, 511.5, 600.0, 0.0, 0.0])
    wide.draws = np.tile(np.append(wide.mean, NOISE_PX), (20, 1))
    like = replace(
        table([np.full((n, 2), 500.0) for n in (5, 11)]),
        sigma_px=np.arange(1.0, 17.0),
        mag=np.arange(16.0),
    )
    sky = random_sky(wide, like, 600, seed=1)  # type: ignore[arg-type]
    b = np.column_stack((sky.xy - 511.5, np.full(len(sky), 600.0)))
    np.testing.assert_allclose(
        sky.directions_icrs, b / np.linalg.norm(b, axis=1)[:, None], rtol=0, atol=1e-12
    )
    # A pixel of a pinhole camera covers a solid angle in proportion to cos^3.
    x, y = np.meshgrid(*[np.arange(1023.0) - 511.0] * 2)
    r2 = x**2 + y**2
    weight = (1.0 + r2 / 600.0**2) ** -1.5
    seen = np.sum((sky.xy - 511.5) ** 2, axis=1)
    assert abs(seen.mean() - np.average(r2, weights=weight)) < 4.0 * seen.std() / np.sqrt(len(sky))
    assert np.average(r2) - seen.mean() > 20.0 * seen.std() / np.sqrt(
        len(sky)
    )  # the control: uniform in pixels
    assert np.all(sky.xy.min(axis=0) < 1.0) and np.all(sky.xy.min(axis=0) >= 0.0)
    assert np.all(sky.xy.max(axis=0) > 1022.0) and np.all(sky.xy.max(axis=0) <= 1023.0)
    counts = np.diff(sky.frame_starts)
    assert len(counts) == 600 and set(counts) == {5, 11} and abs(np.mean(counts == 5) - 0.5) < 0.08
    # Noise and magnitude are those of one star.
    assert set(sky.mag) == set(like.mag)
    np.testing.assert_array_equal(sky.sigma_px, sky.mag + 1.0)
    # A draw that folds beyond 267 px keeps stars away from there; one that is defined nowhere
    # leaves no place.
    wide.draws[7, 3] = -1.0 / (3.0 * 400.0**2)
    within = random_sky(wide, like, 100, seed=1)  # type: ignore[arg-type]
    assert 250.0 < np.sqrt(np.max(np.sum((within.xy - 511.5) ** 2, axis=1))) < 267.0
    wide.draws[7, 3] = np.nan
    with pytest.raises(DistortionError):
        random_sky(wide, like, 100, seed=1)  # type: ignore[arg-type]


def test_an_alignment_on_a_table_says_what_that_is() -> None:
    rng = np.random.default_rng(4)
    frames, other = table(skies(rng, 3)), table(skies(rng, 1))
    named = replace(other, meta={**other.meta, "frames": "a night in May"})
    for given, told in (
        (frames, "3 frames (the same)"),
        (other, "1 frame (given)"),
        (named, "1 frame (a night in May)"),
    ):
        found, words = alignment_frames(POST, frames, given, None, 0)  # type: ignore[arg-type]
        assert found is given and words == told
    assert alignment_frames(POST, frames, "observed", None, 0)[0] is frames  # type: ignore[arg-type]


def test_an_alignment_that_is_none_is_refused() -> None:
    frames = table(scenes()["random"][1])
    for options, words in (
        ({"alignment": "sky"}, "give 'random', 'observed' or a table"),
        ({"alignment": "observed", "alignment_frames": 5}, "belongs to a random sky"),
    ):
        with pytest.raises(ObservationError, match=words):
            propagate(POST, frames, **options)  # type: ignore[arg-type]
    with pytest.raises(SettingError, match="alignment_frames is 0: give a whole number from 1"):
        propagate(POST, frames, alignment_frames=0)  # type: ignore[arg-type]
