"""Calibrations, screenings and the agreement of merged runs in sentences and tables."""

from __future__ import annotations

import numpy as np

from starcal_uq.calibration.fallback import fallback_facts
from starcal_uq.calibration.screening.result import REASONS, Screening
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import parameters
from starcal_uq.core.formatting import (
    decimals_for,
    fixed,
    join_words,
    p_words,
    percent,
    plural,
    pretty_unit,
    significant,
)
from starcal_uq.estimation.merging import ALPHA, Consistency
from starcal_uq.estimation.result import Calibration
from starcal_uq.presentation.sentences.estimate import fallback_sentence
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.effects import effects_table, effects_text

_SHOWN_ROWS = 30


def fallback_words(cal: Calibration) -> str:
    """What the data do not determine of the camera's model, and what the sigmas rest on; empty
    where they do.
    """
    return fallback_sentence(**fallback_facts(cal))


def focal_length(cal: Calibration) -> str:
    """The focal length with its sigma, mm, or px where the pixel pitch is unknown."""
    focal, sigma, unit = cal.camera.focal_px, cal.sigmas[2], "px"
    if cal.camera.pixel_um is not None and cal.camera.focal_mm is not None:
        focal, sigma, unit = cal.camera.focal_mm, sigma * cal.camera.pixel_um * 1e-3, "mm"
    decimals = decimals_for(sigma)
    return f"{fixed(focal, decimals)} ± {fixed(sigma, decimals)} {unit}"


def noise_kind(cal: Calibration) -> str:
    """Which noise of each star a common factor multiplies."""
    return "stated" if cal.fitted_noise is None else "fitted"


def fitted_noise_text(cal: Calibration) -> str:
    """How the noise varies, where that was asked for."""
    return "" if cal.noise_model is None else f" Fitted noise: {cal.noise_model}."


def calibration_text(cal: Calibration) -> str:
    """What was calibrated, how it ended, the focal length, and what was decided on the way: noise,
    model.
    """
    first = (
        f"{plural(cal.n_stars, 'star')} in {plural(cal.n_frames, 'frame')}, {cal.method} "
        f"({cal.solver}): "
        f"{cal.status.name.lower().replace('_', ' ')}; focal length "
        f"{focal_length(cal)}.{fitted_noise_text(cal)}"
    )
    return " ".join(filter(None, (first, *decided(cal))))


def decided(cal: Calibration) -> list[str]:
    """What was decided of model and effects on the way, a sentence or a few each."""
    found = "" if cal.effects is None else effects_text(cal.effects)
    return [words for words in (fallback_words(cal), found, ties_text(cal)) if words]


def ties_text(cal: Calibration) -> str:
    """What known rotations between frames tell of the principal point, and how they agree with the
    stars; empty without any.
    """
    ties = cal.ties
    if ties is None:
        return ""
    what = "A fixed mount" if ties.known.of_mount else plural(len(ties.known), "known rotation")
    before, after = (
        [f"{significant(sigma)} px" for sigma in sigmas[:2]]
        for sigmas in (ties.sigmas_without, cal.sigmas)
    )
    verb = "ties" if ties.known.of_mount or len(ties.known) == 1 else "tie"
    return (
        f"{what} {verb} the attitudes of the frames: sigma of x0 and y0 is {join_words(after)}, "
        f"without {join_words(before)}. Chi-square {fixed(ties.chi2, 1)} for {ties.dof} "
        f"({p_words(ties.p_value)})."
    )


def calibration_tables(cal: Calibration) -> list[TextTable | None]:
    """Its parameters, and the effects that it holds."""
    return [calibration_table(cal), None if cal.effects is None else effects_table(cal.effects)]


def calibration_table(cal: Calibration, truth: Camera | None = None) -> TextTable:
    """Start, estimate and sigma of every parameter; with a truth of the same parameters, also truth
    and z.
    """
    if truth is not None and truth.parameter_names != cal.parameter_names:
        truth = None
    known = () if truth is None else ("truth", "z")
    rows = []
    specs = parameters(cal.camera.distortion)
    for index, (spec, value, sigma) in enumerate(zip(specs, cal.theta, cal.sigmas, strict=True)):
        decimals = decimals_for(sigma / spec.scale)
        cells = [
            fixed(number / spec.scale, decimals)
            for number in (cal.nominal.theta[index], value, sigma)
        ]
        if truth is not None:
            true = truth.theta[index]
            cells += [fixed(true / spec.scale, decimals), fixed((value - true) / sigma, 2)]
        rows.append((spec.name, *cells, pretty_unit(spec.scaled_unit)))
    decimals = decimals_for(cal.sigma_std)
    unit = "px per axis" if cal.sigma_name == "sigma" else f"times the {noise_kind(cal)} noise"
    noise = (fixed(cal.sigma, decimals), fixed(cal.sigma_std, decimals))
    rows.append((cal.sigma_name, "", *noise, *("" for _ in known), unit))
    heads = ("parameter", "start", "estimate", "sigma", *known, "unit")
    title = f"Calibration: {cal.n_stars} stars in {cal.n_frames} frames"
    return TextTable(heads, tuple(rows), title, "l" + "r" * (len(heads) - 2) + "l")


def screening_text(screening: Screening) -> str:
    """What was rejected and why, at which risk, in a few lines."""
    n = len(screening.kept)
    lines = [
        f"{plural(screening.n_rejected, 'star')} of {n} rejected "
        f"({percent(screening.n_rejected / n)}), "
        f"{plural(len(screening.dropped_frames), 'frame')} of {len(screening.frame_ids)} dropped, "
        f"{plural(len(screening.rounds), 'round')}."
    ]
    lines += [
        f"{plural(number, 'star')}: {REASONS[reason]}."
        for reason, number in screening.counts.items()
    ]
    lines.append(
        f"Limits: a star {significant(np.sqrt(screening.star_threshold), 3)} sigma from "
        "the prediction of the "
        f"others (p < {significant(screening.star_p_value)}), a frame at p < "
        f"{significant(screening.frame_p_value)}; "
        f"at most {significant(screening.expected_false)} right stars are expected among the "
        "rejected."
    )
    if screening.sigma_shrinkage > 1e-3:
        lines.append(
            f"The estimated {screening.calibration.sigma_name} is "
            f"{percent(screening.sigma_shrinkage)} too small, "
            "because right stars in the tails were cut off."
        )
    return "\n".join([*lines, *(f"Warning: {text}" for text in screening.warnings)])


def screening_table(screening: Screening) -> TextTable | None:
    """The first rejected rows, each with its reason; None where none is rejected."""
    if not screening.n_rejected:
        return None

    def number(value: float) -> str:
        return "∞" if np.isinf(value) else fixed(value, 3)

    rejected = screening.rejected.head(_SHOWN_ROWS)
    formats = dict.fromkeys(
        ("x_px", "y_px", "residual_px", "offset_deg", "statistic", "threshold"), number
    )
    more = f", the first {len(rejected)}" if len(rejected) < screening.n_rejected else ""
    return TextTable.of(rejected, f"Rejected stars{more}", formats=formats, missing="")


def consistency_text(consistency: Consistency) -> str:
    """Whether the runs show the same camera."""
    verdict = (
        "show the same camera" if consistency.p_value >= ALPHA else "do not show the same camera"
    )
    return (
        f"The runs {verdict} (F = {consistency.statistic:.3g} with {consistency.dof[0]} and "
        f"{consistency.dof[1]:.0f} "
        f"degrees of freedom, p = {consistency.p_value:.2g})."
    )


def consistency_table(consistency: Consistency) -> TextTable:
    """One row per run."""
    return TextTable.of(consistency.to_dataframe(), "Agreement of the runs")
