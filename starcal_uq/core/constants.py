"""Constants and names of columns that every wing shares."""

from __future__ import annotations

import math

# Arc seconds in a radian.
ARCSEC = 648_000.0 / math.pi
LIGHT_SPEED_KM_S = 299792.458
AU_KM = 149597870.7

# Axes of an attitude error: left rotation vectors about camera +X, +Y and the boresight +Z.
AXES = ("pitch", "yaw", "roll")
CROSS_BORESIGHT = "cross-boresight"
TOTAL_AXES = (*AXES, CROSS_BORESIGHT)

# Row of an attitude budget that calibration and noise make together.
INTERACTION = "interaction, calibration and noise"
