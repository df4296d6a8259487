"""Ensembles of emcee: separately seeded, in memory, interruptible and resumed bit for bit."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from starcal_uq.core.errors import SamplingError
from starcal_uq.core.files import atomic_path, reading
from starcal_uq.core.records import read_arrays
from starcal_uq.core.settings import Moves
from starcal_uq.core.tasks import interrupt_between_steps
from starcal_uq.core.types import AnyDict, FloatArray, IntArray, PathLike, Progress
from starcal_uq.inference.target import Density, Target, student_t_log_density

# Tails a little heavier than normal: most proposals are accepted, and no part of the posterior is
# out of reach.
PROPOSAL_DF = 8.0
_INDEPENDENCE_WEIGHT = 0.7
_CHUNK_STEPS = 25
_MAX_CHUNKS = 20
# Between checkpoints; whoever interrupts loses nothing, a process that is killed so much.
_SECONDS = 0.5


@dataclass(frozen=True)
class EnsembleSettings:
    """How to sample."""

    # `n_walkers`, `n_steps`, `n_burn`: per ensemble; burn-in steps come before and are not kept.
    n_walkers: int
    n_steps: int
    n_burn: int
    # "mixture" or "stretch": ``mixture`` is 0.7 of an independence proposal and 0.3 of differential
    # evolution.
    moves: Moves


@dataclass(frozen=True)
class Chains:
    """Draws of all ensembles."""

    u: FloatArray  # (n_ensembles, n_steps, n_walkers, d): whitened coordinates
    log_density: FloatArray  # (n_ensembles, n_steps, n_walkers): log posterior there
    accepted: IntArray  # (n_ensembles,): number of accepted proposals after the burn-in


def student_t_proposal(df: float) -> Callable[[FloatArray, Any], tuple[FloatArray, FloatArray]]:
    """An independence proposal for `emcee.moves.MHMove`: a standard multivariate t, whatever the
    present point.
    """

    def propose(u: FloatArray, random: Any) -> tuple[FloatArray, FloatArray]:
        normal = random.standard_normal(u.shape)
        new = normal / np.sqrt(random.chisquare(df, (len(u), 1)) / df)
        # Hastings: log q(old | new) - log q(new | old), and q does not depend on where it comes
        # from.
        return new, student_t_log_density(u, df) - student_t_log_density(new, df)

    return propose


def make_moves(moves: Moves) -> list[tuple[Any, float]]:
    """The weighted emcee moves of a name."""
    import emcee

    if moves == "stretch":
        return [(emcee.moves.StretchMove(), 1.0)]
    return [
        (emcee.moves.MHMove(student_t_proposal(PROPOSAL_DF)), _INDEPENDENCE_WEIGHT),
        (emcee.moves.DEMove(), 1.0 - _INDEPENDENCE_WEIGHT),
    ]


def run_ensembles(
    density: Density,
    dim: int,
    seeds: Sequence[np.random.SeedSequence],
    settings: EnsembleSettings,
    *,
    progress: Progress | None = None,
    checkpoint: PathLike | None = None,
    fingerprint: str = "",
    moves: list[tuple[Any, float]] | None = None,
) -> Chains:
    """Run one ensemble per seed, each from its own draws of the Laplace approximation.

    `density` takes whitened points (n, dim). The checkpoint is rewritten while sampling and read at
    the start; a resumed run gives the same draws, bit for bit, as one that was not interrupted. It
    is left in place, and passed over where the `fingerprint` of data and settings is another.
    `moves` stand in for those of the settings. SamplingError if a start is not finite.
    """
    import emcee

    class Sampler(emcee.EnsembleSampler):  # type: ignore[misc, unused-ignore]
        """emcee's sampler with the densities as one array: emcee itself loops over the walkers."""

        def compute_log_prob(self, coords: FloatArray) -> tuple[FloatArray, None]:
            found = density(coords)
            if np.isnan(found).any():
                raise ValueError("the density of a walker is not a number")
            return found, None

    weighted = make_moves(settings.moves) if moves is None else moves
    store = _Store(len(seeds), settings, dim, checkpoint, fingerprint)
    per_ensemble = settings.n_burn + settings.n_steps
    chunk = max(_CHUNK_STEPS, -(-settings.n_steps // _MAX_CHUNKS))
    total = per_ensemble * len(seeds)
    # emcee prints a page about any exception in the density, Ctrl-C included.
    with store.kept(), interrupt_between_steps() as check_interrupt:
        for index in range(store.ensemble, len(seeds)):
            state = store.state or _start(density, dim, seeds[index], settings.n_walkers)
            sampler = Sampler(settings.n_walkers, dim, density, moves=weighted, vectorize=True)
            for first, last in _chunks(store.step, settings, chunk):
                sampler.reset()
                steps = sampler.sample(
                    state, iterations=last - first, skip_initial_state_check=True
                )
                for step, last_state in enumerate(steps, start=first + 1):
                    state = last_state
                    check_interrupt()
                    if progress is not None:
                        progress(index * per_ensemble + step, total)
                store.add(index, first, last, sampler, state)
            store.next_ensemble()
    return store.chains


def ensemble_draws(
    target: Target,
    seed: np.random.SeedSequence,
    settings: EnsembleSettings,
    moves: list[tuple[Any, float]] | None = None,
) -> FloatArray:
    """Draws (n, p+1) of one ensemble, step after step; `moves` as of `run_ensembles`."""
    chains = run_ensembles(target.log_density, target.dim, [seed], settings, moves=moves)
    return target.natural(chains.u[0].reshape(-1, target.dim))


def autocorrelation(values: FloatArray) -> FloatArray:
    """Integrated autocorrelation times (d,) in steps of draws (ensemble, step, walker, d), averaged
    over ensembles.
    """
    from emcee.autocorr import integrated_time

    return np.asarray(
        np.mean([integrated_time(chain, tol=0, quiet=True) for chain in values], axis=0)
    )


def _start(density: Density, dim: int, seed: np.random.SeedSequence, n_walkers: int) -> Any:
    import emcee

    random = np.random.RandomState(seed.generate_state(8))
    u = random.standard_normal((n_walkers, dim))
    # emcee accepts walkers of zero density and never moves them.
    bad = int(np.sum(~np.isfinite(density(u))))
    if bad:
        raise SamplingError(
            f"{bad} of {n_walkers} start points drawn around the calibrated camera have no "
            "posterior density: check "
            "that the calibration converged, or use more stars."
        )
    return emcee.State(u, random_state=random.get_state())


def _chunks(done: int, settings: EnsembleSettings, size: int) -> Iterator[tuple[int, int]]:
    """Step ranges from `done` on; none of them contains both burn-in and kept steps."""
    total = settings.n_burn + settings.n_steps
    while done < total:
        limit = settings.n_burn if done < settings.n_burn else total
        last = min(done + size, limit)
        yield done, last
        done = last


class _Store:
    """Draws so far, where the run stands, and the checkpoint file."""

    def __init__(
        self,
        n_ensembles: int,
        settings: EnsembleSettings,
        dim: int,
        path: PathLike | None,
        fingerprint: str,
    ) -> None:
        shape = (n_ensembles, settings.n_steps, settings.n_walkers)
        self._n_burn, self._path, self._fingerprint = settings.n_burn, path, fingerprint
        accepted = np.zeros(n_ensembles, dtype=np.int64)
        self.chains = Chains(np.zeros((*shape, dim)), np.zeros(shape), accepted)
        self.ensemble, self.step = 0, 0
        self.state: Any = None
        self._written, self._due = True, 0.0
        if path is not None and Path(path).exists():
            self._read(path)

    def add(self, index: int, first: int, last: int, sampler: Any, state: Any) -> None:
        """Keep steps [first, last) of an ensemble unless they are burn-in; now and then, write the
        checkpoint.
        """
        if first >= self._n_burn:
            kept = slice(first - self._n_burn, last - self._n_burn)
            self.chains.u[index, kept] = sampler.get_chain()
            self.chains.log_density[index, kept] = sampler.get_log_prob()
            self.chains.accepted[index] += int(np.sum(sampler.backend.accepted))
        self.ensemble, self.step, self.state = index, last, state
        self._written = False
        if time.monotonic() >= self._due:
            self.keep()
            self._due = time.monotonic() + _SECONDS

    def keep(self) -> None:
        """Write what is new since the checkpoint."""
        if self._path is not None and not self._written:
            self._write(self._path)
            self._written = True

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Within, what is done when an interrupt or an error ends it is in the checkpoint."""
        try:
            yield
        except BaseException:
            self.keep()
            raise

    def next_ensemble(self) -> None:
        self.keep()
        self.ensemble, self.step, self.state = self.ensemble + 1, 0, None

    def _write(self, path: PathLike) -> None:
        _, key, position, has_gauss, gauss = self.state.random_state
        with atomic_path(path, durable=False) as temporary, open(temporary, "wb") as file:
            np.savez(
                file,
                fingerprint=np.array(self._fingerprint),
                place=np.array([self.ensemble, self.step]),
                coords=self.state.coords,
                log_prob=self.state.log_prob,
                key=key,
                # A half-used pair of normals is part of the state.
                rest=np.array([position, has_gauss]),
                gauss=np.array(gauss),
                **vars(self.chains),
            )

    def _read(self, path: PathLike) -> None:
        import emcee

        try:
            with reading(path, "a checkpoint of sampling", "delete it", SamplingError):
                content = read_arrays(path)
                if str(content["fingerprint"]) != self._fingerprint:
                    return
                n_walkers, dim = self.chains.u.shape[2:]
                shapes: AnyDict = {name: array.shape for name, array in vars(self.chains).items()}
                shapes |= {"coords": (n_walkers, dim), "log_prob": (n_walkers,)}
                shapes |= {"place": (2,), "rest": (2,), "gauss": ()}
                for name, shape in shapes.items():
                    found = content[name]
                    kinds = "iu" if name in ("place", "rest", "accepted") else "f"
                    right = found.shape == shape and found.dtype.kind in kinds
                    if not (right and np.isfinite(found).all()):
                        raise ValueError(f"{name} does not hold what it should")
                position, has_gauss = (int(v) for v in content["rest"])
                random_state = (
                    "MT19937",
                    content["key"],
                    position,
                    has_gauss,
                    float(content["gauss"]),
                )
                np.random.RandomState(0).set_state(random_state)
        except SamplingError:
            # What cannot be resumed is made again.
            return
        self.state = emcee.State(
            content["coords"], log_prob=content["log_prob"], random_state=random_state
        )
        self.chains = Chains(*(content[name] for name in vars(self.chains)))
        self.ensemble, self.step = (int(v) for v in content["place"])
