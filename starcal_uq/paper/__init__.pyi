from .camera import paper_camera as paper_camera
from .camera import paper_start as paper_start
from .interaction import InteractionStudy as InteractionStudy
from .interaction import interaction_study as interaction_study
from .replicates import Replicates as Replicates
from .replicates import replicate as replicate
from .reproduction import reproduce as reproduce
from .result import Reproduction as Reproduction
