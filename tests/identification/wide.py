"""Pictures of the sky by NumPy alone: wide fields, lenses that bend, and detections that are no
stars.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Lens:
    """A lens of a field so many degrees wide, whose corner is drawn in by `barrel`, a part of its
    distance.

    A point that a pinhole would show at the radius r, in units of the corner's distance, is seen at
    ``r (1 - (barrel + wave) r^2 + wave r^4)``. The axis is off the detector's middle by `off`
    pixels.
    """

    width: int
    height: int
    field_deg: float
    barrel: float = 0.0
    wave: float = 0.0
    off: tuple[float, float] = (0.0, 0.0)

    @property
    def focal(self) -> float:
        return float(0.5 * self.width / np.tan(np.radians(0.5 * self.field_deg)))

    @property
    def corner(self) -> float:
        return float(0.5 * np.hypot(self.width, self.height))

    def places(self, seen: Any) -> Any:
        """Pixels (n, 2) of directions (n, 3) in the lens's axes; NaN where none arrives."""
        with np.errstate(divide="ignore", invalid="ignore"):
            p = self.focal * seen[:, :2] / seen[:, 2:]
            rho2 = np.sum(p * p, axis=1) / self.corner**2
            p = p * (1.0 - (self.barrel + self.wave) * rho2 + self.wave * rho2**2)[:, None]
            # Beyond where the polynomial turns back, the lens shows nothing.
            slope = 1.0 - 3.0 * (self.barrel + self.wave) * rho2 + 5.0 * self.wave * rho2**2
        p[(seen[:, 2] <= 0.05) | (slope <= 0.1) | (rho2 > 6.0)] = np.nan
        return p + 0.5 * np.array([self.width - 1.0, self.height - 1.0]) + np.array(self.off)


def attitude(rng: np.random.Generator) -> Any:
    """A random rotation, by two random vectors."""
    a, b = rng.standard_normal((2, 3))
    a /= np.linalg.norm(a)
    b -= a * (a @ b)
    b /= np.linalg.norm(b)
    return np.stack([a, b, np.cross(a, b)])


def view(stars: Any, lens: Lens, rotation: Any, n: int) -> tuple[Any, Any]:
    """Rows of the catalogue and places (m, 2) of the n brightest stars on the detector."""
    places = lens.places(stars.directions_icrs @ rotation.T)
    size = np.array([lens.width, lens.height])
    rows = np.flatnonzero(np.all((places > 2.0) & (places < size - 3.0), axis=1))
    rows = rows[np.argsort(stars.mag[rows], kind="stable")][:n]
    return rows, places[rows]


def picture(lens: Lens, places: Any, mag: Any, rng: np.random.Generator, psf: float = 1.1) -> Any:
    """Counts (height, width) of Gaussian spots, the faintest with about eight times the noise, 12
    bit in 16.
    """
    expected = np.full((lens.height, lens.width), 200.0)
    parts = (np.arange(5) - 2.0) / 5.0
    reach = 6
    for (x, y), flux in zip(places, 500.0 * 10.0 ** (-0.4 * (mag - mag.max())), strict=True):
        columns, rows = (
            np.arange(round(v) - reach, round(v) + reach + 1) for v in (float(x), float(y))
        )
        columns = columns[(columns >= 0) & (columns < lens.width)]
        rows = rows[(rows >= 0) & (rows < lens.height)]
        along, down = (
            np.exp(-0.5 * ((at[:, None] + parts - v) / psf) ** 2).mean(axis=1)
            for at, v in ((columns, x), (rows, y))
        )
        expected[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += (
            flux / (2.0 * np.pi * psf**2) * np.outer(down, along)
        )
    counts = expected + np.sqrt(expected) * rng.standard_normal(expected.shape) * 0.5
    return (16.0 * np.clip(np.round(counts), 0, 4095)).astype(np.uint16)
