from .profile import AttitudeProfile as AttitudeProfile
from .profile import load_attitude_profile as load_attitude_profile
from .wahba import quest as quest
