"""Tab completion lists public names, and figures are drawn into those of the user."""

import inspect

import pytest
from matplotlib import pyplot
from matplotlib.figure import Figure

import starcal_uq as sc
from tests.helpers.public import public
from tests.helpers.scenes import observations


def test_nothing_private_is_completed():
    kinds = {thing for _, thing in public() if inspect.isclass(thing)}
    assert {sc.Camera, sc.Calibration, sc.Posterior, sc.Run, sc.Observations} <= kinds
    for kind in kinds:
        if not inspect.isabstract(kind):
            names = dir(
                kind.__new__(kind) if not hasattr(kind, "__members__") else next(iter(kind))
            )
            private = [name for name in names if name.startswith("_") and name[:2] != "__"]
            assert not private, (kind, private)
    run = sc.Run("nowhere")
    assert "_tell" in vars(run) and not [name for name in dir(run) if name.startswith("_")]
    assert {"calibrate", "path", "posterior"} <= {*dir(run)}
    for module in (sc, sc.core, sc.inference):
        assert set(dir(module)) == set(module.__all__)
        assert not [name for name in dir(module) if name.startswith("_")]


@pytest.fixture
def cal():
    return sc.calibrate(observations(n_frames=12), sc.paper.paper_start())


def test_a_figure_is_drawn_into_that_of_the_user(cal):
    whole = Figure(layout="constrained")
    left, right = whole.subfigures(1, 2)
    assert cal.plot.convergence(fig=left) is left
    assert left.axes and not right.axes and not pyplot.get_fignums()
    # Without one, each call has a figure of its own.
    own = cal.plot.convergence()
    assert isinstance(own, Figure) and own is not whole
    assert cal.plot.convergence(fig=whole) is whole


def test_help_shows_the_arguments_that_are_left(cal):
    names = [*inspect.signature(cal.plot.convergence).parameters]
    assert names == ["truth", "fig"]
    assert "stage" in cal.plot.convergence.__doc__
