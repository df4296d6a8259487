"""Ways to get the uncertainty wrong, for validations that must notice. Worker processes import this
module.
"""

from __future__ import annotations

import dataclasses
from typing import Any


def forgets_attitudes(obs: Any, cal: Any) -> Any:
    """Counts 2 N residuals, as if no attitude had been fitted to them: sigma comes out too
    small.
    """
    return dataclasses.replace(cal.compressed, dof=2 * obs.n_stars)


def snooker(weight: float = 0.2) -> list[tuple[Any, float]]:
    """A mixture whose second part is biased (emcee 3.1.6); a fifth of it is popular."""
    import emcee

    return [(emcee.moves.DEMove(), 1.0 - weight), (emcee.moves.DESnookerMove(), weight)]


def snooker_half() -> list[tuple[Any, float]]:
    """Half of the moves biased."""
    return snooker(0.5)


def evolution() -> list[tuple[Any, float]]:
    """The first part of that mixture alone, which is right."""
    import emcee

    return [(emcee.moves.DEMove(), 1.0)]
