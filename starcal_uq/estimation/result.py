"""The result of a calibration: estimate, uncertainty and how it was reached; saves itself without
loss.
"""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from starcal_uq.attitude.rotations import quaternion_to_rotation
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import parameters, sigma_parameter
from starcal_uq.camera.projection import unproject
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.files import atomic_path, reading
from starcal_uq.core.later import Deferring
from starcal_uq.core.manifest import digest
from starcal_uq.core.provenance import Provenance, Traced, in_order, provenance
from starcal_uq.core.records import Arrays, from_plain, read_arrays, to_plain, write_json
from starcal_uq.core.remedy import Remedy
from starcal_uq.core.settings import bounded
from starcal_uq.core.status import Status
from starcal_uq.core.types import AnyDict, FloatArray, IntArray, floats
from starcal_uq.estimation.kept import KeptFrames
from starcal_uq.estimation.prediction import PredictedCamera, displacement, predicted
from starcal_uq.estimation.residual_map import PartitionSums
from starcal_uq.estimation.stages import Stage
from starcal_uq.estimation.undetermined import remedy_of
from starcal_uq.likelihood.compressed import CompressedLikelihood
from starcal_uq.likelihood.fitted_effects import Effects
from starcal_uq.likelihood.ties import FittedTies
from starcal_uq.maths.intervals import student_quantile
from starcal_uq.maths.linear import correlation_of, is_positive, root_diagonal
from starcal_uq.observations.repeats import Fingerprints

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import ArrayLike

    from starcal_uq.likelihood.noise_model import NoiseModel
    from starcal_uq.observations.table import Observations

# Fields whose arrays grow with the data or the iterations: they stand in an archive beside the
# document.
_APART = (
    "frame_ids",
    "quaternions",
    "residuals_px",
    "trajectory",
    "cost",
    "sigmas",
    "sizes",
    "xy_px",
    "error_px",
    "star_weights",
    "frame_a",
    "frame_b",
    "sigma_arcsec",
)
# Fields of the document, in the order in which it is read.
_DOCUMENT = (
    "status",
    "parameter_names",
    "method",
    "solver",
    "sigma",
    "sigma_std",
    "sigma_name",
    "chi2",
    "dof",
    "provenance",
    "theta",
    "covariance",
    "information",
    "rotation_per_theta",
    "attitude_noise",
    "pair_theta",
    "pair_covariance",
    "camera",
    "nominal",
    "stages",
    "compressed",
    "fingerprints",
    "partitions",
    "undetermined",
    "effects",
    "ties",
)
# Hash of the archive that belongs to the document.
_ARCHIVE = "archive_sha256"
# What the document says of a stage; its last estimate is there for readers.
_STAGE = ("name", "status", "iterations", "evaluations", "seconds", "theta")


@dataclass(frozen=True)
class Calibration(Deferring, Shown, Traced):
    """Optics and distortion estimated from star observations.

    p is the number of parameters, K of frames, N of stars. A recursive method that was given a
    stream of frames has kept none of them: its `frame_ids`, `quaternions` and `residuals_px` are
    empty, `chi2` and `compressed` are those of the linearised frames, and `n_stars` and `n_frames`
    count what went by.

    `stages`, `pair_theta`, `pair_covariance`, `compressed`, `rotation_per_theta`, `attitude_noise`
    and `fingerprints` may be computed when they are first read; until then the calibration keeps
    the stars. Files hold them.

    Attributes
    ----------
    camera : Camera
        The estimate.
    nominal : Camera
        The start.
    method : str
        ``efficient``, ``three_stage``, ``least_squares``, ``samaan`` or ``griffith``.
    solver : str
        ``lm``, ``minpack``, ``ipopt``, or ``filter`` for the recursive methods.
    theta : (p,) array
        Estimate in px units, order x0, y0, f, k...
    covariance : (p, p) array
        Covariance of `theta` at the estimated noise, px units.
    sigma : float
        Estimated noise: px per axis, or a factor on the stated noise of the stars.
    sigma_std : float
        Standard error of `sigma`, in its unit.
    sigma_name : str
        ``sigma`` or ``sigma_scale``.
    stages : tuple of Stage
        Trajectories of the stages.
    status : Status
        Converged, or why not.
    frame_ids : (K,) array of int
        Frames.
    quaternions : (K, 4) array
        Scalar-last R_cam_icrs at the estimate.
    residuals_px : (N, 2) array
        Observed minus predicted, px, rows as in the observations.
    chi2 : float
        Sum of squared residuals, px^2 (or in units of the stated noise).
    dof : int
        Degrees of freedom: ``sum_k (2 m_k - 3) - p``.
    information : (p, p) array
        Fisher information of the likelihood with the attitudes eliminated, at `sigma`.
    rotation_per_theta : (3, p) array
        Mean over frames of d(attitude, rad)/d(theta): the common rotation that a wrong parameter
        causes.
    attitude_noise : (3, 3) array
        Mean over frames of the attitude covariance due to centroid noise, rad^2.
    pair_theta : (p,) array
        Estimate from interstar angles: that of stage 3, the paper's, or of the method itself where
        it has no other.
    pair_covariance : (p, p) array
        Sandwich (Godambe) covariance of `pair_theta`, px units; with fewer than 50 frames per
        parameter that which Gaussian noise gives.
    compressed : CompressedLikelihood
        The whole data set's likelihood around the estimate.
    provenance : Provenance
        Versions, settings, time and the hash of the data.
    fingerprints : Fingerprints or None
        What identifies the frames, so that a measurement is not counted twice; None for a stream,
        and for a calibration by a version before this one.
    partitions : PartitionSums or None
        Of a calibration of partitioned observations, sums over all of their residuals: `frame_ids`,
        `quaternions`, `residuals_px`, `pair_theta` and `pair_covariance` are those of a sample of
        frames, everything else of all.
    star_weights : (N,) array or None
        Weights that tails leave the stars, where a Gaussian likelihood keeps them.
    effects : Effects or None
        Effects beyond the camera, where they were asked for: `covariance`, `information` and
        `compressed` hold them, and residuals and attitudes are those after them.
    ties : FittedTies or None
        Known rotations between frames, where they were given: `covariance`, `information`, `dof`
        and `compressed` hold them, and residuals and attitudes are those with them.
    undetermined : tuple of str
        Names of parameters that the data leave open; `status` is then SINGULAR.
    """

    camera: Camera
    nominal: Camera
    method: str
    solver: str
    theta: FloatArray
    covariance: FloatArray
    sigma: float
    sigma_std: float
    sigma_name: str
    stages: tuple[Stage, ...]
    status: Status
    frame_ids: IntArray
    quaternions: FloatArray
    residuals_px: FloatArray
    chi2: float
    dof: int
    information: FloatArray
    rotation_per_theta: FloatArray
    attitude_noise: FloatArray
    pair_theta: FloatArray
    pair_covariance: FloatArray
    compressed: CompressedLikelihood
    provenance: Provenance
    fingerprints: Fingerprints | None = None
    partitions: PartitionSums | None = None
    undetermined: tuple[str, ...] = ()
    effects: Effects | None = None
    star_weights: FloatArray | None = None
    ties: FittedTies | None = None

    SHAPES: ClassVar = """
        p: parameter_names theta pair_theta
        p p: covariance information pair_covariance
        k: frame_ids
        k 4: quaternions
        n 2: residuals_px
        3 p: rotation_per_theta
        3 3: attitude_noise
    """
    FINITE: ClassVar = ("theta", "covariance", "sigma", "sigma_std", "information")

    @classmethod
    def of(
        cls,
        nominal: Camera,
        kept: KeptFrames,
        settings: AnyDict,
        *,
        theta: FloatArray,
        sigma: float,
        dof: int,
        status: Status,
        record: AnyDict | None = None,
        **found: Any,
    ) -> Calibration:
        """The calibration of an estimate; what follows from others is filled in here.

        `nominal`: the start. `settings` hold ``method`` and ``solver``. `record`: what else the
        provenance holds. `found`: further fields.
        """
        derived: AnyDict = {
            "sigma_name": sigma_parameter(kept.per_star).name,
            "frame_ids": kept.frame_ids,
            "quaternions": kept.quaternions,
            "residuals_px": kept.residuals_px,
            "fingerprints": kept.fingerprints,
            "provenance": provenance(None, settings, kept.data_hash) | (record or {}),
        }
        at = _at(nominal, theta, sigma, dof, status)
        made = {"nominal": nominal, "method": settings["method"], "solver": settings["solver"]}
        return cls(**(made | derived | at | found))

    def moved(
        self, theta: FloatArray, sigma: float, dof: int, status: Status, **found: Any
    ) -> Calibration:
        """The calibration with another estimate, noise and outcome, and further fields."""
        return replace(self, **(_at(self.nominal, theta, sigma, dof, status) | found))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        return self.camera.parameter_names

    @property
    def rotations(self) -> FloatArray:
        """Attitudes (K, 3, 3) at the estimate, R_cam_icrs."""
        return quaternion_to_rotation(self.quaternions)

    @property
    def known_effects(self) -> Effects:
        """The effects; none of them where it holds none."""
        return self.effects or Effects()

    @property
    def has_tails(self) -> bool:
        """True if its likelihood is that of a Student t."""
        return self.provenance.likelihood == "student_t"

    @property
    def nu(self) -> float:
        """Degrees of freedom of that Student t."""
        return float(self.provenance.student_t["dof"])

    @property
    def remedy(self) -> str:
        """Fault and remedy of a calibration that did not end well, in one clause."""
        return remedy_of(self.status, self.undetermined, self.camera.distortion, self.solver)

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviation of each parameter, (p,)."""
        return root_diagonal(self.covariance)

    @property
    def correlation(self) -> FloatArray:
        """Correlation matrix, (p, p)."""
        return correlation_of(self.covariance)[0]

    def interval(self, probability: float = 0.95) -> FloatArray:
        """Interval of each parameter without sampling, (p, 2), px units: Student's with `dof`
        degrees of freedom.

        A sigma from the scatter of frames has its own degrees of freedom, which provenance states.
        """
        own = self.provenance.interval_dof
        half = self.sigmas * [
            student_quantile(probability, own.get(n, self.dof)) for n in self.parameter_names
        ]
        return np.stack([self.theta - half, self.theta + half], axis=1)

    def sigma_interval(self, probability: float = 0.95) -> FloatArray:
        """Interval of the noise without sampling, (2,), in the unit of `sigma`: of chi-square with
        `dof`.
        """
        from scipy.special import chdtri

        tail = 0.5 * (1.0 - probability)
        return self.sigma * np.sqrt(
            [self.dof / float(chdtri(self.dof, q)) for q in (tail, 1.0 - tail)]
        )

    @property
    def noise_model(self) -> NoiseModel | None:
        """Model of the noise of a calibration with the effect ``noise``; None otherwise."""
        from starcal_uq.likelihood.noise_model import noise_model_of

        return noise_model_of(self)

    @property
    def fitted_noise(self) -> NoiseModel | None:
        """The noise model where it found that the noise varies; otherwise stars have what they
        state, or one noise.
        """
        model = self.noise_model
        return model if model is not None and model.varies else None

    @property
    def coma_factors(self) -> FloatArray | None:
        """Factors (p,) on the sigmas of the likelihood that leave out the coma of a distortion that
        may be none.
        """
        return in_order(self.provenance.without_coma, self.parameter_names)

    @property
    def tail_factors(self) -> FloatArray | None:
        """Factors (p,) on the sigmas of stars whose weights are known, for weights that come from
        the residuals themselves; None where there are none.
        """
        record = self.provenance.tail_weights
        return None if record is None else in_order(record["factors"], self.parameter_names)

    @property
    def tail_scale(self) -> float:
        """Scale of the residuals' tails, as `sigma`, which is that of the weighted residuals where
        stars keep the weights of tails.
        """
        record = self.provenance.tail_weights
        return self.sigma if record is None else float(record["sigma"])

    @property
    def width_factors(self) -> FloatArray:
        """Factors (p,) on the sigmas of the likelihood that `covariance` holds."""
        widths = np.ones(len(self.theta))
        accepted = in_order(self.provenance.inflation, self.parameter_names)
        for factors in (self.coma_factors, self.tail_factors, accepted):
            if factors is not None:
                widths = widths * factors
        return widths

    @property
    def sampled_likelihood(self) -> str:
        """The likelihood by which a posterior is that of the estimate: ``marginal`` also where
        stars have the weights of their tails.
        """
        return "marginal" if self.provenance.tail_weights else self.provenance.likelihood

    @bounded
    def at(
        self,
        *,
        temperature_c: float | None = None,
        time_utc: str | None = None,
        new_night: bool = False,
    ) -> PredictedCamera:
        """The camera at a temperature, at a time or on another night.

        Parameters
        ----------
        temperature_c : float, optional
            Temperature, degC; needs the effect ``temperature``. By default the mean of the table.
        time_utc : str, optional
            Time, ISO 8601, UTC; needs the effect ``time``. By default the middle of the run.
        new_night : bool
            Whether it is a night that the table does not hold; needs the effect ``epoch``.

        Returns
        -------
        PredictedCamera
            With a covariance that holds what is not known of the effects.

        Raises
        ------
        CalibrationError
            When the calibration holds no such effect.
        """
        estimate = PredictedCamera(self.camera, self.covariance)
        return predicted(estimate, self.known_effects, temperature_c, time_utc, new_night)

    def displacement(
        self, xy: ArrayLike, names: Collection[str] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Displacement by effects that depend on the place on the detector: axes, field, pixel
        phase.

        Parameters
        ----------
        xy : (n, 2) array
            Pixels.
        names : collection of str, optional
            Which of these effects; all by default.

        Returns
        -------
        shift : (n, 2) array
            Measured minus what `camera` predicts, px; zero without such effects.
        covariance : (n, 2, 2) array
            Its covariance, px^2.
        """
        pixels = np.atleast_2d(floats(xy))
        estimate = PredictedCamera(self.camera, self.covariance)
        return displacement(estimate, self.known_effects, pixels, names)

    def directions(self, xy: ArrayLike) -> FloatArray:
        """Unit vectors (n, 3) in the camera frame of what is seen at pixels (n, 2), by the camera
        and the effects of the place.
        """
        pixels = np.atleast_2d(floats(xy))
        return unproject(self.camera, pixels - self.displacement(pixels)[0])

    def log_likelihood(self, theta: FloatArray, sigma: FloatArray) -> FloatArray:
        """Log likelihood (n,) of the whole data set at theta (n, p), px units, and sigma (n,), the
        scales of effects integrated.
        """
        if not self.known_effects.fitted:
            return self.compressed.log_likelihood(theta, sigma)
        return self.known_effects.mixed(self.compressed, theta, sigma)

    @property
    def n_stars(self) -> int:
        """Number of stars."""
        return (
            self.compressed.n_stars
            if self.partitions
            else len(self.residuals_px) or self.compressed.n_stars
        )

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return (
            self.compressed.n_frames
            if self.partitions
            else len(self.frame_ids) or self.compressed.n_frames
        )

    def data_hash_of(self, obs: Observations) -> str:
        """Hash of the data that a table represents: for a sample of partitions, the hash of all of
        them.
        """
        if self.provenance.partitions.get("sample_sha256") == obs.data_hash:
            return str(self.provenance.data_sha256)
        return obs.data_hash

    @property
    def has_residuals(self) -> bool:
        """False for the result of a stream, whose stars are gone."""
        return len(self.residuals_px) > 0

    @property
    def with_noise(self) -> FloatArray:
        """Start, estimate and sigma (3, p+1) of the parameters and of the noise, which has no
        start; px units.
        """
        start = [*self.nominal.theta, np.nan]
        return np.array([start, [*self.theta, self.sigma], [*self.sigmas, self.sigma_std]])

    def to_dataframe(self) -> pd.DataFrame:
        """One row per parameter: start, estimate, sigma, 95 % interval and unit; the noise is the
        last row.
        """
        import pandas as pd

        low, high = np.vstack([self.interval(), self.sigma_interval()]).T
        unit = "px" if self.sigma_name == "sigma" else "1"
        return pd.DataFrame(
            {
                "parameter": [*self.parameter_names, self.sigma_name],
                **dict(zip(("start", "estimate", "sigma"), self.with_noise, strict=True)),
                "low": low,
                "high": high,
                "unit": [*(p.unit for p in parameters(self.camera.distortion)), unit],
            }
        )

    def __repr__(self) -> str:
        values = ", ".join(
            f"{name}={value:.8g}+-{sigma:.2g}"
            for name, value, sigma in zip(
                self.parameter_names, self.theta, self.sigmas, strict=True
            )
        )
        return f"Calibration({values}, {self.sigma_name}={self.sigma:.4g}, {self.status.name})"

    def save(self, path: str | Path) -> None:
        """Write ``path`` (JSON) and, beside it, the large arrays as ``.npz``; each file atomically.

        Parameters
        ----------
        path : str or Path
            File ending in ``.json``; overwritten.
        """
        path = Path(path)
        arrays: Arrays = {}
        plain = to_plain(self, arrays, _APART) | {"parameter_names": list(self.parameter_names)}
        for stage, kept in zip(self.stages, plain["stages"], strict=True):
            kept |= {"iterations": stage.iterations, "theta": stage.theta.tolist()}
        plain["stages"] = [{name: kept[name] for name in _STAGE} for kept in plain["stages"]]
        with atomic_path(path.with_suffix(".npz")) as temporary:
            with temporary.open("wb") as stream:
                np.savez_compressed(stream, allow_pickle=False, **arrays)
            archive = digest(temporary)
        kept = {
            name: plain[name] for name in _DOCUMENT if plain[name] is not None and plain[name] != []
        }
        write_json(kept | {_ARCHIVE: archive}, path)

    @classmethod
    def load(cls, path: str | Path) -> Calibration:
        """Inverse of `save`.

        Raises
        ------
        RunFolderError
            When a file is missing or not a calibration, when the two are not of one calibration, or
            when the information matrix is not positive definite.
        """
        path, remedy = Path(path), Remedy("calibrate", purpose="again")
        beside = path.with_suffix(".npz")
        with reading(path, "a calibration", remedy):
            document = json.loads(path.read_text(encoding="utf-8"))
        with reading(beside, "the archive of a calibration", remedy):
            arrays = read_arrays(beside)
            archive = digest(beside)
        with reading(path, "a calibration", remedy):
            # Files of versions before this one do not name their archive.
            if document.pop(_ARCHIVE, archive) != archive:
                raise RunFolderError(
                    f"{path}: is not of the same calibration as {beside.name} beside it; read it "
                    "again if it is being "
                    f"written, or {remedy}."
                )
            stars = document.pop("star_errors", None)
            found = from_plain(cls, document, arrays)
            if stars is not None:
                found = replace(found, effects=Effects.of_stars(stars, found.compressed))
            # What the data leave open has no information.
            if not is_positive(found.information, strictly=not found.undetermined):
                raise ValueError("its information matrix is not positive definite")
            return found


def _at(nominal: Camera, theta: FloatArray, sigma: float, dof: int, status: Status) -> AnyDict:
    """Fields that follow from an estimate and its noise."""
    camera = nominal.with_theta(theta)
    return {
        "camera": camera,
        "theta": theta,
        "sigma": sigma,
        "sigma_std": sigma / float(np.sqrt(2.0 * dof)),
        "dof": dof,
        "status": check_camera(camera, status),
    }


def check_camera(camera: Camera, status: Status) -> Status:
    """`status`, unless the principal point left the detector or the distortion folds over inside
    the field.
    """
    if not status.ok:
        return status
    if not camera.contains(camera.theta[:2]):
        return Status.OUTSIDE_DETECTOR
    return Status.FOLDED if camera.folds else status
