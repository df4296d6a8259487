"""The registry of distortion models: the only place where a distortion formula is written.

Each entry holds a displacement in plain arithmetic, so that the same function serves CasADi symbols
(from which every kernel and derivative is generated) and numbers. Pixel convention, direction and
parameter order are those of ``docs/explanation/conventions.md``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal

from starcal_uq.camera.planes import EQUIDISTANT, PINHOLE, Plane
from starcal_uq.core.errors import DistortionError
from starcal_uq.core.extras import entry_point
from starcal_uq.core.types import FloatArray, floats

# Where other packages offer models.
GROUP = "starcal_uq.distortion_models"

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
    lens : tuple of Coefficient
        Coefficients of the displacement, in the order in which they follow x0, y0 and f.
    direction : {"forward", "inverse"}
        ``forward`` maps ideal to distorted points, ``inverse`` maps distorted to ideal points.
    formula : callable
        ``(u, v, k) -> (du, dv)``: displacement in pixels at offset (u, v) px from the principal
        point.
    source : str
        Source of the formula.
    plane : Plane
        The ideal projection, which gives the points that are displaced.
    compared : bool
        Whether the misfit tests and comparisons of models have its terms.
    axes : bool
        Whether stretch and skew of the detector's axes follow the coefficients of the lens.
    """

    name: str
    lens: tuple[Coefficient, ...]
    direction: Literal["forward", "inverse"]
    formula: Displacement
    source: str
    plane: Plane = PINHOLE
    compared: bool = True
    axes: bool = False

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        """All parameters that follow x0, y0 and f: of the lens, then of the axes."""
        return self.lens + (_AXES if self.axes else ())

    @property
    def radial(self) -> bool:
        """Whether the lens is the same in all directions from the principal point."""
        return self.formula in (_radial, _none)

    @property
    def tilts(self) -> bool:
        """Whether the lens has all terms of the second order, which imitate a tilt of the camera."""
        return self.formula is _cubic

    @property
    def of_lens(self) -> slice:
        """Place of the lens's coefficients among the parameters."""
        return slice(3, 3 + len(self.lens))

    @property
    def bare(self) -> str:
        """Name of the model of this projection without distortion; its axes are free where these
        are.
        """
        return self.plane.bare + (AXES_SUFFIX if self.axes else "")

    def displacement(self, u: Any, v: Any, k: Sequence[Any]) -> tuple[Any, Any]:
        """Displacement by the lens, px, for coefficients k of which the first are the lens's."""
        return self.formula(u, v, k[: len(self.lens)])

    def stretched(self, u: Any, v: Any, theta: Any) -> tuple[Any, Any]:
        """Offset on the detector of the point (u, v) behind the lens, px, for parameters theta."""
        if not self.axes:
            return u, v
        stretch, skew = theta[3 + len(self.lens)], theta[4 + len(self.lens)]
        return u + skew * v, v + stretch * v

    def unstretched(self, x: Any, y: Any, theta: Any) -> tuple[Any, Any]:
        """Inverse of `stretched`."""
        if not self.axes:
            return x, y
        stretch, skew = theta[3 + len(self.lens)], theta[4 + len(self.lens)]
        v = y / (1.0 + stretch)
        return x - skew * v, v


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


def _thin_prism(u: Any, v: Any, k: Sequence[Any]) -> tuple[Any, Any]:
    k1, k2, s1, s2 = k
    du, dv = _radial(u, v, (k1, k2))
    r2 = u * u + v * v
    return du + s1 * r2, dv + s2 * r2


def powers(order: int, least: int = 2) -> list[tuple[int, int]]:
    """Powers (p, q) of a polynomial of two variables with least <= p + q <= order."""
    return [(n - q, q) for n in range(least, order + 1) for q in range(n + 1)]


def _cubic(u: Any, v: Any, k: Sequence[Any]) -> tuple[Any, Any]:
    terms = [u**p * v**q for p, q in _POWERS]
    du, dv = (sum(a * b for a, b in zip(half, terms, strict=True)) for half in (k[:7], k[7:]))
    return du, dv


_K1 = Coefficient("k1", "px^-2", 1e-10, "1e-10 px^-2", "radial distortion, cubic term", 3)
_K2 = Coefficient("k2", "px^-4", 1e-15, "1e-15 px^-4", "radial distortion, quintic term", 5)
_K3 = Coefficient("k3", "px^-6", 1e-20, "1e-20 px^-6", "radial distortion, seventh-order term", 7)
_K4 = Coefficient("k4", "px^-8", 1e-25, "1e-25 px^-8", "radial distortion, ninth-order term", 9)
_P1 = Coefficient("p1", "px^-1", 1e-7, "1e-7 px^-1", "decentring distortion along y", 2)
_P2 = Coefficient("p2", "px^-1", 1e-7, "1e-7 px^-1", "decentring distortion along x", 2)

_S1 = Coefficient("s1", "px^-1", 1e-7, "1e-7 px^-1", "thin prism along x", 2)
_S2 = Coefficient("s2", "px^-1", 1e-7, "1e-7 px^-1", "thin prism along y", 2)
# Names as in FITS headers with SIP: a_pq u^p v^q along x, b_pq u^p v^q along y.
_POWERS = powers(3)
_CUBIC = tuple(
    Coefficient(
        f"{letter}{p}{q}",
        f"px^-{p + q - 1}",
        float(scale := {2: "1e-7", 3: "1e-10"}[p + q]),
        f"{scale} px^-{p + q - 1}",
        f"term u^{p} v^{q} of the displacement along {axis}",
        p + q,
    )
    for letter, axis in (("a", "x"), ("b", "y"))
    for p, q in _POWERS
)
_AXES = (
    Coefficient("stretch", "1", 1e-6, "1e-6", "scale along y over that along x, less one", 1),
    Coefficient("skew", "1", 1e-6, "1e-6", "shift along x with the offset along y", 1),
)
# What a model's name ends in where stretch and skew of the axes are parameters too.
AXES_SUFFIX = "+axes"

_EQ14 = "Ye & Yang 2017, eq. 14 (ideal to distorted), in pixels"
_KANNALA = "Kannala & Brandt 2006, as OpenCV's fisheye, in pixels"
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
        DistortionModel(
            "thin_prism",
            (_K1, _K2, _S1, _S2),
            "forward",
            _thin_prism,
            "Weng, Cohen & Herniou 1992, without decentring",
            compared=False,
        ),
        DistortionModel(
            "cubic",
            _CUBIC,
            "forward",
            _cubic,
            "Taylor series to third order, as in NAIF's kernel of MESSENGER MDIS",
            compared=False,
        ),
        DistortionModel("f_theta", (), "forward", _none, "equidistant projection", EQUIDISTANT),
        DistortionModel(
            "equidistant",
            (_K1, _K2),
            "forward",
            _radial,
            _KANNALA + ", first two terms",
            EQUIDISTANT,
        ),
        DistortionModel("fisheye", (_K1, _K2, _K3, _K4), "forward", _radial, _KANNALA, EQUIDISTANT),
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


def model_names(*, axes: bool = False) -> tuple[str, ...]:
    """Names of the distortion models of this package; with `axes` also those with free axes of the
    detector.
    """
    names = tuple(_MODELS)
    return names + tuple(name + AXES_SUFFIX for name in names) if axes else names


@lru_cache
def get_model(name: str) -> DistortionModel:
    """Look a distortion model up, of this package or offered by another in `GROUP`.

    DistortionError for a name that nobody offers, and for an offered model that does not fit.
    """
    base = name.removesuffix(AXES_SUFFIX)
    return replace(_MODELS.get(base) or _offered(base), name=name, axes=name != base)


def _offered(name: str) -> DistortionModel:
    """The model that another package offers; its coefficients become known by their names."""
    found = entry_point(GROUP, name)
    if found is None:
        raise DistortionError(
            f"distortion model {name!r} is unknown: use one of {', '.join(model_names())}, each "
            f"also as NAME{AXES_SUFFIX}, or install the package that offers it."
        )
    model: DistortionModel = found.load()
    own = {spec.name: spec for spec in model.lens}
    clash = [key for key, spec in own.items() if PARAMETERS.get(key, spec) != spec]
    if clash:
        problem = f"its coefficient {clash[0]} is another one here; rename it"
    elif any(model.formula(3.0, 4.0, [0.0] * len(own))):
        problem = "its displacement is not zero where its coefficients are; subtract what is left"
    else:
        COEFFICIENTS.update(own)
        PARAMETERS.update(own)
        return model
    raise DistortionError(f"distortion model {name!r} of {found.value}: {problem}.")


def with_axes(name: str) -> str:
    """Name of the same model with free axes of the detector."""
    return name.removesuffix(AXES_SUFFIX) + AXES_SUFFIX


def like(name: str, other: str) -> str:
    """Name of a model with the axes of the `other`: free, or square."""
    return with_axes(name) if get_model(other).axes else name.removesuffix(AXES_SUFFIX)


def shared_names(one: str, other: str) -> tuple[str, ...]:
    """Names of the coefficients that mean the same in both models."""
    a, b = get_model(one), get_model(other)
    same = a.direction == b.direction and a.plane is b.plane
    common = set(b.coefficients) - (set() if same else set(b.lens))
    return tuple(c.name for c in a.coefficients if c in common)


def is_special_case(small: str, large: str) -> bool:
    """Whether a model is another one, or becomes it when some of the other's coefficients are
    zero; without distortion, both directions are one.
    """
    a, b = get_model(small), get_model(large)
    same = a.plane is b.plane and (a.direction == b.direction or not a.lens)
    return same and set(a.coefficients) <= set(b.coefficients)


def simpler_models(name: str) -> tuple[str, ...]:
    """Models that a model becomes when some coefficients of its lens are zero; the axes stay, as
    no lack of data makes pixels square.
    """
    own = get_model(name)
    return tuple(
        other
        for other in (like(base, name) for base in model_names())
        if len(get_model(other).lens) < len(own.lens) and is_special_case(other, name)
    )


def rivals(name: str) -> tuple[str, ...]:
    """Models to compare with one: those of its projection from ideal to distorted points, with its
    axes.
    """
    models = (get_model(like(base, name)) for base in model_names())
    plane = get_model(name).plane
    return tuple(
        m.name for m in models if m.compared and m.direction == "forward" and m.plane is plane
    )


def next_richer(name: str) -> str:
    """The richest of `rivals` that has all terms of a model and more; empty where there is none."""
    own = set(get_model(name).lens)
    richer = [other for other in rivals(name) if own < set(get_model(other).lens)]
    return max(richer, key=lambda other: len(get_model(other).lens), default="")


def next_simpler(name: str) -> str:
    """The richest of `simpler_models`, or a lens off its axis for one that imitates a tilt; empty
    where there is none.
    """
    if get_model(name).tilts:
        return like("brown_tangential", name)
    return max(simpler_models(name), key=lambda other: len(get_model(other).lens), default="")


def undistorted(model_name: str, theta: FloatArray) -> FloatArray:
    """The same optics and axes (p,) without distortion."""
    found = theta.copy()
    found[get_model(model_name).of_lens] = 0.0
    return found


def scales_of(specs: Sequence[Parameter]) -> FloatArray:
    """Units (p,) in which parameters are printed, in computation units."""
    return floats([spec.scale for spec in specs])


def parameters(model_name: str) -> tuple[Parameter, ...]:
    """Parameters of a camera with this distortion model, in their fixed order x0, y0, f, k..."""
    return _OPTICS + get_model(model_name).coefficients


def parameter_names(model_name: str) -> tuple[str, ...]:
    """Names of `parameters`."""
    return tuple(p.name for p in parameters(model_name))


# Coefficients and parameters of all models, by name; `_offered` adds those of other packages.
COEFFICIENTS: dict[str, Coefficient] = {
    spec.name: spec for model in _MODELS.values() for spec in model.lens
} | {spec.name: spec for spec in _AXES}
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
