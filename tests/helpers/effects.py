"""Planted effects: displacements for a sensor of a second make, NumPy alone, and the camera that is
nearest to a displaced one.
"""

from __future__ import annotations

import numpy as np

import starcal_uq as sc
from tests.helpers.outside import Campaign, Displacement

CORNER_PX = 0.5 * 1024 * np.sqrt(2.0)


def table(c: Campaign, **columns: np.ndarray) -> sc.Observations:
    """The observations of a campaign, with further columns."""
    return sc.Observations(**(c.columns | columns))


def sheet(c: Campaign) -> sc.Camera:
    """Its data sheet."""
    return sc.Camera.from_dict(c.camera_toml())


def bump(size_px: float, width_px: float = 180.0) -> Displacement:
    """A displacement around one place of the field, that no polynomial of the radius follows."""

    def shift(uv: np.ndarray, xy: np.ndarray, mag: np.ndarray, frame: int) -> np.ndarray:
        r2 = (xy[0] - 300.0) ** 2 + (xy[1] - 650.0) ** 2
        size = size_px * np.exp(-0.5 * r2 / width_px**2)
        return np.array([size, -0.6 * size])

    return shift


def radial_wave(size_px: float) -> Displacement:
    """One wave along the radius from the centre to the corners, alike all around."""

    def shift(uv: np.ndarray, xy: np.ndarray, mag: np.ndarray, frame: int) -> np.ndarray:
        radius = np.maximum(np.hypot(*uv), 1e-9)
        return size_px * np.sin(2.0 * np.pi * radius / CORNER_PX) * uv / radius

    return shift


def smooth(rng: np.random.Generator, size_px: float, size: int = 1024) -> Displacement:
    """Waves over the field to order 8, smaller the shorter they are, of this standard deviation at
    its corners.
    """
    orders = [(i, j) for i in range(9) for j in range(9 - i)]
    spread = np.array([(1.0 + i + j) ** -1.5 for i, j in orders])
    own = size_px * spread / np.linalg.norm(spread) * rng.standard_normal((2, len(orders)))

    def shift(uv: np.ndarray, xy: np.ndarray, mag: np.ndarray, frame: int) -> np.ndarray:
        x, y = 2.0 * (xy + 0.5) / size - 1.0
        along, across = np.polynomial.legendre.legvander(np.array([x, y]), 8)
        waves = np.array([along[:, i] * across[:, j] for i, j in orders])
        return np.asarray(own @ waves)

    return shift


def breathing(rng: np.random.Generator, n_frames: int, size_px: float) -> Displacement:
    """Scale and two shears of every frame, of this standard deviation at the corner."""
    own = size_px * rng.standard_normal((n_frames, 3))

    def shift(uv: np.ndarray, xy: np.ndarray, mag: np.ndarray, frame: int) -> np.ndarray:
        u, v = uv / CORNER_PX
        scale, stretch, shear = own[frame]
        return np.array([(scale + stretch) * u + shear * v, (scale - stretch) * v + shear * u])

    return shift


def together(*shifts: Displacement) -> Displacement:
    """Their sum."""
    return lambda *where: np.sum([shift(*where) for shift in shifts], axis=0)


def projected(theta: np.ndarray, b: np.ndarray) -> np.ndarray:
    x0, y0, f, k1, k2 = theta
    u, v = f * b[0] / b[2], f * b[1] / b[2]
    r2 = u * u + v * v
    stretch = 1.0 + k1 * r2 + k2 * r2**2
    return np.array([x0 + u * stretch, y0 + v * stretch])


def nearest_camera(
    theta: np.ndarray, shift: Displacement, size_px: int = 1024, *, axes: bool = False
) -> np.ndarray:
    """Parameters (5,) of the camera that is nearest over the detector to one whose images are
    shifted, a rotation free: what a smooth field leaves to the camera. With `axes` (7,): stretch
    and skew as well.
    """
    return nearest(theta, shift, size_px, axes=axes)[0]


def nearest(
    theta: np.ndarray, shift: Displacement, size_px: int = 1024, *, axes: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """That camera (5,) or (7,), and the rotation vector (3,), arcsec, of its axes from the first one's."""
    grid = np.linspace(0.0, size_px - 1.0, 41)
    xy = np.array(np.meshgrid(grid, grid)).reshape(2, -1)
    seen = xy - theta[:2, None]
    ideal = seen.copy()
    for _ in range(50):
        r2 = np.sum(ideal**2, axis=0)
        ideal = seen / (1.0 + theta[3] * r2 + theta[4] * r2**2)
    b = np.array([*(ideal / theta[2]), np.ones(ideal.shape[1])])
    steps = np.array([1e-2, 1e-2, 1e-2, 1e-2 / CORNER_PX**3, 1e-2 / CORNER_PX**5])
    columns = [
        (projected(theta + step, b) - projected(theta - step, b)) / 2.0 for step in np.diag(steps)
    ]
    for axis in np.eye(3):
        turned = 1e-6 * np.cross(axis, b.T).T
        columns.append((projected(theta, b + turned) - projected(theta, b - turned)) / 2.0)
    if axes:
        nothing = np.zeros_like(seen[1])
        columns += [np.array([nothing, seen[1]]), np.array([seen[1], nothing])]
    moved = shift(seen, xy, np.full(xy.shape[1], 4.0), 0)
    matrix = np.array(columns).reshape(len(columns), -1).T
    found = np.linalg.lstsq(matrix, moved.ravel(), rcond=None)[0]
    camera = np.append(theta + steps * found[:5], found[8:])
    return camera, found[5:8] * 1e-6 * 648000.0 / np.pi


def stretched(size_px: float) -> Displacement:
    """Scale of x against y and skew, this and half of it at the corner."""

    def shift(uv: np.ndarray, xy: np.ndarray, mag: np.ndarray, frame: int) -> np.ndarray:
        u, v = uv * size_px / CORNER_PX
        return np.array([u + 0.5 * v, -v + 0.5 * u])

    return shift


def moving(size_px: float, by_frame: np.ndarray, shift_px: float = 0.0) -> Displacement:
    """Scale that follows a value (K,) of the frames, this at the corner for one; and so the
    principal point.
    """

    def shift(uv: np.ndarray, xy: np.ndarray, mag: np.ndarray, frame: int) -> np.ndarray:
        return by_frame[frame] * (size_px * uv / CORNER_PX + shift_px)

    return shift


def of_phase(size_px: float) -> Displacement:
    """A wave over every pixel, along both axes."""
    return lambda uv, xy, mag, frame: size_px * np.sin(2.0 * np.pi * xy)


def of_magnitude(size_px: float) -> Displacement:
    """A shift of the bright stars against the faint ones, of magnitudes from 2 to 6, along x."""

    def shift(uv: np.ndarray, xy: np.ndarray, mag: np.ndarray, frame: int) -> np.ndarray:
        z = (mag - 4.0) / np.sqrt(16.0 / 12.0)
        return size_px * np.array([z, np.zeros_like(z)])

    return shift
