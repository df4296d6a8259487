"""The mission's attitude error budget."""
