"""A task for worker processes, which import this file and nothing else of the tests."""

from __future__ import annotations

import os
import time


def numbered(index: int) -> tuple[int, str | None]:
    """The square of the number, and how many BLAS threads this process may start, after a hundredth
    of a second.
    """
    time.sleep(0.01)
    return index**2, os.environ.get("OPENBLAS_NUM_THREADS")
