"""Merge run folders into a run folder, with the observations of all of them where they are
there.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.core.errors import CalibrationError, RunFolderError
from starcal_uq.core.files import check_new_folder
from starcal_uq.core.types import AnyDict, FloatArray, PathLike
from starcal_uq.estimation.duplicates import fingerprints_of
from starcal_uq.estimation.merging import (
    check_mergeable,
    merge,
    merging_noise,
    refuse_shared,
    renumbered,
)
from starcal_uq.estimation.result import Calibration
from starcal_uq.likelihood.compressed import optimum
from starcal_uq.observations.checks import repeated_rows
from starcal_uq.observations.repeats import Fingerprints, shared
from starcal_uq.observations.table import Observations, joined_columns
from starcal_uq.runs.run import Run


def merge_runs(
    paths: Sequence[PathLike],
    out: PathLike | None = None,
    *,
    noise: str = "auto",
    allow_inconsistent: bool = False,
    duplicates: str = "refuse",
    force: bool = False,
) -> Calibration:
    """Merge run folders and write the result as a run folder.

    Where every run still holds the observations it was calibrated on, they are joined
    (`join_observations`) and written too, so that exact checks and the attitude error remain
    possible. Otherwise the merged run has none: `sample` takes it with ``obs=None``, and its
    residuals and attitudes are those of the runs.

    Parameters
    ----------
    paths : sequence of path
        Run folders.
    out : path, optional
        Folder to write; nothing is written without it.
    noise, allow_inconsistent
        As in `merging.merge`.
    duplicates : {"refuse", "drop", "keep"}
        What to do with frames that hold the same measurement in two runs. ``drop`` leaves them out
        of the later run, which is calibrated again without them and must hold its observations for
        that.
    force : bool
        Replace the results in `out` if it is not empty.

    Returns
    -------
    Calibration
        See `merging.merge`.

    Raises
    ------
    RunFolderError
        If a folder lacks its calibration, or `out` is one of the runs, or not empty.
    CalibrationError
        If the runs cannot be merged.
    RepeatedFramesError
        If they hold the same measurements, and those are refused.
    """
    runs = [Run(path) for path in paths]
    target = None if out is None else Run(out)
    if target is not None:
        _check_target(target, runs, force)
    calibrations = [run.calibration for run in runs]
    names = _names(runs)
    tables = [_own_observations(run) for run in runs]
    if duplicates == "drop":
        check_mergeable(calibrations, names, noise, duplicates="keep")
        _drop_shared(calibrations, tables, names)
        duplicates = "refuse"
    check_mergeable(calibrations, names, noise, duplicates)
    present = [table for table in tables if table is not None]
    joined = None
    if len(present) == len(tables) and len(present) > 1:
        if duplicates == "refuse":
            # Said before the joined table finds stars that agree to the last bit: by frames, with
            # the way out.
            marks = [
                fingerprints_of(cal, table)
                for cal, table in zip(calibrations, present, strict=True)
            ]
            refuse_shared(calibrations, marks, names)
        noise = merging_noise(calibrations, noise)
        stated = [optimum(cal.compressed).sigma for cal in calibrations] if noise == "own" else None
        joined = join_observations(present, names, stated, keep_shared=duplicates == "keep")
    merged = merge(
        calibrations,
        joined,
        names=names,
        noise=noise,
        allow_inconsistent=allow_inconsistent,
        duplicates=duplicates,
    )
    if target is not None:
        target.write(merged, joined)
    return merged


def join_observations(
    tables: Sequence[Observations],
    names: Sequence[str],
    noise: Sequence[float] | None = None,
    *,
    keep_shared: bool = False,
) -> Observations:
    """All rows in one table, frames renumbered run by run.

    The frame numbers of the first run stay, those of each further run are shifted to follow;
    ``meta["merged"]`` holds the shifts. An optional column that only some runs have is filled where
    it may have gaps, and left out otherwise. `noise` of each run (px, or a factor on what its stars
    state) is written as their stated noise. A star of a frame that is in two runs is refused unless
    `keep_shared`; so are tables of which only some state their noise, and directions of different
    kinds.
    """
    kinds = {table.origin.directions for table in tables}
    if len(kinds) > 1:
        raise CalibrationError(
            f"the runs' directions are of different kinds ({', '.join(sorted(kinds))}), so that "
            "their focal lengths "
            "mean different things: declare them when calibrating."
        )
    _, shifts = renumbered([table.frame_ids for table in tables])
    if noise is None:
        if len({table.sigma_px is None for table in tables}) > 1:
            raise CalibrationError(
                "only some of the runs state the noise of their stars: merge with noise 'own'."
            )
        columns = joined_columns(tables)
    else:
        columns = joined_columns(tables, sigma_px=list(map(_stated, tables, noise)))
    columns["frame"] = np.concatenate(
        [table.frame + shift for table, shift in zip(tables, shifts, strict=True)]
    )
    if not keep_shared:
        _check_disjoint(columns, tables, names)
    parts = [
        {
            "name": name,
            "frame_shift": shift,
            "n_frames": table.n_frames,
            "data_sha256": table.data_hash,
        }
        for name, shift, table in zip(names, shifts, tables, strict=True)
    ]
    first = tables[0].origin
    meta: AnyDict = {
        "directions": first.directions,
        "source": f"merged from {', '.join(names)}",
    }
    if first.truth is not None and all(table.origin.truth == first.truth for table in tables):
        meta["truth"] = first.truth
    return Observations(**columns, meta={**meta, "merged": parts})


def _stated(table: Observations, factor: float) -> FloatArray:
    stated = np.ones(len(table)) if table.sigma_px is None else table.sigma_px
    return np.asarray(factor * stated)


def _check_disjoint(columns: AnyDict, tables: Sequence[Observations], names: Sequence[str]) -> None:
    """The same centroid of the same star, to the last bit, is the same measurement."""
    owner = np.repeat(np.arange(len(tables)), [len(table) for table in tables])
    twice = repeated_rows(*(columns[name] for name in ("x_px", "y_px", "ra_deg", "dec_deg")))
    several = [owner[[early, late]] for late, early in twice if owner[early] != owner[late]]
    if several:
        first, second = several[0]
        raise CalibrationError(
            f"{names[second]}: {len(several)} of its stars are measurements that another run "
            f"holds too (first {names[first]}), which would count twice: leave one of the runs "
            "out, or calibrate them apart."
        )


def _drop_shared(
    calibrations: list[Calibration], tables: list[Observations | None], names: Sequence[str]
) -> None:
    """Leave the frames that an earlier run holds out of each later run, and calibrate it again."""
    earlier: list[Fingerprints | None] = []
    for i, (name, table) in enumerate(zip(names, tables, strict=True)):
        cal = calibrations[i]
        own = fingerprints_of(cal, table)
        places = [np.empty(0, dtype=np.int64)]
        if own is not None:
            places += [shared(mark, own)[:, 1] for mark in earlier if mark is not None]
        repeating = np.unique(np.concatenate(places))
        if not len(repeating):
            earlier.append(own)
            continue
        if len(repeating) == cal.n_frames:
            raise CalibrationError(
                f"{name}: all of its frames are measurements that earlier runs hold: leave it out."
            )
        if table is None:
            raise CalibrationError(
                f"{name}: {len(repeating)} of its frames are measurements that an earlier run "
                "holds, and it has no observations to be calibrated again without them: leave "
                "one of the runs out."
            )
        rest = table.select_frames(np.delete(table.frame_ids, repeating))
        effects = "none" if cal.noise_model is None else "noise"
        model = cal.nominal.model
        again = calibrate(
            rest, cal.nominal, model=model, method=cal.method, effects=effects, duplicates="keep"
        )
        tables[i], calibrations[i] = rest, again
        earlier.append(fingerprints_of(again, rest))


def _own_observations(run: Run) -> Observations | None:
    """The observations of a run; None where they are missing, no longer those of its calibration,
    or a sample.
    """
    if run.calibration.partitions is not None:
        return None
    try:
        return run.observations
    except RunFolderError:
        return None


def _names(runs: Sequence[Run]) -> list[str]:
    short = [run.name for run in runs]
    return short if len(set(short)) == len(short) else [str(run.path) for run in runs]


def _check_target(target: Run, runs: Sequence[Run], force: bool) -> None:
    place: Path = target.path.resolve()
    if any(run.path.resolve() == place for run in runs):
        raise RunFolderError(
            f"{target.path}: is one of the runs to merge; name another folder for the result."
        )
    check_new_folder(target.path, force)
