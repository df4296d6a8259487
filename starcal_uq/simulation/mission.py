"""Frames that a mission will see: noise-free star positions at random attitudes, or along an
attitude profile.

A posterior from ground or commissioning data says what the camera is; the attitude error that
follows depends on which stars stand where. These frames bring the star geometry of the mission's
catalogue and magnitude limit.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.attitude.rotations import quaternion_to_rotation
from starcal_uq.core.errors import CatalogueError, ObservationError
from starcal_uq.core.formatting import count, plural, significant
from starcal_uq.core.settings import Seed, bounded
from starcal_uq.core.types import FloatArray
from starcal_uq.observations.table import Observations
from starcal_uq.simulation.frames import Tracker, simulate

if TYPE_CHECKING:
    from starcal_uq.attitude.profile import AttitudeProfile
    from starcal_uq.camera.camera import Camera
    from starcal_uq.sky.catalogue import StarCatalogue

_FRAMES_AT_ONCE = 256
_MAG_GROUPS = 12
# Photon noise alone grows by 10^0.2 per magnitude; fainter than all that was measured, noise grows
# at least so much.
_PHOTON_DEX_PER_MAG = 0.2


@bounded
def mission_frames(
    stars: StarCatalogue,
    camera: Camera,
    *,
    n_frames: int = 1000,
    min_stars: int = 5,
    max_stars: int | None = None,
    seed: Seed = 0,
    noise_like: Observations | None = None,
) -> Observations:
    """Noise-free frames at uniformly random attitudes, for `starcal_uq.propagate`.

    Parameters
    ----------
    stars : StarCatalogue
        The mission's catalogue; its magnitude limit is the sensor's in flight.
    camera : Camera
        The calibrated camera: it decides which stars fall on the detector, and where.
    n_frames : int
        Number of frames.
    min_stars : int
        Attitudes with fewer stars in the field are drawn again (at least 3): what the mission calls
        a valid frame.
    max_stars : int, optional
        Stars that the tracker uses of a frame, the brightest ones; all on the detector by default.
    seed : int or Generator
        Repeats bit for bit.
    noise_like : Observations, optional
        A table with stated noise, whose ``sigma_px`` is carried over by magnitude: the median of
        each of a dozen groups of stars, interpolated; fainter than them all it grows as photon
        noise does. Where magnitudes are missing, all stars get the median. Needed where the
        posterior scales stated noise.

    Raises
    ------
    CatalogueError
        When the field is too narrow for the catalogue to show `min_stars`.
    ObservationError
        When `noise_like` states no noise.
    """
    frames = simulate(
        *(stars, camera),
        n_frames=n_frames,
        min_stars=min_stars,
        max_stars=max_stars,
        sigma_px=0.0,
        seed=seed,
    )
    faintest = float(np.nanmax(frames.mag)) if frames.mag is not None else float("nan")
    words = (
        f"random attitudes, {significant(np.diff(frames.frame_starts).mean(), 3)} stars each on "
        "average"
    )
    words += f", faintest star of magnitude {faintest:.1f}" if np.isfinite(faintest) else ""
    frames = frames.with_meta(
        source="mission frames at random attitudes", frames=words, min_stars=min_stars
    )
    return frames if noise_like is None else _with_noise(frames, noise_like)


@bounded
def profile_frames(
    stars: StarCatalogue,
    camera: Camera,
    profile: AttitudeProfile,
    rate_hz: float | None = None,
    *,
    min_stars: int = 3,
    max_stars: int | None = None,
    noise_like: Observations | None = None,
) -> Observations:
    """Noise-free frames along an attitude profile, for `propagate` and
    `starcal_uq.propagation.error_spectrum`.

    Parameters
    ----------
    stars, camera, max_stars, noise_like
        Catalogue, camera, stars of a frame and observations as `mission_frames` takes them.
    profile : AttitudeProfile
        Attitudes of the camera over time.
    rate_hz : float, optional
        Frames per second; the profile is interpolated. By default frames are taken at the profile's
        own instants.
    min_stars : int
        Instants with fewer stars in the field (at least 2) are left out and counted in
        ``meta["skipped_frames"]``.

    Returns
    -------
    Observations
        Frame numbers count the instants from 0; ``origin.frame_times_s`` holds the times of the
        frames that are there.

    Raises
    ------
    CatalogueError
        When no instant shows `min_stars` stars.
    """
    if min_stars < 2:
        raise ValueError(f"min_stars={min_stars}: an attitude needs at least 2 stars.")
    path = profile if rate_hz is None else profile.at_rate(rate_hz)
    sky = Tracker(camera, 0.0, min_stars, max_stars).sky(stars)
    rotations = quaternion_to_rotation(path.quaternions)
    views = [
        view
        for first in range(0, len(rotations), _FRAMES_AT_ONCE)
        for view in sky.views(rotations[first : first + _FRAMES_AT_ONCE])
    ]
    counts = np.array([len(seen) for seen, _ in views])
    frame = np.repeat(np.arange(len(views)), counts)
    seen, xy = map(np.concatenate, zip(*views, strict=True))
    kept = counts >= min_stars
    if not kept.any():
        raise CatalogueError(
            f"none of the {count(len(rotations))} attitudes of the profile shows {min_stars} "
            "stars of the catalogue "
            f"(at most {int(counts.max())}): raise max_mag, or lower min_stars."
        )
    rows = kept[frame]
    seen = seen[rows]
    skipped = int(np.sum(~kept))
    words = f"attitude profile {profile.name}, {significant(path.duration_s, 3)} s".replace(
        "  ", " "
    )
    if skipped:
        words += f"; {plural(skipped, 'instant')} with fewer than {min_stars} stars left out"
    frames = Observations(
        frame=frame[rows],
        x_px=xy[rows, 0],
        y_px=xy[rows, 1],
        **stars.named(seen),
        meta={
            "source": f"attitude profile {profile.name}".strip(),
            "directions": "apparent",
            "frames": words,
            "frame_times_s": path.time_s[kept].tolist(),
            "skipped_frames": skipped,
            "min_stars": min_stars,
        },
    )
    return frames if noise_like is None else _with_noise(frames, noise_like)


def _with_noise(frames: Observations, like: Observations) -> Observations:
    """The frames with stated noise like that of other observations."""
    if like.stated_px is not None and like.unweighted.sigma_px is None:
        # A fitted noise model gives these frames their noise when an attitude error is propagated
        # to them.
        return frames
    like = like.unweighted
    if like.sigma_px is None:
        raise ObservationError(
            "noise_like has no column sigma_px, so that there is no stated noise to carry over: "
            "leave it out.",
            column="sigma_px",
        )
    rule = "median stated noise by magnitude"
    if like.mag is None or frames.mag is None or not np.any(np.isfinite(like.mag)):
        sigma = np.full(frames.n_stars, float(np.median(like.sigma_px)))
        rule = "median stated noise for every star"
    else:
        sigma = noise_by_magnitude(like, frames.mag)
    return replace(frames, sigma_px=sigma).with_meta(noise=rule)


def noise_by_magnitude(like: Observations, mag: FloatArray) -> FloatArray:
    """Stated noise (N,), px, for magnitudes (N,) from the medians of another table; NaN gets the
    overall median.
    """
    assert like.sigma_px is not None and like.mag is not None
    known = np.isfinite(like.mag)
    order = np.argsort(like.mag[known], kind="stable")
    groups = np.array_split(order, min(_MAG_GROUPS, max(1, len(order) // 20)))
    middle = np.array([np.median(like.mag[known][group]) for group in groups])
    level = np.array([np.median(np.log10(like.sigma_px[known][group])) for group in groups])
    exponent = np.interp(mag, middle, level)
    exponent += _PHOTON_DEX_PER_MAG * np.maximum(np.nan_to_num(mag, nan=-99.0) - middle[-1], 0.0)
    return np.where(np.isfinite(mag), 10.0**exponent, float(np.median(like.sigma_px)))
