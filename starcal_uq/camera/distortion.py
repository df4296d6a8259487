"""The registry of distortion models: the only place where a distortion formula is written.

Each entry holds a displacement in plain arithmetic, so that the same function serves CasADi symbols
(from which every kernel and derivative is generated) and numbers. Pixel convention, direction and
parameter order are those of ``docs/explanation/conventions.md``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from starcal_uq.core.errors import DistortionError

Displacement = Callable[[Any, Any, Sequence[Any]], tuple[Any, Any]]


@dataclass(frozen=True)
class Parameter:
    """A parameter as people see it."""

    name: str  # Name in files, tables and draws
    unit: str  # Unit of the value used in computations
    # Stored and printed values are ``value / scale``: diagnostics lose tiny numbers otherwise
    scale: float
    scaled_unit: str  # Unit of the scaled value
    description: str  # Meaning, in words


@dataclass(frozen=True)
class Coefficient(Parameter):
    """A distortion coefficient; its displacement grows as ``r**order``."""

    order: int


@dataclass(frozen=True)
class DistortionModel:
    """One distortion model.

    Attributes
    ----------
    name : str
        Word that users write in ``distortion = "..."``.
    coefficients : tuple of Coefficient
        In the order in which they follow x0, y0 and f.
    direction : {"forward", "inverse"}
        ``forward`` maps ideal to distorted points, ``inverse`` maps distorted to ideal points.
    displacement : callable
        ``(u, v, k) -> (du, dv)``: displacement in pixels at offset (u, v) px from the principal
        point.
    source : str
        Source of the formula.
    """

    name: str
    coefficients: tuple[Coefficient, ...]
    direction: Literal["forward", "inverse"]
    displacement: Displacement
    source: str

    @property
    def radial(self) -> bool:
        """Whether it is the same in all directions from the principal point."""
        return self.displacement in (_radial, _none)


def _radial(u: Any, v: Any, k: Sequence[Any]) -> tuple[Any, Any]:
    r2 = u * u + v * v
    factor: Any = 0.0
    for coefficient in reversed(k):
        factor = (factor + coefficient) * r2
    return u * factor, v * factor


def _none(u: Any, v: Any, k: Sequence[Any]) -> tuple[Any, Any]:
    return 0.0 * u, 0.0 * v


def _brown_tangential(u: Any, v: Any, k: Sequence[Any]) -> tuple[Any, Any]:
    k1, k2, p1, p2 = k
    du, dv = _radial(u, v, (k1, k2))
    r2 = u * u + v * v
    return (
        du + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u),
        dv + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v,
    )


_K1 = Coefficient("k1", "px^-2", 1e-10, "1e-10 px^-2", "radial distortion, cubic term", 3)
_K2 = Coefficient("k2", "px^-4", 1e-15, "1e-15 px^-4", "radial distortion, quintic term", 5)
_K3 = Coefficient("k3", "px^-6", 1e-20, "1e-20 px^-6", "radial distortion, seventh-order term", 7)
_P1 = Coefficient("p1", "px^-1", 1e-7, "1e-7 px^-1", "decentring distortion along y", 2)
_P2 = Coefficient("p2", "px^-1", 1e-7, "1e-7 px^-1", "decentring distortion along x", 2)

_EQ14 = "Ye & Yang 2017, eq. 14 (ideal to distorted), in pixels"
_MODELS = {
    model.name: model
    for model in (
        DistortionModel("none", (), "forward", _none, "pinhole"),
        DistortionModel("k1", (_K1,), "forward", _radial, _EQ14 + ", first term"),
        DistortionModel("brown", (_K1, _K2), "forward", _radial, _EQ14),
        DistortionModel(
            "brown3", (_K1, _K2, _K3), "forward", _radial, _EQ14 + ", with a third term"
        ),
        DistortionModel(
            "brown_tangential",
            (_K1, _K2, _P1, _P2),
            "forward",
            _brown_tangential,
            "Brown 1971; p1 and p2 in OpenCV's order",
        ),
        DistortionModel(
            "inverse",
            (_K1, _K2),
            "inverse",
            _radial,
            "Ye & Yang 2017, eq. 6 (distorted to ideal), in pixels",
        ),
    )
}

_OPTICS = (
    Parameter("x0", "px", 1.0, "px", "principal point, along x"),
    Parameter("y0", "px", 1.0, "px", "principal point, along y"),
    Parameter("f", "px", 1.0, "px", "focal length"),
)
_SIGMA = Parameter("sigma", "px", 1.0, "px", "centroid noise per axis")
_SIGMA_SCALE = Parameter(
    "sigma_scale", "1", 1.0, "1", "common factor on the stated noise of the stars"
)


def model_names() -> tuple[str, ...]:
    """Names of all distortion models."""
    return tuple(_MODELS)


def get_model(name: str) -> DistortionModel:
    """Look a distortion model up; DistortionError for a name that is not in the registry."""
    try:
        return _MODELS[name]
    except KeyError:
        raise DistortionError(
            f"distortion model {name!r} is unknown: use one of {', '.join(model_names())}."
        ) from None


def simpler_models(name: str) -> tuple[str, ...]:
    """Models that a model becomes when some of its coefficients are zero; without any, both
    directions are one.
    """
    own, names = get_model(name), {c.name for c in get_model(name).coefficients}
    return tuple(
        other.name
        for other in _MODELS.values()
        if {c.name for c in other.coefficients} < names
        and (other.direction == own.direction or not other.coefficients)
    )


def next_simpler(name: str) -> str:
    """The richest of `simpler_models`; empty where there is none."""
    return max(
        simpler_models(name), key=lambda other: len(get_model(other).coefficients), default=""
    )


def parameters(model_name: str) -> tuple[Parameter, ...]:
    """Parameters of a camera with this distortion model, in their fixed order x0, y0, f, k..."""
    return _OPTICS + get_model(model_name).coefficients


def parameter_names(model_name: str) -> tuple[str, ...]:
    """Names of `parameters`."""
    return tuple(p.name for p in parameters(model_name))


# Coefficients and parameters of all models, by name.
COEFFICIENTS = {spec.name: spec for model in _MODELS.values() for spec in model.coefficients}
PARAMETERS: dict[str, Parameter] = {spec.name: spec for spec in _OPTICS} | COEFFICIENTS


def parameter_called(name: str) -> Parameter:
    """The parameter of this name, of whatever model has it; DistortionError where none has."""
    try:
        return PARAMETERS[name]
    except KeyError:
        raise DistortionError(
            f"parameter {name!r} is unknown: use one of {', '.join(PARAMETERS)}."
        ) from None


def sigma_parameter(per_star: bool) -> Parameter:
    """The noise parameter: px per axis, or a factor where every star states its own sigma."""
    return _SIGMA_SCALE if per_star else _SIGMA
