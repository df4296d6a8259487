"""The posterior as a result: draws, what they rest on, and whether they can be trusted.

Opening a saved posterior needs neither the sampler nor the symbolic model nor a plotting library.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import Parameter, parameters, scales_of, sigma_parameter
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.files import check_hdf5, ensure_new, reading, write_netcdf
from starcal_uq.core.provenance import Provenance, Traced
from starcal_uq.core.records import Arrays, from_plain, to_json, to_plain
from starcal_uq.core.remedy import RUN, Remedy, read_remedies
from starcal_uq.core.settings import Seed, bounded
from starcal_uq.core.status import CODES, Check, Level, Words, worst
from starcal_uq.core.types import AnyDict, FloatArray, IntArray, PathLike
from starcal_uq.inference.priors import SIGMA_NAMES, Priors
from starcal_uq.likelihood.fitted_effects import Effects

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

# Dimensions, values and attributes by name.
Variables = dict[str, tuple[tuple[str, ...], NDArray[Any], AnyDict]]

DRAW_ORDER = (
    "chain is one separately seeded ensemble; within a chain, draws are ordered by half of the "
    "run, then walker, then "
    "step in that half, so that split R-hat compares the two halves in time and all ensembles"
)

_QUANTILES = (0.025, 0.5, 0.975)
_NUMBERS = ("prior_mean", "prior_sd", "mean", "sd", "q2.5", "q50", "q97.5", "mcse")


@dataclass(frozen=True, eq=False)
class Laplace:
    """Gaussian approximation of the posterior at its mode.

    Attributes
    ----------
    names : tuple of str
        Coordinates: the camera parameters, then ``log_sigma`` if the noise is sampled.
    mode : array (d,)
        Mode of the posterior density in these coordinates, px units.
    covariance : array (d, d)
        Inverse of the negative Hessian of the log posterior there.
    transform : array (d, d)
        Lower triangular square root of `covariance`; coordinates are ``mode + transform @ u``.
    iterations : int
        Newton steps taken.
    converged : bool
        True if the last step gained less than the tolerance.
    """

    names: tuple[str, ...]
    mode: FloatArray
    covariance: FloatArray
    transform: FloatArray
    iterations: int
    converged: bool

    SHAPES: ClassVar = """
        d: names mode
        d d: covariance transform
    """

    @property
    def mean(self) -> FloatArray:
        """Means (d,) of the parameters; the noise is log-normal here."""
        return self._moments()[0]

    @property
    def sd(self) -> FloatArray:
        """Standard deviations (d,) of the parameters."""
        return self._moments()[1]

    def _moments(self) -> tuple[FloatArray, FloatArray]:
        mean, variance = self.mode.copy(), np.diag(self.covariance).copy()
        if self.names[-1] == "log_sigma":
            growth = np.exp(variance[-1])
            mean[-1] = np.exp(self.mode[-1]) * np.sqrt(growth)
            variance[-1] = mean[-1] ** 2 * (growth - 1.0)
        return mean, np.sqrt(variance)


@dataclass(frozen=True)
class Derived:
    """One quantity."""

    # `name`, `unit`: name and unit.
    name: str
    unit: str
    # `mean`, `sd`, `mcse`: moments over the draws, and the Monte Carlo standard error of the mean.
    mean: float
    sd: float
    mcse: float
    # `rhat`, `ess_bulk`, `ess_tail`: convergence over separately seeded ensembles.
    rhat: float
    ess_bulk: float
    ess_tail: float


@dataclass(frozen=True, eq=False)
class Diagnostics:
    """Evidence that the draws are draws from the posterior.

    Arrays over parameters have the order of `Posterior.parameter_names` and hold NaN for a noise
    that was given.

    Attributes
    ----------
    rhat : array (p+1,)
        Rank-normalised split R-hat over ensembles.
    ess_bulk, ess_tail : array (p+1,)
        Effective numbers of draws for the centre and for the 5 % and 95 % quantiles.
    mcse : array (p+1,)
        Monte Carlo standard error of the mean, px units.
    acceptance : array (n_ensembles,)
        Fraction of accepted proposals after the burn-in.
    autocorrelation : array (p+1,)
        Integrated autocorrelation time, steps.
    n_evaluations : int
        Points at which the likelihood was evaluated while sampling, burn-in included.
    psis_khat : float
        Pareto shape of the importance weights of draws around the Laplace approximation; good below
        0.7.
    psis_ess : float
        Equivalent number of independent draws of these weights.
    psis_mean, psis_sd : array (p+1,)
        Moments by those weights, an estimate without a Markov chain.
    laplace_mean, laplace_sd : array (p+1,)
        Moments of the Laplace approximation.
    agreement_mean : float
        Largest difference between sampled and importance-weighted means, in standard deviations.
    agreement_sd : float
        Largest relative difference between their standard deviations.
    compressed_max_difference : float
        Largest difference between compressed and exact log likelihood found within three standard
        deviations of the mode, relative to the mode, nat; NaN where it was not checked.
    compressed_khat : float
        Pareto shape of the weights exact over compressed at the checked draws; 0 where all
        differences are below 0.1 nat, and no tail can matter.
    compressed_frames : tuple of int
        Frames that were compared for it and those that they stand for; zeros where all were
        compared.
    likelihood_used : str
        How it was evaluated: ``compressed``, ``exact``, or the name of the likelihood that was
        passed.
    likelihood : str
        ``marginal``, ``pairs``, ``pairs_naive``, ``student_t``, or the name of the likelihood that
        was passed.
    checks : tuple of Check
        Every check of the draws, made once while sampling.
    derived : tuple of Derived
        What follows from the parameters, with its convergence; empty in earlier posteriors.
    """

    rhat: FloatArray
    ess_bulk: FloatArray
    ess_tail: FloatArray
    mcse: FloatArray
    acceptance: FloatArray
    autocorrelation: FloatArray
    n_evaluations: int
    psis_khat: float
    psis_ess: float
    psis_mean: FloatArray
    psis_sd: FloatArray
    laplace_mean: FloatArray
    laplace_sd: FloatArray
    agreement_mean: float
    agreement_sd: float
    compressed_max_difference: float
    compressed_khat: float
    likelihood_used: str
    likelihood: str = "marginal"
    checks: tuple[Check, ...] = ()
    compressed_frames: tuple[int, int] = (0, 0)
    derived: tuple[Derived, ...] = ()

    SHAPES: ClassVar = """
        p: rhat ess_bulk ess_tail mcse autocorrelation psis_mean psis_sd laplace_mean laplace_sd
    """

    @property
    def level(self) -> Level:
        """The worst outcome of the checks."""
        return worst(self.checks)

    @property
    def ok(self) -> bool:
        """True if no check fails."""
        return self.level is not Level.FAIL


@dataclass(frozen=True, eq=False)
class Posterior(Shown, Traced):
    """Draws of the camera parameters and the noise, with their diagnostics.

    Attributes
    ----------
    parameter_names : tuple of str
        p camera parameters, then ``sigma`` (px) or ``sigma_scale`` (a factor on stated noises).
    draws : array (n, p+1)
        All draws in px units, one ensemble after the other, each in the order of `DRAW_ORDER`.
    log_posterior : array (n,)
        Log posterior density of (theta, log sigma), up to a constant.
    n_ensembles, n_walkers, n_steps : int
        ``n = n_ensembles * n_walkers * n_steps``.
    sigma_sampled : bool
        False if the noise was given; its column is then constant.
    priors : Priors
        Priors that the draws rest on besides the data.
    laplace : Laplace
        Gaussian approximation at the mode.
    diagnostics : Diagnostics
        Convergence and independent checks.
    information : array (p, p)
        Fisher information of the data alone, at the calibration's estimate.
    rotation_per_theta : array (3, p)
        Mean over frames of d(attitude error) / d(theta), rad per px unit.
    attitude_noise : array (3, 3)
        Mean over frames of the attitude covariance due to centroid noise, rad^2.
    camera : Camera
        The calibrated camera around which everything is linearised.
    provenance : Provenance
        Seed, settings, versions, time and data hash.
    dof_draws : array (n,) or None
        Draws of the degrees of freedom of a Student-t likelihood where they were free.
    star_error_px : float
        Direction error of a star per axis, px, where the calibration holds such errors; a frame's
        attitude has it, too.
    effects : Effects or None
        Effects of the calibration, as they are jointly known with the draws of the parameters; None
        where it holds none.
    """

    parameter_names: tuple[str, ...]
    draws: FloatArray
    log_posterior: FloatArray
    n_ensembles: int
    n_walkers: int
    n_steps: int
    sigma_sampled: bool
    priors: Priors
    laplace: Laplace
    diagnostics: Diagnostics
    information: FloatArray
    rotation_per_theta: FloatArray
    attitude_noise: FloatArray
    camera: Camera
    provenance: Provenance
    dof_draws: FloatArray | None = None
    star_error_px: float = 0.0
    effects: Effects | None = None

    SHAPES: ClassVar = """
        p+1: parameter_names
        n p+1: draws
        n: log_posterior dof_draws
        p p: information
        3 p: rotation_per_theta
        3 3: attitude_noise
    """
    FINITE: ClassVar = (
        "draws",
        "log_posterior",
        "information",
        "rotation_per_theta",
    )

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Names of the p camera parameters."""
        return self.parameter_names[:-1]

    @property
    def sigma_name(self) -> str:
        """``sigma`` or ``sigma_scale``."""
        return self.parameter_names[-1]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Units, scales and symbols of `parameter_names`."""
        noise = sigma_parameter(self.sigma_name == SIGMA_NAMES[1])
        return (*parameters(self.camera.distortion), noise)

    @property
    def theta_draws(self) -> FloatArray:
        """Draws (n, p) of the camera parameters."""
        return self.draws[:, :-1]

    @property
    def sigma_draws(self) -> FloatArray:
        """Draws (n,) of the noise."""
        return self.draws[:, -1]

    @cached_property
    def mean(self) -> FloatArray:
        """Posterior mean (p,) of the camera parameters."""
        return np.asarray(self.theta_draws.mean(axis=0))

    @property
    def calibrated_camera(self) -> Camera:
        """The camera at the posterior mean."""
        return self.camera.with_theta(self.mean)

    @cached_property
    def covariance(self) -> FloatArray:
        """Posterior covariance (p, p) of the camera parameters."""
        shift = self.theta_draws - self.mean
        return shift.T @ shift / (len(shift) - 1)

    @cached_property
    def sd(self) -> FloatArray:
        """Posterior standard deviations (p+1,), the noise last."""
        return np.asarray(self.draws.std(axis=0, ddof=1))

    @property
    def sampled(self) -> tuple[int, ...]:
        """Columns of `draws` that were sampled."""
        return tuple(range(len(self.parameter_names) - (not self.sigma_sampled)))

    @cached_property
    def data(self) -> Any:
        """Draws as ArviZ knows them: ``InferenceData`` (0.23) or ``DataTree`` (1.x).

        Chain is the ensemble; coefficients are divided by `Parameter.scale` (k1 in 1e-10 px^-2),
        because ArviZ reports a wrong effective sample size and prints zero for tiny numbers; units
        are attributes.
        """
        from starcal_uq.inference.arviz import to_arviz

        return to_arviz(self.datasets())

    def datasets(self) -> dict[str, xr.Dataset]:
        """ArviZ's groups ``posterior`` and ``sample_stats`` as xarray datasets (chain, draw)."""
        import xarray as xr

        return {name: xr.Dataset(*group) for name, group in self._groups().items()}

    def _groups(self) -> dict[str, tuple[Variables, dict[str, IntArray], AnyDict]]:
        """Variables, coordinates and attributes of these groups."""
        shape = (self.n_ensembles, self.n_walkers * self.n_steps)
        coords = {"chain": np.arange(shape[0]), "draw": np.arange(shape[1])}
        shown = self.parameters
        variables: Variables = {
            shown[i].name: (
                ("chain", "draw"),
                (self.draws[:, i] / shown[i].scale).reshape(shape),
                {
                    "units": shown[i].scaled_unit,
                    "long_name": shown[i].description,
                    "scale": shown[i].scale,
                },
            )
            for i in self.sampled
        }
        if self.dof_draws is not None:
            about: AnyDict = {
                "units": "1",
                "long_name": "degrees of freedom of Student's t",
                "scale": 1.0,
            }
            variables["dof"] = (("chain", "draw"), self.dof_draws.reshape(shape), about)
        attrs: AnyDict = {
            "inference_library": "emcee",
            "inference_library_version": str(self.provenance.versions.get("emcee")),
            "draw_order": DRAW_ORDER,
            "n_walkers": self.n_walkers,
            "n_steps": self.n_steps,
            "provenance": to_json(self.provenance),
        }
        if not self.sigma_sampled:
            attrs[f"{self.sigma_name}_given"] = float(self.sigma_draws[0])
        stats: Variables = {
            "lp": (("chain", "draw"), self.log_posterior.reshape(shape), {"units": "nat"})
        }
        return {"posterior": (variables, coords, attrs), "sample_stats": (stats, coords, attrs)}

    def summary(self) -> pd.DataFrame:
        """One row per parameter: prior, posterior and diagnostics, plain and divided by the
        parameter's scale.

        Columns are ``parameter``, ``unit``, ``prior_mean``, ``prior_sd``, ``mean``, ``sd``,
        ``q2.5``, ``q50``, ``q97.5``, ``mcse``, ``rhat``, ``ess_bulk``, ``ess_tail``, then
        ``scaled_unit`` and ``scaled_...`` of every number that has the unit.
        """
        import pandas as pd

        quantiles = np.quantile(self.draws, _QUANTILES, axis=0)
        shown, d = self.parameters, self.diagnostics
        columns: AnyDict = {
            "parameter": list(self.parameter_names),
            "unit": [p.unit for p in shown],
            "prior_mean": self.priors.mean(self.parameter_names),
            "prior_sd": self.priors.sd(self.parameter_names),
            "mean": self.draws.mean(axis=0),
            "sd": self.sd,
            **{f"q{100 * q:g}": quantiles[i] for i, q in enumerate(_QUANTILES)},
            "mcse": d.mcse,
            "rhat": d.rhat,
            "ess_bulk": d.ess_bulk,
            "ess_tail": d.ess_tail,
            "scaled_unit": [p.scaled_unit for p in shown],
        }
        scale = scales_of(shown)
        columns.update({f"scaled_{name}": columns[name] / scale for name in _NUMBERS})
        return pd.DataFrame(columns)

    def to_dataframe(self) -> pd.DataFrame:
        """All draws in px units, with columns ``ensemble``, ``walker`` and ``step`` before the
        parameters.

        The unit of each column stands in ``.attrs["units"]``.
        """
        import pandas as pd

        half = self.n_steps // 2
        ensemble, part, walker, step = np.indices(
            (self.n_ensembles, 2, self.n_walkers, half)
        ).reshape(4, -1)
        place = {"ensemble": ensemble, "walker": walker, "step": part * half + step}
        draws = dict(zip(self.parameter_names, self.draws.T, strict=True))
        table = pd.DataFrame({**place, **draws})
        table.attrs["units"] = {shown.name: shown.unit for shown in self.parameters}
        return table

    @bounded
    def thin(self, n: int, seed: Seed | np.random.SeedSequence | None = None) -> FloatArray:
        """A random subset (n, p+1) of the draws without replacement; all of them if there are fewer
        than n.
        """
        rng = np.random.default_rng(seed)
        return self.draws[rng.permutation(len(self.draws))[:n]]

    def save(self, path: PathLike, force: bool = False) -> None:
        """Write everything to one netCDF file that ArviZ opens as well.

        Raises
        ------
        RunFolderError
            If the file exists and `force` is false, or cannot be written.
        """
        ensure_new(path, force)
        arrays: Arrays = {}
        record = to_plain(self, arrays, _ARRAYS)
        for kept, check in zip(
            record["diagnostics"]["checks"], self.diagnostics.checks, strict=True
        ):
            # For readers.
            kept |= {name: to_plain(getattr(check, name)) for name in _IN_WORDS}
        # The draws themselves are in px units, one column a parameter; those of ArviZ's group are
        # scaled.
        own = {
            "units": ", ".join(p.unit for p in self.parameters),
            "columns": ", ".join(self.parameter_names),
        }
        kept_record = {name: record[name] for name in _RECORD}
        kept_record |= {} if self.effects is None else {"effects": record["effects"]}
        attrs = {"format": _FORMAT, "record": json.dumps(kept_record)}

        # xarray would do it, but loads Dask for a lock, which takes longer than sampling.
        def fill(file: Any) -> None:
            # An empty dimension is an unlimited one.
            held: Variables = {
                name: (_ARRAYS[name], value, {}) for name, value in arrays.items() if value.size
            }
            held["draws"][2].update(own)
            write_group(file, held, attrs)
            for group, (variables, coords, about) in self._groups().items():
                dimensions: Variables = {
                    name: ((name,), values, {}) for name, values in coords.items()
                }
                write_group(file.create_group(group), dimensions | variables, about)

        write_netcdf(path, fill)

    @classmethod
    def load(cls, path: PathLike) -> Posterior:
        """Read what `save` wrote, without loss.

        Raises
        ------
        RunFolderError
            If the file is missing or is not a posterior.
        """
        import h5netcdf

        remedy = Remedy("sample", (RUN,), {"force": True}, "again")
        if not Path(path).is_file():
            first = Remedy("sample", (RUN,), purpose="first")
            raise RunFolderError(f"{path}: there is no such file; {first}.")
        with reading(path, "a posterior of this version", remedy):
            check_hdf5(path)
            with h5netcdf.File(path, "r") as file:
                if file.attrs.get("format") != _FORMAT:
                    raise ValueError("another format")
                record = json.loads(str(file.attrs["record"]))
                arrays = {
                    name: np.asarray(file.variables[name][...])
                    for name in _ARRAYS
                    if name in file.variables
                }
            for check in record["diagnostics"]["checks"]:
                # Files of earlier versions have titles and commands alone, or words alone.
                if "code" not in check:
                    check["code"] = CODES[check["name"]].name
                    check["remedies"] = to_plain(read_remedies(check["remedy"]))
                if "values" not in check:
                    check["told"] = {
                        field.name: check[field.name]
                        for field in fields(Words)
                        if field.name in check
                    }
                for facts in (check.get("values", {}), check.get("bounds", {})):
                    facts |= {
                        name: tuple(value)
                        for name, value in facts.items()
                        if isinstance(value, list)
                    }
            made = from_plain(cls, record, arrays)
            if made.n_ensembles * made.n_walkers * made.n_steps != len(made.draws):
                raise ValueError("it holds another number of draws than it says")
            if not set(made.parameter_names) <= set(made.priors.names):
                raise ValueError("its priors are those of other parameters")
            return made


def write_group(group: Any, variables: Variables, attrs: AnyDict) -> None:
    """Put variables with their dimensions, and attributes, into a group of a netCDF file."""
    for name, (dimensions, values, about) in variables.items():
        for dimension, size in zip(dimensions, values.shape, strict=True):
            if dimension not in group.dimensions:
                group.dimensions[dimension] = size
        # Steps that were rejected repeat their walker's place: two fifths of the bytes.
        options: AnyDict = (
            {"compression": "gzip", "compression_opts": 1} if values.size > _WORTH_PACKING else {}
        )
        if values.dtype.kind == "U":
            import h5py

            values, options = values.astype(object), options | {"dtype": h5py.string_dtype()}
        group.create_variable(name, dimensions, data=values, **options).attrs.update(about)
    group.attrs.update(attrs)


_FORMAT = "starcal_uq posterior 2"
# What a file tells of each check beside its facts.
_IN_WORDS = ("name", "question", "value", "bound", "sentence", "advice", "remedy")
_WORTH_PACKING = 10_000

_ARRAYS = {
    "draws": ("sample", "parameter"),
    "log_posterior": ("sample",),
    "information": ("camera_parameter", "camera_parameter_2"),
    "rotation_per_theta": ("axis", "camera_parameter"),
    "attitude_noise": ("axis", "axis_2"),
    # Present only where the likelihood has such a parameter.
    "dof_draws": ("sample",),
    "effects_coefficients": ("coefficient",),
    "effects_covariance": ("coefficient", "coefficient_2"),
    "effects_cross": ("camera_parameter", "coefficient"),
}

_RECORD = (
    *("parameter_names", "camera", "priors", "laplace", "diagnostics"),
    *("n_ensembles", "n_walkers", "n_steps", "sigma_sampled", "provenance", "star_error_px"),
)
