"""One table of finished text, for the notebook, the terminal, the page, LaTeX and the workbook.

A table is composed once, where the digits are chosen; the outputs differ in their marks only. The
terminal's own drawing stands in `starcal_uq.cli.console`, which is the only place that knows the
terminal.
"""

from __future__ import annotations

import html
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from starcal_uq.core.formatting import MINUS, significant

if TYPE_CHECKING:
    import pandas as pd


_LOOKS = {"r": 'class="n" style="text-align:right"', "l": 'style="text-align:left"'}


@dataclass(frozen=True)
class TextTable:
    """Rows of finished text under their heads."""

    heads: tuple[str, ...]  # One for each column
    rows: tuple[tuple[str, ...], ...]  # Cells, plain text; digits are chosen already
    title: str = ""  # What the table shows; may be empty
    align: str = ""  # One letter a column: ``l`` for words, ``r`` for numbers
    # One for each row: empty, or ``total``, ``warning``, ``fail``; may be left out altogether.
    marks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.align:
            object.__setattr__(self, "align", "l" + "r" * (len(self.heads) - 1))
        if {len(row) for row in self.rows} - {len(self.heads)} or len(self.align) != len(
            self.heads
        ):
            raise ValueError(
                f"table {self.title!r}: every row, and the alignment, needs {len(self.heads)} "
                "entries"
            )

    @property
    def records(self) -> list[dict[str, str]]:
        """The cells of each row by their heads."""
        return [dict(zip(self.heads, row, strict=True)) for row in self.rows]

    def part(self, heads: Sequence[str], title: str) -> TextTable:
        """Some of its columns, each the first under its head, with a title of their own."""
        places = [self.heads.index(head) for head in heads]
        rows = tuple(tuple(row[place] for place in places) for row in self.rows)
        align = "".join(self.align[place] for place in places)
        return replace(self, heads=tuple(heads), rows=rows, align=align, title=title)

    @classmethod
    def of(
        cls,
        frame: pd.DataFrame,
        title: str = "",
        formats: Mapping[str, Callable[[Any], str]] | None = None,
        missing: str = "–",
    ) -> TextTable:
        """The columns of a data frame; numbers with three digits unless `formats` says otherwise."""
        import numpy as np

        formats = formats or {}

        def cell(name: str, value: Any) -> str:
            if isinstance(value, float) and math.isnan(value):
                return missing
            if name in formats:
                return formats[name](value)
            if isinstance(value, (bool, np.bool_)):
                return "yes" if value else "no"
            return significant(value, 3) if isinstance(value, float) else str(value)

        names = [str(name) for name in frame.columns]
        rows = tuple(
            tuple(cell(name, value) for name, value in zip(names, row, strict=True))
            for row in frame.itertuples(index=False, name=None)
        )
        numbers = [
            np.issubdtype(np.asarray(frame[name]).dtype, np.number) for name in frame.columns
        ]
        return cls(
            tuple(name.replace("_", " ") for name in names),
            rows,
            title,
            "".join("r" if n else "l" for n in numbers),
        )

    def html(
        self, caption: str | None = None, kind: str = "", name: Callable[[str], str] = html.escape
    ) -> str:
        """A ``<table>`` of a class; everything is escaped, but the first column is left to
        `name`.
        """
        looks = [
            'class="unit" style="text-align:left"' if head.lower() == "unit" else _LOOKS[side]
            for head, side in zip(self.heads, self.align, strict=True)
        ]

        def line(tag: str, cells: Sequence[str], mark: str = "") -> str:
            parts = (
                f"<{tag} {look}>{cell}</{tag}>" for cell, look in zip(cells, looks, strict=True)
            )
            return f"<tr{f' class={mark!r}' if mark else ''}>{''.join(parts)}</tr>"

        title = self.title if caption is None else caption
        above = f"<caption>{html.escape(title)}</caption>" if title else ""
        opening = f'<table class="{kind}">' if kind else "<table>"
        head = line("th", [html.escape(head) for head in self.heads])
        body = "".join(
            line("td", [name(row[0]), *map(html.escape, row[1:])], mark)
            for row, mark in zip(self.rows, self.marks or [""] * len(self.rows), strict=True)
        )
        return f"{opening}{above}<thead>{head}</thead><tbody>{body}</tbody></table>"

    def markdown(self) -> str:
        """A table of Markdown with pipes, aligned as the columns are."""

        def line(cells: Sequence[str]) -> str:
            return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"

        rule = line([":--" if side == "l" else "--:" for side in self.align])
        return "\n".join([line(self.heads), rule, *map(line, self.rows)])

    def latex(self) -> str:
        """A ``tabular`` with the rules of booktabs; everything is escaped."""

        def line(cells: Sequence[str]) -> str:
            return " & ".join(tex(cell) for cell in cells) + r" \\"

        body = "\n".join(line(row) for row in self.rows)
        return (
            f"\\begin{{tabular}}{{{self.align}}}\n\\toprule\n{line(self.heads)}\n\\midrule\n{body}\n"
            "\\bottomrule\n\\end{tabular}"
        )


_TEX = {
    "\\": r"\textbackslash{}",
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    # After the end of a row, a bracket would be read as the space to leave.
    "[": "{[}",
    "]": "{]}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    MINUS: "$-$",
    "×": r"$\times$",
    "±": r"$\pm$",
    "≥": r"$\geq$",
    "≤": r"$\leq$",
    "σ": r"$\sigma$",
    "°": r"\textdegree{}",
    "″": r"$''$",
    "–": "--",
    "“": "``",
    "”": "''",
    "’": "'",
    "…": r"\ldots{}",
    "∞": r"$\infty$",
    "µ": r"$\mu$",
    "μ": r"$\mu$",
    "\N{NO-BREAK SPACE}": "~",
    "\N{NARROW NO-BREAK SPACE}": r"\,",
}
_SUPERSCRIPTS = "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"
_PLAIN = str.maketrans(_SUPERSCRIPTS, "-0123456789")


def tex(value: Any) -> str:
    """Text with everything escaped that LaTeX would read as a command."""
    parts = re.split(f"([{_SUPERSCRIPTS}]+)", str(value))
    return "".join(
        f"$^{{{part.translate(_PLAIN)}}}$"
        if index % 2
        else "".join(_TEX.get(sign, sign) for sign in part)
        for index, part in enumerate(parts)
    )
