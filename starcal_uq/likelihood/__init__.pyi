from .composed import Likelihood as Likelihood
from .composed import StarDirections as StarDirections
from .composed import StudentTails as StudentTails
