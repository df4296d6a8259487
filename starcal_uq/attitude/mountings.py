"""Mountings of heads and their drift with temperature, from frames that heads have in common.

With mountings that are wrong by small turns m_i about the axes of the body, heads disagree about
its attitude in every frame: the attitude of the body by head i is turned by -m_i - s_i (T - T0), and
by its noise. The attitude itself is unknown in every frame and eliminated, so that only differences
between heads count: one head is the reference, whose mounting is right at all temperatures.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.attitude.heads import HeadArray, HeadTest, apart_from, body_weights
from starcal_uq.attitude.rotations import exp_rotation
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.display import public_names
from starcal_uq.core.errors import HeadError, check_known, require
from starcal_uq.core.types import FloatArray
from starcal_uq.maths.linear import inverses, root_diagonal

if TYPE_CHECKING:
    import pandas as pd

# Turns of a degree change by less than rounding after this many.
_PASSES = 6


@dataclass(frozen=True, eq=False)
class Misalignments:
    """How mountings differ from those that were taken, about the axes of the body.

    Attributes
    ----------
    heads : HeadArray
        The heads with the mountings that were taken.
    reference : str
        Head whose mounting is right by definition.
    correction_arcsec : (H, 3) array
        Turns that correct the mountings at `temperature_c`: exp([m]x) R_body_head.
    drift_arcsec_c : (H, 3) array
        Their change per degree; 0 where no temperature was given.
    covariance : (3 H, 3 H) or (6 H, 6 H) array
        Covariance of corrections, head by head, and of drifts after them, arcsec and degC; 0 for
        the reference.
    temperature_c : float
        Mean temperature of the frames, degC; NaN where none was given.
    test : HeadTest
        Whether heads differ after the correction as their covariances say. A drift that was left
        out shows here.
    """

    __dir__ = public_names

    heads: HeadArray
    reference: str
    correction_arcsec: FloatArray
    drift_arcsec_c: FloatArray
    covariance: FloatArray
    temperature_c: float
    test: HeadTest

    @property
    def sigma_arcsec(self) -> FloatArray:
        """Standard deviations (H, 3) of the corrections."""
        return self._sigmas[0]

    @property
    def drift_sigma_arcsec_c(self) -> FloatArray:
        """Standard deviations (H, 3) of the drifts; 0 where none was estimated."""
        return self._sigmas[1] if len(self._sigmas) > 1 else 0.0 * self._sigmas[0]

    @property
    def _sigmas(self) -> list[FloatArray]:
        return list(root_diagonal(self.covariance).reshape(-1, *self.correction_arcsec.shape))

    def corrected(self, temperature_c: float | None = None) -> HeadArray:
        """The heads with corrected mountings, at a temperature or at the mean of the frames."""
        warmer = 0.0 if temperature_c is None else temperature_c - self.temperature_c
        turn = (self.correction_arcsec + warmer * self.drift_arcsec_c) / ARCSEC
        return replace(self.heads, R_body_head=exp_rotation(turn) @ self.heads.R_body_head)

    def to_dataframe(self) -> pd.DataFrame:
        """One row per head and axis of the body: ``head``, ``axis``, ``correction_arcsec``,
        ``sigma_arcsec``, ``drift_arcsec_c``, ``drift_sigma_arcsec_c``.
        """
        import pandas as pd

        names = ("correction_arcsec", "sigma_arcsec", "drift_arcsec_c", "drift_sigma_arcsec_c")
        size = len(self.heads.names)
        return pd.DataFrame(
            {
                "head": np.repeat(np.array(self.heads.names, dtype=object), 3),
                "axis": np.array(list("XYZ") * size, dtype=object),
                **{name: getattr(self, name).ravel() for name in names},
            }
        )


def misalignments(
    heads: HeadArray,
    quaternions: FloatArray,
    covariance: FloatArray,
    temperature_c: FloatArray | None = None,
    *,
    reference: str | None = None,
) -> Misalignments:
    """Corrections of mountings from common frames, and their drift with temperature.

    Parameters
    ----------
    heads : HeadArray
        The heads with their mountings as far as they are known, to some degrees.
    quaternions, covariance
        Attitudes of the heads in K frames, as for `HeadArray.fuse`.
    temperature_c : (K,) array, optional
        Temperature of what carries the heads in every frame; with it, drifts are estimated.
    reference : str, optional
        Head whose mounting is taken as right; the first one by default.

    Raises
    ------
    HeadError
        For arrays of another shape, an unknown reference, a temperature that does not vary, and a
        head without a frame in common with the others.
    """
    q, cov, seen = heads.by_frame(quaternions, covariance)
    reference = heads.names[0] if reference is None else reference
    check_known("head", reference, heads.names, HeadError)
    require(HeadError, (len(heads.names) > 1, "one head alone has no misalignment: give another."))
    powers, mean_c = _powers(temperature_c, len(q))
    free = np.flatnonzero(np.array(heads.names) != reference)
    x = np.zeros((powers.shape[1], len(heads.names), 3))
    for step in range(_PASSES + 1):
        rotations = exp_rotation(np.einsum("kp,phi->khi", powers, x)) @ heads.R_body_head
        apart, _ = apart_from(q, rotations, seen)
        between = _between(rotations, cov)
        residual = np.einsum("khiaj,kaj->khi", between, apart)
        if step == _PASSES:
            break
        normal = np.einsum("kp,kq,khiaj->phiqaj", powers, powers, between)
        normal = normal[:, free][:, :, :, :, free]
        right = np.einsum("kp,khi->phi", powers, residual)[:, free]
        inverse = inverses(normal.reshape(right.size, right.size))
        text = "a head has too few frames in common with the others: give more, or leave it out."
        require(HeadError, (bool(np.isfinite(inverse).all()), text))
        x[:, free] -= (inverse @ right.ravel()).reshape(right.shape)
    places = np.arange(x.size).reshape(x.shape)[:, free].ravel()
    full = np.zeros((x.size, x.size))
    full[np.ix_(places, places)] = inverse * ARCSEC**2
    dof = 3 * int(np.sum(seen.sum(axis=1) - 1)) - right.size
    return Misalignments(
        heads=heads,
        reference=reference,
        correction_arcsec=x[0] * ARCSEC,
        drift_arcsec_c=(x[1] if len(x) > 1 else np.zeros_like(x[0])) * ARCSEC,
        covariance=full,
        temperature_c=mean_c,
        test=HeadTest(float(np.einsum("khi,khi->", apart, residual)), dof),
    )


def _powers(temperature_c: FloatArray | None, size: int) -> tuple[FloatArray, float]:
    """What multiplies corrections and drifts in every frame, (K, 1) or (K, 2), and the mean
    temperature.
    """
    if temperature_c is None:
        return np.ones((size, 1)), float("nan")
    warmth = np.asarray(temperature_c, dtype=float)
    good = warmth.shape == (size,) and bool(np.isfinite(warmth).all())
    require(
        HeadError,
        (good, f"temperature_c has shape {warmth.shape}: give a number for each of {size} frames."),
        (good and np.ptp(warmth) > 0.0, "temperature_c never changes: leave it out."),
    )
    mean = float(warmth.mean())
    return np.column_stack([np.ones(size), warmth - mean]), mean


def _between(rotations: FloatArray, cov: FloatArray) -> FloatArray:
    """Information (K, H, 3, H, 3) on turns of the body by each head, with its attitude
    eliminated.
    """
    weights, fused = body_weights(rotations, cov)
    alone = np.einsum("ha,ij->hiaj", np.eye(weights.shape[1]), np.eye(3))
    between: FloatArray = np.einsum(
        "kij,khjl,khlam->khiam",
        np.linalg.inv(fused),
        weights,
        alone - weights[:, None].swapaxes(2, 3),
    )
    return between
