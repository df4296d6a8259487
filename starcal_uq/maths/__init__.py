"""Linear algebra of badly scaled matrices, tails, ranks and intervals."""
