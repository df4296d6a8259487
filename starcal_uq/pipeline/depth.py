"""How faint the stars must be that frames are compared with: as many in a field as the frames show,
or enough.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.identification.result import Identification
    from starcal_uq.images.centroids import Centroids
    from starcal_uq.sky.catalogue import StarCatalogue

# Stars of the embedded catalogue to magnitudes G: the whole sky.
COUNTS = {7.0: 21399, 7.5: 36733, 8.0: 62793, 8.5: 106434, 9.0: 177496, 9.5: 294317, 10.0: 482176}
# To the first magnitude the catalogue has proper motions; more stars than these in a field are not
# asked for.
_LIMITS = tuple(COUNTS)
_ENOUGH = 25
# Frames show other stars than the brightest of the catalogue's band, and fields differ.
_MARGIN = 1.5
# The least stars of a frame worth a search.
_LEAST_STARS = 5
# Magnitude limits of a search at any focal length: what a catalogue of so many stars is enough for.
_SEARCHED = {20_000: 7.0, 40_000: 8.5, 500_000: 10.0}


def stars_in_field(camera: Camera, max_mag: float) -> float:
    """Stars to a magnitude limit that a field holds on average over the sky."""
    half_x, half_y = (np.tan(np.radians(0.5 * angle)) for angle in camera.fov_deg)
    sr = 4.0 * float(np.arcsin(half_x * half_y / np.sqrt((1.0 + half_x**2) * (1.0 + half_y**2))))
    logs = np.log(list(COUNTS.values()))
    return float(np.exp(np.interp(max_mag, _LIMITS, logs))) * sr / (4.0 * np.pi)


def depth_for(centroids: Centroids, camera: Camera) -> float:
    """The magnitude limit for these frames: 7, or what gives a field as many stars as are seen, or
    enough of them.
    """
    seen = centroids.stars_per_frame
    seen = seen[seen >= _LEAST_STARS]
    wanted = min(_MARGIN * float(np.median(seen)), _ENOUGH) if len(seen) else 0.0
    return next(
        (limit for limit in _LIMITS if stars_in_field(camera, limit) >= wanted), _LIMITS[-1]
    )


def identify_to_depth(
    centroids: Centroids,
    camera: Camera | None,
    year: float,
    max_mag: float | None = None,
    **options: Any,
) -> tuple[StarCatalogue, Identification]:
    """Identify with the embedded catalogue to the depth that the frames need; the stars searched
    for, and the result.

    A search at any focal length looks at each level of brightness once, and loads fainter stars
    only where brighter ones are no answer. `year` is the Julian year of the star positions,
    `max_mag` the limit in Gaia G, which is chosen by default, and the options are those of
    `identify`.
    """
    from starcal_uq.identification.engine import identify
    from starcal_uq.sky.catalogue import load_catalogue

    if max_mag is not None:
        stars = load_catalogue(max_mag=max_mag, epoch=year)
        return stars, identify(centroids, camera, stars, **options)
    embedded = Embedded(centroids, year)
    found = identify(centroids, camera, embedded, **options)
    return embedded.for_camera(found.nominal), found


class Embedded:
    """The embedded catalogue, as deep as frames need it, each depth loaded once."""

    def __init__(self, centroids: Centroids, year: float) -> None:
        self._centroids, self._year = centroids, year
        self._loaded: dict[float, StarCatalogue] = {}

    def to(self, limit: float) -> StarCatalogue:
        """All stars to a magnitude limit."""
        from starcal_uq.sky.catalogue import load_catalogue

        if limit not in self._loaded:
            self._loaded[limit] = load_catalogue(max_mag=limit, epoch=self._year)
        return self._loaded[limit]

    def for_camera(self, camera: Camera) -> StarCatalogue:
        """The stars that frames of this camera are compared with."""
        return self.to(depth_for(self._centroids, camera))

    def for_level(self, n: int) -> StarCatalogue:
        """The brightest n of the sky, and what verifies their patterns."""
        return self.to(next(limit for most, limit in _SEARCHED.items() if n <= most))
