"""A smooth misfit of the field with scales of every frame's own, on a sensor of a second make: what
attitudes it costs.

Directions that attitudes imitate, such as a principal point that drifts over the frames, must not
turn what the fit of another shape leaves over into arcminutes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.types import FloatArray
from starcal_uq.diagnostics import pattern
from starcal_uq.diagnostics.inflation import with_misfit
from starcal_uq.diagnostics.misfit import misfit_tests
from starcal_uq.propagation.attitude_error import AttitudeError
from tests.helpers.outside import Campaign, attitude_errors, campaign
from tests.helpers.posteriors import normal_posterior

WIDTH, HEIGHT, FOCAL = 1280, 960, 2657.0
# Scales of single frames, as refraction makes them.
SCALES = np.linspace(-680e-6, 270e-6, 9)


def smooth(seed: int, rms_px: float) -> Callable[[FloatArray], FloatArray]:
    """Shifts (2, n) of stars at (2, n) px from the middle: waves at least as long as two thirds of
    the field.
    """
    rng = np.random.default_rng(seed)
    waves = rng.uniform(0.5, 1.5, (2, 8, 2)) * rng.choice([-1, 1], (2, 8, 2)) * 2.0 * np.pi / WIDTH
    phases, heights = rng.uniform(0.0, 2.0 * np.pi, (2, 8, 1)), rng.standard_normal((2, 8, 1))

    def shift(uv: FloatArray) -> FloatArray:
        return np.sum(heights * np.cos(waves @ uv + phases), axis=1)

    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 40) * WIDTH, np.linspace(-0.5, 0.5, 30) * HEIGHT)
    size = rms_px / np.sqrt(np.mean(shift(np.array([x.ravel(), y.ravel()])) ** 2))
    return lambda uv: size * shift(uv)


def frames(
    seed: int, scales: FloatArray, *, misfit: int, sigma_px: float = 0.0, rms_px: float = 0.2
) -> Campaign:
    """About 134 stars a frame on a detector of 1280 by 960 px, with the field pattern number
    `misfit`.
    """
    bent = smooth(misfit, rms_px)

    def displaced(uv: FloatArray, xy: FloatArray, mag: FloatArray, frame: int) -> FloatArray:
        return bent(uv) + scales[frame] * uv

    c = campaign(
        np.random.default_rng(seed),
        n_frames=len(scales),
        stars_per_frame=round(134 * WIDTH / HEIGHT),
        field_deg=float(np.degrees(2.0 * np.arctan(0.5 * WIDTH / FOCAL))),
        size_px=WIDTH,
        corner_px=(-15.0, 3.0),
        sigma_px=sigma_px,
        displaced=displaced,
    )
    cut = 0.5 * (WIDTH - HEIGHT)
    seen = np.abs(c.columns["y_px"] - 0.5 * WIDTH) < 0.5 * HEIGHT
    columns = {name: column[seen] for name, column in c.columns.items()}
    columns["y_px"] = columns["y_px"] - cut
    return replace(c, columns=columns, theta=c.theta - np.array([0.0, cut, 0.0, 0.0, 0.0]))


@dataclass(frozen=True)
class Errors:
    """Stated and true errors by the misfit, arcsec, each across the boresight per axis and in roll
    (2,).
    """

    rest: FloatArray
    true_rest: FloatArray
    common: FloatArray
    true_common: FloatArray


def both(values: FloatArray) -> FloatArray:
    return np.array([np.sqrt(np.mean(values[:2] ** 2)), abs(values[2])])


def errors(seed: int, scales: FloatArray = SCALES, rms_px: float = 0.2) -> Errors:
    """The truth is that of the same frames without noise, aligned on 40 others with the same
    misfit.
    """
    options: dict[str, Any] = {"misfit": seed, "rms_px": rms_px}
    c, clean = (frames(seed, scales, sigma_px=sigma, **options) for sigma in (0.13, 0.0))
    others = frames(seed + 5000, np.resize(scales, 40), **options)
    obs, aligned = (
        sc.Observations(**one.columns, meta={"directions": "apparent"}) for one in (c, others)
    )
    sheet = sc.Camera(
        width_px=WIDTH,
        height_px=HEIGHT,
        pixel_um=10.0,
        focal_mm=0.01 * 1.01 * FOCAL,
        x0_px=0.5 * (WIDTH - 1),
        y0_px=0.5 * (HEIGHT - 1),
        distortion="brown",
        coefficients=(0.0, 0.0),
    )
    cal = sc.calibrate(obs, sheet)
    post = normal_posterior(cal)
    diagnosis: Any = SimpleNamespace(
        misfit=misfit_tests(obs, cal), jackknife=None, comparison=None, theta=cal.theta.tolist()
    )
    zero, nothing = np.zeros(3), np.full((5, 4), np.nan)
    bare = AttitudeError(
        zero,
        zero,
        zero,
        nothing,
        nothing,
        zero,
        zero,
        zero,
        2,
        len(scales),
        seen=obs,
        aligned=aligned,
    )
    found = with_misfit(bare, diagnosis, post, obs).misfit
    assert found is not None
    common = attitude_errors(others, cal.theta).mean(axis=0)
    rest = np.sqrt(np.mean((attitude_errors(clean, cal.theta) - common) ** 2, axis=0))
    return Errors(both(found.rest_arcsec), both(rest), both(found.common_arcsec), both(common))


def rms(rows: list[FloatArray]) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(np.square(rows), axis=0)))


def assert_within_two(stated: FloatArray, true: FloatArray) -> None:
    assert np.abs(np.log2(stated / true)).max() < 1.0, (stated, true)


def test_nine_frames_with_scales_of_their_own() -> None:
    for seed in (0, 14):
        found = errors(seed)
        assert_within_two(found.rest, found.true_rest)


def one_frame(seeds: range) -> None:
    # A single frame is one draw of what its pattern does to it: many of them have a size.
    runs = [errors(seed, np.zeros(1)) for seed in seeds]
    rest, true_rest, common, true_common = (
        rms([getattr(run, name) for run in runs])
        for name in ("rest", "true_rest", "common", "true_common")
    )
    print(f"\nrest {rest}, true {true_rest}; common {common}, true {true_common}")
    assert_within_two(rest, true_rest)
    assert_within_two(common, true_common)


def test_one_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    one_frame(range(12))
    # Control: without a prior, what attitudes and parameters imitate is divided by nearly nothing.
    monkeypatch.setattr(
        pattern, "_prior_variance", lambda matrix, raw, slope, variance: 1e6 * variance
    )
    with pytest.raises(AssertionError):
        one_frame(range(6))


@pytest.mark.slow
def test_many_single_frames() -> None:
    one_frame(range(100, 140))


@pytest.mark.slow
@pytest.mark.parametrize("n_frames", [9, 12])
def test_many_campaigns_with_scales_of_their_own(n_frames: int) -> None:
    runs = [errors(seed, np.linspace(-680e-6, 270e-6, n_frames)) for seed in range(20)]
    ratios = np.array([run.rest / run.true_rest for run in runs])
    print(
        f"\n{n_frames} frames, stated over true rest, across and roll: {ratios.min(axis=0)} to "
        f"{ratios.max(axis=0)}"
    )
    for run in runs:
        assert_within_two(run.rest, run.true_rest)
