from .check import ForecastCheck as ForecastCheck
from .check import check_forecast as check_forecast
from .design import FrameChoice as FrameChoice
from .design import choose_frames as choose_frames
from .open_distortion import DistortionRange as DistortionRange
from .planned import Plan as Plan
from .ties import PlannedTies as PlannedTies
