"""Monte Carlo replicates: the one loop of every study that simulates again and again."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, TypedDict, TypeVar, Unpack

import numpy as np

from starcal_uq.core.errors import CalibrationError, CatalogueError, PriorError, StarcalError
from starcal_uq.core.store import Kept
from starcal_uq.core.tasks import run_tasks
from starcal_uq.core.types import PathLike, Progress
from starcal_uq.simulation.frames import Campaign

T = TypeVar("T")


class TrialOptions(TypedDict, total=False):
    """How trials are run; the keywords of `Trials.run`."""

    workers: int | None
    progress: Progress | None
    keep: PathLike | None


class ReplicateOptions(TrialOptions, total=False):
    """The same, with the data of one calibration beside the number of its frames (`Campaign`)."""

    min_stars: int
    sigma_px: float
    max_mag: float


def campaign_of(
    n_frames: int,
    *,
    min_stars: int = 10,
    sigma_px: float = 0.05,
    max_mag: float = 6.0,
    **run: Unpack[TrialOptions],
) -> tuple[Campaign, TrialOptions]:
    """Data of one calibration, and how trials are run."""
    return Campaign(n_frames, min_stars, sigma_px, max_mag), run


@dataclass(frozen=True)
class Outcomes(Generic[T]):
    """What became of trials.

    Attributes
    ----------
    results : list
        Results in the order of the trials; None for a trial that failed.
    failures : tuple of str
        Reasons of those.
    interrupted : bool
        Whether Ctrl-C was pressed before the last one; those that were complete are here.
    """

    results: list[T | None]
    failures: tuple[str, ...]
    interrupted: bool

    @property
    def good(self) -> list[T]:
        """Results of the trials that have one; CalibrationError if none has."""
        found = [result for result in self.results if result is not None]
        if not found:
            reason = Counter(self.failures).most_common(1)[0][0]
            raise CalibrationError(f"no replicate gave a result; the commonest reason: {reason}")
        return found


@dataclass(frozen=True)
class Trials(Generic[T]):
    """A trial that is repeated with other random numbers.

    Attributes
    ----------
    trial : partial
        Called with the number of the trial and its seeds. It holds, as positional arguments, all
        else that a result depends on.
    caller : str
        Function that users call, for messages.
    chunk : int
        Trials sent to a process at once (`run_tasks`).
    kinds : tuple of type
        Named tuples and dataclasses that results are, or hold.
    common : int
        So many consecutive trials have the same seeds.
    fatal : tuple of type
        Errors that end the study. Others are outcomes: by default all but those of settings that
        serve no trial.
    """

    trial: partial[T]
    caller: str
    chunk: int
    kinds: tuple[type, ...] = ()
    common: int = 1
    fatal: tuple[type[StarcalError], ...] = (CatalogueError, PriorError)

    def run(
        self,
        n_trials: int,
        seed: int | Sequence[int],
        *,
        workers: int | None = None,
        progress: Progress | None = None,
        keep: PathLike | None = None,
        whole: bool = False,
    ) -> Outcomes[T]:
        """Run trials 0 .. n_trials - 1; KeyboardInterrupt if they are to be `whole` and are not.

        A trial depends on the seed and its number alone: results are the same, bit for bit, for any
        number of processes, and a longer study begins with a shorter one. `workers` as for
        `starcal_uq.core.tasks.worth_starting`. `progress` is called with (trials done, trials).
        `keep` is a folder in which results are kept as they are made; a later call resumes from
        them.
        """
        identity = [self.caller, seed, self.trial.args]
        kept = None if keep is None else Kept(keep, identity, self.kinds)
        outcomes, interrupted = run_tasks(
            partial(self._attempt, seed),
            n_trials,
            caller=self.caller,
            chunk=self.chunk,
            workers=workers,
            progress=progress,
            kept=kept,
            whole=whole,
        )
        results = [None if isinstance(outcome, str) else outcome for outcome in outcomes]
        failures = tuple(outcome for outcome in outcomes if isinstance(outcome, str))
        return Outcomes(results, failures, interrupted)

    def _attempt(self, seed: Any, number: int) -> T | str:
        """The result of a trial, or why it has none."""
        seeds = np.random.SeedSequence(seed, spawn_key=(number // self.common,))
        try:
            return self.trial(number, seeds)
        except self.fatal:
            raise
        except StarcalError as error:
            return str(error)
