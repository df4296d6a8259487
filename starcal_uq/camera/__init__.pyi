from .distortion import Coefficient as Coefficient
from .distortion import DistortionModel as DistortionModel
from .distortion import model_names as model_names
from .projection import project as project
from .projection import unproject as unproject
