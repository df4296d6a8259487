"""Star identification on random frames, beside tetra3rs on the same frames.

    python benchmarks/identify.py [--frames 1000] [--seed 2004]

A frame is correct when at least four stars are identified and all of them rightly; wrong when a
single one is not. Brightness is known to 0.2 mag; a false star has the magnitude of any star of the
catalogue and lies anywhere. tetra3rs gives positions of its own catalogue, which are compared with
the truth within two pixels; it is left out where it is not installed. Every frame is identified by
itself. "Failed" frames have four centroids or more and no attitude.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from time import perf_counter
from types import SimpleNamespace
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import starcal_uq as sc
from starcal_uq.attitude.rotations import random_rotations
from starcal_uq.identification.engine import identify
from starcal_uq.simulation.frames import Sky
from starcal_uq.sky.positions import unit_vectors

SIZE_PX, SIGMA_PX, EPOCH = 1024, 0.3, 2026.0


@dataclass(frozen=True)
class Frame:
    """Centroids, brightest first, and the catalogue row of each (-1 for a false star)."""

    xy: Any
    flux: Any
    star: Any
    rotation: Any


def camera(fov_deg: float, focal: float = 1.0, shift_px: float = 0.0) -> sc.Camera:
    """A square camera of this field, perhaps off its nominal values."""
    focal_px = focal * SIZE_PX / 2.0 / np.tan(np.radians(fov_deg / 2.0))
    centre = (SIZE_PX - 1) / 2.0 + shift_px
    return sc.Camera(SIZE_PX, SIZE_PX, 10.0, focal_px / 100.0, centre, centre)


def random_frames(
    stars: Any, cam: sc.Camera, n: int, seed: int, false: int, missing: float
) -> list[Frame]:
    """Frames at random attitudes, whatever number of stars they show."""
    rng = np.random.default_rng(seed)
    rotations = random_rotations(n, rng)
    frames = []
    for rotation, (star, xy) in zip(
        rotations, Sky(stars, cam, 6.0 * SIGMA_PX).views(rotations), strict=True
    ):
        seen = rng.random(len(star)) >= missing
        star, xy = star[seen], xy[seen] + SIGMA_PX * rng.standard_normal((int(seen.sum()), 2))
        mag = stars.mag[star] + 0.2 * rng.standard_normal(len(star))
        star = np.concatenate([star, np.full(false, -1)])
        xy = np.concatenate([xy, rng.random((false, 2)) * (SIZE_PX - 1)])
        mag = np.concatenate([mag, rng.choice(stars.mag, false)])
        order = np.argsort(mag)
        frames.append(Frame(xy[order], 10.0 ** (-0.4 * mag[order]), star[order], rotation))
    return frames


@dataclass(frozen=True)
class Score:
    """Shares of frames, and times in ms."""

    correct: float
    wrong: float
    median_ms: float
    p95_ms: float
    failed_ms: float


def score(correct: float, wrong: float, times: Any, failed: Any) -> Score:
    """Percentiles of the times, and the median of those without a result."""
    slow = float(np.median(failed)) if len(failed) else float("nan")
    return Score(correct, wrong, float(np.median(times)), float(np.percentile(times, 95)), slow)


def score_ours(frames: list[Frame], stars: Any, nominal: sc.Camera) -> Score:
    """`identify`, each frame by itself."""
    n = [len(f.xy) for f in frames]
    xy = np.concatenate([f.xy for f in frames])
    table: Any = SimpleNamespace(
        frame=np.repeat(np.arange(len(frames)), n),
        x_px=xy[:, 0],
        y_px=xy[:, 1],
        flux=np.concatenate([f.flux for f in frames]),
        sigma_px=np.full(len(xy), SIGMA_PX),
        frame_ids=np.arange(len(frames)),
        image=[""] * len(frames),
        time_utc=[None] * len(frames),
    )
    found = identify(table, nominal, stars, share_camera=False, cache=False)
    row = {
        (f, x): i
        for i, (f, x) in enumerate(zip(table.frame.tolist(), table.x_px.tolist(), strict=True))
    }
    truth = np.concatenate([f.star for f in frames])
    o = found.observations
    at = np.array(
        [row[key] for key in zip(o.frame.tolist(), o.x_px.tolist(), strict=True)], dtype=int
    )
    true_id = np.where(truth[at] >= 0, stars.star_id[truth[at]], "")
    bad = np.unique(o.frame[o.star_id != true_id])
    done = sum(f.status == "identified" for f in found.frames)
    times = [f.milliseconds for f in found.frames if f.status != "too few stars"]
    failed = [f.milliseconds for f in found.frames if f.status in ("not identified", "ambiguous")]
    wrong = len(bad) / len(frames)
    return score(done / len(frames) - wrong, wrong, times, failed)


def score_tetra3rs(
    frames: list[Frame], stars: Any, nominal: sc.Camera, database: Any, off: bool
) -> Score:
    """tetra3rs; its field may be off by what ours may."""
    import tetra3rs

    model = tetra3rs.CameraModel(nominal.focal_px, SIZE_PX, SIZE_PX)
    centre = (SIZE_PX - 1) / 2.0
    correct = wrong = 0
    times, failed = [], []
    for f in frames:
        if len(f.xy) < 4:
            continue
        centroids = np.column_stack([f.xy - centre, f.flux])
        began = perf_counter()
        result = database.solve_from_centroids(
            centroids,
            camera_model=model,
            fov_max_error_deg=0.035 * nominal.fov_deg[0] if off else None,
            observer_velocity_km_s=None,
            solve_timeout_ms=1000,
        )
        times.append(1e3 * (perf_counter() - began))
        if not result:
            failed.append(times[-1])
            continue
        index = np.asarray(result.matched_centroids, dtype=int)
        known = [database.get_star_by_id(int(i)) for i in result.matched_catalog_ids]
        theirs = unit_vectors(
            np.array([s.ra_deg for s in known]), np.array([s.dec_deg for s in known])
        )
        true = f.star[index]
        apart = np.linalg.norm(theirs - stars.directions_icrs[true], axis=1)
        right = (true >= 0) & (apart < 2.0 / nominal.focal_px)
        if right.all() and len(index) >= 4:
            correct += 1
        elif not right.all():
            wrong += 1
    n = len(frames)
    return score(correct / n, wrong / n, times, failed)


CASES = {
    "exact camera": (1.0, 0.0, 0, 0.0),
    "3 % and 20 px off": (1.03, 20.0, 0, 0.0),
    "10 false, 30 % missing": (1.0, 0.0, 10, 0.3),
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=2004)
    parser.add_argument("--fields", type=float, nargs="+", default=[8.0, 12.0, 20.0])
    parser.add_argument("--max-mag", type=float, default=6.0)
    parser.add_argument("--no-rival", action="store_true")
    arguments = parser.parse_args()
    try:
        import tetra3rs
    except ImportError:
        tetra3rs = None
        print("tetra3rs is not installed: its columns are left out.")
    if arguments.no_rival:
        tetra3rs = None
    stars = sc.load_catalogue(arguments.max_mag, epoch=EPOCH)
    table = Table(
        title=f"{arguments.frames} random frames each, stars to G = {arguments.max_mag:g}"
    )
    for name in (
        "field",
        "case",
        "engine",
        "correct",
        "wrong",
        "median ms",
        "95 % ms",
        "failed ms",
    ):
        table.add_column(name)
    for fov in arguments.fields:
        database = None
        if tetra3rs is not None:
            database = tetra3rs.SolverDatabase.generate_from_gaia(
                max_fov_deg=fov * 1.05,
                min_fov_deg=fov * 0.95,
                star_max_magnitude=arguments.max_mag,
                epoch_proper_motion_year=EPOCH,
            )
        for case, (focal, shift, false, missing) in CASES.items():
            frames = random_frames(
                stars, camera(fov, focal, shift), arguments.frames, arguments.seed, false, missing
            )
            few = np.mean([np.sum(f.star >= 0) < 4 for f in frames])
            scores = {"starcal_uq": score_ours(frames, stars, camera(fov))}
            if database is not None:
                scores["tetra3rs"] = score_tetra3rs(
                    frames, stars, camera(fov), database, focal != 1.0
                )
            for engine, s in scores.items():
                table.add_row(
                    f"{fov:g} deg",
                    f"{case} ({100 * few:.1f} % of frames have < 4 stars)",
                    engine,
                    f"{100 * s.correct:.2f} %",
                    f"{100 * s.wrong:.2f} %",
                    f"{s.median_ms:.2f}",
                    f"{s.p95_ms:.1f}",
                    "" if np.isnan(s.failed_ms) else f"{s.failed_ms:.1f}",
                )
    Console(width=150).print(table)


if __name__ == "__main__":
    main()
