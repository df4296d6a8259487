"""Round levels of filled contours."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.types import FloatArray

if TYPE_CHECKING:
    from matplotlib.colors import Normalize

_WIDE = 5.0


def round_levels(values: FloatArray) -> tuple[FloatArray, Normalize | None]:
    """Round levels; in equal ratios where the map spans more than a factor of five, else a few would hold it all."""
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import MaxNLocator

    low, high = float(np.min(values)), float(np.max(values))
    if low > 0.0 and high > _WIDE * low:
        decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
        steps = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0) if high < 50.0 * low else (1.0, 2.0, 5.0)
        candidates = np.outer(decades, steps).ravel()
        first = int(np.searchsorted(candidates, low * (1.0 + 1e-9), side="right")) - 1
        last = int(np.searchsorted(candidates, high * (1.0 - 1e-9)))
        levels = candidates[first : last + 1]
        return levels, LogNorm(float(levels[0]), float(levels[-1]))
    if high - low <= 1e-9 * abs(high):
        # A map without relief still needs two levels to be filled.
        low, high = low - 0.05 * abs(low) - 1e-12, high + 0.05 * abs(high) + 1e-12
    return np.asarray(MaxNLocator(10).tick_values(low, high), dtype=np.float64), None


def ticks_at_levels(bar: Any, levels: FloatArray) -> None:
    """Ticks of a colour bar at its levels, all of them or every second, third..., in plain numbers."""
    from matplotlib.ticker import FuncFormatter

    bar.set_ticks(levels[:: max(1, len(levels) // 8)])
    bar.formatter = FuncFormatter(lambda value, _: f"{value:.6g}")
    bar.update_ticks()
    bar.ax.minorticks_off()
