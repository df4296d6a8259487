"""The budget section of the report."""

from __future__ import annotations

from starcal_uq.presentation.pages.budget_tables import budget_context

__all__ = ["budget_context"]
