"""The frames on which alignment is calibrated in flight, and what an alignment on them removes.

An alignment is the weighted mean of the attitude errors of its frames, with the inverse of their
covariance from noise as the weights, W_a = C_a^-1. It finds sum (W)^-1 sum W_a phi_a: of a camera
error the *common rotation*, which is gone afterwards, and of the noise an error of covariance (sum
W_a)^-1 that stays until the next alignment.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.projection import cannot_fold, unproject_theta
from starcal_uq.core.errors import DistortionError, ObservationError
from starcal_uq.core.formatting import plural
from starcal_uq.observations.table import Observations

if TYPE_CHECKING:
    from starcal_uq.inference.posterior import Posterior

N_ALIGNMENT_FRAMES = 100
RANDOM, OBSERVED = "random", "observed"
# Places on the detector of which those that stars fall on are drawn.
_PLACES = 20_000
_DRAWS = 60
_STEP_PX = 0.5


def alignment_frames(
    post: Posterior,
    obs: Observations,
    alignment: Observations | str | None,
    n_frames: int | None,
    seed: int,
) -> tuple[Observations, str]:
    """The frames of an alignment, and what they are in words.

    ``random`` (None) is a random sky of `n_frames` (100) frames with the numbers of stars of `obs`,
    ``observed`` is `obs`. ObservationError for another word, fewer than one frame, or a number of
    frames beside frames that are given.
    """
    if isinstance(alignment, Observations) or alignment == OBSERVED:
        if n_frames is not None:
            raise ObservationError(
                "a number of alignment frames belongs to a random sky: leave it out."
            )
        frames = obs if isinstance(alignment, str) else alignment
        told = str(frames.origin.frames or "")
        return (
            frames,
            (
                f"{plural(frames.n_frames, 'frame')} "
                f"({told or ('given' if frames is not obs else 'the same')})"
            ),
        )
    if alignment not in (None, RANDOM):
        raise ObservationError(
            f"alignment is {alignment!r}; give 'random', 'observed' or a table of observations."
        )
    n_frames = N_ALIGNMENT_FRAMES if n_frames is None else n_frames
    return random_sky(post, obs, n_frames, seed), f"{plural(n_frames, 'frame')} of random sky"


def random_sky(post: Posterior, like: Observations, n_frames: int, seed: int) -> Observations:
    """Frames with as many stars as some others have, uniform over the sky as the camera sees it,
    without noise.

    Places at which a draw of the camera folds hold no stars. Stated noise and magnitudes are taken
    from the others.
    """
    rng = np.random.default_rng((seed, 17))
    camera, model = post.camera, post.camera.distortion
    xy = rng.uniform([0.0, 0.0], [camera.width_px - 1.0, camera.height_px - 1.0], (_PLACES, 2))
    shift = [_STEP_PX * step for step in np.eye(2)]
    x, y = (
        unproject_theta(model, post.mean, xy + s) - unproject_theta(model, post.mean, xy - s)
        for s in shift
    )
    angle = np.linalg.norm(np.cross(x, y), axis=1)
    usable = np.isfinite(angle) & (angle > 0.0)
    draws = post.thin(_DRAWS, seed)[:, :-1]
    if not cannot_fold(model, draws, xy):
        for theta in draws:
            usable &= np.isfinite(unproject_theta(model, theta, xy)).all(axis=1)
    if not usable.any():
        raise DistortionError(
            f"the distortion {model!r} folds over everywhere: use more frames or a tighter prior."
        )
    counts = rng.choice(np.diff(like.frame_starts), n_frames)
    chosen = rng.choice(np.flatnonzero(usable), counts.sum(), p=angle[usable] / angle[usable].sum())
    b = unproject_theta(model, post.mean, xy[chosen])
    stated, star = like.unweighted.sigma_px, rng.integers(len(like), size=counts.sum())
    return Observations(
        frame=np.repeat(np.arange(n_frames), counts),
        x_px=xy[chosen, 0],
        y_px=xy[chosen, 1],
        ra_deg=np.degrees(np.arctan2(b[:, 1], b[:, 0])) % 360.0,
        dec_deg=np.degrees(np.arcsin(b[:, 2])),
        sigma_px=None if stated is None else stated[star],
        mag=None if like.mag is None else like.mag[star],
        meta={"frames": f"{plural(n_frames, 'frame')} of random sky"},
    )
