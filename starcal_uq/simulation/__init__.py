"""Data with known truth: stars in frames, and rendered images."""
