"""Effects planted by an independent simulator, chosen and estimated: each alone at one, two and
five times the size that gains twice what it has to, and all pairs at twice that size.

    python verification/effects.py [--replicates 40] [--only field frame]
    python verification/effects.py --pairs --replicates 10 --write

One line a campaign: how often just the planted effects are chosen and how often one that is not
there, how often the 95 % interval of the scale holds what was planted (where that is a standard
deviation), and coverage of the camera's parameters by their 95 % intervals. Without an effect the
camera is the one that is planted, with axes, a field or a radial wave the one that is nearest to
it. `--pairs` plants two at once, and `--write` puts the table into the documentation.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from itertools import combinations, groupby
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import starcal_uq as sc
from benchmarks.pages import put
from starcal_uq.estimation.effects import penalty
from tests.helpers import effects as planted
from tests.helpers.outside import Campaign, campaign

KINDS = (
    *("axes", "field", "radial", "frame", "temperature"),
    *("time", "epoch", "star", "phase", "magnitude"),
)
# Scales that are standard deviations of what is drawn again in every campaign.
DRAWN = ("frame", "star")
FRAMES, STARS, NIGHTS = 30, 20, 3
PAGE = Path(__file__).parents[1] / "docs" / "explanation" / "effects.md"
# Sizes of what is planted, px, and shares over its campaigns.
Row = tuple[dict[str, float], dict[str, float]]


def observed(seed: int, sizes: dict[str, float]) -> tuple[Campaign, sc.Observations]:
    """A campaign with effects of these sizes, and its table."""
    rng = np.random.default_rng([seed, 28])
    warmth = rng.uniform(-1.7, 1.7, FRAMES)
    night = np.repeat(np.arange(NIGHTS), FRAMES // NIGHTS)
    clock = np.linspace(-1.0, 1.0, FRAMES)
    shifts = [
        of_place(sizes),
        planted.breathing(rng, FRAMES, sizes.get("frame", 0.0)),
        planted.moving(sizes.get("temperature", 0.0), warmth),
        planted.moving(sizes.get("time", 0.0), clock),
        planted.moving(sizes.get("epoch", 0.0), np.array([-1.2, 0.1, 1.1])[night]),
        planted.of_phase(sizes.get("phase", 0.0)),
        planted.of_magnitude(sizes.get("magnitude", 0.0)),
    ]
    c = campaign(
        rng,
        n_frames=FRAMES,
        stars_per_frame=STARS,
        patch_stars=60,
        star_sigma_px=sizes.get("star", 0.0),
        displaced=planted.together(*shifts),
    )
    frame = c.columns["frame"]
    hours = 24.0 * night + 3.0 * (np.arange(FRAMES) % (FRAMES // NIGHTS)) / (FRAMES // NIGHTS)
    start = np.datetime64("2026-01-01T20:00:00", "ms")
    times = start + (3.6e6 * hours).astype("timedelta64[ms]")
    columns = {"temperature_c": 15.0 + 8.0 * warmth[frame]}
    if "epoch" in sizes:
        columns["time_utc"] = times.astype(str)[frame]
    return c, planted.table(c, **columns)


def of_place(sizes: dict[str, float]) -> planted.Displacement:
    """Effects that keep their place in the field: they decide which camera is true."""
    return planted.together(
        planted.stretched(sizes.get("axes", 0.0)),
        planted.bump(sizes.get("field", 0.0)),
        planted.radial_wave(sizes.get("radial", 0.0)),
    )


def row(sizes: dict[str, float], replicates: int) -> dict[str, float]:
    """Shares over campaigns."""
    exact, extra, scales, z = [], [], [], []
    for seed in range(replicates):
        c, obs = observed(seed, sizes)
        cal = sc.calibrate(obs, planted.sheet(c), effects="auto")
        axes = cal.camera.distortion.endswith("+axes")
        truth = planted.nearest_camera(c.theta, of_place(sizes), axes=axes)
        assert cal.effects is not None
        names = set(cal.effects.names)
        exact.append(set(sizes) <= names)
        extra.append(bool(names - set(sizes)))
        z.extend((cal.theta - truth) / cal.sigmas)
        for effect in cal.effects.fitted:
            if effect.name in DRAWN and effect.name in sizes:
                scales.append(effect.low_px < sizes[effect.name] < effect.high_px)
    return {
        "chosen": float(np.mean(exact)),
        "others": float(np.mean(extra)),
        "scale": float(np.mean(scales)) if scales else float("nan"),
        "covered": float(np.mean(np.abs(z) < 1.96)),
        "rms": float(np.sqrt(np.mean(np.square(z)))),
    }


def limit(kind: str) -> float:
    """Size, px, at which an effect gains twice the penalty, on average over three campaigns."""
    low, high = 1e-3, 2.0
    for _ in range(8):
        size = float(np.sqrt(low * high))
        gains = []
        for seed in range(3):
            c, obs = observed(1000 + seed, {kind: size})
            cal = sc.calibrate(obs, planted.sheet(c), effects=kind)
            # None is left where the best scale is none.
            gains.append(sum(effect.gain_nat for effect in cal.effects.held))
        low, high = (low, size) if np.mean(gains) > 2.0 * penalty(len(KINDS)) else (size, high)
    return high


def alone(kinds: list[str]) -> Iterator[dict[str, float]]:
    """Sizes of campaigns without any effect, and with each."""
    yield {}
    for kind in kinds:
        detected = limit(kind)
        yield from ({kind: times * detected} for times in (1.0, 2.0, 5.0))


def pairs(kinds: list[str]) -> Iterator[dict[str, float]]:
    """Sizes of campaigns with two effects at once."""
    limits = {kind: limit(kind) for kind in kinds}
    for both in combinations(kinds, 2):
        yield {kind: 2.0 * limits[kind] for kind in both}


def by_effect(rows: list[Row]) -> str:
    """A row of each effect, with its sizes and the shares of each."""
    keys = ("chosen", "others", "scale", "covered", "rms")
    lines = ["| Simulated | px | Chosen | Others | Scale | Covered | rms z |", "|---" * 7 + "|"]
    for names, group in groupby(rows, key=lambda row: list(row[0])):
        sizes, found = zip(*group, strict=True)
        cells = [", ".join(f"{size[name]:.3f}" for size in sizes for name in names)]
        cells += [", ".join(f"{one[key]:.2f}" for one in found) for key in keys]
        cells = ["–" if not cell or "nan" in cell else cell for cell in cells]
        lines.append(f"| {' | '.join(names or ['nothing'])} | {' | '.join(cells)} |")
    return "\n".join(lines)


def by_pair(rows: list[Row]) -> str:
    """A matrix of effects: above the diagonal how often both are chosen, below it coverage."""
    found = {tuple(sizes): shares for sizes, shares in rows}
    kinds = list(dict.fromkeys(kind for pair in found for kind in pair))

    def cell(one: str, other: str) -> str:
        above = found.get((one, other))
        below = found.get((other, one))
        return f"{above['chosen']:.2f}" if above else f"{below['covered']:.2f}" if below else "–"

    lines = [f"| | {' | '.join(kinds)} |", "|---" * (len(kinds) + 1) + "|"]
    for one in kinds:
        lines.append(f"| {one} | {' | '.join(cell(one, other) for other in kinds)} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--replicates", type=int, default=40)
    parser.add_argument("--only", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--pairs", action="store_true")
    parser.add_argument("--write", action="store_true", help=f"put the table into {PAGE.name}")
    arguments = parser.parse_args()
    rows: list[Row] = []
    for sizes in (pairs if arguments.pairs else alone)(arguments.only):
        rows.append((sizes, row(sizes, arguments.replicates)))
        print(*rows[-1], flush=True)
    made = by_pair(rows) if arguments.pairs else by_effect(rows)
    print(made)
    if arguments.write:
        put(PAGE, "effect pairs" if arguments.pairs else "effects alone", made)


if __name__ == "__main__":
    main()
