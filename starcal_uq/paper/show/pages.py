"""The reports on the paper's experiments as one HTML file each: a headline, tables and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from starcal_uq.core.display import Shown
from starcal_uq.core.formatting import count, fixed, percent, plural, significant
from starcal_uq.core.provenance import Provenance
from starcal_uq.paper.field.published import MORE_THAN_STARS, N_CHOSEN, N_TAKEN, TRUE_CAMERA
from starcal_uq.paper.published import N_FRAMES
from starcal_uq.paper.show import field, tables
from starcal_uq.presentation.figures.style import DPI, png_bytes
from starcal_uq.presentation.html import template_environment
from starcal_uq.presentation.tables import TextTable

if TYPE_CHECKING:
    from starcal_uq.paper.field.result import FieldExperiment
    from starcal_uq.paper.result import Reproduction

_ABOUT = (
    "“Autonomous calibration of star sensors based on nonlinear optimization algorithm”, Optics "
    "and Precision "
    "Engineering 25(9), 2483–2489."
)
# The maps are smooth: fewer pixels show as much of them.
_DPI = {"error_fields": 130}


class Section(NamedTuple):
    """A part of a page: text, a figure by its name, and tables."""

    title: str
    tables: Sequence[TextTable] = ()
    text: str = ""
    figure: str = ""
    caption: str = ""


def reproduction_figures(found: Reproduction) -> dict[str, bytes]:
    """Every figure as PNG, by name."""
    drawn = _drawn(found, "printed_numbers", "trajectories", "error_fields")
    drawn["replicates"] = png_bytes(found.replicates.plot.spread(), DPI)
    if found.study is not None:
        drawn["interaction"] = png_bytes(found.study.plot.bias(), DPI)
    return drawn


def field_figures(found: FieldExperiment) -> dict[str, bytes]:
    """Every figure as PNG, by name."""
    return {f"field_{name}": png for name, png in _drawn(found, "rates", "errors").items()}


def _drawn(found: Shown, *names: str) -> dict[str, bytes]:
    return {name: png_bytes(getattr(found.plot, name)(), _DPI.get(name, DPI)) for name in names}


def reproduction_page(found: Reproduction, figures: Mapping[str, bytes]) -> str:
    """The report; `figures` are PNG images by the names of `reproduction_figures`, a missing one is
    left out.
    """
    obs = found.run.observations
    n, settings = obs.n_frames, found.provenance.settings
    tried = [len(one.trials) for one in found.judged]
    warning = (
        f"This reproduction has {plural(n, 'frame')} where the paper has {count(N_FRAMES)}: our "
        "draws spread "
        f"{fixed(np.sqrt(N_FRAMES / n), 1)} times as far, and z-values are that much "
        "smaller."
    )
    sections = [
        Section(
            "Table 2, every method",
            (tables.table_2(found), tables.row_tests(found), tables.methods(found)),
        ),
        Section(
            "Every printed number",
            (tables.printed_numbers(found.judged),),
            "A printed number is one draw: z is its distance from our mean in standard "
            "deviations of a new draw, and "
            "up to 3 it agrees. A digit is noise when 95 % of our draws cover all its values. "
            "“Fits anything” is the "
            f"share of numbers as far off that some reading would accept; {min(tried)} to "
            f"{max(tried)} readings were "
            "tried, all in trials.csv.",
            "printed_numbers",
            "Distances from our mean, under the main reading (blue) and the closest of all (open).",
        ),
        Section(
            "One reading for all three methods?",
            [
                tables.error_readings(found, quantity)
                for quantity in ("reprojection_px", "max_residual_px")
            ],
        ),
        Section("The paper against itself", (tables.checks(found),)),
        Section("Errors, without and with noise", (tables.errors(found),)),
        Section(
            "Fig. 3: the optics on their way",
            figure="trajectories",
            caption="Distances from the truth, logarithmic far from it; marks at the edge are what "
            "the paper prints. "
            "Rings are least squares, which the first stage of the proposed method repeats.",
        ),
        Section(
            "Figs. 4 to 6: the error over the field",
            figure="error_fields",
            caption="Errors without noise: eq. 16 above, directions after the best rotation below. "
            "Arrows grow with "
            "the root of the size, panel by panel.",
        ),
        Section(
            "Over seeds: what each method does, and what it claims",
            (tables.replicates(found.replicates),),
            tables.replicates_text(found.replicates),
            "replicates",
        ),
    ]
    if found.study is not None:
        words = tables.study_text(found.study)
        caption = (
            "Solid: bias, from data without noise. Dashed: spread. Dotted, where drawn: what "
            "noise alone does."
        )
        shown = (tables.thresholds(found.study),)
        sections.append(Section("Optics against distortion", shown, words, "interaction", caption))
    about = f"{_ABOUT} Distortion by {settings['convention'].replace('eq', 'eq. ')}."
    title, headline = "Ye & Yang 2017, reproduced", tables.headline(found)
    warning = "" if n == N_FRAMES else warning
    return _page(title, about, headline, sections, found.provenance, figures, warning)


def field_page(found: FieldExperiment, figures: Mapping[str, bytes]) -> str:
    """The report; `figures` are PNG images by the names of `field_figures`."""
    counts = found.campaign_counts
    noise = significant(found.stars[TRUE_CAMERA].noise_scale, 3)
    sections = [
        Section("Table 3", (field.table_3(found),)),
        Section(
            "Noise, common rotation, rest",
            (field.parts(found), field.sources(found)),
            "Noise is what changes when centroids are put where the stars truly are. The mean of "
            "what is left is the "
            "common rotation, which a calibration of the alignment takes out; the rest differs "
            "from frame to frame.",
            "field_errors",
            "Errors about each axis with ranges of 95 % of repetitions.",
        ),
        Section(
            "Identification against tolerance",
            (field.rates(found),),
            figure="field_rates",
            caption="Frames identified without a wrong star, with 95 % Wilson intervals.",
        ),
        Section("Other data sheets", (field.data_sheets(found),)),
        Section(
            "The cameras",
            (field.cameras(found),),
            f"{counts['identified']} of {plural(counts['frames'], 'frame')} of the calibration "
            "are identified from the "
            f"data sheet, with {plural(counts['stars'], 'star')}, {counts['wrong']} of them "
            f"wrong, and {noise} times "
            "the noise that is stated.",
        ),
        Section(
            "The sensor",
            (field.sensor(found),),
            f"{percent(found.frames.share)} of random attitudes gave a frame with more than "
            f"{MORE_THAN_STARS} stars; "
            f"the paper chose {N_CHOSEN} of {N_TAKEN} frames.",
        ),
    ]
    title = "Ye & Yang 2017: the field experiment by simulation"
    return _page(
        title, f"Table 3 of {_ABOUT}", field.headline(found), sections, found.provenance, figures
    )


def _page(
    title: str,
    about: str,
    headline: str,
    sections: list[Section],
    record: Provenance,
    figures: Mapping[str, bytes],
    warning: str = "",
) -> str:
    sections.append(Section("Provenance", (tables.provenance_table(record),)))
    context = {
        "title": title,
        "about": about,
        "headline": headline,
        "sections": sections,
        "warning": warning,
        "created": record.created_utc,
        "version": record.version,
        "images": figures,
    }
    return template_environment().get_template("sections.html.j2").render(context) + "\n"
