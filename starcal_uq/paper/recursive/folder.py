"""A recursive calibration of a table of any size, from file to run folder; an interrupted one goes
on.

While the filter runs, its state is kept in the folder; at the end the state gives way to the
calibration and to the estimates after every frame.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from starcal_uq.calibration.plausibility import explanation
from starcal_uq.camera.distortion import parameters
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.files import atomic_write_text, check_new_folder
from starcal_uq.core.records import to_plain
from starcal_uq.core.tasks import interrupt_between_steps
from starcal_uq.core.types import AnyDict
from starcal_uq.paper.recursive.frames import FrameStream, stream_frames
from starcal_uq.paper.recursive.start import RecursionOptions
from starcal_uq.paper.recursive.stream import RecursiveCalibration
from starcal_uq.runs.folder import RunFolder
from starcal_uq.runs.run import Run

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.camera.camera import Camera
    from starcal_uq.estimation.result import Calibration

STATE, SOURCE = "recursion.npz", "recursion.json"
# Frames between two looks at Ctrl-C, and between two savings of the state.
_CHUNK, _SAVE_EVERY = 64, 4096


def filter_run(
    path: str | Path,
    camera: Camera,
    out: str | Path,
    *,
    method: str = "griffith",
    options: RecursionOptions | None = None,
    columns: Mapping[str, str] | None = None,
    force: bool = False,
) -> Calibration:
    """Calibrate recursively from a file that need not fit into memory, into a run folder without
    observations.

    `path` and `columns` are what `stream_frames` takes, `method` and `options` those of
    `RecursiveCalibration`. After Ctrl-C the state is kept, and the same call resumes from it. A
    folder that holds results is refused unless `force`.
    """
    with RunFolder(out).writing(make=True):
        return _filter_run(
            Run(out), stream_frames(path, camera, columns), camera, method, options, columns, force
        )


def _filter_run(
    run: Run,
    stream: FrameStream,
    camera: Camera,
    method: str,
    options: RecursionOptions | None,
    columns: Mapping[str, str] | None,
    force: bool,
) -> Calibration:
    options = options or RecursionOptions()
    filtering = RecursiveCalibration(camera, method, options)
    identity: AnyDict = {
        "files": [
            [str(file.resolve()), file.stat().st_size, file.stat().st_mtime_ns]
            for file in stream.paths
        ],
        "columns": dict(columns or {}),
        "camera": camera.to_dict(),
        "method": method,
        "options": to_plain(options),
    }
    state = run.path / STATE
    if run.has("calibration"):
        check_new_folder(run.path, force)
    if state.exists() and _same(run.path / SOURCE, identity):
        filtering = RecursiveCalibration.load(state)
    elif not state.exists():
        check_new_folder(run.path, force)
    # Gone before the source of the next is written, so that the two never mix.
    else:
        state.unlink()

    def keep() -> None:
        run.folder.create()
        atomic_write_text(run.path / SOURCE, json.dumps(identity) + "\n")
        filtering.save(state)

    _feed(filtering, stream, keep)
    try:
        calibration = filtering.result()
    except CalibrationError as error:
        found = explanation(error, stream, camera)
        if found is None:
            raise
        raise found from error
    run.write(calibration, None, history=history(calibration))
    for name in (STATE, SOURCE):
        (run.path / name).unlink(missing_ok=True)
    return calibration


def _feed(filtering: RecursiveCalibration, stream: FrameStream, keep: Callable[[], None]) -> None:
    """Give the filter the frames that it has not seen; `keep` saves its state."""
    frames = iter(stream)
    next(islice(frames, filtering.n_frames, filtering.n_frames), None)
    saved = filtering.n_frames
    with interrupt_between_steps() as check:
        try:
            for index, frame in enumerate(frames):
                filtering.update(frame)
                if index % _CHUNK == 0:
                    check()
                if filtering.n_frames - saved >= _SAVE_EVERY:
                    keep()
                    saved = filtering.n_frames
        except KeyboardInterrupt:
            keep()
            raise


def _same(path: Path, identity: AnyDict) -> bool:
    """Whether what was begun is of these data and settings; anything else starts again."""
    try:
        return bool(
            json.loads(path.read_text(encoding="utf-8")) == json.loads(json.dumps(identity))
        )
    except (OSError, ValueError):
        return False


def history(calibration: Calibration) -> pd.DataFrame:
    """Estimates and the filter's own sigmas after every frame (every second, fourth ... of very
    many).

    Columns are ``row`` (0 is the start), the parameters in px units, and ``sigma_`` with each
    parameter's name.
    """
    import pandas as pd

    stage = next(stage for stage in calibration.stages if stage.name == "filter")
    table: AnyDict = {"row": range(len(stage.trajectory))}
    for index, parameter in enumerate(
        parameters(calibration.camera.distortion)[: stage.trajectory.shape[1]]
    ):
        table[parameter.name] = stage.trajectory[:, index]
        if stage.sigmas is not None and index < stage.sigmas.shape[1]:
            table[f"sigma_{parameter.name}"] = stage.sigmas[:, index]
    return pd.DataFrame(table)
