"""What the model leaves over: residuals in cells of the detector, and whether their pattern is more
than noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.types import BoolArray, FloatArray, floats
from starcal_uq.estimation.residual_map import OUTLIER_SIGMA, ResidualMap
from starcal_uq.estimation.weights import by_noise_model, weighed
from starcal_uq.observations.splits import one_of_each

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

_MIN_STARS = 5


@dataclass(frozen=True)
class BinnedResiduals:
    """Mean residual vectors in square cells of the detector.

    Cells with fewer than five stars are left out; n is the number of the others.
    """

    centres: FloatArray  # (n, 2): cell centres, px
    means: FloatArray  # (n, 2): mean residuals, px
    counts: FloatArray  # (n,): stars in the cell
    # (n,): |mean|^2 over its variance per axis if residuals are noise alone; two degrees of freedom
    # each.
    chi2: FloatArray
    noise_px: FloatArray  # (n,): standard deviation per axis of a mean that is noise alone, px
    cell_px: float  # Side of a cell
    n_empty: int  # Cells left out

    @property
    def p_value(self) -> float:
        """Probability of cell means at least this large from noise alone.

        A little too large in general, which is the safe side for an alarm: the attitude of each
        frame takes up part of a pattern, and of the noise in the means.
        """
        from scipy.special import gammaincc

        if len(self.counts) == 0:
            return 1.0
        return float(gammaincc(len(self.counts), 0.5 * np.sum(self.chi2)))

    @property
    def pattern_px(self) -> float:
        """Root mean square per axis of the pattern over the field, the noise of the cell means
        taken off; px.
        """
        if len(self.counts) == 0:
            return 0.0
        excess = np.mean(np.sum(self.means**2, axis=1) / 2.0 - self.noise_px**2)
        return float(np.sqrt(max(excess, 0.0)))


def bin_residuals(cal: Calibration, obs: Observations) -> BinnedResiduals:
    """Mean residual vectors in cells that hold about 25 stars each (4 to 12 cells along the longer
    side).

    Of partitioned observations they are those of all stars, of which `obs` is a sample; of an
    estimate with Student-t tails those of stars within 4.5 sigma.
    """
    if cal.partitions is not None:
        found, scale2 = cal.partitions.residuals, _unit_scale(cal, cal.n_stars) ** 2
    else:
        obs = weighed(obs, cal)
        stated = obs.sigma_or_one
        residuals, use = cal.residuals_px, heard(obs, cal)
        scale2 = _unit_scale(cal, obs.n_stars) ** 2
        if not use.all():
            # The scale of the t is not the scatter of those that it hears.
            scale2 = float(np.mean((residuals / stated[:, None])[use] ** 2))
        found = ResidualMap.of(
            cal.camera, obs.n_stars, obs.xy[use].T, residuals[use].T, stated[use]
        )
    cell, nx = found.cell_px, int(found.shape[1])
    keep = found.counts >= _MIN_STARS
    counts, sums, variance = found.counts[keep], found.sums[keep], found.stated2[keep] * scale2
    flat = np.flatnonzero(keep)
    centres = np.stack([(flat % nx + 0.5) * cell - 0.5, (flat // nx + 0.5) * cell - 0.5], axis=1)
    return BinnedResiduals(
        centres=np.minimum(centres, [cal.camera.width_px - 0.5, cal.camera.height_px - 0.5]),
        means=sums / counts[:, None],
        counts=counts,
        chi2=np.sum(sums**2, axis=1) / variance,
        noise_px=np.sqrt(variance) / counts,
        cell_px=cell,
        n_empty=int(np.count_nonzero(~keep)),
    )


def heard(obs: Observations, cal: Calibration) -> BoolArray:
    """Stars (N,) that had a say in an estimate: of one with Student-t tails those within 4.5 sigma,
    else all.

    Frames keep at least three of them, or none.
    """
    if not cal.has_tails:
        return np.ones(obs.n_stars, dtype=bool)
    # By the scale of the tails: beside their own weights even wrong stars look right.
    plain = by_noise_model(obs, cal)
    size = np.max(np.abs(cal.residuals_px / plain.sigma_or_one[:, None]), axis=1)
    # Stars that the likelihood leaves out, such as those of a frame without an attitude, have none.
    use = (size > 0.0) & (size < OUTLIER_SIGMA * cal.tail_scale)
    order = np.searchsorted(cal.frame_ids, obs.frame)
    return np.asarray(use & (np.bincount(order, use, len(cal.frame_ids)) >= 3)[order])


def of_heard(obs: Observations, cal: Calibration) -> tuple[Observations, Calibration]:
    """The stars that were heard, and the estimate with their residuals and frames alone."""
    return _of_stars(obs, cal, heard(obs, cal))


def of_some_frames(
    obs: Observations, cal: Calibration, most: int | None, seed: int
) -> tuple[Observations, Calibration, int]:
    """A sample of at most so many frames, the calibration with the residuals and frames of the
    sample alone, and the number of all frames; all frames, and 0, where there are no more or
    effects are fitted.
    """
    if most is None or obs.n_frames <= most or cal.known_effects.fitted:
        return obs, cal, 0
    use = np.isin(np.arange(obs.n_frames), one_of_each(obs.n_frames, most, seed))
    return *_of_stars(obs, cal, np.repeat(use, np.diff(obs.frame_starts))), obs.n_frames


def _of_stars(
    obs: Observations, cal: Calibration, use: BoolArray
) -> tuple[Observations, Calibration]:
    if use.all():
        return obs, cal
    left = np.isin(cal.frame_ids, obs.frame[use])
    frames, quaternions = cal.frame_ids[left], cal.quaternions[left]
    kept = replace(
        cal,
        residuals_px=cal.residuals_px[use],
        frame_ids=frames,
        quaternions=quaternions,
        star_weights=None if cal.star_weights is None else cal.star_weights[use],
    )
    return obs.select(use), kept


def residual_scale(cal: Calibration, obs: Observations) -> FloatArray:
    """Expected standard deviation of each residual per axis, px, shape (N,).

    The fit takes up part of the noise: with d degrees of freedom in 2N numbers, residuals are
    smaller than the noise by sqrt(d / 2N) on average.
    """
    obs = weighed(obs, cal)
    n_stars = obs.n_stars if cal.partitions is None else cal.n_stars
    return floats(_unit_scale(cal, n_stars) * obs.sigma_or_one)


def _unit_scale(cal: Calibration, n_stars: int) -> float:
    """Expected standard deviation of the residuals of `n_stars` stars with a stated noise of
    one.
    """
    return float(cal.sigma * np.sqrt(max(cal.dof, 1) / (2.0 * n_stars)))


def normalised_residuals(cal: Calibration, obs: Observations) -> FloatArray:
    """Residuals in units of their expected standard deviation, shape (N, 2); of fitted axes, the
    independent parts.
    """
    scaled: FloatArray = cal.residuals_px / residual_scale(cal, obs)[:, None]
    axes = weighed(obs, cal).noise_axes
    return scaled if axes is None else scaled @ np.linalg.inv(np.linalg.cholesky(axes)).T


@dataclass(frozen=True)
class Profile1D:
    """Mean residuals in bins of one quantity, for two components."""

    # `title`, `label`: quantity that they are compared with, and the axis label with its unit.
    title: str
    label: str
    names: tuple[str, str]  # The two components
    centres: FloatArray  # (n,): mean of the quantity in each bin
    means: FloatArray  # (2, n): mean residuals, px
    errors: FloatArray  # (n,): standard error of a mean from noise alone, px


_XY, _POLAR = ("x", "y"), ("radial", "tangential")


def residual_profiles(cal: Calibration, obs: Observations) -> tuple[Profile1D, ...]:
    """Residuals against radius, azimuth, pixel phase in x and y, order of frames, magnitude and
    temperature, in bins.

    The phase is that of the predicted position, from -0.5 to 0.5 px around the centre of a pixel.
    Quantities that the table lacks, or that do not vary, are left out.
    """
    obs = weighed(obs, cal)
    residuals = cal.residuals_px.T
    predicted = obs.xy.T - residuals
    offset = predicted - cal.theta[:2, None]
    unit = offset / np.maximum(np.hypot(*offset), 1e-9)
    polar = np.stack(
        [np.sum(residuals * unit, axis=0), unit[0] * residuals[1] - unit[1] * residuals[0]]
    )
    phase = predicted - np.round(predicted)
    order = np.searchsorted(obs.frame_ids, obs.frame).astype(np.float64)
    wanted: list[tuple[str, str, tuple[str, str], FloatArray | None, FloatArray]] = [
        ("Radius", "distance from principal point [px]", _POLAR, np.hypot(*offset), polar),
        (
            "Azimuth",
            "azimuth in the field [°]",
            _POLAR,
            np.degrees(np.arctan2(offset[1], offset[0])),
            polar,
        ),
        ("Pixel phase in x", "phase in x [px]", _XY, phase[0], residuals),
        ("Pixel phase in y", "phase in y [px]", _XY, phase[1], residuals),
        ("Order of frames", "frame, in order", _POLAR, order, polar),
        ("Magnitude", "magnitude", _XY, obs.mag, residuals),
        ("Temperature", "temperature [°C]", _POLAR, obs.temperature_c, polar),
    ]
    scale2 = residual_scale(cal, obs) ** 2
    found = []
    for title, label, names, values, parts in wanted:
        if values is not None and np.nanstd(values) > 1e-9:
            found.append(_profile(title, label, names, values, parts, scale2))
    return tuple(found)


def _profile(
    title: str,
    label: str,
    names: tuple[str, str],
    values: FloatArray,
    parts: FloatArray,
    scale2: FloatArray,
) -> Profile1D:
    known = np.isfinite(values)
    values, parts, scale2 = values[known], parts[:, known], scale2[known]
    n_bins = int(np.clip(len(values) // 30, 3, 16))
    # Bins of equal number, so that all error bars mean the same; equal values stay in one bin.
    edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, n_bins + 1)))
    index = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, max(len(edges) - 2, 0))
    counts = np.bincount(index)
    kept = counts > 0
    counts = counts[kept].astype(np.float64)
    sums = np.stack([np.bincount(index, part)[kept] for part in parts])
    return Profile1D(
        title=title,
        label=label,
        names=names,
        centres=np.bincount(index, values)[kept] / counts,
        means=sums / counts,
        errors=np.sqrt(np.bincount(index, scale2)[kept]) / counts,
    )
