from . import errors as errors
from .status import Check as Check
from .status import Level as Level
from .status import Status as Status
