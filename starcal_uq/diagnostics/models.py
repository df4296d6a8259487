"""Which distortion model the data support: expected log predictive density, leaving one frame out
at a time.

A frame is the unit, because its stars share an attitude. The log likelihood of a frame has its
attitude integrated out; the posterior of the parameters and the noise is that of the linearised
model under the reference prior (flat in the parameters, 1 / sigma): normal times scaled inverse
chi-square. Two estimates of each frame's density without itself:

- the closed form, a multivariate t, exact for the linearised model, and
- Pareto-smoothed importance sampling over posterior draws (Vehtari, Gelman & Gabry 2017), of some
  of the frames where they are many; frames whose k-hat exceeds 0.7 keep the closed form.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from starcal_uq.attitude.rotations import left_error, rotation_to_quaternion
from starcal_uq.camera.distortion import rivals
from starcal_uq.core.constants import ARCSEC, AXES
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import StarcalError
from starcal_uq.core.settings import Seed, bounded
from starcal_uq.core.types import FloatArray
from starcal_uq.diagnostics.beside import without_effects
from starcal_uq.estimation.fit import refit
from starcal_uq.estimation.normals import FrameNormals
from starcal_uq.estimation.weights import weighed
from starcal_uq.inference.arviz import psis
from starcal_uq.maths.intervals import student_quantile
from starcal_uq.observations.splits import one_of_each

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

KHAT_BOUND = 0.7
# A model is rejected when another one predicts better beyond the Student quantile for so many
# frames, and by more than chance between equal models (Sivula et al. 2020: below four, a difference
# of elpd says nothing).
REJECT_P, REJECT_ELPD = 0.005, 4.0
_DRAWS = 1000
# Frames whose densities are sampled as well; the closed form, which is exact for the same model,
# costs nothing.
_SAMPLED_FRAMES = 100


@dataclass(frozen=True)
class ModelScore:
    """One model in a comparison.

    Attributes
    ----------
    model : str
        Name of the distortion model.
    n_parameters : int
        p.
    sigma : float
        Estimated noise.
    elpd : float
        Expected log predictive density of a left-out frame, summed over frames, nat; up to a common
        constant.
    difference, difference_se : float
        `elpd` minus that of the best model, and its standard error over frames.
    effective_parameters : float
        How much the frames predict themselves better than left out, nat.
    closed_form : float
        `elpd` in closed form.
    max_khat : float
        Largest Pareto shape over the sampled frames.
    n_replaced : int
        Sampled frames whose importance weights could not be trusted, taken in closed form.
    common_arcsec : tuple of float
        Mean rotation over frames from the calibration's attitudes to this model's: pitch, yaw,
        roll.
    rest_arcsec : tuple of float
        Root mean square over frames of what is left of the rotation.
    rejected : bool
        True if another model predicts better beyond doubt.
    """

    model: str
    n_parameters: int
    sigma: float
    elpd: float
    difference: float
    difference_se: float
    effective_parameters: float
    closed_form: float
    max_khat: float
    n_replaced: int
    common_arcsec: tuple[float, float, float]
    rest_arcsec: tuple[float, float, float]
    rejected: bool

    GONE: ClassVar = ("preferred",)


@dataclass(frozen=True)
class ModelComparison(Shown):
    """Models side by side.

    Attributes
    ----------
    scores : tuple of ModelScore
        The best first.
    fitted : str
        The model of the calibration that was compared.
    failed : dict
        Models that could not be calibrated, and why.
    n_frames, n_sampled_frames : int
        Frames, and those of them whose densities were sampled; the others are in closed form. 0 in
        a comparison of a version that sampled all.
    of_frames : int
        Frames of the calibration, of which `n_frames` are a sample; 0 where they are all.
    """

    scores: tuple[ModelScore, ...]
    fitted: str
    failed: dict[str, str]
    n_frames: int = 0
    n_sampled_frames: int = 0
    of_frames: int = 0

    GONE: ClassVar = ("share",)

    @property
    def accepted(self) -> tuple[ModelScore, ...]:
        """Models that are not rejected, the best first."""
        return tuple(score for score in self.scores if not score.rejected)

    @property
    def simplest(self) -> ModelScore:
        """The model with the fewest parameters that is not rejected."""
        return min(self.accepted, key=lambda score: (score.n_parameters, -score.elpd))

    @property
    def better(self) -> str:
        """Of a fitted model that is rejected, the simplest accepted one that predicts better; else
        empty.
        """
        mine = self.of(self.fitted)
        if mine is None or not mine.rejected:
            return ""
        ahead = [score for score in self.accepted if score.elpd > mine.elpd]
        return min(ahead, key=lambda score: (score.n_parameters, -score.elpd)).model

    def of(self, model: str) -> ModelScore | None:
        """The score of one model."""
        return next((score for score in self.scores if score.model == model), None)

    def to_dataframe(self) -> pd.DataFrame:
        """One row per model, the best first."""
        import pandas as pd

        rows = []
        for score in self.scores:
            row = asdict(score)
            for part in ("common", "rest"):
                values = row.pop(f"{part}_arcsec")
                row |= {f"{part}_{axis}_arcsec": v for axis, v in zip(AXES, values, strict=True)}
            rows.append(row)
        return pd.DataFrame(rows)


@bounded
def compare_models(
    obs: Observations,
    cal: Calibration,
    models: Sequence[str] | None = None,
    *,
    n_draws: int = _DRAWS,
    seed: Seed = 0,
    normals: FrameNormals | None = None,
    of_frames: int = 0,
) -> ModelComparison:
    """Compare distortion models by cross-validation over frames.

    Parameters
    ----------
    obs, cal
        The data and the calibration whose model is in question; its own model is always among those
        compared. Images are compared without its effects.
    models : sequence of str, optional
        Names of the registry; by default `starcal_uq.camera.distortion.rivals`.
    n_draws : int
        Posterior draws of each model.
    seed : int or Generator
        Seed of the draws.
    normals : FrameNormals, optional
        The frames' normal equations of a calibration without effects, where they are at hand.
    of_frames : int
        Frames of the calibration, where these are a sample.

    Raises
    ------
    StarcalError
        When no model can be calibrated.
    """
    obs = weighed(obs, cal)
    obs = without_effects(obs, cal)
    own = cal.camera.distortion
    names = tuple(dict.fromkeys((own, *(rivals(own) if models is None else models))))
    fits, failed = {} if normals is None or of_frames else {own: normals}, {}
    for name in names:
        try:
            fits[name] = fits.get(name) or _normals(obs, cal, name, bool(of_frames))
        except StarcalError as error:
            failed[name] = str(error)
    if not fits:
        raise StarcalError(
            f"no distortion model could be calibrated: {next(iter(failed.values()))}"
        )
    # Attitudes by the estimate of these frames: that of all is beside those of the other models.
    alone = of_frames and own in fits
    attitudes = rotation_to_quaternion(fits[own].rotations) if alone else cal.quaternions
    rng = np.random.default_rng(seed)
    found_scores = {name: _leave_out(normals, n_draws, rng) for name, normals in fits.items()}
    best = max(found_scores, key=lambda name: float(np.sum(found_scores[name].pointwise)))
    reference = found_scores[best].pointwise
    scores = []
    for name, normals in fits.items():
        loo = found_scores[name]
        difference = loo.pointwise - reference
        total = float(np.sum(difference))
        common, rest = _moved(attitudes, normals)
        scores.append(
            ModelScore(
                model=name,
                n_parameters=len(normals.theta),
                sigma=cal.sigma
                if name == cal.camera.distortion
                else float(np.sqrt(normals.variance)),
                elpd=float(np.sum(loo.pointwise)),
                difference=total,
                difference_se=_spread(difference),
                effective_parameters=float(np.sum(loo.in_sample - loo.pointwise)),
                closed_form=float(np.sum(loo.closed_form)),
                max_khat=loo.max_khat,
                n_replaced=loo.n_replaced,
                common_arcsec=common,
                rest_arcsec=rest,
                rejected=-total > _beyond_doubt(difference),
            )
        )
    scores.sort(key=lambda score: -score.elpd)
    sampled = min(obs.n_frames, _SAMPLED_FRAMES)
    return ModelComparison(
        tuple(scores),
        cal.camera.distortion,
        failed,
        n_frames=obs.n_frames,
        n_sampled_frames=sampled,
        of_frames=of_frames,
    )


def _spread(pointwise: FloatArray) -> float:
    """Standard error of a difference of scores from that of every frame (K,)."""
    return float(np.sqrt(len(pointwise)) * np.std(pointwise, ddof=1))


def _beyond_doubt(pointwise: FloatArray) -> float:
    return max(
        student_quantile(1.0 - 2.0 * REJECT_P, len(pointwise) - 1) * _spread(pointwise), REJECT_ELPD
    )


def _normals(obs: Observations, cal: Calibration, name: str, of_these: bool) -> FrameNormals:
    """Normal equations at the optimum of a model; of the calibration's own one at its estimate, or
    at that of these frames.
    """
    if name == cal.camera.distortion and not of_these:
        return FrameNormals.at(obs, cal)
    return FrameNormals.around(obs, name, *refit(obs, cal, name))


def _moved(
    attitudes: FloatArray, normals: FrameNormals
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    phi = left_error(rotation_to_quaternion(normals.rotations), attitudes) * ARCSEC
    common = phi.mean(axis=0)
    rest = np.sqrt(np.mean((phi - common) ** 2, axis=0))
    c, r = common.tolist(), rest.tolist()
    return (c[0], c[1], c[2]), (r[0], r[1], r[2])


@dataclass(frozen=True)
class _LeftOut:
    """Log densities per frame (K,): predictive without it, the same in closed form, and with it."""

    pointwise: FloatArray
    closed_form: FloatArray
    in_sample: FloatArray
    max_khat: float
    n_replaced: int


def _leave_out(normals: FrameNormals, n_draws: int, rng: np.random.Generator) -> _LeftOut:
    closed = closed_form(normals)
    chosen = one_of_each(len(normals.dof), _SAMPLED_FRAMES)
    dof = int(np.sum(normals.dof)) - len(normals.theta)
    factor = np.linalg.cholesky(np.linalg.inv(normals.matrix))
    sigma = np.sqrt(np.sum(normals.squares) / rng.chisquare(dof, n_draws))
    centre = np.linalg.solve(normals.matrix, normals.slopes.sum(axis=0))
    z = centre + sigma[:, None] * (rng.standard_normal((n_draws, len(factor))) @ factor.T)
    slopes = normals.slopes[chosen]
    matrices = normals.matrices[chosen]
    own_dof = normals.dof[chosen]
    squares = (
        normals.squares[chosen]
        - 2.0 * z @ slopes.T
        + np.einsum("sa,kab,sb->sk", z, matrices, z, optimize=True)
    )
    log_density = -0.5 * squares / sigma[:, None] ** 2 - np.outer(np.log(sigma), own_dof)
    log_density += -0.5 * normals.log_determinant[chosen] - 0.5 * own_dof * np.log(2.0 * np.pi)
    by_frame = np.ascontiguousarray(log_density.T)
    weights, khats = psis(-by_frame)
    good = khats <= KHAT_BOUND
    pointwise, in_sample = closed.copy(), closed_form(normals, left_out=False)
    pointwise[chosen[good]] = _log_mean_exp(weights + by_frame)[good] + np.log(n_draws)
    in_sample[chosen] = _log_mean_exp(by_frame)
    return _LeftOut(
        pointwise, closed, in_sample, float(np.max(khats)), int(np.count_nonzero(~good))
    )


def closed_form(normals: FrameNormals, *, left_out: bool = True) -> FloatArray:
    """Log predictive density (K,) of every frame given the others, or given all, for the linearised
    model.

    A frame's projected residuals, given the others, are multivariate t with ``nu = d - d_k - p``
    degrees of freedom, location ``h_k z_(k)`` and scale ``s_(k)^2 (I + h_k H_(k)^-1 h_k^T)``;
    determinant and inverse need matrices of size p only. Given all, H, z and s are those of all
    frames.
    """
    from scipy.special import gammaln

    matrix = normals.matrix
    matrices = normals.matrices
    slopes = normals.slopes
    dof = normals.dof
    squares, total = normals.squares.sum(), slopes.sum(axis=0)
    if left_out:
        z, rest = normals.left_out()
        squares, total, together = squares - normals.squares, total - slopes, matrix
        nu = dof.sum() - dof - len(normals.theta)
    else:
        rest, together, nu = matrix, matrix + matrices, dof.sum() - len(normals.theta)
        z = np.broadcast_to(np.linalg.solve(matrix, total), slopes.shape)
    variance = (squares - np.sum(total * z, axis=1)) / nu
    # What the frame's residuals and its own pull on the parameters leave, by the Woodbury identity.
    pull = slopes - np.einsum("kab,kb->ka", matrices, z)
    own = normals.squares - np.sum((slopes + pull) * z, axis=1)
    own -= np.sum(pull * np.linalg.solve(together, pull[..., None])[..., 0], axis=1)
    growth = np.linalg.slogdet(together)[1] - np.linalg.slogdet(rest)[1]
    density: FloatArray = (
        gammaln(0.5 * (nu + dof))
        - gammaln(0.5 * nu)
        - 0.5 * dof * np.log(nu * np.pi * variance)
        - 0.5 * growth
        - 0.5 * (nu + dof) * np.log1p(own / (nu * variance))
        - 0.5 * normals.log_determinant
    )
    return density


def _log_mean_exp(rows: FloatArray) -> FloatArray:
    top = np.max(rows, axis=1)
    return np.asarray(top + np.log(np.mean(np.exp(rows - top[:, None]), axis=1)))
