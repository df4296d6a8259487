"""A study or a coupling as an interactive figure: its numbers as one block of JSON, which a script
in the page draws without a library and without network.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import parameter_called
from starcal_uq.core.constants import AXES
from starcal_uq.core.formatting import pretty_unit
from starcal_uq.core.types import AnyDict
from starcal_uq.presentation.figures.scales import symbol
from starcal_uq.presentation.figures.studies import correlation_of, numbers_of
from starcal_uq.presentation.html import template_environment
from starcal_uq.presentation.words.axes import axis_label, axis_name, value_words, with_unit
from starcal_uq.propagation.coupling import Coupling
from starcal_uq.studies.result import Study

if TYPE_CHECKING:
    from markupsafe import Markup

# A page holds the numbers of at most so many places of a sweep.
_MOST_PLACES = 2000
_ERRORS = ("frame_error_arcsec", "common_rotation_arcsec", "nea_arcsec")


def explorer(result: Study | Coupling) -> Markup:
    """The figure as a piece of a page; nothing for a study without numbers along an axis."""
    from markupsafe import Markup

    if isinstance(result, Study) and not (result.axes and result.ok.any()):
        return Markup("")
    facts = _study(result) if isinstance(result, Study) else _coupling(result)
    return Markup(template_environment().get_template("explorer.html.j2").render(facts=facts))


def framed(result: Study | Coupling) -> str:
    """The figure in a frame of its own, as a notebook shows it."""
    return template_environment().get_template("frame.html.j2").render(explorer=explorer(result))


def _study(study: Study) -> AnyDict:
    """Medians over seeds, and over axes that have no slider, at every place of the grid."""
    sweep, names = study.sweep, study.parameter_names
    axes = [axis for axis in sweep.axes if axis not in sweep.drawn] or [sweep.axes[0]]
    while math.prod(len(sweep.values[axis]) for axis in axes) > _MOST_PLACES:
        axes.pop()
    columns = [correlation_of(study, a, b) for a in names for b in (*names, *AXES)]
    for variable in ("sigma", "sigma_conditional"):
        columns += [numbers_of(study, variable, name)[0] for name in names]
    columns += [numbers_of(study, variable)[0] for variable in _ERRORS]
    grids = [sweep.over(column, dims=axes).values.ravel() for column in columns]
    middle = sweep.held()
    values = {axis: list(sweep.values[axis]) for axis in axes}
    return {
        "axes": [
            {
                "name": axis_name(axis),
                "label": axis_label(axis),
                "values": list(map(value_words, known)),
                "words": [with_unit(axis, value) for value in known],
                "start": known.index(middle.get(axis, known[0])),
            }
            for axis, known in values.items()
        ],
        "over": [axis_name(axis) for axis in sweep.axes if axis not in axes],
        "target": study.definition.target_arcsec,
        "places": [_plain(row) for row in np.transpose(grids)],
        **_matrix(names),
    }


def _coupling(coupling: Coupling) -> AnyDict:
    """What the script needs to add measurements of single parameters."""
    names = coupling.parameter_names
    scales = np.array([parameter_called(name).scale for name in names])
    return {
        "correlation": coupling.extended_correlation.tolist(),
        "sigma": [*coupling.sigma_marginal / scales, *coupling.common_rotation_arcsec],
        "alone": list(coupling.sigma_conditional / scales),
        **_matrix(names),
    }


def _matrix(names: Sequence[str]) -> AnyDict:
    """Parameters, and the heads of the matrix."""
    units = {name: pretty_unit(parameter_called(name).scaled_unit) for name in names}
    return {
        "parameters": [{"name": symbol(name), "unit": unit} for name, unit in units.items()],
        "names": [*map(symbol, names), *AXES],
    }


def _plain(values: Iterable[float]) -> list[float | None]:
    """Numbers that JSON knows, of five digits."""
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in values]
