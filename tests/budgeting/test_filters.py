"""States of a filter against attitudes that are simulated star by star here, with NumPy alone."""

from __future__ import annotations

import dataclasses
import math
from functools import lru_cache

import numpy as np
import pandas as pd
import pytest

import starcal_uq as sc
from starcal_uq.budgeting.behaviour import Behaviour
from starcal_uq.budgeting.filters import FilterState, filter_states
from starcal_uq.budgeting.result import Budget
from starcal_uq.budgeting.rows import NEA, REST, Contributor
from starcal_uq.core.constants import AXES
from starcal_uq.core.provenance import Provenance
from starcal_uq.observations.table import Observations
from starcal_uq.propagation.propagate import propagate
from starcal_uq.propagation.spectrum import error_spectrum

ARCSEC = 648_000.0 / np.pi
SIZE, FOCAL_PX, NOISE_PX = 1024, 5800.0, 0.05
STEP_S, RATE_DEG_S, FRAMES = 1.0, 0.1, 1201
# Of principal point, focal length (px) and radial distortion.
THETA = np.array([511.5, 511.5, FOCAL_PX, 1.0e-10, 0.0])
SIGMA = np.array([0.2, 0.2, 1.0, 3.0e-10, 1e-18])


class Draws:
    """A posterior of Gaussian draws."""

    def __init__(self, n: int = 400) -> None:
        rng = np.random.default_rng(7)
        self.theta_draws = THETA + SIGMA * rng.standard_normal((n, 5))
        self.sigma_draws = np.full(n, NOISE_PX)
        self.draws = np.column_stack((self.theta_draws, self.sigma_draws))
        self.mean, self.covariance = THETA, np.diag(SIGMA**2)
        self.sigma_name, self.star_error_px, self.effects = "sigma", 0.0, None
        self.provenance = Provenance()
        self.camera = self.calibrated_camera = sc.Camera(
            width_px=SIZE, height_px=SIZE, pixel_um=10.0, focal_mm=58.0, x0_px=511.5, y0_px=511.5,
            distortion="brown", coefficients=(1.0e-10, 0.0),
        )  # fmt: skip

    def thin(self, n: int, seed: int) -> np.ndarray:
        return self.draws[:n]


@lru_cache
def flown() -> tuple[Observations, np.ndarray, np.ndarray]:
    """Frames along a slew through a random sky, turns (K, 3, 4) of their attitudes by one standard
    deviation of each parameter, and their noise (K, 3), arcsec.
    """
    rng = np.random.default_rng(5)
    sky = rng.standard_normal((9_000, 3))
    sky /= np.linalg.norm(sky, axis=1, keepdims=True)
    columns: dict[str, list[np.ndarray]] = {"frame": [], "xy": [], "icrs": []}
    turns, noise = [], []
    for k in range(FRAMES):
        angle = np.radians(RATE_DEG_S) * STEP_S * k
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
        b = sky @ turn.T
        plane = FOCAL_PX * b[:, :2] / b[:, 2:]
        seen = (b[:, 2] > 0.0) & (np.abs(plane) < 0.49 * SIZE).all(axis=1)
        b, plane = b[seen], plane[seen]
        square = np.sum(plane**2, axis=1, keepdims=True)
        # What each error of the camera makes of the ideal place, px; and of the direction.
        shift = [-np.eye(2)[[0]], -np.eye(2)[[1]], -plane / FOCAL_PX, -plane * square]
        inverse = np.linalg.inv(len(b) * np.eye(3) - b.T @ b)

        def direction(
            moved: np.ndarray, b: np.ndarray = b, plane: np.ndarray = plane
        ) -> np.ndarray:
            along = np.column_stack((plane + moved, np.full(len(b), FOCAL_PX)))
            return np.asarray(along / np.linalg.norm(along, axis=1, keepdims=True) - b)

        turns.append([
            inverse @ np.cross(b, direction(1e-3 * sigma * one)).sum(axis=0) / 1e-3
            for one, sigma in zip(shift, SIGMA[:4], strict=True)
        ])  # fmt: skip
        noise.append(np.sqrt(np.diag(inverse)) * NOISE_PX / FOCAL_PX)
        columns["frame"].append(np.full(len(b), k))
        columns["xy"].append(plane * (1.0 + 1.0e-10 * square) + 511.5)
        columns["icrs"].append(sky[seen])
    frame, xy, icrs = (np.concatenate(columns[name]) for name in ("frame", "xy", "icrs"))
    obs = Observations(
        frame=frame, x_px=xy[:, 0], y_px=xy[:, 1],
        ra_deg=np.degrees(np.arctan2(icrs[:, 1], icrs[:, 0])) % 360.0,
        dec_deg=np.degrees(np.arcsin(icrs[:, 2])),
    )  # fmt: skip
    return obs, np.swapaxes(turns, 1, 2) * ARCSEC, np.array(noise) * ARCSEC


@lru_cache
def budget() -> Budget:
    obs, _, _ = flown()
    post, times = Draws(), STEP_S * np.arange(FRAMES)
    attitude = propagate(post, obs, n_draws=20, alignment="observed")
    spectrum = error_spectrum(post, obs, times, n_draws=5)
    return sc.budget(post, obs, attitude, spectrum=spectrum, n_samples=10_000)


def state(kind: str, axis: str, found: Budget | None = None) -> FilterState:
    (one,) = (one for one in (found or budget()).filter if (one.kind, one.axis) == (kind, axis))
    return one


def autocovariance(series: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """Of independent series (K, S), summed over them."""
    size = len(series)
    return np.array([np.sum(series[: size - lag] * series[lag:]) / (size - lag) for lag in lags])


def gauss_markov(sigma: float, seconds: float, white: float, lags: np.ndarray) -> np.ndarray:
    """Autocovariance of simulated processes, mean over 400, with white noise beside them."""
    rng = np.random.default_rng(8)
    rho = np.exp(-STEP_S / seconds)
    series = np.empty((FRAMES, 400))
    series[0] = rng.standard_normal(400)
    for k in range(1, FRAMES):
        series[k] = rho * series[k - 1] + np.sqrt(1.0 - rho**2) * rng.standard_normal(400)
    # The white part is at lag 0 alone: drawn, its chance would hide the rest about the boresight.
    return autocovariance(sigma * series, lags) / 400.0 + white**2 * (lags == 0)


@pytest.mark.parametrize("axis", AXES)
def test_states_make_the_autocovariance_of_attitudes_star_by_star(axis: str):
    _, turns, noise = flown()
    i = AXES.index(axis)
    # Alignment takes the mean turn by each parameter away.
    series = turns[:, i] - turns[:, i].mean(axis=0)
    white, correlated = state("white", axis), state("correlated", axis)
    lags = np.arange(0, round(3.0 * correlated.seconds))
    wanted = autocovariance(series, lags)
    noise_2 = np.mean(noise[:, i] ** 2)
    wanted[0] += noise_2
    of_states = correlated.sigma_arcsec, correlated.seconds, white.sigma_arcsec
    variance = correlated.sigma_arcsec**2
    # The mean of the record, which the misfit leaves out, and chance among the processes made here.
    allowed = correlated.misfit + 3.0 * correlated.seconds / FRAMES + 0.05
    assert allowed < 0.45
    made = gauss_markov(*of_states, lags)
    assert np.abs(made - wanted)[1:].max() / variance < allowed
    assert made[0] == pytest.approx(wanted[0], rel=0.05)
    assert white.sigma_arcsec == pytest.approx(np.sqrt(noise_2), rel=0.03)
    assert white.seconds == STEP_S
    # Controls: another correlation time, and all of it taken as white.
    for sigma, seconds, rest in (
        (correlated.sigma_arcsec, 5.0 * correlated.seconds, white.sigma_arcsec),
        (0.0, 1.0, math.hypot(correlated.sigma_arcsec, white.sigma_arcsec)),
    ):
        other = gauss_markov(sigma, seconds, rest, lags)
        assert np.abs(other - wanted)[1:].max() / variance > 1.5 * allowed


def test_a_process_is_found_again():
    """Lines of records of a known process: the white share, the time, and no misfit."""
    rng = np.random.default_rng(9)
    n, seconds, step = 1000, 12.0, 0.5
    rho = np.exp(-step / seconds)
    series = np.empty((n, 300))
    series[0] = rng.standard_normal(300)
    for k in range(1, n):
        series[k] = rho * series[k - 1] + np.sqrt(1.0 - rho**2) * rng.standard_normal(300)
    series += 0.5 * rng.standard_normal(series.shape)
    power = np.mean(2.0 * np.abs(np.fft.rfft(series - series.mean(axis=0), axis=0)[1:] / n) ** 2, 1)
    power[-1] *= 0.5
    f = np.arange(1, n // 2 + 1) / (n * step)
    white, time, misfit = Behaviour("series", step, f, power).gauss_markov()
    assert white == pytest.approx(0.2, abs=0.01)
    assert time == pytest.approx(seconds, rel=0.05)
    assert misfit < 0.02
    # The same as a density, up to the folded part of it.
    f = np.linspace(0.0, 2.0, 20_000)
    density = 4.0 * seconds / (1.0 + (2.0 * np.pi * f * seconds) ** 2)
    white, time, _ = Behaviour("spectrum", frequency_hz=f, power=density).gauss_markov()
    assert white < 0.03
    assert time == pytest.approx(seconds, rel=0.05)


def test_rows_are_states_by_what_they_state():
    def row(name: str, sigma: float, **of_row: str) -> Contributor:
        settings = {"interpretation": "temporal", "source": "file"} | of_row
        return Contributor(name, "other", "pitch", 0.0, sigma, **settings)

    rows = (
        row("one", 3.0), row("two", 4.0), row("orbit", 1.0), row("slow", 2.0), row("odd", 5.0),
        row("constant", 6.0, interpretation="ensemble"), row("fixed", 8.0),
        row("pixels", 12.0), row("season", 2.4),
        row("gone", 9.0, absorbed_by_alignment="yes"), row("control", 9.0, part="control"),
    )  # fmt: skip
    known = {
        "one": Behaviour("white", 0.2), "two": Behaviour("white", 0.2),
        "orbit": Behaviour("periodic", 5880.0), "slow": Behaviour("correlated", 50.0),
        "fixed": Behaviour("constant"), "pixels": Behaviour("periodic", 0.3),
        "season": Behaviour("periodic", 5880.0),
    }  # fmt: skip
    behaviours = {(name, "pitch"): behaviour for name, behaviour in known.items()}
    found = {one.kind: one for one in filter_states(rows, behaviours)}
    assert list(found) == ["white", "correlated", "periodic", "bias", "not stated"]
    # With 3 and 4 arcsec of noise what changes within two frames; two rows of one period.
    assert found["white"].sigma_arcsec == pytest.approx(13.0)
    assert found["white"].density == pytest.approx(13.0 * np.sqrt(0.2))
    assert found["white"].contributors == ("one", "two", "pixels")
    assert found["periodic"].sigma_arcsec == pytest.approx(2.6)
    assert found["correlated"].density == pytest.approx(2.0 * np.sqrt(2.0 / 50.0))
    assert found["bias"].sigma_arcsec == pytest.approx(10.0)
    assert np.isnan(found["bias"].density)
    assert (found["periodic"].seconds, found["not stated"].sigma_arcsec) == (5880.0, 5.0)
    # Nothing is known of time: there is no table.
    assert filter_states(rows, {}) == ()


def test_states_are_saved_and_shown(tmp_path):
    from starcal_uq.presentation.pages.budgeting import sheet_html
    from starcal_uq.presentation.pages.write import write_page
    from starcal_uq.presentation.words.sentences import rows

    openpyxl = pytest.importorskip("openpyxl")
    found = budget()
    write_page(found, tmp_path / "b.csv")
    table = Budget.load(tmp_path / "b.csv").filter_dataframe()
    pd.testing.assert_frame_equal(table, found.filter_dataframe())
    assert {REST, NEA} <= {name for one in found.filter for name in one.contributors}
    assert len(found.to_dict()["filter"]) == len(table)
    assert len(rows("filter", found).rows) == len(table)
    write_page(found, tmp_path / "b.html")
    assert "States of a filter" in (tmp_path / "b.html").read_text("utf-8")
    assert sheet_html(found).count('<td style="text-align:left">correlated</td>') == 3
    write_page(found, tmp_path / "b.tex")
    _, _, shown = (tmp_path / "b.tex").read_text("utf-8").partition("% --- table: filter")
    assert shown.partition("% --- end of table")[0].count("& correlated &") == 3
    write_page(found, tmp_path / "b.xlsx")
    cells = openpyxl.load_workbook(tmp_path / "b.xlsx")["Filter"].values
    head, *states = cells
    assert head[:2] == ("Axis", "Kind") and len(states) == len(table)
    sigma = head.index("Sigma [arcsec]")
    assert [one[sigma] for one in states] == pytest.approx(table["sigma_arcsec"].tolist())
    # Without behaviour in time there is nothing to show.
    write_page(dataclasses.replace(found, filter=()), tmp_path / "none.xlsx")
    assert "Filter" not in openpyxl.load_workbook(tmp_path / "none.xlsx").sheetnames
