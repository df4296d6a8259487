"""Many calibration campaigns of one sensor with known true attitudes, and what attitude errors they
make.

Run as ``python -m tests.helpers.attitude_campaigns`` for the table of the documentation.

Every campaign has its own noise on the same stars. The camera that it would estimate is the linear,
efficient one, theta = truth + G e with G = (M^T M)^-1 M^T and M the derivatives of the pixels after
each frame's attitude has been projected out; derivatives are central differences of `project`, so
that nothing of the likelihood or of the propagation is used. The full calibration of a few
campaigns shows how near that is. Attitudes are exact: noise and cameras go through QUEST as they
are.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from starcal_uq.attitude.rotations import exp_rotation, left_error
from starcal_uq.attitude.wahba import quest
from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.projection import project, unproject_theta
from starcal_uq.observations.table import Observations
from starcal_uq.paper.camera import paper_camera, paper_start
from starcal_uq.propagation.attitude_error import AttitudeError
from starcal_uq.simulation.frames import simulate
from starcal_uq.sky.catalogue import load_catalogue

ARCSEC = 648_000.0 / np.pi
PARTS = ("nea", "common", "rest")
_BATCH = 25


@dataclass(frozen=True)
class Campaigns:
    """Root mean squares (3,) over campaigns and frames, and coverage (4,) of stated half-widths, by
    part.

    `together` is the root mean square of the whole error; `correlation` (3,) that of noise and
    calibration.
    """

    rms: dict[str, np.ndarray]
    coverage: dict[str, np.ndarray]
    together: np.ndarray
    interaction: np.ndarray
    correlation: np.ndarray
    n: int


def clean_frames(n_frames: int, seed: int = 2017, max_mag: float = 6.0) -> Observations:
    """Noise-free frames of the paper's sensor."""
    stars = load_catalogue(max_mag=max_mag, epoch=2026.9)
    return simulate(stars, paper_camera(), n_frames=n_frames, min_stars=10, sigma_px=0.0, seed=seed)


def with_noise(clean: Observations, e: np.ndarray) -> Observations:
    return dataclasses.replace(clean, x_px=clean.x_px + e[:, 0], y_px=clean.y_px + e[:, 1])


def linear_estimator(clean: Observations, truth: Camera) -> np.ndarray:
    """G (p, N, 2): estimate minus truth of the efficient estimator per px of noise."""
    b, starts = unproject_theta(truth.distortion, truth.theta, clean.xy), clean.frame_starts
    step = np.array([1e-3, 1e-3, 1e-2, 1e-12, 1e-17])

    def derivative(plus: np.ndarray, minus: np.ndarray, h: float) -> np.ndarray:
        return (plus - minus) / (2.0 * h)

    columns = [
        derivative(
            *(project(truth.with_theta(truth.theta + sign * h * unit), b) for sign in (1.0, -1.0)),
            h=h,
        )
        for h, unit in zip(step, np.eye(5), strict=True)
    ]
    turns = [
        derivative(
            *(project(truth, b @ exp_rotation(sign * 1e-6 * axis).T) for sign in (1.0, -1.0)),
            h=1e-6,
        )
        for axis in np.eye(3)
    ]
    H, A = np.stack(columns, axis=-1), np.stack(turns, axis=-1)
    M = np.empty_like(H)
    for i, j in pairwise(starts):
        q, _ = np.linalg.qr(A[i:j].reshape(-1, 3))
        rows = H[i:j].reshape(-1, 5)
        M[i:j] = (rows - q @ (q.T @ rows)).reshape(H[i:j].shape)
    flat = M.reshape(-1, 5)
    scale = np.linalg.norm(flat, axis=0)
    G = np.linalg.pinv(flat / scale) / scale[:, None]
    return G.reshape(5, *clean.xy.shape)


def some_frames(obs: Observations, every: int) -> Observations:
    """Every so many frames one of them."""
    return obs.select_frames(obs.frame_ids[::every])


def fly(
    clean: Observations,
    stated: Sequence[AttitudeError],
    *,
    n: int,
    every: int = 1,
    sigma_px: float = 0.05,
    seed: int = 1,
) -> list[Campaigns]:
    """Attitude errors of n campaigns on these frames against the truth, and how often stated
    half-widths hold.

    All frames make the estimate; attitudes, and the alignment, are those of `some_frames`.
    """
    truth = paper_camera()
    flown = some_frames(clean, every)
    model, r, starts, xy = truth.distortion, flown.directions_icrs, flown.frame_starts, flown.xy
    seen = np.isin(
        np.repeat(np.arange(clean.n_frames), np.diff(clean.frame_starts)),
        np.arange(clean.n_frames)[::every],
    )
    G = linear_estimator(clean, truth)

    def attitudes(thetas: np.ndarray, xy: np.ndarray) -> np.ndarray:
        b = np.stack([unproject_theta(model, t, p) for t, p in zip(thetas, xy, strict=True)])
        return quest(b, r, starts, covariance=False).quaternions

    true = attitudes(truth.theta[None], xy[None])
    # Alignment on these frames: the mean weighted by the inverse covariances from noise.
    b = unproject_theta(model, truth.theta, xy)
    weights = np.add.reduceat(np.eye(3) - b[:, :, None] * b[:, None, :], starts[:-1])
    weights = np.linalg.inv(weights.sum(axis=0)) @ weights
    rng = np.random.default_rng(seed)
    parts = (*PARTS, "together", "interaction")
    squares = {part: np.zeros(3) for part in parts}
    held = [{part: np.zeros(4) for part in PARTS} for _ in stated]
    product = np.zeros(3)
    for first in range(0, n, _BATCH):
        count = min(_BATCH, n - first)
        e = sigma_px * rng.standard_normal((count, *clean.xy.shape))
        thetas = truth.theta + np.einsum("cna,pna->cp", e, G)
        same, noisy = np.broadcast_to(truth.theta, thetas.shape), xy + e[:, seen]
        noise = left_error(attitudes(same, noisy), true) * ARCSEC
        camera = left_error(attitudes(thetas, np.broadcast_to(xy, noisy.shape)), true) * ARCSEC
        both = left_error(attitudes(thetas, noisy), true) * ARCSEC
        common = np.einsum("kij,ckj->ci", weights, camera)[:, None]
        errors = {
            "nea": noise,
            "common": common,
            "rest": camera - common,
            "together": both,
            "interaction": both - camera - noise,
        }
        for part, values in errors.items():
            squares[part] += np.mean(values**2, axis=1).sum(axis=0)
        for row, part in enumerate(PARTS):
            a = np.abs(errors[part])
            a = np.concatenate((a, np.hypot(a[..., :1], a[..., 1:2])), axis=-1)
            for counts, error in zip(held, stated, strict=True):
                counts[part] += np.mean(a <= error.p95_arcsec[row], axis=1).sum(axis=0)
        product += np.mean(noise * camera, axis=1).sum(axis=0)
    rms = {part: np.sqrt(value / n) for part, value in squares.items()}
    correlation = product / n / (rms["nea"] * np.hypot(rms["common"], rms["rest"]))
    return [
        Campaigns(
            rms={part: rms[part] for part in PARTS},
            coverage={part: counts[part] / n for part in PARTS},
            together=rms["together"],
            interaction=rms["interaction"],
            correlation=correlation,
            n=n,
        )
        for counts in held
    ]


def sigmas_of(error: AttitudeError) -> dict[str, np.ndarray]:
    return {"nea": error.nea_arcsec, "common": error.common_arcsec, "rest": error.rest_arcsec}


def failures(flown: Campaigns, error: AttitudeError, slack: float = 0.03) -> set[str]:
    """Parts whose stated sigma is off by more than `slack`, or whose 95 % half-widths do not hold
    93 to 97 %.
    """
    wrong = {
        part
        for part in PARTS
        if np.abs(sigmas_of(error)[part] / flown.rms[part] - 1.0).max() > slack
    }
    return wrong | {part for part in PARTS if np.abs(flown.coverage[part] - 0.95).max() > 0.02}


def main() -> None:
    """One real campaign from pixels to its propagated posterior, then many others against it."""
    import starcal_uq as sc

    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--campaigns", type=int, default=5000)
    options = parser.parse_args()
    clean = clean_frames(options.frames)
    obs = with_noise(clean, 0.05 * np.random.default_rng(0).standard_normal(clean.xy.shape))
    cal = calibrate(obs, paper_start())
    error = sc.propagate(sc.sample(obs, cal, seed=1), obs, alignment="observed")
    columns = ["contributor", "axis", "if_model_holds_arcsec", "p95_if_model_holds_arcsec"]
    print(error.to_dataframe()[columns].to_string(index=False))
    print(error.text)
    (flown,) = fly(clean, [error], n=options.campaigns)
    print(
        f"\n{flown.n} campaigns of {clean.n_frames} frames: pitch, yaw, roll (and across the "
        "boresight)"
    )
    for part, sigma in sigmas_of(error).items():
        print(
            f"{part:7s} sigma {flown.rms[part]} arcsec, stated over found {sigma / flown.rms[part]}"
        )
        print(f"{'':7s} 95 % half-widths hold {100.0 * flown.coverage[part]} %")
    print(f"interaction {flown.interaction}, stated {error.interaction_arcsec}")
    print(f"together {flown.together}; correlation of noise and calibration {flown.correlation}")
    print(f"failures: {sorted(failures(flown, error)) or 'none'}")


if __name__ == "__main__":
    np.set_printoptions(precision=4, suppress=True)
    main()
