"""What the paper's commands share: one progress bar for several parts, and the folder that they
write.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from starcal_uq.core.files import atomic_write_bytes, new_folder, write_csv
from starcal_uq.core.types import Progress

if TYPE_CHECKING:
    import pandas as pd


class Bar:
    """One progress bar for several parts, which come in their order; `shares` are their work in
    common units.
    """

    def __init__(self, progress: Progress | None, shares: Mapping[str, int]) -> None:
        self.progress, self.shares = progress, shares
        self.before, self.total = 0, sum(shares.values())

    def part(self, name: str) -> Progress:
        """A progress callback for one part."""
        before, share = self.before, self.shares[name]
        self.before += share

        def move(done: int, total: int) -> None:
            if self.progress is not None:
                self.progress(before + share * done // max(total, 1), self.total)

        return move

    def finish(self, name: str) -> None:
        """A part that has no steps is done."""
        self.part(name)(1, 1)


def write_tables(
    folder: Path, tables: Mapping[str, pd.DataFrame], figures: Mapping[str, bytes]
) -> None:
    """Tables as CSV with all digits, figures as PNG in a folder of their own."""
    pictures = new_folder(new_folder(folder) / "figures")
    for name, png in figures.items():
        atomic_write_bytes(pictures / f"{name}.png", png)
    for name, table in tables.items():
        write_csv(table, folder / f"{name}.csv")
