"""A star sensor of a second make: NumPy alone, no code of the package, for tests that attack from
outside.

Distortion is Brown's (ideal to distorted). Every departure from the package's assumptions is a
switch: directions that err with their star, noise that varies with radius, magnitude or frame,
frames that see one patch of sky.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

Noise = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
# Shifts (2, n) in px of stars at (2, n) px from the principal point, at (2, n) px, with their
# magnitudes, of a frame.
Displacement = Callable[[np.ndarray, np.ndarray, np.ndarray, int], np.ndarray]


@dataclass(frozen=True)
class Campaign:
    """Columns of an observations table, and what is true.

    `columns` has frame, x_px, y_px, ra_deg, dec_deg, star_id and mag; `theta` is x0, y0, f, k1, k2
    in px units; `attitudes` (K, 3, 3) turn ICRS into the camera; `size_px` is the side of the
    square detector.
    """

    columns: dict[str, np.ndarray]
    theta: np.ndarray
    attitudes: np.ndarray
    size_px: int

    def camera_toml(self, focal_error: float = 0.01) -> dict[str, float | str | int]:
        """A data sheet: centred, the focal length wrong by a fraction, no distortion; 10 um
        pixels.
        """
        centre = 0.5 * (self.size_px - 1)
        focal_mm = self.theta[2] * 0.01 * (1.0 + focal_error)
        sheet: dict[str, float | str | int] = {
            "width_px": self.size_px,
            "height_px": self.size_px,
            "pixel_um": 10.0,
        }
        return sheet | {
            "focal_mm": focal_mm,
            "x0_px": centre,
            "y0_px": centre,
            "distortion": "brown",
        }


def campaign(
    rng: np.random.Generator,
    *,
    n_frames: int,
    stars_per_frame: int = 15,
    field_deg: float = 15.0,
    size_px: int = 1024,
    corner_px: tuple[float, float] = (3.0, -1.0),
    sigma_px: float | Noise = 0.05,
    patch_stars: int | None = None,
    star_sigma_px: float = 0.0,
    frame_focal: float = 0.0,
    pointings: int | None = None,
    drift_px: float = 0.0,
    displaced: Displacement | None = None,
    path: np.ndarray | None = None,
    offset_px: tuple[float, float] = (-12.0, 18.0),
) -> Campaign:
    """Observe.

    `field_deg` is the width of the field; `corner_px` are the displacements by k1 and k2 at the
    corner; `sigma_px` is a number or a function of (radius over the half diagonal, magnitude, frame
    number). With `patch_stars` all frames see the same stars, that many over a patch that random
    rolls and pointings of up to a fifth of the field stay within; otherwise every frame has stars
    of its own. `star_sigma_px` is the error per axis of each star's own direction, the same
    whenever it is seen; `frame_focal` the relative spread of the focal length from frame to frame.
    With `pointings` the camera stares: frames take turns at so many attitudes, each with the same
    stars whenever it comes round, and `drift_px` further along the rows from one turn to the next.
    `displaced` moves what is seen, after the distortion. Along a `path` (n_frames, 3, 3) of
    attitudes all frames see one sky, whose stars stay while they are in the field. The principal
    point is `offset_px` off the centre.
    """
    focal = 0.5 * size_px / np.tan(np.radians(0.5 * field_deg))
    x0, y0 = 0.5 * size_px + offset_px[0], 0.5 * size_px + offset_px[1]
    corner = 0.5 * size_px * np.sqrt(2.0)
    k1, k2 = corner_px[0] / corner**3, corner_px[1] / corner**5
    patch = (
        None
        if patch_stars is None
        else cap(rng, np.array([0.3, -0.5, 0.8]), 0.85 * field_deg, patch_stars)
    )
    magnitudes = None if patch_stars is None else rng.uniform(2.0, 6.0, patch_stars)
    offsets = (
        None
        if patch_stars is None
        else star_sigma_px / focal * rng.standard_normal((patch_stars, 2))
    )
    rows: dict[str, list[np.ndarray]] = {name: [] for name in ("frame", "x", "y", "r", "id", "mag")}
    attitudes: list[np.ndarray] = []
    views: list[tuple[np.ndarray, ...]] = []
    if path is not None:
        # As many to the sky as give a frame its stars.
        number = round(
            1.3 * stars_per_frame * 4.0 * np.pi / (2.0 * np.tan(np.radians(0.5 * field_deg))) ** 2
        )
        sky = np.array([random_unit(rng) for _ in range(number)])
        patch, magnitudes, offsets = sky, rng.uniform(2.0, 6.0, number), np.zeros((number, 2))
    for frame in range(n_frames):
        if path is not None:
            attitude = path[frame]
            stars, mag, number, own = patch, magnitudes, np.arange(len(patch)), offsets
        elif pointings is not None and frame >= pointings:
            attitude, stars, mag, number, own = views[frame % pointings]
            angle = drift_px / focal * (frame // pointings)
            turn = np.array(
                [
                    [np.cos(angle), 0.0, np.sin(angle)],
                    [0.0, 1.0, 0.0],
                    [-np.sin(angle), 0.0, np.cos(angle)],
                ]
            )
            attitude = turn @ attitude
        elif patch is None:
            attitude = frame_at(rng, random_unit(rng))
            stars = cap(rng, attitude[2], 0.75 * field_deg, 6 * stars_per_frame)
            mag, number = rng.uniform(2.0, 6.0, len(stars)), np.arange(len(stars)) + 1000 * frame
            own = star_sigma_px / focal * rng.standard_normal((len(stars), 2))
        else:
            attitude = frame_at(rng, cap(rng, np.array([0.3, -0.5, 0.8]), 0.2 * field_deg, 1)[0])
            stars, mag, number, own = patch, magnitudes, np.arange(len(patch)), offsets
        if pointings is not None and frame < pointings:
            views.append((attitude, stars, mag, number, own))
        f = focal * (1.0 + frame_focal * rng.standard_normal())
        # What shines is where the star is; what the table states is off by the star's own error.
        b = stars @ attitude.T
        x, y = f * b[:, 0] / b[:, 2] + x0, f * b[:, 1] / b[:, 2] + y0
        r2 = (x - x0) ** 2 + (y - y0) ** 2
        stretch = 1.0 + k1 * r2 + k2 * r2**2
        x, y = x0 + (x - x0) * stretch, y0 + (y - y0) * stretch
        # Far outside the field the polynomial folds back onto the detector.
        near = 0.3 if path is None else np.cos(np.radians(0.75 * field_deg))
        seen = np.flatnonzero(
            (b[:, 2] > near) & (x > 0) & (x < size_px - 1) & (y > 0) & (y < size_px - 1)
        )
        if path is not None:
            chosen = np.argsort(mag[seen], kind="stable")
        else:
            chosen = np.arange(len(seen)) if pointings is not None else rng.permutation(len(seen))
        seen = seen[chosen[:stars_per_frame]]
        radius = np.sqrt(r2[seen]) / corner
        sigma = (
            sigma_px(radius, mag[seen], np.full(len(seen), frame))
            if callable(sigma_px)
            else sigma_px
        )
        noise = sigma * rng.standard_normal((2, len(seen)))
        attitudes.append(attitude)
        xy = np.array([x[seen], y[seen]])
        if displaced is not None:
            xy = xy + displaced(xy - np.array([[x0], [y0]]), xy, mag[seen], frame)
        xy = xy + noise
        values = (
            np.full(len(seen), frame),
            *xy,
            moved(stars[seen], own[seen]),
            number[seen],
            mag[seen],
        )
        for name, column in zip(rows, values, strict=True):
            rows[name].append(column)
    r = np.concatenate(rows["r"])
    columns = {
        "frame": np.concatenate(rows["frame"]),
        "x_px": np.concatenate(rows["x"]),
        "y_px": np.concatenate(rows["y"]),
        **dict(zip(("ra_deg", "dec_deg"), sky_angles(r), strict=True)),
        "star_id": np.array([f"S{i}" for i in np.concatenate(rows["id"])]),
        "mag": np.concatenate(rows["mag"]),
    }
    return Campaign(columns, np.array([x0, y0, focal, k1, k2]), np.array(attitudes), size_px)


def zeniths_of_frames(
    rng: np.random.Generator,
    c: Campaign,
    high_deg: tuple[float, float] = (20.0, 60.0),
    turned: bool = True,
) -> np.ndarray:
    """Zeniths (K, 3) at some distances from the boresights, in any direction or, not `turned`, at
    one in the camera.
    """
    distance = np.radians(rng.uniform(*high_deg, len(c.attitudes)))
    angle = (
        rng.uniform(0.0, 2.0 * np.pi, len(c.attitudes))
        if turned
        else np.full(len(c.attitudes), 0.7)
    )
    up = [np.sin(distance) * np.cos(angle), np.sin(distance) * np.sin(angle), np.cos(distance)]
    return np.einsum("ik,kij->kj", np.array(up), c.attitudes)


def one_night(
    rng: np.random.Generator,
    n_frames: int,
    zenith: np.ndarray,
    high_deg: tuple[float, float] = (20.0, 60.0),
) -> np.ndarray:
    """Attitudes (n_frames, 3, 3) that look at some distances from one zenith, for the `path` of a
    campaign.
    """
    level = np.linalg.svd(zenith[None])[2][1:]
    distance = np.radians(rng.uniform(*high_deg, n_frames))
    angle = rng.uniform(0.0, 2.0 * np.pi, n_frames)
    across = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ level
    looks = np.cos(distance)[:, None] * zenith + np.sin(distance)[:, None] * across
    return np.array([frame_at(rng, boresight) for boresight in looks])


def through_air(c: Campaign, zeniths: np.ndarray, arcsec: float = 58.0) -> Campaign:
    """The same images with directions that lack `arcsec` tan z of refraction towards zeniths (K,
    3).
    """
    zenith, r = zeniths[c.columns["frame"]], star_directions(c)
    sine = np.sum(r * zenith, axis=1, keepdims=True)
    # The way to the zenith is as long as the cosine of the altitude.
    return _redirected(c, r - np.radians(arcsec / 3600.0) * (zenith - sine * r) / sine)


def aberrated(c: Campaign, velocity_km_s: np.ndarray) -> Campaign:
    """The same images with directions that are aberrated by this velocity, ICRS axes; a negative
    one takes it off.
    """
    return _redirected(c, star_directions(c) + velocity_km_s / 299792.458)


def unit_vectors(ra_deg: np.ndarray, dec_deg: np.ndarray) -> np.ndarray:
    """Directions (n, 3)."""
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    return np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


def sky_angles(r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Right ascensions and declinations, degrees, of directions (n, 3)."""
    return np.degrees(np.arctan2(r[:, 1], r[:, 0])) % 360.0, np.degrees(np.arcsin(r[:, 2]))


def star_directions(c: Campaign) -> np.ndarray:
    return unit_vectors(c.columns["ra_deg"], c.columns["dec_deg"])


def _redirected(c: Campaign, directions: np.ndarray) -> Campaign:
    ra, dec = sky_angles(directions / np.linalg.norm(directions, axis=1)[:, None])
    return replace(c, columns=c.columns | {"ra_deg": ra, "dec_deg": dec})


def measured_again(
    rng: np.random.Generator,
    columns: dict[str, np.ndarray],
    error_px: float,
    *,
    origin_px: float = 0.0,
    lost: float = 0.07,
) -> dict[str, np.ndarray]:
    """The same images by another program: its own errors and origin, some stars lost, other numbers
    and order.

    Frame numbers run backwards from 1000 on; names and magnitudes are not known.
    """
    frame = columns["frame"]
    kept = rng.random(len(frame)) > lost
    order = rng.permutation(np.flatnonzero(kept))
    again = {name: columns[name][order] for name in ("frame", "x_px", "y_px", "ra_deg", "dec_deg")}
    for name in ("x_px", "y_px"):
        again[name] = again[name] + origin_px + error_px * rng.standard_normal(len(order))
    return again | {"frame": 1000 + frame.max() - again["frame"]}


def slew(n_frames: int, step_deg: float) -> np.ndarray:
    """Attitudes (n, 3, 3) of a camera that turns about its y axis by a step a frame, and slowly
    about the others.
    """
    found = []
    for a in np.radians(step_deg) * np.arange(n_frames):
        turn_y = np.array(
            [[np.cos(a), 0.0, -np.sin(a)], [0.0, 1.0, 0.0], [np.sin(a), 0.0, np.cos(a)]]
        )
        roll = 0.3 * a
        turn_z = np.array(
            [[np.cos(roll), np.sin(roll), 0.0], [-np.sin(roll), np.cos(roll), 0.0], [0.0, 0.0, 1.0]]
        )
        found.append(turn_z @ turn_y)
    return np.array(found)


def attitude_errors(c: Campaign, theta: np.ndarray) -> np.ndarray:
    """Rotation vectors (K, 3), arcsec, by which attitudes err that a camera `theta` finds, the axes of its
    detector square or its last two parameters: Wahba's problem by SVD.
    """
    x0, y0, f, k1, k2, *axes = theta
    stretch, skew = axes or (0.0, 0.0)
    d = np.array([c.columns["x_px"] - x0, (c.columns["y_px"] - y0) / (1.0 + stretch)])
    d[0] -= skew * d[1]
    ideal = d.copy()
    for _ in range(50):
        r2 = np.sum(ideal**2, axis=0)
        ideal = d / (1.0 + k1 * r2 + k2 * r2**2)
    b = np.column_stack([ideal.T, np.full(d.shape[1], f)])
    b /= np.linalg.norm(b, axis=1)[:, None]
    r = star_directions(c)
    errors = []
    for frame, truth in enumerate(c.attitudes):
        mine = c.columns["frame"] == frame
        u, _, vt = np.linalg.svd(b[mine].T @ r[mine])
        found = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        turn = found @ truth.T
        errors.append(
            0.5
            * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        )
    return np.array(errors) * 648000.0 / np.pi


def random_unit(rng: np.random.Generator) -> np.ndarray:
    """A direction, uniform on the sphere."""
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


def frame_at(rng: np.random.Generator, boresight: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) from the sky to a camera that looks at `boresight`, at a random roll."""
    z = boresight / np.linalg.norm(boresight)
    x = np.cross(z, random_unit(rng))
    x /= np.linalg.norm(x)
    return np.array([x, np.cross(z, x), z])


def cap(rng: np.random.Generator, centre: np.ndarray, radius_deg: float, n: int) -> np.ndarray:
    """Directions (n, 3), uniform over a spherical cap."""
    axes = frame_at(rng, centre)
    z = rng.uniform(np.cos(np.radians(radius_deg)), 1.0, n)
    phi = rng.uniform(0.0, 2.0 * np.pi, n)
    s = np.sqrt(1.0 - z**2)
    return np.column_stack([s * np.cos(phi), s * np.sin(phi), z]) @ axes


def moved(stars: np.ndarray, offsets_rad: np.ndarray) -> np.ndarray:
    """Unit vectors (n, 3) displaced by offsets (n, 2) along right ascension and declination."""
    east = np.cross([0.0, 0.0, 1.0], stars)
    east /= np.linalg.norm(east, axis=1)[:, None]
    north = np.cross(stars, east)
    v = stars + offsets_rad[:, :1] * east + offsets_rad[:, 1:] * north
    return v / np.linalg.norm(v, axis=1)[:, None]
