"""Rotations, QUEST, and attitudes over time."""
