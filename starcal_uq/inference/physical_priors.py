"""Independent priors in physical terms.

A prior on a distortion coefficient is stated as the displacement that its term causes at the corner of the field: a
prior on the raw number means something else for every lens, and quietly regularises it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.camera.distortion import get_model
from starcal_uq.core.errors import PriorError
from starcal_uq.core.types import FloatArray
from starcal_uq.inference.priors import Priors, positive_number, read_priors_table

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera

# Wide on purpose: a tenth of the detector, 5 % of the focal length and a twentieth of the image radius cover any camera
# whose data sheet is not wrong, and are hundreds of times wider than what a night of stars determines.
_PRINCIPAL_POINT_FRACTION = 0.1
_FOCAL_FRACTION = 0.05
_DISTORTION_FRACTION = 0.05
_SIGMA_PX = (0.1, 1.5)
_SIGMA_SCALE = (1.0, 0.7)


@dataclass(frozen=True)
class PhysicalPriors(Priors):
    """Independent proper priors on the parameters of one camera.

    Attributes
    ----------
    principal_point_px : float
        Standard deviation of x0 and of y0, px.
    principal_point_centre_px : tuple of float
        Mean of (x0, y0), px.
    focal_fraction : float
        Standard deviation of the focal length relative to `focal_px`.
    focal_px : float
        Mean of the focal length, px.
    distortion_corner_px : float
        Standard deviation of the displacement by each distortion term alone at `corner_radius_px`, px.
    corner_radius_px : float
        Distance from the principal point at which the displacement is stated, px.
    sigma_median : float
        Median of the centroid noise: px, or a factor where every star states its own noise.
    sigma_log_sd : float
        Standard deviation of the logarithm of the noise.
    distortion : str
        Name of the distortion model, which gives names and orders of the coefficients.
    per_star_sigma : bool
        True where the noise parameter is a common factor on stated noises.
    """

    principal_point_px: float
    principal_point_centre_px: tuple[float, float]
    focal_fraction: float
    focal_px: float
    distortion_corner_px: float
    corner_radius_px: float
    sigma_median: float
    sigma_log_sd: float
    distortion: str = "brown"
    per_star_sigma: bool = False

    def __post_init__(self) -> None:
        centre = tuple(float(v) for v in self.principal_point_centre_px)
        if len(centre) != 2 or not all(math.isfinite(v) for v in centre):
            raise PriorError(
                f"prior 'principal_point_centre_px' is {self.principal_point_centre_px}: give two finite numbers."
            )
        object.__setattr__(self, "principal_point_centre_px", centre)
        for name in _POSITIVE:
            object.__setattr__(self, name, positive_number(name, getattr(self, name)))
        get_model(self.distortion)

    @classmethod
    def around(cls, camera: Camera, per_star_sigma: bool = False) -> PhysicalPriors:
        """Wide priors around a nominal camera (see the module's constants for the widths)."""
        median, log_sd = _SIGMA_SCALE if per_star_sigma else _SIGMA_PX
        centre = camera.centre_px
        return cls(
            principal_point_px=_PRINCIPAL_POINT_FRACTION * max(camera.width_px, camera.height_px),
            principal_point_centre_px=(float(centre[0]), float(centre[1])),
            focal_fraction=_FOCAL_FRACTION,
            focal_px=float(camera.focal_px),
            distortion_corner_px=_DISTORTION_FRACTION * float(camera.corner_radius_px),
            corner_radius_px=float(camera.corner_radius_px),
            sigma_median=median,
            sigma_log_sd=log_sd,
            distortion=camera.distortion,
            per_star_sigma=per_star_sigma,
        )

    def theta_moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean (p,) and diagonal covariance (p, p), px units."""
        x0, y0 = self.principal_point_centre_px
        coefficients = get_model(self.distortion).coefficients
        sd = [self.principal_point_px, self.principal_point_px, self.focal_fraction * self.focal_px]
        sd += [self.distortion_corner_px / self.corner_radius_px**c.order for c in coefficients]
        return np.array([x0, y0, self.focal_px, *(0.0 for _ in coefficients)]), np.diag(np.square(sd))

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for files."""
        return {**dataclasses.asdict(self), "principal_point_centre_px": list(self.principal_point_centre_px)}

    @classmethod
    def read(cls, values: Mapping[str, Any]) -> PhysicalPriors:
        """Read what `to_dict` wrote."""
        return cls(**{**values, "principal_point_centre_px": tuple(values["principal_point_centre_px"])})

    def _statement(self, name: str) -> str:
        if name in ("x0", "y0"):
            centre = self.principal_point_centre_px["xy".index(name[0])]
            return f"normal, {centre:g} px with sd {self.principal_point_px:g} px"
        if name == "f":
            return f"normal, {self.focal_px:g} px with sd {100 * self.focal_fraction:g} %"
        return f"normal, displacement 0 with sd {self.distortion_corner_px:g} px at {self.corner_radius_px:g} px"


_FIELDS = tuple(field.name for field in dataclasses.fields(PhysicalPriors))
_POSITIVE = tuple(name for name in _FIELDS if name not in ("principal_point_centre_px", "distortion", "per_star_sigma"))
_IN_FILES = tuple(name for name in _FIELDS if name not in ("distortion", "per_star_sigma"))


def priors_from_toml(path: str | Path, camera: Camera, per_star_sigma: bool = False) -> PhysicalPriors:
    """Read a ``[priors]`` table; see `Priors.from_toml`."""
    return priors_from_table(path, read_priors_table(path), camera, per_star_sigma)


def priors_from_table(
    path: str | Path, table: Mapping[str, Any], camera: Camera, per_star_sigma: bool = False
) -> PhysicalPriors:
    """Priors from the entries of a ``[priors]`` table; `path` is for messages.

    Raises
    ------
    PriorError
        For an unknown key or a value that is not a proper prior.
    """
    _check_table(path, table)
    values = dict(table)
    if "principal_point_centre_px" in values:
        values["principal_point_centre_px"] = tuple(values["principal_point_centre_px"])
    try:
        return PhysicalPriors.around(camera, per_star_sigma).replace(**values)
    except PriorError as error:
        raise PriorError(f"{path}: {error}") from None


def _check_table(path: str | Path, table: Mapping[str, Any]) -> None:
    for key, value in table.items():
        if key not in _IN_FILES:
            raise PriorError(f"{path}: unknown key {key!r} in [priors]; use one of {', '.join(_IN_FILES)}.")
        numbers = value if isinstance(value, list) else [value]
        wanted = 2 if key == "principal_point_centre_px" else 1
        numeric = all(isinstance(v, int | float) and not isinstance(v, bool) for v in numbers)
        if not numeric or len(numbers) != wanted or isinstance(value, list) != (wanted == 2):
            raise PriorError(f"{path}: key {key!r} in [priors] must be {'two numbers' if wanted == 2 else 'a number'}.")
