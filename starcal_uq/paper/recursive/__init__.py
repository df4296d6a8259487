"""Calibration frame by frame: Samaan's filter and Griffith's recursion."""
