"""Real frames without a site: each frame predicted from the others, and attitudes by two models.

    python verification/ground.py TABLE CAMERA [--time UTC]

Frame by frame: the camera and its effects are estimated from the other frames, and the stars of the
one that is left out are predicted, without effects and with those that the data support. Chi-square
per degree of freedom of what the attitude of that frame leaves counts noise, camera, effects of the
run and the prior of effects of single frames; the log density compares the two. Then the attitudes
of all frames by two quite different models, the common rotation taken off: their difference beside
the stated errors of the rest, which should exceed it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import starcal_uq as sc
from starcal_uq.attitude.rotations import rotation_vector
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.status import Level
from starcal_uq.diagnostics.verdict.judge import judge
from starcal_uq.estimation.effects import without_effects
from starcal_uq.likelihood.effect_sums import Columns
from starcal_uq.likelihood.effects import effects_of
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.zenith import frame_axes

MODELS = (("brown", "auto"), ("none", "field,noise,phase,zenith"))


def seen(table: str | Path, camera: sc.Camera, time_utc: str | None = None) -> sc.Observations:
    """The table of frames at one time, which are taken for seen through unknown air."""
    obs = sc.load_observations(table, camera)
    if time_utc is None:
        return obs
    obs = replace(obs, time_utc=np.full(obs.n_stars, time_utc))
    return sc.sky.make_apparent(obs.with_origin(directions="catalogue"))


def predicted(obs: sc.Observations, cal: sc.Calibration, frame: int) -> tuple[float, int, float]:
    """Chi-square, degrees of freedom and log density of a frame of the table that the calibration
    has not seen.

    The attitude is integrated out, so that densities by different effects can be compared.
    """
    one = obs.select_frames([frame])
    found, variance = cal.effects, cal.sigma**2
    if cal.noise_model is not None:
        one = one.weighted(cal.noise_model.sigma_px(one), cal.noise_model.axes)
    for weighing in found.weighing if found else ():
        if weighing.dof is not None:  # The scale of a Student t is less than its deviation.
            variance *= weighing.dof / (weighing.dof - 2.0)
    likelihood = MarginalLikelihood(one, cal.camera.distortion)
    state, _ = likelihood.profile(cal.theta)
    h = state.slopes.reshape(len(cal.theta), -1)
    e = state.e.ravel()
    covariance = variance * np.eye(e.size)
    if found is None or not found.fitted:
        covariance += h.T @ cal.covariance @ h
    else:
        zeniths = None
        if found.zeniths is not None:
            assert not found.zeniths.apiece, "no frame tells the zenith of another"
            zeniths = replace(found.zeniths, frame_ids=obs.frame_ids, axes=frame_axes(obs)[0])
        others = obs.select_frames(np.setdiff1d(obs.frame_ids, [frame]))
        known = effects_of(others, cal.camera, seen=one, zeniths=zeniths)
        shifts = [known[effect.name] for effect in found.fitted]
        columns = Columns.of(shifts, likelihood, state, cal.theta, slice(None))
        run = columns.raw.reshape(len(columns.raw), e.size)
        own = columns.frame.reshape(len(columns.frame), e.size) * found.scale("frame")
        joint = np.block([[cal.covariance, found.cross], [found.cross.T, found.covariance]])
        shared = np.concatenate([h, run])
        covariance += shared.T @ joint @ shared + own.T @ own
        e = e - found.coefficients @ run
    turns = state.attitude.reshape(3, -1).T
    weight = np.linalg.inv(covariance)
    known_turns = turns.T @ weight @ turns
    best = np.linalg.solve(known_turns, turns.T @ weight @ e)
    rest = e - turns @ best
    chi2, dof = float(rest @ weight @ rest), e.size - 3
    determinants = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(known_turns)[1]
    widths = 2.0 * np.sum(np.log(one.sigma_px)) if one.sigma_px is not None else 0.0
    return chi2, dof, -0.5 * (chi2 + determinants + dof * np.log(2.0 * np.pi)) - float(widths)


def left_out(
    obs: sc.Observations, camera: sc.Camera, effects: str
) -> list[tuple[float, int, float]]:
    """Every frame predicted from the others."""
    found = []
    for frame in obs.frame_ids.tolist():
        others = obs.select_frames(np.setdiff1d(obs.frame_ids, [frame]))
        cal = sc.calibrate(others, camera, effects=effects)
        chi2, dof, density = predicted(obs, cal, frame)
        found.append((chi2, dof, density))
        names = ", ".join(names_of(cal))
        print(f"frame {frame}: {chi2 / dof:.2f} ({dof}), {density:.1f} nat, effects {names}")
    chi2, dof, density = np.sum(found, axis=0)
    print(
        f"all, {effects}: chi-square {chi2 / dof:.3f} per degree of freedom ({dof:.0f}), "
        f"{density:.1f} nat"
    )
    return found


def attitudes(
    obs: sc.Observations, camera: sc.Camera, models: Sequence[tuple[str, str]] = MODELS
) -> tuple[list[Level], dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Verdicts on two models, and for the camera alone and the effects aboard the rest (pitch, yaw,
    roll, arcsec) between their attitudes and by their errors; stars count alike.
    """
    levels, turned, errors, found = [], [], [], {}
    for model, effects in models:
        cal = sc.calibrate(obs, camera, model=model, effects=effects)
        post = sc.sample(obs, cal, seed=1)
        levels.append(judge(obs, cal, post, diagnosis=sc.diagnose(obs, cal, post)).level)
        print(f"{model}: effects {', '.join(names_of(cal))}; {levels[-1].name.lower()}")
        seen = {"model": obs, "effects": without_effects(obs, cal)}
        errors.append({o: sc.propagate(post, obs, onboard=o) for o in seen})
        likelihoods = {o: MarginalLikelihood(s, cal.camera.distortion) for o, s in seen.items()}
        turned.append({o: each.profile(cal.theta)[0].rotations for o, each in likelihoods.items()})
    for onboard in turned[0]:
        between = turned[0][onboard] @ np.swapaxes(turned[1][onboard], 1, 2)
        vectors = np.array([rotation_vector(one) for one in between]) * ARCSEC
        rest = np.sqrt(np.mean((vectors - vectors.mean(axis=0)) ** 2, axis=0))
        stated = np.sqrt(sum(e[onboard].rest_arcsec ** 2 for e in errors))
        common = np.sqrt(sum(e[onboard].common_arcsec ** 2 for e in errors))
        found[onboard] = (rest, stated)
        print(f"onboard {onboard}: pitch, yaw, roll, arcsec")
        print(f"  rest: {rest.round(3)} between the models, {stated.round(3)} by their errors")
        print(f"  common: {np.abs(vectors.mean(axis=0)).round(2)}, {common.round(2)}")
    return levels, found


def names_of(cal: sc.Calibration) -> tuple[str, ...]:
    return cal.effects.names if cal.effects else ("none",)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("table")
    parser.add_argument("camera")
    parser.add_argument("--time", help="one UTC time of all frames, whose aberration is applied")
    arguments = parser.parse_args()
    camera = sc.Camera.load(arguments.camera)
    obs = seen(arguments.table, camera, arguments.time)
    for effects in ("none", "auto"):
        left_out(obs, camera, effects)
    attitudes(obs, camera)


if __name__ == "__main__":
    main()
