"""Effects beyond the camera in sentences and tables."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Any

from starcal_uq.likelihood.fitted_effects import Effects
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.sentences import table


def effects_table(effects: Effects, *, path: bool = False) -> TextTable | None:
    """One row per effect of the calibration, in the order in which they were taken up; None without
    any. With `path` those that were not taken up follow, with what they would gain.
    """
    if not effects.names:
        return None
    refused = [{"name": name, "gain_nat": gain} for name, gain in effects.refused if path]
    groups: dict[str, Sequence[Any]] = {
        "weighs": effects.weighing,
        "shifts": (*effects.of_camera, *effects.fitted),
        "refused": refused,
    }
    kinds = [kind for kind, group in groups.items() for _ in group]
    return table("effects", it=[*chain(*groups.values())], kind=kinds)
