from .duplicates import repeated_frames as repeated_frames
from .merging import consistency_of as consistency_of
from .merging import merge as merge
from .settings import EstimationSettings as EstimationSettings
