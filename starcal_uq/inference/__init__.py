"""From a calibration to a posterior: priors, sampling, and the checks of the draws."""
