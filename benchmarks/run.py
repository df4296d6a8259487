"""The package beside its rivals, each at full strength, in turns on one machine, as a page of the
documentation.

    python benchmarks/run.py [--only NAME ...] [--quick] [--large] [--repeats N] [--write] [--list]

``--only`` takes names or parts of them; ``--quick`` takes less data and fewer turns (under two
minutes), ``--large`` adds the rows that take minutes each. ``--write`` puts what was run into
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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

from benchmarks.harness import (  # noqa: E402
    CONTESTANTS,
    ONE_THREAD,
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

CACHE = ROOT / ".bench"
RESULTS = ROOT / "benchmarks" / "results.json"
PAGE = ROOT / "docs" / "explanation" / "benchmarks.md"
BEFORE = "0e7b0a1afa4eb04b62df08dc31eeebd4d9d66f9b"
SEED = 2017
IMAGES = Path(os.environ.get("STARCAL_IMAGES", ROOT.parent / "shared" / "data" / "esa-tetra3"))
# By its defaults tetra3rs takes the noise of short exposures for stars; of what was tried, this
# solves most of them.
SHORT_EXTRACTION = {"matched_filter_sigma": None, "sigma_threshold": 8.0, "min_pixels": 5}
SHORT = IMAGES.parent / "openstartracker"
# Of ESA's frames.
MIDDLE_PX = (511.5, 383.5)
CLOCKS = ("processor", "wall")
PARTITIONS = ("--frames", "200000", "--partition-frames", "10000")
# Mode, frames, fields of view; ten distortions, five noises and ten seeds make the rest.
STUDY = """[study]
name = "Benchmark"
question = "How long does a study take?"
mode = "{}"
seeds = 10
[camera]
width_px = 1024
height_px = 1024
pixel_um = 12.0
focal_mm = 70.2
x0_px = 511.5
y0_px = 511.5
distortion = "brown"
[observation]
frames = {}
max_mag = 6.0
min_stars = 5
[sweep]
fov_deg = {{start = 8, stop = 20, n = {}}}
distortion_px = [-20, -15, -10, -5, -1, 1, 5, 10, 15, 20]
sigma_px = [0.02, 0.05, 0.1, 0.2, 0.5]
"""


@dataclass(frozen=True)
class Agreement:
    """How far a rival's answer is from ours, in words, and whether they are the same for all that
    matters.
    """

    words: str
    same: bool


Same = Callable[[Mapping[str, Any], Mapping[str, Any]], Agreement]


@dataclass(frozen=True)
class Target:
    """What was asked."""

    words: str  # As it was asked
    # `rival`, `factor`, `of`: so many times as long as ours the rival takes, or as the contestant
    # `of`.
    rival: str | None = None
    factor: float | None = None
    of: str | None = None
    # `seconds`, `clock`: limit of ours, on this clock.
    seconds: float | None = None
    clock: str = "wall"
    peak_mb: float | None = None  # Limit of our memory
    # Limit of the growth with the number of frames, fitted through all contestants of the row.
    exponent: float | None = None


@dataclass(frozen=True)
class Row:
    """One question."""

    name: str  # Word for ``--only``
    what: str  # Heading in the table
    contestants: tuple[Contestant, ...]  # Ours first
    same: Same = lambda ours, rival: Agreement("–", True)  # Compares (ours, rival's) results
    unit: str = ""  # What the times are for, where a call does not always do as much
    amount: Callable[[Any], float] = lambda result: 1.0  # How many of it a result holds
    frames: int = 0  # Frames of the data; 0 for none
    repeats: int = 7  # Turns
    one_core: bool = (
        True  # All contestants on one core and one thread; otherwise as a user would start them
    )
    large: bool = False  # Runs only when it is asked for
    targets: tuple[Target, ...] = ()  # What was asked


# --- the same answer
# --------------------------------------------------------------------------------------------------


def same_estimate(limit: float = 0.03) -> Same:
    """Largest difference of the optics in our standard deviations, and of the deviations where both
    have them.
    """

    def compare(ours: Mapping[str, Any], rival: Mapping[str, Any]) -> Agreement:
        if "theta" not in rival:
            return Agreement("–", True)
        sigma = np.sqrt(np.diag(ours["covariance"]))
        off = float(np.max(np.abs(np.array(rival["theta"]) - ours["theta"]) / sigma))
        words, same = f"{off:.2g} σ", off < limit
        if "covariance" in rival:
            ratios = np.sqrt(np.diag(rival["covariance"])) / sigma
            words += f", σ to {100.0 * np.max(np.abs(ratios - 1.0)):.1g} %"
            same = same and bool(np.all(np.abs(ratios - 1.0) < 0.02))
        return Agreement(words + (f"; {rival['said']}" if "said" in rival else ""), same)

    return compare


def same_draws(ours: Mapping[str, Any], rival: Mapping[str, Any]) -> Agreement:
    """Means and spreads of two sets of draws, beside their Monte Carlo errors."""
    mine, theirs = ours["moments"], rival["moments"]
    (m, s, n), (m2, s2, n2) = (tuple(np.array(moment) for moment in x) for x in (mine, theirs))
    means, spreads = np.abs(m2 - m) / s, np.abs(s2 / s - 1.0)
    noise = np.sqrt(1.0 / n + 1.0 / n2)
    same = bool(np.all(means < 4.0 * noise + 0.03) and np.all(spreads < 4.0 * noise + 0.02))
    return Agreement(f"means {np.max(means):.2f} σ, spreads {100.0 * np.max(spreads):.0f} %", same)


def same_attitudes(ours: Mapping[str, Any], rival: Mapping[str, Any]) -> Agreement:
    """Largest angle between the attitudes, arc seconds."""
    a, b = np.array(ours["quaternions"]), np.array(rival["quaternions"])
    few = min(len(a), len(b))
    a, b = a[:few], b[:few]
    b = b * np.sign(np.sum(a * b, axis=1, keepdims=True))
    angle = float(np.max(2.0 * np.linalg.norm(a - b, axis=1)) * 206264.8)
    return Agreement(f"{angle:.1g} arcsec", angle < 1e-3)


def same_arrays(key: str, scale: float, unit: str, limit: float) -> Same:
    """Largest difference of two arrays."""

    def compare(ours: Mapping[str, Any], rival: Mapping[str, Any]) -> Agreement:
        off = float(np.max(np.abs(np.array(ours[key]) - np.array(rival[key])))) * scale
        return Agreement(f"{off:.1g} {unit}", off < limit)

    return compare


# --- the rows
# --------------------------------------------------------------------------------------------------


def rows(quick: bool = False) -> list[Row]:
    """All questions; `quick` has less data."""
    ours, before = "starcal_uq", "starcal_uq before"
    turns = 3 if quick else 7
    few = 100 if quick else 1000
    draws, chain = ({"draws": 200}, {"steps": 600}) if quick else ({}, {})
    made = [
        Row(
            name=f"calibrate-{frames}",
            what=f"Estimate of the optics with its covariance, {frames:,} frames",
            contestants=(
                Contestant(ours, "ours:calibrate"),
                *(
                    Contestant(
                        f"{ours}, {path} path",
                        "ours:calibrate",
                        environment={"STARCAL_UQ_KERNELS": word},
                    )
                    for word, path in (("numba", "compiled"), ("numpy", "NumPy"))
                ),
                Contestant(before, "ours:calibrate", "before"),
                Contestant("SciPy sparse bundle", "bundles:sparse"),
                Contestant("SciPy least_squares, sparse", "bundles:least_squares"),
                Contestant("NumPy bundle, angles eliminated", "bundles:schur"),
                Contestant("mrcal", "bundle_mrcal:bundle", "system"),
                Contestant(
                    "mrcal, no covariance", "bundle_mrcal:bundle", "system", {"covariance": False}
                ),
            ),
            same=same_estimate(),
            frames=frames,
            repeats=turns,
            targets=(
                *(
                    Target(f"{asked}{suffix}", rival, factor, of)
                    for asked, rival, factor in (
                        ("a quarter of SciPy's sparse bundle", "SciPy sparse bundle", 4.0),
                        ("a quarter of SciPy's sparse bundle", "SciPy least_squares, sparse", 4.0),
                        ("a fifth of mrcal's time", "mrcal", 5.0),
                    )
                    for suffix, of in (("", None), (" (compiled path)", f"{ours}, compiled path"))
                ),
                Target(
                    "3 times as fast as before (NumPy path)", before, 3.0, f"{ours}, NumPy path"
                ),
            ),
        )
        for frames in ((1000,) if quick else (1000, 10_000))
    ]
    made += [
        Row(
            name="calibrate-100000",
            what="Estimate of the optics with its covariance, 100,000 frames",
            contestants=(
                Contestant(ours, "ours:calibrate"),
                Contestant(before, "ours:calibrate", "before", first=False, every=3),
            ),
            same=same_estimate(),
            frames=100_000,
            repeats=3,
            large=True,
            targets=(
                Target("8 times as fast as before", before, 8.0),
                Target("less than 1.5 GB", peak_mb=1500.0),
            ),
        ),
        Row(
            name="three-stages",
            what="The paper's three stages with sandwich covariance, 1,000 frames",
            contestants=(
                Contestant(ours, "ours:three_stages"),
                Contestant(before, "ours:three_stages", "before"),
                Contestant("SciPy LM on explicit pairs", "pairs:three_stages"),
            ),
            same=same_estimate(),
            frames=1000,
            repeats=turns,
        ),
        Row(
            name="other-answers",
            what="Camera calibrations that give another answer, 1,000 frames",
            contestants=(
                Contestant(ours, "ours:calibrate"),
                Contestant("tetra3rs calibrate_camera", "bundle_tetra3rs:calibrate", "rivals"),
                *(
                    ()
                    if quick
                    else (
                        Contestant(
                            "OpenCV calibrateCamera",
                            "points:calibrate",
                            "rivals",
                            first=False,
                            every=3,
                        ),
                    )
                ),
            ),
            same=same_estimate(),
            frames=1000,
            repeats=turns,
        ),
        Row(
            name="sample",
            what=f"1,000 effective draws from the posterior, {few:,} frames",
            contestants=(
                Contestant(ours, "ours:sample"),
                Contestant(before, "ours:sample", "before"),
                Contestant("NUTS (NumPyro), exact likelihood", "nuts:numpyro", "rivals", draws),
                *(
                    Contestant(
                        label, "samplers:ensemble", options={"move": move, **chain}, first=False
                    )
                    for label, move in (
                        ("emcee, stretch, exact likelihood", "StretchMove"),
                        ("emcee, DE, exact likelihood", "DEMove"),
                    )
                ),
            ),
            same=same_draws,
            unit="for 1,000 effective draws",
            amount=lambda result: float(np.min(result["moments"][2])) / 1000.0,
            frames=few,
            repeats=2 if quick else 3,
        ),
        Row(
            name="sample-size",
            what="Draws with all their checks: 10,000 frames beside 1,000",
            contestants=(
                Contestant("starcal_uq, 10,000 frames", "ours:sample"),
                Contestant("starcal_uq before, 10,000 frames", "ours:sample", "before"),
                Contestant("starcal_uq, 1,000 frames", "ours:sample", options={"n_frames": 1000}),
            ),
            frames=10_000,
            repeats=3,
            large=True,
            targets=(
                Target("the same whatever the number of stars", "starcal_uq, 1,000 frames", 0.8),
            ),
        ),
        *(
            Row(
                name=f"{name}-10000",
                what=f"`{name}`, 10,000 frames",
                contestants=(
                    Contestant(ours, f"ours:{name}"),
                    Contestant(before, f"ours:{name}", "before", first=False),
                ),
                frames=10_000,
                repeats=2,
                large=True,
            )
            for name in ("propagate", "diagnose")
        ),
        Row(
            name="attitudes",
            what="4,000 attitudes of 12 stars",
            contestants=tuple(
                Contestant(label, call, options={"frames": n, "stars": 12})
                for label, call, n in (
                    (ours, "ours:quest", 4000),
                    ("NumPy, singular values of all frames", "attitudes:kabsch", 4000),
                    ("NumPy, eigenvectors of all frames", "attitudes:davenport", 4000),
                    ("SciPy align_vectors, frame by frame", "attitudes:align_vectors", 4000),
                )
            ),
            same=same_attitudes,
            repeats=turns,
        ),
        Row(
            name="project",
            what="A million directions to pixels",
            contestants=(
                Contestant(ours, "ours:project", options={"points": 1_000_000}),
                Contestant(
                    "OpenCV projectPoints", "points:project", "rivals", {"points": 1_000_000}
                ),
            ),
            same=same_arrays("xy", 1.0, "px", 1e-6),
            repeats=turns,
        ),
        Row(
            name="unproject",
            what="A million pixels to directions",
            contestants=(
                Contestant(ours, "ours:unproject", options={"points": 1_000_000}),
                Contestant(
                    "OpenCV undistortPoints", "points:unproject", "rivals", {"points": 1_000_000}
                ),
            ),
            same=same_arrays("b", 206264.8, "arcsec", 1e-4),
            repeats=turns,
        ),
        Row(
            name="import",
            what="`import starcal_uq` in a fresh process",
            contestants=(
                Contestant(ours, "ours:imported", options={"code": "import starcal_uq"}),
                Contestant(before, "ours:imported", "before", {"code": "import starcal_uq"}),
                Contestant("import numpy", "ours:imported", options={"code": "import numpy"}),
            ),
            repeats=turns,
        ),
    ]
    return made if quick else made + commands(ours, before)


def commands(ours: str, before: str) -> list[Row]:
    """Whole commands, as a user starts them, and work on images."""

    def pair(arguments: Sequence[str], needs: Path | None = None) -> tuple[Contestant, ...]:
        options = {"arguments": list(arguments), "needs": None if needs is None else str(needs)}
        return (
            Contestant(ours, "ours:command", options=options),
            Contestant(before, "ours:command", "before", options, first=False),
        )

    stars, camera = "{data}/stars.parquet", "{data}/camera.toml"
    table, nominal = (
        IMAGES.parent / "esa_tetra3_observations.csv",
        IMAGES.parent / "esa_tetra3_camera.toml",
    )
    images = {"images": str(IMAGES)}
    identified = {**images, "camera": str(nominal)}
    return [
        Row(
            name="demo",
            what="`starcal-uq demo`",
            contestants=pair(["demo", "--out", "{out}"]),
            repeats=3,
            one_core=False,
            targets=(Target("4 times as fast as before", before, 4.0),),
        ),
        Row(
            name="run-table",
            what="`starcal-uq run` on the table of ESA's night-sky frames (567 stars)",
            contestants=pair(["run", str(table), str(nominal), "--out", "{out}"], table),
            repeats=3,
            one_core=False,
            targets=(Target("4 times as fast as before", before, 4.0),),
        ),
        Row(
            name="run-1000",
            what="`starcal-uq run`, 1,000 frames",
            contestants=pair(["run", stars, camera, "--out", "{out}"]),
            frames=1000,
            repeats=3,
            one_core=False,
        ),
        Row(
            name="run-10000",
            what="`starcal-uq run`, 10,000 frames",
            contestants=pair(["run", stars, camera, "--out", "{out}"]),
            frames=10_000,
            repeats=2,
            one_core=False,
            large=True,
            targets=(Target("8 times as fast as before", before, 8.0),),
        ),
        Row(
            name="growth",
            what="Calibration, by number of frames",
            contestants=tuple(
                Contestant(f"{ours}, {n:,} frames", "ours:calibrate", options={"n_frames": n})
                for n in (1000, 10_000, 100_000, 1_000_000)
            ),
            repeats=3,
            large=True,
            targets=(
                Target(
                    "processor time grows with the power 1.05 of the frames at most", exponent=1.05
                ),
            ),
        ),
        Row(
            name="simulate",
            what="`starcal-uq simulate` to a folder of partitions, 200,000 frames",
            contestants=(
                Contestant(
                    ours,
                    "ours:command",
                    options={"arguments": ["simulate", camera, *PARTITIONS, "--out", "{out}"]},
                    first=False,
                ),
            ),
            frames=1000,
            repeats=3,
            one_core=False,
            large=True,
            targets=(Target("20,000 frames per second and core", seconds=10.0, clock="processor"),),
        ),
        Row(
            name="run-1000000",
            what="`starcal-uq run`, 1,000,000 frames in a folder of partitions",
            contestants=(
                Contestant(
                    ours,
                    "ours:command",
                    options={"arguments": ["run", "{data}/frames", camera, "--out", "{out}"]},
                    first=False,
                ),
            ),
            frames=1_000_000,
            repeats=2,
            one_core=False,
            large=True,
            targets=(
                Target("under 90 s on two cores", seconds=90.0),
                Target("under 2 GB", peak_mb=2000.0),
            ),
        ),
        *(
            Row(
                name=f"study-{mode}",
                what=f"`study`, {cells:,} cells {words}",
                contestants=(
                    Contestant(ours, "ours:study", options={"definition": text}, first=False),
                ),
                repeats=2,
                one_core=False,
                large=True,
                targets=(Target(f"under {limit:.0f} s on two cores", seconds=limit),),
            )
            for mode, cells, words, text, limit in (
                (
                    "fisher",
                    10_000,
                    "by Fisher information, of 300 frames",
                    STUDY.format("fisher", 300, 20),
                    60.0,
                ),
                (
                    "simulate",
                    1000,
                    "simulated with their posteriors, of 50 frames",
                    STUDY.format("simulate", 50, 2),
                    120.0,
                ),
            )
        ),
        Row(
            name="centroids",
            what="Centroids of ESA's night-sky frames, per frame",
            contestants=(
                Contestant(ours, "ours:centroids", options=images),
                Contestant(before, "ours:centroids", "before", images),
                Contestant("cedar-solve get_centroids", "images_cedar:centroids", "cedar", images),
                Contestant(
                    "tetra3rs extract_centroids", "images_tetra3rs:centroids", "rivals", images
                ),
            ),
            same=counted("stars found"),
            unit="for a frame",
            amount=lambda result: float(result["frames"]),
            repeats=3,
            targets=(Target("3 times as fast as before", before, 3.0),),
        ),
        Row(
            name="identify",
            what="Identification of ESA's night-sky frames, per frame",
            contestants=(
                Contestant(ours, "ours:identify", options=identified),
                Contestant(before, "ours:identify", "before", identified),
                Contestant(
                    "cedar-solve solve_from_centroids", "images_cedar:identify", "cedar", identified
                ),
                Contestant(
                    "tetra3rs solve_from_centroids",
                    "images_tetra3rs:identify",
                    "rivals",
                    identified,
                ),
            ),
            same=counted("frames identified"),
            unit="for a frame",
            amount=lambda result: float(result["frames"]),
            repeats=3,
            targets=(Target("3 times as fast as before", before, 3.0),),
        ),
        Row(
            name="frames",
            what=(
                "ESA's night-sky frames one by one, centroids and identification with a sheet, "
                "per frame"
            ),
            contestants=(
                Contestant(ours, "ours:frames", options=identified),
                Contestant("cedar-solve", "images_cedar:frames", "cedar", identified),
                Contestant("tetra3rs", "images_tetra3rs:frames", "rivals", identified),
            ),
            same=same_frames(table),
            unit="for a frame",
            amount=lambda result: float(len(result["frames"])),
            repeats=3,
        ),
        *(
            Row(
                name=f"identify-{name}",
                what=f"Identification of {whose} frames without a camera sheet, per frame",
                contestants=(
                    Contestant(ours, "ours:identify_unknown", options=options),
                    Contestant(
                        "cedar-solve, 10 to 30 degrees",
                        "images_cedar:identify_unknown",
                        "cedar",
                        options,
                    ),
                    Contestant(
                        "tetra3rs, 5 to 30 degrees",
                        "images_tetra3rs:identify_unknown",
                        "rivals",
                        options,
                    ),
                    *(
                        Contestant(
                            "tetra3rs, thresholds chosen for these images",
                            "images_tetra3rs:identify_unknown",
                            "rivals",
                            options | {"extraction": SHORT_EXTRACTION},
                        )
                        for _ in range(name == "unknown-short")
                    ),
                ),
                same=lambda mine, rival: Agreement(
                    (
                        f"{rival['found']} frames, {rival['wrong']} wrong; ours {mine['found']} "
                        "and "
                        f"{mine['wrong']}"
                    ),
                    True,
                ),
                unit="for a frame",
                amount=lambda result: float(result["frames"]),
                repeats=3,
            )
            for name, whose, options in (
                ("unknown", "ESA's night-sky", {"images": str(IMAGES), "field": 11.42}),
                (
                    "unknown-short",
                    "openstartracker's",
                    {"images": str(IMAGES.parent / "openstartracker"), "field": 6.08},
                ),
            )
        ),
    ]


def same_frames(table: Path) -> Same:
    """Frames found and wrong, stars named rightly, scatter of the centroids, median and worst times
    of both steps.

    A frame is wrong whose middle is more than 0.05 degrees from where the stars of a table have it,
    or of whose stars more than one in twenty is (`judged_frames`). Times are of the processor.
    Scatter is of the stars that both measured, of those of the table, about a cubic polynomial of
    the places in each frame, which takes up attitude, lens and which pixel counts first.
    """

    def words(result: Mapping[str, Any], rms: float) -> str:
        frames = result["frames"]
        found = judged_frames(table, frames)
        wrong = sum(apart_deg > 0.05 or right < 0.95 * n for apart_deg, right, n in found)
        n_right, n_stars = (
            sum(column) for column in list(zip(*found, strict=True))[1:] or ([], [])
        )
        steps = 1e3 * np.diff([f["clock"] for f in frames], axis=1)
        (c, i), (slow_c, slow_i) = np.median(steps, axis=0), np.max(steps, axis=0)
        return (
            f"{len(found) - wrong} of {len(frames)} frames, {wrong} wrong (farthest "
            f"{max(f[0] for f in found):.3f}°), "
            f"{n_right} of {n_stars} stars right, {rms:.3f} px, centroids {c:.1f} ms (worst "
            f"{slow_c:.1f}), identification {i:.1f} ms (worst {slow_i:.1f})"
        )

    def compare(ours: Mapping[str, Any], rival: Mapping[str, Any]) -> Agreement:
        rms = scatter(table, [[f["points"] for f in result["frames"]] for result in (ours, rival)])
        return Agreement(f"{words(rival, rms[1])}; ours {words(ours, rms[0])}", True)

    return compare


# Farther from its place than this a star is another one, px; catalogues of other epochs differ by a
# tenth of it.
_OTHER_STAR_PX = 3.0


def judged_frames(table: Path, frames: Sequence[Mapping[str, Any]]) -> list[tuple[float, int, int]]:
    """Of each frame found: how far its middle is off, degrees, and how many of its stars are right,
    of how many.

    What is right follows from the places and catalogue directions of the table's own stars, by a
    cubic polynomial.
    """
    stars = np.genfromtxt(
        table, delimiter=",", names=True, usecols=range(10), dtype=None, encoding="utf-8"
    )

    def terms(xy: Any) -> Any:
        u, v = (np.asarray(xy, dtype=float) - MIDDLE_PX).T / 500.0
        return np.column_stack([u**i * v**j for i in range(4) for j in range(4 - i)])

    found = []
    for k, frame in enumerate(frames):
        if frame["middle"] is None:
            continue
        own = stars[stars["frame"] == k]
        r, xy = (
            directions(own["ra_deg"], own["dec_deg"]),
            np.column_stack([own["x_px"], own["y_px"]]),
        )
        axes = np.linalg.svd(r)[2]
        axes[0] *= np.sign(np.mean(r @ axes[0]))
        plane = np.linalg.lstsq(terms(xy), (r @ axes[1:].T) / (r @ axes[0])[:, None], rcond=None)[0]
        pixel = np.linalg.norm(plane[[1, 4]]) / np.sqrt(2.0) / 500.0

        def off(theirs: Any, places: Any, axes: Any = axes, plane: Any = plane) -> Any:
            """Distance of directions from where the places are."""
            here = axes[0] + terms(places) @ plane @ axes[1:]
            return np.linalg.norm(theirs - here / np.linalg.norm(here, axis=1)[:, None], axis=1)

        named = np.reshape(frame["stars"], (-1, 4))
        right = off(directions(named[:, 2], named[:, 3]), named[:, :2]) < _OTHER_STAR_PX * pixel
        apart = off(np.reshape(frame["middle"], (1, 3)), [MIDDLE_PX])
        found.append((float(np.degrees(apart[0])), int(right.sum()), len(named)))
    return found


def directions(ra_deg: Any, dec_deg: Any) -> Any:
    """Unit vectors (n, 3)."""
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    return np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


def scatter(table: Path, measured: Sequence[Sequence[Any]]) -> list[float]:
    """Scatter per axis, px, of each list of places by frame (n, 2), of the stars that all lists
    have.
    """
    from scipy.spatial import cKDTree

    stars = np.genfromtxt(
        table, delimiter=",", names=True, usecols=range(10), dtype=None, encoding="utf-8"
    )
    left: list[list[Any]] = [[] for _ in measured]
    for k in np.unique(stars["frame"]):
        own = stars[stars["frame"] == k]
        near = [
            cKDTree(places[k]).query(np.column_stack([own["x_px"], own["y_px"]]))
            for places in measured
        ]
        all_have = np.all([distance < 2.0 for distance, _ in near], axis=0)
        r = directions(own["ra_apparent_deg"], own["dec_apparent_deg"])
        axes = np.linalg.svd(r)[2]
        x, y = (r @ axes[1:].T / (r @ axes[0])[:, None]).T * 10.0
        terms = np.column_stack([x**i * y**j for i in range(4) for j in range(4 - i)])[all_have]
        rest = []
        for (_, index), places in zip(near, measured, strict=True):
            at = np.asarray(places[k])[index[all_have]]
            rest.append(at - terms @ np.linalg.lstsq(terms, at, rcond=None)[0])
        factor = np.sqrt(len(terms) / (len(terms) - terms.shape[1]))
        for parts, e in zip(left, rest, strict=True):
            parts.append(e * factor)
    return [float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) for parts in left]


def counted(words: str) -> Same:
    """Ours and theirs, side by side: no two programs find the same."""
    return lambda ours, rival: Agreement(f"{rival['found']} {words}, ours {ours['found']}", True)


# --- running
# --------------------------------------------------------------------------------------------------


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
        # It knew no Numba: ArviZ, which uses it where it is, then gave arrays where it expected
        # numbers.
        hide = 'import sys\n\nsys.modules["numba"] = None\n'
        (CACHE / "before" / "sitecustomize.py").write_text(hide, encoding="utf-8")
        compileall.compile_dir(CACHE / "before", quiet=1)


def run_row(
    row: Row, repeats: int | None = None, tell: Callable[[str], None] = lambda text: None
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

    runs = take_turns(row.contestants, repeats or row.repeats, start, tell)
    for run in runs:
        drawn = [turn.result for turn in run.turns.values() if "draws" in turn.result]
        for result in drawn:
            result["moments"] = moments(result["draws"])
        for result in drawn[:1]:
            shutil.rmtree(Path(result["draws"]).parent)
    return record(row, runs)


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


def record(row: Row, runs: Sequence[Runs]) -> dict[str, Any]:
    """All figures of a row, as they are kept."""
    mine, listed = runs[0], []
    for run in runs:
        entry: dict[str, Any] = {
            "label": run.label,
            "missing": run.missing,
            "turns": len(run.turns),
        }
        if run.turns:
            entry["peak_mb"] = run.peak_mb
            entry["first_s"] = run.first and run.first.wall
            for clock in CLOCKS:
                entry[clock] = vars(
                    spread([cost(t, clock, row.amount) for t in run.turns.values()])
                )
            if run is not mine and mine.turns:
                agreement = row.same(mine.turns[0].result, run.turns[0].result)
                entry["answer"], entry["same"] = agreement.words, agreement.same
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
        "load": os.getloadavg()[0],
        "contestants": listed,
        "targets": [judged(row, target, listed) for target in row.targets],
    }


def judged(row: Row, target: Target, listed: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """A target and what came out; one in time is met where both clocks say so."""
    mine = listed[0]
    said: dict[str, Any] = {
        "asked": target.words,
        "rival": target.rival,
        "measured": None,
        "met": None,
    }
    if target.factor is not None:
        rival = next(entry for entry in listed if entry["label"] == target.rival)
        subject = next((entry for entry in listed if entry["label"] == target.of), None)
        found = [rival.get(f"{clock}_ratio") for clock in CLOCKS]
        by = [
            {"median": 1.0} if target.of is None else subject and subject.get(f"{clock}_ratio")
            for clock in CLOCKS
        ]
        if all(found) and all(by):
            factors = [f["median"] / b["median"] for f, b in zip(found, by, strict=True)]
            said["measured"] = f"{factors[0]:.2g} times (wall clock {factors[1]:.2g})"
            said["met"] = min(factors) >= target.factor
    elif target.seconds is not None and mine["turns"]:
        took = mine[target.clock]["median"]
        said["measured"], said["met"] = seconds(took), took <= target.seconds
    elif target.exponent is not None and all(entry["turns"] for entry in listed):
        sizes = np.log([contestant.options["n_frames"] for contestant in row.contestants])
        slope = float(
            np.polyfit(sizes, np.log([entry["processor"]["median"] for entry in listed]), 1)[0]
        )
        said["measured"], said["met"] = f"{slope:.2f}", slope <= target.exponent
    elif target.peak_mb is not None and "peak_mb" in mine:
        said["measured"], said["met"] = (
            f"{mine['peak_mb']:,.0f} MB",
            mine["peak_mb"] <= target.peak_mb,
        )
    return said


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


def times(found: Mapping[str, float] | None) -> str:
    """Median and quartiles of a ratio."""
    return (
        "–"
        if not found
        else f"**{found['median']:.3g}** ({found['low']:.3g} to {found['high']:.3g})"
    )


def table(records: Sequence[Mapping[str, Any]]) -> str:
    """All contestants of all rows."""
    head = (
        "",
        "Processor",
        "Wall",
        "Times ours (processor)",
        "Times ours (wall)",
        "Peak MB",
        "Beside our answer",
    )
    lines = []
    for record in records:
        where = "one core" if record["one_core"] else "all cores"
        unit = f" ({record['unit']})" if record["unit"] else ""
        lines += [
            f"\n### {record['what']}{unit}\n",
            (
                f"`{record['name']}`, {where}, {record['made']}, load of the machine "
                f"{record.get('load', 0.0):.1f}.\n"
            ),
        ]
        lines += ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
        for entry in record["contestants"]:
            if not entry["turns"]:
                reason = " ".join(
                    (entry["missing"] or "it was not its turn").replace("|", "/").split()
                )
                lines.append(
                    f"| {entry['label']} | not measured: {reason} |" + " |" * (len(head) - 2)
                )
                continue
            cells = [
                entry["label"],
                seconds(entry["processor"]["median"]),
                seconds(entry["wall"]["median"]),
            ]
            cells += [
                times(entry.get("processor_ratio")),
                times(entry.get("wall_ratio")),
                f"{entry['peak_mb']:,.0f}",
            ]
            answer = entry.get("answer", "")
            cells.append(answer if entry.get("same", True) else f"**another answer**: {answer}")
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines).strip()


def targets(records: Sequence[Mapping[str, Any]]) -> str:
    """What was asked and what came out."""
    lines = ["| What | Asked | Measured | Beside | Met |", "|---|---|---|---|---|"]
    for record in records:
        for target in record["targets"]:
            met = {True: "yes", False: "**no**", None: "not measured"}[target["met"]]
            cells = (
                record["what"],
                target["asked"],
                target["measured"] or "–",
                target["rival"] or "itself",
                met,
            )
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def write(made: Sequence[dict[str, Any]]) -> None:
    """Keep the records, and make the page from all that are kept, in the order of the rows."""
    kept = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else []
    merged = {r["name"]: r for r in [*kept, *made]}
    ordered = [merged[row.name] for row in rows() if row.name in merged]
    RESULTS.write_text(json.dumps(ordered, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    machines = "; ".join(sorted({r["machine"] for r in ordered}))
    put(PAGE, "targets", targets(ordered))
    put(PAGE, "benchmarks", f"Machine: {machines}.\n\n{table(ordered)}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="NAME", help="names of rows, or parts of names"
    )
    parser.add_argument("--quick", action="store_true", help="less data, fewer turns")
    parser.add_argument("--large", action="store_true", help="also the rows that take minutes each")
    parser.add_argument("--repeats", type=int, help="turns of each row")
    parser.add_argument(
        "--write", action="store_true", help="put the results into the documentation"
    )
    parser.add_argument("--list", action="store_true", help="names of the rows")
    options = parser.parse_args(arguments)
    if options.quick and options.write:
        parser.error(
            "--quick is for a look: what is written has all its data; leave one of them out."
        )
    listed = rows(options.quick)
    names = {row.name for row in listed}

    def asked(row: Row) -> bool:
        return not options.only or any(
            row.name == o or (o not in names and o in row.name) for o in options.only
        )

    chosen = [row for row in listed if asked(row)]
    if options.list:
        print(
            "\n".join(
                f"{row.name:20} {row.what}{' (--large)' if row.large else ''}" for row in chosen
            )
        )
        return 0
    if not options.large:
        chosen = [row for row in chosen if not row.large or row.name in options.only]
    if not chosen:
        parser.error(f"no row is called {' or '.join(options.only)}; --list names them.")

    def tell(text: str) -> None:
        print(text, file=sys.stderr)

    made = []
    for row in chosen:
        made.append(run_row(row, options.repeats, tell))
        print(f"{table(made[-1:])}\n", flush=True)
        if options.write:
            write(made)
    if any(record["targets"] for record in made):
        print(targets(made))
    return 0


if __name__ == "__main__":
    sys.exit(main())
