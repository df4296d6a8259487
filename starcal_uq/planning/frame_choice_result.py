"""The result of choosing frames: which, in what order, and what they are worth."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.attitude.rotations import rotation_to_quaternion
from starcal_uq.core.files import atomic_path
from starcal_uq.core.formatting import significant
from starcal_uq.core.types import AnyDict, FloatArray, IntArray
from starcal_uq.sky.positions import ra_dec_deg

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class FrameChoice:
    """Frames to take, in the order of their value, and what they are worth. n frames, Q quantities, S random sets.

    Attributes
    ----------
    rotations : (n, 3, 3) array
        R_cam_icrs.
    candidate : (n,) array of int
        Their places among the candidates.
    n_stars : (n,) array of int
        Stars that each shows.
    criterion, scope : str
        What was optimised.
    names : tuple of str
        Quantities, with their units.
    before, after : (Q,) array
        1 sigma without the new frames (infinite without data) and with them.
    random : (S, Q) array
        1 sigma with as many random frames instead.
    richest : (Q,) array
        1 sigma with the candidates that show most stars instead.
    score_path : (n,) array
        Criterion after 1, 2, ... n frames in this order, as 1 sigma: arcsec for ``A``, relative to the whole choice for
        ``D`` (per parameter).
    random_path : (n,) array
        The same for random frames, on average.
    n_candidates : int
        Candidates that show enough stars.
    n_refused : int
        Candidates that do not.
    exchanges : int
        Frames exchanged after the greedy choice.
    provenance : dict
        Versions, settings and time.
    """

    rotations: FloatArray
    candidate: IntArray
    n_stars: IntArray
    criterion: str
    scope: str
    names: tuple[str, ...]
    before: FloatArray
    after: FloatArray
    random: FloatArray
    richest: FloatArray
    score_path: FloatArray
    random_path: FloatArray
    n_candidates: int
    n_refused: int
    exchanges: int
    provenance: AnyDict

    @property
    def quaternions(self) -> FloatArray:
        """Scalar-last R_cam_icrs, (n, 4)."""
        return rotation_to_quaternion(self.rotations)

    @property
    def factors(self) -> FloatArray:
        """1 sigma with random frames over that with the chosen ones, (S, Q): above 1 where the choice is better."""
        factors: FloatArray = self.random / self.after
        return factors

    def factor(self, name: str) -> tuple[float, float, float]:
        """Mean of `factors` for one quantity, and the range of 90 % of the random sets."""
        column = self.factors[:, self.names.index(name)]
        low, high = np.quantile(column, (0.05, 0.95))
        return float(column.mean()), float(low), float(high)

    def to_dataframe(self) -> pd.DataFrame:
        """One row per frame, most valuable first.

        Columns are ``order``, the boresight as ``ra_deg`` and ``dec_deg``, ``roll_deg`` (position angle of the camera's
        +Y axis, from north through east), the quaternion ``qx qy qz qw``, ``n_stars``, ``score`` (see `score_path`)
        and ``candidate``.
        """
        import pandas as pd

        ra, dec = ra_dec_deg(self.rotations[:, 2])
        q = self.quaternions
        return pd.DataFrame(
            {
                "order": np.arange(1, len(ra) + 1),
                "ra_deg": ra,
                "dec_deg": dec,
                "roll_deg": _position_angle(self.rotations),
                **{f"q{axis}": q[:, i] for i, axis in enumerate("xyzw")},
                "n_stars": self.n_stars,
                "score": self.score_path,
                "candidate": self.candidate,
            }
        )

    def worth(self) -> pd.DataFrame:
        """What the choice is worth, one row per quantity.

        Columns are 1 sigma ``before``, ``chosen``, with ``random`` frames (mean) and with the ``richest`` in stars, and
        ``factor``, random over chosen, with the range of 90 % of the random sets.
        """
        import pandas as pd

        low, high = np.quantile(self.factors, (0.05, 0.95), axis=0)
        return pd.DataFrame(
            {
                "quantity": self.names,
                "before": self.before,
                "chosen": self.after,
                "random": self.random.mean(axis=0),
                "richest": self.richest,
                "factor": self.factors.mean(axis=0),
                "factor_low": low,
                "factor_high": high,
            }
        )

    @property
    def verdict(self) -> str:
        """What was found, in plain words."""
        from starcal_uq.presentation.words.planning import choice_verdict

        return choice_verdict(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the frames as CSV, atomically and to the last digit; overwritten."""
        with atomic_path(path) as temporary:
            self.to_dataframe().to_csv(temporary, index=False)

    def plot(self, **options: Any) -> Any:
        """Where the frames point, and what they gain; options as for `starcal_uq.presentation.figures.planning.plot_frame_choice`."""
        from starcal_uq.presentation.figures.planning import plot_frame_choice

        return plot_frame_choice(self, **options)

    def _repr_html_(self) -> str:
        from html import escape

        html = self.worth().to_html(index=False, float_format=lambda v: significant(v, 3), border=0)
        return f"<p><b>Frames to take</b>: {escape(self.verdict)}</p>{html}"


def _position_angle(rotations: FloatArray) -> FloatArray:
    """Position angle (n,) of the camera's +Y axis on the sky at the boresight, deg, from north through east."""
    boresight, up = rotations[:, 2], rotations[:, 1]
    east = np.cross([0.0, 0.0, 1.0], boresight)
    east /= np.maximum(np.linalg.norm(east, axis=1, keepdims=True), 1e-12)
    north = np.cross(boresight, east)
    angle: FloatArray = np.degrees(np.arctan2(np.sum(up * east, axis=1), np.sum(up * north, axis=1)))
    return angle % 360.0
