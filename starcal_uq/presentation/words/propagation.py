"""What a posterior means for attitudes and directions, in sentences and tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from starcal_uq.camera.distortion import Parameter, scales_of
from starcal_uq.core.constants import AXES, INTERACTION
from starcal_uq.core.formatting import (
    fixed,
    significant,
)
from starcal_uq.core.types import AnyDict
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.sentences import table, told
from starcal_uq.propagation.attitude_error import (
    CONTRIBUTORS,
    IF_MODEL_HOLDS,
    WITH_MISFIT_FOUND,
    Agreement,
    AttitudeError,
)
from starcal_uq.propagation.coupling import Coupling
from starcal_uq.propagation.field import FieldMap
from starcal_uq.propagation.onboard_error import with_cross
from starcal_uq.propagation.spectrum import ErrorSpectrum
from starcal_uq.propagation.thermal import ThermalError

if TYPE_CHECKING:
    pass


def agreement_text(agreement: Agreement) -> str:
    """What the ratios of sampled to first-order standard deviations mean."""
    distance = np.nan_to_num(np.abs(agreement.ratio - 1.0), posinf=0.0)
    row, axis = np.unravel_index(int(np.argmax(distance)), distance.shape)
    where = f"{agreement.contributors[row]}, {AXES[axis]}"
    return told("agreement", agreement, where=where)


_NOTES = (
    "random, new in every frame",
    "one constant for the mission",
    "depends on where the stars are",
    "common rotation and rest together",
    "beyond the sum of both",
)
# Columns of 1 sigma, 95 % and 99.7 % by what they begin with.
_GROUPS = {"sigma": "", "p95": "p95_", "p997": "p997_"}


def attitude_rows(error: AttitudeError, small: bool = True) -> list[AnyDict]:
    """Contributions to the attitude error by both their figures, once where these print alike: 1
    sigma, 95 % and 99.7 % for each axis, arcsec; with `small` the interaction is but bounded.
    """
    kinds = {WITH_MISFIT_FOUND: "with_misfit_found", IF_MODEL_HOLDS: "if_model_holds"}
    rows = []
    groups = error.to_dataframe().groupby("contributor", sort=False)
    for (contributor, group), note in zip(groups, _NOTES, strict=True):
        name = str(contributor)
        shown = _small if small and name == INTERACTION else significant
        figures = []
        for kind, column in kinds.items():
            values = {
                head: [shown(float(v)) for v in group[f"{start}{column}_arcsec"]]
                for head, start in _GROUPS.items()
            }
            untested = kind == WITH_MISFIT_FOUND and error.misfit is None
            figures.append({"name": kind, "untested": untested, **values})
        found, held = figures
        if not found["untested"] and all(found[head] == held[head] for head in _GROUPS):
            figures = [{**held, "name": "both"}]
        if group["if_model_holds_arcsec"].isna().any():
            note = "not sampled by the version that wrote this run"
        rows.append(
            {
                "contributor": name,
                "note": note,
                "absorbed": str(group["absorbed_by_alignment"].iloc[0]),
                "total": name == CONTRIBUTORS[3],
                "figures": figures,
            }
        )
    return rows


def _small(arcsec: float) -> str:
    """The interaction is shown to be small, and no more: twelve columns leave no room for powers of
    ten.
    """
    if np.isnan(arcsec):
        return "—"
    return "<\N{NO-BREAK SPACE}0.001" if 0.0 < arcsec < 0.001 else significant(arcsec)


def attitude_table(error: AttitudeError) -> TextTable:
    """Contributors by axis, by both figures: 1 sigma, and the half-width across the boresight that
    holds 95 %.
    """
    rows: list[tuple[str, ...]] = []
    for row in attitude_rows(error, small=False):
        figures = [figure for figure in row["figures"] if not figure["untested"]]
        several = len(figures) > 1
        for figure in figures:
            cells = (*figure["sigma"], figure["p95"][3])
            rows.append((f"  {figure['name']}" if several else row["contributor"], *cells, ""))
        if several:
            rows.insert(-2, (row["contributor"], *[""] * 5, row["absorbed"]))
        else:
            rows[-1] = (*rows[-1][:-1], row["absorbed"])
    heads = ("contributor", *AXES, "across", "two-axis 95 %", "absorbed by alignment")
    which = f", {IF_MODEL_HOLDS}" if error.misfit is None else ""
    return TextTable(heads, tuple(rows), f"Attitude error, arcsec, 1 sigma{which}", "lrrrrrl")


def onboard_table(error: AttitudeError) -> TextTable:
    """The calibration's part by what the software aboard uses, one beside the other, and the share
    of every effect.
    """
    rows = [
        (part if own is error.variants[0] else "", own.onboard, *map(significant, values))
        for part in (error.variants[0].parts if error.variants else {})
        for own in error.variants
        for values in [with_cross(own.parts[part]).tolist()]
    ]
    return TextTable(
        ("part", "aboard", *AXES, "across"),
        tuple(rows),
        f"Calibration's part with effects, arcsec, 1 sigma, {IF_MODEL_HOLDS}",
        "llrrrr",
    )


def thermal_table(error: ThermalError) -> TextTable:
    """Root mean square and peak over the profile by what the software aboard uses."""
    rows = tuple(
        (name if own == "model" else "", own, *map(significant, with_cross(values).tolist()))
        for name, *both in (
            ("common rotation", error.model.common_arcsec, error.effects.common_arcsec),
            ("rest, rms over the profile", error.model.rest_arcsec, error.effects.rest_arcsec),
            ("rest, largest", error.peak_arcsec("model"), error.peak_arcsec("effects")),
        )
        for own, values in zip(("model", "effects"), both, strict=True)
    )
    title = f"Temperature of the optics over {error.profile.name}, arcsec, 1 sigma"
    return TextTable(("part", "aboard", *AXES, "across"), rows, title, "llrrrr")


def coupling_table(coupling: Coupling, specs: Sequence[Parameter] = ()) -> TextTable:
    """What not knowing the others costs every parameter; sigmas in the units of `specs`, or in px
    units.
    """
    scales = scales_of(specs) if specs else np.ones(len(coupling.parameter_names))
    contraction = coupling.contraction
    return table(
        "coupling",
        None,
        ("prior σ / σ",) if contraction is None else (),
        name=coupling.parameter_names,
        marginal=coupling.sigma_marginal / scales,
        conditional=coupling.sigma_conditional / scales,
        inflation=coupling.variance_inflation,
        bound=coupling.crlb_sigma / scales,
        contraction=np.zeros(len(scales)) if contraction is None else contraction,
        unit=[spec.scaled_unit for spec in specs] or coupling.units,
    )


def correlation_table(coupling: Coupling) -> TextTable:
    """Correlations of the parameters and of the rotation that they cause in every frame."""
    rows = tuple(
        (name, *(fixed(value, 2) for value in row))
        for name, row in zip(coupling.extended_names, coupling.extended_correlation, strict=True)
    )
    return TextTable(
        ("", *coupling.extended_names), rows, "Correlations, with the rotation common to all frames"
    )


def field_table(field: FieldMap) -> TextTable:
    """Least, median and largest uncertainty over the detector, before and after the best rotation
    is removed.
    """
    maps = (
        ("absolute", field.sigma_absolute_arcsec, field.worst_absolute_arcsec),
        ("best rotation removed", field.sigma_compensated_arcsec, field.worst_compensated_arcsec),
    )
    found = [(np.min(s), np.median(s), np.max(s), np.max(worst)) for _, s, worst in maps]
    return table("field", name=[name for name, *_ in maps], numbers=found)


def spectrum_table(spectrum: ErrorSpectrum) -> TextTable:
    """One row per axis."""
    rows = pd.DataFrame(
        {
            "axis": AXES,
            "frame-dependent part [arcsec]": spectrum.rest_arcsec,
            "correlation time [s]": spectrum.correlation_time_s,
            "centroid noise of a frame [arcsec]": spectrum.nea_arcsec,
            "exceeds averaged noise after [s]": spectrum.dominates_after_s,
        }
    )
    return TextTable.of(rows, missing="not known")


def attitude_notes(error: AttitudeError) -> list[str]:
    """What the errors are made from."""
    return [f"{error.n_draws} posterior draws through QUEST on {error.told_frames}."]
