"""Cameras of all kinds that nothing is known of, or something wrong: how many frames are
identified, how many wrongly.

    python verification/unknown.py [--frames 10000] [--seed 1] [--part 0 2] [--show] [--write]

Every camera has its own field of view (4 to 80 degrees, evenly in its logarithm, and of every
twentieth 1 to 4, where preparing a catalogue takes tens of seconds), detector (256 to 4096 px),
lens (up to 0.3 % of distortion at the corner, principal point up to 1 % of the width off), depth,
noise, missing stars and false ones (hot pixels, and clusters as from the Moon, clouds and a
horizon); its frames look anywhere on the sky. The sheet is missing, right, or 20 or 50 % wrong, in
turns. Nine cameras of ten give lists of sixty frames, made here with NumPy alone of the catalogue's
places; every tenth gives five images, rendered with defocus, hot pixels, streaks, the Moon and a
horizon painted in, whose stars are measured.

A frame counts where it shows at least six true stars among its thirty brightest. A star is wrong
when its name is, a frame when at least half of its stars are; attitudes also hold the offset of the
principal point. A star, false or one of a close pair, within five standard deviations of the place
of a star that the list leaves out is that star for all that anybody can tell: it is counted apart,
as a coincidence. Intervals are Clopper and Pearson's, 95 %.

What was done is kept in `.bench/unknown`, a line for each camera: a campaign that is stopped goes
on, and several processes share one (``--part 0 2`` and ``--part 1 2``). ``--show`` prints the table
of what there is and ``--write`` puts it into the documentation (`docs/explanation/reliability.md`).
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from time import process_time
from types import SimpleNamespace
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

import starcal_uq as sc  # noqa: E402
import starcal_uq.sky.catalogue as catalogue  # noqa: E402
from benchmarks.pages import put  # noqa: E402
from starcal_uq.pipeline.depth import identify_to_depth  # noqa: E402

OUT = ROOT / ".bench" / "unknown"
PAGE = ROOT / "docs" / "explanation" / "reliability.md"
EPOCH = 2020.0
# Frames of a camera that gives lists, and of every tenth, which gives images.
LISTED, RENDERED, EVERY = 60, 5, 10
# Fields of view, and those of every so many cameras.
WIDE, NARROW, SELDOM = (4.0, 80.0), (1.0, 4.0), 20
SHEETS = ("none", "right", "20 % off", "50 % off")
LEAST, BRIGHTEST = 6, 30


@dataclass(frozen=True)
class Made:
    """A camera without errors in its sheet, and its frames: rotations, stars by place, and whether
    they count.
    """

    camera: sc.Camera
    table: Any
    rotations: Any
    names: dict[tuple[int, float], str]
    counts: Any
    unseen: dict[tuple[int, float], str]


def random_rotation(rng: np.random.Generator) -> Any:
    """Anywhere, by the QR decomposition of normal numbers."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else q[[1, 0, 2]]


def seen_by(
    stars: Any, rotation: Any, camera: sc.Camera, bend: float, offset: Any
) -> tuple[Any, Any]:
    """Rows and places of the stars on the detector: a pinhole with a cubic displacement of its own
    formula.
    """
    corner = 0.5 * np.hypot(camera.width_px, camera.height_px)
    ahead = np.flatnonzero(
        stars.directions_icrs @ rotation[2] > np.cos(np.arctan(1.1 * corner / camera.focal_px))
    )
    b = stars.directions_icrs[ahead] @ rotation.T
    u = camera.focal_px * b[:, :2] / b[:, 2:]
    u = u * (1.0 + bend * np.sum(u * u, axis=1) / corner**2)[:, None]
    xy = u + np.array(camera.centre_px) + offset
    on = np.all((xy > 0) & (xy < [camera.width_px - 1, camera.height_px - 1]), axis=1)
    return ahead[on], xy[on]


def make_camera(
    rng: np.random.Generator, fields: tuple[float, float]
) -> tuple[sc.Camera, float, Any]:
    """A sheet, and how the lens differs from it: distortion at the corner and the offset of the
    principal point.
    """
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
    sigma, false, missing = (
        rng.choice([0.05, 0.1, 0.3]),
        rng.choice([0, 3, 10]),
        rng.choice([0.0, 0.1, 0.3]),
    )
    rotations, frame, xs, names, mags, counts, unseen = [], [], [], [], [], [], {}
    deeper = stars.select(stars.mag <= limit + 1.0)
    for k in range(n):
        rotation = random_rotation(rng)
        sky, places = seen_by(deeper, rotation, camera, bend, offset)
        star, xy = sky[sky < len(depth)], places[sky < len(depth)]
        kept = rng.random(len(star)) >= missing
        star, xy = star[kept], xy[kept] + sigma * rng.normal(size=(int(kept.sum()), 2))
        mag = depth.mag[star] + 0.25 * rng.normal(size=len(star))
        wrong = rng.random((false, 2)) * [camera.width_px - 1, camera.height_px - 1]
        if false and rng.random() < 0.3:
            # As at the edge of the Moon, a cloud or a horizon: all in one part of the image.
            wrong = wrong * rng.uniform(0.1, 0.3, 2)
        faint = rng.uniform(limit - 3.0, limit + 0.5, false)
        xy = np.vstack([xy, wrong])
        left_out = ~np.isin(sky, star)
        apart = np.hypot(*(xy[:, None] - places[left_out]).transpose(2, 0, 1))
        for row, near in enumerate(apart < 5.0 * max(sigma, 0.1)):
            unseen[k, float(xy[row, 0])] = " or ".join(deeper.star_id[sky[left_out][near]])
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
    truth = dict(zip(zip(frame, xy[:, 0], strict=True), names, strict=True))
    return Made(camera, table, rotations, truth, counts, unseen)


def render_camera(
    rng: np.random.Generator, stars: Any, n: int, fields: tuple[float, float]
) -> Made:
    """The same with pixels: defocus, hot pixels, streaks, the Moon and a horizon."""
    camera, bend, offset = make_camera(rng, fields)
    size, height = camera.width_px, camera.height_px
    corner = 0.5 * np.hypot(size, height)
    true = camera.replace(
        x0_px=camera.x0_px + offset[0],
        y0_px=camera.y0_px + offset[1],
        coefficients=(bend / corner**2, 0.0),
    )
    sr = np.prod(np.radians(camera.fov_deg))
    wanted = np.exp(rng.uniform(*np.log([15.0, 60.0]))) * 4.0 * np.pi / sr
    limit = stars.mag[min(int(wanted), len(stars) - 1)]
    # A star at the limit has a signal of some ten times the noise of its pixels.
    psf = rng.choice([0.7, 1.0, 1.6, 2.5])
    zero = 12.0 * 11.0 * 2.0 * psf * np.sqrt(np.pi) * 10.0 ** (0.4 * limit) / 0.1
    sensor = sc.simulation.Sensor(
        psf_sigma_px=psf,
        zero_point_e_s=zero,
        hot_pixel_fraction=rng.choice([0.0, 1e-5, 1e-4]),
        hot_pixel_seed=7,
    )
    depth = stars.select(stars.mag <= limit + 0.5)
    images, rotations, truths = [], [], []
    y, x = np.ogrid[:height, :size]
    for k in range(n):
        rotation = random_rotation(rng)
        rendered = sc.simulation.render(
            depth, true, rotation, sensor, seed=int(rng.integers(2**31))
        )
        data = rendered.data.astype(np.float32)
        if rng.random() < 0.3:
            # The Moon and its light.
            at, radius = rng.random(2) * [size, height], rng.uniform(0.02, 0.06) * size
            distance = np.hypot(x - at[0], y - at[1])
            data += 4000.0 * (distance < radius) + 300.0 / (1.0 + (distance / radius) ** 2)
        if rng.random() < 0.3:
            # A satellite.
            a, b = rng.random((2, 2)) * [size, height]
            away = np.abs((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / np.hypot(
                *(b - a)
            )
            data += 400.0 * np.exp(-0.5 * (away / psf) ** 2)
        if rng.random() < 0.3:
            # Trees before the sky.
            trees = y > height * (0.85 + 0.05 * np.sin(x / 11.0) + 0.03 * np.sin(x / 2.3))
            data[trees] = 70.0 + 40.0 * rng.random(int(trees.sum()))
        images.append(
            sc.images.Image(
                np.clip(data, 0, 4095).astype(np.uint16), f"frame {k}", saturation=4095.0
            )
        )
        rotations.append(rotation)
        # Stars just outside, which are not in the truth of the image, give their light to its edge.
        ahead = np.flatnonzero(
            depth.directions_icrs @ rotation[2] > np.cos(np.arctan(1.1 * corner / true.focal_px))
        )
        truths.append(
            (
                depth.star_id[ahead],
                sc.camera.project(true, depth.directions_icrs[ahead] @ rotation.T),
            )
        )
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
    return Made(camera, table, rotations, names, counts, {})


def judged(
    made: Made, sheet: str, rng: np.random.Generator
) -> tuple[int, int, int, int, int, int, float]:
    """Frames that count, identified, wrong; stars, wrong stars, coincidences; seconds of the
    processor.
    """
    factor = {
        "none": None,
        "right": 1.0,
        "20 % off": 1.2 ** rng.choice([-1, 1]),
        "50 % off": 1.5 ** rng.choice([-1, 1]),
    }
    camera = (
        None
        if factor[sheet] is None
        else made.camera.replace(focal_mm=made.camera.focal_mm * factor[sheet])
    )
    clock = process_time()
    _, found = identify_to_depth(made.table, camera, EPOCH, cache=False)
    seconds = process_time() - clock
    identified = sum(bool(made.counts[f.frame]) for f in found.frames if f.quaternion is not None)
    o = found.observations
    amiss: dict[int, list[bool]] = defaultdict(list)
    coincident = 0
    for frame, place, name in zip(o.frame, o.x_px, o.star_id, strict=True):
        key = int(frame), float(place)
        right = str(name) in made.names[key].split(" or ")
        by_chance = not right and str(name) in made.unseen.get(key, "").split(" or ")
        coincident += by_chance
        amiss[int(frame)].append(not right and not by_chance)
    n_wrong = sum(map(sum, amiss.values()))
    wrong = sum(2 * sum(stars) >= len(stars) for stars in amiss.values())
    return int(np.sum(made.counts)), identified, wrong, len(o), n_wrong, coincident, seconds


def tried(number: int, seed: int, stars: Any) -> dict[str, Any]:
    """What became of the frames of a camera."""
    rng = np.random.default_rng([seed, number])
    rendered, sheet = number % EVERY == EVERY - 1, SHEETS[(number + number // EVERY) % len(SHEETS)]
    fields = NARROW if number // 2 % SELDOM == SELDOM - 1 else WIDE
    made = (
        render_camera(rng, stars, RENDERED, fields)
        if rendered
        else make_frames(rng, stars, LISTED, fields)
    )
    names = ("counting", "identified", "wrong", "stars", "wrong_stars", "coincidences", "seconds")
    result = dict(zip(names, map(float, judged(made, sheet, rng)), strict=True))
    camera = {"number": number, "field": made.camera.fov_deg[0], "width": made.camera.width_px}
    return camera | {"sheet": sheet, "rendered": rendered, "frames": len(made.rotations)} | result


def results(seed: int) -> list[dict[str, Any]]:
    """What was done so far."""
    lines = [
        line
        for path in sorted(OUT.glob(f"{seed}-*.jsonl"))
        for line in path.read_text().splitlines()
    ]
    return list({row["number"]: row for row in map(json.loads, lines)}.values())


def table(rows: list[dict[str, Any]]) -> str:
    """Shares by sheet, kind, field and detector, as Markdown."""
    groups: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in sorted(rows, key=lambda row: (row["rendered"], SHEETS.index(row["sheet"]))):
        groups["all"].append(row)
        groups["images" if row["rendered"] else "lists"].append(row)
        groups[f"sheet: {row['sheet']}"].append(row)
    for row in sorted(rows, key=lambda row: row["field"]):
        low, high = next(
            (a, b) for a, b in pairwise((1, 2, 4, 10, 20, 40, 81)) if row["field"] <= b
        )
        groups[f"field {low} to {min(high, 80)}°"].append(row)
    for row in sorted(rows, key=lambda row: row["width"]):
        groups[f"width {row['width']} px"].append(row)
    lines = [
        (
            "|  | Cameras | Frames that count | Identified | Wrong frames | Wrong stars | By "
            "chance "
            "| Processor a frame |"
        ),
        "|---|---:|---:|---|---|---|---:|---|",
    ]
    for name, group in groups.items():
        keys = ("counting", "identified", "wrong", "stars", "wrong_stars", "coincidences")
        n, found, wrong, n_stars, bad, chance = (
            int(sum(row[key] for row in group)) for key in keys
        )
        if not n:
            continue
        times = np.quantile([row["seconds"] / row["frames"] for row in group], [0.5, 0.95])
        lines.append(
            (
                f"| {name} | {len(group)} | {n} | {share(found, n)} | {share(wrong, n)} | {bad} of "
                f"{n_stars} | {chance} | "
            )
            + ", ".join(f"{t:.2g} s" for t in times)
            + " |"
        )
    n_frames = int(sum(row["frames"] for row in rows))
    return f"{n_frames} frames, {len(rows)} cameras.\n\n" + "\n".join(lines)


def share(k: int, n: int) -> str:
    """A share in per cent with its interval."""
    from scipy.stats import beta

    low = beta.ppf(0.025, k, n - k + 1) if k else 0.0
    high = beta.ppf(0.975, k + 1, n - k) if k < n else 1.0
    return f"{k} ({100 * low:.2f} to {100 * high:.2f} %)"


def main() -> None:
    """Go on until so many frames are tried, then show what there is."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--part", type=int, nargs=2, default=(0, 1), metavar=("NUMBER", "OF"))
    parser.add_argument("--show", action="store_true")
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    part, of = arguments.part
    done = {row["number"] for row in results(arguments.seed)}
    # Every camera asks for some of few catalogues.
    catalogue.load_catalogue = lru_cache(maxsize=8)(catalogue.load_catalogue)  # type: ignore[assignment]
    mean = LISTED + (RENDERED - LISTED) / EVERY
    todo = [k for k in range(part, round(arguments.frames / mean), of) if k not in done]
    if todo:
        OUT.mkdir(parents=True, exist_ok=True)
        stars = sc.load_catalogue(10.0, epoch=EPOCH)
        stars = stars.select(np.argsort(stars.mag, kind="stable"))
        with (OUT / f"{arguments.seed}-{part}-{of}.jsonl").open("a", encoding="utf-8") as file:
            for number in todo:
                file.write(json.dumps(tried(number, arguments.seed, stars)) + "\n")
                file.flush()
    rows = results(arguments.seed)
    if arguments.show:
        for row in rows:
            if row["wrong_stars"]:
                print(row)
        print(table(rows))
    if arguments.write:
        put(PAGE, "unknown cameras", table(rows))


if __name__ == "__main__":
    main()
