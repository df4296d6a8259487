"""The outcome of a comparison in sentences and tables."""

from __future__ import annotations

from starcal_uq.comparison.result import CameraComparison
from starcal_uq.presentation.tables import TextTable


def comparison_table(found: CameraComparison) -> TextTable:
    """One row per quantity: the difference, and what was to be expected."""
    return TextTable.of(found.to_dataframe(), f"{found.labels[1]} minus {found.labels[0]}")
