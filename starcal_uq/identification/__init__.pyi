from .engine import identify as identify
from .result import FrameIdentification as FrameIdentification
from .result import Identification as Identification
