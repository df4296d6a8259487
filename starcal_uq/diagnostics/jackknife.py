"""Leave-one-frame-out jackknife: uncertainties from how the frames disagree, whatever the cause.

Formal uncertainties hold if noise is Gaussian and independent from star to star. Whatever makes
stars of one frame err together, and differently from frame to frame, shows in the scatter of
estimates that leave one frame out, and in that of the frames' slopes. The second is tested: with
the leverage corrected (CR2 of Bell & McCaffrey 2002) it is unbiased for any number of frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from starcal_uq.core.display import Shown
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.formatting import plural
from starcal_uq.core.types import FloatArray, floats
from starcal_uq.diagnostics.beside import normals_beside
from starcal_uq.estimation.normals import FrameNormals
from starcal_uq.estimation.weights import weighed
from starcal_uq.maths.linear import root_diagonal

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.estimation.residual_map import FrameScatter
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

# Degrees of freedom of a noise that is taken as known.
_MANY = 10_000_000


@dataclass(frozen=True, eq=False)
class Jackknife(Shown):
    """Formal and frame-level uncertainties side by side.

    Attributes
    ----------
    parameter_names : tuple of str
        The p parameters.
    formal_covariance : (p, p) array
        Covariance if noise is Gaussian and independent.
    jackknife_covariance : (p, p) array
        ``(K - 1) / K`` times the scatter of the estimates that leave one of K frames out.
    sandwich_covariance : (p, p) array
        ``H^-1 (sum_k g_k g_k^T) H^-1`` over frames: the cluster-robust one, with the leverage of
        each frame corrected.
    left_out : (K, p) array
        Estimates without each frame, px units; none of partitioned observations.
    effective_frames : (p,) array
        Frames of equal weight that would determine each parameter as unevenly as these K do: one
        more than Satterthwaite's degrees of freedom of `sandwich_covariance`.
    n_frames : int
        K.
    of_frames : int
        Frames of the estimate, of which these K are a sample: covariances and estimates are those
        that all frames have if they are like these. 0 where K are all.
    residual_dof : int
        Degrees of freedom of the noise in `formal_covariance`; 0 in earlier files, which took it
        as known.
    tail_dof : (p,) array or None
        Degrees of freedom of a chi-square as skew as `sandwich_covariance`; None in files of
        before.
    """

    parameter_names: tuple[str, ...]
    formal_covariance: FloatArray
    jackknife_covariance: FloatArray
    sandwich_covariance: FloatArray
    left_out: FloatArray
    effective_frames: FloatArray
    n_frames: int
    residual_dof: int = 0
    tail_dof: FloatArray | None = None
    of_frames: int = 0

    SHAPES: ClassVar = """
        p: parameter_names effective_frames tail_dof
        k p: left_out
        p p: formal_covariance jackknife_covariance sandwich_covariance
    """

    @property
    def ratio(self) -> FloatArray:
        """Cluster-robust standard deviation over the formal one, (p,)."""
        return np.sqrt(np.diag(self.sandwich_covariance) / np.diag(self.formal_covariance))

    @property
    def jackknife_ratio(self) -> FloatArray:
        """Jackknife standard deviation over the formal one, (p,); too large on average where frames
        are few.
        """
        return np.sqrt(np.diag(self.jackknife_covariance) / np.diag(self.formal_covariance))

    def expected(self, probability: float = 0.95) -> tuple[FloatArray, FloatArray]:
        """Lower and upper end (p,) of the ratios that chance alone gives."""
        from scipy.special import betaincinv

        tail = 0.5 * (1.0 - probability)
        low, high = (self._ratio(betaincinv(*self._shape, q)) for q in (tail, 1.0 - tail))
        return low, high

    @property
    def dof(self) -> FloatArray:
        """Degrees of freedom (p,) of the cluster-robust variances."""
        return np.maximum(self.effective_frames - 1.0, 1.0)

    # A squared ratio has mean 1, variance 2 / dof and the skewness of tail_dof; shifted and scaled
    # it is, to these three moments, a chi-square of tail_dof (Hall 1983, Buckley & Eagleson 1988),
    # as a part of all squares a beta.

    @property
    def _tail(self) -> FloatArray:
        return self.dof if self.tail_dof is None else np.clip(self.tail_dof, 0.5, self.dof)

    @property
    def _shape(self) -> tuple[FloatArray, FloatArray]:
        rest = np.maximum((self.residual_dof or _MANY) - self._tail, 1.0)
        return 0.5 * self._tail, 0.5 * rest

    def _ratio(self, share: FloatArray) -> FloatArray:
        excess = (share * (self.residual_dof or _MANY) - self._tail) / np.sqrt(
            self.dof * self._tail
        )
        return np.sqrt(np.maximum(1.0 + excess, 0.0))

    @property
    def p_values(self) -> FloatArray:
        """Probability (p,) of a ratio at least this large if the formal errors hold."""
        from scipy.special import betaincc

        share = (self._tail + (self.ratio**2 - 1.0) * np.sqrt(self.dof * self._tail)) / (
            self.residual_dof or _MANY
        )
        return floats(betaincc(*self._shape, np.clip(share, 0.0, 1.0)))

    def detectable(self, alpha: float, power: float = 0.9) -> FloatArray:
        """Ratios (p,) of true uncertainties that a test at this level finds with this
        probability.
        """
        from scipy.special import betaincinv, gammaincinv

        found = self._ratio(betaincinv(*self._shape, 1.0 - alpha))
        # Frames that err by more scatter as evenly as they weigh: Satterthwaite's approximation,
        # which is never zero.
        missed = np.sqrt(2.0 / self.dof * gammaincinv(0.5 * self.dof, 1.0 - power))
        return floats(found / missed)

    def to_dataframe(self) -> pd.DataFrame:
        """One row per parameter: formal, jackknife and cluster-robust sigma, and their ratios."""
        import pandas as pd

        low, high = self.expected()
        return pd.DataFrame(
            {
                "parameter": list(self.parameter_names),
                "formal_sigma": root_diagonal(self.formal_covariance),
                "jackknife_sigma": root_diagonal(self.jackknife_covariance),
                "sandwich_sigma": root_diagonal(self.sandwich_covariance),
                "ratio": self.ratio,
                "jackknife_ratio": self.jackknife_ratio,
                "expected_low": low,
                "expected_high": high,
                "p_value": self.p_values,
            }
        )


def jackknife_frames(
    obs: Observations,
    cal: Calibration,
    normals: FrameNormals | None = None,
    of_frames: int = 0,
) -> Jackknife:
    """Leave each frame out in turn, by one Gauss-Newton step from the estimate.

    Parameters
    ----------
    obs, cal
        The data and the estimate made from them.
    normals : FrameNormals, optional
        The frames' normal equations, where they are at hand.
    of_frames : int
        Frames of the estimate, where these are a sample.

    Raises
    ------
    CalibrationError
        For fewer than three frames, or when the parameters are not determined without one of the
        frames.
    """
    if obs.n_frames < 3:
        raise CalibrationError(
            f"a jackknife over {plural(obs.n_frames, 'frame')} says nothing: use three or more."
        )
    if normals is None:
        at = normals_beside if cal.known_effects.fitted else FrameNormals.at
        normals = at(weighed(obs, cal), cal)
    z, _ = normals.left_out()
    if not np.isfinite(z).all():
        frame = obs.frame_ids[int(np.argmin(np.isfinite(z).all(axis=1)))]
        raise CalibrationError(
            f"without frame {frame} the parameters are not determined: a jackknife needs more "
            "frames like it."
        )
    if of_frames:
        # The best estimate of these frames is a little beside that of all.
        z = (z - z.mean(axis=0)) * (obs.n_frames / of_frames)
    left_out = normals.theta + z * normals.scale
    return _jackknife(normals.scatter(), cal, left_out, of_frames)


def jackknife_of_all(cal: Calibration) -> Jackknife | None:
    """The jackknife over all frames of partitioned observations, without the single estimates; None
    if it has no sums.

    The sums are made with the calibration, file by file.
    """
    found = None if cal.partitions is None else cal.partitions.scatter
    if found is None or found.n_frames < 3 or not np.isfinite(found.steps).all():
        return None
    return _jackknife(found, cal, np.empty((0, len(found.theta))))


def _jackknife(
    found: FrameScatter, cal: Calibration, left_out: FloatArray, of_frames: int = 0
) -> Jackknife:
    unit = np.outer(found.scale, found.scale)
    if of_frames:
        unit *= found.n_frames / of_frames
    clustered, dof, tail_dof = found.clustered
    return Jackknife(
        parameter_names=cal.parameter_names,
        formal_covariance=found.formal * unit,
        jackknife_covariance=found.jackknife * unit,
        sandwich_covariance=clustered * unit,
        left_out=left_out,
        effective_frames=dof + 1.0,
        n_frames=found.n_frames,
        residual_dof=found.dof - len(found.theta),
        tail_dof=tail_dof,
        of_frames=of_frames,
    )
