"""Which frames to take next: a choice among candidate attitudes by optimal design.

Frames are added one by one, each the one that helps most (greedy), and then exchanged as long as
another candidate is better (Fedorov 1972, *Theory of Optimal Experiments*). What "helps" means is
the criterion:

- ``D``: the determinant of the information on the parameters, i.e. the volume of their joint
  uncertainty;
- ``A``: the mean variance, per axis across the boresight, of a part of the attitude error over the
  mission's attitudes.

Candidates are ranked by the derivative of the criterion, which costs one product of matrices; the
best of them are then evaluated exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Unpack, get_args

import numpy as np

from starcal_uq.attitude.rotations import random_rotations, rotation_to_quaternion
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import PlanningError, require
from starcal_uq.core.provenance import Provenance, provenance
from starcal_uq.core.settings import Criterion, Seed, bounded, seed_of
from starcal_uq.core.types import FloatArray, IntArray, floats
from starcal_uq.maths.linear import inverses, root_diagonal
from starcal_uq.planning.forecast import quantities, spreads
from starcal_uq.planning.information import FrameSet, look_at, random_frames
from starcal_uq.planning.plan import HasInformation, start_information
from starcal_uq.simulation.frames import Tracker, TrackerOptions
from starcal_uq.sky.positions import ra_dec_deg

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.camera.camera import Camera
    from starcal_uq.sky.catalogue import StarCatalogue

CRITERIA = get_args(Criterion)
CHOICE_SCOPES = ("common", "rest", "calibration")
# Without data, a thousandth of a mean frame makes the first steps defined.
_FAINT = 1e-3
_EXACT, _SWAPS_PER_FRAME, _RANDOM_SETS, _RANDOM_PATHS = 48, 3, 200, 20
_GAIN = 1e-9


@bounded
def choose_frames(
    camera: Camera,
    stars: StarCatalogue,
    *,
    n_frames: int,
    candidates: FloatArray | int = 3000,
    criterion: str = "A",
    scope: str = "common",
    after: HasInformation | None = None,
    n_geometries: int = 1000,
    seed: Seed = 0,
    **options: Unpack[TrackerOptions],
) -> FrameChoice:
    """Choose the frames that improve a calibration most.

    Parameters
    ----------
    camera : Camera
        The sheet, or the camera of the calibration `after`.
    stars : StarCatalogue
        The sky, to the sensor's limit.
    n_frames : int
        Frames to take.
    candidates : (M, 3, 3) array or int
        Attitudes (R_cam_icrs) that could be taken; or how many random ones to choose from. Each is
        taken at most once.
    sigma_px, min_stars, max_stars, exclusion
        Noise, stars of a frame and exclusion, as for `plan`; candidates with fewer stars are refused.
    criterion : {"A", "D"}
        ``A`` for the attitude error of `scope`, ``D`` for the parameters as a whole.
    scope : {"common", "rest", "calibration"}
        Part of the attitude error that ``A`` is about.
    after : Calibration or Posterior, optional
        Data that are there already.
    n_geometries : int
        Random attitudes that stand for the mission.
    seed : int or Generator
        Repeats bit for bit.

    Raises
    ------
    PlanningError
        For settings that cannot work, or fewer candidates than frames.
    CatalogueError
        When the field is too narrow for the catalogue to show `min_stars`.
    """
    seed = seed_of(seed)
    tracker = Tracker.of(camera, **options)
    _check(tracker.min_stars, criterion, scope)
    mission = random_frames(stars, tracker, n_frames=n_geometries, seed=seed)
    pool = _pool(stars, tracker, candidates, seed)
    if pool.n_frames < n_frames:
        raise PlanningError(
            f"{pool.n_frames} candidate attitudes show {tracker.min_stars} stars, fewer than the "
            f"{n_frames} frames asked for: "
            "give more candidates or ask for fewer frames."
        )
    start = start_information(after, camera)
    design = _Design(pool.information, criterion, _weights(mission, scope), start)
    chosen, exchanges = design.choose(n_frames)
    measured = quantities(mission)
    forms = np.stack([q.form for q in measured])
    rng = np.random.default_rng([seed, 2])
    random_sets = np.stack([rng.permutation(pool.n_frames)[:n_frames] for _ in range(_RANDOM_SETS)])
    none = np.zeros((len(camera.theta),) * 2) if start is None else start
    richest = np.argsort(-pool.n_stars, kind="stable")[:n_frames]
    sums = {
        name: none + pool.information[some].sum(axis=-3)
        for name, some in (("after", chosen), ("richest", richest), ("random", random_sets))
    }
    reference = design.score(sums["after"])
    n_given = candidates if isinstance(candidates, int) else len(candidates)
    settings = {"criterion": criterion, "scope": scope, "n_frames": n_frames, "candidates": n_given}
    return FrameChoice(
        rotations=pool.rotations[chosen],
        candidate=chosen,
        n_stars=pool.n_stars[chosen],
        criterion=criterion,
        scope=scope,
        names=tuple(q.name for q in measured),
        before=spreads(forms, inverses(none)),
        **{name: spreads(forms, inverses(total)) for name, total in sums.items()},
        score_path=design.path(chosen, reference),
        random_path=np.mean(
            [design.path(some, reference) for some in random_sets[:_RANDOM_PATHS]], axis=0
        ),
        n_candidates=pool.n_frames,
        n_refused=n_given - pool.n_frames,
        exchanges=exchanges,
        provenance=provenance(seed, settings, None),
    )


def _pool(
    stars: StarCatalogue, tracker: Tracker, candidates: FloatArray | int, seed: int
) -> FrameSet:
    if isinstance(candidates, int):
        rotations = random_rotations(max(candidates, 1), np.random.default_rng([seed, 3]))
    else:
        rotations = floats(candidates)
        if rotations.ndim != 3 or rotations.shape[1:] != (3, 3):
            raise PlanningError(
                f"candidates have the shape {rotations.shape}: give rotation matrices R_cam_icrs "
                "(M, 3, 3)."
            )
    return look_at(stars, tracker, rotations)


def _weights(mission: FrameSet, scope: str) -> FloatArray:
    """Matrix (p, p) whose product with a covariance is the mean variance per axis across the
    boresight, arcsec^2.
    """
    response = {
        "common": mission.common[None],
        "rest": mission.rest,
        "calibration": mission.response,
    }[scope]
    rows = ARCSEC * response[:, :2].reshape(-1, response.shape[-1]) / np.sqrt(2.0 * len(response))
    weights: FloatArray = rows.T @ rows
    return weights


class _Design:
    """A greedy choice with exchanges, in parameters scaled to order one."""

    def __init__(
        self, information: FloatArray, criterion: str, weights: FloatArray, start: FloatArray | None
    ) -> None:
        mean = information.mean(axis=0)
        self._scale = 1.0 / root_diagonal(mean)
        both = np.outer(self._scale, self._scale)
        self._information = information * both
        self._flat = self._information.reshape(len(information), -1)
        self._weights = weights * both
        self._start = _FAINT * mean * both if start is None else start * both
        self._is_d = criterion == "D"

    def choose(self, n: int) -> tuple[IntArray, int]:
        """Indices (n,) in the order of their value, and how many were exchanged."""
        chosen: list[int] = []
        total = self._start.copy()
        for _ in range(n):
            best, _ = self._best(total, chosen)
            chosen.append(best)
            total = total + self._information[best]
        exchanges = self._exchange(chosen, total)
        return self._ordered(np.array(chosen, dtype=np.int64)), exchanges

    def _exchange(self, chosen: list[int], total: FloatArray) -> int:
        """Exchange frames in place until none is better, or each was looked at a few times."""
        swapped = 0
        for _ in range(_SWAPS_PER_FRAME):
            before = swapped
            for place in range(len(chosen)):
                without = total - self._information[chosen[place]]
                others = chosen[:place] + chosen[place + 1 :]
                best, value = self._best(without, others)
                if value < self._value(total) - _GAIN * abs(self._value(total)):
                    total = without + self._information[best]
                    chosen[place] = best
                    swapped += 1
            if swapped == before:
                break
        return swapped

    def _best(self, total: FloatArray, taken: list[int]) -> tuple[int, float]:
        """The candidate whose addition makes the criterion least, and what it makes it."""
        inverse = np.linalg.inv(total)
        slope = inverse if self._is_d else inverse @ self._weights @ inverse
        gain = self._flat @ slope.ravel()
        gain[taken] = -np.inf
        # While few frames are there, one more changes everything and the derivative says little.
        n_exact = min(len(gain) - len(taken), _EXACT if len(taken) > 10 else 10 * _EXACT)
        some = np.argpartition(-gain, n_exact - 1)[:n_exact]
        values = self._values(total + self._information[some])
        place = int(np.argmin(values))
        return int(some[place]), float(values[place])

    def _values(self, totals: FloatArray) -> FloatArray:
        """Criterion (m,), less is better: mean variance, or minus the log determinant."""
        if self._is_d:
            logs: FloatArray = -np.linalg.slogdet(totals)[1]
            return logs
        values: FloatArray = np.einsum("nij,ij->n", np.linalg.inv(totals), self._weights)
        return values

    def _value(self, total: FloatArray) -> float:
        return float(self._values(total[None])[0])

    def _ordered(self, chosen: IntArray) -> IntArray:
        """Most valuable first: greedily among the chosen ones."""
        left, order, total = list(chosen), [], self._start.copy()
        while left:
            place = int(np.argmin(self._values(total + self._information[left])))
            total = total + self._information[left[place]]
            order.append(left.pop(place))
        return np.array(order, dtype=np.int64)

    def score(self, total: FloatArray) -> float:
        """Criterion of an information matrix in px units."""
        return self._value(total * np.outer(self._scale, self._scale))

    def path(self, frames: IntArray, reference: float) -> FloatArray:
        """Criterion after each frame as 1 sigma; for ``D`` per parameter, relative to a `reference`
        value.
        """
        values = self._values(self._start + np.cumsum(self._information[frames], axis=0))
        return (
            np.exp(0.5 * (values - reference) / len(self._scale)) if self._is_d else np.sqrt(values)
        )


def _check(min_stars: int, criterion: str, scope: str) -> None:
    require(
        PlanningError,
        (min_stars >= 3, f"min_stars is {min_stars}: an attitude needs at least 3."),
        (
            criterion in CRITERIA,
            f"the criterion {criterion!r} is unknown: use one of {', '.join(CRITERIA)}.",
        ),
        (
            scope in CHOICE_SCOPES,
            f"the scope {scope!r} cannot be optimised: use one of {', '.join(CHOICE_SCOPES)}.",
        ),
    )


@dataclass(frozen=True, eq=False)
class FrameChoice(Shown):
    """Frames to take, in the order of their value, and what they are worth. n frames, Q quantities,
    S random sets.

    Attributes
    ----------
    rotations : (n, 3, 3) array
        R_cam_icrs.
    candidate : (n,) array of int
        Places of the frames among the candidates.
    n_stars : (n,) array of int
        Stars that each shows.
    criterion, scope : str
        Criterion and part of the error that were optimised.
    names : tuple of str
        Quantities, with their units.
    before, after : (Q,) array
        1 sigma without the new frames (infinite without data) and with them.
    random : (S, Q) array
        1 sigma with as many random frames instead.
    richest : (Q,) array
        1 sigma with the candidates that show most stars instead.
    score_path : (n,) array
        Criterion after 1, 2, ... n frames in this order, as 1 sigma: arcsec for ``A``, relative to
        the whole choice for ``D`` (per parameter).
    random_path : (n,) array
        Values for random frames, on average.
    n_candidates : int
        Candidates that show enough stars.
    n_refused : int
        Candidates that do not.
    exchanges : int
        Frames exchanged after the greedy choice.
    provenance : Provenance
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
    provenance: Provenance

    @property
    def quaternions(self) -> FloatArray:
        """Scalar-last R_cam_icrs, (n, 4)."""
        return rotation_to_quaternion(self.rotations)

    @property
    def factors(self) -> FloatArray:
        """1 sigma with random frames over that with the chosen ones, (S, Q): above 1 where the
        choice is better.
        """
        return self.random / self.after

    def factor(self, name: str) -> tuple[float, float, float]:
        """Mean of `factors` for one quantity, and the range of 90 % of the random sets."""
        column = self.factors[:, self.names.index(name)]
        low, high = np.quantile(column, (0.05, 0.95))
        return float(column.mean()), float(low), float(high)

    def to_dataframe(self) -> pd.DataFrame:
        """One row per frame, most valuable first.

        Columns are ``order``, the boresight as ``ra_deg`` and ``dec_deg``, ``roll_deg`` (position
        angle of the camera's +Y axis, from north through east), the quaternion ``qx qy qz qw``,
        ``n_stars``, ``score`` (see `score_path`) and ``candidate``.
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
        """Gain of the choice, one row per quantity.

        Columns are 1 sigma ``before``, ``chosen``, with ``random`` frames (mean) and with the
        ``richest`` in stars, and ``factor``, random over chosen, with the range of 90 % of the
        random sets.
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


def _position_angle(rotations: FloatArray) -> FloatArray:
    """Position angle (n,) of the camera's +Y axis on the sky at the boresight, deg, from north
    through east.
    """
    boresight, up = rotations[:, 2], rotations[:, 1]
    east = np.cross([0.0, 0.0, 1.0], boresight)
    east /= np.maximum(np.linalg.norm(east, axis=1, keepdims=True), 1e-12)
    north = np.cross(boresight, east)
    angle: FloatArray = np.degrees(
        np.arctan2(np.sum(up * east, axis=1), np.sum(up * north, axis=1))
    )
    return angle % 360.0
