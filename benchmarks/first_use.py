"""Processor time of the first use of the compiled loops.

A process with an empty folder of machine code calibrates 60 frames, and another one does the same
with what the first has left there: the difference is what compiling costs, the second what loading
does beside NumPy's path. Each round begins anew; given are the median and the range. ``PYTHONPATH``
decides which version is measured.

    python benchmarks/first_use.py --rounds 5
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile

JOB = """
import dataclasses, sys
import starcal_uq as sc
truth = sc.paper.paper_camera()
truth = truth.replace(distortion=sys.argv[1], coefficients=(0.0,) * (int(sys.argv[2]) - 3))
obs = sc.simulate(sc.load_catalogue(max_mag=6.0), truth, n_frames=60, seed=1)
assert sc.calibrate(obs, truth).provenance["kernels"] == sys.argv[3]
"""


def seconds(model: str, path: str, folder: str) -> float:
    """Processor time of one process on one thread."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    environment = os.environ | threads | {"NUMBA_CACHE_DIR": folder, "STARCAL_UQ_KERNELS": path}
    before = os.times()
    size = {"none": 3, "brown": 5, "brown3": 6, "brown_tangential": 7, "inverse": 5}[model]
    subprocess.run([sys.executable, "-c", JOB, model, str(size), path], env=environment, check=True)
    after = os.times()
    return sum(getattr(after, k) - getattr(before, k) for k in ("children_user", "children_system"))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default="brown")
    parser.add_argument("--rounds", type=int, default=5)
    given = parser.parse_args()
    compiling, loading = [], []
    for _ in range(given.rounds):
        with tempfile.TemporaryDirectory() as folder:
            first, again, plain = (
                seconds(given.model, path, folder) for path in ("numba", "numba", "numpy")
            )
        compiling.append(first - again)
        loading.append(again - plain)
    for label, times in (("compiling", compiling), ("loading", loading)):
        low, middle, high = min(times), statistics.median(times), max(times)
        print(f"{label}: {middle:.2f} s of processor time ({low:.2f} to {high:.2f})")


if __name__ == "__main__":
    main()
