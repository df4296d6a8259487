"""The result of star identification: observations, a record of every frame, the refined camera."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.core.display import Shown
from starcal_uq.core.types import FloatArray
from starcal_uq.observations.table import Observations

if TYPE_CHECKING:
    import pandas as pd

Parity: TypeAlias = Literal["normal", "mirrored"]
FrameStatus: TypeAlias = Literal["identified", "not identified", "ambiguous", "too few stars"]


@dataclass(frozen=True, eq=False)
class FrameIdentification:
    """What became of one frame.

    Attributes
    ----------
    frame : int
        Number of the frame.
    image : str
        Name of its image.
    status : str
        "identified"; "not identified": no attitude is accepted; "ambiguous": more than one is; "too
        few stars": fewer than four centroids.
    n_centroids, n_identified : int
        Centroids, and those with a catalogue star.
    n_ambiguous : int
        Centroids left out because two stars, or two centroids, are too close to tell which is
        which.
    n_unlike_brightness : int
        Centroids left out because they are farther from their star, and less of its brightness,
        than chance explains.
    log10_expected_false : float
        Decimal logarithm of the number of wrong attitudes, on the whole sky, expected to match as
        well; NaN if not identified.
    quaternion : (4,) array or None
        Scalar last, of R_cam_icrs (b = R r).
    noise_scale : float
        Noise found over noise stated, at least 1: the gate was widened by it.
    taste, taste_p_value : float
        Shuster's TASTE with the refined camera and the stated noise, chi-square with 2m - 3 degrees
        of freedom, and its p-value.
    milliseconds : float
        Time spent on the frame.
    """

    frame: int
    image: str
    status: FrameStatus
    n_centroids: int
    n_identified: int = 0
    n_ambiguous: int = 0
    n_unlike_brightness: int = 0
    log10_expected_false: float = math.nan
    quaternion: FloatArray | None = None
    noise_scale: float = math.nan
    taste: float = math.nan
    taste_p_value: float = math.nan
    milliseconds: float = 0.0


@dataclass(frozen=True)
class FoundOptics:
    """A focal length found from the stars alone.

    Attributes
    ----------
    focal_px : float
        Focal length, px.
    mirrored : bool
        Whether the images are mirror images of the sky.
    n_frames, n_searched : int
        Frames that agree, of those that were searched.
    distortion_px : float
        Largest displacement that their lens showed at the detector's corner.
    log10_expected_false : float
        Decimal logarithm of the number of wrong attitudes, on the whole sky and at any focal
        length, expected to match as well as the best of the frames.
    """

    focal_px: float
    mirrored: bool
    n_frames: int
    n_searched: int
    distortion_px: float
    log10_expected_false: float


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Shown):
    """Identified stars of all frames.

    Attributes
    ----------
    observations : Observations
        The identified stars. In a mirrored set, `x_px` is counted from the right edge: width_px - 1
        - x.
    frames : tuple of FrameIdentification
        Every frame that was given, identified or not.
    camera : Camera
        Refined from all identified frames, damped by the tolerances: for matching, not a
        calibration. Its principal point is counted as the observations are.
    nominal : Camera
        The camera of the search, counted likewise.
    parity : str
        "normal", or "mirrored" where the images are mirror images of the sky.
    n_left_out : int
        Frames whose images had been left out before, when the centroids were measured; the text is
        of the others.
    optics : FoundOptics or None
        What the stars alone said of the lens, where the search had to ask them.
    """

    observations: Observations
    frames: tuple[FrameIdentification, ...]
    camera: Camera
    nominal: Camera
    parity: Parity
    n_left_out: int = 0
    optics: FoundOptics | None = None

    @property
    def n_identified(self) -> int:
        """Frames identified."""
        return sum(frame.status == "identified" for frame in self.frames)

    def __repr__(self) -> str:
        return (
            f"Identification({self.n_identified} of {len(self.frames)} frames, "
            f"{self.observations.n_stars} stars)"
        )

    def to_dataframe(self) -> pd.DataFrame:
        """One row for each frame, with the fields of `FrameIdentification`; the quaternion in
        columns qx to qw.
        """
        import pandas as pd

        rows = []
        for frame in self.frames:
            row = {name: value for name, value in vars(frame).items() if name != "quaternion"}
            q = np.full(4, np.nan) if frame.quaternion is None else frame.quaternion
            rows.append(row | dict(zip(("qx", "qy", "qz", "qw"), q.tolist(), strict=True)))
        return pd.DataFrame(rows)
