"""Real frames without a site: each frame predicted from the others, and attitudes by two models.

    python benchmarks/ground.py TABLE CAMERA [--time UTC]

Frame by frame: the camera and its effects are estimated from the other frames, and the stars of the
one that is left out are predicted. Chi-square per degree of freedom of what the attitude of that
frame leaves counts noise, camera, effects of the run and the prior of effects of single frames. Then
the attitudes of all frames by two quite different models, the common rotation taken off: their
difference against the stated errors of the rest, which should exceed it.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import starcal_uq as sc
from starcal_uq.attitude.rotations import quaternion_to_rotation, rotation_vector
from starcal_uq.core.constants import ARCSEC
from starcal_uq.likelihood.effect_sums import Columns
from starcal_uq.likelihood.effects import effects_of
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.zenith import frame_axes

MODELS = (("brown", "auto"), ("k1", "field,frame"))


def predicted(obs: sc.Observations, cal: sc.Calibration, frame: int) -> tuple[float, int]:
    """Chi-square and degrees of freedom of a frame of the table that the calibration has not seen."""
    one = obs.select_frames([frame])
    found, sigma = cal.effects, cal.sigma
    if cal.noise_model is not None:
        one = one.weighted(cal.noise_model.sigma_px(one), cal.noise_model.axes)
    likelihood = MarginalLikelihood(one, cal.camera.distortion, axes=True)
    state, _ = likelihood.profile(cal.theta)
    zeniths = None
    if found.zeniths is not None:
        assert not found.zeniths.apiece, "no frame tells the zenith of another"
        zeniths = replace(found.zeniths, frame_ids=obs.frame_ids, axes=frame_axes(obs)[0])
    others = obs.select_frames(np.setdiff1d(obs.frame_ids, [frame]))
    known = effects_of(others, cal.camera, seen=one, zeniths=zeniths)
    columns = Columns.of(
        [known[name] for name in found.names], likelihood, state, cal.theta, slice(None)
    )
    h = likelihood.project_out(state, likelihood.derivatives(cal.theta, state))
    joint = np.block([[cal.covariance, found.cross], [found.cross.T, found.covariance]])
    shared = np.concatenate([h, columns.run]).reshape(len(joint), state.e.size)
    own = columns.frame.reshape(len(columns.frame), state.e.size) * found.scale("frame")
    e = likelihood.project_out(state, state.e[None]).ravel()
    e = e - found.coefficients @ columns.run.reshape(len(columns.run), state.e.size)
    turns = state.attitude.reshape(3, -1)
    left = np.linalg.svd(turns, full_matrices=True)[2][3:]
    covariance = sigma**2 * np.eye(e.size) + shared.T @ joint @ shared + own.T @ own
    rest = left @ e
    return float(rest @ np.linalg.solve(left @ covariance @ left.T, rest)), len(rest)


def left_out(obs: sc.Observations, camera: sc.Camera, noise: str) -> None:
    """Every frame predicted from the others."""
    found = []
    for frame in obs.frame_ids.tolist():
        others = obs.select_frames(np.setdiff1d(obs.frame_ids, [frame]))
        cal = sc.calibrate(others, camera, effects="auto", noise=noise)
        chi2, dof = predicted(obs, cal, frame)
        found.append((chi2, dof))
        print(f"frame {frame}: {chi2 / dof:.2f} ({dof}), effects {', '.join(cal.effects.names)}")
    chi2, dof = np.sum(found, axis=0)
    print(f"all, noise {noise}: chi-square {chi2 / dof:.3f} per degree of freedom ({dof:.0f})")


def attitudes(obs: sc.Observations, camera: sc.Camera) -> None:
    """Attitudes by two models, by the cameras alone and with their effects."""
    cals, errors = [], []
    for model, effects in MODELS:
        cal = sc.calibrate(obs, camera, model=model, effects=effects)
        post = sc.sample(obs, cal, seed=1)
        cals.append(cal)
        errors.append({o: sc.propagate(post, obs, onboard=o) for o in ("model", "effects")})
        print(f"{model}: effects {', '.join(cal.effects.names)}, noise {cal.sigma:.4f}")
    for onboard in ("model", "effects"):
        turned = []
        for cal in cals:
            rotations = quaternion_to_rotation(cal.quaternions)
            if onboard == "model":
                likelihood = MarginalLikelihood(obs, cal.camera.distortion)
                rotations = likelihood.profile(cal.theta, rotations)[0].rotations
            turned.append(rotations)
        between = turned[0] @ np.swapaxes(turned[1], 1, 2)
        vectors = np.array([rotation_vector(one) for one in between]) * ARCSEC
        rest = np.sqrt(np.mean((vectors - vectors.mean(axis=0)) ** 2, axis=0))
        stated = np.sqrt(sum(e[onboard].rest_arcsec ** 2 for e in errors))
        common = np.sqrt(sum(e[onboard].common_arcsec ** 2 for e in errors))
        print(f"onboard {onboard}: pitch, yaw, roll, arcsec")
        print(f"  rest: {rest.round(3)} between the models, {stated.round(3)} by their errors")
        print(f"  common: {np.abs(vectors.mean(axis=0)).round(2)}, {common.round(2)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("table")
    parser.add_argument("camera")
    parser.add_argument("--time", help="one UTC time of all frames, whose aberration is applied")
    arguments = parser.parse_args()
    camera = sc.Camera.load(arguments.camera)
    obs = sc.load_observations(arguments.table, camera)
    if arguments.time:
        obs = replace(obs, time_utc=np.full(obs.n_stars, arguments.time))
        obs = sc.sky.make_apparent(obs.with_origin(directions="catalogue"))
    for noise in ("common", "model"):
        left_out(obs, camera, noise)
    attitudes(obs, camera)


if __name__ == "__main__":
    main()
