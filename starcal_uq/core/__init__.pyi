from . import errors as errors
from .progress import ProgressBar as ProgressBar
from .status import Check as Check
from .status import Level as Level
from .status import Status as Status
