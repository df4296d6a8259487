from .noise_model import NoiseModel as NoiseModel
from .ties import FixedMount as FixedMount
