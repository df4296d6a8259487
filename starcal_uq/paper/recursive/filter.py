"""Recursive estimation of a camera, frame by frame: the iterated extended Kalman filter behind the
baselines.

A frame enters as its gradient ``a`` and information ``M`` (`innovations`), so that an update is
algebra of p x p matrices. With prior estimate u and covariance P (in units of the noise variance),
and the frame linearised at u0,

    P+ = (I + P M)^-1 P,    u+ = u + P+ (a - M (u - u0)),

and P+ is then recomputed in Joseph's form ``F P F^T + P+ M P+``, ``F = I - P+ M``, which rounding
cannot make indefinite. That the noise variance cancels lets the data give it: the whitened
innovations ``|d - J (u - u0)|^2 - (u+ - u)^T (a - M (u - u0))`` add up to the sum of squared
residuals of the batch solution.

**Where a frame is linearised.** At a point that frames share until the estimate has moved away from
it; then the present frame is taken again from its prior at the new estimate, until that agrees with
its point (the iterated filter, which is Gauss-Newton on the frame and its prior; Bell & Cathey
1993, IEEE Trans. Automatic Control 38(2), 294-297). Plain filters linearise every frame once, at
the prior: from a start far off they keep the error of the first frames for ever. Sharing points
changes estimates by less than a hundredth of a sigma and makes the linearisation of many frames at
a time possible, which is most of the work.

**The first frames.** A frame of a few stars leaves the estimate anywhere, and what it then says of
its own information is wrong for ever, iterated or not. So the first frames are held, and taken
together from the start each time another one comes, until together they determine every parameter.
With a dozen stars in a frame that is the first frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.settings import PairCovariance
from starcal_uq.core.status import Status
from starcal_uq.core.types import AnyDict, FloatArray, floats
from starcal_uq.maths.linear import root_diagonal, symmetric
from starcal_uq.observations.frames import StarFrames
from starcal_uq.paper.recursive.innovations import PairNormals, frame_normals

# Estimates that are kept of a long stream: when they are this many, every second one is dropped.
_MAX_HISTORY = 16_384


@dataclass
class FrameSums:
    """Sums over frames of their normal equations about one point, which say what the frames say
    together.
    """

    gram: FloatArray  # (1 + p, 1 + p): sum of `PairNormals.grams`: misfit of the pixels
    # (s, s): sum of products of the frames' entries (gradient and information), from which the
    # scatter of their scores follows for any estimate: the meat of the sandwich.
    moments: FloatArray
    degrees: float = 0.0  # Sum of 2 m - 3
    # `weight`, `squared_weight`: sums of the frames' weights, which are 1 where nothing is
    # forgotten, and of their squares.
    weight: float = 0.0
    squared_weight: float = 0.0

    @classmethod
    def empty(cls, p: int, diagonal: bool) -> FrameSums:
        """Nothing added yet; p parameters."""
        entries = entry_count(p) * (2 if diagonal else 1)
        return cls(np.zeros((1 + p, 1 + p)), np.zeros((entries, entries)))

    def add(
        self, gram: FloatArray, entries: FloatArray, size: int, forgetting: float = 1.0
    ) -> None:
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


def frame_entries(normals: PairNormals, moved: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gram matrices (K, 1 + p, 1 + p) about another point, and the distinct entries of every frame
    (K, s).

    `moved` (p,) is the point where the frames were linearised minus the new one, in the units of
    `normals`.
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
    """Estimates after every frame; of a long stream, after every 2nd, 4th, ... frame."""

    every: int = 1  # Frames between two entries
    # `estimates`, `sigmas`, (q,): in scaled units.
    estimates: list[FloatArray] = field(default_factory=list)
    sigmas: list[FloatArray] = field(default_factory=list)
    costs: list[float] = field(default_factory=list)  # Sum of whitened innovations

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

    def to_dict(self) -> AnyDict:
        """The lists as arrays, for a file."""
        return {
            name: value if name == "every" else np.array(value)
            for name, value in vars(self).items()
        }

    @classmethod
    def from_dict(cls, values: AnyDict) -> History:
        """Inverse of `to_dict`."""
        estimates, sigmas, costs = (values[name] for name in ("estimates", "sigmas", "costs"))
        return cls(values["every"], list(estimates), list(sigmas), costs.tolist())


# A linearisation serves while the estimate is within so many of its sigmas of it. The error that
# this leaves in a frame's innovation is of second order: a sigma of a single frame is some pixels
# in thousands. Where pairs are taken as independent these sigmas are a third of the spread, and the
# same reach is three times as many of them.
REACH_SIGMAS = {"full": 2.0, "diagonal": 6.0}
# Data without noise leave no sigma; this far, in px, every model is linear to rounding.
_REACH_PX = 1e-6
# Frames linearised at once at most: their arrays stay in the cache.
_WINDOW = 256
# Halvings of a step that makes matters worse.
_HALVINGS = 8
# Linearisations of the held frames each time another one comes: they go on where the last ones
# stopped.
_HELD_ITERATIONS = 4
# Degrees of freedom from which on the noise is estimated rather than taken as stated.
_ENOUGH_DOF = 30.0
# A parameter counts as determined when its sigma is this share of the start's; until all are,
# frames are held and taken together, but no more than so many.
_DETERMINED = 0.005
_MAX_HELD = 64


@dataclass
class Recursion:
    """State of a filter, and its update.

    Offsets are from `origin` in units of `scale`, and covariances in units of the noise variance.
    """

    model_name: str  # Distortion model that frames are linearised with, of p parameters
    # `origin`, `scale`, (p,): start and units, px units.
    origin: FloatArray
    scale: FloatArray
    offset: FloatArray  # (q,): estimate of the first q parameters; the others stay at the origin
    point: FloatArray  # (q,): point at which frames are linearised
    covariance: FloatArray  # (q, q): covariance of the estimate, per noise variance
    start_covariance: FloatArray  # (q, q): covariance at the start, per noise variance
    reference_px: float  # Stated noise: px, or 1 where the stars state their own
    pair_covariance: (
        PairCovariance  # "full" or "diagonal": covariance of the interstar angles that is assumed
    )
    process: (
        FloatArray | None
    )  # (q,): variance of each parameter's step from frame to frame, per noise variance
    forgetting: float  # Weight of the frames before against the next
    iterations: int  # Most linearisations of a frame
    sums: FrameSums  # About the origin
    # `response`, `noise`, (3, p) and (3, 3): sums over frames of `PairNormals.response` and
    # `PairNormals.noise`.
    response: FloatArray
    noise: FloatArray
    reach_sigmas: float  # How far from its point, in sigmas, a linearisation serves
    # `chi2`, `numbers`: sum of whitened innovations, and how many they are.
    chi2: float = 0.0
    numbers: float = 0.0
    # `n_frames`, `n_stars`: frames and stars.
    n_frames: int = 0
    n_stars: int = 0
    settled: bool = True  # Whether the last frame's linearisation agrees with its estimate
    held: StarFrames | None = None  # First frames, which will be taken again with the next one
    starting: bool = True  # Whether the parameters are not yet determined
    history: History = field(default_factory=History)  # Estimates so far

    @property
    def theta(self) -> FloatArray:
        """The estimate (p,), px units."""
        return self.full(self.offset)

    def full(self, offset: FloatArray) -> FloatArray:
        """Parameters (p,) in px units at an offset (q,) of the estimated ones."""
        theta = self.origin.copy()
        theta[: len(offset)] += self.scale[: len(offset)] * offset
        return theta

    @property
    def sigma(self) -> float:
        """Noise: from the innovations once there are enough, the stated one before."""
        dof = self.numbers - len(self.offset)
        return (
            float(np.sqrt(max(self.chi2, 0.0) / dof)) if dof >= _ENOUGH_DOF else self.reference_px
        )

    def advance(self, frames: StarFrames) -> None:
        """Take frames in, one after the other."""
        if not self.history.costs:
            self.history.add(
                0, self.offset, self.reference_px * root_diagonal(self.covariance), 0.0
            )
        first, window = 0, 1
        while first < frames.n_frames:
            if self.starting:
                self._start_with(frames.part(first, first + 1))
                first += 1
                continue
            last = min(first + window, frames.n_frames)
            part = frames.part(first, last)
            taken = self._advance_together(part)
            if not taken:
                self._advance_iterated(part.part(0, 1), self.iterations)
            # A point that has just served many frames will serve as many again.
            window = min(_WINDOW, 2 * window) if taken == last - first else max(1, taken)
            first += max(taken, 1)

    def _start_with(self, frame: StarFrames) -> None:
        """All frames so far, and this one, from the start."""
        self.held = frame if self.held is None else StarFrames.joined([self.held, frame])
        self.offset, self.covariance = np.zeros_like(self.offset), self.start_covariance
        self.sums = FrameSums.empty(len(self.origin), self.pair_covariance == "diagonal")
        self.response, self.noise = np.zeros_like(self.response), np.zeros_like(self.noise)
        self.chi2, self.numbers, self.n_frames, self.n_stars = 0.0, 0.0, 0, 0
        first = self.held.n_frames == 1
        self._advance_iterated(
            self.held, self.iterations if first else min(self.iterations, _HELD_ITERATIONS)
        )
        sigmas = self.sigma / self.reference_px * np.sqrt(self.covariance.diagonal())
        determined = np.all(sigmas < _DETERMINED * np.sqrt(self.start_covariance.diagonal()))
        if determined or self.held.n_frames >= _MAX_HELD:
            self.held, self.starting = None, False

    def _linearise(self, frames: StarFrames, point: FloatArray) -> PairNormals:
        return frame_normals(
            frames, self.model_name, self.full(point), self.scale, self.pair_covariance
        )

    def _about_origin(self, normals: PairNormals) -> tuple[FloatArray, FloatArray]:
        moved = np.zeros(len(self.origin))
        moved[: len(self.point)] = self.point
        return frame_entries(normals, moved)

    def _advance_together(self, frames: StarFrames) -> int:
        """Frames that share the present point; returns for how many of them it serves."""
        normals = self._linearise(frames, self.point)
        grams, entries = self._about_origin(normals)
        for i, size in enumerate(frames.sizes.tolist()):
            step = self._step(normals.weighted[i], self._prior(1))
            if step is None or not step.near:
                return i
            self._accept(step, float(normals.pairs[i]))
            self._add(grams[i], entries[i], normals, i, size)
            self._remember()
        return frames.n_frames

    def _advance_iterated(self, frames: StarFrames, iterations: int) -> None:
        """Frames taken as one, linearised until their estimate agrees with the point of its
        linearisation.
        """
        normals, step = self._attempt(frames, self.point)
        accepted = self._misfit(normals, self.point)
        for _ in range(iterations - 1):
            if step is not None and step.near:
                break
            target = self.offset if step is None else step.offset
            for _ in range(_HALVINGS):
                trial, trial_step = self._attempt(frames, target)
                misfit = self._misfit(trial, target)
                if misfit <= accepted * (1.0 + 1e-9) or not np.isfinite(accepted):
                    break
                # Too far for the linearisation: half the way.
                target = 0.5 * (target + self.point)
            else:
                break
            self.point, normals, step, accepted = target, trial, trial_step, misfit
        if step is None:
            raise CalibrationError(
                f"frame number {self.n_frames + 1} of the stream has no finite interstar angles "
                "at the estimate",
                Status.NOT_FINITE,
                reason=Status.NOT_FINITE.remedy,
            )
        grams, entries = self._about_origin(normals)
        self._accept(
            step, float(self._weights(len(normals.pairs)) @ normals.pairs), frames.n_frames
        )
        for i, size in enumerate(frames.sizes.tolist()):
            self._add(grams[i], entries[i], normals, i, size)
        self._remember()
        self.settled = step.near
        if not step.near:
            self.point = step.offset

    def _weights(self, n: int) -> FloatArray:
        """Weights of n frames that are taken together."""
        return self.forgetting ** np.arange(n - 1.0, -1.0, -1.0)

    def _attempt(self, frame: StarFrames, point: FloatArray) -> tuple[PairNormals, _Step | None]:
        before, self.point = self.point, point
        normals = self._linearise(frame, point)
        step = self._step(self._total(normals), self._prior(frame.n_frames))
        self.point = before
        return normals, step

    def _total(self, normals: PairNormals) -> FloatArray:
        """Gram matrix of frames that are taken together."""
        if len(normals.pairs) == 1:
            one: FloatArray = normals.weighted[0]
            return one
        total: FloatArray = np.sum(
            self._weights(len(normals.pairs))[:, None, None] * normals.weighted, axis=0
        )
        return total

    def _misfit(self, normals: PairNormals, point: FloatArray) -> float:
        """Sum of squares of frames at the point of their linearisation, and of the prior there."""
        shift = point - self.offset
        prior = self._prior(len(normals.pairs))
        value = float(self._total(normals)[0, 0] + shift @ np.linalg.solve(prior, shift))
        return value if np.isfinite(value) else float("inf")

    def _prior(self, n: int) -> FloatArray:
        """Covariance before the first of n frames that are taken together."""
        prior = self.covariance if self.forgetting == 1.0 else self.covariance / self.forgetting**n
        return prior if self.process is None else prior + np.diag(self.process)

    def _step(self, gram: FloatArray, prior: FloatArray) -> _Step | None:
        """The update by frames linearised at `point`; None where it is not finite."""
        q = len(self.offset)
        a, m = gram[1 : q + 1, 0], gram[1 : q + 1, 1 : q + 1]
        if not np.isfinite(gram[0, 0]):
            return None
        shift = self.offset - self.point
        gain = floats(np.linalg.solve(_identity(q) + prior @ m, prior))
        pulled = m @ shift
        slope = a - pulled
        change = gain @ slope
        offset = self.offset + change
        innovation = float(gram[0, 0] - (a + slope) @ shift - slope @ change)
        if not np.isfinite(innovation):
            return None
        far = np.abs(offset - self.point)
        limit = self.reach_sigmas * self.sigma * np.sqrt(np.abs(gain.diagonal()))
        return _Step(offset, prior, m, gain, innovation, bool((far <= limit + _REACH_PX).all()))

    def _accept(self, step: _Step, numbers: float, n: int = 1) -> None:
        """Take an update by n frames that hold so many independent numbers."""
        keep = _identity(len(step.offset)) - step.gain @ step.information
        covariance = keep @ step.prior @ keep.T + step.gain @ step.information @ step.gain.T
        if self.process is not None and n > 1:
            covariance = covariance + (n - 1) * np.diag(self.process)
        self.covariance = symmetric(covariance)
        self.offset = step.offset
        self.chi2 = self.forgetting**n * self.chi2 + step.innovation
        self.numbers = self.forgetting**n * self.numbers + numbers

    def _add(
        self, gram: FloatArray, entries: FloatArray, normals: PairNormals, index: int, size: int
    ) -> None:
        """Count a frame."""
        self.sums.add(gram, entries, size, self.forgetting)
        self.response += normals.response[index]
        self.noise += normals.noise[index]
        self.n_frames += 1
        self.n_stars += size

    def _remember(self) -> None:
        self.history.add(
            self.n_frames, self.offset, self.sigma * np.sqrt(self.covariance.diagonal()), self.chi2
        )


@dataclass(frozen=True)
class _Step:
    """An update that may be taken: estimate, prior, information of the frame, covariance,
    innovation, within reach.
    """

    offset: FloatArray
    prior: FloatArray
    information: FloatArray
    gain: FloatArray
    innovation: float
    near: bool


_IDENTITIES: dict[int, FloatArray] = {}


def _identity(q: int) -> FloatArray:
    """The identity matrix; made once, because a filter asks for it twice a frame."""
    if q not in _IDENTITIES:
        _IDENTITIES[q] = np.eye(q)
    return _IDENTITIES[q]
