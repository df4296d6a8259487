"""One cell of a study by simulation: frames drawn, calibrated and sampled, beside what their
information foretold.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.camera.camera import Camera
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.records import hash_of
from starcal_uq.core.texts import Texts
from starcal_uq.core.types import AnyMapping, FloatArray
from starcal_uq.inference.ensemble import PROPOSAL_DF, EnsembleSettings, ensemble_draws
from starcal_uq.inference.named import quick_target
from starcal_uq.inference.priors import GaussianPriors, Priors
from starcal_uq.inference.surrogate import fit_polynomial
from starcal_uq.inference.target import importance_draws
from starcal_uq.maths.intervals import student_quantile
from starcal_uq.maths.linear import correlation_of, scaled_inverse
from starcal_uq.observations.origin import SIMULATED, Origin
from starcal_uq.observations.table import Observations
from starcal_uq.sky.positions import ra_dec_deg
from starcal_uq.studies.cells import (
    Cells,
    Numbers,
    campaign_numbers,
    covariance_numbers,
    prior_precision,
)
from starcal_uq.studies.definition import Cell
from starcal_uq.studies.geometry import (
    Geometry,
    GeometryKey,
    Statements,
    geometry_key,
    mission_key,
    noise_shape,
    offset_of,
    star_noise,
    statements,
    take_frames,
)
from starcal_uq.studies.result import VARIABLES

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration

# What is decided after the frames were taken: cells that differ in nothing else share their data.
_AFTERWARDS = ("method", "likelihood", "prior")
_WALKERS, _BURN = 64, 20
_PROBABILITY = 0.95
_CUBIC = 3


class SimulatedCells(Cells):
    """Cells by simulation."""

    def _numbers(self, cell: Cell, camera: Camera) -> Numbers:
        definition, settings = self.definition, cell.settings
        key = geometry_key(camera, settings, definition.seed, cell.seed_index, True)
        geometry = take_frames(key, self.heaven, definition.geometries).brightest(
            settings.get("stars")
        )
        shape, scale = noise_shape(settings, camera.focal_px)
        noise = scale * star_noise(geometry.mag, shape)
        random, sampling = np.random.SeedSequence(self._seed(cell)).spawn(2)
        rng = np.random.default_rng(random)
        obs = observe(geometry, noise, settings, rng)
        likelihood = settings["likelihood"]
        tails = ["tails"] if likelihood == "student_t" else []
        stars = ["star"] if settings["direction_mas"] > 0.0 else []
        cal = calibrate(
            obs,
            camera.data_sheet(),
            model=camera.model,
            method=settings["method"],
            effects=[*tails, *stars],
        )
        stated, found = self._foretold(key, geometry, noise, cell, camera)
        prior = self._prior(cell, camera, cal, obs.sigma_px is not None, rng)
        own = estimated(cal, camera, stated, prior)
        if definition.posterior != "none":
            own |= self._sampled(obs, cal, camera, prior.full, likelihood, sampling)
        found |= {
            name: embedded(name, value, cal.parameter_names, camera.parameter_names)
            for name, value in own.items()
        }
        return found | {"noise_estimate": cal.sigma}

    def _seed(self, cell: Cell) -> int:
        """Seed of the noise: another one for all other settings, so that cells are independent of
        each other.
        """
        settings = {k: v for k, v in cell.settings.items() if k not in _AFTERWARDS}
        content = [
            settings,
            self.definition.camera.to_dict(),
            self.definition.seed,
            cell.seed_index,
        ]
        return int(hash_of(content)[:32], 16)

    def _foretold(
        self, key: GeometryKey, geometry: Geometry, noise: FloatArray, cell: Cell, camera: Camera
    ) -> tuple[Statements, Numbers]:
        """What the same frames say by their information."""
        settings = cell.settings
        offset = offset_of(camera, settings)
        stated = statements(geometry, noise, offset)
        if key.pointing != "random":
            mission = take_frames(mission_key(key), self.heaven, self.definition.geometries)
            mission = mission.brightest(settings.get("stars"))
            shape, scale = noise_shape(settings, camera.focal_px)
            stated = stated.for_mission(
                statements(mission, scale * star_noise(mission.mag, shape), offset)
            )
        prior = prior_precision(self.definition.priors.get(settings["prior"]), camera)
        found = campaign_numbers(stated, np.ones(len(stated.information)), prior, geometry.n_frames)
        return stated, found | {"sigma_predicted": found["sigma"]}

    def _prior(
        self, cell: Cell, camera: Camera, cal: Calibration, per_star: bool, rng: np.random.Generator
    ) -> GroundPrior:
        """Prior of the parameters that were estimated.

        A prior set is a measurement from the ground: its centre is off by as much as it says, drawn
        at random. Around the truth itself it would make every estimate better than its sigma.
        """
        table = self.definition.priors.get(cell.settings["prior"])
        known = [camera.parameter_names.index(name) for name in cal.parameter_names]
        stated = prior_precision(table, camera)
        precision = np.zeros(len(known)) if stated is None else stated[known]
        # Drawn in any case, so that cells with and without a prior have the same data.
        shift = rng.standard_normal(len(camera.theta))[known]
        wide = Priors.default(cal.nominal.replace(distortion=cal.camera.distortion), per_star)
        mean, covariance = wide.theta_moments()
        given = precision > 0.0
        sd = np.sqrt(np.where(given, 1.0 / np.where(given, precision, 1.0), np.diag(covariance)))
        centre = np.where(given, camera.theta[known] + sd * shift, mean)
        full = GaussianPriors(
            centre,
            np.diag(sd**2),
            wide.sigma_median,
            wide.sigma_log_sd,
            cal.camera.distortion,
            per_star,
        )
        return GroundPrior(precision, centre, full)

    def _sampled(
        self,
        obs: Observations,
        cal: Calibration,
        camera: Camera,
        priors: GaussianPriors,
        likelihood: str,
        seed: np.random.SeedSequence,
    ) -> Numbers:
        """Moments of the posterior, and whether its intervals hold the truth."""
        target, fast = quick_target(likelihood, obs, cal, priors)
        design, draws = seed.spawn(2)
        if not fast:
            polynomial = fit_polynomial(target, _CUBIC, np.random.default_rng(design))
            target = (
                target
                if polynomial is None
                else replace(target, log_likelihood=polynomial.log_likelihood)
            )
        if self.definition.posterior == "ensemble":
            steps = max(20, -(-self.definition.draws // _WALKERS))
            natural = ensemble_draws(
                target, draws, EnsembleSettings(_WALKERS, steps, _BURN, "mixture")
            )
            weights, khat = np.full(len(natural), 1.0 / len(natural)), np.nan
        else:
            natural, weights, khat = importance_draws(
                target, self.definition.draws, PROPOSAL_DF, np.random.default_rng(draws)
            )
        truth = truth_of(camera, cal)
        shift = natural[:, : len(truth)] - truth
        mean = weights @ shift
        covariance = (shift - mean).T @ ((shift - mean) * weights[:, None])
        correlation, sigma = correlation_of(covariance)
        below = np.sum(weights[:, None] * (shift < 0.0), axis=0)
        tail = 0.5 * (1.0 - _PROBABILITY)
        return {
            "posterior_sigma": sigma,
            "posterior_correlation": correlation,
            "covered_95": ((below >= tail) & (below <= 1.0 - tail)).astype(np.float64),
            "khat": khat,
        }


@dataclass(frozen=True, eq=False)
class GroundPrior:
    """A prior: `precision` (p,) of what the prior set states, 0 elsewhere, and means (p,), px
    units.

    `full` has wide priors elsewhere, to sample with.
    """

    precision: FloatArray
    centre: FloatArray
    full: GaussianPriors


def observe(
    geometry: Geometry, noise: FloatArray, settings: AnyMapping, rng: np.random.Generator
) -> Observations:
    """A table of the frames with noise; stars whose catalogue errs have other directions in it than
    in the sky.
    """
    stars = geometry.depth.stars
    frame = np.repeat(np.arange(geometry.n_frames), np.diff(geometry.starts))
    xy = geometry.pixel + noise[:, None] * rng.standard_normal(geometry.pixel.shape)
    ra, dec = stars.ra_deg[geometry.star], stars.dec_deg[geometry.star]
    error = settings["direction_mas"]
    if error > 0.0:
        which, image = np.unique(geometry.star, return_inverse=True)
        offset = error / 1000.0 / ARCSEC * rng.standard_normal((len(which), 3))
        r = geometry.depth.directions[which]
        # What is along the direction itself does not turn it.
        turned = r + offset - np.sum(offset * r, axis=1, keepdims=True) * r
        ra, dec = (
            column[image]
            for column in ra_dec_deg(turned / np.linalg.norm(turned, axis=1, keepdims=True))
        )
    uneven = (
        "sensor" in settings or settings["noise_per_mag"] > 0.0 or settings["noise_floor_px"] > 0.0
    )
    return Observations(
        frame=frame,
        x_px=xy[:, 0],
        y_px=xy[:, 1],
        ra_deg=ra,
        dec_deg=dec,
        sigma_px=noise if uneven else None,
        star_id=Texts.placed(geometry.star, stars.star_id),
        mag=geometry.mag,
        direction_mas=np.full(len(xy), error) if error > 0.0 else None,
        meta=Origin(SIMULATED, "apparent").plain(),
    )


def truth_of(camera: Camera, cal: Calibration) -> FloatArray:
    """True values of the parameters that were estimated."""
    return camera.theta[[camera.parameter_names.index(name) for name in cal.parameter_names]]


def estimated(cal: Calibration, camera: Camera, stated: Statements, prior: GroundPrior) -> Numbers:
    """Estimate, covariance and what follows, of the parameters that were estimated; a prior set is
    combined with it.
    """
    truth = truth_of(camera, cal)
    kept = [camera.parameter_names.index(name) for name in cal.parameter_names]
    covariance, theta = cal.covariance, cal.theta
    if prior.precision.any():
        information = scaled_inverse(covariance)
        covariance = scaled_inverse(information + np.diag(prior.precision))
        theta = theta + covariance @ (prior.precision * (prior.centre - theta))
    forms = stated.rest_forms[:, kept][:, :, kept]
    found = covariance_numbers(covariance, cal.camera.distortion, stated.common[:, kept], forms)
    z = (theta - truth) / found["sigma"]
    return found | {
        "sigma_data": cal.sigmas,
        "estimate": theta,
        "z": z,
        "covered_95": (np.abs(z) <= student_quantile(_PROBABILITY, cal.dof)).astype(np.float64),
    }


def embedded(name: str, value: Any, own: tuple[str, ...], names: tuple[str, ...]) -> Any:
    """A variable over parameters `own` as one over all `names`, NaN where a method did not estimate
    one.
    """
    dims = VARIABLES[name][0] if name in VARIABLES else ()
    if own == names or not dims or not dims[0].startswith("parameter"):
        return value
    place = [names.index(parameter) for parameter in own]
    square = len(dims) == 2 and dims[1].startswith("parameter")
    wide = np.full((len(names), *((len(names),) if square else value.shape[1:])), np.nan)
    wide[np.ix_(place, place) if square else place] = value
    return wide
