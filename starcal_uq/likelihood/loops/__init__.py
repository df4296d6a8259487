"""The sums over frames as loops compiled by Numba: the same numbers as the NumPy path, several
times faster.

The loops know no model and no number of parameters: they are compiled once. What does, the kernels
and the columns made of them, are functions of a chunk of stars (`common.star_function`), which
`starcal_uq.likelihood.loops.unrolled` writes out and the loops call by their address. Products of
columns are summed three by three, so that sums stay in registers. Numba keeps the machine code
beside the source, or where ``NUMBA_CACHE_DIR`` says. Stars are visited in chunks whose columns stay
in the first cache; a column is a row of `STRIDE` numbers in one buffer.
`starcal_uq.likelihood.paths` is the door: this package imports Numba.
"""

import logging

from starcal_uq.likelihood.loops.frames import gram, normals, slope
from starcal_uq.likelihood.loops.pairs import attitudes, pairs

__all__ = ["attitudes", "gram", "normals", "pairs", "slope"]

logging.getLogger(__name__).info(
    "Loading compiled loops; compiling them at first use takes a few seconds."
)
