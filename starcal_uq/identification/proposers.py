"""What proposes attitudes to be verified: our own pattern search, or the solver of another package,
found by its entry point.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from starcal_uq.core.errors import IdentificationError
from starcal_uq.core.extras import entry_point
from starcal_uq.core.files import shown
from starcal_uq.core.types import FloatArray, PathLike
from starcal_uq.identification.pairs import StarPairs, cached_star_pairs, remembered
from starcal_uq.identification.pyramid import CameraTolerance, FieldGeometry, Hypothesis, hypotheses
from starcal_uq.sky.catalogue import StarCatalogue

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP = "starcal_uq.engines"
# The pairs that were prepared last, for cameras that are used in turns.
_RECENT = 4
_recent: dict[tuple[str, float, float], StarPairs] = {}

# Batches of hypotheses from points, their noise, the camera, its tolerances, the number of
# centroids to look at, and the number of those that were searched before: `pyramid.hypotheses` with
# its catalogue, or another solver's.
Proposer: TypeAlias = Callable[
    [FloatArray, FloatArray, FieldGeometry, CameraTolerance, int, int], Iterator[list[Hypothesis]]
]


def prepare_engine(
    engine: str,
    stars: StarCatalogue,
    geometry: FieldGeometry,
    tolerance: CameraTolerance,
    folder: PathLike | None,
) -> Proposer:
    """The catalogue prepared for "pyramid", or for the engine that a package offers under this name:
    a function of stars, geometry and tolerance that gives a `Proposer`.

    The pairs of "pyramid" are those that this process has used before, or else those of a file in
    the `folder` where there is one, or new ones. IdentificationError where no installed package
    offers the engine.
    """
    found = offered_engine(engine)
    if found is not None:
        proposer: Proposer = found.load()(stars, geometry, tolerance)
        return proposer
    f, w, h = geometry.focal_px, geometry.width_px, geometry.height_px
    largest = 2.0 * float(np.arctan(0.5 * np.hypot(w, h) / f)) * (1.0 + tolerance.focal) + 0.002
    # Rounded, so that cameras of nearly the same field share a file.
    largest = float(np.ceil(largest * 200.0) / 200.0)
    field_sr = float(f"{w * h / f**2:.2g}")
    given = stars.directions_icrs, stars.mag, field_sr, largest
    key = stars.digest(len(stars)), field_sr, largest
    pairs = remembered(_recent, _RECENT, key, partial(cached_star_pairs, *given, folder))
    return partial(hypotheses, pairs.ready())


def offered_engine(name: str) -> EntryPoint | None:
    """The entry point in `GROUP` of an engine of another package; None for "pyramid".

    IdentificationError where no installed package offers it.
    """
    if name == "pyramid":
        return None
    found = entry_point(GROUP, name)
    if found is None:
        raise IdentificationError(
            f"there is no engine {shown(name)}: choose pyramid, or install a package that offers it."
        )
    return found
