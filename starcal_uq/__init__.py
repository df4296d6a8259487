"""Probabilistic calibration of star sensors: from identified stars to a posterior and its attitude error.

Names are loaded when they are first used, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_LOCATION = {
    "AttitudeError": "propagation",
    "Calibration": "calibration",
    "CalibrationError": "errors",
    "Camera": "camera",
    "CameraError": "errors",
    "CatalogueError": "errors",
    "Coupling": "couplings",
    "DistortionError": "errors",
    "FieldMap": "fieldmap",
    "ObservationError": "errors",
    "Observations": "observations",
    "Posterior": "posterior",
    "Priors": "priors",
    "PriorError": "errors",
    "RunFolder": "runfolder",
    "RunFolderError": "errors",
    "SamplingError": "errors",
    "StarCatalogue": "catalogue",
    "StarcalError": "errors",
    "Status": "status",
    "aberrate": "apparent",
    "calibrate": "estimation",
    "coupling": "couplings",
    "earth_velocity_km_s": "apparent",
    "field_map": "fieldmap",
    "load_catalogue": "catalogue",
    "load_observations": "observations",
    "make_apparent": "apparent",
    "model_names": "distortion",
    "paper_camera": "simulation",
    "paper_start": "simulation",
    "project": "projection",
    "propagate": "propagation",
    "quest": "wahba",
    "read_catalogue": "readers",
    "report": "reporting",
    "sample": "sampler",
    "simulate": "simulation",
    "unproject": "projection",
}

__all__ = [
    "AttitudeError",
    "Calibration",
    "CalibrationError",
    "Camera",
    "CameraError",
    "CatalogueError",
    "Coupling",
    "DistortionError",
    "FieldMap",
    "ObservationError",
    "Observations",
    "Posterior",
    "PriorError",
    "Priors",
    "RunFolder",
    "RunFolderError",
    "SamplingError",
    "StarCatalogue",
    "StarcalError",
    "Status",
    "__version__",
    "aberrate",
    "calibrate",
    "coupling",
    "earth_velocity_km_s",
    "field_map",
    "load_catalogue",
    "load_observations",
    "make_apparent",
    "model_names",
    "paper_camera",
    "paper_start",
    "project",
    "propagate",
    "quest",
    "read_catalogue",
    "report",
    "sample",
    "simulate",
    "unproject",
]


def __getattr__(name: str) -> Any:
    if name not in _LOCATION:
        raise AttributeError(f"module 'starcal_uq' has no attribute {name!r}")
    value = getattr(import_module(f"starcal_uq.{_LOCATION[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
