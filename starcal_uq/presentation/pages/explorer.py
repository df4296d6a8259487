"""A study or a coupling as an interactive figure: its numbers as one block of JSON, which a script
in the page draws without a library and without network.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from starcal_uq.camera.distortion import parameter_called
from starcal_uq.core.constants import AXES
from starcal_uq.core.formatting import pretty_unit
from starcal_uq.core.types import AnyDict
from starcal_uq.presentation.figures.scales import symbol
from starcal_uq.presentation.html import template_environment
from starcal_uq.presentation.words.axes import axis_label, axis_name, value_words
from starcal_uq.propagation.coupling import Coupling
from starcal_uq.studies.findings import cross
from starcal_uq.studies.result import Study

# A page holds the numbers of at most so many places of a sweep.
_MOST_PLACES = 2000


def explorer(result: Study | Coupling) -> str:
    """The figure as a piece of a page; nothing for a study without numbers along an axis."""
    if isinstance(result, Coupling):
        facts = _coupling(result)
    elif result.axes and result.ok.any():
        facts = _study(result)
    else:
        return ""
    return template_environment().get_template("explorer.html.j2").render(facts=facts)


def framed(result: Study | Coupling) -> str:
    """The figure in a frame of its own, as a notebook shows it."""
    return template_environment().get_template("frame.html.j2").render(explorer=explorer(result))


def _study(study: Study) -> AnyDict:
    """Medians over seeds, and over axes that have no slider, at every place of the grid."""
    sweep, data = study.sweep, study.data
    axes = [axis for axis in sweep.axes if axis not in sweep.drawn] or [sweep.axes[0]]
    while math.prod(len(sweep.values[axis]) for axis in axes) > _MOST_PLACES:
        axes.pop()
    matrix = np.concatenate([data["correlation"], data["attitude_correlation"]], axis=2)
    columns = (
        *matrix.reshape(study.n_cells, -1).T,
        *data["sigma"].values.T,
        *data["sigma_conditional"].values.T,
        *(sweep.frame_error, sweep.common_rotation, cross(data["nea_arcsec"]).values),
    )
    grids = [sweep.over(column, dims=axes).values.ravel() for column in columns]
    middle = sweep.held()
    values = {axis: list(sweep.values[axis]) for axis in axes}
    return {
        "axes": [
            {
                "label": axis_label(axis),
                "values": list(map(value_words, known)),
                "start": known.index(middle.get(axis, known[0])),
            }
            for axis, known in values.items()
        ],
        "over": [axis_name(axis) for axis in sweep.axes if axis not in axes],
        "target": study.definition.target_arcsec,
        "places": [_plain(row) for row in np.transpose(grids)],
        **_matrix(study.parameter_names),
    }


def _coupling(coupling: Coupling) -> AnyDict:
    """Data from which the script adds measurements of single parameters."""
    return {
        "correlation": coupling.extended_correlation.tolist(),
        "sigma": [*coupling.sigma_marginal, *coupling.common_rotation_arcsec],
        "alone": list(coupling.sigma_conditional),
        **_matrix(coupling.parameter_names),
    }


def _matrix(names: Sequence[str]) -> AnyDict:
    """Parameters, with the unit in which they are shown and its size, and the heads of the matrix."""
    specs = map(parameter_called, names)
    return {
        "parameters": [[symbol(s.name), pretty_unit(s.scaled_unit), s.scale] for s in specs],
        "names": [*map(symbol, names), *AXES],
    }


def _plain(values: Iterable[float]) -> list[float | None]:
    """Numbers that JSON knows, of five digits."""
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in values]
