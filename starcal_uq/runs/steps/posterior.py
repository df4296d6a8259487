"""The posterior of a run, and its couplings."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from starcal_uq.core.files import write_csv
from starcal_uq.core.types import Progress
from starcal_uq.runs.folder import CHECKPOINT, remove_checkpoints
from starcal_uq.runs.stored import StoredRun, save_results, writing

if TYPE_CHECKING:
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.propagation.coupling import Coupling


@writing
def sample(
    run: StoredRun, /, *, force: bool = False, progress: Progress | None = None, **options: Any
) -> Posterior:
    """Sample the posterior and write it; an interrupted call continues from its checkpoint.

    Parameters
    ----------
    force : bool
        Whether to replace the earlier posterior.
    progress, **options
        As for `starcal_uq.sample`.
    """
    from starcal_uq.inference.sample import sample

    run._keep("posterior", force)
    obs = run.observations if run._keeps_observations else None
    if options.get("likelihood") is None:
        # A calibration knows which likelihood its estimate maximises.
        options["likelihood"] = run.calibration.sampled_likelihood
    checkpoint = run.folder.path / CHECKPOINT
    posterior = sample(obs, run.calibration, progress=progress, checkpoint=checkpoint, **options)
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
