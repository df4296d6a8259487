"""Contestants in turns, ratios with spread.

Every contestant has a process of its own, in the interpreter that it needs. The first call (imports,
compilation, caches) is kept apart; then they take turns: A B C A B C, so that a busy machine is busy
for all. A ratio is taken in each turn; given are the median and the quartiles of
these.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
CONTESTANTS = ROOT / "benchmarks" / "contestants"
ONE_THREAD = {
    **dict.fromkeys(
        ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"
    ),
    **dict.fromkeys(("NUMBA_NUM_THREADS", "RAYON_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"),
    "ONE_CORE": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}


@dataclass(frozen=True)
class Contestant:
    """Who is timed."""

    label: str  # Name in the table
    call: str  # ``file:function`` in the folder of contestants
    # "own", "before", "rivals", "cedar" or "system": this interpreter, this one with the package of
    # before, one of the environments of rivals, the system's.
    python: str = "own"
    options: Mapping[str, Any] = field(default_factory=dict)  # Keywords of the function
    environment: Mapping[str, str] = field(default_factory=dict)  # Variables of the environment
    how: str = ""  # What it is made of: extras of the package, libraries of rivals


@dataclass(frozen=True)
class Turn:
    """One call: seconds of wall clock and processor, and what it returned."""

    wall: float
    processor: float
    result: Any = None


@dataclass
class Runs:
    """All calls of one contestant, by turn; `missing` says why there are none."""

    label: str
    turns: dict[int, Turn] = field(default_factory=dict)
    first: Turn | None = None
    peak_mb: float = float("nan")
    missing: str | None = None


class Worker:
    """The process of a contestant."""

    def __init__(
        self,
        call: str,
        options: Mapping[str, Any],
        folder: Path,
        command: Sequence[str],
        environment: Mapping[str, str],
    ) -> None:
        """Start ``file:function`` with its options on the data of a folder; `environment` is added
        to ours.
        """
        file, function = call.split(":")
        arguments = [
            str(CONTESTANTS / "worker.py"),
            file,
            function,
            str(folder),
            json.dumps(dict(options)),
        ]
        self.errors = tempfile.TemporaryFile("w+", encoding="utf-8")  # noqa: SIM115 (closed with the worker)
        self.process = subprocess.Popen(
            [*command, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.errors,
            text=True,
            # Compiled files are kept, as they are for users.
            env={k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
            | dict(environment),
        )
        self.missing: str | None = self._read().get("missing")

    def go(self) -> dict[str, Any]:
        """One call; a failure ends the worker and is kept as `missing`."""
        assert self.process.stdin is not None
        self.process.stdin.write("go\n")
        self.process.stdin.flush()
        answer = self._read()
        self.missing = answer.get("missing") or answer.get("failed")
        return answer

    def end(self) -> None:
        """Let it go."""
        assert self.process.stdin is not None and self.process.stdout is not None
        if self.process.poll() is None:
            self.process.stdin.write("end\n")
        self.process.stdin.close()
        self.process.wait()
        self.process.stdout.close()
        self.errors.close()

    def _read(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if line:
            return dict(json.loads(line))
        self.errors.seek(0)
        said = self.errors.read().strip().splitlines()
        return {"missing": f"its process ended: {said[-1] if said else 'without a word'}"}


def take_turns(
    contestants: Sequence[Contestant],
    repeats: int,
    start: Callable[[Contestant], Worker | str],
    tell: Callable[[str], None] = lambda text: None,
    seconds: float = float("inf"),
) -> list[Runs]:
    """Time contestants in turns; `start` makes the worker of one, or says why there is none.

    No turn but the first begins later than `seconds` after the start.
    """
    began = perf_counter()
    workers = [start(c) for c in contestants]
    runs = [Runs(c.label) for c in contestants]
    try:
        for turn in range(-1, repeats):
            if turn > 0 and perf_counter() - began > seconds:
                break
            for contestant, worker, run in zip(contestants, workers, runs, strict=True):
                if isinstance(worker, str) or worker.missing is not None:
                    run.missing = worker if isinstance(worker, str) else worker.missing
                    continue
                tell(
                    f"{contestant.label}, "
                    f"{'first call' if turn < 0 else f'turn {turn + 1} of {repeats}'}"
                )
                answer = worker.go()
                if worker.missing is not None:
                    run.missing = worker.missing
                    continue
                done = Turn(answer["wall"], answer["processor"], answer["result"])
                run.peak_mb = answer["peak_mb"]
                if turn < 0:
                    run.first = done
                else:
                    run.turns[turn] = done
    finally:
        for worker in workers:
            if not isinstance(worker, str):
                worker.end()
    return runs


@dataclass(frozen=True)
class Ratio:
    """Median over turns, and the quartiles."""

    median: float
    low: float
    high: float


def spread(values: Sequence[float]) -> Ratio:
    """Median and quartiles."""
    low, median, high = np.percentile(np.asarray(values, dtype=float), [25.0, 50.0, 75.0])
    return Ratio(float(median), float(low), float(high))


def ratio(
    rival: Runs, ours: Runs, clock: str, amount: Callable[[Any], float] = lambda result: 1.0
) -> Ratio | None:
    """How many times as long the rival takes for the same amount, turn by turn in which both took
    part.
    """
    common = [t for t in rival.turns if t in ours.turns]
    if not common:
        return None
    return spread(
        [cost(rival.turns[t], clock, amount) / cost(ours.turns[t], clock, amount) for t in common]
    )


def cost(turn: Turn, clock: str, amount: Callable[[Any], float] = lambda result: 1.0) -> float:
    """Seconds for one unit of what was done."""
    return float(getattr(turn, clock)) / amount(turn.result)


def interpreter(python: str, root: Path, cache: Path) -> tuple[list[str], dict[str, str]] | str:
    """Command and environment of an interpreter, or why there is none."""
    if python == "own":
        return [sys.executable], {"PYTHONPATH": str(root)}
    if python == "before":
        if not (cache / "before" / "starcal_uq").is_dir():
            return "the version before is not in this repository's history"
        return [sys.executable], {"PYTHONPATH": str(cache / "before")}
    if python in ("rivals", "cedar"):
        path = cache / python / "bin" / "python"
        # Some of them may be here as well; who is not says so.
        return [str(path if path.exists() else sys.executable)], {}
    path = Path("/usr/bin/python3")
    # mrcal keeps arrays on the stack: 10,000 frames need more of it than the usual 8 MB.
    roomy = ["sh", "-c", 'ulimit -s unlimited; exec "$0" "$@"', str(path)]
    return (roomy, {}) if path.exists() else "there is no /usr/bin/python3"
