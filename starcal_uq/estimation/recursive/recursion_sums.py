"""What a recursion remembers of its frames: sums of their normal equations, and the estimates after each."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from starcal_uq.core.types import FloatArray
from starcal_uq.estimation.recursive.innovations import FrameNormals

# Estimates that are kept of a long stream: when they are this many, every second one is dropped.
_MAX_HISTORY = 16_384


@dataclass
class FrameSums:
    """Sums over frames of their normal equations about one point, which say what the frames say together.

    Attributes
    ----------
    gram : (1 + p, 1 + p) array
        Sum of `FrameNormals.grams`: misfit of the pixels.
    moments : (s, s) array
        Sum of products of the frames' entries (gradient and information), from which the scatter of their scores
        follows for any estimate: the meat of the sandwich.
    degrees : float
        Sum of 2 m - 3.
    weight, squared_weight : float
        Sums of the frames' weights, which are 1 where nothing is forgotten, and of their squares.
    """

    gram: FloatArray
    moments: FloatArray
    degrees: float = 0.0
    weight: float = 0.0
    squared_weight: float = 0.0

    @classmethod
    def empty(cls, p: int, diagonal: bool) -> FrameSums:
        """Nothing added yet; p parameters."""
        entries = entry_count(p) * (2 if diagonal else 1)
        return cls(np.zeros((1 + p, 1 + p)), np.zeros((entries, entries)))

    def add(self, gram: FloatArray, entries: FloatArray, size: int, forgetting: float = 1.0) -> None:
        """One frame of `size` stars; `entries` as from `frame_entries`."""
        if forgetting != 1.0:
            self.gram *= forgetting
            self.moments *= forgetting**2
            self.degrees *= forgetting
            self.weight *= forgetting
            self.squared_weight *= forgetting**2
        self.gram += gram
        self.moments += entries[:, None] * entries
        self.degrees += 2 * size - 3
        self.weight += 1.0
        self.squared_weight += 1.0

    @property
    def effective_frames(self) -> float:
        """Number of frames, less where old ones are forgotten: ``(sum w)^2 / sum w^2``."""
        return self.weight**2 / self.squared_weight


def entry_count(p: int) -> int:
    """Entries of a symmetric (1 + p, 1 + p) matrix without its first."""
    return (p + 1) * (p + 2) // 2 - 1


def frame_entries(normals: FrameNormals, moved: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gram matrices (K, 1 + p, 1 + p) about another point, and the distinct entries of every frame (K, s).

    Parameters
    ----------
    normals : FrameNormals
        The frames.
    moved : (p,) array
        The point where they were linearised minus the new one, in the units of `normals`.
    """
    p = len(moved)
    transfer = np.eye(1 + p)
    transfer[1:, 0] = moved
    rows, columns = np.triu_indices(1 + p)
    grams = transfer.T @ normals.grams @ transfer
    entries = grams[:, rows[1:], columns[1:]]
    if normals.weighted is not normals.grams:
        weighted = transfer.T @ normals.weighted @ transfer
        entries = np.concatenate([entries, weighted[:, rows[1:], columns[1:]]], axis=1)
    return grams, entries


@dataclass
class History:
    """Estimates after every frame; of a long stream, after every 2nd, 4th, ... frame.

    Attributes
    ----------
    every : int
        Frames between two entries.
    estimates, sigmas : lists of (q,) arrays
        In scaled units.
    costs : list of float
        Sum of whitened innovations.
    """

    every: int = 1
    estimates: list[FloatArray] = field(default_factory=list)
    sigmas: list[FloatArray] = field(default_factory=list)
    costs: list[float] = field(default_factory=list)

    def add(self, n_frames: int, estimate: FloatArray, sigmas: FloatArray, cost: float) -> None:
        """The state after `n_frames` frames."""
        if n_frames % self.every:
            return
        self.estimates.append(estimate)
        self.sigmas.append(sigmas)
        self.costs.append(cost)
        if len(self.costs) > _MAX_HISTORY:
            self.every *= 2
            for name in ("estimates", "sigmas", "costs"):
                setattr(self, name, getattr(self, name)[::2])
