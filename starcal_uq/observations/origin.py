"""Where a table of observations or of centroids comes from, and what was done to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeVar, get_args

from starcal_uq.core.display import public_names
from starcal_uq.core.errors import ObservationError
from starcal_uq.core.facts import Facts
from starcal_uq.core.types import AnyDict

Directions = Literal["apparent", "catalogue", "undeclared"]
Air = Literal["corrected", "none", "unknown"]
T = TypeVar("T", bound="Sourced")

SIMULATED = "simulated"
# How the source of a table starts whose stars were identified in images; the catalogue follows.
_IDENTIFIED = "identified in "
# No observer of these sees through air.
_NO_AIR = ("space", "rendered")


@dataclass(frozen=True)
class Origin(Facts):
    """The facts of a table that decide how it is treated; None where a fact is not stated.

    Attributes
    ----------
    source : str or list of str
        Files, catalogue or simulation that the table was made from.
    directions : {"apparent", "catalogue", "undeclared"}
        Whether aberration is in the directions.
    seed : int
        Seed of a simulation.
    sigma_px : float
        Noise of a simulation, px per axis.
    truth : dict
        Camera of a simulation, as plain values.
    epoch : float
        Year of the catalogue's positions.
    max_mag : float
        Magnitude to which stars were searched for.
    observer : str
        "ground", "space" or "rendered"; "unknown" where refraction may be missing.
    site, atmosphere : dict
        Place on the ground and its air, as plain values, where refraction is in the directions.
    observer_velocity_km_s : list of float
        Mean of the barycentric velocities that were applied, ICRS axes, km/s.
    noise_floor_px, noise_scale : float
        Noise that was added to every star, px per axis, and the factor on what they state.
    low_stars, disturbed_stars : int
        Stars that were left out near the horizon, and beside bright neighbours.
    screening : dict
        Counts and settings of a screening, and what it blames.
    frames : str
        The frames in words, where they are not those observed.
    frame_times_s : list of float
        Times of the frames of a profile, s.
    messages : list of str
        Notes on how the frames were made.
    frame_names : str
        Names of frames that were numbered as they come.
    ignored_columns : list of str
        Columns of the file that are not used.
    attribution, licence : str
        Owner and licence of published data.

    Raises
    ------
    ObservationError
        If the kind of the directions is another word.
    """

    source: str | list[str] | None = None
    directions: Directions = "undeclared"
    seed: int | None = None
    sigma_px: float | None = None
    truth: AnyDict | None = None
    epoch: float | None = None
    max_mag: float | None = None
    observer: str | None = None
    site: AnyDict | None = None
    atmosphere: AnyDict | None = None
    observer_velocity_km_s: list[float] | None = None
    noise_floor_px: float | None = None
    noise_scale: float | None = None
    low_stars: int | None = None
    disturbed_stars: int | None = None
    screening: AnyDict | None = None
    frames: str | None = None
    frame_times_s: list[float] | None = None
    messages: list[str] | None = None
    frame_names: str | None = None
    ignored_columns: list[str] | None = None
    attribution: str | None = None
    licence: str | None = None

    def __post_init__(self) -> None:
        if self.directions not in get_args(Directions):
            raise ObservationError(
                f"observations: meta directions is {self.directions!r}; use apparent, catalogue or "
                "undeclared."
            )
        if not isinstance(self.frames, str):
            # The number of frames, which simulated partitions of former versions hold.
            object.__setattr__(self, "frames", None)

    @classmethod
    def identified(cls, catalogue: str, **facts: Any) -> Origin:
        """The origin of stars that were identified in images."""
        return cls(source=f"{_IDENTIFIED}{catalogue}", **facts)

    @property
    def from_images(self) -> bool:
        """Whether the stars were identified in images."""
        return str(self.source).startswith(_IDENTIFIED)

    @property
    def simulated(self) -> bool:
        """Whether the table is a simulation of centroids."""
        return self.source == SIMULATED

    @property
    def apparent(self) -> bool:
        """Whether aberration is in the directions."""
        return self.directions == "apparent"

    @property
    def without_air(self) -> bool:
        """Whether the observer is one that sees through no air."""
        return self.observer in _NO_AIR

    @property
    def air(self) -> Air:
        """Whether refraction is in the directions, is out of the question, or is not known.

        Directions that the user declared as apparent are what the camera saw, with all there is to
        it.
        """
        if self.observer == "ground":
            return "corrected"
        declared = self.apparent and self.observer != "unknown"
        return "none" if self.without_air or self.simulated or declared else "unknown"


@dataclass(frozen=True)
class CentroidsOrigin(Facts):
    """The facts of images that decide how their centroids are treated; None where not stated.

    Attributes
    ----------
    optics : dict
        Size of most images, and the focal length and pixel pitch that their headers state.
    other_sizes : dict
        Width and height, px, of the images that differ, by frame number.
    other_focals : list of (float, list of int)
        Focal length, px, and frames of other cameras of the same size.
    rendered : bool
        Whether all images were rendered, so that their stars shine through no air.
    place : dict
        Place on the ground that the headers state, and the keys that state it.
    """

    optics: AnyDict | None = None
    other_sizes: dict[str, tuple[int, int]] | None = None
    other_focals: list[tuple[float, list[int]]] | None = None
    rendered: bool | None = None
    place: AnyDict | None = None


class Sourced:
    """A table with plain values about it, `meta`, and the facts among them, `origin`."""

    __dir__ = public_names

    meta: AnyDict

    @property
    def origin(self) -> Origin:
        """The facts in `meta` that decide how the table is treated, as it is now."""
        return Origin.of(self.meta)

    @property
    def directions_declared(self) -> bool:
        """Whether the table says if its directions are apparent or straight from a catalogue."""
        return self.origin.directions != "undeclared"

    def with_meta(self: T, **entries: Any) -> T:
        """The same table with entries of `meta` added or changed."""
        raise NotImplementedError

    def with_origin(self: T, **facts: Any) -> T:
        """The same table with these facts of its origin; files keep them in the metadata."""
        Origin(**facts)  # Refuses what is no fact.
        return self.with_meta(**facts)
