"""Time of one rendered frame: all of it, its noise arrays alone, and the rest.

Run with ``python benchmarks/rendering.py``; medians on one core.
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path
from time import perf_counter

import numpy as np

import starcal_uq as sc
from starcal_uq.attitude.rotations import random_rotations
from starcal_uq.simulation.rendering import render, uniform_shot_noise
from starcal_uq.simulation.sensor import Sensor
from starcal_uq.simulation.truth import write_frame


def milliseconds(run: Callable[[int], object], repeats: int = 15) -> float:
    """Median wall time."""
    times = []
    for number in range(repeats):
        began = perf_counter()
        run(number)
        times.append(1e3 * (perf_counter() - began))
    return statistics.median(times)


def main() -> None:
    """Print the table."""
    stars, camera, sensor = sc.load_catalogue(6.0), sc.paper.paper_camera(), Sensor()
    rotations = random_rotations(15, np.random.default_rng(1))
    rng = np.random.default_rng(0)
    shape = camera.height_px, camera.width_px
    slew = [0.0, np.radians(1.0), 0.0]

    def noise_arrays(_: int) -> None:
        uniform_shot_noise(10.0, shape, rng)
        rng.standard_normal(shape, dtype=np.float32)

    rows = {
        "one frame": lambda i: render(stars, camera, rotations[i], sensor),
        "without noise arrays": lambda i: render(stars, camera, rotations[i], sensor, noise=False),
        "without noise arrays, 1 deg/s": lambda i: render(
            stars, camera, rotations[i], sensor, noise=False, rate_rad_s=slew
        ),
        "its noise arrays": noise_arrays,
        "noise arrays by NumPy": lambda _: (rng.poisson(10.0, shape), rng.standard_normal(shape)),
    }
    for name, run in rows.items():
        print(f"{name:32s}{milliseconds(run):8.1f} ms")
    frame = render(stars, camera, rotations[0], sensor)
    with tempfile.TemporaryDirectory() as folder:
        writing = milliseconds(lambda i: write_frame(frame, Path(folder) / f"{i}.fits"))
    print(f"{'writing it as FITS':32s}{writing:8.1f} ms")
    for mag in (0, 2, 4, 5, 6, 7, 8):
        snr, sigma_px = sensor.star_accuracy(mag)
        print(
            f"G = {mag}: {float(sensor.electrons(mag)):8.0f} e, SNR {snr:6.1f}, centroid "
            f"{sigma_px:.4f} px"
        )


if __name__ == "__main__":
    main()
