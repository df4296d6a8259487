"""What ArviZ wants besides the draws: prior, data, log likelihood, and images drawn from prior and
posterior.

The unit of the log likelihood is a frame. Its m stars share an attitude, which is integrated out,
so that they are 2 m - 3 independent numbers and no star has a density of its own; given the
parameters, frames are independent. With the whitened residuals e at the best attitude, and A their
derivative with respect to it,

    log p(frame) = -e.e / (2 sigma^2) - (2 m - 3) log sigma - 1/2 log |A^T A| - (2 m - 3) / 2 log(2
    pi),

a density per px^(2 m), the attitude being flat in its rotation vector (rad); with Student's t as in
`starcal_uq.likelihood.student`. Nothing is linearised in the parameters.

A drawn image is one that the same stars would make in another exposure of the same frame:
parameters, noise and attitude are drawn, and noise is added. What the eye can compare is its
`residual`: the part of its distance from the estimate's prediction that no small turn of the frame
makes, for the data and for the drawn images alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from starcal_uq.camera.projection import forward_kernel, forward_root
from starcal_uq.core.errors import SamplingError
from starcal_uq.core.files import write_netcdf
from starcal_uq.core.settings import Seed, bounded, check_memory, seed_of
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.types import AnyDict, FloatArray, PathLike, Progress
from starcal_uq.estimation.weights import weighed
from starcal_uq.inference.arviz import to_arviz
from starcal_uq.inference.posterior import Variables, write_group
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.student import StudentLikelihood
from starcal_uq.observations.frames import StarFrames
from starcal_uq.observations.splits import frame_sample

if TYPE_CHECKING:
    import xarray as xr

    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.table import Observations

Group = Literal[
    "prior",
    "observed_data",
    "constant_data",
    "log_likelihood",
    "prior_predictive",
    "posterior_predictive",
]
GROUPS: tuple[Group, ...] = get_args(Group)
LOG_LIKELIHOOD = "frame_log_density"
_PIXELS = ("x_px", "y_px", "residual_x_px", "residual_y_px")
_GAUSSIAN, _STUDENT = "marginal", "student_t"
# Draws of all groups, and frames of those that hold images.
_DRAWS, _FRAMES = 1000, 20


@bounded
@one_thread()
def arviz_data(
    post: Posterior,
    obs: Observations,
    *,
    groups: Sequence[Group] | None = None,
    n_draws: int = _DRAWS,
    n_frames: int = _FRAMES,
    seed: Seed = 0,
    progress: Progress | None = None,
) -> Any:
    """A posterior with all of ArviZ's groups, made on demand: ``InferenceData`` (0.23) or
    ``DataTree`` (1.x).

    The draws are thinned, evenly along every chain, so that all groups have the same. The log
    likelihood takes about 0.3 microseconds a star and draw and 8 bytes a frame and draw, images
    take 64 bytes a star and draw: 6 s and 30 MB for 1000 frames of 18 stars. `Posterior.data` has
    all draws, without these groups, and costs nothing.

    Parameters
    ----------
    post : Posterior
        What `starcal_uq.sample` gave.
    obs : Observations
        The data that it was sampled from; images can be drawn for other frames, too.
    groups : sequence of str, optional
        Which of ``prior``, ``observed_data``, ``constant_data``, ``log_likelihood``,
        ``prior_predictive`` and ``posterior_predictive`` come beside ``posterior`` and
        ``sample_stats``; by default all that the likelihood of the posterior has.
    n_draws : int
        Draws over all chains, and of the prior.
    n_frames : int
        Frames, evenly spread, of the data and the drawn images; the log likelihood has all.
    seed : int or Generator
        Seed of the prior, the noise and the attitudes.
    progress : callable, optional
        Called as ``progress(draws_done, draws_total)`` for the log likelihood.

    Returns
    -------
    InferenceData or DataTree
        The log likelihood has the dimensions chain, draw and frame, images chain, draw and star,
        where ``star_frame`` and ``star_id`` are coordinates. Every variable has its ``units``.

    Raises
    ------
    SamplingError
        For an unknown group, or one that there is not: the log likelihood needs the data of the
        posterior, and a likelihood of star positions in which frames are independent.
    """
    seed = seed_of(seed)
    return to_arviz(_datasets(post, obs, groups, n_draws, n_frames, seed, progress))


@bounded
@one_thread()
def write_arviz(
    post: Posterior,
    obs: Observations,
    path: PathLike,
    *,
    n_draws: int = _DRAWS,
    seed: Seed = 0,
    progress: Progress | None = None,
) -> tuple[str, ...]:
    """Write what `arviz_data` gives as netCDF, all or nothing, for programs that read ArviZ's
    schema; its groups.
    """
    seed = seed_of(seed)
    made = _datasets(post, obs, None, n_draws, _FRAMES, seed, progress)

    def fill(file: Any) -> None:
        for name, dataset in made.items():
            variables: Variables = {
                str(key): (tuple(map(str, v.dims)), v.values, dict(v.attrs))
                for key, v in dataset.variables.items()
            }
            # Coordinates that are no dimensions, as xarray names them to itself.
            beside = " ".join(str(key) for key in dataset.coords if key not in dataset.dims)
            write_group(
                file.create_group(name),
                variables,
                dataset.attrs | ({"coordinates": beside} if beside else {}),
            )

    write_netcdf(path, fill)
    return tuple(made)


def _datasets(
    post: Posterior,
    obs: Observations,
    groups: Sequence[Group] | None,
    n_draws: int,
    n_frames: int,
    seed: int,
    progress: Progress | None,
) -> dict[str, xr.Dataset]:
    obs = weighed(obs, post)
    hashed = post.provenance.data_sha256
    refused = _refused(post, hashed in (None, obs.data_hash))
    for group in groups or ():
        if group not in GROUPS:
            raise SamplingError(f"group {group!r} is unknown: use some of {', '.join(GROUPS)}.")
        if group in refused:
            raise SamplingError(f"there is no {group}: {refused[group]}.")
    chosen = [group for group in (GROUPS if groups is None else groups) if group not in refused]
    per_chain = post.n_walkers * post.n_steps
    kept = max(min(n_draws // post.n_ensembles, per_chain), 1)
    places = np.arange(kept) * per_chain // kept
    some, _ = frame_sample(obs, n_frames)
    check_memory(
        f"n_draws={n_draws}",
        8.0 * n_draws * ((obs.n_frames if "log_likelihood" in chosen else 0) + 8 * some.n_stars),
    )
    made: dict[str, xr.Dataset] = {}
    for name, dataset in post.datasets().items():
        thinned = dataset.isel(draw=places).assign_coords(draw=np.arange(kept))
        left_out = "; ".join(f"{group}: {why}" for group, why in refused.items())
        made[name] = thinned.assign_attrs(n_draws_of=len(post.draws), left_out=left_out)
    draws = _Draws(post, post.draws.reshape(post.n_ensembles, per_chain, -1)[:, places], places)
    images = _Images(post, some)
    prior_rng, post_rng = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(2))
    prior = post.priors.draw(n_draws, prior_rng)
    makers: dict[Group, Callable[[], xr.Dataset]] = {
        "prior": lambda: _prior(post, prior),
        "observed_data": images.observed,
        "constant_data": images.constant,
        "log_likelihood": lambda: _log_likelihood(post, obs, draws, progress),
        "prior_predictive": lambda: images.of_prior(prior, prior_rng),
        "posterior_predictive": lambda: images.of_posterior(draws, post_rng),
    }
    for group in GROUPS:
        if group in chosen:
            made[group] = makers[group]()
    return made


def _refused(post: Posterior, same_data: bool) -> dict[str, str]:
    """Groups that a posterior does not have, and why."""
    likelihood = post.diagnostics.likelihood
    predictive = ("log_likelihood", "posterior_predictive")
    if post.star_error_px > 0.0:
        return dict.fromkeys(
            predictive, "stars bring errors along, so that frames depend on each other"
        )
    if likelihood not in (_GAUSSIAN, _STUDENT):
        return dict.fromkeys(predictive, f"the likelihood {likelihood!r} is none of star positions")
    if not same_data:
        return {
            "log_likelihood": "these are not the observations, all of them, that the posterior was sampled from"
        }
    return {}


class _Draws:
    """Thinned draws (c, d, p+1), and their degrees of freedom where the likelihood has some."""

    def __init__(self, post: Posterior, values: FloatArray, places: Any) -> None:
        self.shape = values.shape[:2]
        self.theta, self.sigma = (
            values[..., :-1].reshape(-1, values.shape[2] - 1),
            values[..., -1].ravel(),
        )
        self.dof: FloatArray | None = None
        if post.dof_draws is not None:
            self.dof = post.dof_draws.reshape(post.n_ensembles, -1)[:, places].ravel()
        elif post.diagnostics.likelihood == _STUDENT:
            self.dof = np.full(len(self.sigma), float(post.provenance.settings["dof"]))

    def coords(self) -> AnyDict:
        return {"chain": np.arange(self.shape[0]), "draw": np.arange(self.shape[1])}


class _Frames:
    """Frames, and the model of their stars at the best attitudes for any draw."""

    def __init__(self, post: Posterior, obs: Observations) -> None:
        self.frames, self.model = StarFrames.from_observations(obs), post.camera.distortion
        self.gaussian = MarginalLikelihood(self.frames, self.model)
        self.reference, cost = self.gaussian.profile(post.camera.theta)
        if not np.isfinite(cost):
            raise SamplingError(
                "the calibrated camera does not fit these frames: are they those of the posterior?"
            )
        self._near = self.gaussian.sums(post.camera.theta)[1]
        self.student: StudentLikelihood | None = None
        if post.diagnostics.likelihood == _STUDENT:
            theta, sigma = post.camera.theta, float(np.mean(post.draws[:, -1]))
            nu = float(
                np.mean(
                    post.dof_draws
                    if post.dof_draws is not None
                    else post.provenance.settings["dof"]
                )
            )
            self.student = StudentLikelihood(
                self.frames, self.model, theta, self.reference.rotations
            )
            state = self.student.state(theta, sigma, nu)
            self.student.follow(theta, state, self.student.information(theta, state, sigma))

    def profile(self, theta: FloatArray) -> Any:
        return self.gaussian.profile(theta, self._near.at(theta))[0]


def _log_likelihood(
    post: Posterior, obs: Observations, draws: _Draws, progress: Progress | None
) -> xr.Dataset:
    import xarray as xr

    at = _Frames(post, obs)
    frames, values = at.frames, np.empty((len(draws.sigma), obs.n_frames))
    dof = 2.0 * frames.sizes - 3.0
    constant = -0.5 * dof * np.log(2.0 * np.pi)
    if frames.weight is not None:
        constant += 2.0 * frames.sum(np.log(frames.weight))
    for i, (theta, sigma) in enumerate(zip(draws.theta, draws.sigma, strict=True)):
        if at.student is not None and draws.dof is not None:
            values[i] = at.student.by_frame(theta, float(sigma), float(draws.dof[i]))
        else:
            state = at.profile(theta)
            squares = frames.sum(np.sum(state.e * state.e, axis=0))
            values[i] = -0.5 * (squares / sigma**2 + state.log_determinant) - dof * np.log(sigma)
        if progress is not None:
            progress(i + 1, len(values))
    about = {
        "units": "nat",
        "long_name": "log density of the stars of a frame, its attitude integrated out",
    }
    array = (("chain", "draw", "frame"), (values + constant).reshape(*draws.shape, -1), about)
    return xr.Dataset({LOG_LIKELIHOOD: array}, draws.coords() | {"frame": obs.frame_ids})


def _prior(post: Posterior, prior: FloatArray) -> xr.Dataset:
    import xarray as xr

    variables = {
        post.parameters[i].name: (
            ("chain", "draw"),
            (prior[:, i] / post.parameters[i].scale)[None],
            {"units": post.parameters[i].scaled_unit, "long_name": post.parameters[i].description},
        )
        for i in post.sampled
    }
    return xr.Dataset(variables, {"chain": [0], "draw": np.arange(len(prior))})


class _Images:
    """Images of some frames: the observed ones, and drawn ones."""

    def __init__(self, post: Posterior, obs: Observations) -> None:
        self._obs, self._at = obs, _Frames(post, obs)
        state, frames = self._at.reference, self._at.frames
        self._predicted = frames.pixel - frames.in_pixels(state.e)
        self._theta = post.camera.theta
        self._coords: AnyDict = {
            "star": np.arange(obs.n_stars),
            "star_frame": ("star", obs.frame),
        }
        if obs.star_id is not None:
            self._coords["star_id"] = ("star", np.asarray(obs.star_id))

    def _dataset(self, pixels: FloatArray, dims: tuple[str, ...], coords: AnyDict) -> xr.Dataset:
        """Positions (..., 2, n) and their residuals."""
        import xarray as xr

        flat = (pixels - self._predicted).reshape(-1, *self._predicted.shape)
        self._at.frames.whiten(flat)
        rest = self._at.frames.in_pixels(self._at.gaussian.project_out(self._at.reference, flat))
        rest = rest.reshape(pixels.shape)
        values = (pixels[..., 0, :], pixels[..., 1, :], rest[..., 0, :], rest[..., 1, :])
        named = zip(_PIXELS, values, strict=True)
        return xr.Dataset(
            {k: ((*dims, "star"), v, {"units": "px"}) for k, v in named}, coords | self._coords
        )

    def observed(self) -> xr.Dataset:
        """The data."""
        return self._dataset(self._at.frames.pixel, (), {})

    def constant(self) -> xr.Dataset:
        """Where the stars are, and where the estimate puts them."""
        import xarray as xr

        columns = {"ra_deg": self._obs.ra_deg, "dec_deg": self._obs.dec_deg}
        columns |= {"model_x_px": self._predicted[0], "model_y_px": self._predicted[1]}
        columns |= {} if self._obs.sigma_px is None else {"sigma_px": self._obs.sigma_px}
        units = {name: {"units": name.rpartition("_")[2]} for name in columns}
        return xr.Dataset({k: ("star", v, units[k]) for k, v in columns.items()}, self._coords)

    def of_posterior(self, draws: _Draws, rng: np.random.Generator) -> xr.Dataset:
        """Another exposure for every draw; NaN for stars that a Student-t likelihood leaves out."""
        frames, n = self._at.frames, self._at.frames.n_stars
        pixels = np.empty((len(draws.sigma), 2, n))
        for i, (theta, sigma) in enumerate(zip(draws.theta, draws.sigma, strict=True)):
            noise = sigma * rng.standard_normal((2, n))
            if self._at.student is not None and draws.dof is not None:
                nu = float(draws.dof[i])
                state: Any = self._at.student.state(theta, float(sigma), nu)
                noise *= np.sqrt(nu / rng.chisquare(nu, n))
                noise[:, ~state.seen] = np.nan
            else:
                state = self._at.profile(theta)
            turns = sigma * np.einsum(
                "abk,bk->ak", _roots(state.inverse), rng.standard_normal((3, frames.n_frames))
            )
            moved = np.einsum("axn,an->xn", state.attitude, frames.spread(turns))
            pixels[i] = frames.pixel + frames.in_pixels(moved + noise - state.e)
        return self._dataset(pixels.reshape(*draws.shape, 2, n), ("chain", "draw"), draws.coords())

    def of_prior(self, prior: FloatArray, rng: np.random.Generator) -> xr.Dataset:
        """Images by cameras of the prior, pointed as the estimate says; NaN where a camera has
        none.
        """
        frames, n = self._at.frames, self._at.frames.n_stars
        b = frames.rotated(self._at.reference.rotations)
        project = forward_kernel(self._at.model, "attitude")
        pixels = np.empty((len(prior), 2, n))
        for i, draw in enumerate(prior):
            noise = draw[-1] * rng.standard_normal((2, n))
            with np.errstate(all="ignore"):
                xy = project(n, draw[:-1], b, forward_root(self._at.model, draw[:-1], b))[0]
            pixels[i] = np.where(np.isfinite(xy), xy, np.nan) + frames.in_pixels(noise)
        coords = {"chain": [0], "draw": np.arange(len(prior))}
        return self._dataset(pixels[None], ("chain", "draw"), coords)


def _roots(inverse: FloatArray) -> FloatArray:
    """Square roots (3, 3, K) of covariances (3, 3, K), which are nothing where a frame has no
    attitude.
    """
    fixed = inverse[0, 0] > 0.0
    covariance = np.where(fixed[:, None, None], np.moveaxis(inverse, 2, 0), np.eye(3))
    return np.asarray(np.moveaxis(np.linalg.cholesky(covariance), 0, 2) * fixed)
