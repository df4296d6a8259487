"""Samplers on the exact likelihood: emcee as it comes, started from draws of the normal
approximation.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from likelihood import Likelihood

Result = dict[str, Any]


def ensemble(
    folder: Path, *, walkers: int = 32, steps: int = 1500, burn: int = 200
) -> Callable[[], Result]:
    """One ensemble, with emcee's default move."""
    import emcee

    density = Likelihood(folder)
    kept = Path(tempfile.mkdtemp(prefix="starcal-bench-"))
    seeds = iter(range(10_000))

    def run() -> Result:
        seed = next(seeds)
        rng, path = np.random.RandomState(seed), kept / f"{seed}.npy"
        sampler = emcee.EnsembleSampler(walkers, 6, density)
        start = emcee.State(rng.standard_normal((walkers, 6)), random_state=rng.get_state())
        sampler.run_mcmc(start, burn + steps, skip_initial_state_check=True)
        draws = density.parameters(sampler.get_chain(discard=burn))
        np.save(path, np.swapaxes(draws, 0, 1))
        return {"draws": str(path), "evaluations": walkers * (burn + steps)}

    return run
