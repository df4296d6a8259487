"""From observations to a calibration: likelihoods, solvers, stages."""
