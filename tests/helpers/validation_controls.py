"""Ways to get the uncertainty wrong, for validations that must notice. Worker processes import this module."""

from __future__ import annotations

import dataclasses
from typing import Any


def forgets_attitudes(obs: Any, cal: Any) -> Any:
    """Counts 2 N residuals, as if no attitude had been fitted to them: sigma comes out too small."""
    return dataclasses.replace(cal.compressed, dof=2 * obs.n_stars)


def snooker() -> list[tuple[Any, float]]:
    """A popular mixture whose second part is biased (emcee 3.1.6)."""
    import emcee

    return [(emcee.moves.DEMove(), 0.8), (emcee.moves.DESnookerMove(), 0.2)]


def evolution() -> list[tuple[Any, float]]:
    """The first part of that mixture alone, which is right."""
    import emcee

    return [(emcee.moves.DEMove(), 1.0)]
