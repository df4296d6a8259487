"""What the posterior of the camera means for attitude: draws through QUEST on the observed frames.

Every draw of the camera turns the measured pixels into directions, and QUEST turns these into one attitude per frame.
Its difference from the attitude at the posterior mean is a left rotation vector phi (pitch, yaw, roll), split into

- the *common rotation*, its mean over frames: one constant for the mission, which alignment calibration with the same
  parameters absorbs, and
- the *rest*, which depends on where the stars are and is absorbed by nothing.

The mean square of phi is the sum of theirs. Centroid noise (the noise-equivalent angle, NEA) stands beside them: it is
new in every frame.

A few hundred draws give a standard deviation to 4 % only. But phi is linear in the parameters to high accuracy, and its
first-order response K is known, so it serves as a control variate: to the variance of the sampled phi is added
K (Sigma - Sigma_d) K^T, with Sigma the covariance of all draws and Sigma_d that of the draws that went through QUEST.
What is sampled is then only the difference from linearity. Quantiles are those of K applied to all draws, scaled to
that standard deviation.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq._types import FloatArray, IntArray
from starcal_uq.attitude import left_error
from starcal_uq.errors import DistortionError, ObservationError, RunFolderError, SamplingError
from starcal_uq.formatting import significant
from starcal_uq.projection import unproject_jacobian, unproject_theta
from starcal_uq.runfolder import atomic_path
from starcal_uq.wahba import quest

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.observations import Observations
    from starcal_uq.posterior import Posterior

AXES = ("pitch", "yaw", "roll")
CROSS_BORESIGHT = "cross-boresight"
_COLUMNS = (*AXES, CROSS_BORESIGHT)
CONTRIBUTORS = (
    "centroid noise (NEA)",
    "calibration, common rotation",
    "calibration, rest",
    "calibration, total",
)
_ABSORBED = ("no", "yes", "no", "in part")
_ARCSEC = 648_000.0 / np.pi
_LEVELS = (0.95, 0.997)
_STARS_AT_ONCE = 1_000_000
_SAMPLES = 400_000
# Half a pixel: the map is so smooth that the central difference errs by (h / f)^2, while rounding stays below 1e-12.
_STEP_PX = 0.5


@dataclass(frozen=True, eq=False)
class AttitudeError:
    """Attitude error of single frames by contributor, arcsec.

    Axes are ``("pitch", "yaw", "roll")``: left rotation vectors about camera +X, +Y and the boresight +Z.

    Attributes
    ----------
    nea_arcsec : (3,) array
        Centroid noise: root mean square over frames of the standard deviation.
    common_arcsec : (3,) array
        Standard deviation of the common rotation over the posterior.
    rest_arcsec : (3,) array
        Standard deviation of the rest over the posterior, root mean square over frames.
    p95_arcsec, p997_arcsec : (4, 4) array
        Half-widths that hold 95 % and 99.7 % of the absolute errors: rows are `CONTRIBUTORS`, columns the three axes
        and the angle across the boresight, the root of pitch^2 + yaw^2 (2.45 and 3.41 sigma per axis if Gaussian).
    analytic_nea_arcsec, analytic_common_arcsec, analytic_rest_arcsec : (3,) array
        The same standard deviations by first-order propagation of the posterior's covariance.
    n_draws, n_frames : int
        What the numbers rest on.
    common_draws_arcsec : (D, 3) array or None
        Common rotation of every draw; None when read from a file.
    rest_rms_per_frame_arcsec : (K, 3) array or None
        Standard deviation of the rest in each frame; None when read from a file.
    nea_per_frame_arcsec : (K, 3) array or None
        Standard deviation from centroid noise in each frame; None when read from a file.
    """

    nea_arcsec: FloatArray
    common_arcsec: FloatArray
    rest_arcsec: FloatArray
    p95_arcsec: FloatArray
    p997_arcsec: FloatArray
    analytic_nea_arcsec: FloatArray
    analytic_common_arcsec: FloatArray
    analytic_rest_arcsec: FloatArray
    n_draws: int
    n_frames: int
    common_draws_arcsec: FloatArray | None = None
    rest_rms_per_frame_arcsec: FloatArray | None = None
    nea_per_frame_arcsec: FloatArray | None = None

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the three axes."""
        return AXES

    @property
    def calibration_total_arcsec(self) -> FloatArray:
        """Common rotation and rest together (3,), which are uncorrelated by construction."""
        return np.hypot(self.common_arcsec, self.rest_arcsec)

    def to_dataframe(self) -> pd.DataFrame:
        """One row per contributor and axis.

        Columns are ``contributor``, ``axis``, ``sigma_arcsec``, ``p95_arcsec``, ``p997_arcsec``,
        ``first_order_arcsec`` (sigma by first-order propagation) and ``absorbed_by_alignment`` (yes, no, in part).
        The cross-boresight rows hold the root mean square of the sigmas of pitch and yaw.
        """
        import pandas as pd

        sampled = (self.nea_arcsec, self.common_arcsec, self.rest_arcsec, self.calibration_total_arcsec)
        analytic = (
            self.analytic_nea_arcsec,
            self.analytic_common_arcsec,
            self.analytic_rest_arcsec,
            np.hypot(self.analytic_common_arcsec, self.analytic_rest_arcsec),
        )
        return pd.DataFrame(
            {
                "contributor": np.repeat(CONTRIBUTORS, len(_COLUMNS)).astype(object),
                "axis": np.array(_COLUMNS * len(CONTRIBUTORS), dtype=object),
                "sigma_arcsec": np.concatenate([_with_cross(values) for values in sampled]),
                "p95_arcsec": self.p95_arcsec.ravel(),
                "p997_arcsec": self.p997_arcsec.ravel(),
                "first_order_arcsec": np.concatenate([_with_cross(values) for values in analytic]),
                "absorbed_by_alignment": np.repeat(_ABSORBED, len(_COLUMNS)).astype(object),
            }
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the table as CSV, atomically and to the last digit; overwritten. Single draws are not kept."""
        table = self.to_dataframe().assign(n_draws=self.n_draws, n_frames=self.n_frames)
        with atomic_path(path) as temporary:
            table.to_csv(temporary, index=False)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> AttitudeError:
        """Read what `save` wrote.

        Raises
        ------
        RunFolderError
            If the file is missing or is not such a table.
        """
        names = ("sigma", "p95", "p997", "first_order")
        try:
            with open(path, newline="", encoding="utf-8") as file:
                rows = {(row["contributor"], row["axis"]): row for row in csv.DictReader(file)}
            chosen = [[rows[contributor, axis] for axis in _COLUMNS] for contributor in CONTRIBUTORS]
            sigma, p95, p997, analytic = (
                np.array([[float(row[f"{name}_arcsec"]) for row in line] for line in chosen]) for name in names
            )
            counts = {name: int(chosen[0][0][name]) for name in ("n_draws", "n_frames")}
        except OSError as error:
            raise RunFolderError(
                f"{path}: cannot be read ({error.strerror or error}); run `starcal-uq propagate RUN` first."
            ) from error
        except (KeyError, TypeError, ValueError, csv.Error) as error:
            raise RunFolderError(
                f"{path}: is not a table of attitude errors; run `starcal-uq propagate RUN` to write it again."
            ) from error
        return cls(
            *(sigma[0, :3], sigma[1, :3], sigma[2, :3], p95, p997),
            *(analytic[0, :3], analytic[1, :3], analytic[2, :3]),
            n_draws=counts["n_draws"],
            n_frames=counts["n_frames"],
        )

    def plot_attitude(self, **options: Any) -> Any:
        """Bars per contributor and axis; options as for `starcal_uq.plots.plot_attitude`."""
        from starcal_uq.plots import plot_attitude

        return plot_attitude(self, **options)

    def _repr_html_(self) -> str:
        table = self.to_dataframe().to_html(index=False, float_format=significant, border=0)
        return (
            f"<p><b>Attitude error</b> of single frames: {self.n_draws} posterior draws through QUEST on "
            f"{self.n_frames} frames.</p>{table}"
        )


def propagate(post: Posterior, obs: Observations, *, n_draws: int = 300, seed: int = 0) -> AttitudeError:
    """Attitude error on the observed frames: centroid noise, and calibration as common rotation and rest.

    QUEST weights stars equally, or by their stated noise where the posterior scales it.

    Parameters
    ----------
    post : Posterior
        Draws of the camera and the noise.
    obs : Observations
        The frames whose star geometry counts; usually those of the calibration.
    n_draws : int
        Draws that go through QUEST; all if there are fewer.
    seed : int
        Chooses them.

    Raises
    ------
    SamplingError
        For fewer than two draws.
    DistortionError
        When a draw folds the distortion within the observed pixels.
    ObservationError
        When the posterior scales stated noises that the observations lack.
    DegenerateFrameError
        When a frame does not determine an attitude.
    """
    draws = post.thin(n_draws, seed)[:, :-1]
    count = len(draws)
    if count < 2:
        raise SamplingError("propagation needs at least two posterior draws: raise n_draws.")
    noise_px, weights = _noise(post, obs)
    common = np.empty((count, 3))
    total, squares = np.zeros((obs.n_frames, 3)), np.zeros((obs.n_frames, 3))
    for part, phi in _rotations(post, obs, draws, weights):
        common[part] = phi.mean(axis=1)
        rest = phi - common[part, None]
        total += rest.sum(axis=0)
        squares += np.sum(rest * rest, axis=0)

    response, nea = _first_order(post, obs, noise_px, weights)
    together, apart = response.mean(axis=0), response - response.mean(axis=0)
    chance = post.covariance - np.cov(draws, rowvar=False)
    common_variance = np.maximum(common.var(axis=0, ddof=1) + _spread(together, chance), 0.0)
    rest_variance = (squares - total * total / count) / (count - 1) + _spread(apart, chance)
    rest_variance = np.maximum(rest_variance, 0.0)
    half_widths = [_noise_half_widths(nea, seed)]
    sigmas = (np.sqrt(common_variance), _rms(rest_variance))
    half_widths += _calibration_half_widths(post, together, apart, sigmas, seed)
    p95, p997 = np.swapaxes(half_widths, 0, 1) * _ARCSEC
    return AttitudeError(
        nea_arcsec=_rms(_diagonal(nea)) * _ARCSEC,
        common_arcsec=sigmas[0] * _ARCSEC,
        rest_arcsec=sigmas[1] * _ARCSEC,
        p95_arcsec=p95,
        p997_arcsec=p997,
        analytic_nea_arcsec=np.sqrt(np.diag(post.attitude_noise)) * _ARCSEC,
        analytic_common_arcsec=np.sqrt(_spread(post.rotation_per_theta, post.covariance)) * _ARCSEC,
        analytic_rest_arcsec=_rms(_spread(apart, post.covariance)) * _ARCSEC,
        n_draws=count,
        n_frames=obs.n_frames,
        common_draws_arcsec=common * _ARCSEC,
        rest_rms_per_frame_arcsec=np.sqrt(rest_variance) * _ARCSEC,
        nea_per_frame_arcsec=np.sqrt(_diagonal(nea)) * _ARCSEC,
    )


def _noise(post: Posterior, obs: Observations) -> tuple[FloatArray, FloatArray | None]:
    """Centroid noise of every star (N,) in px at the posterior mean, and the weights of QUEST."""
    sigma = float(np.mean(post.sigma_draws))
    if post.sigma_name != "sigma_scale":
        return np.full(obs.n_stars, sigma), None
    if obs.sigma_px is None:
        raise ObservationError(
            "the posterior scales the stated noise of the stars, but these observations have no sigma_px: "
            "pass the observations that it was sampled from.",
            column="sigma_px",
        )
    return sigma * obs.sigma_px, obs.sigma_px**-2.0


def _rotations(
    post: Posterior, obs: Observations, draws: FloatArray, weights: FloatArray | None
) -> Iterator[tuple[slice, FloatArray]]:
    """Left rotations (d, K, 3) rad of the attitudes at some draws from those at the posterior mean."""
    model, xy, r, starts = post.camera.distortion, obs.xy, obs.directions_icrs, obs.frame_starts

    def attitudes(thetas: FloatArray) -> FloatArray:
        b = np.stack([unproject_theta(model, theta, xy) for theta in thetas])
        folded = ~np.isfinite(b).all(axis=(1, 2))
        if folded.any():
            raise DistortionError(
                f"at {int(folded.sum())} of {len(b)} posterior draws the distortion {model!r} folds over within the "
                "observed field: use more frames, a tighter prior or a model with fewer coefficients."
            )
        return quest(b, r, starts, weights, covariance=False).quaternions

    reference = attitudes(post.mean[None])
    step = max(1, _STARS_AT_ONCE // obs.n_stars)
    for first in range(0, len(draws), step):
        part = slice(first, first + step)
        yield part, left_error(attitudes(draws[part]), reference)


def _first_order(
    post: Posterior, obs: Observations, noise_px: FloatArray, weights: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Response of QUEST to parameters (K, 3, p), rad per px unit, and its covariance from centroid noise (K, 3, 3).

    Displacements db of the directions turn the attitude by phi = [sum w (I - b b^T)]^-1 sum w b x db.
    """
    model, xy, starts = post.camera.distortion, obs.xy, obs.frame_starts
    b, per_theta = unproject_jacobian(model, post.mean, xy)
    steps = _STEP_PX * np.eye(2)
    per_pixel = [
        (unproject_theta(model, post.mean, xy + step) - unproject_theta(model, post.mean, xy - step)) / (2.0 * _STEP_PX)
        for step in steps
    ]
    w = np.ones(obs.n_stars) if weights is None else weights
    inverse = np.linalg.inv(_frame_sums(w[:, None, None] * (np.eye(3) - b[:, :, None] * b[:, None, :]), starts))
    by_theta = _frame_sums(w[:, None, None] * np.cross(b[:, None], np.swapaxes(per_theta, 1, 2)), starts)
    noise = [w[:, None] * noise_px[:, None] * np.cross(b, column) for column in per_pixel]
    scatter = _frame_sums(sum(v[:, :, None] * v[:, None, :] for v in noise), starts)
    return inverse @ np.swapaxes(by_theta, 1, 2), inverse @ scatter @ inverse


def _frame_sums(values: Any, starts: IntArray) -> FloatArray:
    sums: FloatArray = np.add.reduceat(values, starts[:-1], axis=0)
    return sums


def _noise_half_widths(covariance: FloatArray, seed: int) -> FloatArray:
    """Half-widths of Gaussian errors with the covariance (K, 3, 3) of a frame taken at random."""
    shape = (max(1, _SAMPLES // len(covariance)), len(covariance), 3, 1)
    return _half_widths(np.linalg.cholesky(covariance) @ np.random.default_rng(seed).standard_normal(shape))


def _calibration_half_widths(
    post: Posterior, together: FloatArray, apart: FloatArray, sigmas: tuple[FloatArray, FloatArray], seed: int
) -> list[FloatArray]:
    """Half-widths of common rotation, rest and total: first-order errors of draws and frames, scaled to `sigmas`."""
    shift = post.theta_draws - post.mean
    common = _scaled(shift @ together.T, sigmas[0])
    rng = np.random.default_rng(seed)
    draw, frame = rng.integers(len(shift), size=_SAMPLES), rng.integers(len(apart), size=_SAMPLES)
    rest = _scaled(np.einsum("np,nip->ni", shift[draw], apart[frame]), sigmas[1])
    return [_half_widths(errors) for errors in (common, rest, rest + common[draw])]


def _scaled(errors: FloatArray, sigma: FloatArray) -> FloatArray:
    own = np.sqrt(np.mean(errors.reshape(-1, 3) ** 2, axis=0))
    scaled: FloatArray = errors * (sigma / np.where(own > 0.0, own, 1.0))
    return scaled


def _half_widths(errors: FloatArray) -> FloatArray:
    """Quantiles of the absolute errors (..., 3) over all leading axes: (2, 4), rad, the last across the boresight."""
    e = np.abs(errors.reshape(-1, 3))
    widths: FloatArray = np.quantile(np.column_stack((e, np.hypot(e[:, 0], e[:, 1]))), _LEVELS, axis=0)
    return widths


def _with_cross(sigma: FloatArray) -> FloatArray:
    return np.append(sigma, np.sqrt(np.mean(sigma[:2] ** 2)))


def _spread(response: FloatArray, covariance: FloatArray) -> FloatArray:
    """Diagonal (..., 3) of ``response @ covariance @ response^T`` for responses (..., 3, p)."""
    diagonal: FloatArray = np.sum((response @ covariance) * response, axis=-1)
    return diagonal


def _diagonal(matrices: FloatArray) -> FloatArray:
    diagonal: FloatArray = np.diagonal(matrices, axis1=-2, axis2=-1)
    return diagonal


def _rms(variances: FloatArray) -> FloatArray:
    """Root of the mean over frames of variances (K, 3)."""
    root: FloatArray = np.sqrt(variances.mean(axis=0))
    return root
