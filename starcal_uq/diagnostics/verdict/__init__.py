"""Every check of a run, and what follows from them."""
