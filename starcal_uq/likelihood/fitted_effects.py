"""Effects that a calibration holds, and what they say of the camera."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from starcal_uq.core.display import Shown
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.likelihood.compressed import CompressedLikelihood, optimum, squares_by
from starcal_uq.likelihood.effects import Effect, effects_of
from starcal_uq.likelihood.shapes import Extent
from starcal_uq.likelihood.zenith import Zeniths
from starcal_uq.maths.linear import scaled_inverse

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.camera.camera import Camera
    from starcal_uq.observations.table import Observations


@dataclass(frozen=True)
class FittedEffect:
    """An effect that a calibration holds.

    Attributes
    ----------
    name : str
        Name in the list of effects.
    scale_px, low_px, high_px : float
        Standard deviation of its coefficients, px at the corner of the field, and its 95 %
        interval; 1 for `zenith`, whose coefficients have a known prior. Of `noise` the standard
        deviation over the stars of their noise, px; NaN for what an effect lacks.
    size_px : float
        Root mean square per axis over the stars of the shifts that it explains, px; attitudes and
        parameters removed.
    gain_nat : float
        Log of the restricted likelihood gained when it was taken up; beside all others, for one
        that was asked for.
    moved_sigma : float
        Largest change of a parameter when it was taken up, in its standard deviations.
    moved_name : str
        That parameter.
    dof : float or None
        Degrees of freedom of `tails`.
    """

    name: str
    scale_px: float
    low_px: float
    high_px: float
    size_px: float
    gain_nat: float
    moved_sigma: float
    moved_name: str
    dof: float | None = None

    @classmethod
    def weighing(
        cls, name: str, gain_nat: float, scale_px: float = np.nan, dof: float | None = None
    ) -> FittedEffect:
        """An effect that decides how much stars count, and shifts none."""
        return cls(name, scale_px, np.nan, np.nan, np.nan, gain_nat, np.nan, "", dof)


@dataclass(frozen=True)
class FoundAir:
    """Air that was found, and where.

    Attributes
    ----------
    kind : {"place", "moment", "frames"}
        Whether all frames share a place on the Earth, a zenith among the stars (one moment, where
        times are not known), or have a zenith each.
    density, density_std : float
        Density of the air in that of the standard air at sea level, and its standard error.
    least_deg, most_deg : float
        Smallest and largest distance of a boresight from its zenith.
    zenith_std_deg : float
        Standard error of the zenith along the less certain of its two directions; median over the
        frames where each has its own.
    latitude_deg, latitude_std_deg : float
        Latitude of the place, north positive, and its standard error; NaN where frames have a
        zenith each.
    longitude_deg, longitude_std_deg : float
        Longitude, east positive, and its standard error; NaN without times.
    """

    kind: Literal["place", "moment", "frames"]
    density: float
    density_std: float
    least_deg: float
    most_deg: float
    zenith_std_deg: float
    latitude_deg: float = np.nan
    latitude_std_deg: float = np.nan
    longitude_deg: float = np.nan
    longitude_std_deg: float = np.nan


# Arrays that hold nothing.
_NO_VECTOR, _NO_MATRIX = partial(np.zeros, 0), partial(np.zeros, (0, 0))
_NO_PAIRS = partial(np.zeros, (0, 2))


@dataclass(frozen=True, eq=False)
class Effects(Shown):
    """Effects of a calibration, the first that was taken up first, and what they say of the camera.

    m coefficients belong to the run, in the order of the names; J nodes hold what is known of the
    scales.
    """

    fitted: tuple[FittedEffect, ...] = ()  # Those that shift stars
    selected: bool = False  # Whether the data were to choose, beside those that were asked for
    # Candidates that were not taken up, and what the next one would have gained, nat
    refused: tuple[tuple[str, float], ...] = ()
    penalty_nat: float = 0.0  # Gain that an effect has to exceed
    coefficients: FloatArray = field(default_factory=_NO_VECTOR)  # (m,): best ones
    # (m, m): covariance of the coefficients at the best scales
    covariance: FloatArray = field(default_factory=_NO_MATRIX)
    # (p, m): covariance of the camera's parameters with them, px units
    cross: FloatArray = field(default_factory=_NO_MATRIX)
    # (J, q, q), (J,): Gram matrices of the compressed likelihood at the nodes, the best scales
    # first, and log weights of the nodes in the mixture
    node_grams: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 0)))
    node_log_weights: FloatArray = field(default_factory=_NO_VECTOR)
    # Where the camera's parameters hold, and what one standard deviation of the temperature is,
    # degC; first and last time, seconds since 1970; NaN of what the table lacks
    temperature_c: tuple[float, float] = (np.nan, np.nan)
    time_s: tuple[float, float] = (np.nan, np.nan)
    places: tuple[tuple[str, int], ...] = ()  # Number of the run's coefficients of each effect
    air: FoundAir | None = None  # Of the effect `zenith`
    zeniths: Zeniths | None = None  # Around which its coefficients are
    # (K, c), px at the corner: coefficients of the frames' effect and their standard deviations;
    # (S, 2), px at the boresight: those of the stars along two axes on the sky. None where there is
    # no such effect, and in files of earlier versions.
    frames: FloatArray = field(default_factory=_NO_MATRIX)
    frame_sigmas: FloatArray = field(default_factory=_NO_MATRIX)
    stars: FloatArray = field(default_factory=_NO_PAIRS)
    star_sigmas: FloatArray = field(default_factory=_NO_PAIRS)
    extent: Extent | None = None  # Of all frames, where their residuals are those of a sample
    weighing: tuple[FittedEffect, ...] = ()  # Noise that varies, and tails
    of_camera: tuple[FittedEffect, ...] = ()  # Those that became parameters of the camera: axes
    asked: tuple[str, ...] = ()  # Names of those that were asked for
    # Root mean square of the direction errors that the catalogue of the effect `star` states, px
    stated_px: float = 0.0

    SHAPES: ClassVar = """
        m: coefficients
        m m: covariance
        p m: cross
        j q q: node_grams
        j: node_log_weights
        k c: frames frame_sigmas
        s 2: stars star_sigmas
    """

    @classmethod
    def of_stars(cls, stars: AnyDict, compressed: CompressedLikelihood) -> Effects:
        """Errors of the stars of an earlier version, which had a record of their own, as an effect."""
        tau, nothing = float(stars["tau_px"]), np.nan
        factor = float(np.exp(1.96 * stars["tau_px_std"] / max(tau, 1e-12)))
        own = FittedEffect("star", tau, tau / factor, tau * factor, nothing, nothing, nothing, "")
        return cls(
            (own,),
            cross=np.zeros((len(compressed.theta_hat), 0)),
            node_grams=compressed.gram[None],
            node_log_weights=np.zeros(1),
            stated_px=float(stars["stated_px"]),
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all effects: of those that weigh stars, of those that are parameters of the
        camera, then of the others that shift stars.
        """
        return tuple(effect.name for effect in self.held)

    @property
    def held(self) -> tuple[FittedEffect, ...]:
        """All effects, in the order of their names."""
        return (*self.weighing, *self.of_camera, *self.fitted)

    def scale(self, name: str) -> float:
        """Scale of an effect, px at the corner; zero of one that is not there."""
        return next((e.scale_px for e in self.fitted if e.name == name), 0.0)

    @property
    def star_px(self) -> float:
        """Direction error of a star per axis with what its catalogue states, px at the boresight;
        zero where the effect `star` is not there.
        """
        return float(np.hypot(self.scale("star"), self.stated_px))

    def ratio(self, sigma: float) -> dict[str, float]:
        """Squares of the scales in units of `sigma` squared, by name."""
        return {e.name: (e.scale_px / sigma) ** 2 for e in self.fitted}

    def at(self, name: str) -> slice:
        """Coefficients of an effect of the run; none of one that is not there."""
        first = 0
        for known, size in self.places:
            if known == name:
                return slice(first, first + size)
            first += size
        return slice(0, 0)

    def of(self, obs: Observations, camera: Camera) -> list[Effect]:
        """Its effects, in the order of the coefficients, as columns at the stars of the table; air
        is left out where its zeniths are not known.

        LookupError for one that the table does not allow.
        """
        known = effects_of(obs, camera, zeniths=self.zeniths, extent=self.extent)
        names = [effect.name for effect in self.fitted]
        return [known[n] for n in names if n != "zenith" or self.zeniths is not None]

    def about(
        self, compressed: CompressedLikelihood, shift: FloatArray, covariance: FloatArray
    ) -> Effects:
        """The effects where the camera's parameters are off the best ones of their compressed
        likelihood by (p,), with this covariance (p, p), px units: coefficients follow as far as the
        data tie them to these.

        The covariance holds what is known of the scales, and no camera that flies needs the
        zeniths.
        """
        effects = replace(
            self, node_grams=np.zeros((0, 0, 0)), node_log_weights=np.zeros(0), zeniths=None
        )
        if not len(effects.coefficients):
            return effects
        best = optimum(compressed).covariance
        follow = scaled_inverse(best) @ effects.cross
        return replace(
            effects,
            coefficients=effects.coefficients + shift @ follow,
            covariance=effects.covariance + follow.T @ (covariance - best) @ follow,
            cross=covariance @ follow,
        )

    def to_dataframe(self) -> pd.DataFrame:
        """One row per effect, those not taken up with their gain alone."""
        import pandas as pd

        fitted = [vars(effect) | {"taken": True} for effect in self.held]
        refused = [{"name": n, "gain_nat": gain, "taken": False} for n, gain in self.refused]
        columns = [*(each.name for each in fields(FittedEffect)), "taken"]
        return pd.DataFrame([*fitted, *refused], columns=columns)

    def mixed(
        self, compressed: CompressedLikelihood, theta: FloatArray, sigma: FloatArray
    ) -> FloatArray:
        """Log likelihood (n,) at theta (n, p) and sigma (n,) with the scales integrated over their
        nodes.
        """
        z = compressed.whiten(theta)
        squares, *others = squares_by(np.stack([compressed.gram, *self.node_grams]), z)
        apart = -0.5 * (np.stack(others) - squares) / np.square(sigma)
        plain = compressed.log_likelihood(theta, sigma)
        return plain + _log_sum_exp(apart + self.node_log_weights[:, None])


def _log_sum_exp(values: FloatArray) -> FloatArray:
    """Logarithm (n,) of the sum of exponentials of columns (m, n).

    The formula of `scipy.special.logsumexp`, to the bit, without what that spends on every call.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        top = values.max(axis=0)
        largest = values == top
        count = largest.sum(axis=0, dtype=float)
        rest = np.exp(np.where(largest, -np.inf, values - top)).sum(axis=0)
        return np.asarray(np.log1p(rest / count) + np.log(count) + top)
