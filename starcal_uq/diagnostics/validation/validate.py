"""Are the intervals right? Simulation-based calibration, coverage and squared errors for one's own
sensor.

Observations are simulated again and again as the sensor would make them, calibrated and sampled,
and the truth is compared with its posterior. If the posterior is right, then

- the rank of the truth among posterior draws is uniform, for every parameter and for any function
  of parameters and data (Talts et al. 2018, arXiv:1804.06788; Modrak et al. 2023, arXiv:2211.02383,
  for the joint log likelihood);
- a 95 % interval holds the truth 95 times in a hundred;
- the normalised estimation error squared, e^T C^-1 e, is the number of parameters on average.

With the truth drawn from the prior (``truth="prior"``) this holds exactly, for any prior. With one
fixed truth it is the claim that a user makes in the end, that the intervals cover at *this* camera;
it holds as far as the data, and not the prior, decide.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Unpack, get_args

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import PriorError, SamplingError, check_known
from starcal_uq.core.provenance import provenance
from starcal_uq.core.settings import Seed, Truth, bounded, seed_of
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.types import AnyDict
from starcal_uq.diagnostics.validation.replicates import (
    MARGINAL,
    LikelihoodMaker,
    Replication,
    TrialOutcome,
    run_replicate,
)
from starcal_uq.diagnostics.validation.result import Validation
from starcal_uq.inference.priors import Priors
from starcal_uq.simulation.replicates import (
    ReplicateOptions,
    TrialOptions,
    Trials,
    campaign_of,
)

if TYPE_CHECKING:
    from starcal_uq.sky.catalogue import StarCatalogue

TRUTHS = get_args(Truth)
_CHUNK = 8
# Student t is for stars that are not where they should be; its sigma is not the noise that is
# simulated here.
LIKELIHOODS = (MARGINAL, "pairs", "pairs_naive")
# What truth="prior" draws from by default: narrow enough that every draw is a camera that sees the
# same sky.
_PRIOR_POINT_PX = 5.0
_PRIOR_FOCAL = 1e-3
_PRIOR_CORNER_PX = 1.0
_PRIOR_LOG_SIGMA = 0.2


@bounded
@one_thread()
def validate(
    camera: Camera,
    *,
    n_replicates: int = 1000,
    n_frames: int = 50,
    seed: Seed = 0,
    truth: Truth = "fixed",
    priors: Priors | None = None,
    stars: StarCatalogue | None = None,
    assumed_sigma_px: float | None = None,
    likelihood: str | LikelihoodMaker = MARGINAL,
    **options: Unpack[ReplicateOptions],
) -> Validation:
    """Check intervals, ranks and errors of calibration and posterior for a sensor and its volume of
    data.

    Parameters
    ----------
    camera : Camera
        The sensor, with the optics and distortion that it is thought to have. Every calibration
        starts as from its data sheet: principal point in the centre, no distortion.
    n_replicates : int
        Data sets to simulate; 1000 know a coverage to 1.4 %.
    n_frames : int
        Frames of one calibration.
    seed : int or Generator
        The same seed gives the same result, bit for bit, for any number of processes; the first
        replicates of a longer validation are those of a shorter one.
    truth : {"fixed", "prior"}
        ``fixed``: the truth is `camera` in every replicate, sampled with the default priors, which
        are nearly flat there. ``prior``: the truth is drawn from the priors.
    priors : Priors, optional
        Instead of ``Priors.default`` of the data-sheet camera, or, with ``truth="prior"``, instead
        of narrow ones around `camera` (`narrow_priors`).
    stars : StarCatalogue, optional
        The sky, instead of the embedded catalogue to `max_mag`.
    assumed_sigma_px : float, optional
        Tell the sampler this noise instead of letting it sample the noise.
    likelihood : {"marginal", "pairs", "pairs_naive"} or callable
        As in `sample`; or ``(obs, cal) -> object with log_likelihood(theta (n, p), sigma (n,)) ->
        (n,)``, to validate one's own, which with several workers must be a function at the top
        level of a module.

    Returns
    -------
    Validation
        After Ctrl-C, with the replicates that were complete by then.

    Raises
    ------
    SamplingError
        For settings that cannot work, or processes that cannot be started.
    CatalogueError
        When the field is too narrow for the catalogue to show `min_stars`.
    CalibrationError
        When no replicate gave a result.

    Other Parameters
    ----------------
    min_stars : int
        Least stars in each frame; 10 by default.
    sigma_px : float
        Centroid noise per axis, px; 0.05 by default.
    max_mag : float
        Limiting magnitude; 6.0 by default.
    workers : int, optional
        Processes; as many as there are processors by default. With 0, everything happens in this
        process, where a BLAS with several threads can change the last digits.
    progress : callable, optional
        Called as ``progress(done, total)``.
    keep : path, optional
        Folder in which replicates are kept as they are made; a later call resumes from them, with
        more replicates as well. Not for a likelihood of one's own.
    """
    seed = seed_of(seed)
    from starcal_uq.sky.catalogue import load_catalogue

    campaign, run = campaign_of(n_frames, **options)
    nominal = camera.data_sheet()
    if priors is None:
        narrow = truth == "prior"
        priors = narrow_priors(camera, campaign.sigma_px) if narrow else Priors.default(nominal)
    study = Replication(
        camera, nominal, priors, truth, campaign, seed, assumed_sigma_px, likelihood
    )
    _check(study)
    settings: AnyDict = {
        "truth": truth,
        **campaign.settings(stars),
        "assumed_sigma_px": assumed_sigma_px,
        "likelihood": likelihood
        if isinstance(likelihood, str)
        else getattr(likelihood, "__name__", repr(likelihood)),
    }
    if run.get("keep") is not None and not isinstance(likelihood, str):
        raise SamplingError(
            "replicates of a likelihood of your own cannot be kept: leave out `keep`."
        )
    sky = load_catalogue(max_mag=campaign.max_mag) if stars is None else stars
    return validate_study(study, sky, n_replicates, settings=settings, **run)


def validate_study(
    study: Replication,
    stars: StarCatalogue,
    n_replicates: int,
    *,
    settings: AnyDict | None = None,
    **run: Unpack[TrialOptions],
) -> Validation:
    """Run the replicates of a study, whose settings may be any, and collect them."""
    trial = partial(run_replicate, study, stars)
    outcomes = Trials(trial, "validate", _CHUNK, (TrialOutcome,)).run(
        n_replicates, study.seed, **run
    )
    good = outcomes.good
    sampling = {name: getattr(study, name) for name in ("n_walkers", "n_steps", "n_burn", "thin")}
    return Validation(
        quantities=study.quantities,
        units=study.units,
        camera=study.camera,
        nominal=study.nominal,
        priors=study.priors,
        n_ranked=study.n_ranked,
        **{name: np.array([getattr(o, name) for o in good]) for name in TrialOutcome._fields},
        failures=outcomes.failures,
        n_requested=n_replicates,
        interrupted=outcomes.interrupted,
        provenance=provenance(
            study.seed, {**(settings or {}), "n_replicates": n_replicates, **sampling}, None
        ),
    )


def narrow_priors(camera: Camera, sigma_px: float) -> Priors:
    """Priors around a camera from which truths can be drawn.

    Principal point within 5 px, focal length within 0.1 %, noise within 20 %, and each distortion
    term within what the camera's largest one displaces at the corner, at least 1 px, around zero
    (one standard deviation each).
    """
    from starcal_uq.camera.distortion import get_model

    radius = camera.corner_radius_px
    terms = zip(camera.coefficients, get_model(camera.distortion).lens, strict=False)
    displacements = [abs(value) * radius**term.order for value, term in terms]
    return Priors.default(camera).replace(
        principal_point_px=_PRIOR_POINT_PX,
        principal_point_centre_px=(camera.x0_px, camera.y0_px),
        focal_fraction=_PRIOR_FOCAL,
        distortion_corner_px=max([_PRIOR_CORNER_PX, *displacements]),
        sigma_median=sigma_px,
        sigma_log_sd=_PRIOR_LOG_SIGMA,
    )


def _check(study: Replication) -> None:
    assumed = study.assumed_sigma_px
    check_known("truth", study.truth, TRUTHS, SamplingError)
    if assumed is not None and not 0.0 < assumed < np.inf:
        raise SamplingError(f"assumed_sigma_px is {assumed}: give a noise above zero.")
    study.campaign.check(SamplingError)
    if isinstance(study.likelihood, str) and study.likelihood not in LIKELIHOODS:
        raise SamplingError(
            f"the likelihood {study.likelihood!r} cannot be validated: use one of "
            f"{', '.join(LIKELIHOODS)}, or give a "
            "function that makes one."
        )
    if study.priors.names != (*study.camera.parameter_names, "sigma"):
        raise PriorError(
            f"the priors are on {', '.join(study.priors.names)}, but the camera has "
            f"{', '.join(study.camera.parameter_names)} and sigma: make them with Priors.default "
            "of this camera."
        )
