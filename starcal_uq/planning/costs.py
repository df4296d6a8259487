"""What effects cost a calibration: how much less is known of camera and attitude when they are in
the model.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.types import FloatArray
from starcal_uq.planning.effects import PlannedEffects, joint_inverses
from starcal_uq.planning.forecast import quantities, spreads, start_with
from starcal_uq.planning.information import FrameSet

if TYPE_CHECKING:
    import pandas as pd

NONE, ALL = "none", "all"


@dataclass(frozen=True, eq=False)
class EffectCosts:
    """Standard deviations after n average frames, for no effect, each alone, and all together.

    Attributes
    ----------
    planned : PlannedEffects
        The effects, with their scales.
    n_frames : int
        Frames.
    models : tuple of str
        ``none``, the name of every effect, and ``all`` where there are several.
    names : tuple of str
        The Q quantities, with their units.
    sigma : (L, Q) array
        Their standard deviations by model, where the mission's software knows the effects; NaN of
        what a model has not.
    camera_alone : (L, Q) array
        Where it knows the camera alone, so that attitudes err by the effects themselves.
    """

    planned: PlannedEffects
    n_frames: int
    models: tuple[str, ...]
    names: tuple[str, ...]
    sigma: FloatArray
    camera_alone: FloatArray

    def of(self, model: str, name: str) -> float:
        """Standard deviation of one quantity."""
        return float(self.sigma[self.models.index(model), self.names.index(name)])

    def growth(self, model: str, *names: str) -> float:
        """Factor by which quantities grow, root mean square over several."""
        of = [self.names.index(name) for name in names]
        own, plain = (self.sigma[self.models.index(m)][of] for m in (model, NONE))
        return float(np.sqrt(np.sum(own**2) / np.sum(plain**2)))

    def to_dataframe(self) -> pd.DataFrame:
        """One row per model: its standard deviations, and those of the rest with the camera alone
        aboard.
        """
        import pandas as pd

        table = pd.DataFrame(self.sigma, columns=list(self.names))
        table.insert(0, "effects", list(self.models))
        alone = pd.DataFrame(self.camera_alone, columns=list(self.names)).filter(like="rest_")
        return table.join(alone.add_suffix("_camera_alone"))


def effect_costs(frames: FrameSet, n_frames: int, start: FloatArray | None) -> EffectCosts:
    """Costs of the effects of frames for a calibration that holds them; `start` (p, p) is
    information that is there already.
    """
    assert frames.seen is not None
    seen, p = frames.seen, len(frames.camera.theta)
    every = quantities(frames)
    names = tuple(q.name for q in every)
    held = list(seen.planned.scales)
    parts = {name: frames.with_effects(seen.only((name,))) for name in held}
    chosen = {NONE: frames.with_effects(seen.only(())), **parts}
    if len(held) > 1:
        chosen[ALL] = frames
    rows: list[FloatArray] = []
    alone: list[FloatArray] = []
    for mission in chosen.values():
        total = start_with(mission, start)
        assert total is not None and mission.joint is not None
        total = total + n_frames * mission.information.mean(axis=0)
        covariance = joint_inverses(total, p)
        # Errors of the parameters go with errors of the coefficients, all of which are errors there.
        aboard = covariance.copy()
        aboard[p:, p:] = np.diag(1.0 / mission.joint.prior[p:])
        own = quantities(mission)
        place = [names.index(q.name) for q in own]
        for into, matrix in ((rows, covariance), (alone, aboard)):
            into.append(np.full(len(names), np.nan))
            into[-1][place] = spreads(np.stack([q.form for q in own]), matrix)
    return EffectCosts(
        seen.planned, n_frames, tuple(chosen), names, np.array(rows), np.array(alone)
    )
