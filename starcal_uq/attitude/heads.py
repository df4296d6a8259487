"""Several heads of one star tracker: one attitude of the body from theirs, and how they are mounted.

A head measures R_head_icrs with a left error phi of covariance P about its own axes. Its mounting
R_body_head turns vectors of the head into those of the body, so that it measures the attitude of
the body with the error R_body_head phi. The heads together, each with the inverse of its covariance
as its weight, have

    P_body = (sum R_body_head P^-1 R_body_head^T)^-1.

What a head knows badly, the turn about its boresight, another one knows well that looks elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.attitude.rotations import (
    exp_rotation,
    left_error,
    quaternion_multiply,
    quaternion_to_rotation,
    rotation_to_quaternion,
)
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.errors import HeadError, StarcalError, require
from starcal_uq.core.toml import Key, Section, read_toml
from starcal_uq.core.types import FloatArray, IntArray, PathLike
from starcal_uq.maths.intervals import chi_square_both_sides
from starcal_uq.maths.linear import mean_weights, root_diagonal

if TYPE_CHECKING:
    import pandas as pd

# Rows of a matrix that people round to six digits.
_ORTHONORMAL = 1e-5
# Parts of a quaternion, which need not have unit length.
_LARGE = 1e6
# References, each nearer to what is sought: errors of a degree leave nothing after three.
_PASSES = 4
ROTATION = Key(Any, "a matrix of three rows, or a quaternion", required=True)
_HEAD = Section(
    {
        "name": Key(str, "text in quotes", required=True, pattern=r"\S"),
        "rotation": ROTATION,
        "run": Key(str, "the run folder of its calibration, beside this file", pattern=r"\S"),
        "weighed_arcsec": Key(list[float], "three positive numbers, about X, Y and Z of the head"),
    },
    HeadError,
)


@dataclass(frozen=True)
class HeadTest:
    """How far heads differ from each other, beside what their covariances say.

    Attributes
    ----------
    chi_square : float
        Sum of squared differences, in stated covariances.
    dof : int
        Its degrees of freedom.
    """

    chi_square: float
    dof: int

    @property
    def ratio(self) -> float:
        """Chi-square per degree of freedom: 1 where covariances and mountings are right."""
        return self.chi_square / self.dof if self.dof else float("nan")

    @property
    def p_value(self) -> float:
        """Probability of a ratio as far from 1, either way, if they are; NaN where one head is
        alone.
        """
        return float(chi_square_both_sides(self.chi_square, self.dof))


@dataclass(frozen=True, eq=False)
class FusedAttitudes:
    """Attitudes of the body from those of all heads.

    Attributes
    ----------
    quaternions : (K, 4) array
        Of R_body_icrs, scalar last.
    covariance : (K, 3, 3) array
        Covariance of the left error about the axes of the body, rad^2.
    heads : (K,) array of int
        Heads that gave an attitude.
    squares : (K,) array
        Squared differences of the heads from the fused attitude, in their covariances.
    """

    quaternions: FloatArray
    covariance: FloatArray
    heads: IntArray
    squares: FloatArray

    @property
    def sigma_arcsec(self) -> FloatArray:
        """Standard deviation (3,) about X, Y and Z of the body, root mean square over frames."""
        variances = np.diagonal(self.covariance, axis1=1, axis2=2)
        return np.asarray(ARCSEC * np.sqrt(variances.mean(axis=0)))

    @property
    def test(self) -> HeadTest:
        """Whether heads differ as their covariances say. It sees a wrong weight along axes on which
        heads differ in it; the errors of two heads with one boresight cannot be told apart.
        """
        return HeadTest(float(self.squares.sum()), 3 * int(np.sum(self.heads - 1)))


@dataclass(frozen=True, eq=False)
class HeadArray:
    """Heads of one star tracker and their mountings.

    Attributes
    ----------
    names : tuple of str
        The heads.
    R_body_head : (H, 3, 3) array
        Rotations that turn vectors of a head into those of the body.
    runs : tuple of str
        Run folders of their calibrations, empty where none is stated.
    weighed_arcsec : (H, 3) array or None
        Standard deviations about the axes of each head by which the software aboard weighs it, NaN
        for one that is weighed by its noise; None where all are.
    """

    names: tuple[str, ...]
    R_body_head: FloatArray
    runs: tuple[str, ...] = ()
    weighed_arcsec: FloatArray | None = None

    def __post_init__(self) -> None:
        rotations = np.array(self.R_body_head, dtype=float)
        known = len(set(self.names)) == len(self.names) > 0
        require(
            HeadError,
            (known, f"heads are called {', '.join(self.names)}: give each a name of its own."),
            (
                rotations.shape == (len(self.names), 3, 3),
                f"there are mountings of shape {rotations.shape} for {len(self.names)} heads: give "
                "a 3 x 3 matrix for each.",
            ),
        )
        rotations.setflags(write=False)
        object.__setattr__(self, "R_body_head", rotations)

    def gains(self, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How errors of the heads turn the fused attitude, and its covariance.

        Parameters
        ----------
        covariance : (..., H, 3, 3) array
            Covariances that weigh the heads, each about the axes of its head; NaN for a head that
            gives no attitude.

        Returns
        -------
        (..., H, 3, 3) array, (..., 3, 3) array
            Turn about the axes of the body by a unit error about those of a head, and the
            covariance of the sum if those that weigh are right, in their unit.
        """
        weights, fused = body_weights(self.R_body_head, covariance)
        return weights @ self.R_body_head, fused

    def fuse(self, quaternions: FloatArray, covariance: FloatArray) -> FusedAttitudes:
        """Attitudes of the body from those of the heads.

        Parameters
        ----------
        quaternions : (H, K, 4) array
            R_head_icrs of each head in K frames, scalar last; NaN where a head has no attitude.
        covariance : (H, K, 3, 3) or (H, 1, 3, 3) array
            Covariances of their left errors, rad^2, as of `starcal_uq.attitude.quest`.

        Raises
        ------
        HeadError
            For arrays of another shape, and frames without any attitude.
        """
        q, cov, seen = self.by_frame(quaternions, covariance)
        weights, fused = body_weights(self.R_body_head, cov)
        apart, reference = apart_from(q, self.R_body_head, seen)
        for _ in range(_PASSES):
            turn = exp_rotation(np.einsum("khij,khj->ki", weights, apart))
            reference = quaternion_multiply(rotation_to_quaternion(turn), reference)
            apart, _ = apart_from(q, self.R_body_head, seen, reference)
        squares = np.einsum("khi,kij,khjl,khl->k", apart, np.linalg.inv(fused), weights, apart)
        return FusedAttitudes(reference, fused, seen.sum(axis=1), squares)

    def geometry(self, covariance: FloatArray) -> pd.DataFrame:
        """Errors about the axes of the body, 1 sigma, for each head alone, all, and all but one.

        Parameters
        ----------
        covariance : (3, 3) or (H, 3, 3) array
            Covariance of a head about its axes, rad^2, such as ``Plan.attitude_noise``.

        Returns
        -------
        DataFrame
            ``heads``, ``x_arcsec``, ``y_arcsec``, ``z_arcsec``.
        """
        import pandas as pd

        alone = np.eye(len(self.names), dtype=bool)
        sets = dict.fromkeys(tuple(kept) for kept in (*alone, *~alone, alone.any(axis=0)))
        rows = []
        for kept in sorted(filter(any, sets), key=sum):
            _, fused = self.gains(np.where(np.array(kept)[:, None, None], covariance, np.nan))
            names = " + ".join(name for name, one in zip(self.names, kept, strict=True) if one)
            rows.append((names, *(ARCSEC * root_diagonal(fused))))
        return pd.DataFrame(rows, columns=["heads", "x_arcsec", "y_arcsec", "z_arcsec"])

    def by_frame(
        self, quaternions: FloatArray, covariance: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Quaternions (K, H, 4), covariances (K, H, 3, 3), NaN where there is no attitude, and
        where there is one.
        """
        q = np.asarray(quaternions, dtype=float)
        right = q.ndim == 3 and q.shape[0] == len(self.names) and q.shape[2] == 4
        text = f"quaternions have shape {q.shape}: give (heads, frames, 4), with "
        require(HeadError, (right, f"{text}{len(self.names)} heads."))
        q = np.swapaxes(q, 0, 1)
        try:
            cov = np.broadcast_to(covariance, (len(self.names), len(q), 3, 3)).swapaxes(0, 1)
        except ValueError:
            raise HeadError(
                f"covariances have shape {np.shape(covariance)}: give (heads, frames, 3, 3), or "
                "(heads, 1, 3, 3)."
            ) from None
        seen = np.isfinite(q).all(axis=2) & np.isfinite(cov).all(axis=(2, 3))
        none = ~seen.any(axis=1)
        text = f"frame {int(np.argmax(none))} has an attitude of no head: leave it out."
        positive = np.linalg.eigvalsh(cov[seen])[:, 0] > 0.0
        require(
            HeadError,
            (not none.any(), text),
            (
                bool(positive.all()),
                "a covariance is not positive: give the noise of each head about its three axes, "
                "rad^2.",
            ),
        )
        return q, np.where(seen[:, :, None, None], cov, np.nan), seen


def body_weights(rotations: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weights of errors about the axes of the body, and the covariance of their mean."""
    return mean_weights(rotations @ covariance @ np.swapaxes(rotations, -1, -2))


def apart_from(
    q: FloatArray, rotations: FloatArray, seen: FloatArray, reference: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Left errors (K, H, 3) of the body from a reference, rad, zero where there is no attitude; and
    the reference (K, 4): by the first head that has an attitude, where none is given.
    """
    of_body = quaternion_multiply(rotation_to_quaternion(rotations), q)
    if reference is None:
        reference = of_body[np.arange(len(q)), np.argmax(seen, axis=1)]
    return np.where(seen[:, :, None], left_error(of_body, reference[:, None]), 0.0), reference


def load_heads(path: PathLike) -> HeadArray:
    """Read heads and their mountings: ``[[head]]`` tables of a TOML file.

    Each has ``name``, ``rotation`` (v_body = R v_head: three rows of three numbers, or a quaternion
    with its scalar last) and, for a budget, ``run``: the run folder of its calibration, beside the
    file; where the software aboard weighs it by another noise than its own, ``weighed_arcsec`` about
    X, Y and Z of the head. Other tables are those of a budget of the array.

    Raises
    ------
    HeadError
        When the file cannot be read, has no head, or a key is unknown, missing or wrong.
    """
    tables = read_toml(path, "heads", HeadError).get("head", [])
    good = isinstance(tables, list) and len(tables) > 0
    require(HeadError, (good, f"{path}: holds no head; write [[head]] above the keys of each."))
    names, rotations, runs, weighed = [], [], [], []
    for number, table in enumerate(tables, start=1):
        where = f"{path}, [[head]] {number}"
        good = isinstance(table, Mapping)
        require(HeadError, (good, f"{where}: is no table; write [[head]] above its keys."))
        read = _HEAD.check(table, where)
        names.append(read["name"].strip())
        words = "v_body = R v_head"
        rotations.append(stated_rotation(read["rotation"], where, words, HeadError))
        runs.append(str(Path(path).parent / read["run"]) if "run" in read else "")
        weighed.append(read.get("weighed_arcsec", [np.nan] * 3))
        good = len(weighed[-1]) == 3 and not min(weighed[-1]) <= 0.0
        text = f"{where}: key weighed_arcsec is {weighed[-1]}; write three positive numbers."
        require(HeadError, (good, text))
    stated = None if np.isnan(weighed).all() else np.array(weighed, dtype=float)
    try:
        return HeadArray(tuple(names), np.stack(rotations), tuple(runs), stated)
    except HeadError as error:
        raise HeadError(f"{path}: {error}") from None


def stated_rotation(value: Any, where: str, words: str, error: type[StarcalError]) -> FloatArray:
    """The matrix (3, 3) of a rotation that a file states as one, or as a quaternion; `words` say
    what it turns.
    """
    try:
        values = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        values = np.zeros(0)
    if values.size and not np.abs(values).max() < _LARGE:
        values = np.zeros(0)
    if values.shape == (4,) and np.any(values):
        values = quaternion_to_rotation(values / np.linalg.norm(values))
    if values.shape != (3, 3) or not np.abs(values @ values.T - np.eye(3)).max() < _ORTHONORMAL:
        raise error(
            f"{where}: key rotation is no rotation; write three rows of three numbers "
            f"({words}), or the four of a quaternion, scalar last."
        )
    if np.linalg.det(values) < 0.0:
        raise error(f"{where}: key rotation mirrors; change the sign of one row.")
    return values
