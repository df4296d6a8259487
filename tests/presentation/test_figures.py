"""The figures show the numbers they are made from, in every model, legibly, and leave no trace in
the process.
"""

from __future__ import annotations

import ast
import dataclasses
import itertools
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.camera.distortion import parameters
from starcal_uq.presentation.figures import style
from starcal_uq.presentation.figures.coupling import (
    correlation_text,
    plot_correlation,
    plot_correlations,
    plot_couplings,
)
from starcal_uq.presentation.figures.estimation import (
    plot_convergence,
    plot_residuals,
)
from starcal_uq.presentation.figures.inference import (
    CONTOUR_MASSES,
    mass_levels,
    plot_corner,
    plot_prior_posterior,
    sparse,
)
from starcal_uq.presentation.figures.propagation import (
    plot_attitude,
    plot_distortion_curve,
    plot_field_map,
)
from starcal_uq.presentation.figures.scales import axis_scale, symbol
from starcal_uq.presentation.figures.style import (
    figure_of,
    new_axes,
    new_figure,
    painted,
    panels,
    png_bytes,
)
from starcal_uq.presentation.figures.ticks import single_ticks
from starcal_uq.propagation.attitude_error import AttitudeError
from starcal_uq.propagation.onboard_error import OnboardError
from tests.helpers.scenes import camera, nominal, observations

ROOT = Path(__file__).parents[2]
PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def run():
    """A run with as many parameters as a usual model has: the fullest panels."""
    truth = camera("brown_tangential")
    obs = observations("brown_tangential", n_frames=60)
    cal = sc.calibrate(obs, nominal(truth))
    post = sc.sample(obs, cal, seed=1, n_steps=50)
    return SimpleNamespace(obs=obs, cal=cal, post=post, coupling=sc.coupling(post), truth=truth)


@pytest.fixture
def errors():
    """Attitude errors and a map, the sizes of the paper's set-up."""
    x, y = np.linspace(-0.5, 1023.5, 9), np.linspace(-0.5, 767.5, 7)
    radius = np.hypot(x[None, :] - 500.0, y[:, None] - 400.0) / 700.0
    sizes = [np.array([0.5, 0.5, 7.0]), np.array([5.4, 5.5, 0.1]), np.array([0.02, 0.02, 0.2])]
    nothing = np.full((5, 4), np.nan)
    attitude = AttitudeError(*sizes, nothing, nothing, *sizes, n_draws=300, n_frames=100)
    absolute, compensated = 5.0 + 0.01 * radius, 0.002 + 0.1 * radius**4
    shape = np.array([[1.2, 0.3], [0.3, 0.8]])
    field = SimpleNamespace(
        x_px=x,
        y_px=y,
        sigma_absolute_arcsec=absolute,
        sigma_compensated_arcsec=compensated,
        covariance_absolute_arcsec2=absolute[..., None, None] ** 2 * shape,
        covariance_compensated_arcsec2=compensated[..., None, None] ** 2 * shape,
        star_x_px=np.linspace(0.0, 1000.0, 30),
        star_y_px=np.linspace(0.0, 700.0, 30),
    )
    return attitude, field


def drawn(result):
    figure = figure_of(result) if hasattr(result, "plot") else result
    assert png_bytes(figure, dpi=50).startswith(PNG)
    return figure


def overlapping(figure):
    """Pairs of tick labels of one axis that cover each other."""
    figure.draw_without_rendering()
    pairs = []
    for ax in figure.axes:
        for axis in (ax.xaxis, ax.yaxis):
            low, high = sorted(axis.get_view_interval())
            shown = [
                tick.label1
                for tick in axis.get_major_ticks()
                if tick.label1.get_visible()
                and tick.label1.get_text()
                and low <= tick.get_loc() <= high
            ]
            boxes = [(label.get_text(), label.get_window_extent()) for label in shown]
            pairs += [
                (a[0], b[0]) for a, b in itertools.combinations(boxes, 2) if a[1].overlaps(b[1])
            ]
    return pairs


def test_corner_shows_every_sampled_parameter(run):
    figure = drawn(plot_corner(run.post, run.cal, run.truth))
    n = len(run.post.sampled)
    assert len(figure.axes) == n * (n + 1) // 2
    titles = [ax.get_title() for ax in figure.axes if ax.get_title()]
    assert [title.split(" ")[0] for title in titles] == [
        symbol(run.post.parameters[i].name) for i in run.post.sampled
    ]
    assert overlapping(figure) == []


@pytest.mark.parametrize("half", [0.152, 0.157, 3.1, 10.4, 0.0203])
def test_labels_of_neighbouring_panels_do_not_touch(half):
    figure = new_figure(11.5, 2.0)
    grid = panels(figure, 1, 6, (0.46, 0.14, 0.5, 0.6), (0.22, 0.0))
    for i in range(6):
        ax = figure.add_subplot(grid[0, i])
        ax.set_xlim(-half, half)
        sparse(ax, y=False)
    figure.draw_without_rendering()
    labels = [
        label
        for ax in figure.axes
        for label in ax.get_xticklabels()
        if abs(label.get_position()[0]) <= half
    ]
    assert len(labels) >= 12
    boxes = [label.get_window_extent() for label in labels]
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))


def test_prior_and_posterior(run):
    figure = drawn(plot_prior_posterior(run.post, run.truth))
    assert len(figure.axes) == 2 * len(run.post.sampled)
    assert overlapping(figure) == []


def test_contours_hold_the_stated_mass():
    """On a normal distribution the levels are those of the 1- and 2-sigma ellipses."""
    x = np.linspace(-5, 5, 401)
    density = np.exp(-0.5 * (x[:, None] ** 2 + x[None, :] ** 2))
    outer, inner = mass_levels(density, CONTOUR_MASSES)
    assert inner == pytest.approx(np.exp(-0.5), rel=0.01)
    assert outer == pytest.approx(np.exp(-2.0), rel=0.02)


def test_axis_is_value_minus_the_printed_number():
    k1 = parameters("brown")[3]
    scale = axis_scale(k1, 1.9634e-10, 0.39e-10)
    assert scale.label == "k₁ − 1.96 [10⁻¹⁰ px⁻²]"
    assert scale.title == "k₁ = (1.96 ± 0.39) × 10⁻¹⁰ px⁻²"
    assert scale(2.35e-10) == pytest.approx(0.39)
    fine = axis_scale(parameters("brown")[2], -5000.0, 0.0002)
    assert fine.label == "f + 5000.00000 [10⁻³ px]"
    assert fine(np.array([-4999.999])) == pytest.approx([1.0])


@pytest.mark.parametrize("extended", [False, True])
def test_heat_map_prints_its_numbers(run, extended):
    ax = plot_correlation(run.coupling, extended=extended)
    matrix = run.coupling.extended_correlation if extended else run.coupling.correlation
    texts = [text.get_text() for text in ax.texts]
    wanted = [correlation_text(v, i == j) for (i, j), v in np.ndenumerate(matrix)]
    assert texts == wanted
    drawn(ax)


def test_correlations_near_one_keep_their_digits():
    assert [correlation_text(v) for v in (0.02, -0.943, 0.9912, -0.99931, 1.0 - 1e-9, -0.001)] == [
        "0.02",
        "−0.94",
        "0.991",
        "−0.9993",
        "0.9999",
        "0.00",
    ]
    assert correlation_text(1.0, diagonal=True) == "1"


def test_price_of_coupling(run):
    ax = plot_couplings(run.coupling)
    ratio = run.coupling.sigma_marginal / run.coupling.sigma_conditional
    assert [bar.get_width() for bar in ax.patches] == pytest.approx(ratio)
    drawn(ax)


def test_convergence_draws_the_trajectories(run):
    figure = drawn(plot_convergence(run.cal, run.truth))
    p = len(run.cal.parameter_names)
    assert len(figure.axes) == 2 * p
    trajectory = np.concatenate([stage.trajectory for stage in run.cal.stages])
    focal_mm = figure.axes[2].lines[0].get_ydata()
    assert focal_mm == pytest.approx(trajectory[:, 2] * run.cal.camera.pixel_um / 1000.0)
    error = figure.axes[p].lines[-1].get_ydata()
    assert error == pytest.approx((trajectory[:, 0] - run.truth.theta[0]) / run.cal.sigmas[0])
    assert overlapping(figure) == []
    drawn(plot_convergence(run.cal))


def test_a_truth_of_another_model_is_not_compared(run):
    other = camera("brown3")
    figure = plot_convergence(run.cal, other)
    assert "final estimate" in figure.axes[len(run.cal.parameter_names)].get_ylabel()


def test_residuals(run):
    figure = drawn(plot_residuals(run.cal, run.obs))
    assert len(figure.axes) == 3
    assert overlapping(figure) == []
    few = run.obs.select_frames(run.obs.frame_ids[:3])
    cal = sc.calibrate(few, run.cal.camera)
    drawn(plot_residuals(cal, few))


def test_attitude_bars_are_with_the_misfit_found_and_lines_if_the_model_holds(errors):
    attitude, _ = errors
    parts = np.array([[12.0, 11.0, 0.2], [0.5, 0.1, 0.4], [12.0, 11.0, 0.5]])
    found = OnboardError("model", *parts, ())
    ax = plot_attitude(dataclasses.replace(attitude, misfit=found))
    bars = np.array([bar.get_height() for bar in ax.patches])
    assert bars[3] == pytest.approx(12.0) and bars[6] == pytest.approx(0.5)
    lines = [line.get_ydata()[0] for line in ax.lines]
    assert lines == pytest.approx([0.5, 0.5, 7.0, 5.4, 5.5, 0.1, 0.02, 0.02, 0.2])
    drawn(ax)


def test_field_map_has_a_colour_bar_for_each_panel(errors):
    _, field = errors
    figure = drawn(plot_field_map(field))
    assert len(figure.axes) == 4
    assert figure.axes[0].get_ylim()[0] > figure.axes[0].get_ylim()[1]
    assert overlapping(figure) == []
    # The compensated map spans a factor of fifty: levels in equal ratios, printed without powers of
    # ten.
    bar = figure.axes[3]
    assert bar.get_yscale() == "log"
    assert "0.01" in [label.get_text() for label in bar.get_yticklabels()]
    field.sigma_absolute_arcsec = np.full_like(field.sigma_absolute_arcsec, 5.0)
    field.sigma_compensated_arcsec = np.zeros_like(field.sigma_absolute_arcsec)
    field.covariance_compensated_arcsec2 = np.zeros_like(field.covariance_absolute_arcsec2)
    drawn(plot_field_map(field))


def test_ellipses_of_the_field_map_lie_within_their_cells(errors):
    _, field = errors
    figure = drawn(plot_field_map(field))
    ellipses = figure.axes[0].collections[-1]
    places = ellipses.get_offsets()
    step = min(np.diff(np.unique(places[:, i])).min() for i in (0, 1))
    assert 0.85 * step < ellipses.get_widths().max() <= step
    assert (ellipses.get_widths() > ellipses.get_heights()).all()
    # The long axis points along rising x and y, which is downwards to the right.
    assert np.all((ellipses.get_angles() % 180.0 > 0.0) & (ellipses.get_angles() % 180.0 < 45.0))
    assert "semi-axis 5″" in [text.get_text() for text in figure.axes[0].texts]
    # A map of an earlier version has no ellipses and is drawn all the same.
    field.covariance_absolute_arcsec2 = field.covariance_compensated_arcsec2 = None
    assert not drawn(plot_field_map(field)).axes[0].texts


def test_figures_are_repeatable_and_show_themselves(run):
    first, second = (png_bytes(figure_of(plot_couplings(run.coupling)), dpi=40) for _ in range(2))
    assert first == second
    both = plot_correlations(run.coupling)
    assert overlapping(both) == [] and both._repr_png_().startswith(PNG)


def test_single_ticks_draw_the_same_picture(run, errors):
    """Also beside a colour bar, secondary axes, minor ticks and an offset; afterwards nothing has
    changed.
    """

    def far():
        ax = new_axes(4.0, 3.0)
        ax.plot([1e6, 1e6 + 1.0], [0.0, 1.0])
        return ax

    curve = sc.propagation.distortion_curve(run.post, run.obs, n=11, n_draws=50)
    for make in (
        lambda: plot_corner(run.post, run.cal, run.truth),
        lambda: plot_convergence(run.cal, run.truth),
        lambda: plot_correlations(run.coupling),
        lambda: plot_distortion_curve(curve),
        lambda: plot_field_map(errors[1]),
        lambda: figure_of(plot_attitude(errors[0])),
        lambda: figure_of(far()),
    ):
        figure, other = make(), make()
        axes = [axis for ax in figure.axes for axis in (ax.xaxis, ax.yaxis)]
        before = [axis.get_visible() for axis in axes]
        with single_ticks(figure):
            assert sum(axis.get_visible() for axis in axes) < sum(before)
            assert np.array_equal(painted(figure, 60), painted(other, 60))
        assert [axis.get_visible() for axis in axes] == before
        # The fit of panels depends on the one before.
        assert np.array_equal(painted(figure, 60), painted(other, 60))


def test_settings_of_the_user_stay_untouched(run):
    import matplotlib

    before = dict(matplotlib.rcParams)
    plot_residuals(run.cal, run.obs)
    plot_correlation(run.coupling)
    assert dict(matplotlib.rcParams) == before


def test_importing_plots_imports_no_matplotlib():
    code = "import sys, starcal_uq.presentation.views; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_gallery_has_every_figure(monkeypatch):
    """A figure without an entry is not shown to anybody who has not drawn it."""
    from starcal_uq.paper.show import views as paper
    from starcal_uq.presentation import views

    monkeypatch.syspath_prepend(ROOT / "docs")
    from gallery_figures import SCENES

    tables = (views.VIEWS, paper.VIEWS)
    figures = {
        f"{cls.__name__}.{name}"
        for table in tables
        for cls, view in table.items()
        for name in view.figures
    }
    shown = [name for scene in SCENES for name in scene.figures]
    assert (set(shown), len(shown)) == (figures, len(figures))


@pytest.mark.slow
@pytest.mark.usefixtures("unpainted")
def test_every_figure_is_drawn_into_that_of_the_user(monkeypatch, tmp_path):
    """Those of the paper's field experiment, which takes minutes, alone are left out."""
    from matplotlib import pyplot
    from matplotlib.figure import Figure

    monkeypatch.syspath_prepend(ROOT / "docs")
    monkeypatch.chdir(tmp_path)
    from gallery_figures import SCENES

    made = []
    initialise = Figure.__init__

    def counted(self, *args, **options):
        made.append(self)
        initialise(self, *args, **options)

    monkeypatch.setattr(Figure, "__init__", counted)
    monkeypatch.setattr("starcal_uq.paper.reproduction.N_READING_DRAWS", 2)
    results, n_drawn = {}, 0
    for scene in (scene for scene in SCENES if scene.drawn):
        exec(scene.code, results)
        for name, (_, _, code) in scene.figures.items():
            whole = Figure(figsize=(14.0, 7.0))
            other, own = whole.subfigures(1, 2)
            made.clear()
            call = ast.parse(code, mode="eval")
            call.body.keywords.append(ast.keyword("fig", ast.Name("own", ast.Load())))
            compiled = compile(ast.fix_missing_locations(call), name, "eval")
            drawn = eval(compiled, {**results, "own": own})
            whole.draw_without_rendering()
            assert (drawn if isinstance(drawn, type(own)) else drawn.figure) is own, name
            assert own.axes and not other.axes and not made, name
            assert not pyplot.get_fignums(), name
            n_drawn += 1
    assert n_drawn > 30


def test_every_name_of_the_table_of_looks_is_found_and_used():
    """A legend names looks that exist, and nothing in the table is left over."""
    table = tomllib.loads((ROOT / "starcal_uq/presentation/figures/looks.toml").read_text("utf-8"))
    drawn = [one for legend in table["legends"] for one in style.keys(legend)]
    assert all(one.get_label() for one in drawn) and len(drawn) > 10
    code = "".join(path.read_text("utf-8") for path in (ROOT / "starcal_uq").rglob("*.py"))
    words = {name for legend in table["legends"].values() for name in legend.values()}
    left = {name for name in table["looks"] if f'"{name}"' not in code} - words
    assert not left, left
