"""Fill the template."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from starcal_uq.camera.distortion import get_model, parameters
from starcal_uq.core.formatting import count, join_words
from starcal_uq.core.remedy import RUN, Remedy
from starcal_uq.core.status import Check, Code, Level, Question, worst
from starcal_uq.core.types import AnyDict
from starcal_uq.diagnostics.verdict.limits import limits
from starcal_uq.presentation.html import template_environment
from starcal_uq.presentation.pages import budgeting as budget_tables
from starcal_uq.presentation.report import diagnostics as model_tables
from starcal_uq.presentation.report import summary, tables, words
from starcal_uq.presentation.report.results import Results
from starcal_uq.presentation.words.propagation import (
    alignment_sentence,
    corner_sentence,
    coupling_table,
    misfit_sentence,
    onboard_sentence,
    onboard_table,
    one_number_sentence,
    thermal_table,
    thermal_text,
)

_MARKS = {Level.PASS: "✓", Level.WARN: "!", Level.FAIL: "✗"}


def render(results: Results, figures: Mapping[str, bytes], gallery: str = "") -> str:
    """The report as one HTML document.

    Parameters
    ----------
    results
        What to report.
    figures
        SVG images by the names of `starcal_uq.presentation.report.drawing.draw_figures`; a missing
        one is left out.
    gallery
        The frames of a run from images, as a piece of a page.
    """
    return prepared(results)(figures, gallery)


def prepared(results: Results) -> Callable[[Mapping[str, bytes], str], str]:
    """The report as a function of figures and gallery, for whoever waits for these: everything else
    is done.
    """
    template, known = template_environment().get_template("report.html.j2"), context(results)

    def document(figures: Mapping[str, bytes], gallery: str) -> str:
        return template.render(known, images=figures, gallery=gallery) + "\n"

    return document


def context(results: Results) -> AnyDict:
    """What the template shows beside the figures."""
    cal, post, obs = results.calibration, results.posterior, results.observations
    verdict = results.verdict
    converged = verdict.of(Question.CONVERGED)
    trust = verdict.of(Question.TRUSTWORTHY)
    usable, unusable = summary.uses(results)
    provenance = (post or cal).provenance
    thermal = None if results.attitude is None else results.attitude.thermal
    return {
        "title": (results.truth or cal.nominal).name or results.name,
        "run_name": results.name,
        "created": provenance.created_utc,
        "version": provenance.version,
        "usable": usable,
        "unusable": unusable,
        "attitude_summary": None
        if results.attitude is None
        else summary.attitude_summary(results.attitude),
        "budget_summary": None
        if results.budget is None
        else summary.budget_summary(results.budget),
        "glance_caption": summary.glance_caption(results),
        "methods_paragraph": summary.methods_paragraph(results),
        "citations": [line.format(version=provenance.version) for line in summary.CITATIONS],
        "diagnose": results.command(Remedy("diagnose", (RUN,))),
        "report_command": Remedy("report").command,
        "template_command": _template_command(results),
        "verdict": verdict,
        "marks": _MARKS,
        "Level": Level,
        "converged_level": worst(converged),
        "trust_level": worst(trust),
        "required_level": worst(verdict.of(Question.REQUIRED)),
        "converged_words": _answer(converged),
        "trust_words": _answer(trust),
        "limits": [
            one.sentence
            for one in limits(obs, cal, results.coupling, results.attitude, results.diagnosis)
        ],
        "data_sentence": words.data_sentence(results),
        "results": results,
        "names": [p.name for p in tables.all_parameters(results)],
        "parameter_rows": tables.parameter_rows(results),
        "attitude_rows": [] if results.attitude is None else tables.attitude_rows(results.attitude),
        "alignment_sentence": ""
        if results.attitude is None
        else alignment_sentence(results.attitude),
        "onboard_table": None
        if results.attitude is None or not results.attitude.variants
        else onboard_table(results.attitude),
        "thermal_table": None if thermal is None else thermal_table(thermal),
        "thermal_sentence": "" if thermal is None else thermal_text(thermal),
        "onboard_sentence": "" if results.attitude is None else onboard_sentence(results.attitude),
        "one_number_sentence": ""
        if results.attitude is None
        else one_number_sentence(results.attitude),
        "misfit_attitude_sentence": ""
        if results.attitude is None
        else misfit_sentence(results.attitude, results.place),
        "attitude_sentence": words.attitude_sentence(results),
        "corner_sentence": ""
        if results.distortion_curve is None
        else corner_sentence(results.distortion_curve),
        "equivalent_sentence": words.equivalent_sentence(results.field_map),
        "coupling_table": None
        if results.coupling is None
        else coupling_table(results.coupling, parameters(cal.camera.distortion)),
        "weak_directions": []
        if results.coupling is None
        else tables.weak_directions(results.coupling),
        "diagnostics_table": None if post is None else tables.diagnostics_table(post),
        "agreement": next(
            (check.value for check in verdict.checks if check.code is Code.INDEPENDENT_POSTERIOR),
            "",
        ),
        "methods_table": tables.methods_table(results),
        "derived_table": None if post is None else model_tables.derived_table(post),
        **model_tables.effects_context(cal),
        **model_tables.diagnosis_context(results.diagnosis, cal),
        **tables.image_context(results.images, cal),
        **budget_tables.budget_context(results.budget),
        "stage_table": tables.stage_table(results),
        "pair_table": tables.pair_table(cal),
        "noise_table": tables.noise_table(cal),
        "noise_model": cal.noise_model,
        "assumption_rows": words.assumption_rows(verdict),
        "prior_rows": words.prior_rows(results),
        "likelihood_sentence": words.likelihood_sentence(results),
        "sigma_sentence": words.sigma_sentence(results),
        "sampling_sentence": words.sampling_sentence(results),
        **_distortion(results),
        "degrees_of_freedom": count(cal.dof),
        "provenance_rows": words.provenance_rows(results),
    }


def _template_command(results: Results) -> str:
    """The command that writes a file for what of the budget is not assessed."""
    if results.budget is None or not results.budget.not_assessed:
        return ""
    return results.command(Remedy("budget", (RUN,), {"template": "budget.toml"}))


def _distortion(results: Results) -> AnyDict:
    """The formula of the distortion model, from its registry entry."""
    model = get_model(results.calibration.camera.distortion)
    radial = [(c.name, c.order - 1) for c in model.lens if c.name.startswith("k")]
    forward = model.direction == "forward"
    return {
        "distortion_source": model.source,
        "radial_terms": radial,
        "decentring": [c.name for c in model.lens if not c.name.startswith("k")],
        "axes": model.axes,
        "plane": model.plane.name,
        "from_point": "ideal" if forward else "distorted",
        "to_point": "distorted" if forward else "ideal",
    }


def _answer(checks: tuple[Check, ...]) -> str:
    """The outcome of some checks in one line; what failed is explained elsewhere."""
    if worst(checks) is Level.PASS:
        every = "Both" if len(checks) == 2 else f"All {len(checks)}"
        return f"{every} checks passed."
    parts = []
    for level, verb in (
        (Level.FAIL, "failed"),
        (Level.WARN, "raised a warning"),
        (Level.PASS, "passed"),
    ):
        found = tuple(check for check in checks if check.level is level)
        if found:
            names = (
                "" if level is Level.PASS else f": {join_words([check.phrase for check in found])}"
            )
            parts.append(f"{len(found)} of {len(checks)} {verb}{names}.")
    return " ".join(parts)
