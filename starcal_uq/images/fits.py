"""Fits of a Gaussian star image, integrated over pixels, to the pixels around many detections at
once.

Each star has position and flux; weights are the inverse variances that the fitted star itself
implies, iterated. This is maximum likelihood to first order, so that its scatter is the Cramer-Rao
bound, and it has no pixel-phase error because the integration over pixels is in the model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from starcal_uq.core.types import AnyDict, BoolArray, FloatArray, IntArray, floats
from starcal_uq.images.background import PreparedImage
from starcal_uq.maths.intervals import median_of

_ITERATIONS = 10
# A star is left alone when its step is this small, in standard deviations, or in px, parts of its
# flux and log width.
_TOLERANCE_SIGMAS, _TOLERANCE = 1e-2, 1e-4
# So many may be left that have not settled: they swing at the limit of detection, by less than they
# are known.
_LEFT_MOVING = 0.02
_SQRT_2PI = float(np.sqrt(2.0 * np.pi))
_NO_PAIRS = np.empty((0, 2), dtype=np.int64)


@dataclass(frozen=True)
class Stamps:
    """Squares of pixels (m, m, n), rows first, around n positions, from first column `x0` and row
    `y0` (n,) on.

    Stars are along the last axis of all arrays here, so that NumPy's inner loops run over stars and
    not over a few pixels. `counts` are above the background, 0 where not `fine`; `good` is 1 for
    pixels to use and 0 for others, `fine` are those that are good, or no loss: those between, in a
    mosaic of colours, hold the mean of their neighbours. `variance` (n,) is that of the background,
    counts squared; `counts_per_e` the inverse gain, and 0 leaves photon noise of the star away.
    """

    x0: IntArray
    y0: IntArray
    counts: FloatArray
    good: FloatArray
    fine: BoolArray
    variance: FloatArray
    counts_per_e: float = 0.0

    def subset(self, chosen: Any) -> Stamps:
        """The stamps of some of the stars."""
        changes: AnyDict = {}
        for name in ("x0", "y0", "counts", "good", "fine", "variance"):
            # Indexing would put the stars first in memory.
            changes[name] = getattr(self, name).take(chosen, axis=-1)
        return replace(self, **changes)

    def whole_within(self, x: FloatArray, y: FloatArray, radius: FloatArray) -> BoolArray:
        """Whether all pixels (n,) within a radius of places in the image, px, are good or no loss."""
        whole: BoolArray = np.all(self.fine, axis=(0, 1))
        cut, grid = np.flatnonzero(~whole), np.arange(len(self.counts))[:, None]
        u, v = grid + (self.x0 - x)[cut], grid + (self.y0 - y)[cut]
        far = u**2 + v[:, None] ** 2 > radius[cut] ** 2
        whole[cut] = (self.fine[..., cut] | far).all((0, 1))
        return whole


@dataclass(frozen=True)
class StarFit:
    """Result of `fit_stars` for n stars: positions in the image, px, and fluxes, counts.

    `covariance` (n, 3, 3) of (x, y, flux) is infinite where the pixels do not determine the star;
    `sigma_px` (n,) is the width of the star image, before integration over pixels; `weight` (m, m,
    n) the inverse variance of each pixel, 0 where it was not used; `residual` (m, m, n) counts
    minus the other stars of the field that reach into the stamp.
    """

    x_px: FloatArray
    y_px: FloatArray
    flux: FloatArray
    covariance: FloatArray
    sigma_px: FloatArray
    weight: FloatArray
    residual: FloatArray


def cut_stamps(frame: PreparedImage, x: FloatArray, y: FloatArray, half_px: int) -> Stamps:
    """Cut the pixels around positions; what lies outside the image or is not usable is marked as
    not good.
    """
    counts, usable, parity = frame.counts, frame.usable, frame.parity
    height, width = counts.shape
    size = 2 * half_px + 1
    x0, y0 = np.rint(x).astype(np.int64), np.rint(y).astype(np.int64)
    variance = floats(frame.noise[y0.clip(0, height - 1), x0.clip(0, width - 1)]) ** 2
    x0, y0 = x0 - half_px, y0 - half_px
    steps = np.arange(size)[:, None]
    columns, rows = x0 + steps, (y0 + steps)[:, None]
    inside = ((rows >= 0) & (rows < height)) & ((columns >= 0) & (columns < width))
    at = rows.clip(0, height - 1) * width + columns.clip(0, width - 1)
    good = inside if usable is None else inside & usable.take(at)
    fine = good if parity is None else good | (inside & ((columns + rows) % 2 != parity))
    stamp = floats(np.where(fine, counts.take(at), 0.0))
    return Stamps(x0, y0, stamp, floats(good), fine, variance, frame.counts_per_e)


def _profiles(
    stamps: Stamps, u: FloatArray, v: FloatArray, sigma: FloatArray, derivatives: int
) -> tuple[FloatArray, FloatArray]:
    """Parts of a star's light in each pixel along x and along y, and as further rows their
    `derivatives`.

    Shape (1 + derivatives, m, n) each; the first derivative is by the position, the second by the
    log width.
    """
    from scipy.special import ndtr

    n, m = len(u), len(stamps.counts)
    inverse = np.concatenate([1.0 / sigma] * 2)
    z = np.arange(-0.5, m)[:, None] - np.concatenate([u, v])
    z *= inverse
    rows = np.empty((1 + derivatives, m, 2 * n))
    part = ndtr(z)
    np.subtract(part[1:], part[:-1], out=rows[0])
    if derivatives:
        density = np.exp(-0.5 * z * z) / _SQRT_2PI
        np.subtract(density[:-1], density[1:], out=rows[1])
        rows[1] *= inverse
    if derivatives > 1:
        density *= z
        np.subtract(density[:-1], density[1:], out=rows[2])
    return rows[..., :n], rows[..., n:]


def _contracted(x: FloatArray, image: FloatArray, y: FloatArray) -> FloatArray:
    """Sums over pixels of y_a image x_b, (a, b, n), for rows (b, m, n) along x and (a, m, n) along
    y.
    """
    # The star image is a product of two profiles, so that no product with one needs all pixels of
    # all stars at once.
    return floats(np.einsum("avn,bvn->abn", y, np.einsum("vun,bun->bvn", image, x)))


def fit_stars(
    stamps: Stamps,
    x: FloatArray,
    y: FloatArray,
    sigma_px: float | FloatArray,
    *,
    pairs: IntArray = _NO_PAIRS,
    once: bool = False,
) -> StarFit:
    """Fit position and flux of each star from x, y (n,) in the image.

    `pairs` (p, 2) are stars (i, j) of which j reaches into the stamp of i; it is subtracted there.
    With `once` each star is moved once only, where the places are known.
    """
    state = _settled(stamps, x, y, sigma_px, pairs=pairs, left_moving=1.0 if once else _LEFT_MOVING)
    u, v, flux, log_sigma = state
    sigma = np.exp(log_sigma)
    others = _of_others(stamps, state, pairs, np.arange(len(x)))
    px, py = _profiles(stamps, u, v, sigma, 1)
    _, weight = _weighted(stamps, flux, px[0], py[0], others)
    inverse, determined = _solve(_normal(px, py, weight), np.eye(3)[..., None])
    # Light that was moved is flux times the way.
    some = np.where(flux == 0.0, 1.0, flux)
    inverse[:2] /= some
    inverse[:, :2] /= some
    covariance = np.where(determined & (flux != 0.0), inverse, np.inf).transpose(2, 0, 1)
    x, y, residual = u + stamps.x0, v + stamps.y0, stamps.counts - others
    return StarFit(x, y, flux, covariance, sigma, weight, residual)


def fit_widths(
    stamps: Stamps, x: FloatArray, y: FloatArray, sigma_px: FloatArray, left_moving: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Fit the width of each star as well: its position, flux and width, (n,) each.

    `left_moving` is the part of the stars that need not have settled, where a median is all that is
    wanted.
    """
    u, v, flux, log_sigma = _settled(
        stamps, x, y, sigma_px, free_sigma=True, left_moving=left_moving
    )
    return u + stamps.x0, v + stamps.y0, flux, np.exp(log_sigma)


def _settled(
    stamps: Stamps,
    x: FloatArray,
    y: FloatArray,
    sigma_px: float | FloatArray,
    *,
    free_sigma: bool = False,
    pairs: IntArray = _NO_PAIRS,
    left_moving: float = 0.0,
) -> FloatArray:
    """Places in the stamps, fluxes and logarithms of the widths, (4, n).

    A star is left alone once its own steps are small and those of the stars in its stamp.
    """
    m, _, n = stamps.counts.shape
    state = np.stack([x - stamps.x0, y - stamps.y0, np.zeros(n), np.zeros(n) + np.log(sigma_px)])
    moving, part, here, last = np.arange(n), stamps, pairs, np.zeros((2 + free_sigma, n))
    # Rows of the steps in position and width.
    shape = [0, 1, 3][: 2 + free_sigma]
    for iteration in range(_ITERATIONS):
        if iteration and len(moving) <= left_moving * n:
            break
        u, v, flux, log_sigma = state if part is stamps else state.take(moving, axis=1)
        sigma = np.exp(log_sigma)
        px, py = _profiles(part, u, v, sigma, 1 + free_sigma)
        if iteration == 0:
            # The flux is linear: start at its best value.
            weight = part.good / part.variance
            top = _contracted(px[:1], weight * part.counts, py[:1])
            state[2] = flux = _ratio(top, _contracted(px[:1] ** 2, weight, py[:1] ** 2))[0, 0]
        light = _of_others(stamps, state, here, moving) if len(here) else None
        rest, weight = _weighted(part, flux, px[0], py[0], light)
        gradient = _gradient(px, py, rest * weight)
        solution, determined = _solve(_normal(px, py, weight), gradient[:, None])
        step = np.where(determined & (flux != 0.0), solution[:, 0], 0.0)
        some = np.where(flux == 0.0, 1.0, flux)
        done = np.einsum("in,in->n", step, gradient) < _TOLERANCE_SIGMAS**2
        step[shape] /= some
        # Far from the solution the linear step overshoots.
        step[:2] /= np.maximum(np.hypot(step[0], step[1]) / (0.5 * sigma), 1.0)
        step[shape] = _to_their_end(step[shape], last, moving)
        state[:3, moving] += step[:3]
        if free_sigma:
            # NumPy's `clip` takes longer than so few numbers.
            wider = log_sigma + np.minimum(np.maximum(step[3], -0.3), 0.3)
            state[3, moving] = np.minimum(np.maximum(wider, np.log(0.15)), np.log(0.5 * m))
        step[2] /= some
        done |= np.abs(step).max(axis=0) < _TOLERANCE
        if done.any():
            still = np.zeros(n, dtype=np.bool_)
            still[moving] = ~done
            if len(pairs):
                still[pairs[still[pairs[:, 1]], 0]] = True
                here = pairs[still[pairs[:, 0]]]
            moving = np.flatnonzero(still)
            part = stamps.subset(moving)
    return state


def _to_their_end(step: FloatArray, last: FloatArray, moving: IntArray) -> FloatArray:
    """Steps (q, k) of the stars that move, which swing, as about a hot pixel, or creep, to where
    their sum will end.

    `last` (q, n) are the steps before, and become these.
    """
    before = last.take(moving, axis=1)
    size = np.einsum("qk,qk->k", before, before)
    ratio = np.einsum("qk,qk->k", step, before) / np.where(size > 0.0, size, 1.0)
    longer: FloatArray = step / (1.0 - np.minimum(np.maximum(ratio, -1.0), 0.5))
    last[:, moving] = longer
    return longer


def _weighted(
    stamps: Stamps, flux: FloatArray, px: FloatArray, py: FloatArray, others: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """What the model leaves over, and the weights that it implies, (m, m, n) each."""
    bright: FloatArray = px * (flux * py)[:, None]
    if others is not None:
        bright += others
    rest = stamps.counts - bright
    np.maximum(bright, 0.0, out=bright)
    bright *= stamps.counts_per_e
    bright += stamps.variance
    return rest, np.divide(stamps.good, bright, out=bright)


# Derivatives of a star image by x, y, flux and log width (the sum of the last two), those by shape
# over the flux: which rows of the profiles along x and along y are multiplied.
_ALONG_X, _ALONG_Y = np.array([1, 0, 0, 2, 0]), np.array([0, 1, 0, 0, 2])
# Products of two rows of a profile, and where the product of each two is among them.
_ONE, _TWO = np.array([0, 0, 1, 0, 1, 2]), np.array([0, 1, 1, 2, 2, 2])
_PRODUCT = np.array([[0, 1, 3], [1, 2, 4], [3, 4, 5]])


def _joined(terms: FloatArray) -> FloatArray:
    """Sums (p, ...) by the parameters, from those of the terms of their derivatives."""
    if len(terms) > 3:
        terms[3] += terms[4]
    return terms[:4]


def _gradient(px: FloatArray, py: FloatArray, image: FloatArray) -> FloatArray:
    """Sums (p, n) of an image (m, m, n) times the derivatives of a star image of flux 1."""
    x, y = (rows[: 2 * len(px) - 1] for rows in (_ALONG_X, _ALONG_Y))
    return _joined(_contracted(px, image, py)[y, x])


def _normal(px: FloatArray, py: FloatArray, weight: FloatArray) -> FloatArray:
    """Normal matrices (p, p, n) of these derivatives, with weights (m, m, n)."""
    one, two = (rows[: 3 * len(px) - 3] for rows in (_ONE, _TWO))
    sums = _contracted(px[one] * px[two], weight, py[one] * py[two])
    terms = 2 * len(px) - 1
    x, y = (_PRODUCT[rows[:terms, None], rows[:terms]] for rows in (_ALONG_X, _ALONG_Y))
    return _joined(_joined(sums[y, x]).transpose(1, 0, 2))


def explained(stamps: Stamps, fit: StarFit, scale: float) -> FloatArray:
    """Drop of chi squared by a star of `scale` times the width at the fitted place, shape (n,)."""
    px, py = _profiles(stamps, fit.x_px - stamps.x0, fit.y_px - stamps.y0, scale * fit.sigma_px, 0)
    projected = _contracted(px, fit.weight * fit.residual, py)[0, 0]
    return _ratio(projected * np.abs(projected), _contracted(px**2, fit.weight, py**2)[0, 0])


def _of_others(stamps: Stamps, state: FloatArray, pairs: IntArray, stars: IntArray) -> FloatArray:
    """Light (m, m, k) of other stars in the stamps of some `stars` (k,), by sorted `pairs`."""
    others = np.zeros((*stamps.counts.shape[:2], len(stars)))
    if len(pairs):
        here, there = pairs.T
        u, v, flux, log_sigma = state.take(there, axis=1)
        du, dv = stamps.x0[there] - stamps.x0[here], stamps.y0[there] - stamps.y0[here]
        px, py = _profiles(stamps, u + du, v + dv, np.exp(log_sigma), 0)
        first = np.flatnonzero(np.diff(here, prepend=-1))
        light = px[0] * (np.maximum(flux, 0.0) * py[0])[:, None]
        others[..., np.searchsorted(stars, here[first])] = np.add.reduceat(light, first, axis=2)
    return others


def _ratio(top: FloatArray, bottom: FloatArray) -> FloatArray:
    return np.divide(top, bottom, out=np.zeros_like(top), where=bottom > 0.0)


def _solve(normal: FloatArray, right: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Solutions (p, q, n) for normal matrices (p, p, n) and right sides (p, q, n), and which are
    determined, (n,).

    The determinant over the product of the diagonal, which is 1 or less, says how nearly singular
    a matrix is, whatever the units. Gauss-Jordan elimination: no pivoting is needed for positive
    definite matrices.
    """
    p, n = len(normal), normal.shape[2]
    rows, left = np.empty((p, p + right.shape[1], n)), np.ones(n)
    rows[:, :p], rows[:, p:] = normal, right
    with np.errstate(all="ignore"):
        for k in range(p):
            pivot = rows[k, k].copy()
            left *= pivot / normal[k, k]
            rows[k] /= pivot
            factor = rows[:, k].copy()
            factor[k] = 0.0
            rows -= factor[:, None] * rows[k]
    return rows[:, p:], (left > 1e-9) & np.isfinite(left)


def near_pairs(x: FloatArray, y: FloatArray, reach: float) -> IntArray:
    """Pairs (i, j), in both orders and sorted by i, of positions closer than `reach`."""
    from scipy.spatial import cKDTree

    pairs: IntArray = cKDTree(np.column_stack([x, y])).query_pairs(reach, output_type="ndarray")
    both = np.concatenate([pairs, pairs[:, ::-1]])
    return both[np.argsort(both[:, 0], kind="stable")]


def disturbed(x: FloatArray, y: FloatArray, flux: FloatArray, reach: float) -> IntArray:
    """Stars with a neighbour closer than `reach`; one a hundred times fainter moves them by less
    than the noise.
    """
    near = near_pairs(x, y, reach)
    moved: IntArray = near[flux[near[:, 1]] > 0.01 * flux[near[:, 0]], 0]
    return moved


# Wide enough to bridge the pixels of an undersampled image.
_WINDOW_SIGMA_PX = 1.5
# Stars whose second moments can be measured one by one, and how many of them it takes.
_GRADIENT_SNR, _GRADIENT_STARS = 30.0, 4
_LEAST_GRADIENT = 0.1
# A window ends where its weight is 3e-4, as SExtractor's does.
_WINDOW_SIGMAS = 4.0
_WINDOW_ITERATIONS, _WINDOW_STEP_PX, _WINDOW_STEP_SIGMAS = 16, 2e-4, 1e-2


def window_positions(
    stamps: Stamps,
    shape: tuple[int, int],
    x: FloatArray,
    y: FloatArray,
    window_px: FloatArray,
    star_px: FloatArray,
    step_px: float | FloatArray,
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Windowed centroids from positions (n,), and which are to be believed: whole windows with
    light in them.

    SExtractor's XWIN and YWIN (Bertin & Arnouts): where the first moment of the light in a Gaussian
    window (n,) around it is nought. All stars are moved at once, by steps that suit a Gaussian star
    of width `star_px` (n,): SExtractor's suit a window as wide as the star, and swing in a wider
    one. The last steps are shorter than `step_px` (n,). `stamps` of an image of this shape reach to
    where the windows end.
    """
    good = np.isfinite(x) & np.isfinite(y)
    if not len(x):
        return x, y, good
    half, moving = len(stamps.counts) // 2, np.flatnonzero(good)
    counts = stamps.counts if good.all() else stamps.counts.take(moving, axis=-1)
    steps, factor = np.arange(2 * half + 1)[:, None], 1.0 + (star_px**2 + 1.0 / 12.0) / window_px**2
    small, fall = np.zeros(len(x)) + step_px**2, -0.5 / window_px**2
    at, last = np.stack([x - stamps.x0, y - stamps.y0]), np.zeros((2, len(x)))
    for _ in range(_WINDOW_ITERATIONS):
        here = at.take(moving, axis=1)
        w = steps - here[:, None]
        rows = np.empty((2, 2, *w.shape[1:]))
        np.exp(fall[moving] * w * w, out=rows[:, 0])
        np.multiply(rows[:, 0], w, out=rows[:, 1])
        moments = _contracted(rows[0], counts, rows[1])
        light = moments[0, 0]
        lit = light > 0.0
        scale = factor[moving] / np.where(lit, light, np.inf)
        step = _to_their_end(scale * moments.reshape(4, -1)[1:3], last, moving)
        here += step
        at[:, moving] = here
        # A window that has left its square has run away.
        fine = lit & (np.abs(here - half).max(axis=0) < 2.0)
        good[moving[~fine]] = False
        on = fine & (np.einsum("qk,qk->k", step, step) > small[moving])
        if not on.any():
            break
        if not on.all():
            moving, counts = moving[on], counts.compress(on, axis=-1)
    x, y = at[0] + stamps.x0, at[1] + stamps.y0
    radius = _WINDOW_SIGMAS * window_px
    for place, size in zip((y, x), shape, strict=True):
        good &= (place - radius >= -0.5) & (place + radius <= size - 0.5)
    return x, y, good & stamps.whole_within(x, y, radius)


def windowed(frame: PreparedImage, fit: StarFit) -> StarFit:
    """`fit` with windowed centroids and their covariance for the stars that stand alone."""
    window = np.maximum(_WINDOW_SIGMA_PX, 1.2 * fit.sigma_px)
    half = int(np.ceil(_WINDOW_SIGMAS * window.max(initial=_WINDOW_SIGMA_PX)))
    stamps = cut_stamps(replace(frame, usable=None), fit.x_px, fit.y_px, half)
    steps_px = np.maximum(_WINDOW_STEP_PX, _WINDOW_STEP_SIGMAS * np.sqrt(fit.covariance[:, 0, 0]))
    x, y, whole = window_positions(
        stamps, frame.counts.shape, fit.x_px, fit.y_px, window, fit.sigma_px, steps_px
    )
    sums = window_moments(stamps, stamps.counts, x, y, window)
    light = sums[0, 0]
    variance = np.maximum(stamps.counts, 0.0)
    variance *= stamps.counts_per_e
    variance += stamps.variance
    variance *= stamps.good
    if frame.parity is not None:
        # What half of the pixels have measured counts for twice as many.
        variance *= 2.0
    # The square of the window is a narrower window.
    spread = _second_moments(window_moments(stamps, variance, x, y, window / np.sqrt(2.0)))
    use = (
        whole
        & (light > 0.0)
        & (np.hypot(x - fit.x_px, y - fit.y_px) < 1.0)
        & stamps.good.all((0, 1))
    )
    use[disturbed(fit.x_px, fit.y_px, fit.flux, 4.0 * float(window.max(initial=0.0)))] = False
    gradient = _window_gradient(sums, window, fit, use)
    noise = spread / np.where(light > 0.0, light, np.inf)[:, None, None] ** 2
    inverse = np.linalg.inv(gradient)
    covariance = fit.covariance.copy()
    covariance[use, :2, :2] = (inverse @ noise @ inverse.transpose(0, 2, 1))[use]
    x, y = np.where(use, x, fit.x_px), np.where(use, y, fit.y_px)
    return replace(fit, x_px=x, y_px=y, covariance=covariance)


def window_moments(
    stamps: Stamps, image: FloatArray, x: FloatArray, y: FloatArray, window_px: float | FloatArray
) -> FloatArray:
    """Moments of stamps (m, m, n) in Gaussian windows around positions (n,) in the image, up to the
    second along each axis: (power of v, power of u, n).
    """
    steps = np.arange(len(image))[:, None]
    w = np.stack([steps - (x - stamps.x0), steps - (y - stamps.y0)])
    rows = np.exp(-0.5 * (w / window_px) ** 2) * np.stack([np.ones_like(w), w, w * w])
    return _contracted(rows[:, 0], image, rows[:, 1])


def _second_moments(sums: FloatArray) -> FloatArray:
    """Sums of uu, uv and vv as matrices (n, 2, 2), from sums (power of v, power of u, n)."""
    return floats(sums[[0, 1, 1, 2], [2, 1, 1, 0]].T.reshape(-1, 2, 2))


def _window_gradient(
    sums: FloatArray, window: FloatArray, fit: StarFit, alone: BoolArray
) -> FloatArray:
    """How far a windowed first moment falls when its window moves on by 1 px, shape (n, 2, 2).

    The window follows the star, so that noise in the moment moves the centroid by the inverse of
    this: by a factor 2 where the window is as wide as the star (SExtractor's ERRX2WIN takes that
    for all), by hardly more than 1 where it is wide. The second moments of the light in the window
    are the median of the bright stars'; one faint star's are noise.
    """
    bright = alone & (fit.flux > _GRADIENT_SNR * np.sqrt(fit.covariance[:, 2, 2]))
    # Stars of one width, mostly all, have one answer.
    _, first, which = np.unique(fit.sigma_px, return_index=True, return_inverse=True)
    star, window = fit.sigma_px[first] ** 2 + 1.0 / 12.0, window[first]
    moments = (star * window**2 / (star + window**2))[:, None, None] * np.eye(2)
    if np.count_nonzero(bright) >= _GRADIENT_STARS:
        second = _second_moments(sums[..., bright] / sums[0, 0, bright])
        moments = np.broadcast_to(median_of(np.moveaxis(second, 0, -1)), moments.shape)
    # Light without a peak does not hold the window; the floor keeps the errors finite.
    values, axes = np.linalg.eigh(np.eye(2) - moments / window[:, None, None] ** 2)
    gradient: FloatArray = (
        axes * np.maximum(values, _LEAST_GRADIENT)[:, None, :]
    ) @ axes.transpose(0, 2, 1)
    return gradient[which]
