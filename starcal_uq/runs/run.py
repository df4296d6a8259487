"""A run: the results in a folder, and the steps that add to them."""

from __future__ import annotations

from starcal_uq.runs.steps import budgeting, estimate, images, misfit, mission, pages, posterior
from starcal_uq.runs.stored import StoredRun


class Run(StoredRun):
    """A run folder with what it holds; a result is loaded when it is first asked for.

    A step takes results and gives one, and writes it; `RunFolder` has the rule by which it replaces
    what was there. A result that is not there raises `RunFolderError`, whose message names the
    command that makes it.

    Parameters
    ----------
    path : path
        The folder, which need not exist before the first step.
    truth : Camera, optional
        The camera of a simulation, shown beside the estimate; that of the observations by default.
    tell : callable, optional
        Function that gets what a user should know, one sentence each, such as which results go.

    Attributes
    ----------
    path : Path
        The folder.
    folder : RunFolder
        The folder and the paths of its files; a hidden one inside, while a command makes a run to
        replace this one.
    screening : Screening or None
        What the last `calibrate` of this object left out, if it screened.
    camera : Camera
        The nominal camera, as it was given.
    posterior : Posterior
        The draws.
    attitude : AttitudeError
        The attitude error, without its single draws.
    field_map : FieldMap
        The direction uncertainty over the field.
    spectrum : ErrorSpectrum
        The spectrum of the frame-dependent error along an attitude profile.
    error_budget : Budget
        The attitude error budget.
    """

    calibrate, write = estimate.calibrate, estimate.write
    keep_images, keep_frames = images.keep_images, images.keep_frames
    inspect = images.inspect
    sample, couple = posterior.sample, posterior.couple
    propagate = mission.propagate
    diagnose = misfit.diagnose
    budget = budgeting.budget
    report, pdf, notebook = pages.report, pages.pdf, pages.notebook
