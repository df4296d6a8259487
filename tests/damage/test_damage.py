"""Whatever a file holds, its loader lets out a result or the package's own error of one
sentence.
"""

from __future__ import annotations

import gzip
import inspect
import io
import random
import re
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import starcal_uq as sc
from starcal_uq.core import files
from starcal_uq.core.errors import StarcalError
from tests.damage.judging import Bench, judge
from tests.damage.samples import SAMPLES, Sample

BY_FILE = {sample.file: sample for sample in SAMPLES}
# What reads files and is tested elsewhere: folders of runs, and what reads images by `read_image`.
ELSEWHERE = {
    *(
        "studies.StudyDefinition.from_dict",
        "images.extract_centroids",
        "simulation.read_truth",
        "report",
        "runs.compare_runs",
    ),
    *("runs.merge_runs", "runs.prior_from_run", "runs.compare_split", "Run", "runs.RunFolder"),
}


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return Bench(tmp_path_factory.mktemp("mutants"))


# Readable in part: rows that are missing at the end, and a budget file without a row.
IN_PART = {"budget.toml", "kernel.ti", "profile.csv", "orbit.csv", "hip_main.dat"}


@pytest.mark.parametrize("name", BY_FILE)
def test_a_file_that_is_empty_cut_not_there_or_a_folder_is_refused_in_one_sentence(
    bench: Bench, name: str
) -> None:
    sample = BY_FILE[name]
    data, valid, path = bench.valid(sample)
    found = [bench.judged(sample, made, valid, path) for made in (b"", data[: len(data) // 2])]
    whole = [outcome for outcome in found if outcome.kind != "refused"]
    assert len(whole) == (name in IN_PART), found
    path.unlink()
    # Where there is no record of a run, there is no run yet.
    assert judge(sample, path).kind == ("other" if name == "run.json" else "refused")
    path.mkdir()
    folder = judge(sample, path)
    # Permissions are the reason that the system would give on some machines.
    assert folder.kind == "refused" and "check its permissions" not in folder.detail, folder
    path.rmdir()


@pytest.mark.slow
@pytest.mark.parametrize("name", BY_FILE)
def test_no_damage_escapes_a_loader(bench: Bench, name: str) -> None:
    sample = BY_FILE[name]

    @given(st.randoms(use_true_random=False))
    @settings(max_examples=12, suppress_health_check=list(HealthCheck))
    def check(rng: random.Random) -> None:
        made, outcome = bench.damaged(sample, rng)
        assert outcome.kind in ("same", "other", "refused"), (outcome.detail, made[:200])

    check()


def readers() -> Iterator[str]:
    """Public functions and class methods of all typed stubs that are named as readers, or take a
    path.
    """
    wings = {"": sc} | {
        name: getattr(sc, name) for name in sc.__all__ if inspect.ismodule(getattr(sc, name))
    }
    for wing, module in wings.items():
        for name in getattr(module, "__all__", ()):
            value = getattr(module, name)
            prefix = f"{wing}." if wing else ""
            if inspect.isclass(value):
                for own, method in vars(value).items():
                    if isinstance(method, classmethod | staticmethod) and _reads(
                        own, method.__func__
                    ):
                        yield f"{prefix}{name}.{own}"
            elif inspect.isfunction(value) and _reads(name, value):
                yield f"{prefix}{name}"


def _reads(name: str, function: Callable[..., Any]) -> bool:
    if not name.startswith(("load", "read", "open", "from_", "stream")):
        return False
    return any(
        "path" in str(p.annotation).lower() or "pathlike" in str(p.annotation).lower()
        for p in inspect.signature(function).parameters.values()
    )


def test_every_public_reader_is_in_the_table() -> None:
    known = {name for sample in SAMPLES for name in sample.reads} | ELSEWHERE
    found = set(readers())
    assert found - known == set()
    assert len(found) > 20 and "Posterior.load" in found


def _members(data: bytes, **changed: bytes | None) -> bytes:
    """An archive with other members; those that are None are left out."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        content = {info.filename: archive.read(info) for info in archive.infolist()}
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, member in (
            content | {f"{name}.npy": member for name, member in changed.items()}
        ).items():
            if member is not None:
                archive.writestr(name, member)
    return stream.getvalue()


def _document(data: bytes, old: str, new: str) -> bytes:
    text = str(np.load(io.BytesIO(data))["document"])
    assert old in text
    return _members(data, document=_npy(np.array(text.replace(old, new))))


def _npy(array: Any) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()


def _declared(shape: tuple[int, ...]) -> bytes:
    """The header of an array, without its content."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {"descr": "<f8", "fortran_order": False, "shape": shape}
    )
    return stream.getvalue()


def _flipped(data: bytes) -> bytes:
    return data[:2000] + bytes([data[2000] ^ 4]) + data[2001:]


def _parquet(change: Callable[[Any], Any]) -> Callable[[bytes], bytes]:
    def made(data: bytes) -> bytes:
        from pyarrow import parquet

        stream = io.BytesIO()
        parquet.write_table(change(parquet.read_table(io.BytesIO(data))), stream)
        return stream.getvalue()

    return made


def _null(table: Any) -> Any:
    import pyarrow as pa

    frames = table.column("frame").to_pylist()
    return table.set_column(0, "frame", pa.array([None, *frames[1:]], pa.int64()))


def _meta(key: bytes, text: bytes | None) -> Callable[[bytes], bytes]:
    return _parquet(
        lambda table: table.replace_schema_metadata({} if text is None else {key: text})
    )


def _hdf5(change: Callable[[Any], None]) -> Callable[[bytes], bytes]:
    def made(data: bytes) -> bytes:
        import h5py

        stream = io.BytesIO(data.rpartition(b"\nsha256 ")[0])
        with h5py.File(stream, "r+") as file:
            change(file)
        return files.sealed(stream.getvalue())

    return made


def _nan_draw(file: Any) -> None:
    draws = file["draws"][()]
    draws[5, 2] = np.nan
    file["draws"][...] = draws


def _other_names(file: Any) -> None:
    file.attrs["record"] = file.attrs["record"].replace(
        '"parameter_names": ["x0"', '"parameter_names": ["text"'
    )


def _huge_draws(file: Any) -> None:
    del file["draws"]
    file.create_dataset("draws", shape=(10**12,), dtype="f8", chunks=(1000,))


def _one_for_another(file: Any) -> None:
    del file["n_frames"]
    file.move("sigma", "n_frames")


def _header_only(data: bytes) -> bytes:
    lines = data.decode().splitlines(keepends=True)
    first = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    return "".join(lines[: first + 1]).encode()


def _many_names(data: bytes) -> bytes:
    """Nine lines of YAML that name each other: a billion entries."""
    lines = ["# - {a0: &a0 [x, x, x, x, x, x, x, x, x, x]}"]
    for i in range(8):
        lines.append(f"# - {{a{i + 1}: &a{i + 1} [{', '.join([f'*a{i}'] * 10)}]}}")
    head, meta, rest = data.decode().partition("# meta: !!omap\n")
    return (head + meta + "\n".join(lines) + "\n" + rest).encode()


_CAMERA = (
    b"[camera]\nwidth_px = 1024\nheight_px = 1024\npixel_um = 12.0\nx0_px = 1\ny0_px = "
    b"1\nfocal_mm = %s\n"
)
_DEEP = "[" * 100_000 + "]" * 100_000
CALIBRATE = r"; run `starcal-uq calibrate` again\.$"
SAMPLE = r"; run `starcal-uq sample RUN --force` again\.$"


def _with(**changed: bytes | None) -> Callable[[bytes], bytes]:
    return lambda d: _members(d, **changed)


def _replaced(old: bytes, new: bytes) -> Callable[[bytes], bytes]:
    return lambda d: d.replace(old, new)


def _is(content: bytes) -> Callable[[bytes], bytes]:
    return lambda d: content


_EMPTY = _is(b""), r"\(the file is empty\)"
_OTHER_SIZE = r"\(theta declares another size than it has\)"
_AGAIN = "the draws are made again"
_NAXIS, _NAXIS2 = b"NAXIS   =                    2", b"NAXIS2  =                   40"
# What once ended in a traceback, in a wrong reason, or in numbers, by file: what was done to it, and
# the sentence; None where a result may come.
ONCE: dict[str, list[tuple[Callable[[bytes], bytes], str | None]]] = {
    "camera.toml": [
        (
            _is(_CAMERA % (b"[" * 3000 + b"]" * 3000)),
            "nests its values too deeply; write plain tables",
        ),
        (_is(_CAMERA % (b"{a=" * 3000 + b"1" + b"}" * 3000)), "nests its values too deeply"),
        (_is(_CAMERA % (b"1" * 5000)), "holds a number with too many digits; correct it"),
        (_is(_CAMERA % (b"1" * 4000)), r"focal_mm is 1{1,60}\.\.\.1+; write"),
        (_is(_CAMERA % b'"\\u0007"'), "focal_mm is '\\\\x07'; write"),
    ],
    "sensor.toml": [(_is(b"[sensor]\n" + b"1" * 5000 + b" = 2\n"), r"key 1+\.\.\.1+")],
    "calibration.npz": [
        (_is(b""), r"\(the file is empty\)" + CALIBRATE),
        (lambda d: d[:3000], r"\(it is damaged or cut off\)"),
        (_flipped, CALIBRATE),
        (_is(b"not an archive"), r"\(it is damaged or cut off\)"),
        (_with(quaternions=None), r"\(quaternions is missing\)"),
        (_with(theta=_declared((10**12,))), _OTHER_SIZE),
        (_with(theta=_declared((2**62, 4))), _OTHER_SIZE),
        (_with(theta=_npy(np.array([{}]))), r"\(theta holds Python objects\)"),
        (_with(theta=_npy(np.ones(5) + 1j)), r"\(theta does not hold what it should\)"),
        (_with(theta=_npy(np.full(5, np.nan))), r"\(theta holds a value that is not finite\)"),
        (_with(theta=_npy(np.ones(4))), r"\(theta has 4 entries where there should be 5\)"),
    ],
    "calibration.json": [
        _EMPTY,
        (lambda d: d[: len(d) // 2], r"\(line \d+ is no JSON\)"),
        (_is(_DEEP.encode()), r"\(its values are nested too deeply\)"),
        (
            _replaced(b'"sigma_name": "sigma', b'"sigma_name": "\\ud800'),
            "which no file can hold",
        ),
    ],
    "diagnosis.json": [(_is(_DEEP.encode()), "nested too deeply")],
    "images.json": [(_is(b"[1, 2]"), r"\(the document is \[1, 2\], not a table\)")],
    "posterior.nc": [
        (_hdf5(_other_names), r"\(its priors are those of other parameters\)" + SAMPLE),
        _EMPTY,
        (lambda d: d[:-1000], r"\(it is cut off, or not of this version\)"),
        (_hdf5(_nan_draw), r"\(draws holds a value that is not finite\)"),
        (_flipped, r"\(its content was changed after it was written\)"),
        (_hdf5(_huge_draws), r"\(it declares 8e\+12 bytes of content, far more"),
    ],
    "study.nc": [
        (
            _hdf5(lambda f: f.pop("status")),
            r"\(status is missing\); run `starcal-uq study` again\.$",
        ),
        (_hdf5(lambda f: f.pop("max_mag")), r"\(max_mag is missing\)"),
        (_hdf5(_one_for_another), r"\(n_frames is not along cell\)"),
    ],
    "study.toml": [
        (
            _replaced(b"k1 = 2.0e-10", b"k1 = 1e300"),
            r"key k1 is 1e\+300; write the coefficient, a ",
        ),
        (
            lambda d: re.sub(rb"seeds = .*", b"seeds = " + b"9" * 30, d),
            r"key seeds is 9+; write a whole number",
        ),
    ],
    "validation.npz": [
        (
            lambda d: _document(d, '"n_ranked": ', '"n_ranked": -'),
            r"\(n_ranked is -\d+, no number of draws\); run `starcal-uq validate CAMERA`",
        )
    ],
    "comparison.json": [
        (lambda d: re.sub(rb'"worst_ratio": [^,}]*', b'"worst_ratio": 0', d), None)
    ],
    "checkpoint.npz": [
        (_with(place=_npy(np.zeros(2) + 1j)), _AGAIN),
        (_with(place=_npy(np.zeros(2, "M8[s]"))), _AGAIN),
        (_with(key=None), _AGAIN),
        (lambda d: d[:200], _AGAIN),
    ],
    "run.json": [
        (_replaced(b'"gone": []', b'"gone": ["../kept.csv"]'), "names a file elsewhere"),
        (_replaced(b'"stage": ""', b'"stage": "/tmp"'), "names a file elsewhere"),
    ],
    "observations.parquet": [
        (
            _parquet(_null),
            "row 1, column frame: the value is missing; fill it in or remove the row",
        ),
        (_parquet(lambda t: t.append_column("frame", t.column(0))), "column frame occurs twice"),
        (_meta(b"starcal_uq", b"{"), r"\(line 1 is no JSON\); write it again\.$"),
        (_meta(b"starcal_uq", b"\xff"), r"\(its text is not UTF-8\)"),
        (_meta(b"starcal_uq", b"[1]"), r"\(its metadata are no table\)"),
        (_meta(b"starcal_uq", _DEEP.encode()), "nested too deeply"),
        (_meta(b"other", b"{"), None),
    ],
    "stream.parquet": [
        (_parquet(lambda t: t.append_column("x_px", t.column(1))), "column x_px occurs twice")
    ],
    "part.parquet": [(_meta(b"starcal_uq", b"1.5"), r"\(its metadata are no table\)")],
    "centroids.parquet": [
        (_meta(b"starcal_uq_centroids", None), "the list of frames is missing; give a table"),
        (_meta(b"starcal_uq_centroids", b"{}"), "list of frames is missing"),
    ],
    "profile.parquet": [_EMPTY],
    "observations.ecsv": [
        (_header_only, "the table has a header but no rows; give a table with observations"),
        (_replaced(b"datatype:", b"datatipe:"), "the ECSV header is not valid YAML"),
    ],
    "catalogue.ecsv": [(_header_only, "holds no stars")],
    "centroids.ecsv": [(lambda d: d.split(b"\n")[0] + b"\n", "is not valid YAML")],
    "observations.csv": [(_is(b"\x07,x\n1,2\n"), r"the file has \\x07, x: give")],
    "catalogue.csv.gz": [(lambda d: d[:100], "is not readable as CSV")],
    "tiles.fits": [
        (_replaced(_NAXIS2, _NAXIS2[:-2] + b" 0"), "the image has no pixels; leave it out")
    ],
    "catalogue.fits": [
        (_replaced(_NAXIS, b"NAXIS   = " + b"9" * 20), "its header states NAXIS as 9+")
    ],
    "state.npz": [(_with(header=None), r"\(header is missing\); give a file written by")],
}


@pytest.mark.parametrize(
    ("name", "damage", "words"),
    [(name, damage, words) for name, cases in ONCE.items() for damage, words in cases],
)
def test_what_once_went_wrong_is_one_sentence(
    bench: Bench, name: str, damage: Callable[[bytes], bytes], words: str | None
) -> None:
    sample = BY_FILE[name]
    outcome = bench.judged(sample, damage(bench.valid(sample)[0]))
    if words is None:
        assert outcome.kind in ("same", "other")
        return
    assert outcome.kind == "refused", outcome
    assert re.search(words, outcome.detail), outcome.detail


def test_what_is_packed_is_bounded_before_it_is_unpacked(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "_MODEST_BYTES", 2**16)
    outcome = bench.judged(BY_FILE["catalogue.csv.gz"], gzip.compress(bytes(2**20)))
    assert outcome.kind == "refused" and "far more than it can hold" in outcome.detail
    sample = BY_FILE["calibration.npz"]
    outcome = bench.judged(sample, _members(bench.valid(sample)[0], extra=bytes(2**20)))
    assert outcome.kind == "refused" and "far more than it can hold" in outcome.detail
    outcome = bench.judged(
        BY_FILE["observations.ecsv"], _many_names(bench.valid(BY_FILE["observations.ecsv"])[0])
    )
    assert outcome.kind == "refused" and "far more than it can hold" in outcome.detail


def test_a_bad_sentence_and_what_escapes_are_seen(bench: Bench) -> None:
    def broken(path: Path) -> None:
        raise KeyError("row")

    def wordy(path: Path) -> None:
        raise StarcalError("ValueError: no file\n is named")

    for load, kind in ((broken, "escaped"), (wordy, "words")):
        sample = Sample("camera.toml", load, ())
        assert bench.judged(sample, b"", "", bench.folder / "camera.toml").kind == kind
