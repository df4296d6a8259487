"""What the posterior of a run does to attitudes and directions, on the frames of a mission."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from starcal_uq.camera.distortion import sigma_parameter
from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.remedy import Remedy
from starcal_uq.core.settings import Seed, bounded, seed_of
from starcal_uq.core.types import PathLike
from starcal_uq.observations.table import Observations, load_observations
from starcal_uq.runs.steps.misfit import with_misfit
from starcal_uq.runs.stored import StoredRun, save_results, writing

if TYPE_CHECKING:
    from starcal_uq.core.settings import OnboardModel, Scalar, Sense
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.propagation.attitude_error import AttitudeError
    from starcal_uq.propagation.field import FieldMap
    from starcal_uq.propagation.spectrum import ErrorSpectrum
    from starcal_uq.propagation.thermal import TemperatureProfile


@dataclass(frozen=True)
class MissionSky:
    """Frames that a mission will see, in place of the observed ones.

    Attributes
    ----------
    profile : Path or None
        Attitudes over time; random ones where it is None.
    max_mag : float
        Magnitude limit of the sensor in flight, Gaia G.
    epoch : float
        Julian year of the star positions.
    n_frames : int
        Number of random attitudes.
    min_stars : int or None
        Least stars of a frame that gives an attitude; 5 at random attitudes and 3 along a profile
        by default.
    max_stars : int or None
        Stars that the tracker uses of a frame, the brightest ones; all where it is None.
    rate_hz : float or None
        Frames per second along the profile; its own instants where it is None.
    scalar, sense
        Conventions of the profile's quaternions, as for
        `starcal_uq.attitude.load_attitude_profile`.
    """

    profile: Path | None = None
    max_mag: float = 6.0
    epoch: float = 2026.9
    n_frames: int = 1000
    min_stars: int | None = None
    max_stars: int | None = None
    rate_hz: float | None = None
    scalar: Scalar | None = None
    sense: Sense = "icrs_to_camera"

    @bounded
    def frames(self, posterior: Posterior, obs: Observations, seed: Seed) -> Observations:
        """Noise-free frames, with the noise of the observed ones by magnitude where it is
        stated.
        """
        from starcal_uq.attitude.profile import load_attitude_profile
        from starcal_uq.simulation.mission import mission_frames, profile_frames
        from starcal_uq.sky.catalogue import load_catalogue

        stars = load_catalogue(max_mag=self.max_mag, epoch=self.epoch)
        camera = posterior.calibrated_camera
        like = obs if posterior.sigma_name == sigma_parameter(True).name else None
        if self.profile is None:
            return mission_frames(
                stars,
                camera,
                n_frames=self.n_frames,
                min_stars=self.min_stars or 5,
                max_stars=self.max_stars,
                seed=seed,
                noise_like=like,
            )
        profile = load_attitude_profile(self.profile, scalar=self.scalar, sense=self.sense)
        frames = profile_frames(
            *(stars, camera, profile, self.rate_hz),
            min_stars=self.min_stars or 3,
            max_stars=self.max_stars,
            noise_like=like,
        )
        return frames.with_origin(messages=[*profile.messages])


@bounded
@writing
def propagate(
    run: StoredRun,
    /,
    *,
    n_draws: int = 300,
    seed: Seed = 0,
    sky: MissionSky | None = None,
    alignment: str | PathLike = "random",
    alignment_frames: int | None = None,
    onboard: OnboardModel = "model",
    temperature_profile: TemperatureProfile | PathLike | None = None,
    force: bool = False,
) -> tuple[AttitudeError, FieldMap, ErrorSpectrum | None]:
    """Carry the posterior through QUEST on the observed frames or a mission's, and over the
    field; write all of it.

    Along an attitude profile the spectrum of the frame-dependent part is written as well.

    Parameters
    ----------
    n_draws, seed
        As for `starcal_uq.propagate`.
    sky : MissionSky, optional
        Frames in place of the observed ones.
    alignment : str or path
        Frames on which alignment is calibrated: ``random`` sky, those ``observed`` for this
        run, or a table.
    alignment_frames : int, optional
        Number of frames of the random sky; 100 by default.
    onboard : {"model", "effects"}
        What the mission's software uses: parameters of the camera alone, or effects as well.
    temperature_profile : TemperatureProfile or path, optional
        Temperatures of the optics over an orbit; the error over it is written as well.
    force : bool
        Whether to replace the earlier attitude error.
    """
    seed = seed_of(seed)
    run._keep("attitude", force)
    posterior = run.posterior
    if not run._keeps_observations and not run.has("observations"):
        raise RunFolderError(
            f"{run.path}: holds no observations, so that there are no frames to propagate "
            f"to: calibrate a table that fits into memory with `{Remedy('calibrate').words}`."
        )
    from starcal_uq.propagation import attitude_error
    from starcal_uq.propagation.alignment import OBSERVED, RANDOM
    from starcal_uq.propagation.field import field_map
    from starcal_uq.propagation.propagate import propagate

    frames = run.observations if sky is None else sky.frames(posterior, run.observations, seed)
    aligning: Observations | str = str(alignment)
    if aligning == OBSERVED:
        aligning = run.observations.with_origin(frames=attitude_error.OBSERVED)
    elif aligning != RANDOM:
        aligning = load_observations(alignment).with_origin(frames=str(alignment))
    error = propagate(
        posterior,
        frames,
        n_draws=n_draws,
        seed=seed,
        alignment=aligning,
        alignment_frames=alignment_frames,
        onboard=onboard,
        calibrated=run.observations,
        temperature_profile=temperature_profile,
    )
    fields = field_map(posterior, run.observations)
    spectrum = None
    told = [str(message) for message in frames.origin.messages or ()]
    if sky is not None and sky.profile is not None:
        from starcal_uq.propagation.spectrum import MIN_SPECTRUM_FRAMES, error_spectrum

        if frames.n_frames >= MIN_SPECTRUM_FRAMES:
            spectrum = error_spectrum(posterior, frames, n_draws=min(n_draws, 100), seed=seed)
        else:
            told.append(
                f"the profile has {frames.n_frames} frames, too few for a spectrum "
                f"({MIN_SPECTRUM_FRAMES})."
            )
    error = with_misfit(run, error)
    settings = {
        "n_draws": n_draws,
        "sky": sky,
        "alignment": alignment,
        "alignment_frames": alignment_frames,
        "onboard": onboard,
    }
    if error.thermal is not None:
        settings["temperature_profile"] = error.thermal.profile.name
    with run._step("propagate", seed, settings) as files:
        save_results(
            files,
            # A diagnosis of later is carried to the same frames.
            mission=None if sky is None else frames,
            alignment=error.aligned,
            attitude=error,
            field_map=fields,
            spectrum=spectrum,
            thermal=error.thermal,
        )
    # The file of the attitude error holds less than the result, and a report shows what is in
    # the file.
    run._forget("attitude", "spectrum")
    run.field_map = fields
    for message in told:
        run._tell(message)
    return error, fields, spectrum
