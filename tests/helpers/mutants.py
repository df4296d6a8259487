"""Damaged files of every kind that the package reads, and what its loaders say of them.

`SAMPLES` is the table of readers: a small valid file each, with the public names that read it.
`mutant` damages it: as bytes, as text, or inside its format, so that the damage passes the
checksums of archives and meets the code behind them. `judge` loads it and says what came out. All
chance is in a `random.Random`, which hypothesis can play as well.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import random
import re
import shutil
import struct
import traceback
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import starcal_uq as sc
from starcal_uq.core.errors import StarcalError
from starcal_uq.core.files import sealed

PREVIOUS = Path(__file__).resolve().parents[1] / "runs" / "data" / "previous"


@dataclass(frozen=True)
class Sample:
    """A kind of file."""

    file: str  # Name of the valid file in the folder of samples
    load: Callable[[Path], Any]  # Reads it, as a user does
    reads: tuple[str, ...]  # Public names whose files these are
    beside: tuple[str, ...] = ()  # Files that must stand beside it

    @property
    def ending(self) -> str:
        return self.file.rpartition(".")[2]

    @property
    def binary(self) -> bool:
        return self.ending in (
            "npz",
            "nc",
            "parquet",
            "fits",
            "bin",
            "gz",
            "tiff",
            "png",
            "jpg",
            "bmp",
        )


@cache
def _content(path: Path) -> bytes:
    return path.read_bytes()


def _all(items: Any) -> list[Any]:
    return list(items)


@cache
def _camera() -> sc.Camera:
    return sc.Camera.load(PREVIOUS / "camera.toml")


@cache
def _calibration() -> sc.Calibration:
    return sc.Calibration.load(PREVIOUS / "calibration.json")


@cache
def _observations() -> sc.Observations:
    return sc.load_observations(PREVIOUS / "observations.parquet")


def _checkpoint(path: Path) -> Any:
    from starcal_uq.inference.ensemble import EnsembleSettings, _Store

    store = _Store(2, EnsembleSettings(16, 6, 10, 2), 6, path, "fingerprint")
    if store.state is None:
        raise StarcalError(f"{path}: the draws are made again.")
    return store


def _pairs(path: Path) -> Any:
    from starcal_uq.identification.pairs import _read

    pairs = _read(path)
    if pairs is None:
        raise StarcalError(f"{path}: the pairs are made again.")
    return pairs


def _store(path: Path) -> Any:
    from starcal_uq.studies.store import _read

    return _read(path)


def _frames(path: Path) -> Any:
    from starcal_uq.runs.steps.misfit import _frames_of

    return _frames_of(path)


def _gaia(path: Path) -> Any:
    from starcal_uq.sky.gaia import read_gaia_records

    return read_gaia_records(path)


def _image_record(path: Path) -> Any:
    from starcal_uq.pipeline.record import ImageRecord

    return ImageRecord.load(path)


def _manifest(path: Path) -> Any:
    from starcal_uq.core.manifest import read_manifest

    return read_manifest(path.parent)


def _partitions(path: Path) -> Any:
    whole = sc.observations.open_partitions(path.parent)
    return [whole.meta, whole.n_frames, _all(whole)]


def _image(path: Path) -> Any:
    image = sc.images.read_image(path)
    assert len(sc.images.read_images(path)) > 0
    return [image, sc.images.extract_centroids(image)]


IMAGES = (
    "image.fits",
    "image.fits.gz",
    "tiles.fits",
    "image.tiff",
    "image.png",
    "colours.png",
    "image.jpg",
    "image.bmp",
)
# Format of another program, by the file.
CAMERAS = {
    "opencv.yaml": "opencv",
    "ros.yml": "ros",
    "kalibr.yaml": "kalibr",
    "mrcal.cameramodel": "mrcal",
}
SAMPLES = (
    *(Sample(name, _image, ("images.read_image", "images.read_images")) for name in IMAGES),
    *(Sample(name, sc.Camera.load, ("Camera.load",)) for name in ("camera.toml", *CAMERAS)),
    Sample("sensor.toml", sc.simulation.Sensor.load, ("simulation.Sensor.load",)),
    Sample("site.toml", sc.sky.Site.load, ("sky.Site.load",)),
    Sample(
        "priors.toml",
        lambda path: [sc.runs.load_priors(path, _camera()), sc.Priors.from_toml(path, _camera())],
        ("runs.load_priors", "Priors.from_toml"),
    ),
    Sample("chain.toml", lambda path: sc.runs.load_priors(path, _camera()), ("runs.load_priors",)),
    Sample("budget.toml", sc.budgeting.load_budget_file, ("budgeting.load_budget_file",)),
    Sample("study.toml", sc.studies.StudyDefinition.load, ("studies.StudyDefinition.load",)),
    Sample("observations.csv", sc.load_observations, ("load_observations",)),
    Sample("observations.ecsv", sc.load_observations, ("load_observations",)),
    Sample("observations.parquet", sc.load_observations, ("load_observations",)),
    Sample(
        "stream.csv",
        lambda path: _all(sc.paper.stream_frames(path)),
        ("paper.stream_frames",),
    ),
    Sample(
        "stream.parquet",
        lambda path: _all(sc.paper.stream_frames(path)),
        ("paper.stream_frames",),
    ),
    Sample("part.parquet", _partitions, ("observations.open_partitions",)),
    Sample("frames.parquet", _frames, ("Run",)),
    Sample("centroids.csv", sc.images.Centroids.load, ("images.Centroids.load",)),
    Sample("centroids.ecsv", sc.images.Centroids.load, ("images.Centroids.load",)),
    Sample("centroids.parquet", sc.images.Centroids.load, ("images.Centroids.load",)),
    Sample("profile.csv", sc.attitude.load_attitude_profile, ("attitude.load_attitude_profile",)),
    Sample("profile.ecsv", sc.attitude.load_attitude_profile, ("attitude.load_attitude_profile",)),
    Sample(
        "profile.parquet", sc.attitude.load_attitude_profile, ("attitude.load_attitude_profile",)
    ),
    Sample(
        "relative.csv", sc.attitude.load_relative_attitudes, ("attitude.load_relative_attitudes",)
    ),
    Sample(
        "orbit.csv",
        sc.propagation.load_temperature_profile,
        ("propagation.load_temperature_profile",),
    ),
    Sample("catalogue.csv", sc.sky.read_catalogue, ("sky.read_catalogue",)),
    Sample("catalogue.ecsv", sc.sky.read_catalogue, ("sky.read_catalogue",)),
    Sample("catalogue.fits", sc.sky.read_catalogue, ("sky.read_catalogue",)),
    Sample("catalogue.csv.gz", sc.sky.read_catalogue, ("sky.read_catalogue",)),
    Sample("hip_main.dat", sc.sky.read_catalogue, ("sky.read_catalogue",)),
    Sample("gaia.bin", _gaia, ("load_catalogue",)),
    Sample("calibration.json", sc.Calibration.load, ("Calibration.load",), ("calibration.npz",)),
    Sample(
        "calibration.npz",
        lambda path: sc.Calibration.load(path.with_suffix(".json")),
        ("Calibration.load",),
        ("calibration.json",),
    ),
    Sample("posterior.nc", sc.Posterior.load, ("Posterior.load",)),
    Sample("checkpoint.npz", _checkpoint, ("sample",)),
    Sample(
        "state.npz",
        sc.paper.RecursiveCalibration.load,
        ("paper.RecursiveCalibration.load",),
    ),
    Sample("attitude.csv", sc.propagation.AttitudeError.load, ("propagation.AttitudeError.load",)),
    Sample("field_map.npz", sc.propagation.FieldMap.load, ("propagation.FieldMap.load",)),
    Sample("spectrum.npz", sc.propagation.ErrorSpectrum.load, ("propagation.ErrorSpectrum.load",)),
    Sample("budget.csv", sc.budgeting.Budget.load, ("budgeting.Budget.load",)),
    Sample(
        "comparison.json",
        sc.comparison.CameraComparison.load,
        ("comparison.CameraComparison.load",),
    ),
    Sample("diagnosis.json", sc.diagnostics.Diagnosis.load, ("diagnostics.Diagnosis.load",)),
    Sample("validation.npz", sc.diagnostics.Validation.load, ("diagnostics.Validation.load",)),
    Sample("images.json", _image_record, ("Run",)),
    Sample("run.json", _manifest, ("Run",)),
    Sample("replicates.npz", sc.paper.Replicates.load, ("paper.Replicates.load",)),
    Sample(
        "interaction.csv", sc.paper.InteractionStudy.load_csv, ("paper.InteractionStudy.load_csv",)
    ),
    Sample("study.nc", sc.studies.Study.load, ("studies.Study.load",)),
    Sample("cells.parquet", _store, ("study",)),
    Sample("pairs.npz", _pairs, ("identification.identify",)),
)


# Written after all others.
LAST = "pairs.npz"


def write_samples(folder: Path) -> None:
    """Write the valid files."""
    for path in PREVIOUS.iterdir():
        shutil.copy(path, folder / path.name)
    obs = _observations()
    obs.save(folder / "observations.csv")
    obs.save(folder / "observations.ecsv")
    for name in ("stream.csv", "stream.parquet"):
        obs.save(folder / name)
    shutil.copy(PREVIOUS / "observations.parquet", folder / "part.parquet")
    shutil.copy(PREVIOUS / "observations.parquet", folder / "frames.parquet")
    _write_images(folder)
    _write_tables(folder)
    _write_results(folder)


def _write_images(folder: Path) -> None:
    import gzip

    import PIL.Image
    from astropy.io import fits

    rng = np.random.default_rng(2)
    pixels = rng.normal(90.0, 3.0, (40, 48))
    pixels[20, 20:22] += 120.0
    header = fits.Header(
        {"DATE-OBS": "2026-11-21T01:02:03", "EXPTIME": 1.0, "EGAIN": 2.0, "SATURATE": 4000.0}
    )
    whole = fits.PrimaryHDU(pixels.astype(np.uint16), header)
    whole.writeto(folder / "image.fits")
    (folder / "image.fits.gz").write_bytes(
        gzip.compress((folder / "image.fits").read_bytes(), mtime=0)
    )
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(whole.data, header)]).writeto(
        folder / "tiles.fits"
    )
    PIL.Image.fromarray(whole.data).save(folder / "image.tiff", compression="tiff_deflate")
    PIL.Image.fromarray(whole.data).save(folder / "image.png")
    grey = PIL.Image.fromarray(pixels.astype(np.uint8))
    grey.save(folder / "image.jpg")
    grey.save(folder / "image.bmp")
    grey.convert("P").save(folder / "colours.png", transparency=3)


def _write_tables(folder: Path) -> None:
    from astropy.table import Table

    from tests.helpers.plate_solver import write_gaia_records
    from tests.sky.test_readers import HIPPARCOS

    rng = np.random.default_rng(1)
    n = 12
    columns = {
        **{
            "frame": np.repeat([1, 2, 4], 4),
            "x_px": rng.uniform(0, 900, n),
            "y_px": rng.uniform(0, 900, n),
        },
        **dict.fromkeys(("var_x_px2", "var_y_px2"), np.full(n, 0.01)),
        **{"cov_xy_px2": np.zeros(n), "flux": rng.uniform(1e3, 1e4, n), "snr": np.full(n, 30.0)},
        **{
            "peak": np.full(n, 900.0),
            **dict.fromkeys(("saturated", "blended", "edge"), np.arange(n) % 5 == 0),
        },
    }
    frames = {
        **{
            "frame_ids": [1, 2, 3, 4],
            "image": list("abcd"),
            "time_utc": [""] * 4,
            "background": [100.0] * 4,
        },
        **{"noise": [5.0] * 4, "psf_sigma_px": [1.0] * 4, "problem": ["", "", "no star", ""]},
    }
    centroids = sc.images.Centroids(
        **columns, **frames, messages=("one",), meta={"flux_unit": "adu"}
    )
    for ending in ("csv", "ecsv", "parquet"):
        centroids.save(folder / f"centroids.{ending}")
    q = rng.standard_normal((8, 4)) * 0.01 + [0.0, 0.0, 0.0, 1.0]
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    profile = Table(
        dict(zip(("time_s", "qx", "qy", "qz", "qw"), (np.arange(8.0), *q.T), strict=True))
    )
    profile.write(folder / "profile.csv", format="ascii.csv")
    profile.write(folder / "profile.ecsv", format="ascii.ecsv", delimiter=",")
    profile.to_pandas().to_parquet(folder / "profile.parquet")
    turns = {name: profile[name] for name in ("qx", "qy", "qz", "qw")}
    pairs = {"frame_a": np.arange(8), "frame_b": np.arange(1, 9), "sigma_arcsec": np.full(8, 2.0)}
    Table({**pairs, **turns}).write(folder / "relative.csv", format="ascii.csv")
    Table({"time_s": np.arange(8.0), "temperature_c": rng.uniform(-20.0, 20.0, 8)}).write(
        folder / "orbit.csv", format="ascii.csv"
    )
    stars = Table(
        {
            **{
                "star_id": [f"S {i}" for i in range(9)],
                "ra": rng.uniform(0, 360, 9),
                "dec": rng.uniform(-80, 80, 9),
            },
            **{"mag": rng.uniform(2, 6, 9), "pmra": np.full(9, 5.0), "pmdec": np.full(9, -5.0)},
            "epoch": np.full(9, 2016.0),
        }
    )
    stars.write(folder / "catalogue.csv", format="ascii.csv")
    stars.write(folder / "catalogue.ecsv", format="ascii.ecsv")
    stars.write(folder / "catalogue.fits", format="fits")
    import gzip

    (folder / "catalogue.csv.gz").write_bytes(
        gzip.compress((folder / "catalogue.csv").read_bytes(), mtime=0)
    )
    (folder / "hip_main.dat").write_text("\n".join(HIPPARCOS) + "\n")
    write_gaia_records(
        folder / "gaia.bin", rng.uniform(0, 360, 9), rng.uniform(-80, 80, 9), rng.uniform(2, 6, 9)
    )


PRIORS = """[priors]
principal_point_px = 20.0
principal_point_centre_px = [512.0, 512.0]
"""
BUDGET = """[budget]
title = "Star tracker A"
confidence = 0.997

[frame.payload]
rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]

[[contributor]]
name = "thermo-elastic distortion"
axis = "roll"
sigma_arcsec = 1.5
distribution = "gaussian"
provenance = "TN-3"

[[contributor]]
name = "my own"
axis = "pitch"
half_width_arcsec = 0.5
distribution = "uniform"
ecss_class = "bias"
interpretation = "ensemble"
absorbed_by_alignment = "no"
provenance = "TN-4"

[[requirement]]
name = "R-1"
axis = "cross-boresight"
limit_arcsec = 10.0
frame = "payload"
"""


def _write_results(folder: Path) -> None:
    import pandas as pd

    from starcal_uq.core.manifest import Entry, Manifest, write_manifest
    from starcal_uq.core.store import write_part
    from starcal_uq.identification.pairs import StarPairs
    from starcal_uq.inference.ensemble import EnsembleSettings, _Store
    from starcal_uq.studies.store import Store, row
    from tests.helpers.studies import made_study

    for name, to in CAMERAS.items():
        sc.export(_camera(), to, folder / name)
    (folder / "priors.toml").write_text(PRIORS)
    (folder / "chain.toml").write_text('[priors]\nprior_from = "earlier"\ninflation = 2.0\n')
    (folder / "budget.toml").write_text(BUDGET)
    sc.studies.write_study_template("magnitude-noise", folder / "study.toml", force=True)
    posterior = sc.sample(
        _observations(), _calibration(), n_walkers=16, n_steps=8, n_ensembles=2, seed=1
    )
    posterior.save(folder / "posterior.nc", force=True)
    study = made_study({"max_mag": (5.0, 6.0)}, lambda cell: {}, seeds=2)
    study.data.attrs["definition"] = json.dumps(study.definition.to_dict())
    study.save(folder)
    write_manifest(
        folder,
        Manifest({"camera.toml": Entry(680, "0" * 64, "calibrate")}, {"calibrate": {"seed": 1}}),
    )
    cells = Store(None)
    cells.append([row("a", "brown", {"status": "ok", "truth": np.arange(5.0)})])
    write_part(cells.table(), folder / "cells.parquet")
    import emcee

    store = _Store(2, EnsembleSettings(16, 6, 10, 2), 6, folder / "checkpoint.npz", "fingerprint")
    state = np.random.RandomState(1).get_state()
    coords = np.zeros((16, 6))
    store.state = emcee.State(coords, log_prob=np.zeros(16), random_state=state)
    store._write(folder / "checkpoint.npz")
    table = {name: ["distortion"] for name in ("axis", "method", "handling", "parameter", "unit")}
    table |= {name: [3] for name in ("n_frames", "min_stars", "seed", "n", "failed")}
    numbers = (
        "value",
        "corner_px",
        "corner_size_px",
        "field_deg",
        "stars_per_frame",
        "max_mag",
        "sigma_px",
    )
    table |= {name: [0.123456789012345678] for name in (*numbers, "bias", "spread", "rmse", "crlb")}
    pd.DataFrame(table).to_csv(folder / "interaction.csv", index=False)
    n, p = 3, 2
    arrays = {
        **{"directions": np.eye(3), "star": np.arange(n), "angle": np.arange(float(p))},
        **{"first": np.arange(p), "second": np.arange(p), "neighbour_start": np.arange(n + 1)},
        **{"neighbour": np.arange(2 * p), "neighbour_angle": np.arange(2.0 * p)},
    }
    known = {f.name for f in dataclasses.fields(StarPairs)}
    np.savez(
        folder / "pairs.npz", **{name: value for name, value in arrays.items() if name in known}
    )


# What stands where a number or a text should.
ODD = (
    *(
        "nan",
        "inf",
        "-inf",
        "1e999",
        "1e300",
        "-1e300",
        "1e-320",
        "-1",
        "0",
        "",
        "text",
        "é",
        "\x00",
        "\x07",
    ),
    *(
        "1" * 30,
        "1" * 5000,
        '"',
        "'",
        "=1+1",
        "true",
        "None",
        "null",
        "-0.0",
        "2024-01-01T00:00:00",
        "\u2028",
        "0x10",
    ),
)
LITERALS = (
    *(
        "nan",
        "-inf",
        "1e300",
        "-1",
        "0",
        '""',
        '"text"',
        "[]",
        "{}",
        "true",
        "1979-05-27",
        "1" * 30,
        "1" * 5000,
    ),
    *(
        "[" * 3000 + "]" * 3000,
        "{a=" * 1500 + "1" + "}" * 1500,
        '"\\u0001"',
        "[1, 'a']",
        "1e-320",
        "07:32:00",
    ),
)
_NESTED = "@nested@"
NODES: tuple[Any, ...] = (
    *(
        None,
        True,
        "",
        "text",
        "\ud800",
        -1,
        0,
        1e300,
        float("nan"),
        float("inf"),
        10**30,
        10**400,
        [],
        {},
        [[]],
    ),
    *([1, 2], {"a": 1}, ["a"], [None], _NESTED, -0.5, "\x00", "9" * 5000),
)


def mutant(sample: Sample, data: bytes, rng: random.Random, other: bytes = b"") -> bytes:
    """The file, damaged once or a few times."""
    ways: list[Callable[[bytes, random.Random], bytes]] = [lambda d, r: _bytes(d, r, other)]
    ending = sample.ending
    if not sample.binary:
        ways.append(_text)
    if ending in ("toml",):
        ways.append(_toml)
    structural = {
        "json": _json,
        "npz": _npz,
        "parquet": _parquet,
        "nc": _netcdf,
        "fits": _fits,
        "png": _png,
    }.get(ending)
    if ending == "gz":
        structural = _packed
    if structural is not None:
        ways += [structural, structural]
    way = rng.choice(ways)
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        try:
            data = way(data, rng)
        except Exception:  # what is damaged already need not take a second blow inside its format
            data = _bytes(data, rng, other)
    return data


def _place(data: Any, rng: random.Random) -> int:
    return rng.randrange(len(data)) if data else 0


def _bytes(data: bytes, rng: random.Random, other: bytes) -> bytes:
    way, i, j = rng.randrange(9), _place(data, rng), _place(data, rng)
    changed = bytearray(data)
    if way == 0:
        return data[:i]
    if way == 1:
        return rng.choice((b"", b"\n", b"\x00", b" " * 40))
    if way == 2:
        for _ in range(rng.choice((1, 1, 3, 30))):
            if changed:
                changed[_place(changed, rng)] ^= 1 << rng.randrange(8)
        return bytes(changed)
    if way == 3:
        return data[:i] + other[_place(other, rng) :]
    if way == 4 and data:
        changed[i], changed[j] = changed[j], changed[i]
        return bytes(changed)
    low, high = sorted((i, j))
    if way == 5:
        return data[:low] + data[high:]
    if way == 6:
        return data[:low] + bytes(min(high - low, 512)) + data[low + min(high - low, 512) :]
    if way == 7:
        return (
            data[:i] + bytes(rng.randrange(256) for _ in range(rng.choice((1, 4, 16)))) + data[i:]
        )
    return data[:high] + data[low:]


def _text(data: bytes, rng: random.Random) -> bytes:
    text = data.decode("utf-8", "surrogateescape")
    lines = text.splitlines(keepends=True)
    way = rng.randrange(9)
    i, j = _place(lines, rng), _place(lines, rng)
    if not lines:
        return data
    if way == 0:
        del lines[i]
    elif way == 1:
        lines.insert(j, lines[i])
    elif way == 2:
        lines[i], lines[j] = lines[j], lines[i]
    elif way in (3, 4, 5):
        lines[i] = _token(lines[i], rng)
    elif way == 6:
        lines = _column(lines, rng)
    elif way == 7:
        lines = lines[: i + 1]
    else:
        lines[i] = (
            lines[i].rstrip("\n")
            + rng.choice((",", '"', "\t", " x", "," * 200, "9" * 200_000))
            + "\n"
        )
    return "".join(lines).encode("utf-8", "surrogateescape")


def _token(line: str, rng: random.Random) -> str:
    tokens = list(re.finditer(r"[^\s,|=\[\]{}\":]+", line))
    if not tokens:
        return line + rng.choice(ODD)
    token = tokens[_place(tokens, rng)]
    return line[: token.start()] + rng.choice(ODD) + line[token.end() :]


def _column(lines: list[str], rng: random.Random) -> list[str]:
    """Leave out or repeat a column of a table with commas, or rename it."""
    rows = [line.rstrip("\n").split(",") for line in lines]
    width = max(map(len, rows))
    place, way = rng.randrange(width), rng.randrange(4)
    for row in rows:
        if len(row) != width:
            continue
        if way == 0:
            del row[place]
        elif way == 1:
            row.append(row[place])
        elif way == 2:
            row[place] = rng.choice(ODD)
        else:
            row[place] = ""
    return [",".join(row) + "\n" for row in rows]


def _toml(data: bytes, rng: random.Random) -> bytes:
    lines = data.decode().splitlines(keepends=True)
    keys = [i for i, line in enumerate(lines) if re.match(r"\s*\w+ *=", line)]
    if not keys:
        return data
    i = rng.choice(keys)
    key = lines[i].partition("=")[0]
    way = rng.randrange(4)
    if way == 0:
        lines[i] = f"{key.strip()}x = 1\n"
    elif way == 1:
        lines[i] = f"[{key.strip()}]\n"
    else:
        lines[i] = f"{key}= {rng.choice(LITERALS)}\n"
    return "".join(lines).encode()


def _json(data: bytes, rng: random.Random) -> bytes:
    document = json.loads(data)
    return _dumped(_node(document, rng)).encode()


def _dumped(document: Any) -> str:
    return json.dumps(document).replace(f'"{_NESTED}"', "[" * 100_000 + "]" * 100_000)


def _node(document: Any, rng: random.Random) -> Any:
    """Change something in a tree of plain values, at a depth drawn at random."""
    if isinstance(document, dict) and document:
        key = rng.choice(list(document))
        way = rng.randrange(8)
        if way == 0:
            return {name: value for name, value in document.items() if name != key}
        if way == 1:
            return {
                (f"{name}_" if name == key else name): value for name, value in document.items()
            }
        if way == 2:
            return rng.choice(NODES)
        return {**document, key: _node(document[key], rng)}
    if isinstance(document, list) and document:
        i, way = rng.randrange(len(document)), rng.randrange(8)
        if way == 0:
            return document[:i] + document[i + 1 :]
        if way == 1:
            return [*document, document[i]]
        if way == 2:
            return rng.choice(NODES)
        return [*document[:i], _node(document[i], rng), *document[i + 1 :]]
    return rng.choice(NODES)


# Values of cards, and of the sizes in other headers.
CARDS = (
    *(
        b"T",
        b"0",
        b"1",
        b"-1",
        b"8",
        b"-32",
        b"64",
        b"999",
        b"1000000000000",
        b"99999999999999999999",
        b"1E300",
        b"NaN",
    ),
    *(
        b"''",
        b"'text'",
        b"'2026-11-21T25:00:00'",
        b"(1.0, 2.0)",
        b"",
        b"\xff",
        b"'open",
        b"-1E400",
        b"40000",
    ),
)


def _fits(data: bytes, rng: random.Random) -> bytes:
    """A card of a header changed, left out, repeated, or in the place of another."""
    cards = [
        i for i in range(0, len(data), 80) if re.match(rb"[A-Z0-9_-]{1,8} *=", data[i : i + 10])
    ]
    i, j, way = rng.choice(cards), rng.choice(cards), rng.randrange(6)
    card = data[i : i + 80]
    if way == 0:
        return data[:i] + b" " * 80 + data[i + 80 :]
    if way == 1:
        return data[:j] + card + data[j + 80 :]
    if way == 2:
        names = (
            b"BSCALE",
            b"BZERO",
            b"BLANK",
            b"PCOUNT",
            b"GCOUNT",
            b"GROUPS",
            b"NAXIS3",
            b"EXTEND",
            b"BAYERPAT",
        )
        card = rng.choice(names).ljust(8) + card[8:]
    return data[:i] + (card[:10] + rng.choice(CARDS).rjust(20)).ljust(80) + data[i + 80 :]


def _png(data: bytes, rng: random.Random) -> bytes:
    """A part of a PNG file changed, left out or repeated, with its checksum."""
    import zlib

    parts, place = [], 8
    while place + 12 <= len(data):
        (size,) = struct.unpack(">I", data[place : place + 4])
        parts.append((data[place + 4 : place + 8], data[place + 8 : place + 8 + size]))
        place += size + 12
    i, way = rng.randrange(len(parts)), rng.randrange(5)
    name, content = parts[i]
    if way == 0:
        del parts[i]
    elif way == 1:
        parts.insert(i, parts[i])
    elif way == 2 and name == b"IHDR":
        sizes = struct.pack(
            ">II", *(rng.choice((0, 1, 7, 40, 70_000, 2**31 - 1, 2**32 - 1)) for _ in range(2))
        )
        parts[i] = name, sizes + bytes(rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 255)) for _ in range(5))
    else:
        parts[i] = name, _bytes(content, rng, data)
    made = (
        struct.pack(">I", len(c)) + n + c + struct.pack(">I", zlib.crc32(n + c)) for n, c in parts
    )
    return data[:8] + b"".join(made)


def _packed(data: bytes, rng: random.Random) -> bytes:
    """What is inside a file of gzip, damaged and packed again."""
    import gzip

    content = gzip.decompress(data)
    if content.startswith(b"SIMPLE"):
        content = rng.choice(
            (_fits, lambda d, r: _bytes(d, r, data), lambda d, r: d + bytes(10**6))
        )(content, rng)
    else:
        content = _text(content, rng)
    return gzip.compress(content, mtime=0)


def _npz(data: bytes, rng: random.Random) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    name = rng.choice(list(members))
    way = rng.randrange(8)
    extra: list[tuple[str, bytes]] = []
    if way == 0:
        del members[name]
    elif way == 1:
        members[f"x{name}"] = members.pop(name)
    elif way == 2:
        extra = [(name, members[name])]
    elif way == 3:
        members[name] = _npy(rng.choice(_ARRAYS)(np.load(io.BytesIO(members[name]))))
    elif way == 4:
        members[name] = _header(members[name], rng)
    elif way == 5:
        members[name] = rng.choice(
            (b"", b"\x93NUMPY", b"text", members[name][:-4], members[name][:20])
        )
    else:
        document = next((m for m in ("document.npy", "header.npy") if m in members), None)
        if document is None:
            members[name] = _npy(rng.choice(_ARRAYS)(np.load(io.BytesIO(members[name]))))
        else:
            text = str(np.load(io.BytesIO(members[document])))
            members[document] = _npy(np.array(_dumped(_node(json.loads(text), rng))))
    stream = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(stream, "w", rng.choice((0, 8, 12))) as archive:
        warnings.simplefilter("ignore")
        for member, content in (*members.items(), *extra):
            archive.writestr(zipfile.ZipInfo(member), content)
    return stream.getvalue()


def _npy(array: Any) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def _numeric(array: Any) -> Any:
    return (
        np.asarray(array, dtype=float) if array.dtype.kind in "fiub" else np.zeros(np.shape(array))
    )


_ARRAYS: tuple[Callable[[Any], Any], ...] = (
    lambda a: a.ravel()[:-1],
    lambda a: a[None],
    lambda a: np.zeros((0,)),
    lambda a: np.zeros((2, 3, 4)),
    lambda a: np.float64(1.0),
    lambda a: np.full(np.shape(a), np.nan),
    lambda a: _numeric(a) * 1e300,
    lambda a: _numeric(a) + 1j,
    lambda a: np.full(np.shape(a), "text"),
    lambda a: np.array([{"a": 1}], dtype=object),
    lambda a: a.T.copy(),
    lambda a: -_numeric(a),
    lambda a: _numeric(a) + 10,
    lambda a: np.array("2020-01-01", dtype="datetime64[s]"),
    lambda a: a[..., :1] if np.ndim(a) else a,
    lambda a: np.zeros(np.shape(a), dtype=[("a", "f8")]),
)


def _header(member: bytes, rng: random.Random) -> bytes:
    """An array's file whose header declares something else."""
    array = np.load(io.BytesIO(member))
    descr = rng.choice(
        (array.dtype.str, "|O", "<f4", "<c16", "<U1000000", "<M8[s]", "|V8", "not a type")
    )
    shape = rng.choice(
        (array.shape, (10**12,), (10**6, 10**6), (-1,), (2**62, 4), "shape", (0,), (1.5,), (10**9,))
    )
    text = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape!r}, }}"
    if rng.random() < 0.1:
        text = "(" * 5000
    head = text.encode() + b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + member[-array.nbytes :]


def _parquet(data: bytes, rng: random.Random) -> bytes:
    import pyarrow as pa
    from pyarrow import parquet

    table = parquet.read_table(io.BytesIO(data))
    i, way = rng.randrange(table.num_columns), rng.randrange(10)
    name, column = table.column_names[i], table.column(i)
    if way == 0:
        table = table.remove_column(i)
    elif way == 1:
        table = table.append_column(name, column)
    elif way == 2:
        values: list[Any] = column.to_pylist()
        values[rng.randrange(len(values))] = None
        table = table.set_column(i, name, pa.array(values, column.type))
    elif way in (3, 4):
        n = len(column)
        odd: list[Any] = [
            *(
                ["text"] * n,
                [[1.0]] * n,
                [True] * n,
                [None] * n,
                [float("nan")] * n,
                [float("inf")] * n,
                [b"\xff"] * n,
            ),
            *(
                [2**62] * n,
                [-1] * n,
                [1e300] * n,
                [{"a": 1}] * n,
                [0.5] * n,
                [0] * n,
                ["\x00"] * n,
                ["1"] * n,
            ),
        ]
        table = table.set_column(i, name, pa.array(rng.choice(odd)))
    elif way == 5:
        table = table.slice(0, rng.choice((0, 1)))
    elif way == 6:
        table = table.set_column(i, rng.choice((f"{name}x", "", "\x00", "frame")), column)
    else:
        meta = dict(table.schema.metadata or {})
        key = rng.choice(sorted(meta)) if meta else b"starcal_uq"
        document = meta.get(key, b"{}")
        if rng.random() < 0.4:
            meta[key] = rng.choice(
                (b"", b"{", b"[]", b"null", b"1", b"\xff", b"[" * 100_000, b'{"directions": 3}')
            )
        elif rng.random() < 0.2:
            meta.pop(key, None)
        else:
            meta[key] = _dumped(_node(json.loads(document), rng)).encode("utf-8", "replace")
        table = table.replace_schema_metadata(meta)
    stream = io.BytesIO()
    parquet.write_table(table, stream)
    return stream.getvalue()


def _netcdf(data: bytes, rng: random.Random) -> bytes:
    import h5py

    content = data.rpartition(b"\nsha256 ")[0]
    if sealed(content) != data:
        raise ValueError("damaged already: the HDF5 library may never come back from it")
    stream = io.BytesIO(content)
    with h5py.File(stream, "r+") as file:
        names = [name for name in file if isinstance(file[name], h5py.Dataset)]
        way = rng.randrange(8)
        name = rng.choice(names)
        values = file[name][()]
        if way == 0:
            del file[name]
        elif way == 1 and len(file.attrs):
            del file.attrs[rng.choice(sorted(file.attrs))]
        elif way in (2, 3):
            numeric = (
                values if np.asarray(values).dtype.kind in "fiu" else np.zeros(np.shape(values))
            )
            made = rng.choice(_ARRAYS[:10])(np.asarray(numeric))
            del file[name]
            file[name] = made if made.dtype.kind not in "UO" else np.array([b"text"])
        elif way == 4 and np.asarray(values).dtype.kind == "f" and np.size(values):
            flat = np.array(values).ravel()
            flat[rng.randrange(flat.size)] = rng.choice((np.nan, np.inf, 1e300, 0.0, -1.0))
            file[name][...] = flat.reshape(np.shape(values))
        elif way == 5:
            del file[name]
            file.create_dataset(name, shape=(10**12,), dtype="f8", chunks=(1000,))
        else:
            key = next((k for k in ("record", "definition") if k in file.attrs), None)
            if key is not None:
                text = _dumped(_node(json.loads(file.attrs[key]), rng))
                file.attrs[key] = text if len(text) < 60_000 else text[:60_000]
    return sealed(stream.getvalue())


@dataclass(frozen=True)
class Outcome:
    """What became of a file."""

    # ``same`` (the numbers of the valid file), ``other`` (a result with others), ``refused``,
    # ``words`` (refused with a bad sentence), or ``escaped``.
    kind: str
    detail: str = ""  # The sentence, or what escaped and where


_CLASS_NAMES = re.compile(
    r"\b[A-Z]\w*(Error|Exception)\b|NoneType|Traceback|object is not| at 0x[0-9a-f]{6}|<class "
)


def faults(message: str, path: Path) -> Iterator[str]:
    """What is wrong with a sentence."""
    if "\n" in message or "\r" in message:
        yield "more than one line"
    if len(message) - len(str(path.parent)) >= 400:
        yield f"{len(message)} characters"
    if path.stem not in message:
        yield "does not name the file"
    if match := _CLASS_NAMES.search(message):
        yield f"says {match.group()!r}"
    if not message.isprintable():
        yield "has characters that do not print"
    if message[-1:] not in ".?":
        yield "is no sentence"


def judge(sample: Sample, path: Path, valid: str = "") -> Outcome:
    """Load a file; `valid` is the `digest` of what the valid one holds."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            result = sample.load(path)
            # Absurd numbers overflow when they are squared; that is said, and no failure.
            warnings.simplefilter("ignore", RuntimeWarning)
            use(result)
    except StarcalError as error:
        wrong = list(faults(str(error), path))
        return (
            Outcome("words", f"{'; '.join(wrong)}: {error}"[:1000])
            if wrong
            else Outcome("refused", str(error))
        )
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        own = [f for f in frames if "starcal_uq" in f.filename]
        place = f"{Path(own[-1].filename).name}:{own[-1].lineno} {own[-1].name}" if own else "?"
        return Outcome("escaped", f"{type(error).__name__} at {place}: {str(error)[:120]}")
    return Outcome("same" if digest(result) == valid else "other")


def use(result: Any) -> None:
    """What is done first with a result: it is shown, and made a table."""
    if isinstance(result, list | tuple):
        for item in result:
            use(item)
        return
    repr(result)
    for name in ("to_dataframe", "summary"):
        method = getattr(result, name, None)
        if callable(method) and hasattr(sc, type(result).__module__.split(".")[1]):
            method()


def digest(value: Any) -> str:
    """A hash of all numbers and texts of a result."""
    sha = hashlib.sha256()
    _feed(value, sha.update, set())
    return sha.hexdigest()


def _feed(value: Any, put: Callable[[bytes], None], seen: set[int]) -> None:
    if isinstance(value, np.ndarray | np.generic):
        array = np.asarray(value)
        put(
            f"{array.dtype.str}{array.shape}".encode()
            + (repr(array.tolist()).encode() if array.size else b"")
        )
    elif isinstance(value, Mapping):
        for key in sorted(value, key=str):
            put(str(key).encode())
            _feed(value[key], put, seen)
    elif isinstance(value, list | tuple):
        put(f"[{len(value)}".encode())
        for item in value:
            _feed(item, put, seen)
    elif type(value).__module__.partition(".")[0] in ("pandas", "pyarrow", "xarray"):
        put(repr(value.to_dict() if hasattr(value, "to_dict") else value.to_pylist()).encode())
    elif type(value).__module__.startswith("starcal_uq") and hasattr(value, "__dict__"):
        if id(value) in seen:
            return
        seen.add(id(value))
        own = (
            {f.name for f in dataclasses.fields(value)}
            if dataclasses.is_dataclass(value)
            else set(vars(value))
        )
        for name in sorted(own):
            if name not in ("path", "source", "name", "seconds"):
                put(name.encode())
                _feed(getattr(value, name), put, seen)
    else:
        put(repr(value).encode())


class Bench:
    """A folder in which samples are damaged and judged, one at a time."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "valid").mkdir(parents=True, exist_ok=True)
        if not (folder / "valid" / LAST).exists():
            write_samples(folder / "valid")
        self._known: dict[str, tuple[bytes, str, Path]] = {}

    def valid(self, sample: Sample) -> tuple[bytes, str, Path]:
        """Content of the valid file, the digest of its result, and where damaged ones are put."""
        if sample.file not in self._known:
            place = self.folder / "at" / sample.file.replace(".", "-")
            place.mkdir(parents=True, exist_ok=True)
            for name in (sample.file, *sample.beside):
                shutil.copy(self.folder / "valid" / name, place / name)
            path = place / sample.file
            expected = sample.load(path) if sample.file != "chain.toml" else None
            self._known[sample.file] = (path.read_bytes(), digest(expected), path)
        return self._known[sample.file]

    def damaged(self, sample: Sample, rng: random.Random) -> tuple[bytes, Outcome]:
        """One mutant, and what became of it."""
        data, expected, path = self.valid(sample)
        other = _content(self.folder / "valid" / SAMPLES[rng.randrange(len(SAMPLES))].file)
        made = mutant(sample, data, rng, other)
        return made, self.judged(sample, made, expected, path)

    def judged(
        self, sample: Sample, made: bytes, expected: str = "", path: Path | None = None
    ) -> Outcome:
        """What becomes of the sample with this content."""
        if path is None:
            _, expected, path = self.valid(sample)
        path.write_bytes(made)
        return judge(sample, path, expected)
