"""Have several chains of draws converged, how much do they tell, and can weighted draws stand for others?

Rank-normalised R-hat, effective sample sizes and Monte Carlo error of Vehtari, Gelman, Simpson, Carpenter & Buerkner
(2021, "Rank-normalization, folding, and localization", Bayesian Analysis 16:667), and Pareto-smoothed importance
sampling of Vehtari, Simpson, Gelman, Yao & Gabry (2024, JMLR 25:72). The numbers are those of ArviZ, a test says so;
ArviZ needs `scipy.stats` and `scipy.signal` for them, which take longer to load than a whole run takes to sample.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from starcal_uq.core.types import FloatArray

# Tail ESS is the smaller of the ESS of these two quantiles.
_TAIL = (0.05, 0.95)
# Log weights closer than this are equal for every purpose, and a Pareto tail cannot be fitted to them.
_EQUAL_WEIGHTS = 1e-9
# Least draws of a chain, and of a Pareto tail.
_LEAST_DRAWS, _LEAST_TAIL = 4, 5
# The prior of the Pareto shape: a normal about 0.5 that weighs as much as ten draws.
_PRIOR_DRAWS, _PRIOR_SHAPE, _PRIOR_SCALE = 10, 0.5, 3.0


@dataclass(frozen=True)
class Convergence:
    """What chains of one quantity tell; NaN where they cannot.

    Attributes
    ----------
    rhat : float
        Rank-normalised split R-hat; 1 for chains that agree.
    ess_bulk, ess_tail : float
        Effective sample size of the bulk, and of the 5 % and 95 % quantiles.
    mcse : float
        Monte Carlo standard error of the mean.
    """

    rhat: float
    ess_bulk: float
    ess_tail: float
    mcse: float


def convergence(draws: FloatArray) -> Convergence:
    """Convergence of draws (chain, draw) of one quantity."""
    if draws.shape[1] < _LEAST_DRAWS or np.any(np.isnan(draws)):
        return Convergence(np.nan, np.nan, np.nan, np.nan)
    split = _split(draws)
    normal = _normal_scores(split)
    # Chains of one location may differ in scale.
    folded = _normal_scores(np.abs(split - np.median(split)))
    return Convergence(
        rhat=max(_rhat(normal), _rhat(folded)) if len(draws) > 1 else np.nan,
        ess_bulk=_ess(normal),
        ess_tail=min(_ess(_split((draws <= q).astype(np.float64))) for q in np.quantile(draws, _TAIL)),
        mcse=float(np.std(draws, ddof=1) / np.sqrt(_ess(split))),
    )


def _split(draws: FloatArray) -> FloatArray:
    """Halves of chains as chains, so that drift within a chain counts as disagreement."""
    half = draws.shape[1] // 2
    return np.concatenate([draws[:, :half], draws[:, -half:]])


def _normal_scores(draws: FloatArray) -> FloatArray:
    """Normal quantiles of the ranks of all draws, equal draws at their mean rank."""
    from scipy.special import ndtri

    flat = draws.ravel()
    order = np.argsort(flat)
    ordered = flat[order]
    starts = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    counts = np.diff(starts, append=flat.size)
    scores = np.empty(flat.size)
    scores[order] = np.repeat(ndtri((starts + (counts + 1) / 2 - 3 / 8) / (flat.size + 1 / 4)), counts)
    return scores.reshape(draws.shape)


def _rhat(draws: FloatArray) -> float:
    n = draws.shape[1]
    within = np.mean(np.var(draws, axis=1, ddof=1))
    return float(np.sqrt(np.var(np.mean(draws, axis=1), ddof=1) / within + (n - 1) / n))


def _ess(draws: FloatArray) -> float:
    """Effective number of draws for their mean, with Geyer's initial monotone sequence of autocorrelations."""
    chains, n = draws.shape
    if np.ptp(draws) < np.finfo(np.float64).resolution:
        return float(draws.size)
    means = draws.mean(axis=1, keepdims=True)
    spectrum = np.fft.rfft(draws - means, 1 << (2 * n - 1).bit_length(), axis=1)
    covariance = np.fft.irfft(np.mean(spectrum.real**2 + spectrum.imag**2, axis=0))[:n] / n
    within = covariance[0] * n / (n - 1)
    total = covariance[0] + (np.var(means, ddof=1) if chains > 1 else 0.0)
    correlation = 1.0 - (within - covariance) / total
    correlation[0] = 1.0
    pairs = correlation[: n - n % 2].reshape(-1, 2).sum(axis=1)[: max(1, (n - 1) // 2)]
    ended = np.flatnonzero(pairs <= 0.0)
    last = int(ended[0]) if len(ended) else len(pairs) - 1
    rest = correlation[2 * last]
    rest = rest if rest > 0.0 or pairs[last] >= 0.0 else 0.0
    time = -1.0 + 2.0 * float(np.sum(np.minimum.accumulate(pairs[:last]))) + rest
    return float(draws.size / max(time, 1.0 / np.log10(draws.size)))


def psis(log_weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pareto-smoothed importance sampling of rows of the log of target over proposal (..., n).

    Returns
    -------
    log_weights : array (..., n)
        Smoothed, normalised so that the weights of a row sum to one.
    khat : array (...)
        Shape of the fitted Pareto tail; below 0.7 the weights can be trusted. 0 where the largest weights are all
        equal, which leaves no tail to fit.
    """
    values = np.array(log_weights, dtype=np.float64)
    rows = values.reshape(-1, values.shape[-1])
    khat = np.array([_smooth(row) for row in rows]).reshape(values.shape[:-1])
    rows -= _log_sum(rows)
    return values, khat


def _smooth(row: FloatArray) -> float:
    """Put quantiles of a generalised Pareto distribution in the place of the largest weights; its shape."""
    row -= row.max()
    n = len(row)
    n_tail = max(_LEAST_TAIL, int(min(n / 5, 3 * np.sqrt(n))))
    largest = np.argsort(row)[-n_tail - 1 :]
    if row[largest[-1]] - row[largest[0]] < _EQUAL_WEIGHTS:
        return 0.0
    cutoff = float(np.exp(row[largest[0]]))
    shape, scale = _pareto(np.exp(row[largest[1:]]) - cutoff)
    if np.isfinite(shape) and scale > 0.0:
        logs = np.log1p(-np.arange(0.5, n_tail) / n_tail)
        excess = -logs if shape == 0.0 else np.expm1(-shape * logs) / shape
        row[largest[1:]] = np.minimum(np.log(cutoff + scale * excess), 0.0)
    return shape


def _pareto(excess: FloatArray) -> tuple[float, float]:
    """Shape and scale of a generalised Pareto distribution of sorted values, by Zhang & Stephens (2009)."""
    n = len(excess)
    trials = 30 + int(np.sqrt(n))
    # Trial shapes that are out of the question get the weight exp(-large), by way of 1 / inf.
    with np.errstate(over="ignore", divide="ignore"):
        b = 1.0 - np.sqrt(trials / (np.arange(1, trials + 1) - 0.5))
        b = b / (_PRIOR_SCALE * excess[int(n / 4 + 0.5) - 1]) + 1.0 / excess[-1]
        shapes = np.mean(np.log1p(-b[:, None] * excess), axis=1)
        fit = n * (np.log(-b / shapes) - shapes - 1.0)
    weights = np.exp(fit - _log_sum(fit[None])[0])
    kept = weights >= 10 * np.finfo(np.float64).eps
    mean_b = float(np.sum(b[kept] * weights[kept]) / np.sum(weights[kept]))
    shape = float(np.mean(np.log1p(-mean_b * excess)))
    return (n * shape + _PRIOR_DRAWS * _PRIOR_SHAPE) / (n + _PRIOR_DRAWS), -shape / mean_b


def _log_sum(rows: FloatArray) -> FloatArray:
    """Logarithms of the sums of exponentials of rows (m, n): (m, 1)."""
    top = rows.max(axis=1, keepdims=True)
    return np.asarray(top + np.log(np.sum(np.exp(rows - top), axis=1, keepdims=True)))
