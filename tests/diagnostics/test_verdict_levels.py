"""The level of a check follows what a misfit does, on a sensor of a second make with the misfit
planted in it.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.status import Level
from starcal_uq.core.types import FloatArray
from starcal_uq.diagnostics.diagnose import diagnose
from starcal_uq.diagnostics.verdict.judge import judge
from tests.helpers.outside import Displacement, campaign

FRAMES = 60


def magnitude(px: float) -> Displacement:
    """Faint stars are off along both axes."""

    def shift(uv: FloatArray, xy: FloatArray, mag: FloatArray, frame: int) -> FloatArray:
        return np.outer([px, -0.5 * px], (mag - 4.0) / 1.15)

    return shift


def drift(relative: float) -> Displacement:
    """A focal length that changes by twice this over the run."""

    def shift(uv: FloatArray, xy: FloatArray, mag: FloatArray, frame: int) -> FloatArray:
        return relative * (2.0 * frame / (FRAMES - 1) - 1.0) * uv

    return shift


# Staring, the stars of one field are the same magnitudes at the same places whenever it comes
# round. A drift averages out over frames, not over the stars of a frame.
PLANTED: dict[str, dict[str, Any]] = {
    "magnitude, small": {"displaced": magnitude(0.015)},
    "drift, small": {"displaced": drift(5e-5)},
    "magnitude, large": {"displaced": magnitude(0.1), "pointings": 4},
    "drift, large": {"displaced": drift(5e-4), "corner_px": (0.0, 0.0), "stars_per_frame": 60},
}


def judged(planted: str, seed: int) -> SimpleNamespace:
    """Outcome of the checks of the model, and which parameters their 95 % intervals hold."""
    c = campaign(np.random.default_rng(seed), n_frames=FRAMES, **PLANTED[planted])
    obs = sc.Observations(**c.columns, meta={"directions": "apparent", "observer": "space"})
    sheet = sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0))  # type: ignore[arg-type]
    model = "brown" if c.theta[3:].any() else "none"
    cal = sc.calibrate(obs, sheet, model=model)
    verdict = judge(obs, cal, diagnosis=diagnose(obs, cal, models=(), n_starts=0))
    check = next(check for check in verdict.checks if check.name == "Unexplained structure")
    held = np.abs(cal.theta - c.theta[: len(cal.theta)]) < 1.96 * cal.sigmas
    return SimpleNamespace(check=check, verdict=verdict, held=held)


LEVELS = {"small": Level.WARN, "large": Level.FAIL}


@pytest.mark.parametrize("planted", ["magnitude, large", "drift, small"])
def test_a_check_fails_where_numbers_are_off_and_warns_where_residuals_know(planted: str) -> None:
    run = judged(planted, 200)
    assert run.check.level is run.verdict.level is LEVELS[planted.split()[-1]], run.check
    assert (
        "of the standard deviation" in run.check.sentence
        or "the stated standard deviation" in run.check.sentence
    )


@pytest.mark.slow
@pytest.mark.parametrize("planted", ["magnitude, small", "drift, large"])
def test_levels_and_coverage_go_together(planted: str) -> None:
    """Intervals of runs that are warned of hold; of those that fail they do not."""
    runs = [judged(planted, 200 + seed) for seed in range(15)]
    expected = LEVELS[planted.split()[-1]]
    right = [run for run in runs if run.verdict.level is expected]
    held = np.mean(np.concatenate([run.held for run in right]))
    print(
        f"\n{planted}: {len(right)} of {len(runs)} runs {expected.value}, their 95 % intervals "
        f"hold {held:.0%}"
    )
    # What averages out over the frames by luck has done no harm, and is warned of however large it
    # is.
    assert len(right) >= (13 if expected is Level.WARN else 10)
    assert held > 0.88 if expected is Level.WARN else held < 0.8
