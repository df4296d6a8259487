"""Everything that a reader sees."""
