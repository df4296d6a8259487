"""The sums over frames as loops compiled by Numba: the same numbers as the NumPy path, several
times faster.

A function is compiled once for each distortion model, whose name is a literal argument and brings
the model's kernels along; the number of parameters is the length of the tuple `theta`. Numba keeps
the machine code beside the source, or where ``NUMBA_CACHE_DIR`` says. What has a fixed number of
terms is written out by `starcal_uq.likelihood.loops.unrolled`, so that sums stay in registers.
Stars are visited in chunks whose columns stay in the first cache; a column is a row of `STRIDE`
numbers in one buffer. `starcal_uq.likelihood.paths` is the door: this package imports Numba.
"""

from starcal_uq.likelihood.loops.frames import frame_loop, turned_loop
from starcal_uq.likelihood.loops.gram import gram_loop
from starcal_uq.likelihood.loops.pairs import attitude_loop, pair_loop

__all__ = ["attitude_loop", "frame_loop", "gram_loop", "pair_loop", "turned_loop"]
