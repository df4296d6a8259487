from .engine import identify as identify
from .result import FoundOptics as FoundOptics
from .result import FrameIdentification as FrameIdentification
from .result import Identification as Identification
