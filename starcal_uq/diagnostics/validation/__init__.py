"""Simulation-based calibration for one's own sensor."""
