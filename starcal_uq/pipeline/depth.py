"""How faint the stars must be that frames are compared with: as many in a field as the frames show, or enough."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.identification.result import Identification
    from starcal_uq.images.centroids import Centroids
    from starcal_uq.sky.catalogue import StarCatalogue

# Stars of the embedded catalogue to magnitudes G: the whole sky.
COUNTS = {7.0: 21399, 7.5: 36733, 8.0: 62793, 8.5: 106434, 9.0: 177496, 9.5: 294317, 10.0: 482176}
# To the first magnitude the catalogue has proper motions; more stars than these in a field are not asked for.
_LIMITS = tuple(COUNTS)
_ENOUGH = 25
# Frames show other stars than the brightest of the catalogue's band, and fields differ.
_MARGIN = 1.5
# Limits for a camera about which nothing is known, and the least stars of a frame worth a search.
_UNKNOWN, _LEAST_STARS = (7.0, 8.5, 10.0), 5


def stars_in_field(camera: Camera, max_mag: float) -> float:
    """Stars to a magnitude limit that a field holds on average over the sky."""
    half_x, half_y = (np.tan(np.radians(0.5 * angle)) for angle in camera.fov_deg)
    sr = 4.0 * float(np.arcsin(half_x * half_y / np.sqrt((1.0 + half_x**2) * (1.0 + half_y**2))))
    logs = np.log(list(COUNTS.values()))
    return float(np.exp(np.interp(max_mag, _LIMITS, logs))) * sr / (4.0 * np.pi)


def depth_for(centroids: Centroids, camera: Camera) -> float:
    """The magnitude limit for these frames: 7, or what gives a field as many stars as are seen, or enough of them."""
    seen = centroids.stars_per_frame
    seen = seen[seen >= _LEAST_STARS]
    wanted = min(_MARGIN * float(np.median(seen)), _ENOUGH) if len(seen) else 0.0
    return next((limit for limit in _LIMITS if stars_in_field(camera, limit) >= wanted), _LIMITS[-1])


def identify_to_depth(
    centroids: Centroids, camera: Camera | None, year: float, max_mag: float | None = None, **options: Any
) -> tuple[StarCatalogue, Identification]:
    """Identify with the embedded catalogue to the depth that the frames need.

    Parameters
    ----------
    centroids, camera
        As for `identify`.
    year : float
        Julian year of the star positions.
    max_mag : float, optional
        Magnitude limit, Gaia G; chosen by default.
    **options
        Those of `identify`.

    Returns
    -------
    StarCatalogue, Identification
        The stars that were searched for, and the result.
    """
    from starcal_uq.identification.engine import identify, sheet_of
    from starcal_uq.sky.catalogue import load_catalogue

    if max_mag is not None:
        stars = load_catalogue(max_mag=max_mag, epoch=year)
        return stars, identify(centroids, camera, stars, **options)
    sheet, told = (camera, True) if camera is not None else sheet_of(centroids)
    wanted = depth_for(centroids, sheet) if told else _UNKNOWN[0]
    limits = [wanted, *(limit for limit in _UNKNOWN if limit > wanted)]
    found_at: list[tuple[StarCatalogue, Identification]] = []
    enough = int(np.count_nonzero(centroids.stars_per_frame >= _LEAST_STARS))
    for limit in limits:
        stars = load_catalogue(max_mag=limit, epoch=year)
        found = identify(centroids, camera, stars, **options)
        found_at.append((stars, found))
        if 2 * found.n_identified >= enough:
            break
    stars, found = max(found_at, key=lambda one: one[1].n_identified)
    if found.n_identified and found.optics is not None:
        # Now that the field is known.
        limit = depth_for(centroids, found.nominal)
        if limit > stars.mag.max() + 0.1 and found.parity == "normal":
            deep = load_catalogue(max_mag=limit, epoch=year)
            again = identify(centroids, found.nominal, deep, **options)
            if again.n_identified >= found.n_identified:
                return deep, replace(again, optics=found.optics)
    return stars, found


def depth_text(stars: StarCatalogue, identification: Identification) -> str:
    """Which stars were searched for, and how many of them a field holds."""
    limit = float(stars.mag.max()) if len(stars) else 0.0
    n = stars_in_field(identification.nominal, limit)
    return f"Searched for stars to G = {limit:.1f}, of which a field holds {n:.0f} on average."
