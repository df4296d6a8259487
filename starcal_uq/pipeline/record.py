"""What became of every image of a run, and what identifying twice changed: kept in the run folder
for the report.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from starcal_uq.core.display import Shown
from starcal_uq.core.records import Saved
from starcal_uq.core.remedy import RUN, SOME_IMAGES, Remedy
from starcal_uq.core.types import PathLike
from starcal_uq.pipeline.cameras import OtherCamera, other_cameras
from starcal_uq.pipeline.refine import ImageCalibration, identified_pairs

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.identification.result import Identification
    from starcal_uq.images.centroids import Centroids
    from starcal_uq.observations.table import Observations

# File in the run folder.
IMAGES = "images.json"


@dataclass(frozen=True)
class RoundRecord:
    """One round of identification and calibration: frames identified, stars calibrated.

    Stars are `new` or `given_up` against the round before; zero in the first. `parameters` are
    estimates with standard deviations, px units, and `sigma` is that noise which was estimated, as
    `sigma_name` says.
    """

    n_frames: int
    n_stars: int
    new: int
    given_up: int
    parameters: dict[str, tuple[float, float]]
    sigma_name: str
    sigma: float


@dataclass(frozen=True)
class ImageRow:
    """One image: its name, time, centroids, outcome in words, and stars identified in the first and
    the last round.
    """

    frame: int
    image: str
    time_utc: str
    n_centroids: int
    outcome: str
    n_first: int
    n_last: int


@dataclass(frozen=True)
class ImageRecord(Shown, Saved):
    """The images of a run."""

    rounds: tuple[
        RoundRecord, ...
    ]  # The first with the nominal camera, the last with what was learnt
    rows: tuple[ImageRow, ...]  # Every image, used or not
    n_disturbed: int  # Stars left out because the light of a neighbour displaces them
    parity: str  # "normal" or "mirrored"
    # Files and folders that the images came from; empty in runs of versions that did not keep them.
    sources: tuple[str, ...] = ()
    # Magnitude (Gaia G) to which stars were searched for, where that is known.
    max_mag: float | None = None
    # Frames of other cameras, which were left out.
    others: tuple[OtherCamera, ...] = ()

    FILE = "a record of images", Remedy("run", (SOME_IMAGES,), {"out": RUN}, "again")

    @property
    def left_out(self) -> tuple[ImageRow, ...]:
        """Images without an identified star."""
        return tuple(row for row in self.rows if not row.n_last)


def record_images(
    centroids: Centroids,
    images: ImageCalibration | Identification | None,
    sources: Sequence[PathLike] = (),
) -> ImageRecord:
    """The record of images with their last identification and the rounds to it, as far as there are
    any.

    `sources` are the files and folders that the images came from.
    """
    calibrated = images if isinstance(images, ImageCalibration) else None
    last = images.identification if isinstance(images, ImageCalibration) else images
    first = last if calibrated is None else calibrated.rounds[0][0]
    counted = {} if first is None else {one.frame: one.n_identified for one in first.frames}
    by_frame = {} if last is None else {one.frame: one for one in last.frames}
    rows = []
    for number, image, time, n, problem in zip(
        centroids.frame_ids.tolist(),
        centroids.image.tolist(),
        centroids.time_utc.tolist(),
        centroids.stars_per_frame.tolist(),
        centroids.problem.tolist(),
        strict=True,
    ):
        frame = by_frame.get(number)
        status, n_last = (
            ("not searched", 0) if frame is None else (frame.status, frame.n_identified)
        )
        outcome = problem or status
        rows.append(ImageRow(number, image, time, n, outcome, counted.get(number, 0), n_last))
    rounds, before = [], None
    for identification, obs, calibration in () if calibrated is None else calibrated.rounds:
        rounds.append(_recorded(identification, obs, calibration, before))
        before = identification
    disturbed = 0 if calibrated is None else calibrated.observations.origin.disturbed_stars or 0
    places = tuple(os.path.abspath(source) for source in sources)
    parity, limit = (
        ("normal", None) if last is None else (last.parity, last.observations.origin.max_mag)
    )
    return ImageRecord(
        tuple(rounds), tuple(rows), int(disturbed), parity, places, limit, other_cameras(centroids)
    )


def _recorded(
    identification: Identification,
    obs: Observations,
    cal: Calibration,
    before: Identification | None,
) -> RoundRecord:
    now = identified_pairs(identification.observations)
    old = now if before is None else identified_pairs(before.observations)
    values = zip(cal.parameter_names, cal.theta.tolist(), cal.sigmas.tolist(), strict=True)
    return RoundRecord(
        n_frames=identification.n_identified,
        n_stars=obs.n_stars,
        new=len(now - old),
        given_up=len(old - now),
        parameters={name: (value, sigma) for name, value, sigma in values},
        sigma_name=cal.sigma_name,
        sigma=float(cal.sigma),
    )
