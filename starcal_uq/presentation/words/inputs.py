"""Cameras, star catalogues, observations and attitude profiles in sentences and tables."""

from __future__ import annotations

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model
from starcal_uq.core.formatting import pretty_unit
from starcal_uq.observations.columns import COLUMNS
from starcal_uq.observations.table import Observations
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.sentences import say

_FIRST_ROWS = 5


def camera_table(camera: Camera) -> TextTable:
    """Detector, optics and distortion."""
    coefficients = get_model(camera.distortion).coefficients
    rows = [
        ("detector", say("Part.detector", it=camera)),
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


def observations_table(obs: Observations) -> TextTable:
    """The first rows: five decimals are a hundredth of a milli-pixel and 0.04 arcsec."""
    head = obs.head(_FIRST_ROWS)
    formats = {name: "{:.5f}".format for name in head if COLUMNS[name].kind == "number"}
    return TextTable.of(head, formats=formats)
