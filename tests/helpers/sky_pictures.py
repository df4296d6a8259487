"""Pictures of the sky, made with NumPy alone: stars of the catalogue through a pinhole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

import starcal_uq as sc

SIZE = 512


def catalogue(max_mag=7.0, epoch=2016.0):
    """Directions (n, 3) and magnitudes (n,)."""
    stars = sc.load_catalogue(max_mag=max_mag, epoch=epoch)
    return stars.directions_icrs, stars.mag


def attitude(rng):
    """A random rotation (3, 3), whose rows are the axes of the camera."""
    matrix, upper = np.linalg.qr(rng.standard_normal((3, 3)))
    matrix = matrix * np.sign(np.diag(upper))
    return matrix * np.sign(np.linalg.det(matrix))


def star_field(rotation, focal_px, size=SIZE, max_mag=7.0):
    """Pixels (n, 2) and magnitudes (n,) of the stars in a frame."""
    directions, mag = catalogue(max_mag)
    seen = directions @ rotation.T
    front = seen[:, 2] > 0.2
    xy = focal_px * seen[front, :2] / seen[front, 2:] + 0.5 * (size - 1)
    inside = np.all((xy > 4.0) & (xy < size - 5.0), axis=1)
    return xy[inside], mag[front][inside]


def picture(
    path: Path,
    rotation,
    focal_px,
    *,
    size=SIZE,
    jitter_px=0.0,
    noise=10.0,
    max_mag=7.0,
    seed=0,
    shift=(0.0, 0.0),
):
    """Write a picture of 16 bits: Gaussian stars of one pixel's width, a background and noise."""
    rng = np.random.default_rng(seed)
    xy, mag = star_field(rotation, focal_px, size, max_mag)
    xy = xy + rng.normal(0.0, jitter_px, xy.shape) + shift
    rows = np.arange(size)
    counts = np.full((size, size), 500.0)
    for (x, y), m in zip(xy, mag, strict=True):
        flux = 3e4 * 10.0 ** (-0.4 * (m - 6.0))
        near = slice(max(0, int(y) - 6), int(y) + 8), slice(max(0, int(x) - 6), int(x) + 8)
        across = np.exp(-0.5 * ((rows[near[1]] - x) / 1.1) ** 2)
        down = np.exp(-0.5 * ((rows[near[0]] - y) / 1.1) ** 2)
        counts[near] += flux / (2.0 * np.pi * 1.1**2) * down[:, None] * across
    counts += rng.normal(0.0, noise, counts.shape)
    Image.fromarray(counts.clip(0, 65535).astype(np.uint16)).save(path)
    return xy, mag
