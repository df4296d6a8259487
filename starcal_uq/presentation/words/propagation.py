"""What a posterior means for attitudes and directions, in sentences and tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from starcal_uq.camera.distortion import Parameter
from starcal_uq.core.constants import AXES, TOTAL_AXES
from starcal_uq.core.formatting import (
    fixed,
    join_words,
    percent,
    plus_minus,
    pretty_unit,
    significant,
)
from starcal_uq.core.remedy import RUN, Remedy
from starcal_uq.core.types import FloatArray
from starcal_uq.presentation.sentences.propagation import two_figures
from starcal_uq.presentation.tables import TextTable
from starcal_uq.propagation.attitude_error import (
    IF_MODEL_HOLDS,
    NOT_ASSESSED,
    WITH_MISFIT_FOUND,
    Agreement,
    AttitudeError,
)
from starcal_uq.propagation.coupling import Coupling
from starcal_uq.propagation.distortion import DistortionCurve
from starcal_uq.propagation.field import FieldMap
from starcal_uq.propagation.onboard_error import with_cross
from starcal_uq.propagation.spectrum import ErrorSpectrum
from starcal_uq.propagation.thermal import ThermalError

if TYPE_CHECKING:
    from starcal_uq.diagnostics.verdict.remedies import Place

# Ratios of standard deviations that are this close to one agree.
_AGREE = 0.02
_ROUNDING_ARCSEC = 1e-9


def agreement_text(agreement: Agreement) -> str:
    """What the ratios of sampled to first-order standard deviations mean."""
    if agreement.largest <= _AGREE:
        return (
            "Sampled and first-order standard deviations agree within "
            f"{percent(max(agreement.largest, 1e-6))}: "
            "attitude errors are linear in parameters and noise."
        )
    distance = np.where(np.isfinite(agreement.ratio), np.abs(agreement.ratio - 1.0), 0.0)
    row, axis = np.unravel_index(int(np.argmax(distance)), distance.shape)
    return (
        f"Sampled and first-order standard deviations differ by up to {percent(agreement.largest)} "
        f"({agreement.contributors[row]}, {AXES[axis]}): attitude errors are not linear over "
        "this posterior, and the "
        "sampled values hold."
    )


def agreement_table(agreement: Agreement) -> TextTable:
    """One row per contributor and axis."""
    return TextTable.of(
        agreement.to_dataframe(),
        formats={"sampled_over_first_order": lambda v: fixed(v, 5)},
        missing="not known",
    )


def one_number_sentence(error: AttitudeError) -> str:
    """What a single number for the calibration would hide, by both figures of every error."""
    common, rest, both = (
        (error.with_misfit_found_arcsec[row, 3], error.if_model_holds_arcsec[row, 3])
        for row in (1, 2, 3)
    )
    words = "Across the boresight, 1 sigma per axis, the calibration"
    # Below this it is rounding: frames that all show the same stars have no part that changes.
    if not max(np.nan_to_num(rest)) > _ROUNDING_ARCSEC:
        return f"{words} is a common rotation of {two_figures(*common)}."
    headline = error.headline_arcsec[:, 3]
    if headline[1] < headline[2]:
        return (
            f"{words} contributes {two_figures(*both)}; most of it depends on where the stars are, "
            f"{two_figures(*rest)}, and no alignment absorbs it."
        )
    return (
        f"{words} contributes {two_figures(*both)}. Most of it is a constant that alignment "
        "calibration with the same "
        f"parameters absorbs; what remains in flight is {two_figures(*rest)}."
    )


def misfit_sentence(error: AttitudeError, place: Place | None = None) -> str:
    """What the tests of the model mean for the errors, or the command that makes them."""
    if error.misfit is None:
        tests = Remedy("diagnose", (RUN,))
        return (
            f"What the errors are {WITH_MISFIT_FOUND} is {NOT_ASSESSED}: the model was not tested "
            f"(`{(tests if place is None else place.of(tests)).command}`), or what was found could "
            "not be fitted."
        )
    if error.variants or not error.misfit.effects:
        return (
            "The tests of the model ask for no further effects: an error "
            f"{WITH_MISFIT_FOUND} is that {IF_MODEL_HOLDS}."
        )
    names = join_words([effect.name for effect in error.misfit.effects])
    return (
        f"The data ask for effects ({names}): an error {WITH_MISFIT_FOUND} is that of the calibrated "
        "camera if the one with these effects is right."
    )


def alignment_sentence(error: AttitudeError) -> str:
    """What "absorbed by alignment" refers to, and what the alignment itself adds."""
    head = f"Alignment is on {error.alignment}"
    if not np.isfinite(error.alignment_arcsec).all():
        return f"{head}, the noise of which was not propagated by the version that wrote this."
    sizes = join_words([significant(v) for v in error.alignment_arcsec])
    text = f"{head}, whose noise leaves {sizes} arcsec ({', '.join(AXES)}) for good."
    if error.stays.any():
        axes = join_words([axis for axis, stays in zip(AXES, error.stays, strict=True) if stays])
        text += (
            f" The mission's frames see one field: the rest in {axes} is a bias that stays, too."
        )
    return text


def onboard_sentence(error: AttitudeError) -> str:
    """What is taken to be aboard, and what the other onboard model would make of the rest; empty
    without effects.
    """
    rests = {
        own.onboard: significant(float(with_cross(own.rest_arcsec)[3])) for own in error.variants
    }
    if not rests:
        return ""
    return (
        f"The calibration holds effects ({join_words([own.name for own in error.effects])}): the "
        f"rest across the boresight is {rests['model']} arcsec where the software uses the "
        f"parameters of the camera alone, and {rests['effects']} arcsec where it uses effects as "
        f"well; stated is that with onboard={error.onboard!r}."
    )


def attitude_text(error: AttitudeError) -> str:
    """Whether first order holds, what a single number would hide, what alignment is, and what the
    misfit adds.
    """
    parts = (agreement_text(error.agreement), one_number_sentence(error), alignment_sentence(error))
    warmth = "" if error.thermal is None else thermal_text(error.thermal)
    return " ".join(filter(None, (*parts, onboard_sentence(error), warmth, misfit_sentence(error))))


def attitude_table(error: AttitudeError) -> TextTable:
    """Contributors by axis, by both figures: 1 sigma, and the half-width across the boresight that
    holds 95 %.
    """
    held, found = error.if_model_holds_arcsec, error.with_misfit_found_arcsec
    widths = (error.half_widths_with_misfit_found_arcsec[0], error.p95_arcsec)
    absorbed = (
        error.to_dataframe().groupby("contributor", sort=False)["absorbed_by_alignment"].first()
    )
    rows: list[tuple[str, ...]] = []
    for place, (contributor, words) in enumerate(absorbed.items()):
        figures = []
        for name, sigma, width in zip(
            (WITH_MISFIT_FOUND, IF_MODEL_HOLDS), (found, held), widths, strict=True
        ):
            values = [*sigma[place], width[place, 3]]
            # The interaction is not known of runs of old.
            figures.append(
                (
                    f"  {name}",
                    *("not known" if np.isnan(v) else significant(v) for v in values),
                    "",
                )
            )
        once = error.misfit is None or figures[0][1:] == figures[1][1:]
        rows.append((str(contributor), *(figures[1][1:-1] if once else [""] * 5), str(words)))
        rows += [] if once else figures
    heads = ("contributor", *TOTAL_AXES, "two-axis 95 %", "absorbed by alignment")
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
        ("part", "aboard", *TOTAL_AXES),
        tuple(rows),
        f"Calibration's part with effects, arcsec, 1 sigma, {IF_MODEL_HOLDS}",
        "llrrrr",
    )


def thermal_text(error: ThermalError) -> str:
    """Temperatures, alignment, and what is left across the boresight with each onboard model."""
    peaks = error.peak_arcsec("model"), error.peak_arcsec("effects")
    sizes = [
        f"{significant(float(with_cross(own.rest_arcsec)[3]))} arcsec rms (largest "
        f"{significant(float(with_cross(peak)[3]))})"
        for own, peak in zip((error.model, error.effects), peaks, strict=True)
    ]
    words = (
        f"Over {error.profile.name}, {fixed(error.profile.temperature_c.min(), 1)} to "
        f"{fixed(error.profile.temperature_c.max(), 1)} °C with alignment at "
        f"{fixed(error.aligned_c, 1)} °C, "
        f"the temperature of the optics causes {sizes[0]} across the boresight where the software "
        "uses one camera for all temperatures, and "
        f"{sizes[1]} where it follows the temperature."
    )
    if not error.outside.any():
        return words
    return (
        f"{words} {percent(error.outside_share)} of the time are outside of the calibration's "
        f"{fixed(error.lowest_c, 1)} to {fixed(error.highest_c, 1)} °C, where the error assumes "
        "that the camera keeps changing in proportion."
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
    return TextTable(("part", "aboard", *TOTAL_AXES), rows, title, "llrrrr")


def coupling_text(coupling: Coupling) -> str:
    """The directions, from the least to the best determined."""
    return "\n".join(f"{direction.words}." for direction in coupling.weak_directions)


def coupling_table(coupling: Coupling, specs: Sequence[Parameter] = ()) -> TextTable:
    """What not knowing the others costs every parameter; sigmas in the units of `specs`, or in px
    units.
    """
    scales = (
        np.array([spec.scale for spec in specs])
        if specs
        else np.ones(len(coupling.parameter_names))
    )
    columns = {
        "σ": coupling.sigma_marginal / scales,
        "σ, others known": coupling.sigma_conditional / scales,
        "ratio": coupling.sigma_marginal / coupling.sigma_conditional,
        "variance inflation": coupling.variance_inflation,
        "Cramér–Rao bound": coupling.crlb_sigma / scales,
    }
    texts = {head: [significant(v) for v in column] for head, column in columns.items()}
    if coupling.contraction is not None:
        # The factor by which the data shrank the prior's sigma: a contraction of 1 - 1e-6 would
        # print as 1.
        shrunk = np.sqrt(np.maximum(1.0 - coupling.contraction, 1e-30))
        texts["prior σ / σ"] = [f"{significant(1.0 / v)} ×" for v in shrunk]
    texts["unit"] = [
        pretty_unit(unit) for unit in ([s.scaled_unit for s in specs] or coupling.units)
    ]
    rows = tuple(zip(coupling.parameter_names, *texts.values(), strict=True))
    return TextTable(
        ("", *texts),
        rows,
        "Coupling: what not knowing the others costs",
        "l" + "r" * (len(texts) - 1) + "l",
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


def field_text(field: FieldMap) -> str:
    """The middle of both maps, and the common rotation as an error of the principal point."""
    absolute, rest = (
        np.median(m) for m in (field.sigma_absolute_arcsec, field.sigma_compensated_arcsec)
    )
    text = (
        "If the model holds, half of the detector knows its directions to "
        f"{significant(absolute)} arcsec (1 sigma per "
        f"axis), or to {significant(rest)} arcsec once the best rotation is removed."
    )
    shift = equivalent_shift(field)
    return (
        text
        if shift is None
        else f"{text} Equivalent principal point, 1 sigma: {shift[0]} along x, {shift[1]} along y."
    )


def equivalent_shift(field: FieldMap) -> tuple[str, str] | None:
    """Error of the principal point along x and y that alone would cause the common rotation; None
    if not known.
    """
    pixels, angles = field.equivalent_principal_point_px, field.equivalent_principal_point_arcsec
    if pixels is None or angles is None:
        return None
    x, y = (
        f"{significant(p)} px ({significant(a)} arcsec)"
        for p, a in zip(pixels, angles, strict=True)
    )
    return x, y


def field_table(field: FieldMap) -> TextTable:
    """Least, median and largest uncertainty over the detector, before and after the best rotation
    is removed.
    """
    maps = (
        ("absolute", field.sigma_absolute_arcsec, field.worst_absolute_arcsec),
        ("best rotation removed", field.sigma_compensated_arcsec, field.worst_compensated_arcsec),
    )
    rows = tuple(
        (
            name,
            *(
                significant(v)
                for v in (np.min(sigma), np.median(sigma), np.max(sigma), np.max(worst))
            ),
        )
        for name, sigma, worst in maps
    )
    return TextTable(
        ("", "least", "median", "largest", "worst direction"), rows, "1 sigma per axis, arcsec"
    )


def corner_sentence(curve: DistortionCurve) -> str:
    """Displacement at the largest radius, with its standard deviation."""
    row = int(np.argmax(np.abs(curve.mean_px[:, -1])))
    value, sd = curve.mean_px[row, -1], curve.sd_px[row, -1]
    scale = curve.arcsec_per_px[-1]
    where = "" if len(curve.mean_px) == 1 else f" at {curve.azimuth_deg[row]:g}° from the x axis"
    return (
        f"At {curve.radius_px[-1]:.0f} px{where} the distortion is {plus_minus(value, sd)} px "
        f"({plus_minus(value * scale, sd * scale)} arcsec)."
    )


def distortion_text(curve: DistortionCurve) -> str:
    """Displacement at the largest radius, and what the bands are."""
    bands = (
        f"Bands of {percent(curve.level)}; the simultaneous one is ±{curve.multiplier:.2f} sd wide."
    )
    return f"{corner_sentence(curve)} {bands}"


def spectrum_text(spectrum: ErrorSpectrum) -> str:
    """How fast the frame-dependent part changes, and what averaging does to it."""
    rest, tau, nyquist = (
        spectrum.rest_arcsec,
        spectrum.correlation_time_s,
        spectrum.frequency_hz[-1],
    )
    share = spectrum.share_below(0.1 * nyquist)
    if not np.all(rest > _ROUNDING_ARCSEC):
        return (
            "The calibration has no frame-dependent part along this profile: its frames all show "
            "the same stars."
        )
    words = (
        f"If the model holds, along {spectrum.frames} the frame-dependent part of the "
        "calibration error is "
        f"{_listed(rest)} arcsec ({', '.join(AXES)}), beside {_listed(spectrum.nea_arcsec)} "
        "arcsec of centroid noise "
        f"in each frame. It keeps its value for about {_listed(tau)} s; "
        f"{', '.join(percent(v) for v in share)} of its variance lie "
        f"below a tenth of the highest frequency ({significant(0.1 * nyquist)} Hz). "
        f"{_averaging(spectrum)}"
    )
    if spectrum.gap_share > 0.0:
        words += (
            f" {percent(spectrum.gap_share)} of the instants have no frame and were interpolated."
        )
    return words


def _averaging(spectrum: ErrorSpectrum) -> str:
    after = spectrum.dominates_after_s
    if np.isfinite(after).any():
        axes = [
            f"{axis} after {significant(t)} s"
            for axis, t in zip(AXES, after, strict=True)
            if np.isfinite(t)
        ]
        return f"Where frames are averaged, it comes to exceed centroid noise: {join_words(axes)}."
    rest, noise = spectrum.averaged_arcsec(spectrum.longest_average_s)
    return (
        f"Averaging of frames, up to {significant(spectrum.longest_average_s)} s, leaves it "
        "below centroid noise: "
        f"{_listed(rest)} against {_listed(noise)} arcsec."
    )


def _listed(values: FloatArray) -> str:
    return ", ".join(significant(v) if np.isfinite(v) else "an unknown number of" for v in values)


def spectrum_table(spectrum: ErrorSpectrum) -> TextTable:
    """One row per axis."""
    table = pd.DataFrame(
        {
            "axis": AXES,
            "frame-dependent part [arcsec]": spectrum.rest_arcsec,
            "correlation time [s]": spectrum.correlation_time_s,
            "centroid noise of a frame [arcsec]": spectrum.nea_arcsec,
            "exceeds averaged noise after [s]": spectrum.dominates_after_s,
        }
    )
    return TextTable.of(table, missing="not known")
