"""Known rotations between frames of a campaign, NumPy alone."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from starcal_uq.attitude import RelativeAttitudes
from tests.helpers.outside import Campaign, frame_at

ARCSEC = 648000.0 / np.pi


def exp(w: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) of a vector (3,), rad."""
    angle = np.linalg.norm(w)
    if angle == 0.0:
        return np.eye(3)
    x, y, z = w / angle
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * k @ k


def quaternion(r: np.ndarray) -> np.ndarray:
    """Scalar-last quaternion of a rotation (3, 3): the eigenvector of its symmetric matrix."""
    m = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]],
            [0.0, r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
            [0.0, 0.0, r[2, 2] - r[0, 0] - r[1, 1], r[1, 0] - r[0, 1]],
            [0.0, 0.0, 0.0, np.trace(r)],
        ]
    )
    return np.linalg.eigh(m, UPLO="U")[1][:, -1]


def gyro(rng: np.random.Generator, c: Campaign, arcsec: float) -> dict[str, np.ndarray]:
    """Columns of relative attitudes from each frame to the next, with errors of this size about each
    axis, which they state.
    """
    w = arcsec / ARCSEC * rng.standard_normal((len(c.attitudes) - 1, 3))
    turns = [
        exp(-own) @ b @ a.T for own, a, b in zip(w, c.attitudes, c.attitudes[1:], strict=False)
    ]
    n = len(turns)
    q = np.array([quaternion(turn) for turn in turns])
    columns = {"frame_a": np.arange(n), "frame_b": np.arange(1, n + 1)}
    columns |= dict(zip(("qx", "qy", "qz", "qw"), q.T, strict=True))
    return columns | {"sigma_arcsec": np.full(n, arcsec)}


def pole_of_date(days: float) -> np.ndarray:
    """The Earth's pole (3,) among the stars, days after 2000-01-01T12:00 TT: precession and the
    largest terms of nutation (Meeus, Astronomical Algorithms, chapter 22), to 0.1 arcsec.
    """
    t = days / 36525.0
    node = np.radians(125.04452 - 1934.136261 * t)
    sun = np.radians(2.0 * (280.4665 + 36000.7698 * t))
    moon = np.radians(2.0 * (218.3165 + 481267.8813 * t))
    psi = -17.20 * np.sin(node) - 1.32 * np.sin(sun) - 0.23 * np.sin(moon)
    psi += 0.21 * np.sin(2.0 * node)
    epsilon = 9.20 * np.cos(node) + 0.57 * np.cos(sun) + 0.10 * np.cos(moon)
    epsilon -= 0.09 * np.cos(2.0 * node)
    x = 2004.19 * t - 0.43 * t**2 + np.sin(np.radians(23.4393)) * psi
    y = -22.41 * t**2 + epsilon
    pole = np.array([x, y, 0.0]) / ARCSEC
    return np.array([pole[0], pole[1], np.sqrt(1.0 - pole @ pole)])


START, START_DAYS = "2026-11-20T20:00:00", 9820.33413


def stare(
    rng: np.random.Generator, n_frames: int, minutes: float, dec_deg: float, sigma_arcsec: float
) -> tuple[np.ndarray, np.ndarray]:
    """Attitudes (n, 3, 3) of a camera fixed on the Earth that looks near this declination, from
    `START` on, some minutes from frame to frame, with errors of the mount; and times.
    """
    pole = pole_of_date(START_DAYS)
    east = np.cross(pole, [1.0, 0.0, 0.0])
    meridian = np.cross(east / np.linalg.norm(east), pole)
    dec = np.radians(dec_deg)
    mount = frame_at(rng, np.cos(dec) * meridian + np.sin(dec) * pole)
    # The Earth turns by 360.9856 degrees in a day, and the sky the other way.
    turns = np.radians(360.98564737 / 1440.0 * minutes) * np.arange(n_frames)
    moved = sigma_arcsec / ARCSEC * rng.standard_normal((n_frames, 3))
    path = [exp(own) @ mount @ exp(-turn * pole) for own, turn in zip(moved, turns, strict=True)]
    seconds = np.round(60.0 * minutes * np.arange(n_frames)).astype("timedelta64[s]")
    return np.array(path), (np.datetime64(START) + seconds).astype(str)


def write_columns(path: Path, columns: dict[str, np.ndarray]) -> None:
    """Write columns as a table."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(columns)
        rows.writerows(zip(*(own.tolist() for own in columns.values()), strict=True))


def known_of(columns: dict[str, np.ndarray], claimed: float = 1.0) -> RelativeAttitudes:
    """Relative attitudes of these columns, with errors that are stated `claimed` times."""
    q = np.column_stack([columns[name] for name in ("qx", "qy", "qz", "qw")])
    sigma = claimed * columns["sigma_arcsec"][:, None]
    return RelativeAttitudes(columns["frame_a"], columns["frame_b"], q, sigma)
