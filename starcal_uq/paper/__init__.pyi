from .camera import paper_camera as paper_camera
from .camera import paper_start as paper_start
from .interaction import interaction_study as interaction_study
from .interaction_result import InteractionStudy as InteractionStudy
from .replicates import replicate as replicate
from .replicates_result import Replicates as Replicates
from .reproduction import reproduce as reproduce
from .result import Reproduction as Reproduction
