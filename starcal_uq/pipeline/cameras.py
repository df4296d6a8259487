"""Frames of another camera among those of a folder: another size of the image, or another focal
length of the stars.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.calibration.cameras import frame_focals
from starcal_uq.core.errors import IdentificationError

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.identification.result import Identification
    from starcal_uq.images.centroids import Centroids

# A focal length that differs by more is another camera's; what frames scatter by is less.
_APART = 0.003
# Frames that no star is found for are asked for another camera when they have so many centroids,
# the richest first.
_CENTROIDS, _ASKED = 12, 3


@dataclass(frozen=True)
class OtherCamera:
    """Frames of a camera that is not the one of most frames: what it is, in a few words, and their
    numbers.
    """

    words: str
    frames: tuple[int, ...]


@dataclass(frozen=True)
class _Group:
    """Frames of one focal length, px."""

    focal_px: float
    frames: tuple[int, ...]


def other_cameras(centroids: Centroids) -> tuple[OtherCamera, ...]:
    """The frames that were left out as those of other cameras, by size and by focal length."""
    by_size: dict[str, list[int]] = {}
    for number, (width, height) in (centroids.origin.other_sizes or {}).items():
        by_size.setdefault(f"{width} x {height} px", []).append(int(number))
    others = [OtherCamera(words, tuple(frames)) for words, frames in by_size.items()]
    for focal_px, frames in centroids.origin.other_focals or ():
        others.append(OtherCamera(f"f = {focal_px:.4g} px", tuple(frames)))
    return tuple(others)


def of_one_camera(
    centroids: Centroids,
    first: Identification,
    camera: Camera | None,
    tolerance: float,
    search: Callable[[Centroids], Identification],
) -> Centroids:
    """The centroids without the frames of other cameras than the one that most frames are of.

    Parameters
    ----------
    centroids : Centroids
        All frames.
    first : Identification
        What was identified in them.
    camera : Camera or None
        The sheet, if there is one: frames that are of it are kept, be they the fewer.
    tolerance : float
        Relative error of its focal length.
    search : callable
        Identification of centroids without a sheet.
    """
    groups = _groups(centroids, first, search)
    if len(groups) < 2:
        return centroids

    def rank(group: _Group) -> tuple[bool, int]:
        as_stated = camera is not None and abs(group.focal_px / camera.focal_px - 1.0) < tolerance
        return as_stated, len(group.frames)

    most = max(groups, key=rank)
    others = [group for group in groups if group is not most]
    odd = {number: group for group in others for number in group.frames}
    problem = [
        (
            f"another camera took it: f = {odd[number].focal_px:.4g} px, and {most.focal_px:.4g} "
            "px "
            "in most frames"
        )
        if number in odd
        else why
        for number, why in zip(
            centroids.frame_ids.tolist(), centroids.problem.tolist(), strict=True
        )
    ]
    kept = centroids.select(~np.isin(centroids.frame, list(odd)))
    focals = [[group.focal_px, list(group.frames)] for group in others]
    kept = replace(kept, problem=np.array(problem, dtype=np.str_))
    return kept.with_meta(other_focals=focals)


def _groups(
    centroids: Centroids, first: Identification, search: Callable[[Centroids], Identification]
) -> list[_Group]:
    """The frames by their focal lengths: those that were identified, and those that another lens
    explains.
    """
    if not first.n_identified:
        return []
    groups = _by_focal(first)
    left = [
        frame
        for frame in first.frames
        if frame.status != "identified" and frame.n_centroids >= _CENTROIDS
    ]
    while left:
        left.sort(key=lambda frame: -frame.n_centroids)
        try:
            found = search(centroids.select_frames([frame.frame for frame in left[:_ASKED]]))
            if found.n_identified and len(left) > _ASKED:
                found = search(centroids.select_frames([frame.frame for frame in left]))
        except IdentificationError:
            # Centroids that do not say the size of their images.
            break
        known = [group.focal_px for group in groups]
        new = [
            group
            for group in _by_focal(found)
            if all(abs(group.focal_px / f - 1.0) > _APART for f in known)
        ]
        if not new:
            break
        groups += new
        gone = {number for group in new for number in group.frames}
        left = [frame for frame in left if frame.frame not in gone]
    return groups


def _by_focal(found: Identification) -> list[_Group]:
    """Identified frames, grouped by the focal length that each tells by itself."""
    numbers = [frame.frame for frame in found.frames if frame.status == "identified"]
    if not numbers:
        return []
    focals = frame_focals(found.observations, found.camera)
    if focals.n_groups < 2:
        return [_Group(found.camera.focal_px, tuple(numbers))]
    groups = []
    for k in range(focals.n_groups):
        mine = focals.group == k
        groups.append(
            _Group(float(np.median(focals.focal_px[mine])), tuple(focals.frame_ids[mine].tolist()))
        )
    return groups
