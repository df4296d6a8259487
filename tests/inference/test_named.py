"""Likelihoods by their names."""

from types import SimpleNamespace

import pytest

from starcal_uq.core.errors import SamplingError
from starcal_uq.core.provenance import Provenance
from starcal_uq.inference import named
from starcal_uq.likelihood.student import DEFAULT_DOF
from tests.helpers.scenes import observations


def test_degrees_of_freedom_are_the_callers_or_the_calibrations() -> None:
    student = SimpleNamespace(
        has_tails=True, provenance=Provenance(settings={"likelihood": "student_t", "dof": 7.0})
    )
    other = SimpleNamespace(has_tails=False)
    assert named.resolved_dof(student, None) == 7.0 and named.resolved_dof(student, 3.0) == 3.0
    assert named.resolved_dof(student, "free") == "free" and named.resolved_dof(other, 3.0) == 3.0
    assert named.resolved_dof(other, None) == DEFAULT_DOF


def test_a_stream_of_samaans_has_no_likelihood_to_sample() -> None:
    cal = SimpleNamespace(
        provenance=Provenance(settings={"stream": True, "method": "samaan"}),
        known_effects=SimpleNamespace(fitted=("star",)),
    )
    with pytest.raises(SamplingError, match="a stream leaves only the quadratic likelihood"):
        named._named_source("pairs", None, cal, None)
    with pytest.raises(SamplingError, match="holds effects"):
        named._named_source("pairs", observations(n_frames=3), cal, None)
