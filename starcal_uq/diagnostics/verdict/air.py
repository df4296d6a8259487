"""What is known of the air between the stars and the camera, and what it does to the focal length."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, TypeAlias

from starcal_uq.core.formatting import fixed, significant
from starcal_uq.sky.refraction import refraction_constants, shrinking
from starcal_uq.sky.site import Site

if TYPE_CHECKING:
    from starcal_uq.estimation.calibration import Calibration
    from starcal_uq.observations.table import Observations

REMEDY = "State the site (--site) and the times, or that the camera was in space (--in-space)."

Air: TypeAlias = Literal["corrected", "none", "unknown"]

_HIGH_DEG, _MIDDLE_DEG = 90.0, 45.0
# What pressure and temperature of a place may differ from the standard atmosphere: 1.5 % and 4 %.
_WEATHER = 0.04


def air(obs: Observations) -> Air:
    """Whether refraction is in the directions, is out of the question, or is not known.

    Directions that the user declared as apparent are what the camera saw, with all there is to it.
    """
    if obs.meta.get("observer") == "ground":
        return "corrected"
    if obs.meta.get("observer") in ("space", "rendered") or obs.meta.get("source") == "simulated":
        return "none"
    declared = obs.meta.get("directions") == "apparent" and obs.meta.get("observer") != "unknown"
    return "none" if declared else "unknown"


def conditional_words(cal: Calibration) -> str:
    """That f is conditional on refraction, with the size of the effect on this camera in standard air at sea level."""
    constants = refraction_constants(Site(latitude_deg=45.0, longitude_deg=0.0))
    focal, sigma = cal.camera.focal_px, float(cal.sigmas[2])
    sizes = [float(shrinking(altitude, constants)) * focal for altitude in (_HIGH_DEG, _MIDDLE_DEG)]
    high, middle = (f"{significant(size)} px ({significant(size / sigma)} sigma)" for size in sizes)
    return (
        "The focal length f is conditional on refraction: if the stars were seen through air, f is too short by "
        f"{high} at the zenith and by {middle} at 45° of altitude."
    )


def corrected_words(obs: Observations, cal: Calibration) -> str:
    """Which air was taken at which site, and what it does to f."""
    site, atmosphere = Site.from_dict(obs.meta["site"]), obs.meta["atmosphere"]
    size = float(atmosphere["shrinking"]) * cal.camera.focal_px
    sigma = float(cal.sigmas[2])
    assumed = " and ".join(site.assumed)
    source = f" ({assumed} of the standard atmosphere)" if assumed else ""
    low, high = (fixed(float(atmosphere[f"altitude_{end}_deg"]), 0) for end in ("min", "max"))
    per_cent = f"each per cent of the air’s density (10 hPa, 3 °C) counts {significant(0.01 * size)} px"
    weather = ""
    if site.assumed and _WEATHER * size > sigma:
        weather = (
            f" The weather may differ from the standard atmosphere by {_WEATHER * 100:.0f} %, which is more than the "
            "sigma of f: state pressure and temperature."
        )
    return (
        f"Site: {site}. Refraction in air of {fixed(site.air_pressure_hpa, 0)} hPa and "
        f"{fixed(site.air_temperature_c, 0)} °C{source} is in the directions, at altitudes of {low}° to {high}°. "
        f"Without it f would come out {significant(size)} px ({significant(size / sigma)} sigma) shorter; "
        f"{per_cent}.{weather}"
    )
