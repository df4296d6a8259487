"""Wrong identifications on purpose, to see what they do and whether they are found."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.errors import CatalogueError
from starcal_uq.core.settings import Seed, bounded
from starcal_uq.core.types import AnyDict, BoolArray, IntArray

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.observations.table import Observations
    from starcal_uq.sky.catalogue import StarCatalogue

KINDS = ("random", "neighbour")
# Nearer than this a catalogue entry is the star itself.
_SAME_RAD = 1e-6


@dataclass(frozen=True)
class Contaminated:
    """Observations with wrong identifications, and which they are."""

    observations: (
        Observations  # Same rows, some with the direction, name and magnitude of another star
    )
    wrong: BoolArray  # (N,): rows that were changed


@bounded
def contaminate(
    obs: Observations,
    stars: StarCatalogue,
    camera: Camera,
    fraction: float,
    kind: str = "random",
    seed: Seed = 0,
    *,
    radius_px: float = 60.0,
) -> Contaminated:
    """Give some rows the direction of another star of the catalogue.

    Parameters
    ----------
    obs : Observations
        Right identifications.
    stars : StarCatalogue
        Catalogue that wrong stars are taken from; its directions must be of the same kind as those
        of the observations.
    camera : Camera
        Camera whose focal length turns `radius_px` into an angle.
    fraction : float
        Share of the rows that becomes wrong; rounded to whole rows, chosen at random over all
        frames.
    kind : {"random", "neighbour"}
        Any star of the catalogue, or one within `radius_px` of the right one. Stars that the frame
        has already are not used.
    seed : int or Generator
        Repeats bit for bit.
    radius_px : float
        Distance of neighbours.

    Raises
    ------
    CatalogueError
        When too few rows have a neighbour.
    ValueError
        For a kind or fraction that makes no sense.
    """
    if kind not in KINDS or not 0.0 <= fraction <= 1.0:
        raise ValueError(
            f"kind={kind!r}, fraction={fraction}: use {' or '.join(KINDS)}, and a number from 0 "
            "to 1."
        )
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(seed)
    tree = cKDTree(stars.directions_icrs)
    own_distance, own = tree.query(obs.directions_icrs)
    own = np.where(own_distance < _SAME_RAD, own, -1)
    frame = np.repeat(np.arange(obs.n_frames), obs.stars_per_frame)
    present = {(int(k), int(star)) for k, star in zip(frame, own, strict=True)}
    near_rad = radius_px / camera.focal_px
    wanted = round(fraction * obs.n_stars)
    rows: list[int] = []
    replacements: list[int] = []
    for row in rng.permutation(obs.n_stars):
        if len(rows) == wanted:
            break
        if kind == "random":
            candidates: IntArray = rng.integers(len(stars), size=20)
        else:
            near = tree.query_ball_point(obs.directions_icrs[row], near_rad)
            candidates = rng.permutation(np.sort(np.array(near, dtype=np.int64)))
        for star in candidates.tolist():
            if star != own[row] and (int(frame[row]), star) not in present:
                present.add((int(frame[row]), star))
                rows.append(int(row))
                replacements.append(star)
                break
    if len(rows) < wanted:
        raise CatalogueError(
            f"only {len(rows)} of {obs.n_stars} rows have another star of the catalogue within "
            f"{radius_px:g} px, and "
            f"{wanted} are asked for: use a catalogue with fainter stars."
        )
    wrong = np.zeros(obs.n_stars, dtype=bool)
    wrong[rows] = True
    changes: AnyDict = {}
    for name, values in stars.named(replacements).items():
        column = getattr(obs, name)
        if column is not None:
            changed = column.astype(object)
            changed[rows] = values
            changes[name] = changed
    return Contaminated(replace(obs, **changes), wrong)
