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

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.attitude.rotations import quaternion_to_rotation
from starcal_uq.core.display import Shown
from starcal_uq.core.formatting import plus_minus
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.types import FloatArray
from starcal_uq.diagnostics.beside import (
    Freed,
    by_frame,
    effects_beside,
    has_effects,
    without_effects,
)
from starcal_uq.diagnostics.noise_tests import NoiseSums, noise_weights
from starcal_uq.diagnostics.pattern import Fit, Pattern, frame_covariance
from starcal_uq.diagnostics.residuals import heard, of_heard
from starcal_uq.estimation.noise_model import (
    axis_noise,
    axis_noise_beside,
    fit_noise,
    sigma_ratios,
)
from starcal_uq.estimation.weights import weighed
from starcal_uq.likelihood.effect_sums import EffectSums
from starcal_uq.likelihood.effects import Effect
from starcal_uq.likelihood.elimination import products_by_frame
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.noise_model import NoiseModel, noise_model_of
from starcal_uq.likelihood.shapes import (
    FRAME_BY_FRAME,
    MAX_CELLS,
    Shape,
    View,
    frame_shapes,
    shapes,
)
from starcal_uq.maths.intervals import holm
from starcal_uq.maths.linear import scaled_inverse, without_first
from starcal_uq.observations.frames import StarFrames

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

# Directions of which the fit absorbs all but this share of the square are not there to be tested.
_ABSORBED = 1e-8
_STARS_AT_ONCE = 10_000
_LEAST_DOF = 10
# Frames with less than one degree of freedom have no noise of their own to compare.
_LEAST_FRAMES, _LEAST_FRAME_DOF = 3, 1.0
_NOISE_ROUNDS = 3
# Square of a scale that is none, in units of the noise and of the columns.
_FREE = 1e10
# Level of all tests together, of the verdict's 5 % for all of its checks.
ALPHA = 0.01
POWER = 0.9


@dataclass(frozen=True)
class Amplitude:
    """The amplitude of one shape that the residuals ask for.

    Attributes
    ----------
    name, unit : str
        Name and unit.
    value, sigma : float
        Estimate and standard error.
    """

    name: str
    unit: str
    value: float
    sigma: float

    def __str__(self) -> str:
        return f"{self.name} {plus_minus(self.value, self.sigma)} {self.unit}"


@dataclass(frozen=True)
class MisfitTest:
    """One test.

    Attributes
    ----------
    name, against : str
        Pattern that it looks for, and the quantity that the residuals are held against.
    statistic : float
        F, or the standard normal z of a test for unequal noise.
    dof, dof_residual : int
        Degrees of freedom of F; `dof` is 0 for z.
    p_value : float
        Probability of a statistic at least this large if the model holds.
    p_holm : float
        p-value corrected for the number of tests (Holm 1979).
    size_px : float
        Root mean square per axis of the pattern found, its noise taken off, px; NaN for unequal
        noise.
    visible : float
        Share of the squared shapes that attitudes and parameters do not absorb; NaN for unequal
        noise.
    amplitudes : tuple of Amplitude
        Amplitudes, where they mean something by themselves.
    moved_sigma : float
        Largest change of a parameter if the shapes were fitted too, in its standard deviations; NaN
        where nothing is fitted.
    moved_name : str
        That parameter.
    moved_std : float
        Standard error of that change, in the same unit: large where shapes can hardly be separated
        from the parameter.
    detectable_px : float
        Root mean square per axis of a pattern that the test finds nine times in ten, at level ALPHA
        of all tests together, px; NaN for unequal noise.
    """

    name: str
    against: str
    statistic: float
    dof: int
    dof_residual: int
    p_value: float
    p_holm: float
    size_px: float
    visible: float
    amplitudes: tuple[Amplitude, ...] = ()
    moved_sigma: float = float("nan")
    moved_name: str = ""
    detectable_px: float = float("nan")
    moved_std: float = float("nan")

    @property
    def is_of_noise(self) -> bool:
        """Whether it looks for unequal noise; otherwise for a pattern."""
        return self.dof == 0


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
    pattern : Pattern or None
        What the tests found, fitted; of no shapes where they found nothing. None of an earlier
        version.
    """

    tests: tuple[MisfitTest, ...]
    sigma: float
    n_stars: int
    n_frames: int
    uneven: UnevenNoise | None = None
    pattern: Pattern | None = None

    @property
    def p_value(self) -> float:
        """Overall p-value: the smallest after Holm's correction. Overlap of the tests makes it err
        to the safe side.
        """
        return min((test.p_holm for test in self.tests), default=1.0)

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


@one_thread()
def misfit_tests(obs: Observations, cal: Calibration, *, max_cells: int = MAX_CELLS) -> Misfit:
    """Test the residuals of a calibration for unexplained structure.

    Parameters
    ----------
    obs, cal
        The data and the estimate made from them (by the marginal likelihood: the residuals of stage
        3 alone are not at its optimum, and the tests then include that).
    max_cells : int
        Largest number of field cells along the longer side.

    Returns
    -------
    Misfit
        With a false-alarm rate that is the nominal one for each test, and at most that for all of
        them together. Of an estimate with Student-t tails it is about the stars within 4.5 sigma.
    """
    from scipy.special import ndtr

    obs = weighed(obs, cal)
    left_out = tuple(np.flatnonzero(~heard(obs, cal)).tolist())
    obs, cal = of_heard(obs, cal)
    families = shapes(obs, cal.camera, max_cells=max_cells)
    sums = _Sums(obs, cal, families)
    tests = [test for test in (sums.family(family) for family in families) if test is not None]
    if (test := sums.frame_by_frame()) is not None:
        tests.append(test)
    of_noise = [
        (f"noise that changes with {name}", name, z, p)
        for name, z, p in sums.noise.tests(*(sums.freed or sums.independent), sums.noise_dof)
        if sums.noise_dof >= _LEAST_DOF
    ]
    if (frames := sums.noise_by_frame()) is not None:
        of_noise.append(("noise that differs from frame to frame", "frame", *frames))
    if has_effects(cal):
        free = Freed.of(obs, cal, axes=False)
        axes = axis_noise_beside(free.own.frames, free.own.columns, free.h, free.e, free.dof)
    else:
        axes = axis_noise(MarginalLikelihood(obs, cal.camera.distortion), cal.theta)
    names = "noise that differs between the axes", "noise whose axes correlate"
    for name, z in zip(names, axes.z(noise_model_of(cal)), strict=True):
        of_noise.append((name, "axis", z, float(2.0 * ndtr(-abs(z)))))
    nothing = float("nan")
    tests += [
        MisfitTest(name, against, z, 0, sums.noise_dof, p, 1.0, nothing, nothing)
        for name, against, z, p in of_noise
    ]
    corrected = holm([test.p_value for test in tests])
    unit = np.sqrt(sums.rss / sums.dof / (2.0 * obs.n_stars)) * sums.noise_px
    tests = [
        replace(
            test, p_holm=float(p), detectable_px=float(unit * _detectable(test, ALPHA / len(tests)))
        )
        for test, p in zip(tests, corrected, strict=True)
    ]
    uneven = None
    if any(test.is_of_noise and test.p_holm < ALPHA for test in tests) and cal.noise_model is None:
        clean = without_effects(obs, cal)
        model, _ = fit_noise(clean, cal.camera, rounds=_NOISE_ROUNDS)
        uneven = UnevenNoise(
            model, cal.parameter_names, sigma_ratios(clean, cal.camera, model, cal.sigma)
        )
    found = [test.name for test in tests if test.dof > 0 and test.p_holm < ALPHA]
    pattern = sums.pattern(found, ALPHA / len(tests))
    pattern = replace(pattern, n_frames=obs.n_frames, max_cells=max_cells, left_out=left_out)
    if FRAME_BY_FRAME in pattern.families:
        clean = without_effects(obs, cal)
        pattern = replace(pattern, frame_covariance=frame_covariance(pattern, families, clean, cal))
    sigma = float(np.sqrt(sums.rss / sums.dof))
    return Misfit(tuple(tests), sigma, obs.n_stars, obs.n_frames, uneven, pattern)


def _detectable(test: MisfitTest, level: float) -> float:
    """Root of the noncentrality at which an F test of this level has its power; NaN for a test for
    unequal noise.
    """
    from scipy.special import fdtri, ncfdtrinc

    if test.dof == 0:
        return float("nan")
    limit = fdtri(test.dof, test.dof_residual, 1.0 - level)
    return float(np.sqrt(ncfdtrinc(test.dof, test.dof_residual, 1.0 - POWER, limit)))


@dataclass(frozen=True)
class _Columns:
    """Whitened columns of some stars, the last of them the two axes of cells of the field, which
    are zero but for few stars.

    `dense` (d, 2, n) are the others; `cells` (q - d, 2 n) is sparse.
    """

    frames: StarFrames
    dense: FloatArray
    cells: Any

    @classmethod
    def of(cls, families: Sequence[Shape], view: View) -> _Columns:
        from scipy.sparse import csr_array

        *others, last = families
        frames = view.part.frames
        dense = np.concatenate([family.columns(view) for family in others])
        frames.whiten(dense)
        assert last.cell is not None
        cell = last.cell(view)
        # Shifts of every star along each axis.
        shifts = np.repeat(np.eye(2)[:, :, None], len(cell), axis=2)
        frames.whiten(shifts)
        rows, stars = (
            2 * cell + np.arange(2)[:, None, None],
            np.arange(2 * len(cell)).reshape(2, -1),
        )
        place = np.broadcast_arrays(rows, stars)
        cells = csr_array(
            (shifts.ravel(), tuple(index.ravel() for index in place)),
            shape=(last.size, stars.size),
        )
        cells.eliminate_zeros()
        return cls(frames, dense, cells)

    def all(self) -> FloatArray:
        """Every column (q, 2, n)."""
        return np.concatenate([self.dense, self.cells.toarray().reshape(-1, *self.dense.shape[1:])])

    def inner(self) -> FloatArray:
        """Products among themselves."""
        across = self.across(self.dense)
        d, q = len(self.dense), len(across)
        found = np.empty((q, q))
        found[:, :d], found[:d] = across, across.T
        found[d:, d:] = (self.cells @ self.cells.T).toarray()
        return found

    def across(self, columns: FloatArray) -> FloatArray:
        """Products (q, m) with columns (m, 2, n)."""
        flat = columns.reshape(len(columns), -1).T
        return np.concatenate([self.dense.reshape(len(self.dense), -1) @ flat, self.cells @ flat])

    def by_frame(self, few: FloatArray) -> FloatArray:
        """Products (i, q, K) with few columns (i, 2, n) over the stars of each frame."""
        from scipy.sparse import csr_array

        n, k = 2 * self.frames.n_stars, self.frames.n_frames
        frame = np.tile(np.repeat(np.arange(k), self.frames.sizes), 2)
        found = []
        for column in few:
            spread = csr_array((column.ravel(), frame, np.arange(n + 1)), shape=(n, k))
            of_cells = (self.cells @ spread).toarray()
            found.append(
                np.concatenate([_frame_products(self.frames, column, self.dense), of_cells])
            )
        return np.stack(found)


def _frame_products(frames: StarFrames, column: FloatArray, many: FloatArray) -> FloatArray:
    """Products (q, K) of a column (2, n) with many (q, 2, n) over the stars of each frame."""
    product = many[:, 0] * column[0]
    product += many[:, 1] * column[1]
    return frames.sum(product)


class _Sums(Fit):
    """Sums over all stars from which every test follows; the table is visited once, some frames at
    a time.

    Where there are effects, `gram` is weighted by them. `plain` is of the parameters and the
    residuals; beside effects it is that part of `gram`, and noise is that of residuals for which
    they are free.
    """

    def __init__(self, obs: Observations, cal: Calibration, families: tuple[Shape, ...]) -> None:
        likelihood = MarginalLikelihood(obs, cal.camera.distortion, axes=True)
        p, theta = len(cal.theta), cal.theta
        super().__init__(families, p, likelihood.dof - p)
        self.names, self.n_stars = cal.parameter_names, obs.n_stars
        self.noise = NoiseSums(noise_weights(obs, cal.camera), p)
        self.noise_dof = self.dof
        # What `independent` is of residuals for which effects are free, where there are any
        self.freed: tuple[FloatArray, FloatArray, float] | None = None
        self.noise_px = 1.0 if obs.sigma_px is None else float(np.sqrt(np.mean(obs.sigma_px**2)))
        self.plain, self.own = np.zeros((p + 1, p + 1)), frame_shapes(cal.camera)
        # Sums of squares of the frames, degrees of freedom that attitudes leave them, and their
        # normal matrices.
        self.frames: list[tuple[FloatArray, FloatArray, FloatArray]] = []
        rotations = quaternion_to_rotation(cal.quaternions)
        effects, sums = effects_beside(obs, cal), None
        if effects:
            held = {effect.name for effect in effects}
            frame = Effect("frame", "frame", self.own, np.ones(3))
            every = effects if "frame" in held else [*effects, frame]
            sums = EffectSums(every, theta, cal.sigma)
        for part, state, rows in likelihood.pieces(theta, rotations, _STARS_AT_ONCE):
            fitted, columns, view = self._add(part, state, theta, rows)
            if sums is not None:
                every_one = np.concatenate([fitted, part.project_out(state, columns.all())])
                own = sums.add(part, state, every_one, rows).frame[-3:]
                if "frame" not in held:
                    self.block_rank += int(by_frame(part.frames, own)[1].sum())
                continue
            flat = fitted.reshape(p + 1, -1)
            self.plain += flat @ flat.T
            self._add_blocks(part, state, view, fitted, columns)
            h, e = fitted[:p], fitted[p]
            self.noise.add(part.attitudes(state), h, e, rows)
            matrices = products_by_frame(part.frames, h, h)
            squares = part.frames.sum(np.sum(e**2, axis=0))
            self.frames.append((squares, np.asarray(2.0 * part.frames.sizes - 3.0), matrices))
        if sums is not None:
            self._with_effects(sums, obs, cal)

    def _with_effects(self, sums: EffectSums, obs: Observations, cal: Calibration) -> None:
        """Weigh everything by the effects of a calibration, and take them for free where the noise
        is looked at.
        """
        assert cal.effects is not None
        ratio, p = cal.effects.ratio(cal.sigma), self.p
        self.before, self.gram = self.gram, sums.solved(ratio).gram
        if "frame" not in ratio:
            size = np.mean(np.einsum("kaa->ka", sums.total.inner.frame[:, -3:, -3:]))
            self.blocks = self.gram - sums.solved(ratio | {"frame": _FREE / float(size)}).gram
        self.plain = self.gram[: p + 1, : p + 1]
        free = Freed.of(obs, cal, axes=True)
        frames, h, e = free.own.frames, free.h, free.e
        self.noise, self.noise_dof = NoiseSums(self.noise.weights, len(h)), free.dof
        self.noise.add(free.own, h, e, slice(None))
        self.freed = np.eye(len(h)), np.eye(len(h)), float(np.sum(e**2))
        squares = frames.sum(np.sum(e**2, axis=0))
        self.frames = [(squares, free.frame_dof, products_by_frame(frames, h, h))]

    def _add(
        self, part: MarginalLikelihood, state: Any, theta: FloatArray, rows: slice
    ) -> tuple[FloatArray, _Columns, View]:
        """Add some frames: parameters and residuals, attitudes projected out, and all columns, as
        they are.

        A product of columns after projection is that before, less the products of what rotations of
        the frames make of both: nothing of the size of the many columns is written for it.
        """
        view = View.of(part, state, theta, rows)
        columns = _Columns.of(self.families, view)
        h = view.parameter_columns.copy()
        part.frames.whiten(h)
        own = np.concatenate([h, state.e[None]])
        fitted = part.project_out(state, own)
        n, flat = len(own), fitted.reshape(len(own), -1)
        inner, across = columns.inner(), columns.across(fitted)
        self.raw[:n] += np.sum(own**2, axis=(1, 2))
        self.raw[n:] += np.diag(inner)
        self.inner += inner
        turned = columns.by_frame(state.attitude)
        answer = sum(turned[i][:, None] * state.inverse[i] for i in range(3))
        self.gram[:n, :n] += flat @ flat.T
        self.gram[n:, :n] += across
        self.gram[:n, n:] += across.T
        self.gram[n:, n:] += inner - np.tensordot(
            np.moveaxis(turned, 0, 1), answer, ((1, 2), (1, 2))
        )
        return fitted, columns, view

    def _add_blocks(
        self, part: MarginalLikelihood, state: Any, view: View, fitted: FloatArray, others: _Columns
    ) -> None:
        """Scale and quadrupole of every frame by itself: three columns per frame, which no other
        frame sees.
        """
        frames = part.frames
        columns = self.own.columns(view)
        frames.whiten(columns)
        raw = np.sqrt(frames.sum(np.sum(columns**2, axis=1)))
        columns = part.project_out(state, columns / frames.spread(raw)[:, None])
        gram = products_by_frame(frames, columns, columns)
        values, vectors = np.linalg.eigh(gram)
        kept = values > _ABSORBED
        root = vectors * np.where(kept, 1.0 / np.sqrt(np.where(kept, values, 1.0)), 0.0)[:, None, :]
        # Attitudes are out of these, and so out of their products with anything.
        with_fitted = np.stack([_frame_products(frames, column, fitted) for column in columns])
        with_all = np.concatenate([with_fitted, others.by_frame(columns)], axis=1)
        explained = np.einsum("kab,ajk->kbj", root, with_all).reshape(-1, with_all.shape[1])
        self.blocks += explained.T @ explained
        self.block_rank += int(np.count_nonzero(kept))

    @cached_property
    def projection(self) -> FloatArray:
        """Inverse of the Gram matrix of the parameters, attitudes removed."""
        return scaled_inverse(self.gram[: self.p, : self.p])

    @property
    def rss(self) -> float:
        """Sum of squared residuals, what little the parameters could still explain taken off."""
        return float(self.alone[0][0, 0])

    @cached_property
    def independent(self) -> tuple[FloatArray, FloatArray, float]:
        """Gram matrix of the parameters, its inverse, and `rss`, of residuals that are
        independent.
        """
        matrix, slope = self.plain[: self.p, : self.p], self.plain[: self.p, self.p]
        inverse = scaled_inverse(matrix)
        return matrix, inverse, float(self.plain[self.p, self.p] - slope @ inverse @ slope)

    def family(self, family: Shape) -> MisfitTest | None:
        """The test of one family; None where nothing of it is left, or too few data."""
        at, (system, _) = self.places[family.name], self.alone
        norm, present = self.norms(at), np.count_nonzero(self.raw[self.p + 1 :][at])
        cross = self.gram[self.p + 1 :, : self.p][at]
        slope, left = system[1:, 0][at] / norm, system[1:, 1:][at, at] / np.outer(norm, norm)
        values, vectors = self.seen(left, at)
        rank = len(values)
        if rank == 0 or self.dof - rank < _LEAST_DOF:
            return None
        scores = vectors.T @ slope
        explained = float(np.sum(scores**2 / values))
        test = self._f_test(family.name, family.against, explained, rank, self.rss)
        visible = float(np.trace(left) / max(present, 1))
        # What fitting the shapes takes from the parameters, in units of their standard deviations.
        fitted = vectors @ (scores / values) / norm
        unit = np.sqrt(np.diag(self.projection) * self.rss / self.dof)
        moved = np.abs(self.projection @ cross.T @ fitted) / unit
        worst = int(np.argmax(moved))
        variance = (self.rss - explained) / (self.dof - rank)
        turned = self.projection[worst] @ (cross / norm[:, None]).T @ (vectors / np.sqrt(values))
        error = float(np.sqrt(variance) * np.linalg.norm(turned) / unit[worst])
        amplitudes: tuple[Amplitude, ...] = ()
        if family.labels and rank == family.size:
            inverse = (vectors / values) @ vectors.T
            unit = np.array(family.per_amplitude) / norm
            best, errors = inverse @ slope * unit, np.sqrt(variance * np.diag(inverse)) * unit
            amplitudes = tuple(
                Amplitude(name, u, float(value), float(sigma))
                for (name, u), value, sigma in zip(family.labels, best, errors, strict=True)
            )
        largest, name = float(moved[worst]), self.names[worst]
        test = replace(test, visible=visible, amplitudes=amplitudes)
        return replace(test, moved_sigma=largest, moved_name=name, moved_std=error)

    def frame_by_frame(self) -> MisfitTest | None:
        """Does scale or shape change from frame to frame?"""
        (matrix, _, rss), size = self.independent, self.p + 1
        left, kept = without_first(
            self.plain - self.blocks[:size, :size],
            self.p,
            _ABSORBED,
            1.0 / np.sqrt(np.diag(matrix)),
        )
        rank = self.block_rank + kept - self.p
        if rank <= 0 or self.dof - rank < _LEAST_DOF:
            return None
        return self._f_test(FRAME_BY_FRAME, "frame", rss - float(left[0, 0]), rank, rss)

    def noise_by_frame(self) -> tuple[float, float] | None:
        """Normal z and p-value of Bartlett's test that all frames have one noise; None for too few
        frames.

        With d_k degrees of freedom of the frames' sums of squares S_k, nu in all, the statistic is
        T = nu log(S / nu) - sum d_k log(S_k / d_k). Shares of S are independent of S, so that mean
        and variance of T follow exactly from those of logarithms of chi-squares; T is then taken as
        gamma-distributed. Many coefficients of effects that frames share couple their sums: mean
        and variance are then those of independent ones times what that does to them to first order.
        """
        from scipy.special import digamma, gammaincc, ndtri, polygamma

        squares, dof, matrices = (
            np.concatenate(column) for column in zip(*self.frames, strict=True)
        )
        dof = dof - np.einsum("kab,ba->k", matrices, (self.freed or self.independent)[1])
        nu = float(dof.sum())
        if (
            len(dof) < _LEAST_FRAMES
            or nu < _LEAST_DOF
            or dof.min() < _LEAST_FRAME_DOF
            or squares.min() <= 0.0
        ):
            return None
        found = nu * np.log(squares.sum() / nu) - np.sum(dof * np.log(squares / dof))
        mean = nu * (digamma(nu / 2) - np.log(nu / 2)) - np.sum(
            dof * (digamma(dof / 2) - np.log(dof / 2))
        )
        variance = np.sum(dof**2 * polygamma(1, dof / 2)) - nu**2 * float(polygamma(1, nu / 2))
        if self.freed is not None:
            by_mean, by_variance = _coupled(matrices, dof)
            mean, variance = mean * by_mean, variance * by_variance
        p = float(gammaincc(mean**2 / variance, found * mean / variance))
        return float(-ndtri(np.clip(p, 1e-300, 1.0 - 1e-16))), p

    def _f_test(
        self, name: str, against: str, explained: float, rank: int, rss: float
    ) -> MisfitTest:
        from scipy.special import fdtrc

        rest = self.dof - rank
        variance = (rss - explained) / rest
        statistic = float(max(explained, 0.0) / rank / variance)
        excess = max(explained - rank * variance, 0.0) / (2.0 * self.n_stars)
        p = float(fdtrc(rank, rest, statistic))
        return MisfitTest(
            name,
            against,
            statistic,
            rank,
            rest,
            p,
            1.0,
            float(np.sqrt(excess)) * self.noise_px,
            float("nan"),
        )


def _coupled(matrices: FloatArray, dof: FloatArray) -> tuple[float, float]:
    """Factors on mean and variance of Bartlett's statistic where frames share what is fitted.

    `matrices` (K, r, r): products over each frame of what is orthonormal over all. `dof` (K,):
    degrees of freedom of the frames' sums of squares, whose covariance is twice G: T is near
    ``s^T K s / 2`` with s their departures from `dof` and ``K = diag(1 / d) - 1 1^T / nu``.
    """
    among = np.einsum("kab,lab->kl", matrices, matrices)
    among += np.diag(dof - np.einsum("kaa->k", matrices))
    by = among / dof[:, None] - among.sum(axis=0) / dof.sum()
    free = len(dof) - 1.0
    return float(np.trace(by)) / free, float(np.sum(by * by.T)) / free
