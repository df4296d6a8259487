from .merging import consistency_of as consistency_of
from .merging import merge as merge
from .noise_model import NoiseModel as NoiseModel
from .recursive.start import RecursionOptions as RecursionOptions
from .recursive.stream import FilterStep as FilterStep
from .recursive.stream import RecursiveCalibration as RecursiveCalibration
from .screening.result import Screening as Screening
from .screening.screening import screen as screen
