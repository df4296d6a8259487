"""How often the tests for misfit find what they are for, and how often they cry wolf.

``python verification/misfit_power.py`` simulates the sensor of Ye & Yang (2017) with one error of the
model at a time, calibrates without knowing of it, tests the residuals, and prints the shares as a
table.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from starcal_uq.attitude.rotations import exp_rotation
from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.projection import project, unproject
from starcal_uq.core.types import FloatArray
from starcal_uq.diagnostics.misfit import misfit_tests
from starcal_uq.observations.table import Observations
from starcal_uq.paper.camera import paper_camera, paper_start
from starcal_uq.simulation.frames import simulate
from starcal_uq.sky.apparent import aberrate
from starcal_uq.sky.catalogue import load_catalogue
from starcal_uq.sky.positions import ra_dec_deg, unit_vectors

EARTH_KM_S = 29.8
# Refraction at sea level: 58.2 arcsec times the tangent of the zenith distance.
_REFRACTION_RAD = 58.2 / 206_264.806
# Level of the table.
ALPHA = 0.05
_MAX_MAG, _EPOCH, _SIGMA_PX = 6.0, 2026.9, 0.05
# Towards Puppis, where stars are many: right ascension and declination.
_FIELD_DEG = (120.0, -40.0)

Maker = Callable[[int, int], Observations]


@dataclass(frozen=True)
class Scenario:
    """Data with one error of the model."""

    name: str  # The error
    make: Maker  # ``(n_frames, seed) -> Observations``
    test: (
        str  # Beginning of the name of the test that is made for it; empty where there is no error
    )


@dataclass(frozen=True)
class Power:
    """Shares of replicates in which something was found."""

    name: str  # The error
    n: int  # Replicates
    # Share in which the test made for it rejects by itself at 5 %; without an error, the mean over
    # all tests.
    specific: float
    overall: float  # Share in which any test rejects after correction, at 5 %
    strongest: str  # The test that most often had the smallest p-value
    # Root mean square error of the worst parameter in its stated standard deviations; 1 if all is
    # well
    error: float
    worst: str  # That parameter


def _base(n_frames: int, seed: int, camera: Camera | None = None) -> Observations:
    stars = load_catalogue(max_mag=_MAX_MAG, epoch=_EPOCH)
    return simulate(
        stars,
        camera or paper_camera(),
        n_frames=n_frames,
        min_stars=10,
        sigma_px=_SIGMA_PX,
        seed=seed,
    )


def _higher_order(n_frames: int, seed: int) -> Observations:
    camera = paper_camera()
    k3 = 1.0 / camera.corner_radius_px**7
    return _base(
        n_frames, seed, camera.replace(distortion="brown3", coefficients=(*camera.coefficients, k3))
    )


def _decentred(n_frames: int, seed: int) -> Observations:
    camera = paper_camera()
    # In the corner on the diagonal, p1 alone moves a star by (p1 r^2, 2 p1 r^2).
    p1 = 0.5 / np.sqrt(5.0) / camera.corner_radius_px**2
    coefficients = (*camera.coefficients, p1, 0.0)
    return _base(
        n_frames, seed, camera.replace(distortion="brown_tangential", coefficients=coefficients)
    )


def _catalogue_directions(obs: Observations, seed: int) -> Observations:
    """Take aberration by the Earth's motion, in a random direction, out of the directions."""
    velocity = np.random.default_rng((seed, 1)).standard_normal(3)
    velocity *= -EARTH_KM_S / np.linalg.norm(velocity)
    ra, dec = ra_dec_deg(aberrate(unit_vectors(obs.ra_deg, obs.dec_deg), velocity))
    return replace(obs, ra_deg=ra, dec_deg=dec)


def _aberrated(n_frames: int, seed: int) -> Observations:
    return _catalogue_directions(_base(n_frames, seed), seed)


def _aberrated_in_one_field(
    n_frames: int, seed: int, *, reach_deg: float = 4.0, rolling: bool = True
) -> Observations:
    rng = np.random.default_rng((seed, 2))
    towards = unit_vectors(*(np.array([angle]) for angle in _FIELD_DEG))[0]
    across = np.cross([0.0, 0.0, 1.0], towards)
    across /= np.linalg.norm(across)
    base = np.stack([across, np.cross(towards, across), towards])
    turns = np.column_stack(
        [
            np.radians(rng.uniform(-reach_deg, reach_deg, (n_frames, 2))),
            rng.uniform(-np.pi, np.pi, n_frames),
        ]
    )
    if not rolling:
        turns[:, 2] = 0.0
    roll, tilt = turns.copy(), turns.copy()
    roll[:, :2], tilt[:, 2] = 0.0, 0.0
    attitudes = exp_rotation(roll) @ exp_rotation(tilt) @ base
    stars = load_catalogue(max_mag=_MAX_MAG, epoch=_EPOCH)
    obs = simulate(
        stars, paper_camera(), min_stars=3, sigma_px=_SIGMA_PX, seed=seed, attitudes=attitudes
    )
    return _catalogue_directions(obs, seed)


def _aberrated_at_one_pointing(n_frames: int, seed: int) -> Observations:
    return _aberrated_in_one_field(n_frames, seed, reach_deg=0.25, rolling=False)


def _refracted(n_frames: int, seed: int, *, rolling: bool) -> Observations:
    camera, obs = paper_camera(), _base(n_frames, seed)
    angle = (
        np.random.default_rng((seed, 3)).uniform(0.0, 2.0 * np.pi, obs.n_frames)
        if rolling
        else np.zeros(obs.n_frames)
    )
    zenith = np.stack([np.sin(angle), -np.cos(angle), np.ones_like(angle)], axis=1) / np.sqrt(2.0)
    zenith = np.repeat(zenith, obs.stars_per_frame, axis=0)
    b = unproject(camera, obs.xy)
    height = np.sum(b * zenith, axis=1, keepdims=True)
    return _moved(obs, project(camera, b + _REFRACTION_RAD * (zenith - height * b) / height))


def _rolling_horizon(n_frames: int, seed: int) -> Observations:
    return _refracted(n_frames, seed, rolling=True)


def _fixed_horizon(n_frames: int, seed: int) -> Observations:
    return _refracted(n_frames, seed, rolling=False)


def _pixel_phase(n_frames: int, seed: int) -> Observations:
    obs = _base(n_frames, seed)
    return _moved(
        obs,
        obs.xy + np.stack([0.1 * np.sin(2.0 * np.pi * obs.x_px), np.zeros(obs.n_stars)], axis=1),
    )


def _drifting(n_frames: int, seed: int) -> Observations:
    camera, obs = paper_camera(), _base(n_frames, seed)
    change = 2.0 * float(calibrate(obs, paper_start()).sigmas[2]) / camera.focal_px
    clock = np.searchsorted(obs.frame_ids, obs.frame) / (obs.n_frames - 1.0) - 0.5
    offset = obs.xy - camera.theta[:2]
    return _moved(obs, obs.xy + offset * (change * clock)[:, None])


def _moved(obs: Observations, xy: FloatArray) -> Observations:
    return replace(obs, x_px=xy[:, 0], y_px=xy[:, 1])


SCENARIOS = (
    Scenario("none (false alarms)", _base, ""),
    Scenario("k3: 1 px at the corner", _higher_order, "radial distortion beyond"),
    Scenario("decentring: 0.5 px at the corner", _decentred, "decentring"),
    Scenario("annual aberration left out, frames all over the sky", _aberrated, "aberration"),
    Scenario("annual aberration left out, frames within 8°", _aberrated_in_one_field, "aberration"),
    Scenario(
        "annual aberration left out, one pointing, never rolled",
        _aberrated_at_one_pointing,
        "aberration",
    ),
    Scenario("refraction at 45°, horizon fixed in the camera", _fixed_horizon, "scale and skew"),
    Scenario(
        "refraction at 45°, camera rolled at random",
        _rolling_horizon,
        "scale and shape that change",
    ),
    Scenario("pixel phase: 0.1 px in x", _pixel_phase, "error with the pixel phase in x"),
    Scenario("thermal drift of f: 2 σ over the run", _drifting, "linear drift"),
)


def power(scenario: Scenario, n: int, n_frames: int = 1000, seed: int = 1) -> Power:
    """Simulate, calibrate and test `n` times.

    `seed`: of the first replicate; the others follow.
    """
    specific, overall, errors, strongest = [], [], [], []
    truth = paper_camera().theta
    for index in range(n):
        obs = scenario.make(n_frames, seed + index)
        cal = calibrate(obs, paper_start(), throw=False)
        found = misfit_tests(obs, cal)
        chosen = [
            test.p_value < ALPHA for test in found.tests if test.name.startswith(scenario.test)
        ]
        specific.append(float(np.mean(chosen)))
        overall.append(found.p_value < ALPHA)
        errors.append((cal.theta - truth) / cal.sigmas)
        strongest.append(
            min(found.tests, key=lambda test: (test.p_holm, -abs(test.statistic))).name
        )
    names, counts = np.unique(strongest, return_counts=True)
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    worst = int(np.argmax(rms))
    return Power(
        name=scenario.name,
        n=n,
        specific=float(np.mean(specific)),
        overall=float(np.mean(overall)),
        strongest=str(names[int(np.argmax(counts))]),
        error=float(rms[worst]),
        worst=paper_camera().parameter_names[worst],
    )


def table(rows: Sequence[Power]) -> str:
    """The results as a table in Markdown."""
    lines = [
        "| Error of the model | Replicates | Its own test rejects (5 %) | Any test rejects, "
        "corrected (5 %) "
        "| Strongest test | Worst parameter: rms error / stated σ |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        first = row.name.startswith("none")
        digits = 3 if first else 2
        strongest = "–" if first else row.strongest
        lines.append(
            f"| {row.name} | {row.n} | "
            f"{row.specific:.{digits}f}{' (mean of all tests)' if first else ''} "
            f"| {row.overall:.{digits}f} | {strongest} | {row.error:.1f} ({row.worst}) |"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python verification/misfit_power.py", description=__doc__
    )
    parser.add_argument(
        "--replicates", type=int, default=100, help="replicates of each error (default 100)"
    )
    parser.add_argument(
        "--null", type=int, default=400, help="replicates without an error (default 400)"
    )
    parser.add_argument("--frames", type=int, default=1000, help="frames in each (default 1000)")
    parser.add_argument(
        "--seed", type=int, default=1, help="seed of the first replicate (default 1)"
    )
    options = parser.parse_args(arguments)
    rows = []
    for scenario in SCENARIOS:
        n = options.replicates if scenario.test else options.null
        rows.append(power(scenario, n, options.frames, options.seed))
        sys.stderr.write(f"{scenario.name}: done\n")
    sys.stdout.write(table(rows) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
