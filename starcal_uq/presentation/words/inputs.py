"""Cameras, star catalogues, observations and attitude profiles in sentences and tables."""

from __future__ import annotations

import numpy as np
import pandas as pd

from starcal_uq.attitude.profile import AttitudeProfile
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model
from starcal_uq.core.formatting import pretty_unit, significant
from starcal_uq.observations.columns import COLUMNS
from starcal_uq.observations.table import Observations
from starcal_uq.pipeline.examples import ExampleData
from starcal_uq.presentation.tables import TextTable
from starcal_uq.sky.catalogue import StarCatalogue

_FIRST_ROWS = 5


# What a result says beside a focal length in pixels.
PITCH_UNKNOWN = (
    "The pixel pitch is unknown, so that nothing is in millimetres: state it with --pixel-um UM, "
    "or as pixel_um in the "
    "camera file."
)


def detector_words(camera: Camera) -> str:
    """Size of the detector, and of its pixels where it is known."""
    size = f"{camera.width_px} × {camera.height_px} pixels"
    return (
        f"{size} of unknown pitch"
        if camera.pixel_um is None
        else f"{size} of {camera.pixel_um:g} µm"
    )


def focal_words(camera: Camera) -> str:
    """Focal length in pixels, and in millimetres where the pitch is known."""
    pixels = f"{camera.focal_px:.5g} px"
    return (
        pixels
        if camera.pixel_um is None
        else f"{pixels} ({camera.length_text(camera.focal_px, 4)})"
    )


def camera_text(camera: Camera) -> str:
    """Name, focal length and field."""
    horizontal, vertical = camera.fov_deg
    name = f"{camera.name}, " if camera.name else ""
    return f"{name}{camera.length_text(camera.focal_px, 6)}, {horizontal:.3f} x {vertical:.3f} deg."


def camera_table(camera: Camera) -> TextTable:
    """Detector, optics and distortion."""
    coefficients = get_model(camera.distortion).coefficients
    rows = [
        ("detector", detector_words(camera)),
        ("focal length", f"{camera.focal_px:.3f} px"),
        *(() if camera.focal_mm is None else (("focal length", f"{camera.focal_mm:.6g} mm"),)),
        ("principal point", f"({camera.x0_px:.3f}, {camera.y0_px:.3f}) px"),
        ("distortion", camera.distortion),
        *(
            (c.name, f"{k:.6g} {pretty_unit(c.unit)}")
            for c, k in zip(coefficients, camera.coefficients, strict=True)
        ),
    ]
    return TextTable(("", "value"), tuple(rows), align="ll")


def observations_text(obs: Observations) -> str:
    """How much there is, and what its directions are."""
    return f"{obs.n_stars} stars in {obs.n_frames} frames, directions {obs.origin.directions}."


def example_text(example: ExampleData) -> str:
    """What there is, and whose it is."""
    obs = example.observations
    return (
        f"{example.name}: {obs.n_stars} stars in {obs.n_frames} frames; {obs.origin.attribution}, "
        f"{obs.origin.licence}. Site: {example.site}."
    )


def observations_table(obs: Observations) -> TextTable:
    """The first rows: five decimals are a hundredth of a milli-pixel and 0.04 arcsec."""
    head = pd.DataFrame({name: values[:_FIRST_ROWS] for name, values in obs.columns.items()})
    formats = {name: "{:.5f}".format for name in head if COLUMNS[name].kind == "number"}
    return TextTable.of(head, formats=formats)


def catalogue_text(stars: StarCatalogue) -> str:
    """Number, kind of directions, epoch and band, and where the stars come from."""
    return f"{repr(stars).strip('<>')}. {stars.source}."


def catalogue_table(stars: StarCatalogue) -> TextTable:
    """The first stars."""
    head = stars.select(np.arange(min(_FIRST_ROWS, len(stars)))).to_dataframe()
    return TextTable.of(head, formats=dict.fromkeys(("ra_deg", "dec_deg"), "{:.6f}".format))


def profile_text(profile: AttitudeProfile) -> str:
    """How long it lasts and how fast it turns."""
    speed = profile.rate_deg_s
    name = f"{profile.name}: " if profile.name else ""
    return (
        f"{name}{len(profile.time_s)} attitudes over {significant(profile.duration_s, 3)} s, "
        "turning at "
        f"{significant(np.median(speed), 3)} (median) to "
        f"{significant(speed.max(), 3)} degrees per "
        "second."
    )
