"""From a table of identified stars to observations whose directions are as the camera saw them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcal_uq.core.errors import ObservationError
from starcal_uq.observations.partitions import PartitionedObservations, open_partitions
from starcal_uq.observations.table import Observations, load_observations
from starcal_uq.sky.site import check_sky

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.sky.site import Site


def observations_from_table(
    path: Any,
    camera: Camera,
    *,
    columns: Mapping[str, str] | None = None,
    directions: str | None = None,
    observer_velocity_km_s: Sequence[float] | None = None,
    site: Site | None = None,
    in_space: bool = False,
    time_utc: Any = None,
) -> Observations:
    """Read a table and make its directions apparent as far as the user has declared how.

    With directions ``catalogue`` (by default the file's own metadata say what they are), or with an
    observer velocity relative to the Earth's centre (ICRS axes), annual aberration is applied at
    each row's ``time_utc``. With a `site` on the ground, refraction and daily aberration are
    applied too, and stars lower than ten degrees left out; `in_space`, nothing need be said of
    refraction. Rows without a time are of `time_utc`. Paths and columns are as `load_observations`
    takes them; observations and tables can be in memory, too (`Observations.from_table`).
    """
    if isinstance(path, Observations):
        obs, path = path, Path("observations")
        obs.check(camera)
    elif isinstance(path, Path | list):
        obs = load_observations(path, camera=camera, columns=columns)
        path = path if isinstance(path, Path) else path[0]
    else:
        obs, path = Observations.from_table(path, camera=camera, columns=columns), Path("table")
    if time_utc is not None:
        _refuse_timed(path, [obs])
    return _apparent(obs, path, directions, observer_velocity_km_s, site, in_space, time_utc)


def partitions_from_folder(
    path: Path | PartitionedObservations,
    camera: Camera,
    *,
    columns: Mapping[str, str] | None = None,
    directions: str | None = None,
    observer_velocity_km_s: Sequence[float] | None = None,
    site: Site | None = None,
    in_space: bool = False,
    time_utc: Any = None,
) -> PartitionedObservations:
    """Open a folder of partitions, whose directions are made apparent as `observations_from_table`
    does, when read.
    """
    if isinstance(path, PartitionedObservations):
        obs, path = path, Path("observations")
    else:
        obs = open_partitions(path, camera, columns)
    if directions is not None:
        obs = obs.with_origin(directions=directions)
    if in_space:
        obs = obs.with_origin(observer="space")
    if time_utc is not None:
        _refuse_timed(path, map(obs.prepared(lambda table: table).reader.load, obs.parts))
    prepare = partial(
        _apparent,
        path=path,
        directions=None,
        observer_velocity_km_s=observer_velocity_km_s,
        site=site,
        in_space=in_space,
        time_utc=time_utc,
    )
    if obs.origin.apparent:
        # Nothing is left to be done to them but to refuse what contradicts it.
        prepare(obs.reader.load(obs.parts[0]))
    elif _catalogued(obs, observer_velocity_km_s, site):
        return obs.prepared(prepare, directions="apparent")
    return obs if time_utc is None else obs.prepared(prepare)


def _catalogued(
    obs: Observations | PartitionedObservations,
    observer_velocity_km_s: Sequence[float] | None,
    site: Site | None,
) -> bool:
    """Whether the directions are a catalogue's, as the table or what is known of the observer says."""
    observed = observer_velocity_km_s is not None or site is not None
    return observed or obs.origin.directions == "catalogue"


def _refuse_timed(path: Path, tables: Iterable[Observations]) -> None:
    """Refuse a time for rows all of which have one; no table is asked for beyond the first that
    lacks some.
    """
    if all(table.timed for table in tables):
        raise ObservationError(
            f"{path}: every row has a time (column time_utc): leave out --time.", column="time_utc"
        )


def _apparent(
    obs: Observations,
    path: Path,
    directions: str | None,
    observer_velocity_km_s: Sequence[float] | None,
    site: Site | None,
    in_space: bool,
    time_utc: Any,
) -> Observations:
    if time_utc is not None:
        obs = obs.with_time(time_utc)
    if directions is not None:
        obs = obs.with_origin(directions=directions)
    # A table that says nothing of its directions is taken to hold a catalogue's.
    declared = obs.origin.directions
    check_sky(directions if declared == "undeclared" else declared, site, in_space)
    if in_space:
        obs = obs.with_origin(observer="space")
    if obs.origin.apparent:
        if observer_velocity_km_s is not None:
            raise ObservationError(
                f"{path}: the directions are declared apparent already, so that an observer "
                "velocity would be applied "
                "twice: leave out --observer-velocity, or declare --directions catalogue."
            )
        return obs
    if _catalogued(obs, observer_velocity_km_s, site):
        from starcal_uq.sky.apparent import make_apparent, without_low_stars

        try:
            return make_apparent(
                obs if site is None else without_low_stars(obs, site),
                observer_velocity_km_s,
                site=site,
            )
        except ObservationError as error:
            raise ObservationError(
                f"{path}: {error}", row=error.row, column=error.column
            ) from error
    return obs
