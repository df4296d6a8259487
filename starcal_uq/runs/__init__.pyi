from .compare import compare_runs as compare_runs
from .compare import compare_split as compare_split
from .exchange import export as export
from .folder import RunFolder as RunFolder
from .merge import merge_runs as merge_runs
from .priors import load_priors as load_priors
from .priors import prior_from_run as prior_from_run
from .steps.mission import MissionSky as MissionSky
