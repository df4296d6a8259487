"""States of a gyro-stellar filter from the rows of a budget: what of the error is white, what is
correlated and for how long, and what is a bias.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

from starcal_uq.budgeting.indices import Behaviours
from starcal_uq.budgeting.rows import KNOWLEDGE, SCOPES, Contributor
from starcal_uq.budgeting.totals import grouped_sigma
from starcal_uq.core.constants import AXES

BIAS, WHITE, CORRELATED, NOT_STATED = "bias", "white", "correlated", "not stated"
KINDS = (WHITE, CORRELATED, "periodic", "drift", BIAS, NOT_STATED)
_MEASURED = ("series", "spectrum")


@dataclass(frozen=True)
class FilterState:
    """What rows of a budget are to a filter, about one axis.

    Attributes
    ----------
    axis : str
        ``pitch``, ``yaw`` or ``roll``.
    kind : str
        ``white``: new in every frame; ``correlated``: first-order Gauss-Markov; ``periodic``;
        ``drift``; ``bias``: constant; ``not stated``: random in time, and nobody stated how.
    sigma_arcsec : float
        Standard deviation after alignment.
    seconds : float
        Time between frames, correlation time, period, or time of the drift, s; NaN for the others.
    misfit : float
        Largest difference of the autocovariance from that of the error spectrum, up to three
        correlation times, in variances; NaN where the behaviour is stated.
    contributors : tuple of str
        Rows.
    """

    DOCUMENTED: ClassVar = ("density",)

    axis: str
    kind: str
    sigma_arcsec: float
    seconds: float = math.nan
    misfit: float = math.nan
    contributors: tuple[str, ...] = ()

    @property
    def density(self) -> float:
        """White: sigma sqrt(seconds), arcsec sqrt(s). Correlated: root of the density of the noise
        that drives it, sigma sqrt(2 / seconds), arcsec / sqrt(s). NaN for the others.
        """
        scale = {WHITE: self.seconds, CORRELATED: 2.0 / self.seconds}.get(self.kind, math.nan)
        return self.sigma_arcsec * math.sqrt(scale)


def filter_states(rows: Sequence[Contributor], behaviours: Behaviours) -> tuple[FilterState, ...]:
    """States after alignment by axis and kind; none where no row is known to change in time.

    White noise of one time between frames is one state, and so are biases, and what has one period
    or drifts over one time; every other row has its own. What is periodic within two frames is new
    in each of them.
    """
    white = [one.seconds for one in behaviours.values() if one.kind == WHITE]
    step = max(white, default=0.0)
    parts: dict[tuple[str, ...], list[Contributor]] = {}
    for row in rows:
        counted = row.counts(SCOPES[1]) and row.assessed and row.applies and row.part == KNOWLEDGE
        if not (counted and row.sigma_arcsec > 0.0):
            continue
        for kind, share, *times in _shares(row, behaviours, step):
            own = row.name if kind in (CORRELATED, NOT_STATED) else ""
            part = replace(row, sigma_arcsec=math.sqrt(share) * row.sigma_arcsec)
            if share > 0.0:
                parts.setdefault((row.axis, kind, *map(str, times), own), []).append(part)
    states = [
        FilterState(
            axis,
            kind,
            grouped_sigma(members),
            float(seconds),
            float(misfit),
            tuple(row.name for row in members),
        )
        for (axis, kind, seconds, misfit, _), members in parts.items()
    ]
    states.sort(key=lambda state: (AXES.index(state.axis), KINDS.index(state.kind)))
    known = any(state.kind not in (BIAS, NOT_STATED) for state in states)
    return tuple(states) if known else ()


def _shares(
    row: Contributor, behaviours: Behaviours, step_s: float
) -> list[tuple[str, float, float, float]]:
    """Kinds of a row with their share of the variance, time and misfit."""
    behaviour = behaviours.get((row.name, row.axis))
    if row.interpretation == "ensemble" or (behaviour and behaviour.kind == "constant"):
        return [(BIAS, 1.0, math.nan, math.nan)]
    if behaviour is None:
        return [(NOT_STATED, 1.0, math.nan, math.nan)]
    if behaviour.kind == "periodic" and behaviour.seconds < 2.0 * step_s:
        return [(WHITE, 1.0, step_s, math.nan)]
    if behaviour.kind not in _MEASURED:
        return [(behaviour.kind, 1.0, behaviour.seconds, math.nan)]
    white, seconds, misfit = behaviour.gauss_markov()
    return [
        (WHITE, white, behaviour.seconds, math.nan),
        (CORRELATED, 1.0 - white, seconds, misfit),
    ]
