"""Figures and pages of the paper's experiments."""
