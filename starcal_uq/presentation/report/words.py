"""Sentences of a report that depend on the run."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.formatting import count, fixed, percent, plural, significant
from starcal_uq.core.status import Code
from starcal_uq.core.types import AnyDict, AnyMapping
from starcal_uq.diagnostics.verdict.draws import propagation_difference
from starcal_uq.diagnostics.verdict.observed import refraction
from starcal_uq.presentation.html import card, listed
from starcal_uq.presentation.words.estimation import calibration_table, noise_kind
from starcal_uq.presentation.words.inference import posterior_table
from starcal_uq.presentation.words.inputs import PITCH_UNKNOWN, detector_words
from starcal_uq.presentation.words.propagation import equivalent_shift, one_number_sentence

if TYPE_CHECKING:
    from starcal_uq.diagnostics.verdict.judge import Verdict
    from starcal_uq.observations.table import Observations
    from starcal_uq.presentation.report.results import Results
    from starcal_uq.propagation.field import FieldMap

_DIRECTIONS = {
    "apparent": "apparent directions (aberration included)",
    "catalogue": "directions straight from a catalogue (aberration not included)",
    "undeclared": "directions not declared as apparent or as straight from a catalogue",
}


def run_text(results: Results) -> str:
    """A run in a few lines: the verdict, what it rests on, the attitude error, and what it
    lacks.
    """
    obs, error = results.observations, results.attitude
    lines = [
        results.verdict.headline,
        f"{plural(obs.n_stars, 'star')} in {plural(obs.n_frames, 'frame')}.",
    ]
    if error is not None:
        lines.append(one_number_sentence(error))
    lines += [
        f"{missing.what}: not there yet (`{missing.remedy.command}`)."
        for missing in results.missing
    ]
    return "\n".join(lines)


def run_html(results: Results) -> str:
    """The same for a notebook, with the table of the parameters and the checks that did not
    pass.
    """
    post, cal = results.posterior, results.calibration
    table = calibration_table(cal, results.truth) if post is None else posterior_table(post)
    doubts = (str(check) for check in results.verdict.doubts)
    return card(f"Run {results.name}", run_text(results), table) + listed(doubts)


def data_sentence(results: Results) -> str:
    """What the result rests on, in one or two sentences."""
    obs, cal = results.observations, results.calibration
    per_frame = obs.stars_per_frame
    low, high = int(per_frame.min()), int(per_frame.max())
    each = (
        f"{low} stars each"
        if low == high
        else f"{low} to {high} stars each, median {np.median(per_frame):g}"
    )
    source = "Simulated data: " if obs.origin.simulated else ""
    stars = f"{plural(obs.n_stars, 'star')} in {plural(obs.n_frames, 'frame')} ({each})"
    if cal.partitions is not None:
        files = plural(len(cal.partitions.n_stars), "file")
        stars = (
            f"{plural(cal.n_stars, 'star')} in {plural(cal.n_frames, 'frame')} of {files}, of "
            "which a sample of "
            f"{plural(obs.n_frames, 'frame')} ({each}) is shown and questioned star by star"
        )
    unique = ""
    if obs.star_id is not None and len(np.unique(obs.star_id)) < obs.n_stars:
        unique = f", {count(len(np.unique(obs.star_id)))} different stars"
    camera = cal.camera
    horizontal, vertical = camera.fov_deg
    pitch = f" {PITCH_UNKNOWN}" if camera.pixel_um is None else ""
    return (
        f"{source}{stars}{unique}, with {_directions(obs)}. Camera: {detector_words(camera)}, "
        f"{fixed(horizontal, 1)}° × {fixed(vertical, 1)}° field, distortion model "
        f"“{camera.distortion}”. Centroid noise was {_noise_words(results)}.{pitch}"
        f"{_air_words(results)}"
    )


def _directions(obs: Observations) -> str:
    declared = obs.origin.directions
    if declared == "apparent" and obs.origin.air == "corrected":
        return "apparent directions (aberration and refraction included)"
    if declared == "apparent" and obs.origin.air == "unknown":
        return "directions that include aberration but no refraction"
    return _DIRECTIONS[declared]


def _air_words(results: Results) -> str:
    """What refraction does to f, where the stars were or may have been seen through air."""
    obs, cal = results.observations, results.calibration
    found = refraction(obs, cal)
    return "" if found is None else f" {found.sentence}"


def _noise_words(results: Results) -> str:
    cal, post = results.calibration, results.posterior
    if cal.fitted_noise is not None:
        return (
            f"fitted: {cal.fitted_noise}; the data ask for {significant(cal.sigma, 3)} times that"
        )
    if cal.sigma_name == "sigma_scale":
        floor = results.observations.origin.noise_floor_px
        more = (
            (
                f", with {significant(floor)} px per axis added that even bright stars show "
                "in their residuals"
            )
            if floor
            else ""
        )
        return f"stated star by star{more}; the data ask for {significant(cal.sigma, 3)} times that"
    if post is not None and not post.sigma_sampled:
        return f"given as {significant(post.sigma_draws[0], 3)} px per axis"
    return f"estimated from the data: {significant(cal.sigma, 3)} px per axis"


def sigma_sentence(results: Results) -> str:
    """How the noise was treated."""
    post = results.posterior
    kind = "px per axis, the same for all stars"
    if results.calibration.sigma_name == "sigma_scale":
        kind = f"a common factor on the {noise_kind(results.calibration)} noise of each star"
    if post is None:
        return f"The noise σ ({kind}) is estimated from the residuals and their degrees of freedom."
    if post.sigma_sampled:
        return (
            f"The noise σ ({kind}) is a parameter: it is sampled with the others, on its logarithm."
        )
    return (
        f"The noise σ ({kind}) was given as {significant(post.sigma_draws[0], 4)} and not sampled."
    )


def likelihood_sentence(results: Results) -> str:
    """Which likelihood was sampled, where it is not the one whose formula the report shows."""
    post = results.posterior
    kind = "marginal" if post is None else post.diagnostics.likelihood
    known = {
        "marginal": "",
        "student_t": (
            "The posterior of this run is that of the robust variant: each star’s residual "
            "follows a bivariate Student "
            "t instead of a Gaussian, with the attitude of the frame integrated out in the same "
            "way."
        ),
        "pairs": (
            "The posterior of this run is that of the angles between stars, a composite "
            "likelihood whose curvature is "
            "adjusted to its Godambe information."
        ),
        "pairs_naive": (
            "The posterior of this run takes the angles between stars as independent, which they "
            "are not: its "
            "intervals are several times too narrow."
        ),
    }
    return known.get(
        kind, f"The posterior of this run is that of the likelihood “{kind}” that was passed."
    )


def attitude_sentence(results: Results) -> str:
    """What the numbers of the attitude table rest on."""
    error = results.attitude
    if error is None:
        return ""
    return (
        f"{plural(error.n_draws, 'posterior draw')} through QUEST on {error.told_frames}; "
        f"first-order propagation gives the same σ within {percent(propagation_difference(error))}."
    )


# What the uncertainties assume, and the checks that look for the opposite.
_ASSUMPTIONS = (
    (
        "Centroid errors are Gaussian, with the noise that is stated.",
        (Code.OUTLIERS, Code.POSTERIOR_PREDICTIVE_CHECK),
    ),
    (
        "The noise is the same over field, magnitude and time, or stated star by star.",
        (Code.EVENNESS_OF_THE_NOISE,),
    ),
    (
        "Stars of one frame share no error but the attitude (motion, refraction, temperature).",
        (Code.JACKKNIFE_OVER_FRAMES, Code.UNEXPLAINED_STRUCTURE),
    ),
    (
        "A star brings no error along (catalogue position and motion, blend, colour).",
        (Code.ERRORS_OF_THE_STARS,),
    ),
    (
        "Directions are those that the camera saw: aberration, and refraction in air.",
        (Code.CATALOGUE_DIRECTIONS,),
    ),
    (
        "The lens follows the distortion model, the same in all frames.",
        (Code.PATTERN_IN_THE_RESIDUALS, Code.UNEXPLAINED_STRUCTURE, Code.DISTORTION_MODEL),
    ),
    ("Every star is the one that it is said to be.", (Code.OUTLIERS, Code.TWO_ESTIMATORS)),
)


def assumption_rows(verdict: Verdict) -> list[AnyDict]:
    """What is assumed, with the outcome of the checks that were made for it."""
    made = {check.code: check for check in verdict.checks}
    return [
        {"assumed": words, "checks": [made[code] for code in codes if code in made]}
        for words, codes in _ASSUMPTIONS
    ]


def prior_rows(results: Results) -> list[dict[str, str]]:
    """The priors as statements."""
    if results.posterior is None:
        return []
    table = results.posterior.priors.to_dataframe()
    return [
        {"name": str(row.parameter), "statement": str(row.statement)} for row in table.itertuples()
    ]


def sampling_sentence(results: Results) -> str:
    """How many draws, by which moves, from which likelihood."""
    post = results.posterior
    if post is None:
        return ""
    settings = post.provenance.settings
    d = post.diagnostics
    moves = f", moves “{settings['moves']}”" if "moves" in settings else ""
    rates = f"{fixed(d.acceptance.min(), 2)} to {fixed(d.acceptance.max(), 2)}"
    return (
        f"emcee: {post.n_ensembles} separately seeded ensembles of {post.n_walkers} walkers, "
        f"{post.n_steps} kept steps "
        f"each{moves}; {count(d.n_evaluations)} evaluations of the {d.likelihood_used} "
        f"likelihood; acceptance {rates}."
    )


# What makes sums over all stars, by the name that a provenance has for it.
_PATHS = {"numpy": "NumPy", "numba": "compiled loops (Numba)"}


def provenance_rows(results: Results) -> list[tuple[str, str]]:
    """What is needed to repeat the run."""
    rows: list[tuple[str, str]] = [
        ("Data, SHA-256", results.calibration.data_hash_of(results.observations))
    ]
    source = results.observations.origin.source
    if source:
        rows.append(("Source of the data", str(source)))
    if results.camera_changed:
        rows.append(("Nominal camera", results.camera_changed))
    steps = [("Calibration", results.calibration.provenance)]
    if results.posterior is not None:
        steps.append(("Sampling", results.posterior.provenance))
    if results.diagnosis is not None:
        steps.append(("Diagnosis", results.diagnosis.provenance))
    for name, step in steps:
        rows.append((f"{name}, time", step.created_utc or "unknown"))
        if step.seed is not None:
            rows.append((f"{name}, seed", str(step.seed)))
        rows.append((f"{name}, settings", _settings_text(step.settings)))
    path = results.calibration.provenance.kernels
    if path:
        rows.append(("Sums over stars", _PATHS[path]))
    rows.append(("Versions", steps[-1][1].software()))
    return rows


def _settings_text(settings: AnyMapping) -> str:
    return ", ".join(f"{name} = {_plain(value)}" for name, value in settings.items()) or "none"


def _plain(value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, float):
        return f"{value:g}"
    return json.dumps(value, default=str)


def equivalent_sentence(field: FieldMap | None) -> str:
    """The common rotation as an error of the principal point; empty without a map, or for one that
    does not hold it.
    """
    shift = None if field is None else equivalent_shift(field)
    if shift is None:
        return ""
    x, y = shift
    return (
        "Equivalent principal point: the rotation that is removed on the right is what an error "
        "of the principal point "
        f"of {x} along x and {y} along y (1 sigma) would do by itself."
    )
