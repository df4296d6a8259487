"""The first page of a report and the last lines in a terminal: what may be used, its numbers, a
paragraph to paste.
"""

from __future__ import annotations

import shlex
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.budgeting.result import by_contributor
from starcal_uq.budgeting.rows import AXIS_LABELS, confidence_text
from starcal_uq.core.constants import CROSS_BORESIGHT
from starcal_uq.core.formatting import count, fixed, join_words, plural, significant
from starcal_uq.core.status import Check, Level, Note, Question, worst
from starcal_uq.presentation.report.tables import parameter_rows
from starcal_uq.presentation.sentences.budgeting import axis_label, bound
from starcal_uq.presentation.sentences.propagation import two_figures
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.inputs import detector_words
from starcal_uq.propagation.attitude_error import (
    IF_MODEL_HOLDS,
    NOT_ASSESSED,
    WITH_MISFIT_FOUND,
)

if TYPE_CHECKING:
    from starcal_uq.budgeting.result import Budget
    from starcal_uq.diagnostics.verdict.judge import Verdict
    from starcal_uq.presentation.report.results import Results
    from starcal_uq.propagation.attitude_error import AttitudeError

COLUMNS = 80
# What is nearer to the corner than this is no extrapolation worth the name.
_SEEN = 0.97
AFTER = "after alignment"
# Rows of an attitude error, in the order of what a mission asks for.
_PARTS = ((1, "Common rotation"), (2, "Frame-dependent rest"), (0, "Centroid noise"))
_PARTS_SAID = (
    "Common: one constant, which alignment calibration takes away. Frame-dependent: nothing "
    "takes it away. Noise: new "
    "in every frame."
)


def uses(results: Results) -> tuple[list[str], list[str]]:
    """What of the run can be used, and what cannot or only with care; sentences."""
    verdict, error, budget = results.verdict, results.attitude, results.budget
    usable, unusable = [], []
    violated, doubts = (join_words(verdict.summary.values[one]) for one in ("violated", "doubts"))
    failed = verdict.summary.code is Note.NOT_USABLE
    if violated:
        unusable.append(f"The sensor with this budget: {violated} is violated.")
    if failed:
        unusable.append(f"Parameters, intervals and attitude error: {doubts} failed.")
        if worst(verdict.of(Question.CONVERGED)) is Level.FAIL:
            usable.append("What tells the cause: residuals and checks.")
        else:
            usable.append(
                f"The errors {IF_MODEL_HOLDS}, as the least that they are; residuals and checks, "
                "as clues."
            )
    elif doubts:
        usable.append(
            "The parameters, their intervals and the attitude error, if you accept the "
            f"warnings: {doubts}."
        )
    else:
        usable.append("The parameters, their σ and intervals: every check passed.")
    if error is not None:
        common, rest = (
            two_figures(
                error.with_misfit_found_arcsec[row, 3],
                error.if_model_holds_arcsec[row, 3],
            )
            for row in (1, 2)
        )
        if not failed:
            usable.append(
                f"Attitudes {AFTER}: the calibration adds {rest} per axis across the boresight."
            )
        unusable.append(
            f"Attitudes before alignment calibration: all are off by one common rotation, {common}."
        )
    elif results.posterior is None:
        unusable.append("Attitude errors and couplings with priors: the posterior was not sampled.")
    if (
        curve := results.distortion_curve
    ) is not None and curve.star_radius_px < _SEEN * curve.radius_px[-1]:
        unusable.append(
            f"Directions farther than {curve.star_radius_px:.0f} px from the principal point: no "
            "star was there."
        )
    if budget is not None and budget.not_assessed:
        every = len(by_contributor(budget.rows))
        unusable.append(
            f"The budget as a total: {len(budget.not_assessed)} of "
            f"{plural(every, 'contributor')} are {NOT_ASSESSED}, "
            "so it is a lower bound."
        )
    return usable, unusable


def attitude_summary(error: AttitudeError) -> TextTable:
    """The parts of the attitude error by both their figures, across the boresight and in roll."""
    tested = error.misfit is not None
    kinds = ([WITH_MISFIT_FOUND] if tested else []) + [IF_MODEL_HOLDS]
    values = {
        WITH_MISFIT_FOUND: error.with_misfit_found_arcsec,
        IF_MODEL_HOLDS: error.if_model_holds_arcsec,
    }
    rows = tuple(
        (name, *(significant(values[kind][row, axis]) for axis in (3, 2) for kind in kinds))
        for row, name in _PARTS
    )
    heads = tuple(f"{where}, {kind}" for where in ("Across", "Roll") for kind in kinds)
    said = (
        "" if tested else f" {WITH_MISFIT_FOUND[0].upper()}{WITH_MISFIT_FOUND[1:]}: {NOT_ASSESSED}."
    )
    if tested and all(
        found == held
        for _, *cells in rows
        for found, held in zip(cells[::2], cells[1::2], strict=True)
    ):
        heads, rows = (
            ("Across the boresight", "Roll"),
            tuple((name, across, roll) for name, across, _, roll, _ in rows),
        )
    title = f"arcsec, 1 sigma; across the boresight per axis. {_PARTS_SAID}{said}"
    return TextTable(("Contribution", *heads), rows, title)


def budget_summary(budget: Budget) -> TextTable:
    """Each requirement against what is reached; without any, the totals after alignment."""
    if budget.outcomes:
        asked = tuple(
            (
                o.requirement.name,
                (
                    f"{axis_label(o.requirement)}, {o.requirement.scope}, "
                    f"{confidence_text(o.requirement.confidence)}"
                ),
                significant(o.requirement.limit_arcsec, 3),
                bound(o.bound_arcsec, o.total.at_least),
                o.verdict,
            )
            for o in budget.outcomes
        )
        marks = tuple(o.level.value for o in budget.outcomes)
        return TextTable(
            ("Requirement", "Of", "Limit [arcsec]", "Reached [arcsec]", "Outcome"),
            asked,
            "",
            "llrrl",
            marks,
        )
    totals = [budget.total(axis, AFTER) for axis in (CROSS_BORESIGHT, "roll")]
    rows = tuple(
        (
            f"{AXIS_LABELS[t.axis]}, {AFTER}",
            *(bound(v, t.at_least) for v in (t.rule_arcsec, t.sampled_arcsec)),
        )
        for t in totals
    )
    heads = (
        f"Total at {confidence_text(budget.confidence)}",
        "By the rule [arcsec]",
        "By sampling [arcsec]",
    )
    return TextTable(heads, rows, "No requirement was given.")


def glance_caption(results: Results) -> str:
    """What the three panels of the first figure show."""
    error = results.attitude
    which = (
        f"{IF_MODEL_HOLDS}"
        if error is None or error.misfit is None
        else f"{WITH_MISFIT_FOUND}, lines {IF_MODEL_HOLDS}"
    )
    return (
        f"Left: the attitude error by contribution and axis, 1 sigma, {which}. Middle: mean "
        "residuals over the "
        "detector; arrows that are no longer than the key are noise. Right: what the calibration "
        "leaves uncertain in a "
        "direction, 1 sigma per axis, after the best constant rotation is removed, "
        f"{IF_MODEL_HOLDS}; dots are stars."
    )


def methods_paragraph(results: Results) -> str:
    """The method of this run in words for a paper, with its settings, versions and citations."""
    cal, post, error, obs = (
        results.calibration,
        results.posterior,
        results.attitude,
        results.observations,
    )
    camera, record = cal.camera, cal.provenance if post is None else post.provenance
    kind = "simulated " if obs.origin.simulated else ""
    noise = "fitted with the camera" if cal.fitted_noise is not None else "a free parameter"
    parts = [
        f"The camera ({detector_words(camera)}, distortion model "
        f"“{camera.distortion}”) was calibrated with starcal_uq "
        f"{record.version} on "
        f"{plural(cal.n_stars, f'{kind}identified star')} in {plural(cal.n_frames, 'frame')}. "
        "Start values came from "
        "the angles between stars in three stages (Ye & Yang 2017); the estimate maximises the "
        "likelihood of the pixel "
        "positions with the attitude of every frame integrated out, the centroid noise being "
        f"{noise}."
    ]
    if post is not None:
        d = post.diagnostics
        fewest = int(
            min(np.min(d.ess_bulk[list(post.sampled)]), np.min(d.ess_tail[list(post.sampled)]))
        )
        seed = f", seed {record.seed}" if record.seed is not None else ""
        parts.append(
            f"The posterior was sampled with emcee {record.versions.get('emcee') or ''} (Foreman-Mackey "
            "et al. 2013): "
            f"{post.n_ensembles} separate ensembles of {post.n_walkers} walkers, {post.n_steps} "
            "kept steps"
            f"{seed}, likelihood “{record.settings.get('likelihood', d.likelihood)}”; R-hat is at most "
            f"{fixed(np.max(d.rhat[list(post.sampled)]), 4)} and the effective sample "
            "size at least "
            f"{count(fewest)} (Vehtari et al. 2021), and Pareto-smoothed importance sampling "
            "(Vehtari et al. 2024) "
            f"differs from it by {fixed(d.agreement_mean, 2)} standard deviations in the means."
        )
    if error is not None:
        misfit = (
            f"; what tests of the model found is added ({WITH_MISFIT_FOUND})"
            if error.misfit is not None
            else ""
        )
        parts.append(
            f"Attitude errors are {plural(error.n_draws, 'posterior draw')} through QUEST "
            "(Shuster & Oh 1981) on "
            f"{error.told_frames}, split into a rotation common to all frames and a rest that "
            "depends on the frame"
            f"{misfit}."
        )
    if results.diagnosis is not None:
        parts.append(
            f"The model was questioned by {plural(len(results.diagnosis.misfit.tests), 'test')} "
            "for misfit, a "
            "jackknife over frames and posterior predictive checks."
        )
    passed, every = len(results.verdict.at(Level.PASS)), len(results.verdict.checks)
    parts.append(f"Of {plural(every, 'check')}, {passed} passed. {_not_passed(results)}".strip())
    software = record.software("starcal_uq", "emcee")
    parts.append(f"Software: {software}. Data: SHA-256 {cal.data_hash_of(obs)[:16]}.")
    return " ".join(filter(None, " ".join(parts).split(" ")))


def _not_passed(results: Results) -> str:
    said = []
    for level, verb in ((Level.WARN, "gave a warning"), (Level.FAIL, "failed")):
        if found := results.verdict.at(level):
            said.append(f"{join_words([check.phrase for check in found])} {verb}")
    words = "; ".join(said)
    return f"{words[0].upper()}{words[1:]}." if said else ""


CITATIONS = (
    (
        "starcal_uq: probabilistic calibration of star trackers, version {version}. The starcal_uq "
        "developers."
    ),
    (
        "Ye, T. & Yang, F. (2017): Optics and Precision Engineering 25(9), 2483–2489. "
        "doi:10.3788/OPE.20172509.2483"
    ),
    "Foreman-Mackey, D. et al. (2013): emcee: The MCMC Hammer. PASP 125, 306–312.",
    (
        "Shuster, M. D. & Oh, S. D. (1981): Three-axis attitude determination from vector "
        "observations. JGC 4(1), 70–77."
    ),
    (
        "Vehtari, A. et al. (2021): Rank-normalization, folding, and localization: an improved "
        "R-hat. Bayesian Anal. 16."
    ),
    "Vehtari, A. et al. (2024): Pareto smoothed importance sampling. JMLR 25(72).",
)


def terminal_summary(results: Results) -> list[str]:
    """The run in lines of at most 80 columns, without the verdict; commands can be copied."""
    cal, post = results.calibration, results.posterior
    lines = _wrapped(
        f"{results.name}: {plural(cal.n_stars, 'star')} in {plural(cal.n_frames, 'frame')}, "
        "distortion model "
        f"{cal.camera.distortion!r}, {'posterior' if post is not None else 'estimate'} ± 1 sigma"
    )
    for row in parameter_rows(results):
        value = (
            f"{row['estimate']} ± {row['sigma']}"
            if row["sigma"] != "given"
            else f"{row['estimate']} (given)"
        )
        lines.append(f"  {row['name']:<12} {value:>22} {row['unit']}".rstrip())
    if (error := results.attitude) is not None:
        lines.append(
            "Attitude error, arcsec, 1 sigma" + f"{'across the boresight':>26}{'roll':>19}"
        )
        for part, name in _PARTS:
            cells = [_both(error, part, axis) for axis in (3, 2)]
            lines.append(f"  {name.lower():<30}{cells[0]:>25}{cells[1]:>19}".rstrip())
        untested = f"{IF_MODEL_HOLDS}; {WITH_MISFIT_FOUND}: {NOT_ASSESSED}"
        differ = f"{WITH_MISFIT_FOUND}; in brackets {IF_MODEL_HOLDS}, where that differs"
        lines.append(f"  {untested if error.misfit is None else differ}")
    if (budget := results.budget) is not None:
        table = budget_summary(budget)
        lines.append(
            "Budget"
            if budget.outcomes
            else f"Budget at {confidence_text(budget.confidence)}, arcsec"
        )
        for name, *told in table.rows:
            said = (
                "{} ({}): limit {} arcsec, reached {}, {}"
                if budget.outcomes
                else "{}: {} by the rule, {} by sampling"
            )
            lines += _wrapped(said.format(name, *told), "  ")
        if budget.not_assessed:
            every = len(by_contributor(budget.rows))
            lines.append(
                f"  {len(budget.not_assessed)} of {every} contributors are {NOT_ASSESSED}: lower "
                "bounds"
            )
    counts = [
        f"{len(results.verdict.at(level))} {words}"
        for level, words in _COUNTED
        if results.verdict.at(level)
    ]
    lines.append(f"Checks: {', '.join(counts)} of {len(results.verdict.checks)}")
    for check in results.verdict.of(Question.REQUIRED):
        lines += _told([check]) if check.level is not Level.PASS else []
    before = ""
    for cause, checks in results.verdict.causes.items():
        lines += _told(checks, cause, before)
        before = before or (cause if checks[0].level is Level.FAIL else "")
    if results.verdict.ended:
        usable, unusable = uses(results)
        lines += [line for sentence in usable for line in _wrapped(f"usable: {sentence}", "  ")]
        lines += [line for sentence in unusable for line in _wrapped(f"not: {sentence}", "  ")]
    for number, command in enumerate(results.verdict.commands):
        lines += ["To try, in this order:"] if number == 0 else []
        lines += _command(command)
    return lines


def verdict_lines(verdict: Verdict) -> list[str]:
    """The verdict in at most 80 columns."""
    return _wrapped(f"Verdict ({verdict.level.value}): {verdict.headline}")


_COUNTED = ((Level.PASS, "passed"), (Level.WARN, "gave a warning"), (Level.FAIL, "failed"))


def _both(error: AttitudeError, row: int, axis: int) -> str:
    held = significant(error.if_model_holds_arcsec[row, axis])
    found = held if error.misfit is None else significant(error.with_misfit_found_arcsec[row, axis])
    return held if found == held else f"{found} ({held})"


def _told(checks: Sequence[Check], cause: str = "", before: str = "") -> list[str]:
    """The checks that one cause explains: the first in full, the others by name; and what may be
    behind the cause.
    """
    first, *others = checks
    lines = _wrapped(f"{first.level.value}: {first.name}. {first.sentence}", "  ")
    lines += _wrapped(first.advice, "    ") if first.advice else []
    if others:
        named = join_words(
            [f"{check.phrase} ({check.level.value}, {check.value})" for check in others]
        )
        lines += _wrapped(f"The same, {cause}, shows in: {named}.", "    ")
    return lines + (_wrapped(f"It may follow from {before}, above.", "    ") if before else [])


def _command(text: str) -> list[str]:
    """A command over lines that a shell puts together again."""
    lines = ["    try:"]
    for word in shlex.split(text):
        written = word if word == "&&" else shlex.quote(word)
        # Room for the backslash.
        if len(lines[-1]) + len(written) + 3 > COLUMNS and lines[-1].strip():
            lines.append("     ")
        lines[-1] += f" {written}"
    return [f"{line} \\" for line in lines[:-1]] + lines[-1:]


def _wrapped(text: str, indent: str = "") -> list[str]:
    return textwrap.wrap(
        text,
        COLUMNS,
        initial_indent=indent,
        subsequent_indent=indent + "  ",
        break_on_hyphens=False,
    )
