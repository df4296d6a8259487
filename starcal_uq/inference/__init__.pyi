from .named import NaivePairsWarning as NaivePairsWarning
from .power_scaling import prior_sensitivity as prior_sensitivity
from .prior_draws import prior_predictive as prior_predictive
from .priors import GaussianPriors as GaussianPriors
from .priors import PhysicalPriors as PhysicalPriors
from .update import AllowedShift as AllowedShift
from .update import prior_from as prior_from
from .update import shift_test as shift_test
