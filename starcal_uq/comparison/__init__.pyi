from .compare import compare_halves as compare_halves
from .result import CameraComparison as CameraComparison
