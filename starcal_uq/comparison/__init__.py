"""Two calibrations held against each other."""
