"""Does a star bring an error along? A test of the variance that images of one star share, and what
it does to sigma.

Catalogue errors, blends and colours move a star's images together, however the camera is turned.
Residuals e, brought to the star's own axes on the sky (Q, a turn for every image), are then alike
within a star:

    R = e^T (Q Q^T - I) e / e^T e,

over the images of stars that recur, attitudes and parameters projected out. It is the score test of
a variance component that is common to a star; pairs of images alone count, so that noise that
differs from star to star does not raise it. Moments of R under independent noise are exact; its
tail is that of the gamma distribution with the first three.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.display import Shown
from starcal_uq.core.types import BoolArray, FloatArray, IntArray
from starcal_uq.diagnostics.beside import without_effects
from starcal_uq.diagnostics.misfit_test import LEAST_DOF
from starcal_uq.estimation.normals import StarNormals
from starcal_uq.estimation.weights import weighed
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.star_errors import star_numbers, star_term
from starcal_uq.likelihood.terms import TermSums
from starcal_uq.maths.linear import principal, root_diagonal
from starcal_uq.observations.frames import StarFrames

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

_STARS_AT_ONCE = 20_000
_ABSORBED = 1e-10
# More stars than this, and what the parameters absorb of them is too little to be worth a dense
# matrix.
_DENSE = 1500
# Normal quantiles: of a test of 5 %, and of a power of 90 %.
_SEEN = 1.645 + 1.282


@dataclass(frozen=True, eq=False)
class StarTest(Shown):
    """Position errors of stars: their size, their test, and uncertainties clustered by star.

    Attributes
    ----------
    parameter_names : tuple of str
        The p parameters.
    n_stars, n_recurring : int
        Distinct stars, and those seen in more than one frame that the test could use.
    n_images : int
        Images of the latter.
    p_value : float
        Probability of as much likeness within stars by chance; NaN where too few stars recur.
    tau_px, tau_px_std : float
        Direction error of a star per axis and its standard error, px at the boresight.
    visible_px : float
        Error that a test of 5 % would have seen nine times in ten, px.
    arcsec_per_px : float
        Scale at the boresight.
    included_px, included_px_std : float
        Error that the calibration has estimated and marginalised, and its standard error; zero
        where it has none.
    n_frames, of_frames : int
        Frames that the test used, and those of the estimate, of which they are a sample; 0 where
        it used all. Covariances are those that all frames have if they are like these.
    formal_covariance : (p, p) array
        Covariance if all images err independently.
    model_covariance : (p, p) array
        Covariance of the same estimate if stars bring errors of `tau_px`.
    sandwich_covariance : (p, p) array
        Cluster-robust covariance, clustered on the star.
    jackknife_covariance : (p, p) array
        ``(S - 1) / S`` times the scatter of the estimates that leave one of S stars out; NaN where
        one is needed.
    """

    parameter_names: tuple[str, ...]
    n_stars: int
    n_recurring: int
    n_images: int
    p_value: float
    tau_px: float
    tau_px_std: float
    visible_px: float
    arcsec_per_px: float
    formal_covariance: FloatArray
    model_covariance: FloatArray
    sandwich_covariance: FloatArray
    jackknife_covariance: FloatArray
    included_px: float = 0.0
    included_px_std: float = 0.0
    n_frames: int = 0
    of_frames: int = 0

    SHAPES: ClassVar = """
        p: parameter_names
        p p: formal_covariance model_covariance sandwich_covariance jackknife_covariance
    """

    @property
    def applicable(self) -> bool:
        """False where too few stars recur for a test."""
        return bool(np.isfinite(self.p_value))

    @property
    def widening(self) -> FloatArray:
        """Standard deviations with the stars' errors over the formal ones, (p,)."""
        return np.sqrt(np.diag(self.model_covariance) / np.diag(self.formal_covariance))

    def to_dataframe(self) -> pd.DataFrame:
        """One row per parameter: formal sigma, with star errors, cluster-robust, jackknife over
        stars.
        """
        import pandas as pd

        names = {
            "formal_sigma": self.formal_covariance,
            "star_sigma": self.model_covariance,
            "sandwich_sigma": self.sandwich_covariance,
            "jackknife_sigma": self.jackknife_covariance,
        }
        columns = {name: root_diagonal(covariance) for name, covariance in names.items()}
        return pd.DataFrame(
            {"parameter": list(self.parameter_names), **columns, "widening": self.widening}
        )


# Random signs, of which the small parts of traces are means.
_PROBES = 16


def star_test(obs: Observations, cal: Calibration, of_frames: int = 0) -> StarTest:
    """Test whether stars bring errors of their own along, and how much that widens the
    uncertainties.

    Parameters
    ----------
    obs, cal
        The data and the estimate made from them. Stars are told apart by `star_id` where all have
        one, else by direction.
    of_frames : int
        Frames of the estimate, where these are a sample: what more frames of the same stars do not
        average out is then larger beside their noise.
    """
    obs = without_effects(weighed(obs, cal), cal)
    focal = float(cal.theta[2])
    numbers = star_numbers(obs, focal)
    normals = StarNormals.at(obs, cal, numbers)
    found = _likeness(obs, cal, numbers)
    inverse = np.linalg.inv(normals.matrix)
    unit = np.outer(normals.scale, normals.scale)
    s = len(normals.scores)
    pull = normals.response.reshape(-1, len(unit)) @ inverse
    share = obs.n_frames / (of_frames or obs.n_frames)
    # What errors of the stars do to single images averages out as noise does; what two images of a
    # star have in common is the same in any number of frames.
    alone = inverse @ normals.of_images @ inverse
    pulled, coherent = (pull.T @ pull - less * alone for less in (0.0, 1.0 - share))
    noise = normals.squares / normals.dof
    own = own_noise(obs, noise, found.tau2)
    steps = normals.left_out()
    spread = steps - steps.mean(axis=0)
    scores = normals.scores @ inverse
    included = _included(cal)
    model = inverse * own * share + coherent * found.tau2
    growth = np.sqrt(np.diag(model) / np.diag(inverse * own + pulled * found.tau2))
    clustered = unit * np.outer(growth, growth)
    return StarTest(
        parameter_names=cal.parameter_names,
        n_stars=s,
        n_recurring=found.n_stars,
        n_images=found.n_images,
        p_value=found.p_value,
        tau_px=float(np.sqrt(found.tau2)),
        tau_px_std=found.tau_std,
        visible_px=found.visible,
        arcsec_per_px=ARCSEC / focal,
        formal_covariance=inverse * noise * share * unit,
        model_covariance=model * unit,
        sandwich_covariance=scores.T @ scores * s / (s - 1.0) * clustered,
        jackknife_covariance=spread.T @ spread * (s - 1.0) / s * clustered,
        included_px=included[0],
        included_px_std=included[1],
        n_frames=obs.n_frames if of_frames else 0,
        of_frames=of_frames,
    )


def _included(cal: Calibration) -> tuple[float, float]:
    """Error of the stars that a calibration has marginalised, and its standard error, px."""
    own = next((effect for effect in cal.known_effects.fitted if effect.name == "star"), None)
    if own is None:
        return 0.0, 0.0
    # The interval is that of the logarithm.
    return own.scale_px, own.scale_px * float(np.log(own.high_px / own.low_px)) / (2.0 * 1.96)


def own_noise(obs: Observations, variance: float, tau2: float) -> float:
    """The images' own noise variance where stars bring errors of tau2, px squared, into what a
    calibration takes for noise.
    """
    of_stars = tau2 * float(np.mean(obs.sigma_or_one**-2.0))
    return max(variance - of_stars, 0.1 * variance)


@dataclass(frozen=True)
class _Likeness:
    n_stars: int
    n_images: int
    p_value: float = float("nan")
    tau2: float = 0.0
    tau_std: float = float("nan")
    visible: float = float("nan")


def _recurring(obs: Observations, numbers: IntArray) -> BoolArray:
    """Images (N,) of stars that recur, in frames with two such images or more."""
    frame = np.repeat(np.arange(obs.n_frames), np.diff(obs.frame_starts))
    used = np.ones(len(numbers), dtype=bool)
    while True:
        often = np.bincount(numbers[used], minlength=int(numbers.max()) + 1) >= 2
        kept = used & often[numbers]
        kept &= (np.bincount(frame[kept], minlength=len(obs.frame_ids)) >= 2)[frame]
        if np.array_equal(kept, used):
            return kept
        used = kept


def _likeness(obs: Observations, cal: Calibration, numbers: IntArray) -> _Likeness:
    """The test, on images of recurring stars alone: others say nothing about likeness within a
    star.
    """
    used = _recurring(obs, numbers)
    if not used.any():
        return _Likeness(0, 0)
    frames, numbers = StarFrames.from_observations(obs).select(used), numbers[used]
    rotations = cal.rotations[np.isin(cal.frame_ids, obs.frame[used])]
    stars = (np.cumsum(np.bincount(numbers) > 0) - 1)[numbers]
    sums = TermSums(star_term(stars, frames.r, float(cal.theta[2]), rigid=True))
    p = len(cal.theta)
    likelihood = MarginalLikelihood(frames, cal.camera.distortion)
    gram = np.zeros((p + 1, p + 1))
    for part, state, columns, rows in likelihood.linearised(
        cal.theta, cal.sigmas, rotations, _STARS_AT_ONCE
    ):
        flat = columns.reshape(p + 1, -1)
        gram += flat @ flat.T
        sums.add(part, state, columns, rows)
    values, vectors = principal(gram[:p, :p], _ABSORBED, relative=True)
    root = vectors / np.sqrt(values)
    explained = root.T @ gram[:p, p]
    absorbed = sums.cross[:, :p] @ root
    total = float(gram[p, p] - explained @ explained)
    pull = sums.cross[:, p] - absorbed @ explained
    dof = 2 * frames.n_stars - 3 * frames.n_frames - len(values)
    nothing = _Likeness(sums.n_groups, frames.n_stars)
    if dof < LEAST_DOF:
        return nothing
    g1, g2, g3, g4 = _traces(sums.matrix, absorbed)
    # Of A = M - (g1 / dof) I on the residuals, M having the traces g: sums of powers of its
    # eigenvalues.
    m = g1 / dof
    a2, a3 = g2 - m * g1, g3 - 3.0 * m * g2 + 3.0 * m**2 * g1 - m**3 * dof
    if a2 <= _ABSORBED * g2:
        return nothing
    variance = 2.0 * a2 / (dof * (dof + 2.0))
    skewness = 8.0 * a3 / (dof * (dof + 2.0) * (dof + 4.0)) / variance**1.5
    statistic = (float(pull @ pull) / total - m) / np.sqrt(variance)
    # Moments of e^T M e and e^T e where a star's error adds tau^2 to the noise s^2.
    tau2 = (float(pull @ pull) - m * total) / a2
    size2 = max(tau2, 0.0)
    noise = max((total - size2 * g1) / dof, 0.1 * total / dof)

    def spread(share: float) -> float:
        middle, last = g3 - 2.0 * m * g2 + m**2 * g1, g4 - 2.0 * m * g3 + m**2 * g2
        return float(
            np.sqrt(2.0 * (noise**2 * a2 + 2.0 * noise * share * middle + share**2 * last)) / a2
        )

    sd = spread(size2)
    unit = float(1.0 / np.sqrt(np.mean(obs.sigma_or_one[used] ** -2.0)))
    low, high = np.sqrt(max(tau2 - sd, 0.0)), np.sqrt(size2 + sd)
    return _Likeness(
        n_stars=sums.n_groups,
        n_images=frames.n_stars,
        p_value=_gamma_tail(statistic, skewness),
        tau2=size2 * unit**2,
        tau_std=float(0.5 * (high - low)) * unit,
        visible=float(np.sqrt(_SEEN * spread(0.0))) * unit,
    )


def _traces(matrix: Any, absorbed: FloatArray) -> tuple[float, float, float, float]:
    """Traces of the first four powers of ``matrix - absorbed absorbed^T``."""
    if matrix.shape[0] <= _DENSE:
        values = np.linalg.eigvalsh(matrix.toarray() - absorbed @ absorbed.T)
        g1, g2, g3, g4 = np.sum(values ** np.arange(1, 5)[:, None], axis=1).tolist()
        return g1, g2, g3, g4
    return _sparse_traces(matrix)


def _sparse_traces(matrix: Any) -> tuple[float, float, float, float]:
    """The same of a sparse matrix whose products would fill up.

    The diagonal D and its products with the rest O are exact; tr(O^3), tr(D O^3) and tr(O^4), which
    are small, are means of x^T O^3 x and the like over random signs x (Hutchinson 1989).
    """
    from scipy.sparse import diags_array

    d = matrix.diagonal()
    rest = matrix - diags_array(d)
    squares = rest.power(2)
    row = squares.sum(axis=1)
    x = np.random.default_rng(0).choice((-1.0, 1.0), (len(d), _PROBES))
    one = rest @ x
    two = rest @ one
    cube, mixed = np.sum(one * two) / _PROBES, np.sum((rest @ (d[:, None] * x)) * two) / _PROBES
    third = np.sum(d**3) + 3.0 * (d @ row) + cube
    fourth = np.sum(d**4) + 4.0 * (d**2 @ row) + 2.0 * (d @ (squares @ d)) + 4.0 * mixed
    fourth += np.sum(two**2) / _PROBES
    return float(d.sum()), float(d @ d + row.sum()), float(third), float(fourth)


def _gamma_tail(z: float, skewness: float) -> float:
    """P(Z > z) of a gamma variable of mean 0, variance 1 and this skewness (Pearson's type III)."""
    from scipy.special import erfc, gammainc, gammaincc

    if abs(skewness) < 1e-4:
        return float(0.5 * erfc(z / np.sqrt(2.0)))
    shape = 4.0 / skewness**2
    x = max(shape + z * np.sqrt(shape) * np.sign(skewness), 0.0)
    return float(gammaincc(shape, x) if skewness > 0.0 else gammainc(shape, x))
