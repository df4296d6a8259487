"""Calibrated tests for structure in the residuals: model error is in no posterior, so it must be
looked for.

Residuals after the fit are ``e = (I - P) epsilon`` with P the projector on what the attitudes and
the parameters can reproduce. A family of shapes C (pixel shifts that some model error would cause)
is projected the same way; the part of the sum of squares that the remainder explains then follows
an F distribution exactly, whatever the geometry:

    F = (e^T Q e / q) / (e^T (I - Q) e / (d - q)),   Q the projector on (I - P) C, of rank q.

It is the Lagrange-multiplier (score) test of the model extended by these shapes: nothing is fitted
again. Tests for unequal noise compare the residuals' weighted and unweighted sums of squares with
their exact mean and variance.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from starcal_uq.core.display import Shown
from starcal_uq.core.settings import Seed, bounded, seed_of
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.types import FloatArray
from starcal_uq.diagnostics.beside import Freed, without_effects
from starcal_uq.diagnostics.misfit_test import LEAST_DOF, MisfitTest
from starcal_uq.diagnostics.noise_tests import NoiseSums, noise_weights
from starcal_uq.diagnostics.residuals import of_heard, of_some_frames
from starcal_uq.diagnostics.shape_sums import ShapeSums
from starcal_uq.estimation.noise_model import AxisSums, fit_noise, sigma_ratios
from starcal_uq.estimation.weights import weighed
from starcal_uq.likelihood.noise_model import NoiseModel, noise_model_of
from starcal_uq.likelihood.shapes import (
    MAX_CELLS,
    shapes,
)
from starcal_uq.maths.intervals import holm

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

_NOISE_ROUNDS = 3
# Level of all tests together, of the verdict's 5 % for all of its checks.
ALPHA = 0.01
POWER = 0.9


@dataclass(frozen=True, eq=False)
class UnevenNoise:
    """How the noise varies that one noise for all stars was fitted to.

    Attributes
    ----------
    model : NoiseModel
        Fitted variance.
    parameter_names : tuple of str
        Camera parameters.
    ratios : (p,) array
        Real over stated standard deviation of each.
    """

    model: NoiseModel
    parameter_names: tuple[str, ...]
    ratios: FloatArray


@dataclass(frozen=True)
class Misfit(Shown):
    """All tests for unexplained structure.

    Attributes
    ----------
    tests : tuple of MisfitTest
        In reading order.
    sigma : float
        Noise that the tests are relative to, in units of the calibration's.
    n_stars, n_frames : int
        Size of the data.
    uneven : UnevenNoise or None
        How the noise varies, and what that does to the stated sigmas; None where no test found that
        it does, or where the calibration knows it already.
    """

    tests: tuple[MisfitTest, ...]
    sigma: float
    n_stars: int
    n_frames: int
    uneven: UnevenNoise | None = None

    GONE: ClassVar = ("pattern",)

    @property
    def p_value(self) -> float:
        """Overall p-value: the smallest after Holm's correction; conservative, because the tests
        overlap.
        """
        return min((test.p_holm for test in self.tests), default=1.0)

    @property
    def n_asked(self) -> int:
        """Frames that tests for unequal noise, and for frames that differ, are made from."""
        return round(min((test.share for test in self.tests), default=1.0) * self.n_frames)

    def found(self, alpha: float = ALPHA) -> tuple[MisfitTest, ...]:
        """Tests that reject at this level after correction, the strongest first."""
        return tuple(
            sorted(
                (t for t in self.tests if t.p_holm < alpha), key=lambda t: (t.p_holm, -t.size_px)
            )
        )

    def to_dataframe(self) -> pd.DataFrame:
        """One row per test; amplitudes as text."""
        import pandas as pd

        rows = [
            {**asdict(t), "amplitudes": "; ".join(str(a) for a in t.amplitudes)} for t in self.tests
        ]
        return pd.DataFrame(rows).rename(columns={"name": "test"})


@bounded
@one_thread()
def misfit_tests(
    obs: Observations,
    cal: Calibration,
    *,
    max_cells: int = MAX_CELLS,
    most_frames: int | None = None,
    seed: Seed = 0,
) -> Misfit:
    """Test the residuals of a calibration for unexplained structure.

    Parameters
    ----------
    obs, cal
        The data and the estimate made from them (by the marginal likelihood: the residuals of stage
        3 alone are not at its optimum, and the tests then include that).
    max_cells : int
        Largest number of field cells along the longer side.
    most_frames : int, optional
        Most frames that the tests for unequal noise and for frames that differ use, and the
        covariance of the shapes in the other tests: a sample where there are more. All frames by
        default, and of a calibration with effects.
    seed : int
        Seed of the choice of these frames.

    Returns
    -------
    Misfit
        With a false-alarm rate that is the nominal one for each test, and at most that for all of
        them together. Of an estimate with Student-t tails it is about the stars within 4.5 sigma.
    """
    from scipy.special import ndtr

    obs = weighed(obs, cal)
    obs, cal = of_heard(obs, cal)
    families = shapes(obs, cal.camera, max_cells=max_cells)
    some, own, of_frames = of_some_frames(obs, cal, most_frames, seed_of(seed))
    places = np.flatnonzero(np.isin(obs.frame, some.frame_ids)) if of_frames else None
    sums, share = ShapeSums(some, own, families, places), some.n_frames / obs.n_frames
    every = sums.for_all(obs, cal) if of_frames else sums
    tests = [test for test in (every.family(family) for family in families) if test is not None]
    if (test := sums.frame_by_frame()) is not None:
        tests.append(replace(test, share=share))
    gram, weights = sums.gram[: sums.p + 1, : sums.p + 1], noise_weights(some, cal.camera)
    noise = NoiseSums(Freed.pieces(some, own, gram), weights, bool(cal.known_effects.fitted))
    of_noise = []
    if noise.dof >= LEAST_DOF:
        of_noise = [(f"noise that changes with {name}", name, z, p) for name, z, p in noise.tests()]
    if (frames := noise.by_frame()) is not None:
        of_noise.append(("noise that differs from frame to frame", "frame", *frames))
    axes = noise.axes
    if some.noise_axes is not None:
        alike, axes = Freed.of(replace(some, noise_axes=None), own), AxisSums()
        axes.add(alike.frames, alike.a, alike.h, alike.e)
    names = "noise that differs between the axes", "noise whose axes correlate"
    known = noise_model_of(cal)
    for name, z in zip(names, axes.noise(noise.dof).z(known), strict=True):
        of_noise.append((name, "axis", z, float(2.0 * ndtr(-abs(z)))))
    nothing = float("nan")
    tests += [
        MisfitTest(name, against, z, 0, noise.dof, p, 1.0, nothing, nothing, share=share)
        for name, against, z, p in of_noise
    ]
    corrected = holm([test.p_value for test in tests])
    tests = [
        replace(
            test,
            p_holm=float(p),
            detectable_px=test.detectable_px * _detectable(test, ALPHA / len(tests)),
        )
        for test, p in zip(tests, corrected, strict=True)
    ]
    uneven = None
    if any(test.is_of_noise and test.p_holm < ALPHA for test in tests) and cal.noise_model is None:
        clean = without_effects(some, own)
        model, _ = fit_noise(clean, cal.camera, rounds=_NOISE_ROUNDS)
        uneven = UnevenNoise(
            model, cal.parameter_names, sigma_ratios(clean, cal.camera, model, cal.sigma)
        )
    sigma = float(np.sqrt(every.rss / every.dof))
    return Misfit(tuple(tests), sigma, obs.n_stars, obs.n_frames, uneven)


def _detectable(test: MisfitTest, level: float) -> float:
    """Root of the noncentrality at which an F test of this level has its power; NaN for a test for
    unequal noise.
    """
    from scipy.special import fdtri, ncfdtrinc

    if test.dof == 0:
        return float("nan")
    limit = fdtri(test.dof, test.dof_residual, 1.0 - level)
    return float(np.sqrt(ncfdtrinc(test.dof, test.dof_residual, 1.0 - POWER, limit)))
