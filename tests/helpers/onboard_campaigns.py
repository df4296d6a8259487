"""Stated attitude errors of calibrations with effects against those of a sensor of a second make,
which flies on with the effect that was planted.

Each replicate draws an effect, images star frames with it (NumPy alone), calibrates, and flies the
same sensor over new frames without noise. True errors are those of attitudes that Wahba's problem
gives, with the camera's parameters aboard and with the effect corrected as the calibration knows
it; alignment weighs the frames by their geometry. They are compared in mean squares over
replicates.

    python -m tests.helpers.onboard_campaigns --replicates 100
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

import starcal_uq as sc
from tests.helpers.effects import CORNER_PX, breathing, nearest, sheet, smooth, table
from tests.helpers.gaussian_camera import gaussian_posterior
from tests.helpers.outside import Campaign, Displacement, attitude_errors, campaign, star_directions

FRAMES, FLOWN, STARS = 16, 24, 20
# Spread of magnitudes from 2 to 6.
_SPREAD_MAG = 4.0 / np.sqrt(12.0)


@dataclass(frozen=True)
class Planted:
    """An effect in the calibration's frames, and in flight; values of the frames by column.

    `gauge` is the turn of the camera's axes that the effect's own convention implies.
    """

    displaced: Displacement | None
    flown: Displacement | None
    columns: dict[str, np.ndarray] = field(default_factory=dict)
    flown_columns: dict[str, np.ndarray] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    flown_options: dict[str, Any] = field(default_factory=dict)
    gauge: Displacement | None = None


def signs(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Coefficients of one size: what is left to chance is small."""
    return rng.choice([-1.0, 1.0], shape)


def moved(moves: np.ndarray) -> Displacement:
    """Shifts along x and y, px, and a scale, px at the corner, of every frame (K, 3)."""

    def shift(uv: np.ndarray, xy: np.ndarray, mag: np.ndarray, frame: int) -> np.ndarray:
        return moves[frame, :2, None] + moves[frame, 2] * uv / CORNER_PX

    return shift


def temperature(rng: np.random.Generator, size: float) -> Planted:
    seen, flown = rng.uniform(-1.0, 1.0, FRAMES), rng.uniform(-1.0, 1.0, FLOWN)
    slope = size * signs(rng, 3) / seen.std()
    warm = [{"temperature_c": -25.0 + 15.0 * w} for w in (seen, flown)]
    return Planted(*(moved(np.outer(w, slope)) for w in (seen, flown)), *warm)


def time(rng: np.random.Generator, size: float) -> Planted:
    clocks = [np.append([-1.0, 1.0], rng.uniform(-1.0, 1.0, n - 2)) for n in (FRAMES, FLOWN)]
    drift = size * signs(rng, 3, 3) / np.arange(1.0, 4.0)[:, None]
    waves = [np.polynomial.legendre.legvander(clock, 3)[:, 1:] for clock in clocks]
    stamps = [{"time_utc": stamped(5e4 * (clock + 1.0))} for clock in clocks]
    return Planted(*(moved(wave @ drift) for wave in waves), *stamps)


def epoch(rng: np.random.Generator, size: float) -> Planted:
    nights = 8
    night = np.repeat(np.arange(nights), FRAMES // nights)
    offsets, other = size * rng.standard_normal((nights, 3)), size * signs(rng, 3)
    seconds = 86400.0 * night + 100.0 * np.arange(FRAMES)
    flown = moved(np.tile(other, (FLOWN, 1)))
    return Planted(moved(offsets[night]), flown, {"time_utc": stamped(seconds)})


def in_field(rng: np.random.Generator, size: float) -> Planted:
    shift = smooth(rng, size)
    return Planted(shift, shift, gauge=shift)


def frame(rng: np.random.Generator, size: float) -> Planted:
    return Planted(*(breathing(rng, n, size) for n in (FRAMES, FLOWN)))


def star(rng: np.random.Generator, size: float) -> Planted:
    own = {"star_sigma_px": size}
    return Planted(None, None, options={"patch_stars": 60, **own}, flown_options=own)


def phase(rng: np.random.Generator, size: float) -> Planted:
    waves = size * signs(rng, 2, 2, 2)

    def shift(uv: np.ndarray, xy: np.ndarray, mag: np.ndarray, frame: int) -> np.ndarray:
        angle = 2.0 * np.pi * np.arange(1, 3)[:, None, None] * xy
        return np.einsum("ahn,ha->an", np.sin(angle).transpose(1, 0, 2), waves[0]) + np.einsum(
            "ahn,ha->an", np.cos(angle).transpose(1, 0, 2), waves[1]
        )

    return Planted(shift, shift)


def magnitude(rng: np.random.Generator, size: float) -> Planted:
    shift = of_brightness(size * signs(rng, 2, 3), 4.0, _SPREAD_MAG)
    return Planted(shift, shift)


def of_brightness(by_power: np.ndarray, mean: float, spread: float) -> Displacement:
    """Shifts and scale (2, 3) by the standardised magnitude and by its square."""

    def shift(uv: np.ndarray, xy: np.ndarray, mag: np.ndarray, frame: int) -> np.ndarray:
        z = (mag - mean) / spread
        return sum(
            z ** (power + 1) * (own[:2, None] + own[2] * uv / CORNER_PX)
            for power, own in enumerate(by_power)
        )

    return shift


def stamped(seconds: np.ndarray) -> np.ndarray:
    """Times in ISO 8601."""
    whole = np.round(1e3 * seconds).astype("timedelta64[ms]")
    return (np.datetime64("2026-01-01T00:00:00.000") + whole).astype(str)


# What is planted, px: shifts of the principal point that the data can hardly tell, and others that
# they tell well.
EFFECTS: dict[str, tuple[Callable[[np.random.Generator, float], Planted], float]] = {
    "temperature": (temperature, 0.1),
    "time": (time, 0.1),
    "epoch": (epoch, 0.3),
    "field": (in_field, 0.2),
    "frame": (frame, 0.2),
    "star": (star, 0.1),
    "phase": (phase, 0.02),
    "magnitude": (magnitude, 0.05),
}


def alignment(c: Campaign, errors: np.ndarray) -> np.ndarray:
    """The rotation (3,) that an alignment takes up: frames weighed by what noise does to them."""
    r, weights = star_directions(c), []
    for number, truth in enumerate(c.attitudes):
        b = r[c.columns["frame"] == number] @ truth.T
        weights.append(len(b) * np.eye(3) - b.T @ b)
    return np.linalg.solve(np.sum(weights, axis=0), np.einsum("kij,kj->i", weights, errors))


def corrected(effect: str, cal: Any, c: Campaign, seen: Campaign, planted: Planted) -> np.ndarray:
    """Attitude errors (K, 3) of software that uses what the calibration knows of the effect; what
    frames, stars and nights draw anew it does not know.
    """
    xy = np.column_stack([c.columns["x_px"], c.columns["y_px"]])
    if effect in ("field", "phase"):
        shift = np.zeros_like(xy)
        for _ in range(6):
            shift = cal.displacement(xy - shift)[0]
    elif effect == "magnitude":
        bright = seen.columns["mag"]
        known = cal.effects.coefficients.reshape(2, 3)
        shift = of_brightness(known, bright.mean(), bright.std())(
            xy.T - cal.theta[:2, None], xy.T, c.columns["mag"], 0
        ).T
    elif effect in ("temperature", "time"):
        ((name, values),) = planted.flown_columns.items()
        errors = []
        for number, value in enumerate(values):
            mine = c.columns["frame"] == number
            columns = {key: column[mine] for key, column in c.columns.items()}
            alone = replace(
                c,
                columns=columns | {"frame": np.zeros(mine.sum(), dtype=int)},
                attitudes=c.attitudes[number : number + 1],
            )
            known = cal.at(**{name: value.item() if name == "temperature_c" else str(value)})
            errors.append(attitude_errors(alone, known.camera.theta)[0])
        return np.array(errors)
    else:
        shift = np.zeros_like(xy)
    columns = c.columns | {"x_px": xy[:, 0] - shift[:, 0], "y_px": xy[:, 1] - shift[:, 1]}
    return attitude_errors(replace(c, columns=columns), cal.theta)


def replicate(effect: str, seed: int, left_out: bool = False) -> dict[str, np.ndarray]:
    """Squares (4, 3) of true common rotation, true rest, and both as stated, by onboard model.

    `left_out`: of a calibration without the effect, which knows the camera alone.
    """
    plant, size = EFFECTS[effect]
    rng = np.random.default_rng([seed, 77])
    planted = plant(rng, size)
    c = campaign(
        *(rng,),
        n_frames=FRAMES,
        stars_per_frame=STARS,
        displaced=planted.displaced,
        **planted.options,
    )
    flown = campaign(
        *(rng,),
        n_frames=FLOWN,
        stars_per_frame=STARS,
        sigma_px=0.0,
        displaced=planted.flown,
        **planted.flown_options,
    )
    obs, frames = (
        table(each, **{name: own[each.columns["frame"]] for name, own in columns.items()})
        for each, columns in ((c, planted.columns), (flown, planted.flown_columns))
    )
    cal = sc.calibrate(obs, sheet(c), effects=None if left_out else effect)
    post = gaussian_posterior(cal, n=400)
    post.mean, post.effects = cal.theta, cal.effects
    post.star_error_px = 0.0 if cal.effects is None else cal.effects.scale("star")
    error = sc.propagate(post, frames, alignment=frames, calibrated=obs, n_draws=4)
    gauge = np.zeros(3) if planted.gauge is None else nearest(c.theta, planted.gauge)[1]
    found = {}
    for own in error.variants or [error]:
        if own.onboard == "effects":
            errors = corrected(effect, cal, flown, c, planted)
        else:
            errors = attitude_errors(flown, cal.theta)
        errors = errors - gauge
        common = alignment(flown, errors)
        rest = np.mean((errors - common) ** 2, axis=0)
        stated = [own.common_arcsec**2, own.rest_arcsec**2]
        for share in own.effects:
            if share.name == "star":
                # They stand in the noise, and so do they in that of the alignment.
                stated = [
                    stated[0] + share.rest_arcsec**2 / FLOWN,
                    stated[1] + share.rest_arcsec**2,
                ]
        found[own.onboard] = np.stack([common**2, rest, *stated])
    return found


def ratios(effect: str, seeds: range, left_out: bool = False) -> dict[str, tuple[float, float]]:
    """True over stated common rotation and rest, root mean squares over replicates and axes, by
    onboard model.
    """
    made = [replicate(effect, seed, left_out) for seed in seeds]
    found = {}
    for onboard in made[0]:
        common, rest, stated_common, stated_rest = np.mean([one[onboard] for one in made], axis=0)
        found[onboard] = (
            float(np.sqrt(np.mean(common / stated_common))),
            float(np.sqrt(np.mean(rest / stated_rest))),
        )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--replicates", type=int, default=100)
    parser.add_argument("--effects", nargs="*", default=list(EFFECTS))
    parser.add_argument("--size", type=float, help="px; that of the table above by default")
    given = parser.parse_args()
    print("| effect, px | onboard | common rotation | rest | rest, effect left out |")
    print("|---|---|---|---|---|")
    for effect in given.effects:
        plant, size = EFFECTS[effect]
        size = size if given.size is None else given.size
        EFFECTS[effect] = plant, size
        blind = ratios(effect, range(min(10, given.replicates)), left_out=True)["model"][1]
        for onboard, (common, rest) in ratios(effect, range(given.replicates)).items():
            print(f"| {effect} {size:g} | {onboard} | {common:.2f} | {rest:.2f} | {blind:.1f} |")


if __name__ == "__main__":
    main()
