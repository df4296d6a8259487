"""Are the stated uncertainties right, regime by regime? The tables of the documentation are made by
this command.

    python verification/regimes.py [--only NAME ...] [--runs N] [--seed 1] [--processes N] [--write]
    [--list]

Every run simulates a campaign with `tests/helpers/outside.py` (NumPy alone, none of the package's
code), takes it through the public chain (`calibrate`, intervals of the estimate, `diagnose`, the
verdict), and compares with the truth. ``--write`` puts the rows that were run into the tables of
`docs/explanation`; the other rows stay as they are. ``--only`` takes parts of names.

A regime is a function from a random generator to an `Outcome`, listed with `Regime` in REGIMES:
most are a `campaign` with some switches, and `chain`.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

import starcal_uq as sc  # noqa: E402
from benchmarks.pages import between, put  # noqa: E402
from starcal_uq.core.status import Level  # noqa: E402
from starcal_uq.core.tasks import processors, run_tasks  # noqa: E402
from starcal_uq.diagnostics.verdict.judge import judge  # noqa: E402
from starcal_uq.likelihood.pairs import PairObjective  # noqa: E402
from starcal_uq.maths.intervals import binomial_interval  # noqa: E402
from starcal_uq.observations.frames import StarFrames  # noqa: E402
from tests.diagnostics import test_air, test_found  # noqa: E402
from tests.helpers.outside import Campaign, campaign, measured_again  # noqa: E402

# Alarms in a smaller share of the runs are not named.
RARE = 0.05
# A fact of the data and no test: few frames and empty corners are warned of in every run of such a
# regime.
FACTS = ("Coverage of the field",)
VERDICTS = {Level.PASS: "passed", Level.WARN: "warning", Level.FAIL: "do not use"}
STATISTICS_HEAD = (
    "Regime",
    "Runs",
    "Coverage of 95 %",
    "Squared error / stated",
    "Warning",
    "Do not use",
    "Most frequent alarms",
)


@dataclass(frozen=True)
class Outcome:
    """What one run gave."""

    # For each parameter whether its 95 % interval holds the truth; empty where there is no
    # estimate.
    inside: tuple[bool, ...] = ()
    # Squared error (normalised by the stated covariance, over its expectation): 1 on average if
    # that is right.
    squared: float = float("nan")
    # One of VERDICTS; "refused" where the chain raised an error, empty where nothing was judged
    verdict: str = ""
    alarms: tuple[str, ...] = ()  # Checks that did not pass, those of FACTS left out
    # Further numbers by column name; the table shows their medians.
    figures: Mapping[str, float] = field(default_factory=dict)
    # Further shares by column name, 0 or 1 where a run gives one answer; the table shows their mean.
    shares: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Regime:
    """A row: its name, what is done in one run, how many runs stand in the table, and the page with
    the table.
    """

    name: str
    run: Callable[[np.random.Generator], Outcome]
    runs: int
    page: str = "statistics"


def chain(
    c: Campaign,
    *,
    diagnose: bool = True,
    calibrate: Mapping[str, Any] | None = None,
    **diagnosis: Any,
) -> Outcome:
    """Calibrate a campaign, with `calibrate`'s options, diagnose it, and hold both against the
    truth.
    """
    obs = sc.Observations(**c.columns, meta={"directions": "apparent"})
    camera = sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0))
    try:
        cal = sc.calibrate(obs, camera, **(calibrate or {}))
    except sc.StarcalError:
        return Outcome(verdict="refused")
    found = sc.diagnose(obs, cal, **diagnosis) if diagnose else None
    return against_truth(c, cal, *(verdict_of(obs, cal, found) if diagnose else ("", ())))


def against_truth(
    c: Campaign, cal: sc.Calibration, verdict: str = "", alarms: tuple[str, ...] = ()
) -> Outcome:
    """Intervals and squared error of an estimate."""
    low, high = cal.interval(0.95).T
    error = (cal.theta - c.theta) / cal.sigmas
    squared = float("nan")
    if np.linalg.cond(cal.correlation) < 1e12:
        squared = float(error @ np.linalg.solve(cal.correlation, error)) / len(error)
    # With d degrees of freedom the form is p times an F variable, whose mean is d / (d - 2).
    expected = cal.dof / (cal.dof - 2.0) if cal.dof > 2 else float("nan")
    inside = (low <= c.theta) & (c.theta <= high)
    return Outcome(tuple(bool(v) for v in inside), squared / expected, verdict, alarms)


def verdict_of(
    obs: sc.Observations, cal: sc.Calibration, found: sc.diagnostics.Diagnosis | None
) -> tuple[str, tuple[str, ...]]:
    """The verdict on a run that has not been sampled, and the checks that did not pass; facts left
    out.
    """
    checks = [
        c
        for c in judge(obs, cal, diagnosis=found).checks
        if c.name not in FACTS and c.level is not Level.PASS
    ]
    level = max((c.level for c in checks), key=lambda v: v.rank, default=Level.PASS)
    return VERDICTS[level], tuple(c.name for c in checks)


def plain(rng: np.random.Generator, options: Mapping[str, Any], **chain_options: Any) -> Outcome:
    """A campaign with these options, through the chain."""
    return chain(campaign(rng, **options), **chain_options)


def twice(rng: np.random.Generator, duplicates: str) -> Outcome:
    """Every frame of a campaign a second time, as another program measures it."""
    c = campaign(rng, n_frames=20)
    again = measured_again(rng, c.columns, 0.005)
    columns = {name: np.concatenate([c.columns[name], values]) for name, values in again.items()}
    return chain(replace(c, columns=columns), calibrate={"duplicates": duplicates})


def merged(rng: np.random.Generator, ratio: float) -> Outcome:
    """Two runs, the smaller with so many times the noise, merged."""
    parts = [
        campaign(rng, n_frames=n, sigma_px=sigma) for n, sigma in ((20, 0.05), (8, 0.05 * ratio))
    ]
    sheets = [sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0)) for c in parts]
    runs = [
        sc.calibrate(sc.Observations(**c.columns), sheet)
        for c, sheet in zip(parts, sheets, strict=True)
    ]
    try:
        return against_truth(parts[0], sc.estimation.merge(runs), "passed")
    except sc.StarcalError:
        return Outcome(verdict="refused")


def clean(name: str, runs: int, **options: Any) -> Regime:
    """A regime in which the model holds."""
    return Regime(name, partial(plain, options=options), runs)


def few(rng: np.random.Generator, options: Mapping[str, Any], method: str, before: bool) -> Outcome:
    """Intervals from few data, and those of before: Gaussian, and of the pair estimate from the
    scatter of frames.
    """
    c = campaign(rng, **options)
    obs = sc.Observations(**c.columns, meta={"directions": "apparent"})
    try:
        cal = sc.calibrate(
            obs, sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0)), method=method
        )
    except sc.StarcalError:
        return Outcome(verdict="refused")
    if before and method == "three_stage":
        cal = replace(
            cal,
            covariance=PairObjective(StarFrames.from_observations(obs), "brown").godambe(cal.theta),
        )
    return against_truth(c, replace(cal, dof=10**6) if before else cal)


def frame_scatter(rng: np.random.Generator, n_frames: int) -> Outcome:
    """The test of the scatter of frames on clean data."""
    c = campaign(rng, n_frames=n_frames)
    obs = sc.Observations(**c.columns, meta={"directions": "apparent"})
    cal = sc.calibrate(obs, sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0)))
    found = sc.diagnostics.jackknife_frames(obs, cal)
    p = len(found.ratio)
    alarm = bool(np.any((p * found.p_values < 0.01) & (found.ratio > 1.1)))
    shares = {"Alarm (nominal 1 %)": alarm, "p < 5 %": float(np.mean(found.p_values < 0.05))}
    least = float(found.detectable(0.01 / p).min())
    return Outcome(figures={"Ratio seen nine times in ten": least}, shares=shares)


def recurring(name: str, *, effects: str = "none", runs: int = 150, **options: Any) -> Regime:
    """Frames that see the same stars again and again; without other models and starts, which take
    most of the time.
    """
    chosen: dict[str, Any] = {"calibrate": {"effects": effects}}
    return Regime(name, partial(plain, options=options, models=(), n_starts=0, **chosen), runs)


PATCH: dict[str, Any] = {"n_frames": 60, "patch_stars": 40}
FEW: dict[str, Any] = {"n_frames": 20, "patch_stars": 15, "star_sigma_px": 0.03}


def worse_outside(radius: np.ndarray, mag: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Three times the noise at the edge of the field, which is at 0.75 of the half diagonal on
    average.
    """
    return 0.05 * (1.0 + 2.0 * (radius / 0.75) ** 4)


def worse_for_faint(radius: np.ndarray, mag: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Photon noise over a floor: 2.8 times as much at magnitude 6 as at 2."""
    return 0.05 * np.sqrt(0.3 + 10.0 ** (0.4 * (mag - 4.0)))


def by_frame(radius: np.ndarray, mag: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """A factor of its own in every frame, log-normal with a spread of 0.4."""
    factors = np.random.default_rng(5).standard_normal(10_000)
    return 0.05 * np.exp(0.4 * factors[frame])


STARING: dict[str, Any] = {"n_frames": 40, "pointings": 1, "drift_px": 3.3}


def uneven(name: str, *, effects: str = "none", runs: int = 100, **options: Any) -> Regime:
    """Noise that varies over 40 frames, calibrated with one noise or with the fitted model."""
    steps = {"calibrate": {"effects": effects}, "models": (), "n_starts": 0}
    words = name if effects == "none" else f"{name}, with `--effects noise`"
    return Regime(words, partial(plain, options={"n_frames": 40} | options, **steps), runs)


def misfit_to_attitude(rng: np.random.Generator, planted: str) -> Outcome:
    """A planted misfit: what it is said to do to the rest over what it does."""
    seed = int(rng.integers(2**31))
    shape, found = test_found.PLANTED[planted][0](seed), {}
    for where in ("observed", "random", "slew"):
        run = test_found.rest(shape, seed, where, 60)
        ratio, own = run.stated / run.true, run.with_effects / run.true_with_effects
        for part, at in (("across", slice(0, 2)), ("about", slice(2, 3))):
            found[f"{where}, {part}"] = float(np.mean(ratio[at]))
            if where == "random":
                found[f"{where} with effects, {part}"] = float(np.mean(own[at]))
    return Outcome(figures=found)


def refraction(rng: np.random.Generator, **options: Any) -> Outcome:
    """Is refraction named in frames without times, and does f come back with what is said of it?"""
    while True:
        try:
            c, obs, cal = test_air.outside(int(rng.integers(2**31)), **options)
            break
        except sc.StarcalError:
            # Few stars may leave a frame with two of them: another campaign.
            continue
    return _named(sc.diagnostics.air_test(obs, cal), c.theta[2] - cal.theta[2])


def refraction_at_night(rng: np.random.Generator, **options: Any) -> Outcome:
    """The same of frames with times, one place."""
    obs, cal, focal = test_air.night(int(rng.integers(2**31)), **options)
    return _named(sc.diagnostics.air_test(obs, cal), focal - cal.theta[2])


def _named(found: sc.diagnostics.AirTest | None, short_px: float) -> Outcome:
    named, open_ = (
        found is not None and flag for flag in (found and found.is_air, found and found.like_others)
    )
    figures = (
        {"Share of the f error found": found.f_px / short_px} if found is not None and named else {}
    )
    return Outcome(
        figures=figures,
        shares={"Named": bool(named), "Indistinguishable from the lens": bool(open_)},
    )


def air(name: str, runs: int, **options: Any) -> Regime:
    """A regime of the test for refraction."""
    return Regime(name, partial(refraction, **options), runs, "air")


REGIMES: list[Regime] = [
    clean("clean: 3 frames", 400, n_frames=3),
    clean("clean: 5 frames", 400, n_frames=5),
    clean("clean: 10 frames", 400, n_frames=10),
    clean("clean: 20 frames", 400, n_frames=20),
    clean("clean: 100 frames", 200, n_frames=100),
    clean("clean: 1000 frames", 40, n_frames=1000),
    clean("clean: 3 stars in each of 60 frames", 200, n_frames=60, stars_per_frame=3),
    clean("clean: 5 stars in each of 20 frames", 200, n_frames=20, stars_per_frame=5),
    clean("clean: field of 4°, 50 frames", 200, n_frames=50, field_deg=4.0),
    clean("clean: field of 55°, 50 frames", 200, n_frames=50, field_deg=55.0),
    *(
        Regime(
            f"{name}{', intervals as before' if before else ''}",
            partial(few, method=m, options=o, before=before),
            400,
        )
        for name, m, o in (
            ("3 frames of 4 stars", "efficient", {"n_frames": 3, "stars_per_frame": 4}),
            ("interstar angles alone, 3 frames", "three_stage", {"n_frames": 3}),
            ("interstar angles alone, 8 frames", "three_stage", {"n_frames": 8}),
        )
        for before in (False, True)
    ),
    *(
        Regime(f"scatter of {k} frames", partial(frame_scatter, n_frames=k), 400, "misfit")
        for k in (3, 5, 10, 20, 100)
    ),
    recurring(
        "40 stars again and again in 60 frames, without errors of their own", runs=300, **PATCH
    ),
    recurring("40 stars: errors of 0.01 px of their own", star_sigma_px=0.01, **PATCH),
    recurring("40 stars: errors of 0.03 px of their own", star_sigma_px=0.03, **PATCH),
    recurring(
        "40 stars: 0.03 px, with `--effects star`", effects="star", star_sigma_px=0.03, **PATCH
    ),
    recurring("40 stars: no errors, with `--effects star`", effects="star", **PATCH),
    recurring("15 stars in 20 frames: errors of 0.03 px of their own", **FEW),
    recurring("15 stars: the same, with `--effects star`", effects="star", **FEW),
    uneven("noise three times larger at the edge", runs=200, sigma_px=worse_outside),
    uneven(
        "noise three times larger at the edge", runs=200, effects="noise", sigma_px=worse_outside
    ),
    uneven("noise larger for faint stars", sigma_px=worse_for_faint),
    uneven("noise larger for faint stars", effects="noise", sigma_px=worse_for_faint),
    uneven("noise of its own in every frame", sigma_px=by_frame),
    uneven("noise of its own in every frame", effects="noise", sigma_px=by_frame),
    uneven("clean: 40 frames", effects="noise"),
    Regime("every frame twice, 20 frames", partial(twice, duplicates="refuse"), 100),
    Regime(
        "every frame twice, kept (`--duplicates keep`: as before)",
        partial(twice, duplicates="keep"),
        100,
    ),
    Regime(
        "every frame twice, left out (`--duplicates drop`)", partial(twice, duplicates="drop"), 100
    ),
    Regime("20 and 8 frames merged, equal noise", partial(merged, ratio=1.0), 200),
    Regime(
        "20 and 8 frames merged, 5 times the noise in the second", partial(merged, ratio=5.0), 200
    ),
    *(
        Regime(f"misfit planted: {name}", partial(misfit_to_attitude, planted=name), 4, "attitude")
        for name in test_found.PLANTED
    ),
    air("no air: 60 frames of 40 stars", 60, **PATCH),
    air("no air: 40 stars with errors of 0.03 px", 60, star_sigma_px=0.03, **PATCH),
    air("no air: the same, with `--effects star`", 60, star_sigma_px=0.03, effects="star", **PATCH),
    air("no air: 15 stars in 20 frames, with errors of 0.03 px", 60, **FEW),
    air(
        "no air: one field, drifting by 3.3 px a frame, star errors of 0.03 px",
        60,
        star_sigma_px=0.03,
        **STARING,
    ),
    air(
        "no air: the same 40 stars, noise three times larger at the edge",
        40,
        sigma_px=worse_outside,
        **PATCH,
    ),
    Regime("no air: frames with times", partial(refraction_at_night, air=0.0), 60, "air"),
    *(
        air(f"no air, 30 frames: {name}", 24, **options)
        for name, options in test_air.LOOKALIKES.items()
    ),
    air(
        "no air, 30 frames: axes that differ by 0.3 px at the corner", 24, displaced=test_air.SKEWED
    ),
    air("air: a zenith of its own in each of 30 frames", 24, air="each"),
    air("air: the same, 0.1 px of noise", 24, air="each", sigma_px=0.1),
    air("air: the same, 0.2 px of noise", 24, air="each", sigma_px=0.2),
    air("air: the same, 10 frames", 24, air="each", n_frames=10),
    air("air: the same, field of 5°", 24, air="each", field_deg=5.0),
    air("air: the same, field of 30°", 24, air="each", field_deg=30.0),
    air(
        "air: the same, 60 frames of 40 stars with errors of 0.03 px",
        24,
        air="each",
        star_sigma_px=0.03,
        **PATCH,
    ),
    air(
        "air: one moment, 60 frames of 40 stars with errors of 0.03 px",
        24,
        air="one",
        star_sigma_px=0.03,
        **PATCH,
    ),
    air("air: 30 frames, horizon fixed in the camera", 24, air="fixed"),
    Regime("air: frames with times", partial(refraction_at_night), 24, "air"),
]


def one_run(index: int, name: str, seed: int) -> Outcome:
    """Run `index` of a regime; the same for any number of processes, and whatever else is run."""
    regime = next(r for r in REGIMES if r.name == name)
    return regime.run(np.random.default_rng([seed, index, *name.encode()]))


def cells(regime: Regime, found: Sequence[Outcome]) -> dict[str, str]:
    """The row of a regime."""
    n = len(found)
    row = dict.fromkeys(STATISTICS_HEAD, "–") if regime.page == "statistics" else {}
    row |= {"Regime": regime.name, "Runs": str(n)}
    if inside := [o.inside for o in found if o.inside]:
        shares = 100.0 * np.mean(inside, axis=0)
        row["Coverage of 95 %"] = f"{shares.min():.1f} – {shares.max():.1f} %"
        squared = np.array([o.squared for o in found if o.inside])
        # A squared error over p parameters scatters widely where degrees of freedom are few: the
        # mean, with its error.
        error = f"{squared.mean():.2f} ± {squared.std(ddof=1) / np.sqrt(len(squared)):.2f}"
        row["Squared error / stated"] = error if np.isfinite(squared).all() else "not defined"
    if verdicts := [o.verdict for o in found if o.verdict]:
        for words, column in (("warning", "Warning"), ("do not use", "Do not use")):
            row[column] = _share(sum(v == words for v in verdicts), len(verdicts))
        counted = Counter(name for o in found for name in o.alarms).most_common(3)
        frequent = [(name, k) for name, k in counted if k >= RARE * n]
        refused = sum(v == "refused" for v in verdicts)
        named = [("refused", refused)] if refused else []
        row["Most frequent alarms"] = (
            ", ".join(f"{name} {_share(k, n)}" for name, k in named + frequent) or "–"
        )
    for name in dict.fromkeys(name for o in found for name in o.figures):
        row[name] = f"{np.median([o.figures[name] for o in found if name in o.figures]):.3g}"
    for name in dict.fromkeys(name for o in found for name in o.shares):
        row[name] = _share(sum(o.shares[name] for o in found), n)
    return row


def _share(count: float, n: int) -> str:
    return f"{100.0 * count / n:.1f} %"


def markdown(rows: Sequence[Mapping[str, str]]) -> str:
    """Rows as a table; columns in the order in which they occur.

    Regimes with the same words before a colon and the same figures share a row.
    """
    head = list(dict.fromkeys(name for row in rows for name in row))
    together: dict[tuple[str, ...], list[str]] = {}
    for row in rows:
        group, colon, one = row["Regime"].partition(": ")
        figures = (row.get(name, "–") for name in head[1:])
        together.setdefault((group + colon, *figures), []).append(one)
    joined = ([key[0] + "; ".join(names), *key[1:]] for key, names in together.items())
    lines = [head, ["---"] * len(head), *joined]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def page(name: str) -> tuple[Path, str]:
    """The page of a table, and the word between its markers."""
    page_name = "misfit" if name == "air" else name
    return (
        ROOT / "docs" / "explanation" / f"{page_name}.md",
        "regimes" if name == "statistics" else f"{name} regimes",
    )


def stored(name: str) -> list[dict[str, str]]:
    """Rows of the table that a page has."""
    path, word = page(name)
    rows = [line for line in between(path, word).splitlines() if line.startswith("|")]
    lines = [[c.strip() for c in line.strip("|").split("|")] for line in rows]
    return [
        dict(zip(lines[0], [group + colon + one, *figures], strict=True))
        for first, *figures in lines[2:]
        for group, colon, names in [first.partition(": ")]
        for one in names.split("; ")
    ]


def write(name: str, rows: Sequence[Mapping[str, str]], seed: int) -> None:
    """Put rows into the table of a page, in the order of REGIMES; rows that were not run stay."""
    path, word = page(name)
    merged = {row["Regime"]: row for row in [*stored(name), *rows]}
    ordered = [merged[r.name] for r in REGIMES if r.name in merged]
    made = (
        f"Made by `python verification/regimes.py --seed {seed} --write`; do not "
        f"edit.{_together(ordered)}"
    )
    put(path, word, f"{made}\n\n{markdown(ordered)}")


def _together(rows: Sequence[Mapping[str, str]]) -> str:
    """Shares of warnings and failures over all clean regimes."""
    counted = [
        row for row in rows if row["Regime"].startswith("clean") and row.get("Warning", "–") != "–"
    ]
    n = sum(int(row["Runs"]) for row in counted)
    if n == 0:
        return ""

    def total(column: str) -> str:
        count = round(
            sum(0.01 * float(row[column].removesuffix(" %")) * int(row["Runs"]) for row in counted)
        )
        low, high = binomial_interval(count, n)
        return f"{_share(count, n)} (95 % interval {100.0 * low:.1f} to {100.0 * high:.1f} %)"

    return (
        f" All clean runs together ({n}): warning {total('Warning')}, do not use "
        f"{total('Do not use')}."
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python verification/regimes.py", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument(
        "--only",
        nargs="+",
        default=[""],
        metavar="NAME",
        help="regimes whose name has one of these",
    )
    parser.add_argument(
        "--runs", type=int, help="runs of each regime (default: as many as the documentation's)"
    )
    parser.add_argument("--seed", type=int, default=1, help="seed (default 1)")
    parser.add_argument(
        "--processes", type=int, default=processors(), help="processes; 0 stays in this one"
    )
    parser.add_argument(
        "--write", action="store_true", help="write the rows into the documentation"
    )
    parser.add_argument("--list", action="store_true", help="list the regimes and stop")
    options = parser.parse_args(arguments)
    chosen = [r for r in REGIMES if any(part in r.name for part in options.only)]
    if options.list or not chosen:
        sys.stdout.write("".join(f"{r.page}: {r.name} ({r.runs} runs)\n" for r in REGIMES))
        return 0 if options.list else 2
    tables: dict[str, list[dict[str, str]]] = {}
    for regime in chosen:
        task = partial(one_run, name=regime.name, seed=options.seed)
        report = partial(_report, regime.name)
        runs = options.runs or regime.runs
        found, stopped = run_tasks(
            task, runs, caller="regimes.py", chunk=4, workers=options.processes, progress=report
        )
        sys.stderr.write("\n")
        if stopped:
            return 1
        tables.setdefault(regime.page, []).append(cells(regime, found))
        if options.write:
            write(regime.page, tables[regime.page], options.seed)
    for rows in tables.values():
        sys.stdout.write(markdown(rows) + "\n")
    return 0


def _report(name: str, done: int, total: int) -> None:
    sys.stderr.write(f"\r{name}: {done} of {total}")


if __name__ == "__main__":
    sys.exit(main())
