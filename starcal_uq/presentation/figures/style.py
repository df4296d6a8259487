"""One look for all figures: colours that colour-blind readers can tell apart, quiet axes, explicit
sizes.

Styles are set on each artist rather than through ``rcParams``: figures look the same wherever they
are drawn, and the user's own settings stay untouched.
"""

from __future__ import annotations

import io
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from starcal_uq.core.display import GIVEN
from starcal_uq.core.formatting import MINUS, significant, superscript
from starcal_uq.core.types import AnyDict
from starcal_uq.presentation.figures.scales import round_below, round_levels, ticks_at_levels
from starcal_uq.presentation.figures.ticks import single_ticks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.gridspec import GridSpec
    from matplotlib.lines import Line2D
    from numpy.typing import NDArray

# Okabe & Ito (2008), "Color Universal Design".
BLUE, SKY, GREEN = "#0072B2", "#56B4E9", "#009E73"
ORANGE, VERMILLION, PURPLE = "#E69F00", "#D55E00", "#CC79A7"
INK, GREY, LIGHT = "#1b2733", "#66727f", "#dfe4e9"
_COLOURS = {
    name.lower(): colour for name, colour in globals().items() if str(colour).startswith("#")
}

TITLE_SIZE, LABEL_SIZE, TICK_SIZE = 10.5, 9.5, 8.5
# Half as many again as a page of 1100 px shows.
DPI = 160
_WHITE = 251
# Intervals between the ticks of an axis, at most.
_TICKS = 5
# Means with their standard errors.
BARS: AnyDict = {"markersize": 4.0, "linestyle": "none", "elinewidth": 1.1}


def new_figure(width_in: float, height_in: float) -> Figure:
    """The figure that a user gave, or an empty one that no window manager knows of and that shows
    itself in a notebook.
    """
    if (given := GIVEN.get()) is not None:
        return cast("Figure", given)
    return _notebook_figure()(
        figsize=(width_in, height_in), layout="constrained", facecolor="white"
    )


@cache
def _notebook_figure() -> type[Figure]:
    """The class, made once: matplotlib writes a page about each class of artists."""
    from matplotlib.figure import Figure

    class NotebookFigure(Figure):
        def _repr_png_(self) -> bytes:
            return png_bytes(self, dpi=110)

    return NotebookFigure


def panels(
    figure: Figure,
    rows: int,
    columns: int,
    margins_in: tuple[float, float, float, float],
    gaps_in: tuple[float, float],
    **ratios: Any,
) -> GridSpec:
    """A grid of panels with margins (left, right, bottom, top) and gaps (across, down) in inches;
    equal by default.

    Many small panels of known labels are laid out at once: measuring every label takes longer than
    drawing all of them.
    """
    if GIVEN.get() is None:
        figure.set_layout_engine("none")
    size: Any = figure.bbox.size
    width, height = size / figure.dpi
    left, right, bottom, top = margins_in
    across, down = gaps_in
    return figure.add_gridspec(
        rows,
        columns,
        left=left / width,
        right=1.0 - right / width,
        bottom=bottom / height,
        top=1.0 - top / height,
        wspace=across * columns / (width - left - right - across * (columns - 1)),
        hspace=down * rows / (height - bottom - top - down * (rows - 1)),
        **ratios,
    )


def new_axes(width_in: float, height_in: float) -> Axes:
    """One dressed panel on a figure of its own.

    In a notebook the figure is handed to pyplot, because only then does the notebook show it below
    the cell although the caller holds the Axes; elsewhere pyplot is left alone.
    """
    if GIVEN.get() is None and _in_notebook():
        from matplotlib import pyplot

        figure = pyplot.figure(
            figsize=(width_in, height_in), layout="constrained", facecolor="white"
        )
    else:
        figure = new_figure(width_in, height_in)
    return dress(figure.add_subplot())


def panel(
    ax: Axes | None,
    width_in: float,
    height_in: float,
    *,
    grid: bool = False,
) -> Axes:
    """The panel that is given, dressed, or one on a figure of its own."""
    return dress(new_axes(width_in, height_in) if ax is None else ax, grid=grid)


def dress(ax: Axes, *, grid: bool = False) -> Axes:
    """Quiet spines, small ticks, and not many of them."""
    from matplotlib.ticker import AutoLocator

    # A title whose height is given is not put above all tick labels, each of them measured, when
    # the figure is drawn.
    ax.set_title("", y=1.0)
    for axis in (ax.xaxis, ax.yaxis):
        locator = axis.get_major_locator()
        # Ticks are most of what it costs to draw a panel.
        if isinstance(locator, AutoLocator):
            locator.set_params(nbins=_TICKS)
    ax.tick_params(labelsize=TICK_SIZE, colors=INK, color=GREY, length=3.0, width=0.7)
    for side, spine in ax.spines.items():
        spine.set_color(GREY)
        spine.set_linewidth(0.7)
        spine.set_visible(side in ("left", "bottom"))
    if grid:
        ax.grid(True, color=LIGHT, linewidth=0.7)
        ax.set_axisbelow(True)
    return ax


def log_scale(axis: Axis, linear: float | None = None, **options: Any) -> None:
    """A logarithmic axis with ticks at powers of ten; linear between -`linear` and `linear` where
    that is given.
    """
    from matplotlib.ticker import FuncFormatter, NullLocator

    ax = axis.axes
    scaled: Any = ax.set_xscale if axis is ax.xaxis else ax.set_yscale
    if linear is None:
        scaled("log", **options)
    else:
        scaled("symlog", linthresh=linear, **options)
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: power_text(value)))


def signed_log(
    axis: Axis, linear: float, reach: float, inner: Any = (0.0,), most: int = 2, **options: Any
) -> None:
    """An axis from -`reach` to `reach`, linear within `linear`, with ticks at `most` powers of ten
    on either side of `inner` ones.
    """
    from matplotlib.ticker import FixedLocator

    ax = axis.axes
    log_scale(axis, linear, **options)
    powers = 10.0 ** np.arange(1, np.floor(np.log10(reach)) + 1)
    powers = powers[:: -max(1, -(-len(powers) // most))]
    axis.set_major_locator(FixedLocator([*-powers, *inner, *powers]))
    (ax.set_xlim if axis is ax.xaxis else ax.set_ylim)(-reach, reach)


def power_text(value: float) -> str:
    """A power of ten as a tick label, without the mathematical typesetting that takes as long as a
    panel.
    """
    if value == 0.0:
        return "0"
    exponent = round(float(np.log10(abs(value))))
    text = f"{abs(value):g}" if abs(exponent) < 3 else f"10{superscript(exponent)}"
    return f"{MINUS}{text}" if value < 0 else text


def label(
    ax: Axes,
    title: str = "",
    x: str = "",
    y: str = "",
    *,
    pad: float = 7.0,
    size: float = LABEL_SIZE,
) -> None:
    """Title, `pad` points above the panel, and axis labels in the common sizes."""
    if title:
        ax.set_title(title, fontsize=TITLE_SIZE, color=INK, loc="left", pad=pad, y=1.0)
    if x:
        ax.set_xlabel(x, fontsize=size, color=INK)
    if y:
        ax.set_ylabel(y, fontsize=size, color=INK)


@cache
def _table() -> AnyDict:
    return tomllib.loads((files(__package__ or "") / "looks.toml").read_text("utf-8"))


def look(name: str, **more: Any) -> AnyDict:
    """Colour, marker and line by a name in ``looks.toml``."""
    found = {key: _COLOURS.get(str(one), one) for key, one in _table()["looks"][name].items()}
    return found | more


def named(ax: Axes, name: str, **look: Any) -> None:
    """Title and axis labels by a name in ``looks.toml``."""
    label(ax, **_table()["labels"][name], **look)


def keys(name: str) -> list[Any]:
    """Entries of a legend by its name in ``looks.toml``."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    found = {text: look(one) for text, one in _table()["legends"][name].items()}
    return [
        Patch(label=text, **one) if "facecolor" in one else Line2D([], [], label=text, **one)
        for text, one in found.items()
    ]


def errors(
    ax: Axes, at: Any, value: Any, low: Any, high: Any, *, across: bool = False, **look: Any
) -> None:
    """Values with bars from their lower to their upper bounds, along x with `across`."""
    bars = np.maximum([value - low, high - value], 0.0)
    if across:
        ax.errorbar(value, at, xerr=bars, **look)
    else:
        ax.errorbar(at, value, bars, **look)


def rows(ax: Axes, names: Iterable[str]) -> None:
    """Names of the rows of a panel at 0, 1, ..., from below, without ticks."""
    names = list(names)
    ax.set_yticks(range(len(names)), names)
    ax.tick_params(axis="y", length=0.0)
    ax.set_ylim(-0.65, len(names) - 0.35)


def heading(ax: Axes, text: str, size: float = TITLE_SIZE, pad: float = 5.0) -> None:
    """A title in the middle above a small panel."""
    ax.set_title(text, fontsize=size, color=INK, pad=pad, y=1.0)


def note(ax: Axes, text: str, at: tuple[Any, Any], shift: Any = None, **look: Any) -> None:
    """Small words at a place of the panel, `shift` (across, up) points aside."""
    look = AnyDict(fontsize=TICK_SIZE, color=INK) | look
    if shift is not None:
        look |= {"xytext": shift, "textcoords": "offset points"}
    ax.annotate(text, at, **look)


def in_cell(ax: Axes, text: str, row: int, column: int, **look: Any) -> None:
    """Words in the middle of a cell of a map; nothing for the layout to make room for."""
    ax.text(column, row, text, ha="center", va="center", **({"fontsize": TICK_SIZE} | look))


def squares(ax: Axes, n_x: int, n_y: int, width: float) -> None:
    """White lines between the cells of a map instead of ticks and spines."""
    ax.spines[:].set_visible(False)
    ax.set_xticks(np.arange(1, n_x) - 0.5, minor=True)
    ax.set_yticks(np.arange(1, n_y) - 0.5, minor=True)
    ax.tick_params(which="both", length=0.0)
    ax.grid(True, which="minor", color="white", linewidth=width)


def band(ax: Axes, x: Any, low: Any, high: Any, colour: str, **look: Any) -> None:
    """A filled band without an edge."""
    ax.fill_between(x, low, high, color=colour, linewidth=0, **look)


def detector(ax: Axes, x: Any, y: Any, title: str) -> None:
    """A map over the detector: equal scales, y downwards as on a picture."""
    ax.set_xlim(x[0], x[-1])
    ax.set_ylim(y[-1], y[0])
    ax.set_aspect("equal")
    label(ax, title, "x [px]", "y [px]")


def filled(
    ax: Axes, x: Any, y: Any, values: Any, title: str, unit: str | None, of: Any = None
) -> tuple[Any, Any]:
    """Filled levels of values (ny, nx) over the detector, with a colour bar in a unit, if any.

    Levels are round and those of `of`, the values themselves by default. Returned are image and
    levels.
    """
    levels, norm = round_levels(values if of is None else of)
    drawn = np.clip(values, levels[0], levels[-1])
    image = dress(ax).contourf(x, y, drawn, levels=levels, norm=norm, cmap="cividis")
    detector(ax, x, y, title)
    if unit is not None:
        ticks_at_levels(colour_bar(ax, image, unit), levels)
    return image, levels


def arrows(ax: Axes, x: Any, y: Any, shifts: Any, unit: str) -> None:
    """White arrows of shifts (ny, nx, 2) at places x (nx,), y (ny,) of the detector, with a key."""
    # The largest are in the corners and would leave nothing to see elsewhere.
    typical = np.percentile(np.linalg.norm(shifts, axis=-1), 85.0)
    key = round_below(typical)
    found = ax.quiver(
        *np.meshgrid(x, y),
        shifts[..., 0],
        shifts[..., 1],
        angles="xy",
        scale_units="xy",
        scale=typical / (0.8 * (x[1] - x[0])),
        color="white",
        edgecolor=INK,
        linewidth=0.6,
        width=0.006,
    )
    ax.quiverkey(
        found,
        0.93,
        1.033,
        key,
        f"{significant(key, 1)}{unit}",
        labelpos="W",
        fontproperties={"size": TICK_SIZE},
        labelcolor=INK,
        color=INK,
    )


def legend(ax: Axes, **keywords: Any) -> None:
    """A legend with a faint white ground, so that data under it do not cross the words."""
    options: AnyDict = {
        "fontsize": TICK_SIZE,
        "framealpha": 0.9,
        "edgecolor": "none",
        "labelcolor": INK,
    }
    ax.legend(**{**options, **keywords})


def about_zero(ax: Axes) -> None:
    """Means about a line at zero, with room above them for a legend of two entries."""
    ax.axhline(0.0, color=INK, linewidth=0.9)
    top = 1.4 * max(map(abs, ax.get_ylim()))
    ax.set_ylim(-top, top)
    legend(ax, loc="upper left", ncols=2, columnspacing=1.0, handletextpad=0.2)


def key(text: str, color: Any, **keywords: Any) -> Line2D:
    """An entry of a legend that stands for no artist."""
    from matplotlib.lines import Line2D

    return Line2D([], [], color=color, label=text, **keywords)


def legend_on_top(ax: Axes, **keywords: Any) -> None:
    """A legend in a line above the panel."""
    place = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.2, "ncols": 3}
    legend(ax, **(place | keywords))


def legend_above(figure: Figure, handles: Any, **keywords: Any) -> None:
    """One legend for all panels, in a line above them."""
    options: AnyDict = {
        "ncols": len(handles),
        "fontsize": TICK_SIZE,
        "frameon": False,
        "labelcolor": INK,
    }
    figure.legend(handles=handles, **{"loc": "outside upper center", **options, **keywords})


def colour_bar(ax: Axes, image: Any, text: str) -> Any:
    """A colour bar of one panel."""
    bar = ax.figure.colorbar(image, ax=ax, fraction=0.046, pad=0.03)
    dress_bar(bar, text)
    return bar


def dress_bar(bar: Any, text: str) -> None:
    """Label and ticks of a colour bar in the common sizes."""
    bar.set_label(text, fontsize=LABEL_SIZE, color=INK)
    bar.ax.tick_params(labelsize=TICK_SIZE, colors=INK, length=3.0, width=0.7)
    bar.outline.set_visible(False)


def figure_of(ax: Axes) -> Figure:
    """The figure that a panel is on."""
    from matplotlib.figure import Figure

    figure = ax.figure
    # A panel may lie on a part of a figure; what is saved is the whole.
    return figure if isinstance(figure, Figure) else figure.figure


def png_bytes(figure: Figure, dpi: int = DPI) -> bytes:
    """The figure as PNG, without a time stamp: the same figure gives the same bytes."""
    from PIL import Image

    buffer = io.BytesIO()
    # 256 colours are as many as flat grounds, letters and a colour bar need, in a quarter of the
    # bytes.
    picture = Image.fromarray(painted(figure, dpi)).quantize(
        256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE
    )
    colours = np.array(picture.getpalette(), dtype=np.uint8).reshape(-1, 3)
    # A colour of the palette is a mean, and that of the ground would be seen beside the page's
    # white.
    colours[colours.min(axis=1) >= _WHITE] = 255
    picture.putpalette(colours.tobytes())
    picture.save(buffer, format="png", dpi=(dpi, dpi))
    return buffer.getvalue()


# What makes a vector figure half as large: hundredths of a point are finer than any screen or
# printer, letters stand at their x, and nobody asks for the names of groups, glyphs apart.
_SHORTER = tuple(
    (re.compile(pattern), short)
    for pattern, short in (
        (r"<\?xml[^>]*>|<!DOCTYPE[^>]*>|<!--.*?-->|<metadata>.*?</metadata>", ""),
        # Not of numbers below one, which are scales.
        (r"(?<=\.\d\d)(?<![ (-]0\.\d\d)\d+", ""),
        (r" \n", "\n"),
        (r"\n\s*", " "),
        (r"<g id=\"[^\"]*\"", "<g"),
        (r"<g ?/>", ""),
        (r"DejaVuSans-", "g"),
        (r" transform=\"translate\(([-\d.]+) 0\)\"/>", r' x="\1"/>'),
        (r"> ", ">"),
        (r" (?=/?>)", ""),
    )
)


def svg_bytes(figure: Figure) -> bytes:
    """The figure as SVG with its letters as shapes: it looks the same everywhere, and gives the
    same bytes again.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    buffer = io.StringIO()
    with (
        _resolved(figure, DPI),
        rc_context({"svg.hashsalt": "starcal_uq", "svg.fonttype": "path"}),
        single_ticks(figure),
    ):
        svg: Any = FigureCanvasSVG(figure)
        svg.print_svg(buffer, metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    text = buffer.getvalue()
    for pattern, short in _SHORTER:
        text = pattern.sub(short, text)
    return text.encode()


def painted(figure: Figure, dpi: int) -> NDArray[np.uint8]:
    """The figure's pixels (height, width, 3), drawn once, where `Figure.savefig` draws twice."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    with _resolved(figure, dpi):
        agg: Any = FigureCanvasAgg(figure)
        agg.draw()
        # Opaque, as all figures here are.
        return np.ascontiguousarray(np.asarray(agg.buffer_rgba())[..., :3])


@contextmanager
def _resolved(figure: Figure, dpi: int) -> Iterator[None]:
    """Draw a figure at a resolution, on canvases that leave it with the block."""
    canvas, resolution = figure.canvas, figure.dpi
    figure.dpi = dpi
    try:
        yield
    finally:
        figure.dpi = resolution
        figure.set_canvas(canvas)


def _in_notebook() -> bool:
    ipython = sys.modules.get("IPython")
    if ipython is None:
        return False
    shell = ipython.get_ipython()
    return shell is not None and hasattr(shell, "kernel")
