"""The package beside its rivals, in turns on one machine, as a page of the documentation.

    python benchmarks/run.py [--only NAME ...] [--large] [--repeats N] [--seconds S] [--write] [--list]

``--only`` takes names or parts of them; ``--large`` adds the rows that take minutes each. A row
begins no further turn after so many seconds. ``--write`` puts what was run into
`benchmarks/results.json` and makes the tables of `docs/explanation/benchmarks.md` from that file;
rows that were not run stay.

A row is a question: contestants, ours first, that take turns on the same data, in processes of
their own (`harness.take_turns`). First it is shown that the answers are the same; a ratio without
that means nothing. A rival that cannot run here is named with the reason. `make bench-rivals` makes
an environment for those that are not in ours; mrcal comes with the system (Debian: ``apt-get
install python3-mrcal``).
"""

from __future__ import annotations

import argparse
import compileall
import datetime
import io
import json
import os
import platform
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

from benchmarks.harness import (  # noqa: E402
    CONTESTANTS,
    ONE_THREAD,
    ROOT,
    Contestant,
    Runs,
    Worker,
    cost,
    interpreter,
    ratio,
    spread,
    take_turns,
)
from benchmarks.pages import put  # noqa: E402
from benchmarks.rows import Row, Target, rows  # noqa: E402

CACHE = ROOT / ".bench"
RESULTS = ROOT / "benchmarks" / "results.json"
PAGE = ROOT / "docs" / "explanation" / "benchmarks.md"
BEFORE = "b0f6c051bd514b6f1a13b7adf23c6a3a56b4b45f"
SEED = 2017
CLOCKS = ("processor", "wall")
SECONDS = 30.0


def data_of(frames: int) -> Path:
    """Folder with the data of so many frames, made when it is not there."""
    folder = CACHE / "data" / f"{frames}-{SEED}"
    if frames and not (folder / "camera.toml").exists():
        command = [
            sys.executable,
            str(CONTESTANTS / "data.py"),
            str(folder),
            str(frames),
            str(SEED),
        ]
        subprocess.run(command, check=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
    return folder


def fetch_before() -> None:
    """Put the version before into the cache, where git knows it."""
    if (CACHE / "before").exists():
        return
    found = subprocess.run(
        ["git", "-C", str(ROOT), "archive", BEFORE, "starcal_uq"], capture_output=True
    )
    if found.returncode == 0:
        with tarfile.open(fileobj=io.BytesIO(found.stdout)) as archive:
            archive.extractall(CACHE / "before", filter="data")
        compileall.compile_dir(CACHE / "before", quiet=1)


def run_row(
    row: Row,
    repeats: int | None = None,
    tell: Callable[[str], None] = lambda text: None,
    seconds: float = SECONDS,
) -> dict[str, Any]:
    """Time all contestants of a row, and put what came out into a record."""
    folder = data_of(row.frames)

    def start(contestant: Contestant) -> Worker | str:
        if contestant.python == "before":
            fetch_before()
        found = interpreter(contestant.python, ROOT, CACHE)
        if isinstance(found, str):
            return found
        data = (
            data_of(contestant.options["n_frames"]) if "n_frames" in contestant.options else folder
        )
        options = {k: v for k, v in contestant.options.items() if k != "n_frames"}
        command, environment = found
        fixed = ONE_THREAD if row.one_core else {}
        return Worker(
            contestant.call,
            options,
            data,
            command,
            {**fixed, **environment, **contestant.environment},
        )

    load = os.getloadavg()[0]
    runs = take_turns(row.contestants, repeats or row.repeats, start, tell, seconds)
    for run in runs:
        done = [run.first, *run.turns.values()]
        drawn = [turn.result for turn in done if turn is not None and "draws" in turn.result]
        for result in drawn:
            result["moments"] = moments(result["draws"])
        for result in drawn[:1]:
            shutil.rmtree(Path(result["draws"]).parent)
    return record(row, runs, (load, os.getloadavg()[0]))


def moments(path: str) -> list[list[float]]:
    """Means, standard deviations and effective numbers of draws (chains, draws, parameters), by
    ArviZ for everybody.
    """
    from starcal_uq.inference.arviz import ess_bulk

    draws = np.load(path)
    flat = draws.reshape(-1, draws.shape[2])
    mean, sd = flat.mean(axis=0), flat.std(axis=0)
    return [
        mean.tolist(),
        sd.tolist(),
        [ess_bulk(column) for column in np.moveaxis((draws - mean) / sd, 2, 0)],
    ]


def record(row: Row, runs: Sequence[Runs], load: Sequence[float]) -> dict[str, Any]:
    """All figures of a row, as they are kept; `load` of the machine is from before and after."""
    mine, listed = runs[0], []
    for run, contestant in zip(runs, row.contestants, strict=True):
        entry: dict[str, Any] = {
            "label": run.label,
            "how": contestant.how,
            "missing": run.missing,
            "turns": len(run.turns),
        }
        if run.turns:
            last = max(run.turns)
            entry["peak_mb"] = run.peak_mb
            entry["path"] = run.turns[last].result.get("path", "")
            for clock in CLOCKS:
                entry[clock] = vars(
                    spread([cost(t, clock, row.amount) for t in run.turns.values()])
                )
                entry[f"first_{clock}"] = run.first and cost(run.first, clock, row.amount)
            if run is not mine and mine.turns:
                common = min(set(mine.turns) & set(run.turns))
                agreement = row.same(mine.turns[common].result, run.turns[common].result)
                entry["answer"], entry["same"] = agreement.words, agreement.same
                listed[0]["answer"] = agreement.ours
                for clock in CLOCKS:
                    found = ratio(run, mine, clock, row.amount)
                    entry[f"{clock}_ratio"] = found and vars(found)
        listed.append(entry)
    return {
        "name": row.name,
        "what": row.what,
        "unit": row.unit,
        "one_core": row.one_core,
        "made": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d"),
        "machine": machine(),
        "load": list(load),
        "contestants": listed,
        "targets": [measured(target, listed) for target in row.targets],
    }


def measured(target: Target, listed: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """A target, what ours measured, without and with extras, and what the rival did."""

    def said(entry: Mapping[str, Any]) -> str:
        if not entry["turns"]:
            return "not measured"
        if target.peak:
            return f"{entry['peak_mb']:,.0f} MB"
        return taken(entry)

    mine = listed[0]
    found = {"target": target.words, "measured": said(mine), "rival": "–"}
    if target.rival is not None:
        rival = next(entry for entry in listed if entry["label"] == target.rival)
        found["rival"] = f"{rival['label']}: {said(rival)}"
        if factor := rival.get("processor_ratio"):
            found["rival"] += f", {factor['median']:.2g} times ours"
    return found


def machine() -> str:
    """Processor, cores and Python."""
    name = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        name = next(
            line.partition(":")[2].strip() for line in lines if line.startswith("model name")
        )
    except (OSError, StopIteration):
        pass
    return (
        f"{name}, {os.cpu_count()} cores, Python {platform.python_version()}, NumPy "
        f"{np.__version__}"
    )


# --- tables
# --------------------------------------------------------------------------------------------------


def seconds(value: float) -> str:
    """With a unit that suits its size."""
    for factor, unit in ((1.0, "s"), (1e3, "ms")):
        if value * factor >= 1.0:
            return f"{value * factor:.3g} {unit}"
    return f"{1e6 * value:.3g} µs"


def taken(entry: Mapping[str, Any]) -> str:
    """Processor time, and the wall time where that differs by more than a tenth."""
    processor, wall = (entry[clock]["median"] for clock in CLOCKS)
    waited = f" ({seconds(wall)})" if abs(wall / processor - 1.0) > 0.1 else ""
    return f"{seconds(processor)}{waited}"


def times(found: Mapping[str, float] | None) -> str:
    """Median and quartiles of a ratio."""
    return (
        "–" if not found else f"**{found['median']:.3g}** ({found['low']:.3g}–{found['high']:.3g})"
    )


OURS = "starcal_uq"
HEAD = ("", "First call", "Processor (wall)", "Times ours", "Peak MB", "Answer")


def table(records: Sequence[Mapping[str, Any]]) -> str:
    """All contestants of all rows."""
    lines = []
    for record in records:
        where = "one core" if record["one_core"] else "all cores"
        unit = f" ({record['unit']})" if record["unit"] else ""
        lines += [
            f"\n### {record['what']}{unit}\n",
            f"`{record['name']}`, {where}\n",
            "| " + " | ".join(HEAD) + " |",
            "|" + "---|" * len(HEAD),
        ]
        for entry in record["contestants"]:
            how = entry.get("path") or ("" if entry["label"].startswith(OURS) else entry["how"])
            label = f"{entry['label']} ({how})" if how else entry["label"]
            if not entry["turns"]:
                reason = " ".join((entry["missing"] or "no turn").replace("|", "/").split())
                lines.append(f"| {label} | not measured: {reason} |" + " |" * 4)
                continue
            first, answer = entry["first_processor"], entry.get("answer", "")
            cells = [
                label,
                seconds(first) if first else "–",
                taken(entry),
                times(entry.get("processor_ratio")),
                f"{entry['peak_mb']:,.0f}",
                answer if entry.get("same", True) else f"**another answer**: {answer}",
            ]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines).strip()


def targets(records: Sequence[Mapping[str, Any]]) -> str:
    """What the package aims at, what it takes, and what a rival takes."""
    lines = ["| What | Target | Measured | Rival |", "|---|---|---|---|"]
    for record in records:
        for found in record["targets"]:
            cells = record["what"], found["target"], found["measured"], found["rival"]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def write(made: Sequence[dict[str, Any]]) -> None:
    """Keep the records, and make the page from all that are kept, in the order of the rows."""
    kept = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else []
    merged = {r["name"]: r for r in [*kept, *made]}
    ordered = [merged[row.name] for row in rows() if row.name in merged]
    RESULTS.write_text(json.dumps(ordered, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    machines = "; ".join(sorted({r["machine"] for r in ordered}))
    days, loads = (
        sorted({r["made"] for r in ordered}),
        [load for r in ordered for load in r["load"]],
    )
    when = f"{days[0]} to {days[-1]}" if len(days) > 1 else days[0]
    load = f"load of the machine {min(loads):.1f} to {max(loads):.1f}"
    put(PAGE, "targets", targets(ordered))
    put(PAGE, "benchmarks", f"{machines}; {when}, {load}.\n\n{table(ordered)}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="NAME", help="names of rows, or parts of names"
    )
    parser.add_argument("--large", action="store_true", help="also the rows that take minutes each")
    parser.add_argument("--repeats", type=int, help="turns of each row")
    parser.add_argument(
        "--seconds", type=float, default=SECONDS, help="a row begins no further turn after these"
    )
    parser.add_argument(
        "--write", action="store_true", help="put the results into the documentation"
    )
    parser.add_argument("--list", action="store_true", help="names of the rows")
    options = parser.parse_args(arguments)
    listed = rows()
    names = {row.name for row in listed}

    def wanted(row: Row) -> bool:
        named = any(row.name == o or (o not in names and o in row.name) for o in options.only)
        return named if options.only else options.large or not row.large

    chosen = [row for row in listed if wanted(row)]
    if options.list:
        for row in listed:
            print(f"{row.name:20} {row.what}{' (--large)' if row.large else ''}")
        return 0
    if not chosen:
        parser.error(f"no row is called {' or '.join(options.only)}; --list names them.")
    began, made = perf_counter(), []
    for number, row in enumerate(chosen, 1):

        def tell(text: str, number: int = number, row: Row = row) -> None:
            minutes = (perf_counter() - began) / 60.0
            print(
                f"{minutes:4.1f} min, row {number} of {len(chosen)}, {row.name}: {text}",
                file=sys.stderr,
            )

        tell("data")
        made.append(run_row(row, options.repeats, tell, options.seconds))
        print(f"{table(made[-1:])}\n", flush=True)
        if options.write:
            write(made)
    if any(record["targets"] for record in made):
        print(targets(made))
    return 0


if __name__ == "__main__":
    sys.exit(main())
