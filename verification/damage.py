"""What becomes of damaged files: the long campaign, by one command.

    python -m verification.damage [--text 100000] [--binary 10000] [--only NAME ...] [--processes 2]
    [--show] [--write]

Every kind of file that the package reads (`tests/damage/samples.py`) is damaged, a seed each, and
loaded: binary kinds that many times, and the kinds of text that one function reads that many times
together. What was done is kept in `.bench/damage`, a file for every few thousand seeds: a campaign
that is stopped resumes, and a larger one takes in a smaller one. A process may take 1 GB beyond
what it has before, and a file 20 s; one that dies is counted with its seed. ``--show`` prints what
was wrong, ``--write`` puts the table into the documentation (`docs/explanation/reliability.md`).
Without ``--text`` and ``--binary`` nothing new is tried.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import Any

from benchmarks.pages import put
from tests.damage.judging import Bench, Outcome
from tests.damage.samples import LAST, SAMPLES, Sample, write_samples

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / ".bench" / "damage"
PAGE = ROOT / "docs" / "explanation" / "reliability.md"
# A process takes seconds to load what it needs.
FIRST, CHUNK = (0, 1000, 10_000), 15_000
LONGEST_S, MOST_BYTES = 20.0, 2**30
KINDS = ("refused", "same", "other", "wrong")
BAD = ("words", "escaped", "slow", "died")


class TooLong(BaseException):
    """A file took too long; no loader may catch this."""


def _too_long(*_: Any) -> None:
    raise TooLong


def work(folder: Path, name: str, first: int, last: int) -> None:
    """Try the seeds [first, last) of a sample, and print what became of them; in a process of its
    own.
    """
    bench, sample = Bench(folder), next(s for s in SAMPLES if s.file == name)
    bench.valid(sample)
    pages = (
        int(Path("/proc/self/statm").read_text().split()[0])
        if os.path.exists("/proc/self/statm")
        else 0
    )
    if pages:
        limit = pages * resource.getpagesize() + MOST_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    signal.signal(signal.SIGALRM, _too_long)
    counts: Counter[str] = Counter()
    bad: list[tuple[int, str, str]] = []
    place = os.open(folder / "seed", os.O_WRONLY | os.O_CREAT)
    slowest = 0.0
    for seed in range(first, last):
        # Where it was, if the process dies.
        os.pwrite(place, f"{seed:12d}".encode(), 0)
        signal.setitimer(signal.ITIMER_REAL, LONGEST_S)
        start = time.process_time()
        try:
            outcome = bench.damaged(sample, random.Random(f"{name} {seed}"))[1]
        except TooLong:
            outcome = Outcome("slow", f"more than {LONGEST_S:g} s")
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        slowest = max(slowest, time.process_time() - start)
        counts[outcome.kind] += 1
        if outcome.kind in BAD:
            bad.append((seed, outcome.kind, outcome.detail))
    print(json.dumps({"counts": counts, "bad": bad[:50], "slowest_s": round(slowest, 3)}))


def tried(name: str, first: int, last: int, out: Path) -> dict[str, Any]:
    """What became of the seeds [first, last); from the file that keeps it, if they were tried
    before.
    """
    kept = out / f"{name}-{first}-{last}.json"
    if kept.exists():
        result: dict[str, Any] = json.loads(kept.read_text("utf-8"))
        return result
    # Files of a moment are written into memory where the system offers that.
    with tempfile.TemporaryDirectory(
        dir="/dev/shm" if os.path.isdir("/dev/shm") else None
    ) as folder:
        result = _tried(name, first, last, out, Path(folder))
    kept.write_text(json.dumps(result) + "\n", "utf-8")
    return result


def _tried(name: str, first: int, last: int, out: Path, folder: Path) -> dict[str, Any]:
    (folder / "valid").symlink_to((out / "valid").resolve())
    command = [
        sys.executable,
        "-m",
        "verification.damage",
        "--work",
        str(folder),
        name,
        str(first),
        str(last),
    ]
    environment = {
        **os.environ,
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        "XDG_CACHE_HOME": str(out / "cache"),
    }
    process = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=ROOT)
    if process.returncode == 0:
        done: dict[str, Any] = json.loads(process.stdout.splitlines()[-1])
        return done
    if not (folder / "seed").exists():
        raise SystemExit(f"the samples cannot be loaded:\n{process.stderr[-2000:]}")
    seed = int((folder / "seed").read_text())
    words = (process.stderr.strip().splitlines() or [""])[-1][:200]
    result: dict[str, Any] = {
        "counts": {"died": 1},
        "bad": [(seed, "died", f"{process.returncode}: {words}")],
        "slowest_s": 0,
    }
    for part in ((first, seed), (seed + 1, last)):
        if part[0] < part[1]:
            result = _sum([result, tried(name, *part, out)])
    return result


def _sum(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    return {
        "counts": dict(sum((Counter(part["counts"]) for part in parts), Counter())),
        "bad": [tuple(bad) for part in parts for bad in part["bad"]],
        "slowest_s": max(part["slowest_s"] for part in parts),
    }


def campaign(
    samples: Sequence[Sample], text: int, binary: int, processes: int, out: Path
) -> dict[str, dict[str, Any]]:
    """Try all that was not tried; what is known of every sample, that of earlier campaigns
    included.
    """
    out.mkdir(parents=True, exist_ok=True)
    if not (out / "valid" / LAST).exists():
        (out / "valid").mkdir(exist_ok=True)
        write_samples(out / "valid")
    # All kinds a little first: whoever looks early sees something of each.
    edges = [*FIRST, *range(FIRST[-1] + CHUNK, max(text, binary) + CHUNK, CHUNK)]
    kinds = Counter(sample.reads[0] for sample in SAMPLES if not sample.binary)
    wanted = {s.file: binary if s.binary else math.ceil(text / kinds[s.reads[0]]) for s in samples}
    jobs = [
        (sample.file, first, min(last, wanted[sample.file]))
        for first, last in pairwise(edges)
        for sample in samples
        if first < wanted[sample.file]
    ]
    start = time.monotonic()
    with ThreadPoolExecutor(processes) as pool:
        for done, (job, result) in enumerate(
            zip(jobs, pool.map(lambda job: tried(*job, out), jobs), strict=True), 1
        ):
            bad = sum(result["counts"].get(kind, 0) for kind in BAD)
            print(
                (
                    f"{done}/{len(jobs)} {time.monotonic() - start:.0f} s  {job[0]} "
                    f"{job[1]}-{job[2]}: {bad} bad"
                ),
                flush=True,
            )
    return {
        sample.file: _sum(parts) for sample in samples if (parts := list(_kept(sample.file, out)))
    }


def _kept(name: str, out: Path) -> Iterator[dict[str, Any]]:
    """All that was tried of a sample, each seed once: parts in a larger part are passed over."""
    ranges = sorted(
        (int(first), -int(last), path)
        for path in out.glob(f"{name}-*.json")
        for first, last in [path.stem.rsplit("-", 2)[1:]]
    )
    end = 0
    for first, last, path in ranges:
        if first >= end:
            end = -last
            yield json.loads(path.read_text("utf-8"))


def _judged(counts: dict[str, int]) -> Counter[str]:
    """Counts by `KINDS`."""
    return Counter(
        {kind: counts.get(kind, 0) for kind in KINDS[:-1]}
        | {"wrong": sum(counts.get(k, 0) for k in BAD)}
    )


def table(results: dict[str, dict[str, Any]]) -> str:
    """The results in Markdown: of files of text, binary files, and all."""
    lines = [
        "|  | Files | Damaged | Refused | Wrong | Slowest, s |",
        "|---|---|" + "---:|" * 4,
    ]
    tried = [sample for sample in SAMPLES if sample.file in results]
    groups = {
        "text": [sample.file for sample in tried if not sample.binary],
        "binary": [sample.file for sample in tried if sample.binary],
        "**all**": [sample.file for sample in tried],
    }
    for name, files in groups.items():
        counts = sum((_judged(results[file]["counts"]) for file in files), Counter[str]())
        slowest = max((results[file]["slowest_s"] for file in files), default=0.0)
        numbers = (counts.total(), counts["refused"], counts["wrong"])
        cells = " | ".join(f"{number:,}" for number in numbers)
        shown = len(files) if name == "**all**" else ", ".join(files)
        lines.append(f"| {name} | {shown} | {cells} | {slowest:.2f} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--text", type=int, default=0, help="damaged files of each reader of text")
    parser.add_argument("--binary", type=int, default=0, help="damaged files of each binary kind")
    parser.add_argument("--only", nargs="+", default=[], help="files, or parts of their names")
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--out", type=Path, default=OUT, help="folder that keeps what was tried")
    parser.add_argument("--show", action="store_true", help="print what was wrong, with its seed")
    parser.add_argument("--write", action="store_true", help="put the table into the documentation")
    parser.add_argument("--work", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.work:
        folder, name, first, last = options.work
        work(Path(folder), name, int(first), int(last))
        return
    samples = [
        s for s in SAMPLES if not options.only or any(part in s.file for part in options.only)
    ]
    results = campaign(samples, options.text, options.binary, options.processes, options.out)
    made = table(results)
    print(made)
    if options.show:
        for name, result in results.items():
            for seed, kind, detail in result["bad"]:
                print(f"{name} seed {seed}: {kind}: {detail}")
    if options.write:
        put(PAGE, "damage", made)


if __name__ == "__main__":
    main()
