"""From centroids and a data sheet to a calibration: identify, calibrate, identify better, calibrate again.

A nominal camera is some per cent off, so that the first identification must tolerate much and may miss faint stars and
poor frames. The calibration of what it found leaves tolerances of a fraction of a pixel, and a second identification
finds more stars and refuses what fitted by luck.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from starcal_uq.errors import IdentificationError
from starcal_uq.formatting import plural
from starcal_uq.identification import identify

if TYPE_CHECKING:
    from starcal_uq.calibration import Calibration
    from starcal_uq.camera import Camera
    from starcal_uq.catalogue import StarCatalogue
    from starcal_uq.centroids import Centroids
    from starcal_uq.identification_result import Identification
    from starcal_uq.observations import Observations


@dataclass(frozen=True, eq=False)
class Bootstrap:
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

    @property
    def summary(self) -> str:
        """What the second round changed, in words."""
        (before, _, first), (after, _, second) = self.rounds[0], self.rounds[-1]
        old, new = _pairs(before.observations), _pairs(after.observations)
        words = (
            f"{plural(len(old), 'star')} in {plural(before.n_identified, 'frame')} with the nominal camera, "
            f"{plural(len(new), 'star')} in {plural(after.n_identified, 'frame')} with the calibrated one: "
            f"{len(new - old)} new, {len(old - new)} given up."
        )
        shift = (second.theta - first.theta) / second.sigmas
        moved = ", ".join(
            f"{name} {value:+.1f}" for name, value in zip(second.parameter_names, shift.tolist(), strict=True)
        )
        return f"{words} The estimate moved, in its standard deviations: {moved}."


def bootstrap(
    centroids: Centroids,
    camera: Camera,
    stars: StarCatalogue,
    *,
    prepare: Callable[[Observations], Observations] | None = None,
    method: dict[str, Any] | None = None,
    identification: dict[str, Any] | None = None,
) -> Bootstrap:
    """Identify with the nominal camera, calibrate, and do both again with what was learnt.

    Parameters
    ----------
    centroids : Centroids
        Measured stars of all frames.
    camera : Camera
        The nominal camera.
    stars : StarCatalogue
        Catalogue.
    prepare : callable, optional
        What is done to observations before they are calibrated, such as making directions apparent.
    method : dict, optional
        Options of `calibrate`.
    identification : dict, optional
        Options of `identify`.

    Raises
    ------
    IdentificationError
        When no frame is identified.
    CalibrationError
        When the stars that were identified do not determine the camera.
    """
    from starcal_uq.estimation import calibrate

    rounds: list[tuple[Identification, Observations, Calibration]] = []
    known: Calibration | None = None
    for _ in range(2):
        found = identify(centroids, camera, stars, calibration=known, **(identification or {}))
        if not found.n_identified:
            raise IdentificationError(f"no frame is identified: {found.summary}")
        obs = found.observations if prepare is None else prepare(found.observations)
        known = calibrate(obs, camera, **(method or {}))
        rounds.append((found, obs, known))
    return Bootstrap(tuple(rounds))


def _pairs(obs: Observations) -> set[tuple[int, str]]:
    if obs.star_id is None:
        return set()
    return set(zip(obs.frame.tolist(), obs.star_id.tolist(), strict=True))
