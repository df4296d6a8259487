"""Speed in units of something timed beside it: a slow or busy machine slows both."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np


def times_as_long(
    run: Callable[[], object], reference: Callable[[], object], repeats: int = 5
) -> float:
    """How many times as long as a reference something takes, in processor time: the shortest of
    both, in turns.
    """
    shortest = [float("inf"), float("inf")]
    for _ in range(repeats):
        for i, function in enumerate((run, reference)):
            began = time.process_time()
            function()
            shortest[i] = min(shortest[i], time.process_time() - began)
    return shortest[0] / shortest[1]


def sort_a_million() -> None:
    """A reference that is NumPy's own work: some 100 ms on a core of 2020.

    Its stable sort is the same on every processor; the other one takes a tenth where there are
    instructions for it.
    """
    np.sort(np.random.default_rng(0).random(1_000_000), kind="stable")
