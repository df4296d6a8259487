"""Residuals as sums that add up over any number of stars: by cells of the detector, by frames, and
by partitions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.likelihood.shapes import Cells
from starcal_uq.likelihood.sums import sum_of, together

# Residuals beyond it are counted: noise alone gives 7 of a million.
OUTLIER_SIGMA = 4.5


@dataclass(frozen=True)
class ResidualMap:
    """Sums of residuals in square cells of the detector, row by row."""

    shape: IntArray  # (2,): rows and columns of cells
    cell_px: float  # Side of a cell
    counts: FloatArray  # (cells,): stars in each
    sums: FloatArray  # (cells, 2): sums of their residuals, px
    # (cells,): sums of their squared stated noise, px^2; of ones where they state none
    stated2: FloatArray

    @classmethod
    def of(
        cls,
        camera: Camera,
        n_stars: int,
        xy_px: FloatArray,
        residuals_px: FloatArray,
        stated_px: FloatArray,
    ) -> ResidualMap:
        """Sums over stars at (2, N) with residuals (2, N) and stated noise (N,).

        The cells are made for `n_stars` stars in all, about 25 to each: 4 to 12 along the longer
        side.
        """
        cells = Cells.of(camera, n_stars, 4, 12)
        index, n = cells.at(xy_px), cells.nx * cells.ny
        return cls(
            shape=np.array([cells.ny, cells.nx]),
            cell_px=cells.side_px,
            counts=np.bincount(index, minlength=n).astype(np.float64),
            sums=np.stack([np.bincount(index, values, n) for values in residuals_px], axis=1),
            stated2=np.bincount(index, stated_px**2, n).astype(np.float64),
        )

    def __add__(self, other: ResidualMap) -> ResidualMap:
        return together(self, other, "shape", "cell_px")


@dataclass(frozen=True)
class RicherModel:
    """A distortion model with more terms, fitted to all stars by one Gauss-Newton step from the
    calibration.
    """

    model: str  # Name of the registry
    theta: FloatArray  # (q,): its estimate, px units
    n_terms: int  # Terms beyond those of the calibration
    # Decrease of the sum of squares, in units of the noise variance: chi-square with `n_terms`
    # degrees of freedom where the calibration's model holds.
    gain: float


@dataclass(frozen=True)
class FrameScatter:
    """How frames scatter about an estimate: sums over frames in parameters ``z = (theta -
    theta_hat) / scale``.
    """

    # `theta`, `scale`, (p,): estimate, px units, and unit of each parameter.
    theta: FloatArray
    scale: FloatArray
    matrix: FloatArray  # (p, p): Gauss-Newton matrix
    squares: float  # Sum of squared whitened residuals
    # `n_frames`, `dof`: frames, and their independent numbers ``2 m_k - 3``.
    n_frames: int
    dof: int
    steps: FloatArray  # (p + 1, p + 1): products of (1, z) of the estimates without each frame
    scores: FloatArray  # (p, p): products of the frames' slopes, their leverage corrected
    # `powers` (3, p), `inner` and `middle` (p, p, p): from which the degrees of freedom of
    # `clustered` follow.
    powers: FloatArray
    inner: FloatArray
    middle: FloatArray

    def __add__(self, other: FrameScatter) -> FrameScatter:
        return together(self, other, "theta", "scale")

    @property
    def formal(self) -> FloatArray:
        """Covariance (p, p) of z if noise is Gaussian and independent."""
        return np.linalg.inv(self.matrix) * self.squares / (self.dof - len(self.theta))

    @property
    def jackknife(self) -> FloatArray:
        """Covariance (p, p) of z from the estimates that leave one frame out."""
        k, mean = self.n_frames, self.steps[0, 1:] / self.n_frames
        return (self.steps[1:, 1:] - k * np.outer(mean, mean)) * (k - 1.0) / k

    @property
    def clustered(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Covariance (p, p) of z from the scatter of the frames, and two degrees of freedom (p,) of
        its diagonal.

        Bell & McCaffrey (2002): residuals of frame k are multiplied by (I - h_k H^-1 h_k^T)^(-1/2),
        which frees the covariance of what the fit takes up wherever noise is independent. Degrees
        of freedom are those of a chi-square of the same variance (Satterthwaite), and of the same
        skewness, which are fewer where frames are uneven.
        """
        trace, square, cube = self.powers
        square = square + np.sum(self.inner**2, axis=(1, 2))
        cube = cube + 3.0 * np.einsum("jab,jab->j", self.middle, self.inner)
        cube -= np.einsum("jab,jbc,jca->j", self.inner, self.inner, self.inner)
        return self.scores, trace**2 / square, square**3 / cube**2


@dataclass(frozen=True)
class PartitionSums:
    """What is known of all residuals of a calibration that has kept those of a sample of its
    frames.
    """

    # `n_stars`, `n_frames`, (n,): stars and frames of each of n partitions.
    n_stars: IntArray
    n_frames: IntArray
    chi2: (
        FloatArray  # (n,): their sums of squared residuals, px^2 (or in units of the stated noise)
    )
    residuals: ResidualMap  # Residuals of all stars in cells of the detector
    # Sum of the squared stated noise of all stars, px^2; their number where they state none
    stated2: float
    n_beyond: int  # Stars with a residual beyond 4.5 standard deviations
    largest: float  # Largest residual along an axis, standard deviations
    largest_frame: int  # Frame of the largest
    richer: tuple[RicherModel, ...] = ()  # Models of which the calibration's is a special case
    scatter: FrameScatter | None = (
        None  # How all frames scatter about the estimate; None in an earlier calibration
    )

    @classmethod
    def joined(cls, parts: Sequence[PartitionSums]) -> PartitionSums:
        """Those of all partitions of several."""
        worst = max(parts, key=lambda part: part.largest)
        return cls(
            n_stars=np.concatenate([part.n_stars for part in parts]),
            n_frames=np.concatenate([part.n_frames for part in parts]),
            chi2=np.concatenate([part.chi2 for part in parts]),
            residuals=sum_of([part.residuals for part in parts]),
            stated2=sum(part.stated2 for part in parts),
            n_beyond=sum(part.n_beyond for part in parts),
            largest=worst.largest,
            largest_frame=worst.largest_frame,
        )
