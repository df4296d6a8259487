from .composed import FixedMount as FixedMount
from .composed import Likelihood as Likelihood
from .composed import StarDirections as StarDirections
from .composed import StudentTails as StudentTails
from .noise_model import NoiseModel as NoiseModel
