"""The readings of the experiment itself, each repeated over seeds with the paper's three methods.

The paper contradicts itself about the direction of its distortion (eq. 6 against eq. 14), its
catalogue is not the embedded one, and its baselines are described in a sentence each. Every reading
here is one such choice; those that contradict the text are marked, and can at most explain a
number, not confirm it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple, Unpack

import numpy as np

from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model
from starcal_uq.camera.projection import unproject_jacobian
from starcal_uq.core.errors import StarcalError
from starcal_uq.core.status import Status
from starcal_uq.core.types import FloatArray, IntArray, floats
from starcal_uq.estimation.stages import Search, distortion_stage, joint_stage, optics_stage
from starcal_uq.likelihood.pairs import PairObjective
from starcal_uq.observations.frames import StarFrames
from starcal_uq.paper.camera import CONVENTIONS, paper_camera, paper_start
from starcal_uq.paper.errors import ERROR_READINGS, error_sizes, undistorted
from starcal_uq.paper.published import (
    LEAST_SQUARES,
    MAX_MAG,
    N_FRAMES,
    N_STARS,
    PROPOSED,
    SAMAAN,
    Printed,
)
from starcal_uq.paper.recursive.start import RecursionOptions
from starcal_uq.paper.replicates import pinhole
from starcal_uq.simulation.frames import Campaign
from starcal_uq.simulation.replicates import TrialOptions, Trials
from starcal_uq.sky.catalogue import load_catalogue

if TYPE_CHECKING:
    from starcal_uq.observations.table import Observations
    from starcal_uq.sky.catalogue import StarCatalogue


@dataclass(frozen=True, eq=False)
class Readings:
    """Draws (keys, n) of every reading over seeds, in the units of `Printed.quantity`; NaN where a
    method failed.
    """

    keys: tuple[Key, ...]
    draws: FloatArray

    @property
    def n_draws(self) -> int:
        """Seeds."""
        return int(self.draws.shape[1])

    def of(self, reading: str, method: str, quantity: str, error: str = "") -> FloatArray:
        """Finite draws (m,) of one key; empty where the reading does not concern the method."""
        key = Key(reading, method, quantity, error)
        values: FloatArray = self.draws[self.keys.index(key)] if key in self.keys else np.empty(0)
        return values[np.isfinite(values)]

    def trials_of(self, number: Printed) -> Iterator[tuple[str, bool, FloatArray]]:
        """Words, faithfulness and draws of every reading that gives this number's quantity, the
        main one first.
        """
        sizes = ERROR_READINGS.get(number.quantity, ())
        errors = {one.key: (one.words, one.faithful) for one in sizes} or {"": ("", True)}
        for reading in READINGS:
            for error, (words, allowed) in errors.items():
                draws = self.of(reading.key, number.method, number.quantity, error)
                if len(draws) > 1:
                    text = (
                        "; ".join(part for part in (reading.words, words) if part) or "as printed"
                    )
                    yield text, reading.faithful and allowed, draws


def run_readings(
    *,
    convention: str = "eq14",
    n_draws: int = 24,
    n_frames: int = N_FRAMES,
    seed: int = 2017,
    **run: Unpack[TrialOptions],
) -> Readings:
    """Repeat the experiment over seeds under every reading; parameters as in `replicate`.

    `convention` is the main reading of the distortion. Draw i depends on the seed and on i alone,
    and is none of the replicates of the same seed.
    """
    stars = load_catalogue(max_mag=MAX_MAG)
    # As many as the paper's, by the embedded catalogue's band.
    sparse = stars.select(np.sort(np.argsort(stars.mag, kind="stable")[:N_STARS]))
    plan = Plan(stars, sparse, convention, Campaign(n_frames))
    trials = Trials(partial(draw, plan), "reproduce", 1, (Key,), fatal=(StarcalError,))
    found = trials.run(n_draws, seed, whole=True, **run).good
    keys = tuple(found[0])
    return Readings(keys, np.array([[one.get(key, np.nan) for one in found] for key in keys]))


AS_PRINTED, OTHER_EQUATION, DIAGONAL = "as printed", "other equation", "diagonal"
FEW_FRAMES = 100
_PROCESS_NOISE_PX = 0.1
_MAX_STEPS = 20
_TOLERANCE_PX = 1e-7
# An estimate of a method, None where it failed.
Estimates = Mapping[str, Camera | None]


class Reading(NamedTuple):
    """A reading of the experiment: in words (empty for what is printed), and whether the paper's
    text allows it.
    """

    key: str
    words: str
    faithful: bool


READINGS = (
    Reading(AS_PRINTED, "", True),
    Reading(OTHER_EQUATION, "distortion by the other equation", True),
    Reading("sparse sky", f"a sky of {N_STARS} stars", True),
    Reading(DIAGONAL, "filter with pairs taken as independent", True),
    Reading("plain filter", "filter that linearises each frame once", True),
    Reading("process noise", f"filter with process noise of {_PROCESS_NOISE_PX} px a frame", True),
    Reading("eq. 6 signs", "coefficients by eq. 6 as printed", True),
    Reading("true attitudes", "coefficients from true attitudes and the estimated f", True),
    Reading("true points", "coefficients from the true ideal points", True),
    Reading("weighted pairs", "pairs weighted by their full covariance", False),
    Reading("angles", "angles instead of the cosines of eq. 5", False),
    Reading("few frames", f"{FEW_FRAMES} frames instead of {N_FRAMES}", False),
)


class Key(NamedTuple):
    """What a draw is of: a reading of the experiment, a method, a quantity, and the reading of an
    error size.
    """

    reading: str
    method: str
    quantity: str
    error: str


class Plan(NamedTuple):
    """What all draws share; sent once to every process."""

    stars: StarCatalogue
    sparse: StarCatalogue
    convention: str
    campaign: Campaign


class Scene(NamedTuple):
    """One simulated data set.

    `noise_px` (N, 2) is for the measures of error, which take the observed places for noise-free
    ones: it must not be the noise of the observations, which moved these places already.
    """

    truth: Camera
    start: Camera
    obs: Observations
    noise_px: FloatArray


def draw(plan: Plan, _number: int, sequence: np.random.SeedSequence) -> dict[Key, float]:
    """One seed under every reading; a method without a result leaves its keys out."""
    # The second branch keeps these seeds apart from those of `replicate`.
    seeds = [int(s) for s in sequence.spawn(2)[1].generate_state(4, np.uint64)]
    rng = np.random.default_rng(seeds[3])
    other = next(name for name in CONVENTIONS if name != plan.convention)
    found: dict[Key, float] = {}
    for reading, convention, stars, seed in (
        (AS_PRINTED, plan.convention, plan.stars, seeds[0]),
        (OTHER_EQUATION, other, plan.stars, seeds[1]),
        ("sparse sky", plan.convention, plan.sparse, seeds[2]),
    ):
        truth, start = paper_camera(convention), paper_start(convention)
        obs = plan.campaign.simulate(stars, truth, seed)
        scene = Scene(
            truth, start, obs, plan.campaign.sigma_px * rng.standard_normal((obs.n_stars, 2))
        )
        readings = {reading: paper_methods(obs, start)}
        if reading == AS_PRINTED:
            readings["few frames"] = paper_methods(
                obs.select_frames(obs.frame_ids[:FEW_FRAMES]), start
            )
            readings |= alternatives(scene, readings[AS_PRINTED])
        for key, estimates in readings.items():
            found |= measured(scene, key, estimates)
    return found


def paper_methods(obs: Observations, start: Camera) -> Estimates:
    """The three methods of the paper's Table 2 on one data set."""
    frames = StarFrames.from_observations(obs)
    optics = optics_stage(frames, start, Search())
    linear = distortion_stage(frames, start, optics.theta)
    objective = PairObjective(frames, start.distortion)
    joint = joint_stage(objective, start, linear.theta, Search())
    return {
        LEAST_SQUARES: pinhole(start, optics.theta) if optics.status.ok else None,
        SAMAAN: _recursive(obs, start, "samaan"),
        PROPOSED: start.with_theta(joint.theta) if joint.status.ok else None,
    }


def _recursive(
    obs: Observations, start: Camera, method: str, options: RecursionOptions | None = None
) -> Camera | None:
    try:
        # As a stream: the same estimate, without the time that residuals take.
        found = calibrate([obs], start, method=method, recursion=options, throw=False)
    except StarcalError:
        return None
    # A filter that linearises every frame once says so by its status, and is what was asked for.
    return found.camera if found.status in (Status.CONVERGED, Status.MAX_ITERATIONS) else None


def alternatives(scene: Scene, printed: Estimates) -> dict[str, Estimates]:
    """The readings that need no other data set, by name; `printed` are the estimates of
    `paper_methods`.
    """
    obs, start = scene.obs, scene.start
    found: dict[str, Estimates] = {
        name: {SAMAAN: _recursive(obs, start, "samaan", options)}
        for name, options in (
            ("plain filter", RecursionOptions(iterations=1)),
            (
                "process noise",
                RecursionOptions(process_noise=_PROCESS_NOISE_PX, sigma_px=obs.origin.sigma_px),
            ),
        )
    }
    filtered = printed[SAMAAN]
    if filtered is not None:
        found |= {
            name: {SAMAAN: camera} for name, camera in _other_coefficients(scene, filtered).items()
        }
        # The filter's optics are those of one least-squares problem over all frames.
        found["weighted pairs"] = {LEAST_SQUARES: pinhole(start, filtered.theta)}
    optics_camera, joint_camera = printed[LEAST_SQUARES], printed[PROPOSED]
    if optics_camera is not None and joint_camera is not None:
        found["angles"] = {
            LEAST_SQUARES: pinhole(start, fit_angles(obs, "none", optics_camera.theta)),
            PROPOSED: start.with_theta(fit_angles(obs, start.distortion, joint_camera.theta)),
        }
    return found


def _other_coefficients(scene: Scene, filtered: Camera) -> dict[str, Camera]:
    """Coefficients by linear least squares at the filter's optics, from other ideal points or with
    other signs.
    """
    truth, obs = scene.truth, scene.obs
    centre = filtered.theta[:2]
    ideal = undistorted(truth, obs.xy)
    measured_at = obs.xy + scene.noise_px - centre
    scaled = (ideal - truth.theta[:2]) * (filtered.focal_px / truth.focal_px)
    frames = StarFrames.from_observations(obs)
    # Eq. 6 with the sign that is printed, on data and attitudes as in the second stage.
    crossed = filtered.replace(distortion="inverse" if filtered.distortion == "brown" else "brown")
    signs = distortion_stage(frames, crossed, filtered.theta).theta
    return {
        "eq. 6 signs": filtered.with_theta(signs),
        "true attitudes": _with_coefficients(filtered, scaled, measured_at),
        "true points": _with_coefficients(filtered, ideal - centre, measured_at),
    }


def _with_coefficients(camera: Camera, ideal: FloatArray, seen: FloatArray) -> Camera:
    """The camera with the coefficients that take ideal to measured offsets (N, 2) best."""
    model = get_model(camera.distortion)
    forward = model.direction == "forward"
    at, target = (ideal, seen - ideal) if forward else (seen, ideal - seen)
    units = np.eye(len(model.coefficients))
    columns = [
        np.concatenate(model.displacement(at[:, 0], at[:, 1], tuple(unit))) for unit in units
    ]
    design = np.stack(columns, axis=1)
    scale = np.linalg.norm(design, axis=0)
    k = np.linalg.lstsq(design / scale, target.T.ravel(), rcond=None)[0] / scale
    return camera.replace(coefficients=tuple(k.tolist()))


def measured(scene: Scene, reading: str, estimates: Estimates) -> dict[Key, float]:
    """Parameters and errors of every estimate."""
    found: dict[Key, float] = {}
    for method, camera in estimates.items():
        if camera is None:
            continue
        values = {
            "x0_px": camera.x0_px,
            "y0_px": camera.y0_px,
            "f_mm": camera.length_mm(camera.focal_px),
        }
        values |= dict(zip(("k1", "k2"), camera.coefficients, strict=False))
        values["y0_error_px"] = abs(camera.y0_px - scene.truth.y0_px)
        found |= {
            Key(reading, method, quantity, ""): float(value) for quantity, value in values.items()
        }
        for quantity, choice, value in error_sizes(
            scene.truth, camera, scene.obs.xy, scene.noise_px
        ):
            found[Key(reading, method, quantity, choice.key)] = value
    return found


def fit_angles(obs: Observations, model: str, start: FloatArray) -> FloatArray:
    """Gauss-Newton on the differences of all angles between stars of a frame, all pairs alike; (p,)
    px units.

    The paper's objective (its eqs. 5 and 13) compares cosines, whose errors are those of the angles
    times their sine: wide pairs count most. An implementation that compares angles weighs all pairs
    alike, and, where distortion is ignored, ends at another focal length. `start` (p,) is near
    enough for full steps, such as the solution for the cosines.
    """
    i, j = _pairs(obs.frame_starts)
    r = obs.directions_icrs
    given = _angle(r[i], r[j])[0]
    theta = floats(start)
    for _ in range(_MAX_STEPS):
        b, db = unproject_jacobian(model, theta, obs.xy)
        angle, sine = _angle(b[i], b[j])
        slope = (
            -(np.einsum("ni,nip->np", b[j], db[i]) + np.einsum("ni,nip->np", b[i], db[j]))
            / sine[:, None]
        )
        scale = np.linalg.norm(slope, axis=0)
        slope /= scale
        step = np.linalg.solve(slope.T @ slope, slope.T @ (given - angle)) / scale
        theta = theta + step
        if float(np.max(np.abs(step[:3]))) < _TOLERANCE_PX:
            break
    return theta


def _pairs(starts: IntArray) -> tuple[IntArray, IntArray]:
    """Rows of the two stars of every pair within a frame."""
    blocks = [np.stack(np.triu_indices(b - a, 1)) + a for a, b in pairwise(starts.tolist())]
    i, j = np.concatenate(blocks, axis=1)
    return i, j


def _angle(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Angles between unit vectors (n, 3), rad, and their sines; both good for small angles."""
    sine = np.linalg.norm(np.cross(a, b), axis=1)
    return np.arctan2(sine, np.einsum("ni,ni->n", a, b)), sine
