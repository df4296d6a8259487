"""Likelihoods of identified stars, their sums, and the solvers that maximise them."""
