from .heads import FusedAttitudes as FusedAttitudes
from .heads import HeadArray as HeadArray
from .heads import load_heads as load_heads
from .profile import AttitudeProfile as AttitudeProfile
from .profile import load_attitude_profile as load_attitude_profile
from .relative import RelativeAttitudes as RelativeAttitudes
from .relative import load_relative_attitudes as load_relative_attitudes
from .wahba import quest as quest
