"""Cameras of all kinds that nothing is known of, or something wrong: how many frames are identified, how many wrongly.

    python benchmarks/unknown.py [--cameras 100] [--frames 5] [--pixels] [--seed 1]

Every camera has its own field of view (1 to 80 degrees, evenly in its logarithm; ``--fields`` narrows it), detector
(256 to 4096 px), lens (up to 0.3 % of distortion at the corner, principal point up to 1 % of the width off), depth,
noise, missing stars and false ones (hot pixels, and clusters as from the Moon, clouds and a horizon); its frames look
anywhere on the sky. The sheet is missing, right, or 20 to 50 % wrong, in turns. Frames are made here with NumPy alone,
of the catalogue's places; with ``--pixels`` they are rendered, with defocus, hot pixels, streaks, the Moon and a
horizon painted in, and their stars are measured.

A frame counts where it shows at least six true stars among its thirty brightest. A star is wrong when its name is, a
frame when at least half of its stars are; attitudes also hold the offset of the principal point. Intervals are Clopper
and Pearson's, 95 %.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from types import SimpleNamespace
from typing import Any

import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import starcal_uq as sc  # noqa: E402
from starcal_uq.pipeline.depth import identify_to_depth  # noqa: E402

EPOCH = 2020.0
SHEETS = ("none", "right", "20 % off", "50 % off")
LEAST, BRIGHTEST = 6, 30


@dataclass(frozen=True)
class Made:
    """A camera without errors in its sheet, and its frames: rotations, stars by place, and whether they count."""

    camera: sc.Camera
    table: Any
    rotations: Any
    names: dict[tuple[int, float], str]
    counts: Any


def random_rotation(rng: np.random.Generator) -> Any:
    """Anywhere, by the QR decomposition of normal numbers."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else q[[1, 0, 2]]


def seen_by(stars: Any, rotation: Any, camera: sc.Camera, bend: float, offset: Any) -> tuple[Any, Any]:
    """Rows and places of the stars on the detector: a pinhole with a cubic displacement of its own formula."""
    b = stars.directions_icrs @ rotation.T
    corner = 0.5 * np.hypot(camera.width_px, camera.height_px)
    ahead = np.flatnonzero(b[:, 2] > np.cos(np.arctan(1.1 * corner / camera.focal_px)))
    u = camera.focal_px * b[ahead, :2] / b[ahead, 2:]
    u = u * (1.0 + bend * np.sum(u * u, axis=1) / corner**2)[:, None]
    xy = u + np.array(camera.centre_px) + offset
    on = np.all((xy > 0) & (xy < [camera.width_px - 1, camera.height_px - 1]), axis=1)
    return ahead[on], xy[on]


def make_camera(rng: np.random.Generator, fields: tuple[float, float]) -> tuple[sc.Camera, float, Any]:
    """A sheet, and how the lens differs from it: distortion at the corner and the offset of the principal point."""
    width = int(rng.choice([256, 512, 1024, 2048, 4096]))
    height = int(width * rng.choice([1.0, 0.75, 0.625]))
    fov = np.exp(rng.uniform(*np.log(fields)))
    focal_px = 0.5 * width / np.tan(np.radians(0.5 * fov))
    camera = sc.Camera(width, height, 5.0, focal_px * 5e-3, (width - 1) / 2, (height - 1) / 2)
    return camera, rng.uniform(-0.003, 0.003), 0.01 * width * rng.uniform(-1.0, 1.0, 2)


def make_frames(rng: np.random.Generator, stars: Any, n: int, fields: tuple[float, float]) -> Made:
    """Centroids of `n` frames of one camera."""
    camera, bend, offset = make_camera(rng, fields)
    sr = np.prod(np.radians(camera.fov_deg))
    # As many stars as make 8 to 60 in a field, where the catalogue has them.
    wanted = np.exp(rng.uniform(*np.log([8.0, 60.0]))) * 4.0 * np.pi / sr
    limit = stars.mag[min(int(wanted), len(stars) - 1)]
    depth = stars.select(stars.mag <= limit)
    sigma, false, missing = rng.choice([0.05, 0.1, 0.3]), rng.choice([0, 3, 10]), rng.choice([0.0, 0.1, 0.3])
    rotations, frame, xs, names, mags, counts = [], [], [], [], [], []
    for k in range(n):
        rotation = random_rotation(rng)
        star, xy = seen_by(depth, rotation, camera, bend, offset)
        kept = rng.random(len(star)) >= missing
        star, xy = star[kept], xy[kept] + sigma * rng.normal(size=(int(kept.sum()), 2))
        mag = depth.mag[star] + 0.25 * rng.normal(size=len(star))
        wrong = rng.random((false, 2)) * [camera.width_px - 1, camera.height_px - 1]
        if false and rng.random() < 0.3:
            # As at the edge of the Moon, a cloud or a horizon: all in one part of the image.
            wrong = wrong * rng.uniform(0.1, 0.3, 2)
        faint = rng.uniform(limit - 3.0, limit + 0.5, false)
        xy = np.vstack([xy, wrong])
        mag, name = np.concatenate([mag, faint]), [*depth.star_id[star], *[""] * false]
        inside = np.all((xy > 0) & (xy < [camera.width_px - 1, camera.height_px - 1]), axis=1)
        bright = np.argsort(mag)[:BRIGHTEST]
        counts.append(sum(bool(name[i]) for i in bright) >= LEAST)
        frame += [k] * int(inside.sum())
        xs.append(xy[inside])
        mags.append(mag[inside])
        names += [name[i] for i in np.flatnonzero(inside)]
        rotations.append(rotation)
    xy = np.concatenate(xs)
    table = SimpleNamespace(
        frame=np.array(frame),
        x_px=xy[:, 0],
        y_px=xy[:, 1],
        flux=10.0 ** (-0.4 * np.concatenate(mags)),
        sigma_px=np.full(len(xy), sigma),
        frame_ids=np.arange(n),
        image=np.array([f"frame {k}" for k in range(n)]),
        time_utc=np.array([""] * n),
        stars_per_frame=np.bincount(frame, minlength=n),
        meta={"optics": {"width_px": camera.width_px, "height_px": camera.height_px}},
    )
    return Made(camera, table, rotations, dict(zip(zip(frame, xy[:, 0], strict=True), names, strict=True)), counts)


def render_camera(rng: np.random.Generator, stars: Any, n: int, fields: tuple[float, float]) -> Made:
    """The same with pixels: defocus, hot pixels, streaks, the Moon and a horizon."""
    camera, bend, offset = make_camera(rng, fields)
    size = min(camera.width_px, 1024)
    scale = size / camera.width_px
    offset = scale * offset
    corner = 0.5 * scale * np.hypot(camera.width_px, camera.height_px)
    height = int(scale * camera.height_px)
    camera = sc.Camera(size, height, 5.0, scale * camera.focal_px * 5e-3, (size - 1) / 2, (height - 1) / 2)
    true = camera.replace(
        x0_px=camera.x0_px + offset[0], y0_px=camera.y0_px + offset[1], coefficients=(bend / corner**2, 0.0)
    )
    sr = np.prod(np.radians(camera.fov_deg))
    wanted = np.exp(rng.uniform(*np.log([15.0, 60.0]))) * 4.0 * np.pi / sr
    limit = stars.mag[min(int(wanted), len(stars) - 1)]
    # A star at the limit has a signal of some ten times the noise of its pixels.
    psf = rng.choice([0.7, 1.0, 1.6, 2.5])
    zero = 12.0 * 11.0 * 2.0 * psf * np.sqrt(np.pi) * 10.0 ** (0.4 * limit) / 0.1
    sensor = sc.simulation.Sensor(
        psf_sigma_px=psf, zero_point_e_s=zero, hot_pixel_fraction=rng.choice([0.0, 1e-5, 1e-4]), hot_pixel_seed=7
    )
    depth = stars.select(stars.mag <= limit + 0.5)
    images, rotations, truths = [], [], []
    y, x = np.mgrid[:height, :size]
    for k in range(n):
        rotation = random_rotation(rng)
        rendered = sc.simulation.render(depth, true, rotation, sensor, seed=int(rng.integers(2**31)))
        data = rendered.data.astype(float)
        if rng.random() < 0.3:
            # The Moon and its light.
            at, radius = rng.random(2) * [size, height], rng.uniform(0.02, 0.06) * size
            distance = np.hypot(x - at[0], y - at[1])
            data += 4000.0 * (distance < radius) + 300.0 / (1.0 + (distance / radius) ** 2)
        if rng.random() < 0.3:
            # A satellite.
            a, b = rng.random((2, 2)) * [size, height]
            away = np.abs((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / np.hypot(*(b - a))
            data += 400.0 * np.exp(-0.5 * (away / psf) ** 2)
        if rng.random() < 0.3:
            # Trees before the sky.
            trees = y > height * (0.85 + 0.05 * np.sin(x / 11.0) + 0.03 * np.sin(x / 2.3))
            data[trees] = 70.0 + 40.0 * rng.random(int(trees.sum()))
        images.append(sc.images.Image(np.clip(data, 0, 4095).astype(np.uint16), f"frame {k}", saturation=4095.0))
        rotations.append(rotation)
        # Stars just outside, which are not in the truth of the image, give their light to its edge.
        b = depth.directions_icrs @ rotation.T
        ahead = np.flatnonzero(b[:, 2] > np.cos(np.arctan(1.1 * corner / true.focal_px)))
        truths.append((depth.star_id[ahead], sc.camera.project(true, b[ahead])))
    table = sc.images.extract_centroids(images)
    names, counts = {}, []
    for k, truth in enumerate(truths):
        rows = np.flatnonzero(table.frame == k)
        star_id, place = truth
        n_true = 0
        for order, row in enumerate(rows):
            apart = np.hypot(*(place - [table.x_px[row], table.y_px[row]]).T)
            near = np.flatnonzero(apart < 3.0 * max(psf, 1.0))
            # Of two stars in one image either name is right.
            names[k, float(table.x_px[row])] = " or ".join(str(star_id[i]) for i in near)
            n_true += bool(len(near)) and order < BRIGHTEST
        counts.append(n_true >= LEAST)
    return Made(camera, table, rotations, names, counts)


def judged(made: Made, sheet: str, rng: np.random.Generator) -> tuple[int, int, int, int, int, float]:
    """Frames that count, identified, wrong; stars, wrong stars; seconds of the processor."""
    factor = {
        "none": None,
        "right": 1.0,
        "20 % off": 1.2 ** rng.choice([-1, 1]),
        "50 % off": 1.5 ** rng.choice([-1, 1]),
    }
    camera = None if factor[sheet] is None else made.camera.replace(focal_mm=made.camera.focal_mm * factor[sheet])
    clock = process_time()
    _, found = identify_to_depth(made.table, camera, EPOCH, cache=False)
    seconds = process_time() - clock
    identified = sum(bool(made.counts[f.frame]) for f in found.frames if f.quaternion is not None)
    o = found.observations
    amiss: dict[int, list[bool]] = defaultdict(list)
    for frame, place, name in zip(o.frame, o.x_px, o.star_id, strict=True):
        amiss[int(frame)].append(str(name) not in made.names[int(frame), float(place)].split(" or "))
    n_wrong = sum(map(sum, amiss.values()))
    wrong = sum(2 * sum(stars) >= len(stars) for stars in amiss.values())
    return int(np.sum(made.counts)), identified, wrong, len(o), n_wrong, seconds


def interval(k: int, n: int) -> str:
    """A share with its interval."""
    from scipy.stats import beta

    low = beta.ppf(0.025, k, n - k + 1) if k else 0.0
    high = beta.ppf(0.975, k + 1, n - k) if k < n else 1.0
    return f"{k} of {n} ({100 * low:.2f} to {100 * high:.2f} %)"


def main() -> None:
    """Make cameras and print the table, growing."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cameras", type=int, default=100)
    parser.add_argument("--frames", type=int, default=5)
    parser.add_argument("--fields", type=float, nargs=2, default=(1.0, 80.0), metavar=("LOW", "HIGH"))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--pixels", action="store_true")
    arguments = parser.parse_args()
    stars = sc.load_catalogue(10.0, epoch=EPOCH)
    stars = stars.select(np.argsort(stars.mag, kind="stable"))
    total: dict[str, Any] = defaultdict(lambda: np.zeros(6))
    make = render_camera if arguments.pixels else make_frames
    for number in range(arguments.cameras):
        rng = np.random.default_rng([arguments.seed, number])
        made = make(rng, stars, arguments.frames, tuple(arguments.fields))
        sheet = SHEETS[number % len(SHEETS)]
        result = np.array(judged(made, sheet, rng))
        fov = made.camera.fov_deg[0]
        bin_name = next(f"to {top:g} deg" for top in (2, 5, 10, 20, 40, 90) if fov <= top)
        for key in (f"sheet {sheet}", bin_name, "all"):
            total[key] += result
        if result[2] or result[4] or result[1] < result[0]:
            print(
                f"camera {number}: {fov:.1f} deg, {made.camera.width_px} px, sheet {sheet}: {result[1]:.0f} of "
                f"{result[0]:.0f} frames, {result[2]:.0f} wrong, {result[4]:.0f} wrong stars, {result[5]:.1f} s",
                flush=True,
            )
        if (number + 1) % 20 == 0:
            print(f"{number + 1} cameras", flush=True)
            report(total)
    report(total)


def report(total: dict[str, Any]) -> None:
    """Shares so far."""
    for key, (n, k, wrong, n_stars, bad, seconds) in total.items():
        print(
            f"{key:16s} identified {interval(int(k), int(n))}; wrong frames {interval(int(wrong), int(n))}; wrong "
            f"stars {int(bad)} of {int(n_stars)}; {seconds / max(n, 1):.2f} s of the processor a frame",
            flush=True,
        )


if __name__ == "__main__":
    main()
