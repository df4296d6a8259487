"""What a posterior means for attitudes and directions, in sentences and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from starcal_uq.camera.distortion import Parameter, scales_of
from starcal_uq.core.constants import AXES, INTERACTION, TOTAL_AXES
from starcal_uq.core.formatting import fixed, significant
from starcal_uq.core.types import AnyDict, FloatArray
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
from starcal_uq.propagation.onboard_error import EffectError, with_cross
from starcal_uq.propagation.spectrum import ErrorSpectrum
from starcal_uq.propagation.thermal import ThermalError


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
# 1 sigma, 95 % and 99.7 %.
_GROUPS = ("sigma", "p95", "p997")


def attitude_rows(error: AttitudeError, small: bool = True) -> list[AnyDict]:
    """Contributions to the attitude error by both their figures, once where these print alike: 1
    sigma, 95 % and 99.7 % for each axis, arcsec; with `small` the interaction is but bounded.
    """
    held = error.if_model_holds_arcsec, error.p95_arcsec, error.p997_arcsec
    found = error.with_misfit_found_arcsec, *error.half_widths_with_misfit_found_arcsec
    absorbed = error.to_dataframe()["absorbed_by_alignment"].iloc[:: len(TOTAL_AXES)]
    rows = []
    for place, (name, note) in enumerate(zip(CONTRIBUTORS, _NOTES, strict=True)):
        shown = _small if small and name == INTERACTION else significant
        figures: list[AnyDict] = [
            {head: [*map(shown, of[place])] for head, of in zip(_GROUPS, kind, strict=True)}
            for kind in (found, held)
        ]
        if error.misfit is not None and figures[0] == figures[1]:
            figures = [figures[1] | {"name": "both", "untested": False}]
        else:
            figures[0] |= {"name": WITH_MISFIT_FOUND, "untested": error.misfit is None}
            figures[1] |= {"name": IF_MODEL_HOLDS, "untested": False}
        if np.isnan(held[0][place]).any():
            note = "not sampled by the version that wrote this run"
        row = {"contributor": name, "note": note, "absorbed": absorbed.iloc[place]}
        rows.append({**row, "total": name == CONTRIBUTORS[3], "figures": figures})
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
        ends = (row["contributor"], row["absorbed"])
        if len(figures) > 1:
            rows.append((ends[0], *[""] * 5, ends[1]))
        for figure in figures:
            name, absorbed = ends if len(figures) == 1 else (f"  {figure['name']}", "")
            rows.append((name, *figure["sigma"], figure["p95"][3], absorbed))
    heads = ("contributor", *AXES, "across", "two-axis 95 %", "absorbed by alignment")
    which = f", {IF_MODEL_HOLDS}" if error.misfit is None else ""
    return TextTable(heads, tuple(rows), f"Attitude error, arcsec, 1 sigma{which}", "lrrrrrl")


def onboard_table(error: AttitudeError) -> TextTable:
    """The calibration's part by what the software aboard uses, one beside the other, and the share
    of every effect.
    """
    names = error.variants[0].parts if error.variants else {}
    parts = {name: {own.onboard: own.parts[name] for own in error.variants} for name in names}
    title = f"Calibration's part with effects, arcsec, 1 sigma, {IF_MODEL_HOLDS}"
    return _aboard(parts, title)


def thermal_table(error: ThermalError) -> TextTable:
    """Root mean square and peak over the profile by what the software aboard uses."""
    kinds: dict[Any, EffectError] = {"model": error.model, "effects": error.effects}
    parts = {
        "common rotation": {kind: own.common_arcsec for kind, own in kinds.items()},
        "rest, rms over the profile": {kind: own.rest_arcsec for kind, own in kinds.items()},
        "rest, largest": {kind: error.peak_arcsec(kind) for kind in kinds},
    }
    title = f"Temperature of the optics over {error.profile.name}, arcsec, 1 sigma"
    return _aboard(parts, title)


def _aboard(parts: Mapping[str, Mapping[Any, FloatArray]], title: str) -> TextTable:
    """Sigmas (3,) of parts of an error, by what the software aboard uses."""
    rows = []
    for part, by in parts.items():
        for aboard, sigma in by.items():
            rows.append((part, aboard, *map(significant, with_cross(sigma).tolist())))
            part = ""
    return TextTable(("part", "aboard", *AXES, "across"), tuple(rows), title, "llrrrr")


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
    return table(
        "field",
        name=("absolute", "best rotation removed"),
        sigma=(field.sigma_absolute_arcsec, field.sigma_compensated_arcsec),
        worst=(field.worst_absolute_arcsec, field.worst_compensated_arcsec),
    )


def spectrum_table(spectrum: ErrorSpectrum) -> TextTable:
    """One row per axis."""
    return table(
        "spectrum",
        axis=AXES,
        rest=spectrum.rest_arcsec,
        time=spectrum.correlation_time_s,
        noise=spectrum.nea_arcsec,
        after=spectrum.dominates_after_s,
    )


def attitude_notes(error: AttitudeError) -> list[str]:
    """What the errors are made from."""
    return [f"{error.n_draws} posterior draws through QUEST on {error.told_frames}."]
