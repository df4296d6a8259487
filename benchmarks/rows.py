"""The questions that the benchmarks ask, and who answers each of them."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.answers import (
    Agreement,
    Same,
    counted,
    same_arrays,
    same_attitudes,
    same_draws,
    same_estimate,
    same_frames,
)
from benchmarks.harness import ROOT, Contestant

IMAGES = Path(os.environ.get("STARCAL_IMAGES", ROOT.parent / "shared" / "data" / "esa-tetra3"))
TABLE, NOMINAL = (
    IMAGES.parent / "esa_tetra3_observations.csv",
    IMAGES.parent / "esa_tetra3_camera.toml",
)
# By its defaults tetra3rs takes the noise of short exposures for stars; of what was tried, this
# solves most of them.
SHORT_EXTRACTION = {"matched_filter_sigma": None, "sigma_threshold": 8.0, "min_pixels": 5}
# What the package decides to use without and with the extra that compiles.
PLAIN, COMPILED = {"STARCAL_UQ_KERNELS": "numpy"}, {"STARCAL_UQ_KERNELS": "auto"}
OURS, BEFORE = "starcal_uq", "starcal_uq before"
BUNDLE = "NumPy bundle, angles eliminated"
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
class Target:
    """What the package aims at: words, and the rival that they name."""

    words: str
    rival: str | None = None
    peak: bool = False  # A limit of memory, and not of time


@dataclass(frozen=True)
class Row:
    """One question."""

    name: str  # Word for ``--only``
    what: str  # Heading in the table
    contestants: tuple[Contestant, ...]  # Ours without extras first
    same: Same = lambda ours, rival: Agreement("–", True)  # Compares (ours, rival's) results
    unit: str = ""  # What the times are for, where a call does not always do as much
    amount: Callable[[Any], float] = lambda result: 1.0  # How many of it a result holds
    frames: int = 0  # Frames of the data; 0 for none
    repeats: int = 5  # Turns
    # All contestants on one core and one thread; otherwise as a user would start them.
    one_core: bool = True
    large: bool = False  # Runs only when it is asked for
    targets: tuple[Target, ...] = ()


def ours(call: str, options: Mapping[str, Any] | None = None) -> tuple[Contestant, ...]:
    """The package without and with the extra that compiles, and the version before, without."""
    options = options or {}
    return (
        Contestant(OURS, call, options=options, environment=PLAIN, how="no extra"),
        Contestant(
            f"{OURS}[compiled]", call, options=options, environment=COMPILED, how="extra compiled"
        ),
        Contestant(BEFORE, call, "before", options, environment=PLAIN, how="no extra"),
    )


def on_images(call: str, options: Mapping[str, Any]) -> tuple[Contestant, ...]:
    """The package and the version before on images, whose extra both need; none compiles."""
    return tuple(
        Contestant(label, call, python, options, environment=PLAIN, how="extra images")
        for label, python in ((OURS, "own"), (BEFORE, "before"))
    )


def rows() -> list[Row]:
    """All questions."""
    per_frame: dict[str, Any] = {
        "unit": "for a frame",
        "amount": lambda result: float(result["frames"]),
        "repeats": 3,
    }
    return [*estimates(), *posteriors(), *parts(), *commands(), *images(per_frame), *large()]


def estimates() -> list[Row]:
    """Optics with their covariance."""
    bundle = Target("no longer than the NumPy bundle, in the same process", BUNDLE)
    made = [
        Row(
            name=f"calibrate-{frames}",
            what=f"Estimate of the optics with its covariance, {frames:,} frames",
            contestants=(
                *ours("ours:calibrate"),
                Contestant(BUNDLE, "bundles:schur", how="NumPy"),
                Contestant("SciPy sparse bundle", "bundles:sparse", how="SciPy"),
                Contestant("SciPy least_squares, sparse", "bundles:least_squares", how="SciPy"),
                # More than four minutes a call at 100,000 frames.
                *(
                    [Contestant("mrcal", "bundle_mrcal:bundle", "system", how="C")]
                    if frames <= 10_000
                    else []
                ),
            ),
            same=same_estimate(),
            frames=frames,
            large=frames > 10_000,
            targets=(bundle,),
        )
        for frames in (1000, 10_000, 100_000)
    ]
    stages = Row(
        name="three-stages",
        what="The paper's three stages with sandwich covariance, 1,000 frames",
        contestants=(
            *ours("ours:three_stages"),
            Contestant("SciPy LM on explicit pairs", "pairs:three_stages", how="SciPy"),
        ),
        same=same_estimate(),
        frames=1000,
    )
    return [*made, stages]


def posteriors() -> list[Row]:
    """Draws, and what is made of them."""
    draws = Row(
        name="sample",
        what="1,000 effective draws from the posterior, 1,000 frames",
        contestants=(
            *ours("ours:sample"),
            Contestant("NUTS (NumPyro)", "nuts:numpyro", "rivals", how="JAX, compiled"),
            Contestant("emcee", "samplers:ensemble", how="NumPy"),
        ),
        same=same_draws,
        unit="for 1,000 effective draws",
        amount=lambda result: float(min(result["moments"][2])) / 1000.0,
        frames=1000,
        repeats=3,
    )
    sizes = (1000, 100_000)
    return [
        draws,
        *(
            Row(
                name=f"{name}-100000",
                what=f"`{name}` by number of frames",
                contestants=tuple(
                    replace(one, label=f"{one.label}, {n:,} frames", options={"n_frames": n})
                    for one in ours(f"ours:{name}")
                    for n in sizes
                ),
                repeats=2,
                large=True,
                targets=(Target(words, f"{OURS}, {sizes[1]:,} frames"),),
            )
            for name, words in (
                ("sample", "100,000 frames at most 1.2 times as long as 1,000"),
                ("propagate", "100,000 frames at most 3 times as long as 1,000"),
                ("diagnose", "100,000 frames at most 3 times as long as 1,000"),
            )
        ),
    ]


def parts() -> list[Row]:
    """Single functions."""
    points = {"points": 1_000_000}
    return [
        Row(
            name="attitudes",
            what="4,000 attitudes of 12 stars",
            contestants=tuple(
                Contestant(label, call, options={"frames": 4000, "stars": 12}, how=how)
                for label, call, how in (
                    (OURS, "ours:quest", "no extra"),
                    ("NumPy, singular values of all frames", "attitudes:kabsch", "NumPy"),
                    ("NumPy, eigenvectors of all frames", "attitudes:davenport", "NumPy"),
                    ("SciPy align_vectors, frame by frame", "attitudes:align_vectors", "SciPy"),
                )
            ),
            same=same_attitudes,
        ),
        *(
            Row(
                name=name,
                what=what,
                contestants=(
                    *ours(f"ours:{name}", points),
                    Contestant(f"OpenCV {theirs}", f"points:{name}", "rivals", points, how="C++"),
                ),
                same=same_arrays(*limits),
            )
            for name, what, theirs, limits in (
                (
                    "project",
                    "A million directions to pixels",
                    "projectPoints",
                    ("xy", 1.0, "px", 1e-6),
                ),
                (
                    "unproject",
                    "A million pixels to directions",
                    "undistortPoints",
                    ("b", 206264.8, "arcsec", 1e-4),
                ),
            )
        ),
    ]


def command(
    name: str, what: str, words: Sequence[str], needs: Path | None = None, **more: Any
) -> Row:
    """A whole command in a fresh process, as a user starts it: each call is a first one."""
    options = {"arguments": list(words), "needs": None if needs is None else str(needs)}
    kept: dict[str, Any] = {"repeats": 3, "one_core": False}
    return Row(name, what, ours("ours:command", options), **(kept | more))


def commands() -> list[Row]:
    """Commands; none of their calls is warm."""
    python = Contestant("python -c pass", "ours:imported", options={"code": "pass"}, how="Python")
    code = "import starcal_uq; starcal_uq.calibrate"
    return [
        Row(
            name="version",
            what="`starcal-uq --version` in a fresh process",
            contestants=(*ours("ours:command", {"arguments": ["--version"]}), python),
            targets=(Target("0.1 s more than Python's own start", "python -c pass"),),
        ),
        Row(
            name="import",
            what="`import starcal_uq` and all that `calibrate` needs, in a fresh process",
            contestants=(*ours("ours:imported", {"code": code}), python),
        ),
        command(
            "demo",
            "`starcal-uq demo`",
            ["demo", "--out", "{out}"],
            targets=(Target("0.6 of the time before", BEFORE),),
        ),
        command(
            "run-table",
            "`starcal-uq run` on the table of ESA's night-sky frames (567 stars)",
            ["run", str(TABLE), str(NOMINAL), "--out", "{out}"],
            TABLE,
            targets=(Target("0.6 of the time before", BEFORE),),
        ),
        command(
            "run-images",
            "`starcal-uq run` on ESA's night-sky images without a sheet",
            ["run", str(IMAGES), "--pixel-um", "6.9", "--out", "{out}"],
            IMAGES,
            targets=(Target("0.7 of the time before", BEFORE),),
        ),
    ]


def images(per_frame: dict[str, Any]) -> list[Row]:
    """Frames alone: each is measured and identified without the others."""
    sheet = {"images": str(IMAGES), "camera": str(NOMINAL)}
    short = {"images": str(IMAGES.parent / "openstartracker"), "field": 6.08}

    def rivals(name: str, options: Mapping[str, Any]) -> tuple[Contestant, ...]:
        return (
            Contestant("cedar-solve", f"images_cedar:{name}", "cedar", options, how="NumPy"),
            Contestant("tetra3rs", f"images_tetra3rs:{name}", "rivals", options, how="Rust"),
        )

    def found(ours: Mapping[str, Any], rival: Mapping[str, Any]) -> Agreement:
        words = (f"{one['found']} frames, {one['wrong']} wrong" for one in (rival, ours))
        return Agreement(next(words), True, next(words))

    made = [
        Row(
            name="centroids",
            what="Centroids of ESA's night-sky frames, each alone",
            contestants=(*on_images("ours:centroids", sheet), *rivals("centroids", sheet)),
            same=counted("stars found"),
            targets=(Target("15 ms", "tetra3rs"),),
            **per_frame,
        ),
        Row(
            name="identify",
            what="Identification of ESA's night-sky frames with a sheet, each alone",
            contestants=(*on_images("ours:identify", sheet), *rivals("identify", sheet)),
            same=counted("frames identified"),
            targets=(Target("2 ms", "tetra3rs"),),
            **per_frame,
        ),
        Row(
            name="frames",
            what="ESA's night-sky frames, each alone: what is found, and how much of it is right",
            contestants=(*on_images("ours:frames", sheet), *rivals("frames", sheet)),
            same=same_frames(TABLE),
            **(per_frame | {"amount": lambda result: float(len(result["frames"]))}),
        ),
    ]
    for name, whose, options, targets in (
        (
            "unknown",
            "ESA's night-sky",
            {"images": str(IMAGES), "field": 11.42},
            (Target("40 ms", "tetra3rs"),),
        ),
        ("unknown-short", "openstartracker's", short, ()),
    ):
        more = Contestant(
            "tetra3rs, thresholds chosen for these images",
            "images_tetra3rs:identify_unknown",
            "rivals",
            options | {"extraction": SHORT_EXTRACTION},
            how="Rust",
        )
        made.append(
            Row(
                name=f"identify-{name}",
                what=f"Identification of {whose} frames without a sheet, each alone",
                contestants=(
                    *on_images("ours:identify_unknown", options),
                    *rivals("identify_unknown", options),
                    *((more,) if options is short else ()),
                ),
                same=found,
                targets=targets,
                **per_frame,
            )
        )
    made += [
        Row(
            name=f"field-{degrees}",
            what=f"A simulated frame {degrees} degrees wide, identified without a sheet",
            contestants=on_images("ours:field", {"degrees": degrees, "max_mag": limit}),
            same=found,
            repeats=3,
            targets=(Target("2 s"),),
        )
        for degrees, limit in ((3, 9.0), (60, 5.5))
    ]
    return made


def large() -> list[Row]:
    """Rows that take minutes each."""
    camera = "{data}/camera.toml"
    partitions = ["simulate", camera, "--frames", "200000", "--partition-frames", "10000"]
    return [
        command(
            "run-10000",
            "`starcal-uq run`, 10,000 frames",
            ["run", "{data}/stars.parquet", camera, "--out", "{out}"],
            frames=10_000,
            repeats=2,
            large=True,
        ),
        command(
            "simulate",
            "`starcal-uq simulate` to a folder of partitions, 200,000 frames",
            [*partitions, "--out", "{out}"],
            frames=1000,
            large=True,
            targets=(Target("10 s of processor time"),),
        ),
        command(
            "run-1000000",
            "`starcal-uq run`, 1,000,000 frames in a folder of partitions",
            ["run", "{data}/frames", camera, "--out", "{out}"],
            frames=1_000_000,
            repeats=1,
            large=True,
            targets=(Target("90 s of wall time on two cores"), Target("2,000 MB", peak=True)),
        ),
        *(
            Row(
                name=f"study-{mode}",
                what=f"`study`, {cells:,} cells {words}",
                contestants=ours("ours:study", {"definition": text}),
                repeats=1,
                one_core=False,
                large=True,
                targets=(Target(f"{limit} s of wall time on two cores"),),
            )
            for mode, cells, words, text, limit in (
                (
                    "fisher",
                    10_000,
                    "by Fisher information, of 300 frames",
                    STUDY.format("fisher", 300, 20),
                    60,
                ),
                (
                    "simulate",
                    1000,
                    "simulated with their posteriors, of 50 frames",
                    STUDY.format("simulate", 50, 2),
                    120,
                ),
            )
        ),
    ]
