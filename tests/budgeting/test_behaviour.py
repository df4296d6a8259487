"""Shares of variance against time series that are simulated here, with NumPy alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from starcal_uq.budgeting.behaviour import Behaviour, load_series, load_spectrum
from starcal_uq.core.errors import AttitudeProfileError, BudgetError

# Series of each simulation, and how well their spread is known: three standard errors.
N = 60_000
WITHIN = 3.0 / np.sqrt(2.0 * N)
Means = tuple[np.ndarray, np.ndarray, np.ndarray]


def sinusoid(rng: np.random.Generator, window: float, later: float) -> Means:
    """The error at a random moment of a window, and the means of two windows; period 5,880 s."""
    w = 2.0 * np.pi / 5880.0
    start = rng.uniform(0.0, 5880.0, N)

    def mean(t: np.ndarray) -> np.ndarray:
        return np.asarray(np.sqrt(2.0) * (np.cos(w * t) - np.cos(w * (t + window))) / (w * window))

    at = start + window * rng.random(N)
    return np.sqrt(2.0) * np.sin(w * at), mean(start), mean(start + later)


def samples(rng: np.random.Generator, window: float, later: float) -> Means:
    """Independent samples, 2 s apart."""
    n, shift = round(window / 2.0), round(later / 2.0)
    values = rng.standard_normal((N, n + shift))
    return values[:, 0], values[:, :n].mean(axis=1), values[:, shift:].mean(axis=1)


def gauss_markov(rng: np.random.Generator, window: float, later: float) -> Means:
    """An exponential autocorrelation of 100 s, in steps of 2 s."""
    rho = np.exp(-2.0 / 100.0)
    n, shift = round(window / 2.0), round(later / 2.0)
    values = np.empty((n + shift, N))
    values[0] = rng.standard_normal(N)
    for i in range(1, n + shift):
        values[i] = rho * values[i - 1] + np.sqrt(1.0 - rho**2) * rng.standard_normal(N)
    at = values[rng.integers(0, n, N), np.arange(N)]
    return at, values[:n].mean(axis=0), values[shift:].mean(axis=0)


def drift(rng: np.random.Generator, window: float, later: float) -> Means:
    """A line over 10,000 s, of variance 1, seen from a random moment on."""
    rate = np.sqrt(12.0) / 10_000.0
    start = rng.uniform(0.0, 10_000.0 - window - later, N)
    at = start + window * rng.random(N)
    middle = start + 0.5 * window
    return rate * (at - 5000.0), rate * (middle - 5000.0), rate * (middle + later - 5000.0)


DENSITY = np.array([[0.0, 4.0], [0.002, 4.0], [0.006, 0.5], [0.03, 0.0]])


def spectrum(rng: np.random.Generator, window: float, later: float) -> Means:
    """Sinusoids of random phase and a density that is linear in between."""
    edge = np.linspace(0.0, 0.03, 31)
    w = 2.0 * np.pi * 0.5 * (edge[1:] + edge[:-1])
    power = np.interp(w / (2.0 * np.pi), *DENSITY.T) * np.diff(edge)
    size = np.sqrt(2.0 * power / power.sum())
    phase = 2.0 * np.pi * rng.random((N, len(w)))
    # Frequencies within their bins, so that lines do not come back in step.
    w = w + np.diff(edge) * 2.0 * np.pi * (rng.random((N, len(w))) - 0.5)

    def mean(t: float) -> np.ndarray:
        ends = np.sin(w * (t + window) + phase) - np.sin(w * t + phase)
        return np.asarray((ends / (w * window)) @ size)

    at = window * rng.random((N, 1))
    return np.cos(w * at + phase) @ size, mean(0.0), mean(later)


CASES = {
    "sinusoid": (Behaviour("periodic", 5880.0), sinusoid, (300.0, 1000.0)),
    "long window": (Behaviour("periodic", 5880.0), sinusoid, (9000.0, 2500.0)),
    "samples": (Behaviour("white", 2.0), samples, (40.0, 60.0)),
    "overlapping": (Behaviour("white", 2.0), samples, (40.0, 20.0)),
    "gauss-markov": (Behaviour("correlated", 100.0), gauss_markov, (160.0, 80.0)),
    "drift": (Behaviour("drift", 10_000.0), drift, (1500.0, 700.0)),
    "spectrum": (
        Behaviour("spectrum", frequency_hz=DENSITY[:, 0], power=DENSITY[:, 1]),
        spectrum,
        (90.0, 400.0),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_shares_are_those_of_simulated_series(name: str) -> None:
    behaviour, simulate, (window, later) = CASES[name]
    rng = np.random.default_rng(2)
    at, first, _ = simulate(rng, window, 0.0)
    _, early, late = simulate(rng, window, later)
    found = {
        "kept": np.sqrt(behaviour.kept(window)) / first.std(),
        "left": np.sqrt(behaviour.left(window)) / np.sqrt(np.mean((at - first) ** 2)),
        "changed": np.sqrt(behaviour.changed(window, later))
        / np.sqrt(np.mean((late - early) ** 2)),
    }
    within = max(0.01, WITHIN)
    assert {k: v for k, v in found.items() if abs(v - 1.0) > within} == {}
    # Control: the shares of a window that is 1.3 times as long are seen to be others.
    wrong = {
        "kept": np.sqrt(behaviour.kept(1.3 * window)) / first.std(),
        "left": np.sqrt(behaviour.left(1.3 * window)) / np.sqrt(np.mean((at - first) ** 2)),
    }
    assert any(abs(v - 1.0) > 0.05 for v in wrong.values())


def test_the_sinusoid_of_the_glossary() -> None:
    """2 arcsec and 5,880 s: mean 1.408 and 1.348, relative 0.131 and 0.428 arcsec."""
    behaviour, sigma = Behaviour("periodic", 5880.0), 2.0 / np.sqrt(2.0)
    found = [sigma * np.sqrt(f(t)) for f in (behaviour.kept, behaviour.left) for t in (300.0, 1e3)]
    assert np.round(found, 3).tolist() == [1.408, 1.348, 0.131, 0.428]


def test_a_series_has_the_shares_of_its_own_windows(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    error = np.zeros(4096)
    for i in range(1, len(error)):
        error[i] = 0.98 * error[i - 1] + rng.standard_normal()
    rows = [f"{0.5 * i},{value!r}" for i, value in enumerate((error + 7.0).tolist())]
    path = tmp_path / "series.csv"
    path.write_text("time_s,error_arcsec\n" + "\n".join(rows) + "\n")
    behaviour = load_series(path)
    deviations = error - error.mean()
    assert behaviour.sigma_arcsec == pytest.approx(deviations.std(), rel=1e-9)
    assert behaviour.mean_arcsec == pytest.approx(error.mean() + 7.0)
    # Windows of the series as one that repeats itself, as its lines have it.
    total = np.concatenate([[0.0], np.cumsum(np.tile(deviations, 2))])
    means = (total[64 : 64 + 4096] - total[:4096]) / 64.0
    variance = deviations.var()
    assert behaviour.kept(32.0) == pytest.approx(means.var() / variance, rel=1e-9)
    difference = np.roll(means, -100) - means
    assert behaviour.changed(32.0, 50.0) == pytest.approx(difference.var() / variance, rel=1e-9)
    assert behaviour.longest_s == pytest.approx(0.25 * 0.5 * 4096)


def test_a_spectrum_is_read_with_its_size(tmp_path: Path) -> None:
    path = tmp_path / "psd.csv"
    path.write_text("frequency_hz,psd_arcsec2_hz\n0,4\n0.002,4\n0.006,0.5\n0.03,0\n")
    read = load_spectrum(path)
    assert read.sigma_arcsec**2 == pytest.approx(0.008 + 0.009 + 0.006)
    assert read.kept(90.0) == pytest.approx(CASES["spectrum"][0].kept(90.0), rel=1e-12)


@pytest.mark.parametrize(
    ("load", "text", "words"),
    [
        (load_spectrum, "frequency_hz\n0\n1\n", "column psd_arcsec2_hz"),
        (load_spectrum, "frequency_hz,psd_arcsec2_hz\n0,1\n2,1\n1,1\n", "line 4"),
        (load_spectrum, "frequency_hz,psd_arcsec2_hz\n0,1\n1,-1\n", "line 3"),
        (load_spectrum, "frequency_hz,psd_arcsec2_hz\n0,1\n", "single row"),
        (load_series, "time_s,error_arcsec\n0,1\n1,nan\n", "line 3"),
        (load_series, "time_s,error_arcsec\n0,1\n2,1\n1,2\n", r"broken\.csv, line 4"),
        (load_series, "time_s,error_arcsec\n0,1\n1,2\n5,3\n", "line 3"),
        (load_series, "time_s,error_arcsec\n0,1\n1,1\n2,1\n", "never changes"),
        (load_series, "time_s,error_arcsec\n0,1\n1,x\n2,1\n", "line 3"),
    ],
)
def test_a_broken_file_is_refused(
    tmp_path: Path, load: Callable[[Path], Behaviour], text: str, words: str
) -> None:
    path = tmp_path / "broken.csv"
    path.write_text(text)
    with pytest.raises((BudgetError, AttitudeProfileError), match=words):
        load(path)
