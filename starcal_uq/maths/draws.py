"""What draws are worth: convergence of chains, effective numbers, and Pareto-smoothed importance weights.

After Vehtari et al. (2021), "Rank-normalization, folding, and localization", for chains and Vehtari et al. (2024),
"Pareto smoothed importance sampling", for weights. The numbers are ArviZ's to rounding (a test holds them equal); they
are computed here because loading ArviZ takes a second, because it smooths one row of weights at a time, and because it
takes draws with a range below 1e-15 for constant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from starcal_uq.core.types import FloatArray

# Tail ESS is the smaller of the ESS of these two quantiles.
_TAIL = (0.05, 0.95)
# Log weights closer than this are equal for every purpose, and a Pareto tail cannot be fitted to them.
_EQUAL_WEIGHTS = 1e-9
# Weak prior of the fit of a Pareto tail: ten draws of shape 0.5.
_PRIOR_DRAWS, _PRIOR_SHAPE = 10.0, 0.5
# Rows whose tails are fitted at a time: their trial shapes stay in the processor's cache.
_ROWS = 32


@dataclass(frozen=True)
class ChainStatistics:
    """Convergence of draws in several chains.

    Attributes
    ----------
    rhat : float
        Rank-normalised split R-hat, the larger one of bulk and folded.
    ess_bulk : float
        Effective number of draws for the bulk.
    ess_tail : float
        Effective number of draws for the 5 % and 95 % quantiles, the smaller one.
    mcse_mean : float
        Monte Carlo standard error of the mean, in the unit of the draws.
    """

    rhat: float
    ess_bulk: float
    ess_tail: float
    mcse_mean: float


def chain_statistics(values: FloatArray) -> ChainStatistics:
    """Convergence of draws (chain, draw), at least four per chain; NaN where a draw is not finite."""
    values = np.asarray(values, dtype=np.float64)
    if not np.all(np.isfinite(values)):
        return ChainStatistics(*4 * (float("nan"),))
    halves = _split(values)
    bulk = _normal_scores(halves)
    folded = _normal_scores(np.abs(halves - np.median(halves)))
    return ChainStatistics(
        rhat=max(_rhat(bulk), _rhat(folded)),
        ess_bulk=_effective(bulk),
        ess_tail=min(_effective(_split((values <= q).astype(np.float64))) for q in np.quantile(values, _TAIL)),
        mcse_mean=float(np.std(values, ddof=1)) / float(np.sqrt(_effective(halves))),
    )


def _split(values: FloatArray) -> FloatArray:
    """Halves of the chains, as chains."""
    half = values.shape[1] // 2
    return np.concatenate([values[:, :half], values[:, -half:]])


def _normal_scores(values: FloatArray) -> FloatArray:
    """Normal quantiles of the ranks, ties getting their mean."""
    from scipy.special import ndtri

    flat = values.ravel()
    order = np.argsort(flat)
    ordered = flat[order]
    first = np.concatenate([[True], ordered[1:] != ordered[:-1]])
    ends = np.concatenate([np.flatnonzero(first), [flat.size]])
    rank = np.empty(flat.size)
    rank[order] = (0.5 * (ends[:-1] + ends[1:] + 1))[np.cumsum(first) - 1]
    scores: FloatArray = ndtri((rank - 0.375) / (flat.size + 0.25)).reshape(values.shape)
    return scores


def _rhat(chains: FloatArray) -> float:
    n = chains.shape[1]
    within = float(np.mean(np.var(chains, axis=1, ddof=1)))
    between = n * float(np.var(chains.mean(axis=1), ddof=1))
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.sqrt((np.divide(between, within) + n - 1) / n))


def _effective(chains: FloatArray) -> float:
    """Effective number of draws, by Geyer's initial monotone sequence of the pooled autocorrelations."""
    if np.ptp(chains) == 0.0:
        return float(chains.size)
    m, n = chains.shape
    covariance = _autocovariance(chains)
    within = covariance[0] * n / (n - 1.0)
    total = covariance[0] + (float(np.var(chains.mean(axis=1), ddof=1)) if m > 1 else 0.0)
    rho = 1.0 - (within - covariance) / total
    rho[0] = 1.0
    # Sums of neighbours, up to the first that is not positive; of that one, the even term still counts.
    last = max(0, (n - 3) // 2)
    pairs = rho[: 2 * last + 2].reshape(-1, 2).sum(axis=1)
    ended = np.flatnonzero(pairs <= 0.0)
    stop = int(ended[0]) if ended.size else last
    beyond = max(float(rho[2 * stop]), 0.0) if ended.size else float(rho[2 * stop])
    tau = -1.0 + 2.0 * float(np.sum(np.minimum.accumulate(pairs[:stop]))) + beyond
    return float(m * n / max(tau, 1.0 / np.log10(m * n)))


def _autocovariance(chains: FloatArray) -> FloatArray:
    """Autocovariance (draw,) at every lag, mean over the chains."""
    from scipy.fft import irfft, next_fast_len, rfft

    n = chains.shape[1]
    size = next_fast_len(2 * n, real=True)
    spectrum = rfft(chains - chains.mean(axis=1, keepdims=True), size, axis=1)
    power = np.mean(spectrum.real**2 + spectrum.imag**2, axis=0)
    covariance: FloatArray = irfft(power, size)[:n] / n
    return covariance


def psis(log_weights: FloatArray) -> tuple[FloatArray, float]:
    """Pareto-smoothed importance sampling of the log of target over proposal (n,).

    Returns
    -------
    log_weights : array (n,)
        Smoothed, normalised so that the weights sum to one.
    khat : float
        Shape of the fitted Pareto tail; below 0.7 the weights can be trusted. 0 where the largest weights are all
        equal, which leaves no tail to fit.
    """
    smoothed, khat = psis_rows(np.asarray(log_weights, dtype=np.float64)[None])
    return smoothed[0], float(khat[0])


def psis_rows(log_weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """`psis` of every row of log weights (k, n): smoothed ones (k, n) and shapes (k,)."""
    x = log_weights - np.max(log_weights, axis=1, keepdims=True)
    n = x.shape[1]
    n_tail = int(np.ceil(min(n / 5.0, 3.0 * np.sqrt(n))))
    depth = min(n, max(5, n_tail) + 1)
    largest = np.argpartition(x, n - depth, axis=1)[:, n - depth :]
    values = np.take_along_axis(x, largest, axis=1)
    order = np.argsort(values, axis=1)
    largest, values = np.take_along_axis(largest, order, axis=1), np.take_along_axis(values, order, axis=1)
    cutoff = np.maximum(values[:, -n_tail - 1], np.log(np.finfo(np.float64).tiny))
    flat = -values[:, 0] < _EQUAL_WEIGHTS
    lengths = np.where(flat, 0, np.count_nonzero(values > cutoff[:, None], axis=1))
    khat = np.where(flat, 0.0, np.inf)
    # Ties with the cutoff make a tail shorter; rows of one length are fitted together.
    for length in np.unique(lengths[lengths > 4]):
        rows = np.flatnonzero(lengths == length)
        for some in np.array_split(rows, -(-len(rows) // _ROWS)):
            edge = np.exp(cutoff[some])[:, None]
            shape, scale = _fit_pareto(np.exp(values[some, -length:]) - edge)
            khat[some] = shape
            probability = (np.arange(length) + 0.5) / length
            with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
                quantile = scale[:, None] * np.expm1(-shape[:, None] * np.log1p(-probability)) / shape[:, None]
                smooth = np.minimum(np.log(quantile + edge), 0.0)
            good = np.isfinite(shape) & np.all(np.isfinite(smooth), axis=1)
            x[some[good, None], largest[some[good], -length:]] = smooth[good]
    # The largest is 0 still, so that nothing overflows.
    return x - np.log(np.sum(np.exp(x), axis=1, keepdims=True)), khat


def _fit_pareto(excess: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Shape and scale of generalised Pareto tails (k, n), sorted; after Zhang & Stephens (2009), with a weak prior."""
    n = excess.shape[1]
    trials = 30 + int(np.sqrt(n))
    b = 1.0 - np.sqrt(trials / (np.arange(1, trials + 1) - 0.5))
    b = b / (3.0 * excess[:, int(n / 4 + 0.5) - 1, None]) + 1.0 / excess[:, -1:]
    # Trial shapes that are out of the question get the weight exp(-large), by way of 1 / inf.
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        shape = np.mean(np.log(1.0 - b[:, :, None] * excess[:, None, :]), axis=2)
        likelihood = n * (np.log(-b / shape) - shape - 1.0)
        weights = 1.0 / np.sum(np.exp(likelihood[:, None, :] - likelihood[:, :, None]), axis=2)
        weights[weights < 10.0 * np.finfo(np.float64).eps] = 0.0
        b_mean = np.sum(b * weights, axis=1) / np.sum(weights, axis=1)
        found = np.mean(np.log(1.0 - b_mean[:, None] * excess), axis=1)
        scale = -found / b_mean
    return (n * found + _PRIOR_DRAWS * _PRIOR_SHAPE) / (n + _PRIOR_DRAWS), scale
