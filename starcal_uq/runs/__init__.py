"""A run on disk, and the steps that fill it."""
