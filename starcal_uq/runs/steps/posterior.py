"""The posterior of a run, and its couplings."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from inspect import signature
from typing import TYPE_CHECKING, Any

from starcal_uq.core.files import write_csv
from starcal_uq.core.types import AnyMapping, Progress
from starcal_uq.runs.folder import CHECKPOINT, remove_checkpoints
from starcal_uq.runs.stored import StoredRun, save_results, writing

if TYPE_CHECKING:
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.propagation.coupling import Coupling


def sampling_of(run: StoredRun, **options: Any) -> Callable[..., Posterior]:
    """The call that samples a run, which another process may make as well."""
    from starcal_uq.inference.sample import sample

    obs = run.observations if run._keeps_observations else None
    if options.get("likelihood") is None:
        # A calibration knows which likelihood its estimate maximises.
        options["likelihood"] = run.calibration.sampled_likelihood
    checkpoint = run.folder.path / CHECKPOINT
    return partial(sample, obs, run.calibration, checkpoint=checkpoint, **options)


def is_quick(run: StoredRun, options: AnyMapping) -> bool:
    """Whether sampling a run takes a second: as many draws as by default, of a likelihood that has
    a compressed form. Of any other a user wants to see the progress.
    """
    from starcal_uq.inference.sample import sample

    by_default = signature(sample).parameters
    usual = all(value in (None, by_default[name].default) for name, value in options.items())
    return usual and run.calibration.sampled_likelihood == "marginal"


@writing
def sample(
    run: StoredRun,
    /,
    *,
    force: bool = False,
    progress: Progress | None = None,
    apart: Callable[[], Posterior | None] | None = None,
    **options: Any,
) -> Posterior:
    """Sample the posterior and write it; an interrupted call continues from its checkpoint.

    Parameters
    ----------
    force : bool
        Whether to replace the earlier posterior.
    progress, **options
        As for `starcal_uq.sample`.
    apart : callable, optional
        What waits for the draws of another process, None where it has failed.
    """
    run._keep("posterior", force)
    posterior = None if apart is None else apart()
    if posterior is None:
        posterior = sampling_of(run, **options)(progress=progress)
    made = posterior.provenance
    with run._step("sample", made.seed, made.settings) as files:
        save_results(files, posterior=posterior, calibrated=posterior.calibrated_camera)
    remove_checkpoints(run.folder.path)
    run._forget("coupling", "attitude", "field_map", "spectrum")
    run.posterior = posterior
    return posterior


def couple(run: StoredRun, /, *, force: bool = False) -> Coupling:
    """Write the table of the couplings, which follow from the rest of the run: one that is
    there is left as it is.

    Parameters
    ----------
    force : bool
        Whether to write it again.
    """
    if force or not run.has("coupling"):
        with run._step("coupling", None, {}) as files:
            write_csv(run.coupling.to_dataframe(), files.coupling)
    return run.coupling
