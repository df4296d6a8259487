from .screening.result import Screening as Screening
from .screening.screening import screen as screen
