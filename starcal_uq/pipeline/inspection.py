"""What became of every detection of a frame, and of every star that it should show.

A detection is *identified* when it has a star of the catalogue and takes part in the calibration,
*left out* when it has a star and takes no part, and *not matched* otherwise. A star is *expected*
when it stands in the frame and is brighter than the frame's limit, the magnitude that parts best
the stars that were detected from those that were not; it is *missed* when no detection is near it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.attitude.rotations import quaternion_to_rotation
from starcal_uq.attitude.wahba import quest
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.fields import detector_corners
from starcal_uq.camera.projection import project, unproject
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import DistortionError, ImageError
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.images.centroids import Centroids
from starcal_uq.observations.table import Observations
from starcal_uq.pipeline.images import FAINTER_NEIGHBOURS, FAINTEST
from starcal_uq.pipeline.record import ImageRecord, ImageRow
from starcal_uq.sky.apparent import apparent_directions
from starcal_uq.sky.positions import ra_dec_deg
from starcal_uq.sky.site import Site

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.sky.catalogue import StarCatalogue

IDENTIFIED, LEFT_OUT, NOT_MATCHED = "identified", "left out", "not matched"
NO_STAR, FAINTER = "at no star of the catalogue", "fainter than the stars searched for"
# What leaves a star out, if it is not screening.
_LEFT_OUT = "displaced by a neighbour, or low above the horizon"
_WHOLE = "in a frame that keeps too few"
# A detection so near to a star's place is that star's, px, widths of a star image, and scatter of
# the frame's stars.
_NEAR_PX, _NEAR_PSF, _NEAR_RMS = 3.0, 2.5, 5.0
# Frames of a gallery that are shown because nothing is known of them, or because they fit worst.
_SHARE = 3


@dataclass(frozen=True, eq=False)
class InspectedFrame(Shown):
    """One frame, star by star.

    Attributes
    ----------
    row : ImageRow
        The frame in the record of the run: its number, name, time, counts and outcome.
    path : Path or None
        The image, as `starcal_uq.images.read_image` takes it; None where it is not found any more.
    width_px, height_px : int
        Size of the image.
    detections : DataFrame
        A row for each detection, brightest first: `x_px`, `y_px`, `snr`, `kind` ("identified",
        "left out" or "not matched"), `reason` (why it is not identified), `star_id`, `mag`, and for
        identified ones `dx_px`, `dy_px`: measured minus predicted.
    stars : DataFrame
        A row for each expected star, brightest first: `x_px`, `y_px` (where it is predicted),
        `star_id`, `mag`, `missed`.
    ra_deg, dec_deg : float
        Direction of the centre of the image, ICRS, degrees; NaN without an attitude.
    roll_deg : float
        Position angle of the image's up (towards its first row), from north through east, degrees.
    north : float
        Direction of north in the image, degrees from up towards the right.
    east_is_left : bool
        Whether east is left of north, as on the sky; false for mirror images.
    rms_px : float
        Root mean square of the residuals of the identified stars, px per axis.
    limit_mag : float
        Magnitude (Gaia G) to which stars are detected; NaN where none is.
    at_least : bool
        Whether the limit may be fainter, because the catalogue was not looked at beyond it.
    seconds : float
        Time that identification took; NaN where it is not known.
    """

    row: ImageRow
    path: Path | None
    width_px: int
    height_px: int
    detections: pd.DataFrame
    stars: pd.DataFrame
    ra_deg: float
    dec_deg: float
    roll_deg: float
    north: float
    east_is_left: bool
    rms_px: float
    limit_mag: float
    at_least: bool
    seconds: float

    def __repr__(self) -> str:
        return f"InspectedFrame({self.row.frame}, {self.row.image!r}, {self.row.outcome})"

    @property
    def solved(self) -> bool:
        """Whether it has an attitude."""
        return bool(np.isfinite(self.ra_deg))

    def n(self, kind: str) -> int:
        """Number of detections of a kind, or of "expected" or "missed" stars."""
        if kind == "expected":
            return len(self.stars)
        return int(
            (self.stars["missed"] if kind == "missed" else self.detections["kind"] == kind).sum()
        )


@dataclass(frozen=True, eq=False, repr=False)
class Frames(Shown):
    """The frames of a run from images: iterate, or take one by its number or its name.

    Attributes
    ----------
    run : str
        The run folder, for commands.
    record : ImageRecord
        What became of every image.
    centroids : Centroids
        All detections.
    matched : Observations
        The stars that the last identification found, with catalogue directions; counted as `used`
        is.
    used : Observations
        Those that were calibrated.
    residuals_px : (N, 2) array
        Their residuals, measured minus predicted.
    camera : Camera
        The calibrated camera.
    quaternions : mapping of int to (4,) array
        Attitude by frame, R_cam_icrs, as calibrated.
    reasons : mapping of (int, str) to str
        Why screening left a star of a frame out.
    seconds : mapping of int to float
        Time that identification took, by frame.
    images : tuple of Path
        Files or folders in which the images are looked for.
    n_run : int
        Frames of the whole run, of which these may be some.
    large : bool
        Whether the frames are shown one below the other, as finely as their images are.
    known : bool
        Whether the run folder has a camera file.
    """

    run: str
    record: ImageRecord
    centroids: Centroids
    matched: Observations
    used: Observations
    residuals_px: FloatArray
    camera: Camera
    quaternions: Mapping[int, FloatArray]
    reasons: Mapping[tuple[int, str], str] = field(default_factory=dict)
    seconds: Mapping[int, float] = field(default_factory=dict)
    images: tuple[Path, ...] = ()
    n_run: int = 0
    large: bool = False
    known: bool = True

    def __len__(self) -> int:
        return len(self.record.rows)

    def __iter__(self) -> Iterator[InspectedFrame]:
        return (self._frame(row) for row in self.record.rows)

    def __getitem__(self, which: int | str) -> InspectedFrame:
        return self._frame(self._row(which))

    def __repr__(self) -> str:
        return f"Frames({len(self)} of {self.n_run or len(self)} of {self.run!r})"

    @property
    def calibrated(self) -> bool:
        """Whether there is a calibration, which other frames can be identified with."""
        return bool(self.record.rounds)

    @property
    def mirrored(self) -> bool:
        """Whether x of the stars is counted from the right edge of the image."""
        return self.record.parity == "mirrored"

    @cached_property
    def rms_px(self) -> dict[int, float]:
        """Root mean square of the residuals of each calibrated frame, px per axis."""
        squares = 0.5 * (self.residuals_px**2).sum(axis=1)
        starts = self.used.frame_starts[:-1]
        mean = (
            np.add.reduceat(squares, starts) / self.used.stars_per_frame
            if len(starts)
            else squares[:0]
        )
        return dict(zip(self.used.frame_ids.tolist(), np.sqrt(mean).tolist(), strict=True))

    def select(self, *which: int | str, large: bool | None = None) -> Frames:
        """Some of the frames, by number or name.

        Raises
        ------
        ImageError
            If there is no such frame.
        """
        rows = [self._row(one) for one in which]
        numbers = [row.frame for row in rows]
        inside = np.isin(self.used.frame, numbers)
        return replace(
            self,
            record=replace(self.record, rows=tuple(rows)),
            centroids=self.centroids.select_frames(np.unique(numbers)),
            matched=self.matched.select(np.isin(self.matched.frame, numbers)),
            used=self.used.select(inside),
            residuals_px=self.residuals_px[inside],
            quaternions={k: q for k, q in self.quaternions.items() if k in numbers},
            n_run=self.n_run or len(self),
            large=self.large if large is None else large,
        )

    def telling(self, most: int) -> Frames:
        """At most so many frames: a third that failed, a third that fit worst, and others spread
        over the run.

        All in the order of the run.
        """
        rows = self.record.rows
        if len(rows) <= most:
            return self
        order = {row.frame: k for k, row in enumerate(rows)}
        failed = [row.frame for row in rows if row.frame not in self.rms_px]
        worst = sorted(self.rms_px, key=lambda k: -self.rms_px[k])
        wanted = _spread(failed, max(most // _SHARE, most - len(worst)))
        wanted += worst[: max(most // _SHARE, most - len(order) + len(worst) - len(wanted))]
        wanted = wanted[:most]
        rest = [k for k in order if k in self.rms_px and k not in wanted]
        wanted += _spread(rest, most - len(wanted))
        return self.select(*sorted(wanted, key=order.__getitem__))

    def to_dataframe(self) -> pd.DataFrame:
        """A row for each frame: number, name, time, outcome, counts, residual, seconds."""
        import pandas as pd

        used = dict(
            zip(self.used.frame_ids.tolist(), self.used.stars_per_frame.tolist(), strict=True)
        )
        return pd.DataFrame(
            [
                {
                    "frame": row.frame,
                    "image": row.image,
                    "time_utc": row.time_utc,
                    "outcome": row.outcome,
                    "n_detected": row.n_centroids,
                    "n_matched": row.n_last,
                    "n_identified": used.get(row.frame, 0),
                    "rms_px": self.rms_px.get(row.frame, np.nan),
                    "seconds": self.seconds.get(row.frame, np.nan),
                }
                for row in self.record.rows
            ]
        )

    def _row(self, which: int | str) -> ImageRow:
        text = str(which)
        found = [
            row for row in self.record.rows if text == row.image or text == Path(row.image).stem
        ]
        found = found or [row for row in self.record.rows if text == str(row.frame)]
        if len(found) == 1:
            return found[0]
        if found:
            numbers = ", ".join(str(row.frame) for row in found[:5])
            raise ImageError(
                f"{text}: {len(found)} frames have this name; take one by its number ({numbers})."
            )
        last = self.record.rows[-1] if self.record.rows else None
        known = "it has none" if last is None else f"the last one is {last.frame}, {last.image}"
        raise ImageError(f"{text}: the run has no frame of this number or name; {known}.")

    @cached_property
    def paths(self) -> dict[int, Path]:
        """The image of each frame, where it is still found, by the name that the run knows it
        by.
        """
        found: dict[str, list[Path]] = {}
        for source in self.images:
            for path in sorted(source.iterdir()) if source.is_dir() else [source]:
                found.setdefault(path.name, []).append(path)
        places: dict[int, Path] = {}
        count: dict[str, int] = {}
        for row in self.record.rows:
            # Images of one name come from several folders, in their order.
            count[row.image] = k = count.get(row.image, -1) + 1
            # A frame of a file with several is named after it: cube.fits[3].
            files = found.get(row.image, []) or found.get(row.image.rpartition("[")[0], [])
            if k < len(files) and files[k].is_file():
                places[row.frame] = files[k].with_name(row.image)
        return places

    @cached_property
    def searched_mag(self) -> float:
        """Magnitude (Gaia G) to which stars were searched for."""
        own = self.matched.origin.max_mag
        stated = self.record.max_mag if own is None else own
        mags = self.matched.mag if self.matched.mag is not None else np.empty(0)
        return float(stated) if stated is not None else float(np.max(mags, initial=-np.inf))

    @property
    def _catalogue(self) -> StarCatalogue | None:
        """Stars to some magnitudes beyond those that were searched for; None where the run names no
        stars.
        """
        if not np.isfinite(self.searched_mag) or self.used.star_id is None:
            return None
        limit = max(self.searched_mag, min(self.searched_mag + FAINTER_NEIGHBOURS, FAINTEST))
        return _stars(limit, self.matched.origin.epoch or 2016.0)

    def _apparent(self, directions: FloatArray, row: ImageRow) -> FloatArray:
        """Catalogue directions as the run took them for this frame."""
        origin = self.used.origin
        made = origin.apparent and origin.observer_velocity_km_s is not None
        if not made or not row.time_utc:
            return directions
        site = None if origin.site is None else Site.from_dict(origin.site)
        return apparent_directions(directions, row.time_utc, site=site)

    def _frame(self, row: ImageRow) -> InspectedFrame:
        import pandas as pd

        camera, number = self.camera, row.frame
        table = self.centroids.select(self.centroids.frame == number)
        xy = np.column_stack(
            [camera.width_px - 1 - table.x_px if self.mirrored else table.x_px, table.y_px]
        )
        used = np.flatnonzero(self.used.frame == number)
        matched = self.matched.select(self.matched.frame == number)
        kind = np.full(len(xy), NOT_MATCHED, dtype=object)
        reason = np.full(len(xy), "", dtype=object)
        star = np.full(len(xy), "", dtype=object)
        mag, moved = np.full(len(xy), np.nan), np.full((len(xy), 2), np.nan)
        for obs, rows in ((matched, np.arange(len(matched))), (self.used, used)):
            place = _nearest(obs.xy[rows], xy)[0]
            kind[place] = LEFT_OUT if obs is matched else IDENTIFIED
            star[place] = obs.named[rows]
            mag[place] = np.nan if obs.mag is None else obs.mag[rows]
            if obs is not matched:
                moved[place] = self.residuals_px[rows]
        for k in np.flatnonzero(kind == LEFT_OUT).tolist():
            reason[k] = self.reasons.get((number, str(star[k])), _LEFT_OUT if len(used) else _WHOLE)
        quaternion = self._attitude(row, matched)
        rms = self.rms_px.get(number, float("nan"))
        width = float(table.psf_sigma_px[0]) if len(table.psf_sigma_px) else np.nan
        near = np.nanmax([_NEAR_PX, _NEAR_PSF * width, _NEAR_RMS * rms])
        places, star_mag, star_id = self._seen(row, quaternion)
        distance = _nearest(places, xy)[1] if len(xy) else np.full(len(places), np.inf)
        seen = distance < near
        limit = _limit(star_mag, seen)
        if quaternion is not None:
            free = np.flatnonzero(kind == NOT_MATCHED)
            who, far = (
                _nearest(xy[free], places)
                if len(places)
                else (free * 0, np.full(len(free), np.inf))
            )
            for k, one, d in zip(free.tolist(), who.tolist(), far.tolist(), strict=True):
                reason[k] = self._why(float(star_mag[one]) if d < near else None)
        expected = star_mag <= limit
        flip = np.array([-1.0, 1.0]) if self.mirrored else np.ones(2)
        if self.mirrored:
            xy[:, 0], places[:, 0] = (
                camera.width_px - 1 - xy[:, 0],
                camera.width_px - 1 - places[:, 0],
            )
        detections = pd.DataFrame(
            {
                "x_px": xy[:, 0],
                "y_px": xy[:, 1],
                "snr": table.snr,
                "kind": kind,
                "reason": reason,
                "star_id": star,
                "mag": mag,
                "dx_px": flip[0] * moved[:, 0],
                "dy_px": moved[:, 1],
            }
        )
        stars = pd.DataFrame(
            {
                "x_px": places[expected, 0],
                "y_px": places[expected, 1],
                "star_id": star_id[expected],
                "mag": star_mag[expected],
                "missed": ~seen[expected],
            }
        )
        ra, dec, roll, north = self._pointing(quaternion)
        return InspectedFrame(
            row,
            self.paths.get(number),
            camera.width_px,
            camera.height_px,
            detections,
            stars,
            ra,
            dec,
            roll,
            north,
            not self.mirrored,
            rms,
            limit,
            bool(len(star_mag)) and limit >= star_mag[seen].max(initial=-np.inf),
            self.seconds.get(number, float("nan")),
        )

    def _why(self, mag: float | None) -> str:
        """Why a detection of an identified frame is not matched: by the magnitude of the star that
        is there, if any.
        """
        if mag is None:
            return NO_STAR
        return FAINTER if mag > self.searched_mag else "not sure which star"

    def _attitude(self, row: ImageRow, matched: Observations) -> FloatArray | None:
        """R_cam_icrs (3, 3); of a frame that was identified and not calibrated that of its
        stars.
        """
        if row.frame in self.quaternions:
            return quaternion_to_rotation(self.quaternions[row.frame])
        if len(matched) < 2:
            return None
        b, r = unproject(self.camera, matched.xy), self._apparent(matched.directions_icrs, row)
        rotation: FloatArray = quest(b, r, np.array([0, len(matched)]), covariance=False).rotations[
            0
        ]
        return rotation

    def _seen(
        self, row: ImageRow, rotation: FloatArray | None
    ) -> tuple[FloatArray, FloatArray, Any]:
        """Places (n, 2), magnitudes and names of the catalogue's stars within a frame, brightest
        first.
        """
        none = np.empty((0, 2)), np.empty(0), np.empty(0, dtype=np.str_)
        stars = None if rotation is None else self._catalogue
        if stars is None or rotation is None:
            return none
        corners = unproject(self.camera, detector_corners(self.camera))
        # Half a degree wider, for what the sky displaces.
        reach = np.cos(min(np.arccos(corners[:, 2].min()) + 0.01, 0.5 * np.pi))
        inside = np.flatnonzero(stars.directions_icrs @ rotation[2] > reach)
        b = self._apparent(stars.directions_icrs[inside], row) @ rotation.T
        within = b[:, 2] >= corners[:, 2].min()
        inside, b = inside[within], b[within]
        try:
            xy = project(self.camera, b)
        except DistortionError:
            return none
        on = self.camera.contains(xy)
        return xy[on], stars.mag[inside[on]], stars.star_id[inside[on]]

    def _pointing(self, rotation: FloatArray | None) -> tuple[float, float, float, float]:
        """Centre of the image, its roll, and where north is, degrees."""
        if rotation is None:
            nan = float("nan")
            return nan, nan, nan, nan
        camera = self.camera
        centre = np.array(camera.centre_px)
        middle, above = unproject(camera, np.array([centre, centre - [0.0, 1.0]])) @ rotation
        ra, dec = ra_dec_deg(middle[None])
        east = np.cross([0.0, 0.0, 1.0], middle)
        east /= np.linalg.norm(east)
        up = above - middle
        roll = float(np.degrees(np.arctan2(up @ east, up @ np.cross(middle, east))))
        # On an image as the sky is seen, east is left of north, so that up is left of north by the
        # roll.
        return float(ra[0]), float(dec[0]), roll % 360.0, -roll if self.mirrored else roll


@lru_cache(maxsize=1)
def _stars(limit: float, epoch: float) -> StarCatalogue:
    from starcal_uq.sky.catalogue import load_catalogue

    return load_catalogue(max_mag=limit, epoch=epoch)


def _nearest(points: FloatArray, among: FloatArray) -> tuple[IntArray, FloatArray]:
    """The nearest of other points for each one, and its distance."""
    from scipy.spatial import cKDTree

    if not len(points) or not len(among):
        return np.zeros(len(points), dtype=np.int64), np.full(len(points), np.inf)
    distance, place = cKDTree(among).query(points)
    return place.astype(np.int64), distance


def _limit(mag: FloatArray, seen: Any) -> float:
    """The magnitude that parts seen stars from others with the fewest exceptions; stars are
    brightest first.
    """
    if not len(mag) or not np.any(seen):
        return float("nan")
    return float(mag[int(np.argmax(np.cumsum(np.where(seen, 1, -1))))])


def _spread(items: Sequence[int], most: int) -> list[int]:
    """At most so many items, evenly spread."""
    if len(items) <= most:
        return list(items)
    return [
        items[k]
        for k in np.unique(np.linspace(0, len(items) - 1, max(most, 0)).astype(int)).tolist()
    ]
