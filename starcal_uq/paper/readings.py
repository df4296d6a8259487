"""The readings of the experiment itself, each repeated over seeds with the paper's three methods.

The paper contradicts itself about the direction of its distortion (eq. 6 against eq. 14), its catalogue is not the
embedded one, and its baselines are described in a sentence each. Every reading here is one such choice; those that
contradict the text are marked, and can at most explain a number, not confirm it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.tasks import Progress, run_tasks
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.paper.error_readings import MAXIMUM, REPROJECTION
from starcal_uq.paper.published import MAX_MAG, N_FRAMES, N_STARS, Printed
from starcal_uq.paper.reading_draws import READINGS, Key, Plan, draw
from starcal_uq.sky.catalogue import load_catalogue

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class Readings:
    """Draws of every reading over seeds.

    Attributes
    ----------
    keys : tuple of Key
        What is drawn.
    draws : (len(keys), n) array
        Values in the units of `Printed.quantity`; NaN where a method gave no result.
    """

    keys: tuple[Key, ...]
    draws: FloatArray

    @property
    def n_draws(self) -> int:
        """Seeds."""
        return int(self.draws.shape[1])

    def of(self, reading: str, method: str, quantity: str, error: str = "") -> FloatArray:
        """Finite draws (m,) of one key; empty where the reading does not concern the method."""
        key = Key(reading, method, quantity, error)
        values: FloatArray = self.draws[self.keys.index(key)] if key in self.keys else np.empty(0)
        return values[np.isfinite(values)]

    def trials_of(self, number: Printed) -> Iterator[tuple[str, bool, FloatArray]]:
        """Words, faithfulness and draws of every reading that gives this number's quantity, the main one first."""
        errors: AnyDict = {"": ("", True)}
        if number.quantity == "reprojection_px":
            errors = {e.key: (e.words, e.faithful) for e in REPROJECTION}
        elif number.quantity == "max_residual_px":
            errors = {e.key: (e.words, e.faithful) for e in MAXIMUM}
        for reading in READINGS:
            for error, (words, allowed) in errors.items():
                draws = self.of(reading.key, number.method, number.quantity, error)
                if len(draws) > 1:
                    text = "; ".join(part for part in (reading.words, words) if part) or "as printed"
                    yield text, reading.faithful and allowed, draws

    def to_dataframe(self) -> pd.DataFrame:
        """One row per key: reading, method, quantity, error, n, mean, spread."""
        import pandas as pd

        rows = []
        for key, values in zip(self.keys, self.draws, strict=True):
            good = values[np.isfinite(values)]
            spread = float(np.std(good, ddof=1)) if len(good) > 1 else np.nan
            mean = float(np.mean(good)) if len(good) else np.nan
            rows.append({**key._asdict(), "n": len(good), "mean": mean, "spread": spread})
        return pd.DataFrame(rows)


def run_readings(
    *,
    convention: str = "eq14",
    n_draws: int = 24,
    n_frames: int = N_FRAMES,
    min_stars: int = 10,
    sigma_px: float = 0.05,
    seed: int = 2017,
    workers: int | None = None,
    progress: Progress | None = None,
) -> tuple[Readings, bool]:
    """Repeat the experiment over seeds under every reading.

    Parameters
    ----------
    convention : {"eq14", "eq6"}
        The main reading of the distortion.
    n_draws : int
        Seeds.
    n_frames, min_stars, sigma_px
        As in `simulate`.
    seed : int
        Draw i depends on the seed and on i alone, and is none of the replicates of the same seed.
    workers, progress
        As in `replicate`.

    Returns
    -------
    Readings
        Of the seeds that were complete.
    bool
        Whether Ctrl-C was pressed.

    Raises
    ------
    SamplingError
        If processes cannot be used.
    """
    stars = load_catalogue(max_mag=MAX_MAG)
    # As many as the paper's, by the embedded catalogue's band.
    sparse = stars.select(np.sort(np.argsort(stars.mag, kind="stable")[:N_STARS]))
    plan = Plan(stars, sparse, convention, n_frames, min_stars, sigma_px, seed)
    found, interrupted = run_tasks(
        partial(draw, plan), n_draws, caller="reproduce", chunk=1, workers=workers, progress=progress
    )
    keys = tuple(found[0])
    return Readings(keys, np.array([[one.get(key, np.nan) for one in found] for key in keys])), interrupted
