"""What effects cost, and what tells slopes with the temperature, in a study that varies them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.formatting import fixed, significant
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.axes import place
from starcal_uq.studies.axes import NO_EFFECTS
from starcal_uq.studies.result import Study

if TYPE_CHECKING:
    import pandas as pd

_EFFECTS, _SLOPE = "effects", "slope_f"


def effects_answer(study: Study) -> list[str]:
    """Sentences on the costs of effects and on df/dT; none for a study without effects."""
    table = _costs(study)
    sentences = []
    if table is not None:
        sentences = [
            f"Beside {name}, the sigma of f is {fixed(row['f'], 2)} times and the common rotation "
            f"{fixed(row['common'], 2)} times as large as without effects; the rest is "
            f"{significant(row['rest'])} instead of {significant(row['plain'])} arcsec."
            for name, row in table.iterrows()
            if name != NO_EFFECTS
        ]
    slopes = _slopes(study)
    if slopes is not None:
        best, worst = (slopes.loc[at] for at in (slopes[_SLOPE].idxmin(), slopes[_SLOPE].idxmax()))
        told = [
            f"{significant(cell[_SLOPE])} px/K ({place(cell.drop(_SLOPE).to_dict())})"
            for cell in (best, worst)
        ]
        sentences.append(f"df/dT is known best to {told[0]}, worst to {told[1]}.")
    return sentences


def effects_table(study: Study) -> TextTable | None:
    """Growth of sigmas by effects, median over the cells that differ in these alone; None where
    effects are not varied, or never left out.
    """
    table = _costs(study)
    if table is None:
        return None
    rows = tuple(
        (
            str(name),
            *(f"× {fixed(row[key], 2)}" for key in ("x0", "f", "common")),
            significant(row["rest"]),
            significant(row["slope"]) if np.isfinite(row["slope"]) else "",
        )
        for name, row in table.iterrows()
    )
    heads = ("effects", "x₀", "f", "common", "rest [arcsec]", "df/dT [px/K]")
    return TextTable(heads, rows, "What effects cost: growth of sigmas, median of cells", "lrrrrr")


def _cells(study: Study) -> pd.DataFrame:
    """The cells that have numbers: their place in the sweep, and what effects change."""
    table = study.data[[*study.axes, "seed_index"]].to_dataframe()[[*study.axes, "seed_index"]]
    table = table.assign(
        x0=study.values("sigma", parameter="x0"),
        f=study.values("sigma", parameter="f"),
        common=study.values("common_rotation_arcsec", axis="cross"),
        rest=study.values("frame_error_arcsec", axis="cross"),
        slope=study.values(_SLOPE) if _SLOPE in study.data else np.nan,
    )
    return table[study.ok]


def _costs(study: Study) -> pd.DataFrame | None:
    """One row per choice of effects."""
    named = study.definition.axes.get(_EFFECTS, ())
    if len(named) < 2 or NO_EFFECTS not in named or not study.ok.any():
        return None
    cells = _cells(study)
    where = [name for name in (*study.axes, "seed_index") if name != _EFFECTS]
    plain = cells[cells[_EFFECTS] == NO_EFFECTS].set_index(where)
    compared = plain[["x0", "f", "common", "rest"]].add_suffix("_plain")
    both = cells.join(compared, on=where)
    for name in ("x0", "f", "common"):
        both[name] = both[name] / both[f"{name}_plain"]
    both["plain"] = both["rest_plain"]
    columns = ["x0", "f", "common", "rest", "plain", "slope"]
    return both.groupby(_EFFECTS, sort=False)[columns].median()


def _slopes(study: Study) -> pd.DataFrame | None:
    """Sigma of df/dT by the place in the sweep, median over repetitions; None where no cell has
    one.
    """
    if _SLOPE not in study.data or not study.axes or not study.ok.any():
        return None
    cells = _cells(study).dropna(subset="slope")
    found = cells.groupby(list(study.axes), sort=False)["slope"].median()
    return found.rename(_SLOPE).reset_index()
