"""From images to a calibration, in memory."""
