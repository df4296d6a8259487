"""Figures to pixels: Matplotlib's Agg with letters by Pillow, which sets and paints a label in a tenth of the time."""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import Any, cast

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

_POINTS = 72.0


def painted(figure: Figure, dpi: int) -> NDArray[np.uint8]:
    """The figure's pixels (height, width, 3), drawn once, where `Figure.savefig` draws twice."""
    canvas, resolution = figure.canvas, figure.dpi
    try:
        figure.dpi = dpi
        agg: Any = _Canvas(figure)
        agg.draw()
        pixels = np.asarray(agg.buffer_rgba())
        # Opaque, as all figures here are.
        return np.asarray(Image.frombuffer("RGBA", pixels.shape[1::-1], pixels, "raw", "RGBX", 0, 1).convert("RGB"))
    finally:
        figure.dpi = resolution
        figure.set_canvas(canvas)


class _Renderer(RendererAgg):
    def draw_text(
        self, gc: Any, x: float, y: float, s: str, prop: Any, angle: float, ismath: Any = False, mtext: Any = None
    ) -> None:
        font = None if ismath or angle not in (0.0, 90.0) else _font(prop, self.dpi, s)
        if font is None:
            agg: Any = super()
            agg.draw_text(gc, x, y, s, prop, angle, ismath, mtext)
            return
        cover, left, top = _letters(font, s)
        below = top + len(cover)
        if angle:
            cover, left, below = np.rot90(cover), top, -left
        red, green, blue, alpha = gc.get_rgb()
        image = np.empty((*cover.shape, 4), dtype=np.uint8)
        image[..., :3] = np.round(255.0 * np.array([red, green, blue]))
        image[..., 3] = np.round((gc.get_alpha() if gc.get_forced_alpha() else alpha) * cover)
        # Of text, y counts down, of images up, and so do their rows.
        self.draw_image(gc, round(x + left), round(self.height - y - below), image[::-1].copy())

    def get_text_width_height_descent(self, s: str, prop: Any, ismath: Any) -> tuple[float, float, float]:
        font = None if ismath else _font(prop, self.dpi, s)
        if font is None:
            agg: Any = super()
            return cast(tuple[float, float, float], agg.get_text_width_height_descent(s, prop, ismath))
        left, top, right, bottom = font.getbbox(s, anchor="ls")
        return right - left, bottom - top, bottom


class _Canvas(FigureCanvasAgg):
    @cached_property
    def _painter(self) -> _Renderer:
        renderer: Any = _Renderer
        return cast(_Renderer, renderer(*self.get_width_height(physical=True), self.figure.dpi))

    def get_renderer(self) -> _Renderer:
        return self._painter


def _font(properties: FontProperties, dpi: float, text: str) -> ImageFont.FreeTypeFont | None:
    """Pillow's font in Matplotlib's place; None where it lacks a letter, for which Matplotlib looks elsewhere."""
    path = findfont(properties)
    if not _characters(path).issuperset(text):
        return None
    return _sized(path, properties.get_size_in_points() * dpi / _POINTS)


@lru_cache(maxsize=64)
def _sized(path: str, size: float) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(path, size, layout_engine=ImageFont.Layout.BASIC)


@lru_cache(maxsize=16)
def _characters(path: str) -> frozenset[str]:
    return frozenset(map(chr, get_font(path).get_charmap()))


@lru_cache(maxsize=1024)
def _letters(font: ImageFont.FreeTypeFont, text: str) -> tuple[NDArray[np.uint8], float, float]:
    """How far each pixel of a box is covered (height, width), 0 to 255; the box's left and top from the start."""
    left, top, right, bottom = font.getbbox(text, anchor="ls")
    image = Image.new("L", (max(1, round(right - left)), max(1, round(bottom - top))))
    ImageDraw.Draw(image).text((-left, -top), text, fill=255, font=font, anchor="ls")
    return np.asarray(image), left, top
