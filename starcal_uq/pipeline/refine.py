"""From centroids and a data sheet to a calibration: identify, calibrate, identify better, calibrate
again.

A nominal camera is some per cent off, so that the first identification must tolerate much and may
miss faint stars and poor frames. The calibration of what it found leaves tolerances of a fraction
of a pixel, and a second identification finds more stars and refuses what fitted by luck.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from starcal_uq.core.display import Shown
from starcal_uq.core.errors import CalibrationError, IdentificationError, RepeatedFramesError
from starcal_uq.core.formatting import plural
from starcal_uq.core.types import AnyDict
from starcal_uq.identification.engine import identify
from starcal_uq.pipeline.displacement import ToCatalogue, as_measured, mirrored, undisplaced

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.identification.result import Identification
    from starcal_uq.images.centroids import Centroids
    from starcal_uq.observations.table import Observations
    from starcal_uq.sky.catalogue import StarCatalogue


@dataclass(frozen=True, eq=False)
class ImageCalibration(Shown):
    """What two rounds of identification and calibration found.

    Attributes
    ----------
    rounds : tuple of (Identification, Observations, Calibration)
        In their order; the observations are those that were calibrated.
    """

    rounds: tuple[tuple[Identification, Observations, Calibration], ...]

    @property
    def identification(self) -> Identification:
        """The last one."""
        return self.rounds[-1][0]

    @property
    def observations(self) -> Observations:
        """The last ones."""
        return self.rounds[-1][1]

    @property
    def calibration(self) -> Calibration:
        """The last one."""
        return self.rounds[-1][2]


def identify_and_calibrate(
    centroids: Centroids,
    camera: Camera | None,
    stars: StarCatalogue,
    *,
    first: Identification | None = None,
    prepare: Callable[[Observations], Observations] | None = None,
    to_catalogue: ToCatalogue | None = None,
    method: AnyDict | None = None,
    model: str | None = None,
    identification: AnyDict | None = None,
) -> ImageCalibration:
    """Identify with the nominal camera, calibrate, and do both again with what was learnt.

    Parameters
    ----------
    centroids : Centroids
        Measured stars of all frames.
    camera : Camera or None
        The nominal camera, as for `identify`.
    stars : StarCatalogue
        Catalogue.
    first : Identification, optional
        The first identification, where it was made before.
    prepare : callable, optional
        Function that observations pass before they are calibrated, such as making directions
        apparent.
    to_catalogue : callable, optional
        Inverse of `prepare`, where that makes directions apparent: apparent directions (n, 3) and
        their times (n,) to catalogue directions (n, 3). The second identification then looks for
        stars where they are seen. It is not used where `prepare` leaves the directions as they are.
    method : dict, optional
        Options of `calibrate`.
    model : str, optional
        Distortion model for stars that determine neither that of the camera nor a simpler one as
        good.
    identification : dict, optional
        Options of `identify`.

    Raises
    ------
    IdentificationError
        When no frame is identified.
    CalibrationError
        When the stars that were identified do not determine the camera.
    """
    options = identification or {}
    found = identify(centroids, camera, stars, **options) if first is None else first
    rounds: list[tuple[Identification, Observations, Calibration]] = []
    for number in range(2):
        if not found.n_identified:
            raise IdentificationError(f"no frame is identified: {found.text}")
        obs = found.observations if prepare is None else prepare(found.observations)
        try:
            # Which frames repeat others is asked once, at the end.
            asked = {**(method or {}), **({"duplicates": "keep"} if number == 0 else {})}
            known = _calibrated(
                obs, found.nominal if number == 0 else rounds[0][0].nominal, model, asked
            )
        except RepeatedFramesError:
            raise
        except CalibrationError as error:
            stars_words = plural(obs.n_stars, "star")
            frames_words = plural(found.n_identified, "frame")
            raise CalibrationError(
                f"{stars_words} in {frames_words} were identified, but they do not determine the "
                f"camera ({error}) Give "
                "more frames, or fainter stars (max_mag, --max-mag).",
                error.status,
            ) from error
        rounds.append((found, obs, known))
        if number == 0:
            found = _again(centroids, found, obs, known, stars, to_catalogue, options)
    return ImageCalibration(tuple(rounds))


def _calibrated(
    obs: Observations, camera: Camera, model: str | None, options: AnyDict
) -> Calibration:
    """The calibration with the lens of a camera; with the model that was asked for where that is of
    no avail.
    """
    from starcal_uq.calibration.calibrate import calibrate

    try:
        return calibrate(obs, camera, **options)
    except RepeatedFramesError:
        raise
    except CalibrationError:
        if model in (None, camera.distortion):
            raise
        return calibrate(obs, camera.replace(distortion=model), **options)


def _again(
    centroids: Centroids,
    first: Identification,
    obs: Observations,
    known: Calibration,
    stars: StarCatalogue,
    to_catalogue: ToCatalogue | None,
    options: AnyDict,
) -> Identification:
    """The second identification, with the calibrated camera and centroids freed from what displaces
    the stars.
    """
    flipped = first.parity == "mirrored"
    table = mirrored(centroids, known.camera.width_px) if flipped else centroids
    moved = table
    if to_catalogue is not None and obs.origin.apparent:
        moved = undisplaced(table, obs, known.camera, to_catalogue)
    found = identify(moved, known.camera, stars, calibration=known, **options)
    # What follows is said against the data sheet.
    found = replace(found, nominal=first.nominal, optics=first.optics)
    if found.n_identified:
        found = replace(found, observations=as_measured(found.observations, moved, table))
    return replace(found, parity="mirrored") if flipped else found


def identified_pairs(obs: Observations) -> set[tuple[int, str]]:
    """Frame number and star of every row, where the stars are named."""
    if obs.star_id is None:
        return set()
    return set(zip(obs.frame.tolist(), obs.star_id.tolist(), strict=True))
