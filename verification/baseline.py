"""The results of one version, stored, and two versions compared.

``make FOLDER`` runs small jobs with one seed on one thread, each command in a process of its own,
and stores what they write and print: tables, documents, arrays, figures, sentences, and the surface
(public names, options, keys of JSON). ``compare BEFORE AFTER`` prints the largest difference of each
array, every sentence that changed, and what vanished or appeared; its exit status is 1 if anything
differs by more than the tolerance. ``PYTHONPATH`` decides which version is measured, because nothing
of the package is imported here.

    PYTHONPATH=BEFORE python verification/baseline.py make /tmp/before
    PYTHONPATH=AFTER python verification/baseline.py make /tmp/after
    python verification/baseline.py compare /tmp/before /tmp/after
"""

from __future__ import annotations

import argparse
import difflib
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

from verification.baseline_facts import NUMBER, Cleaner, Facts, files, read  # noqa: E402
from verification.baseline_jobs import JOBS, Job  # noqa: E402

RECORD = "job.json"
ENVIRONMENT = {
    **dict.fromkeys(
        ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
    ),
    "COLUMNS": "110",
    "NO_COLOR": "1",
    "TERM": "dumb",
    "MPLBACKEND": "Agg",
    "PYTHONHASHSEED": "0",
    "SOURCE_DATE_EPOCH": "0",
    "STARCAL_UQ_KERNELS": "numpy",
}


def make(folder: Path, jobs: list[Job], seed: int, data: Path) -> int:
    """Run the jobs and store what each left in a folder of its name."""
    folder.mkdir(parents=True, exist_ok=True)
    failed = 0
    for job in jobs:
        missing = [name for name in job.data if not (data / name).exists()]
        if missing:
            print(f"{job.name}: left out, {data} has no {missing[0]} (--data)", flush=True)
            continue
        # The path has always the same length, because terminals wrap lines that hold it.
        work = Path(tempfile.mkdtemp(prefix="baseline-"))
        try:
            record = run_job(job, work, seed, data)
            (work / RECORD).write_text(json.dumps(record, indent=1), "utf-8")
            shutil.rmtree(folder / job.name, ignore_errors=True)
            shutil.copytree(work, folder / job.name)
        finally:
            shutil.rmtree(work, ignore_errors=True)
        bad = [step["line"] for step in record["steps"] if step["status"] not in (0, 1, 2)]
        failed += len(bad)
        spent = ", ".join([f"{record['seconds']:.1f} s", *(f"FAILED: {line}" for line in bad)])
        print(f"{job.name}: {spent}", flush=True)
    return int(failed > 0)


def processor() -> float:
    """Seconds of processor time that commands have taken so far."""
    used = os.times()
    return used.children_user + used.children_system


def run_job(job: Job, work: Path, seed: int, data: Path) -> dict[str, Any]:
    """The lines of a job, run in a folder."""
    for name in job.data:
        source = data / name
        (shutil.copytree if source.is_dir() else shutil.copy2)(source, work / name)
    (work / "terminal").mkdir()
    environment = os.environ | ENVIRONMENT
    started, clock, steps = datetime.now(UTC), processor(), []
    for line in job.lines:
        head, _, rest = line.partition("\n")
        variable = re.fullmatch(r"([A-Z_]+)=(\S+)", line)
        if variable:
            environment[variable[1]] = variable[2]
        elif head.startswith("file "):
            (work / head.removeprefix("file ")).write_text(rest, "utf-8")
        else:
            words = ["-c", rest.format(seed=seed)]
            if head != "python":
                words = ["-m", "starcal_uq", *shlex.split(line.format(seed=seed))]
            begun = processor()
            made = subprocess.run(
                [sys.executable, *words],
                cwd=work,
                env=environment,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                check=False,
            )
            head = head.format(seed=seed)
            steps.append({"line": head, "status": made.returncode, "seconds": processor() - begun})
            number = f"{len(steps):02d}-{head.split()[0].strip('-')}"
            parts = [
                f"$ {head}",
                f"status {made.returncode}",
                "",
                made.stdout.decode(),
                "--- standard error",
                made.stderr.decode(),
            ]
            (work / "terminal" / f"{number}.txt").write_text("\n".join(parts), "utf-8")
    for name in job.data:
        (shutil.rmtree if (work / name).is_dir() else os.unlink)(work / name)
    return {
        "work": str(work),
        "seed": seed,
        "started": started.isoformat(),
        "ended": datetime.now(UTC).isoformat(),
        "seconds": processor() - clock,
        "pythonpath": os.environ.get("PYTHONPATH", ""),
        "steps": steps,
    }


@dataclass(frozen=True)
class Difference:
    """Two arrays of one name: how far apart."""

    name: str
    absolute: float
    relative: float
    sigmas: float | None = None
    shapes: str = ""

    @property
    def size(self) -> float:
        """What the tolerance is for: in sigmas where there are some, else of the largest value."""
        return np.inf if self.shapes else self.relative if self.sigmas is None else self.sigmas

    def __str__(self) -> str:
        if self.shapes:
            return f"{self.name}: {self.shapes}"
        sigmas = "" if self.sigmas is None else f", {self.sigmas:.3g} sigma"
        return f"{self.name}: {self.absolute:.3g}, {self.relative:.3g} of the largest{sigmas}"


def difference(
    name: str, before: np.ndarray, after: np.ndarray, sigma: np.ndarray | None
) -> Difference | None:
    """How far two arrays are apart; None where they are the same, bit for bit."""
    if before.shape != after.shape:
        return Difference(name, np.inf, np.inf, shapes=f"shape {before.shape} -> {after.shape}")
    if np.array_equal(
        before, after, equal_nan=before.dtype.kind in "fc" and after.dtype.kind in "fc"
    ):
        return None
    b, a = np.asarray(before, dtype=float), np.asarray(after, dtype=float)
    other = np.isfinite(b) != np.isfinite(a)
    if other.any():
        return Difference(
            name, np.inf, np.inf, shapes=f"{other.sum()} values are finite in one alone"
        )
    far = np.where(
        np.isfinite(b), np.abs(np.nan_to_num(a) - np.nan_to_num(b)), np.where(a == b, 0.0, np.nan)
    )
    absolute = float(np.nanmax(far))
    largest = float(np.max(np.abs(b[np.isfinite(b)]), initial=0.0))
    relative = absolute / largest if largest else np.inf
    sigmas = None
    if sigma is not None and np.all(np.isfinite(sigma)) and np.all(sigma > 0):
        sigmas = float(np.nanmax(far / sigma))
    return Difference(name, absolute, relative, sigmas)


def compare_files(before: Facts, after: Facts, tolerance: float) -> Iterator[tuple[bool, str]]:
    """Lines that say what differs, each with whether it counts."""
    names = [facts.arrays.keys() | facts.words.keys() for facts in (before, after)]
    for name in alone(names[0], names[1]):
        yield True, f"vanished: {name}"
    for name in alone(names[1], names[0]):
        yield True, f"appeared: {name}"
    both = [name for name in before.arrays if name in after.arrays]
    found = (
        difference(name, before.arrays[name], after.arrays[name], before.sigmas.get(name))
        for name in both
    )
    for apart in sorted((d for d in found if d), key=lambda d: -d.size):
        yield apart.size > tolerance, str(apart)
    for name in (
        before.arrays.keys() & after.words.keys() | before.words.keys() & after.arrays.keys()
    ):
        yield True, f"another kind: {name}"
    for name in before.words:
        if name in after.words and before.words[name] != after.words[name]:
            for counts, line in changed(before.words[name], after.words[name], tolerance):
                yield counts, line if name == "lines" else f"{name}: {line}"


def alone(names: Set[str], others: Set[str]) -> list[str]:
    """Keys that `others` lack; of a part of a document that lacks as a whole, its key."""

    def above(key: str) -> list[str]:
        parts = key.split("/")
        return ["/".join(parts[: n + 1]) for n in range(len(parts))]

    known = {part for key in others for part in above(key)}
    found = {next(p for p in above(key) if p not in known or p == key) for key in names - others}
    return sorted(found)


def changed(
    before: list[str], after: list[str], tolerance: float = 0.0
) -> Iterator[tuple[bool, str]]:
    """Lines that vanished (-) and appeared (+), in their order, and whether they count."""
    matcher = difflib.SequenceMatcher(None, before, after, autojunk=False)
    for kind, i, j, k, m in matcher.get_opcodes():
        if kind == "equal":
            continue
        for n in range(max(j - i, m - k)):
            old = before[i + n] if i + n < j else None
            new = after[k + n] if k + n < m else None
            start = _apart(old, new)
            counts = not _near(old, new, tolerance)
            for sign, line in (("-", old), ("+", new)):
                if line is not None:
                    yield counts, f"{sign} {_cut(line, start)}"


def _near(old: str | None, new: str | None, tolerance: float) -> bool:
    """Whether two lines have the same words, and numbers that are as near as the tolerance."""
    if not tolerance or old is None or new is None:
        return False
    if re.sub(NUMBER, "#", old) != re.sub(NUMBER, "#", new):
        return False
    a, b = (
        np.array([float(number.replace("−", "-")) for number in re.findall(NUMBER, line)])
        for line in (old, new)
    )
    return bool(np.all(np.abs(a - b) <= tolerance * np.max(np.abs(a), initial=0.0)))


def _apart(old: str | None, new: str | None) -> int:
    if old is None or new is None:
        return 0
    return next(
        (n for n, (a, b) in enumerate(zip(old, new, strict=False)) if a != b),
        min(len(old), len(new)),
    )


def _cut(line: str, start: int, width: int = 240) -> str:
    first = max(0, start - width // 3)
    return (
        ("..." if first else "")
        + line[first : first + width]
        + ("..." if len(line) > first + width else "")
    )


@dataclass(frozen=True)
class Settings:
    """What differs, and how much of it is printed."""

    tolerance: float = 0.0
    most: int = 20
    replaced: Sequence[tuple[str, str]] = ()


def compare(before: Path, after: Path, only: list[str], settings: Settings) -> int:
    """Print what differs between two folders that `make` wrote."""
    known = [
        {path.parent.name for path in folder.glob(f"*/{RECORD}")} for folder in (before, after)
    ]
    names = [name for name in sorted(known[0] & known[1]) if not only or name in only]
    for name in sorted(known[0] ^ known[1]):
        if only and name not in only:
            continue
        print(f"{name}: not compared, made in one of the folders alone")
    if not names:
        print("Nothing to compare.")
        return 1
    counted = 0
    for name in names:
        counted += compare_job(before / name, after / name, settings)
    print(f"{counted} differences beyond {settings.tolerance:g} in {len(names)} jobs")
    return int(counted > 0)


def compare_job(before: Path, after: Path, settings: Settings) -> int:
    """Print what differs in a job; the number of differences beyond the tolerance."""
    folders, most = (before, after), settings.most
    records = [json.loads((folder / RECORD).read_text("utf-8")) for folder in folders]
    cleaners = [Cleaner(record, settings.replaced) for record in records]
    kept = [files(folder) for folder in folders]
    for paths in kept:
        del paths[RECORD]
    counted, lines = 0, []
    for name in sorted(kept[0].keys() | kept[1].keys()):
        if name not in kept[0] or name not in kept[1]:
            counted += 1
            lines.append(f"  {name}: {'appeared' if name in kept[1] else 'vanished'}")
            continue
        paths = [found[name] for found in kept]
        if paths[0].read_bytes() == paths[1].read_bytes():
            continue
        facts = [read(path, clean) for path, clean in zip(paths, cleaners, strict=True)]
        found = list(compare_files(*facts, settings.tolerance))
        if not found:
            continue
        counted += sum(counts for counts, _ in found)
        lines.append(f"  {name}")
        for counts, text in found[:most]:
            lines.append(f"    {text}{'' if counts else ' (within tolerance)'}")
        if len(found) > most:
            lines.append(f"    ... and {len(found) - most} more")
    spent = " -> ".join(f"{record['seconds']:.1f} s" for record in records)
    verdict = f"{counted} differences" if counted else "the same"
    print(f"{before.name}: {verdict}, {len(kept[0])} files, {spent}")
    print("".join(f"{line}\n" for line in lines), end="", flush=True)
    return counted


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    making = commands.add_parser("make", help="run the jobs and store what they give")
    making.add_argument("folder", type=Path)
    making.add_argument("--seed", type=int, default=7)
    data = ROOT.parent / "shared" / "data"
    making.add_argument(
        "--data",
        type=Path,
        default=data,
        help="folder of real data; jobs without theirs are left out",
    )
    comparing = commands.add_parser(
        "compare", help="print what differs between two folders; status 1 if anything does"
    )
    comparing.add_argument("before", type=Path)
    comparing.add_argument("after", type=Path)
    comparing.add_argument(
        "--tolerance", type=float, default=0.0, help="in sigmas, or of the largest value (0: bits)"
    )
    comparing.add_argument("--most", type=int, default=20, help="lines printed of a file")
    comparing.add_argument(
        "--replace",
        action="append",
        default=[],
        metavar="OLD=NEW",
        help="words that were changed on purpose; repeatable",
    )
    for command in (making, comparing):
        command.add_argument(
            "--only", nargs="+", default=[], metavar="NAME", choices=[job.name for job in JOBS]
        )
    given = parser.parse_args(arguments)
    if given.command == "compare":
        replaced = [tuple(pair.split("=", 1)) for pair in given.replace]
        settings = Settings(given.tolerance, given.most, replaced)
        return compare(given.before, given.after, given.only, settings)
    return make(
        given.folder,
        [job for job in JOBS if not given.only or job.name in given.only],
        given.seed,
        given.data,
    )


if __name__ == "__main__":
    sys.stdout = io.TextIOWrapper(
        sys.stdout.buffer, encoding="utf-8", errors="replace", line_buffering=True
    )
    raise SystemExit(main())
