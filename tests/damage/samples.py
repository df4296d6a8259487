"""A small valid file of every kind that the package reads, with the public names that read it."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import starcal_uq as sc
from starcal_uq.core.errors import StarcalError

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
        return self.ending in [
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
        ]


@cache
def content(path: Path) -> bytes:
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
def observations() -> sc.Observations:
    return sc.load_observations(PREVIOUS / "observations.parquet")


def _checkpoint(path: Path) -> Any:
    from starcal_uq.inference.ensemble import EnsembleSettings, _Store

    store = _Store(2, EnsembleSettings(16, 6, 10, 2), 6, path, "fingerprint")
    if store.state is None:
        raise StarcalError(f"{path}: the draws are made again.")
    return store


def _pairs(path: Path) -> Any:
    from starcal_uq.identification.pairs import StarPairs, _read

    pairs = _read(path, StarPairs)
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


IMAGES = [
    "image.fits",
    "image.fits.gz",
    "tiles.fits",
    "image.tiff",
    "image.png",
    "colours.png",
    "image.jpg",
    "image.bmp",
]
HEADS = """
[[head]]
name = "A"
rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
weighed_arcsec = [2.0, 2.0, 16.0]

[[head]]
name = "B"
rotation = [0.0, 0.7071068, 0.0, 0.7071068]
run = "run-b"
"""
# Format of another program, by the file.
CAMERAS = {
    "opencv.yaml": "opencv",
    "ros.yml": "ros",
    "kalibr.yaml": "kalibr",
    "mrcal.cameramodel": "mrcal",
    "giant.xml": "giant",
    "kernel.ti": "spice",
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
    Sample("heads.toml", sc.attitude.load_heads, ("attitude.load_heads",)),
    Sample("budget.toml", sc.budgeting.load_budget_file, ("budgeting.load_budget_file",)),
    Sample("study.toml", sc.studies.StudyDefinition.load, ("studies.StudyDefinition.load",)),
    Sample("observations.csv", sc.load_observations, ("load_observations",)),
    Sample("observations.ecsv", sc.load_observations, ("load_observations",)),
    Sample("observations.parquet", sc.load_observations, ("load_observations",)),
    Sample("stream.csv", lambda path: _all(sc.paper.stream_frames(path)), ("paper.stream_frames",)),
    Sample(
        "stream.parquet", lambda path: _all(sc.paper.stream_frames(path)), ("paper.stream_frames",)
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
    Sample("state.npz", sc.paper.RecursiveCalibration.load, ("paper.RecursiveCalibration.load",)),
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
    obs = observations()
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
    from tests.sky.test_tables import HIPPARCOS

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
    (folder / "heads.toml").write_text(HEADS)
    sc.studies.write_study_template("magnitude-noise", folder / "study.toml", force=True)
    posterior = sc.sample(
        observations(), _calibration(), n_walkers=16, n_steps=8, n_ensembles=2, seed=1
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
