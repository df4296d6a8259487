"""Do the residuals ask for another time, or for an epoch other than that of the directions?

A wrong time moves the stars of a table in ways that are known. Proper motion: by years. Annual
aberration: by the Earth's velocity of another day, or by all of it where it is missing or was
applied twice. Refraction at a site: towards the zenith of another hour. Each is tried; what
attitudes and parameters cannot take up of it is fitted to the residuals with a factor that has to
be one, and whose scatter from star to star and from frame to frame, and not only the noise, says
how well it is known.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from starcal_uq.attitude.earth import LOWEST
from starcal_uq.core.constants import ARCSEC, LIGHT_SPEED_KM_S
from starcal_uq.core.settings import Seed, bounded, seed_of
from starcal_uq.core.times import FIRST_YEAR, LAST_YEAR
from starcal_uq.core.types import FloatArray, StrArray
from starcal_uq.diagnostics.beside import images_beside
from starcal_uq.estimation.weights import weighed
from starcal_uq.estimation.zenith import Images
from starcal_uq.likelihood.zenith import raised
from starcal_uq.sky.apparent import earth_velocity_km_s
from starcal_uq.sky.catalogue import load_catalogue
from starcal_uq.sky.refraction import refraction_constants, site_among_stars
from starcal_uq.sky.site import Site

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

Cause: TypeAlias = Literal["epoch", "no aberration", "aberration twice", "date", "hour"]

# A factor is significant from so many of its errors on, and one within so many.
_SIGNIFICANT, _ONE = 5.0, 3.5
_FAR = 1e-4
_LARGEST_SHARE, _ROUNDS = 0.05, 30
_MAX_MAG, _SAME_STAR_RAD = 8.0, 60.0 / ARCSEC
_LONGEST_YEARS = 250.0
# Other dates and hours, in days and hours.
_DATES = np.arange(-180.0, 181.0, 4.0)
_HOURS = np.arange(-14.0, 14.1, 0.25)


@dataclass(frozen=True)
class TimeTest:
    """Effect of a wrong time on the directions.

    Attributes
    ----------
    cause : {"epoch", "no aberration", "aberration twice", "date", "hour"}
        Proper motion to another epoch, annual aberration that is missing, applied twice or of
        another date, or refraction of another hour.
    later, later_std : float
        How much later the stars were seen than the directions are for, and its standard error:
        years of an epoch, days of a date, hours of an hour; NaN for the others.
    factor, factor_std : float
        The effect of that, fitted, in units of itself (of an epoch: of one year), and its standard
        error.
    moves : str
        The parameter that it moves most.
    moves_sigma : float
        By how many of its standard deviations.
    """

    cause: Cause
    later: float
    later_std: float
    factor: float
    factor_std: float
    moves: str
    moves_sigma: float


@dataclass(frozen=True)
class UnseenAberration:
    """Shift of f by annual aberration that is missing or applied twice and leaves no trace in the
    residuals.

    Frames near one direction and date stretch by it alike, which is what a focal length does.

    Attributes
    ----------
    f_px, f_sigma : float
        How far f would move, px and in its standard deviations; of frames without times at the
        worst date.
    visible : float
        How many of its standard errors the residuals would be off by.
    dated : bool
        Whether the frames have times, which the velocity of the Earth is of.
    """

    f_px: float
    f_sigma: float
    visible: float
    dated: bool


@dataclass(frozen=True)
class _Moved:
    """A cause with the moves of the stars for each offset: shifts (g, 2, N) of images, offsets
    (g,).
    """

    cause: Cause
    shifts: FloatArray
    later: FloatArray


def remainder(obs: Observations, cal: Calibration, seed: int) -> Images:
    """What `time_test` and `unseen_aberration` look at."""
    return images_beside(weighed(obs, cal), cal, seed)


@bounded
def time_test(
    obs: Observations, cal: Calibration, *, seed: Seed = 0, rest: Images | None = None
) -> TimeTest | None:
    """Look for a wrong time in the residuals of a calibration.

    Parameters
    ----------
    obs, cal
        The data and the estimate made from them.
    seed : int or Generator
        Seed of the choice of frames, where there are many.
    rest : Images, optional
        What `remainder` gives for these, where it is known already.

    Returns
    -------
    TimeTest or None
        The slip that explains most; None where none is seen.
    """
    seed = seed_of(seed)
    rest = remainder(obs, cal, seed) if rest is None else rest
    best, most = None, 0.0
    for moved in _causes(rest):
        columns, absorbed = rest.left(moved.shifts)
        size = np.einsum("gi,gi->g", columns, columns)
        along = columns @ rest.e
        with np.errstate(all="ignore"):
            gain = np.nan_to_num(along**2 / size if moved.cause == "epoch" else 2.0 * along - size)
        i = int(np.argmax(gain))
        if gain[i] <= most:
            continue
        factor, std, sure = _fitted(columns[i], rest)
        later, later_std = float(moved.later[i]), np.nan
        if moved.cause == "epoch":
            later, later_std = factor, std
            good = abs(factor) < _LONGEST_YEARS
        else:
            good = abs(factor - 1.0) < _ONE * std
            if moved.cause in ("date", "hour"):
                a, b = max(i - 1, 0), min(i + 1, len(size) - 1)
                slope = (columns[b] - columns[a]) / (moved.later[b] - moved.later[a])
                step, later_std, _ = _fitted(slope, rest, rest.e - columns[i])
                later += step
        if good and sure > _SIGNIFICANT:
            shift = np.abs(absorbed[i] * (factor if moved.cause == "epoch" else 1.0)) / cal.sigmas
            worst = int(np.argmax(shift))
            name, size_sigma = cal.parameter_names[worst], float(shift[worst])
            best = TimeTest(moved.cause, later, later_std, factor, std, name, size_sigma)
            most = float(gain[i])
    return best


@bounded
def unseen_aberration(
    obs: Observations, cal: Calibration, *, seed: Seed = 0, rest: Images | None = None
) -> UnseenAberration | None:
    """Ask how far annual aberration would move f without being seen in the residuals of a
    calibration.

    Parameters
    ----------
    obs, cal, seed, rest
        As for `time_test`.

    Returns
    -------
    UnseenAberration or None
        None where `time_test` would see it, or it moves f by less than a standard deviation.
    """
    seed = seed_of(seed)
    rest = remainder(obs, cal, seed) if rest is None else rest
    # The first cause is that aberration is missing.
    columns, absorbed = rest.left(next(_causes(rest)).shifts)
    worst = int(np.argmax(np.abs(absorbed[:, 2])))
    f_px = float(abs(absorbed[worst, 2]))
    visible = 1.0 / _fitted(columns[worst], rest)[1]
    if f_px < float(cal.sigmas[2]) or visible > _SIGNIFICANT:
        return None
    return UnseenAberration(f_px, f_px / float(cal.sigmas[2]), visible, len(columns) == 1)


def _fitted(
    column: FloatArray, rest: Images, residuals: FloatArray | None = None
) -> tuple[float, float, float]:
    """The factor of a column, its error and how many errors it is.

    The error is the largest of that by noise and those by leaving out star by star, frame by frame;
    that of few groups counts as what Student's t of as many makes of it, far out. No star has more
    than a twentieth of the say, as one of large proper motion would have.
    """
    from scipy.special import stdtrit

    groups, n = rest.groups, 2 * rest.obs.n_stars
    # Coefficients of effects have no star.
    column, residuals = column[:n], (rest.e if residuals is None else residuals)[:n]
    own = (column**2).reshape(2, -1).sum(axis=0)
    by_star = np.bincount(groups[0], own)
    most = float(by_star.sum())
    if not most > 0.0:
        return 0.0, np.inf, 0.0
    for _ in range(_ROUNDS):
        most = float(np.minimum(by_star, most).sum()) * _LARGEST_SHARE
    weight = np.minimum(1.0, most / np.maximum(by_star, 1e-300))[groups[0]]
    weighted = column * np.tile(weight, 2)
    size = float(weighted @ column)
    factor = float(weighted @ residuals) / size
    errors, few = [rest.sigma * float(np.linalg.norm(weighted)) / size], [1.0]
    left = (weighted * (residuals - factor * column)).reshape(2, -1).sum(axis=0)
    for group in groups:
        share = np.minimum(np.bincount(group, weight * own) / size, 1.0 - 1e-12)
        errors.append(float(np.linalg.norm(np.bincount(group, left) / (1.0 - share))) / size)
        few.append(
            stdtrit(max(1.0 / float(share @ share) - 1.0, 0.1), _FAR) / stdtrit(np.inf, _FAR)
        )
    return factor, max(errors), abs(factor) / float(np.max(np.multiply(errors, few)))


def _causes(rest: Images) -> Iterator[_Moved]:
    obs = rest.obs
    frames, state = rest.likelihood.frames, rest.state
    towards = frames.spread(state.rotations.T)
    # One and the same for all stars of a frame, so that three columns hold the velocities of all
    # candidates.
    basis = state.shifts(towards)

    def aberrated(cause: Cause, velocities: FloatArray, later: FloatArray) -> _Moved:
        """By velocities (g, K, 3), km/s."""
        spread = np.repeat(velocities / LIGHT_SPEED_KM_S, frames.sizes, axis=1)
        return _Moved(cause, np.einsum("gni,ixn->gxn", spread, basis), later)

    apparent = obs.origin.apparent
    first = obs.frame_starts[:-1]
    stated = np.full(len(first), "") if obs.time_utc is None else obs.time_utc[first]
    timed = bool((stated != "").all())
    times = (stated if timed else np.full(len(first), "2026-01-01")).astype("datetime64[m]")
    velocities = _velocities(times, _DATES)
    nothing = np.full(len(_DATES), np.nan)
    # Without times any date may be that of all frames.
    now = velocities[np.flatnonzero(_DATES == 0.0)] if timed else velocities
    yield aberrated("no aberration", now, nothing[: len(now)])
    if apparent:
        yield aberrated("aberration twice", -now, nothing[: len(now)])
    if apparent and timed:
        yield aberrated("date", velocities - now, _DATES)
    if obs.origin.site is not None and apparent and timed:
        yield from _other_hours(rest, Site.from_dict(obs.origin.site), stated)
    moving = np.einsum("jin,jn->in", towards, _proper_motion(obs))
    yield _Moved("epoch", state.shifts(moving)[None], np.zeros(1))


def _proper_motion(obs: Observations) -> FloatArray:
    """Proper motion (3, N) of the stars that the embedded catalogue has, rad a year."""
    from scipy.spatial import cKDTree

    stars = load_catalogue(max_mag=_MAX_MAG)
    distance, place = cKDTree(stars.directions_icrs).query(obs.directions_icrs)
    near = stars.select(place)
    ahead = stars.select(place).at_epoch(stars.epoch + 1.0).directions_icrs - near.directions_icrs
    return np.where(distance < _SAME_STAR_RAD, ahead.T, 0.0)


def _velocities(times: np.ndarray, days: FloatArray) -> FloatArray:
    """Velocity of the Earth (g, K, 3), km/s, so many days after some times."""
    day, margin = np.timedelta64(1, "D"), np.timedelta64(200, "D")
    first, last = (np.datetime64(f"{year}-01-01") for year in (FIRST_YEAR, LAST_YEAR))
    known = np.arange(max(times.min() - margin, first), min(times.max() + margin, last), day)
    at = (times - known[0]) / day + days[:, None]
    table = earth_velocity_km_s(known)
    return np.stack([np.interp(at, np.arange(len(known)), axis) for axis in table.T], axis=-1)


def _other_hours(rest: Images, site: Site, times: StrArray) -> Iterator[_Moved]:
    """Refraction towards the zenith of other hours, in the place of that of the stated ones."""
    frames, state = rest.likelihood.frames, rest.state
    constants = refraction_constants(site)

    def seen(hours: float) -> FloatArray | None:
        zenith = site_among_stars(site.later(hours), times)[0]
        up = frames.spread(np.einsum("kij,kj->ik", state.rotations, zenith))
        if np.sum(up * state.b, axis=0).min() < LOWEST:
            return None
        return state.shifts(raised(state.b, up, constants))

    stated = seen(0.0)
    found = (
        [] if stated is None else [(h, s - stated) for h in _HOURS if (s := seen(h)) is not None]
    )
    if found:
        yield _Moved(
            "hour", np.stack([shift for _, shift in found]), np.array([hours for hours, _ in found])
        )
