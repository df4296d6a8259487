"""One damage to a file: to its bytes, its text, or inside its format, so that it passes the
checksums of archives and meets the code behind them.

All chance is in a `random.Random`, which hypothesis can play as well.
"""

from __future__ import annotations

import io
import json
import random
import re
import struct
import warnings
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np

from starcal_uq.core.files import sealed
from tests.damage.samples import Sample

# What stands where a number or a text should.
_ODD = "nan inf -inf 1e999 1e300 -1e300 1e-320 -1 0 text é \x00 \x07 \" ' =1+1 true None null -0.0"
_LITERAL = r'nan -inf 1e300 -1 0 "" "text" [] {} true 1979-05-27 "\u0001" 1e-320 07:32:00'
ODD = (*_ODD.split(), "", "2024-01-01T00:00:00", "\u2028", "0x10", "1" * 30, "1" * 5000)
LITERALS = (
    *_LITERAL.split(),
    *("1" * 30, "1" * 5000, "[" * 3000 + "]" * 3000, "{a=" * 1500 + "1" + "}" * 1500, "[1, 'a']"),
)
_NESTED = "@nested@"
NODES: tuple[Any, ...] = (
    *(None, True, "", "text", "\ud800", -1, 0, 1e300, float("nan"), float("inf"), 10**30, 10**400),
    *([], {}, [[]], [1, 2], {"a": 1}, ["a"], [None], _NESTED, -0.5, "\x00", "9" * 5000),
)


def mutant(sample: Sample, data: bytes, rng: random.Random, other: bytes = b"") -> bytes:
    """The file, damaged once or a few times."""
    ways: list[Callable[[bytes, random.Random], bytes]] = [lambda d, r: _bytes(d, r, other)]
    ending = sample.ending
    if not sample.binary:
        ways.append(_text)
    if ending in ("toml",):
        ways.append(_toml)
    structural = {
        "json": _json,
        "npz": _npz,
        "parquet": _parquet,
        "nc": _netcdf,
        "fits": _fits,
        "png": _png,
    }.get(ending)
    if ending == "gz":
        structural = _packed
    if structural is not None:
        ways += [structural, structural]
    way = rng.choice(ways)
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        try:
            data = way(data, rng)
        except Exception:  # what is damaged already need not take a second blow inside its format
            data = _bytes(data, rng, other)
    return data


def _place(data: Any, rng: random.Random) -> int:
    return rng.randrange(len(data)) if data else 0


def _bytes(data: bytes, rng: random.Random, other: bytes) -> bytes:
    way, i, j = rng.randrange(9), _place(data, rng), _place(data, rng)
    changed = bytearray(data)
    if way == 0:
        return data[:i]
    if way == 1:
        return rng.choice((b"", b"\n", b"\x00", b" " * 40))
    if way == 2:
        for _ in range(rng.choice((1, 1, 3, 30))):
            if changed:
                changed[_place(changed, rng)] ^= 1 << rng.randrange(8)
        return bytes(changed)
    if way == 3:
        return data[:i] + other[_place(other, rng) :]
    if way == 4 and data:
        changed[i], changed[j] = changed[j], changed[i]
        return bytes(changed)
    low, high = sorted((i, j))
    if way == 5:
        return data[:low] + data[high:]
    if way == 6:
        return data[:low] + bytes(min(high - low, 512)) + data[low + min(high - low, 512) :]
    if way == 7:
        return (
            data[:i] + bytes(rng.randrange(256) for _ in range(rng.choice((1, 4, 16)))) + data[i:]
        )
    return data[:high] + data[low:]


def _text(data: bytes, rng: random.Random) -> bytes:
    text = data.decode("utf-8", "surrogateescape")
    lines = text.splitlines(keepends=True)
    way = rng.randrange(9)
    i, j = _place(lines, rng), _place(lines, rng)
    if not lines:
        return data
    if way == 0:
        del lines[i]
    elif way == 1:
        lines.insert(j, lines[i])
    elif way == 2:
        lines[i], lines[j] = lines[j], lines[i]
    elif way in (3, 4, 5):
        lines[i] = _token(lines[i], rng)
    elif way == 6:
        lines = _column(lines, rng)
    elif way == 7:
        lines = lines[: i + 1]
    else:
        lines[i] = (
            lines[i].rstrip("\n")
            + rng.choice((",", '"', "\t", " x", "," * 200, "9" * 200_000))
            + "\n"
        )
    return "".join(lines).encode("utf-8", "surrogateescape")


def _token(line: str, rng: random.Random) -> str:
    tokens = list(re.finditer(r"[^\s,|=\[\]{}\":]+", line))
    if not tokens:
        return line + rng.choice(ODD)
    token = tokens[_place(tokens, rng)]
    return line[: token.start()] + rng.choice(ODD) + line[token.end() :]


def _column(lines: list[str], rng: random.Random) -> list[str]:
    """Leave out or repeat a column of a table with commas, or rename it."""
    rows = [line.rstrip("\n").split(",") for line in lines]
    width = max(map(len, rows))
    place, way = rng.randrange(width), rng.randrange(4)
    for row in rows:
        if len(row) != width:
            continue
        if way == 0:
            del row[place]
        elif way == 1:
            row.append(row[place])
        elif way == 2:
            row[place] = rng.choice(ODD)
        else:
            row[place] = ""
    return [",".join(row) + "\n" for row in rows]


def _toml(data: bytes, rng: random.Random) -> bytes:
    lines = data.decode().splitlines(keepends=True)
    keys = [i for i, line in enumerate(lines) if re.match(r"\s*\w+ *=", line)]
    if not keys:
        return data
    i = rng.choice(keys)
    key = lines[i].partition("=")[0]
    way = rng.randrange(4)
    if way == 0:
        lines[i] = f"{key.strip()}x = 1\n"
    elif way == 1:
        lines[i] = f"[{key.strip()}]\n"
    else:
        lines[i] = f"{key}= {rng.choice(LITERALS)}\n"
    return "".join(lines).encode()


def _json(data: bytes, rng: random.Random) -> bytes:
    document = json.loads(data)
    return _dumped(_node(document, rng)).encode()


def _dumped(document: Any) -> str:
    return json.dumps(document).replace(f'"{_NESTED}"', "[" * 100_000 + "]" * 100_000)


def _node(document: Any, rng: random.Random) -> Any:
    """Change something in a tree of plain values, at a depth drawn at random."""
    if isinstance(document, dict) and document:
        key = rng.choice(list(document))
        way = rng.randrange(8)
        if way == 0:
            return {name: value for name, value in document.items() if name != key}
        if way == 1:
            return {
                (f"{name}_" if name == key else name): value for name, value in document.items()
            }
        if way == 2:
            return rng.choice(NODES)
        return {**document, key: _node(document[key], rng)}
    if isinstance(document, list) and document:
        i, way = rng.randrange(len(document)), rng.randrange(8)
        if way == 0:
            return document[:i] + document[i + 1 :]
        if way == 1:
            return [*document, document[i]]
        if way == 2:
            return rng.choice(NODES)
        return [*document[:i], _node(document[i], rng), *document[i + 1 :]]
    return rng.choice(NODES)


# Values of cards, and of the sizes in other headers.
CARDS = (
    *b"T 0 1 -1 8 -32 64 999 1000000000000 99999999999999999999 1E300 NaN '' 'text'".split(),
    *(b"'2026-11-21T25:00:00'", b"(1.0, 2.0)", b"", b"\xff", b"'open", b"-1E400", b"40000"),
)


def _fits(data: bytes, rng: random.Random) -> bytes:
    """A card of a header changed, left out, repeated, or in the place of another."""
    cards = [
        i for i in range(0, len(data), 80) if re.match(rb"[A-Z0-9_-]{1,8} *=", data[i : i + 10])
    ]
    i, j, way = rng.choice(cards), rng.choice(cards), rng.randrange(6)
    card = data[i : i + 80]
    if way == 0:
        return data[:i] + b" " * 80 + data[i + 80 :]
    if way == 1:
        return data[:j] + card + data[j + 80 :]
    if way == 2:
        names = b"BSCALE BZERO BLANK PCOUNT GCOUNT GROUPS NAXIS3 EXTEND BAYERPAT".split()
        card = rng.choice(names).ljust(8) + card[8:]
    return data[:i] + (card[:10] + rng.choice(CARDS).rjust(20)).ljust(80) + data[i + 80 :]


def _png(data: bytes, rng: random.Random) -> bytes:
    """A part of a PNG file changed, left out or repeated, with its checksum."""
    import zlib

    parts, place = [], 8
    while place + 12 <= len(data):
        (size,) = struct.unpack(">I", data[place : place + 4])
        parts.append((data[place + 4 : place + 8], data[place + 8 : place + 8 + size]))
        place += size + 12
    i, way = rng.randrange(len(parts)), rng.randrange(5)
    name, content = parts[i]
    if way == 0:
        del parts[i]
    elif way == 1:
        parts.insert(i, parts[i])
    elif way == 2 and name == b"IHDR":
        sizes = struct.pack(
            ">II", *(rng.choice((0, 1, 7, 40, 70_000, 2**31 - 1, 2**32 - 1)) for _ in range(2))
        )
        parts[i] = name, sizes + bytes(rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 255)) for _ in range(5))
    else:
        parts[i] = name, _bytes(content, rng, data)
    made = (
        struct.pack(">I", len(c)) + n + c + struct.pack(">I", zlib.crc32(n + c)) for n, c in parts
    )
    return data[:8] + b"".join(made)


def _packed(data: bytes, rng: random.Random) -> bytes:
    """What is inside a file of gzip, damaged and packed again."""
    import gzip

    content = gzip.decompress(data)
    if content.startswith(b"SIMPLE"):
        content = rng.choice(
            (_fits, lambda d, r: _bytes(d, r, data), lambda d, r: d + bytes(10**6))
        )(content, rng)
    else:
        content = _text(content, rng)
    return gzip.compress(content, mtime=0)


def _npz(data: bytes, rng: random.Random) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    name = rng.choice(list(members))
    way = rng.randrange(8)
    extra: list[tuple[str, bytes]] = []
    if way == 0:
        del members[name]
    elif way == 1:
        members[f"x{name}"] = members.pop(name)
    elif way == 2:
        extra = [(name, members[name])]
    elif way == 3:
        members[name] = _npy(rng.choice(_ARRAYS)(np.load(io.BytesIO(members[name]))))
    elif way == 4:
        members[name] = _header(members[name], rng)
    elif way == 5:
        members[name] = rng.choice(
            (b"", b"\x93NUMPY", b"text", members[name][:-4], members[name][:20])
        )
    else:
        document = next((m for m in ("document.npy", "header.npy") if m in members), None)
        if document is None:
            members[name] = _npy(rng.choice(_ARRAYS)(np.load(io.BytesIO(members[name]))))
        else:
            text = str(np.load(io.BytesIO(members[document])))
            members[document] = _npy(np.array(_dumped(_node(json.loads(text), rng))))
    stream = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(stream, "w", rng.choice((0, 8, 12))) as archive:
        warnings.simplefilter("ignore")
        for member, content in (*members.items(), *extra):
            archive.writestr(zipfile.ZipInfo(member), content)
    return stream.getvalue()


def _npy(array: Any) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def _numeric(array: Any) -> Any:
    return (
        np.asarray(array, dtype=float) if array.dtype.kind in "fiub" else np.zeros(np.shape(array))
    )


_ARRAYS: tuple[Callable[[Any], Any], ...] = (
    lambda a: a.ravel()[:-1],
    lambda a: a[None],
    lambda a: np.zeros((0,)),
    lambda a: np.zeros((2, 3, 4)),
    lambda a: np.float64(1.0),
    lambda a: np.full(np.shape(a), np.nan),
    lambda a: _numeric(a) * 1e300,
    lambda a: _numeric(a) + 1j,
    lambda a: np.full(np.shape(a), "text"),
    lambda a: np.array([{"a": 1}], dtype=object),
    lambda a: a.T.copy(),
    lambda a: -_numeric(a),
    lambda a: _numeric(a) + 10,
    lambda a: np.array("2020-01-01", dtype="datetime64[s]"),
    lambda a: a[..., :1] if np.ndim(a) else a,
    lambda a: np.zeros(np.shape(a), dtype=[("a", "f8")]),
)


def _header(member: bytes, rng: random.Random) -> bytes:
    """An array's file whose header declares something else."""
    array = np.load(io.BytesIO(member))
    descr = rng.choice(
        (array.dtype.str, "|O", "<f4", "<c16", "<U1000000", "<M8[s]", "|V8", "not a type")
    )
    shape = rng.choice(
        (array.shape, (10**12,), (10**6, 10**6), (-1,), (2**62, 4), "shape", (0,), (1.5,), (10**9,))
    )
    text = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape!r}, }}"
    if rng.random() < 0.1:
        text = "(" * 5000
    head = text.encode() + b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + member[-array.nbytes :]


def _parquet(data: bytes, rng: random.Random) -> bytes:
    import pyarrow as pa
    from pyarrow import parquet

    table = parquet.read_table(io.BytesIO(data))
    i, way = rng.randrange(table.num_columns), rng.randrange(10)
    name, column = table.column_names[i], table.column(i)
    if way == 0:
        table = table.remove_column(i)
    elif way == 1:
        table = table.append_column(name, column)
    elif way == 2:
        values: list[Any] = column.to_pylist()
        values[rng.randrange(len(values))] = None
        table = table.set_column(i, name, pa.array(values, column.type))
    elif way in (3, 4):
        n = len(column)
        one_each: list[Any] = [
            "text",
            [1.0],
            True,
            None,
            float("nan"),
            float("inf"),
            b"\xff",
            2**62,
        ]
        one_each += [-1, 1e300, {"a": 1}, 0.5, 0, "\x00", "1"]
        table = table.set_column(i, name, pa.array([rng.choice(one_each)] * n))
    elif way == 5:
        table = table.slice(0, rng.choice((0, 1)))
    elif way == 6:
        table = table.set_column(i, rng.choice((f"{name}x", "", "\x00", "frame")), column)
    else:
        meta = dict(table.schema.metadata or {})
        key = rng.choice(sorted(meta)) if meta else b"starcal_uq"
        document = meta.get(key, b"{}")
        if rng.random() < 0.4:
            meta[key] = rng.choice(
                (b"", b"{", b"[]", b"null", b"1", b"\xff", b"[" * 100_000, b'{"directions": 3}')
            )
        elif rng.random() < 0.2:
            meta.pop(key, None)
        else:
            meta[key] = _dumped(_node(json.loads(document), rng)).encode("utf-8", "replace")
        table = table.replace_schema_metadata(meta)
    stream = io.BytesIO()
    parquet.write_table(table, stream)
    return stream.getvalue()


def _netcdf(data: bytes, rng: random.Random) -> bytes:
    import h5py

    content = data.rpartition(b"\nsha256 ")[0]
    if sealed(content) != data:
        raise ValueError("damaged already: the HDF5 library may never come back from it")
    stream = io.BytesIO(content)
    with h5py.File(stream, "r+") as file:
        names = [name for name in file if isinstance(file[name], h5py.Dataset)]
        way = rng.randrange(8)
        name = rng.choice(names)
        values = file[name][()]
        if way == 0:
            del file[name]
        elif way == 1 and len(file.attrs):
            del file.attrs[rng.choice(sorted(file.attrs))]
        elif way in (2, 3):
            numeric = (
                values if np.asarray(values).dtype.kind in "fiu" else np.zeros(np.shape(values))
            )
            made = rng.choice(_ARRAYS[:10])(np.asarray(numeric))
            del file[name]
            file[name] = made if made.dtype.kind not in "UO" else np.array([b"text"])
        elif way == 4 and np.asarray(values).dtype.kind == "f" and np.size(values):
            flat = np.array(values).ravel()
            flat[rng.randrange(flat.size)] = rng.choice((np.nan, np.inf, 1e300, 0.0, -1.0))
            file[name][...] = flat.reshape(np.shape(values))
        elif way == 5:
            del file[name]
            file.create_dataset(name, shape=(10**12,), dtype="f8", chunks=(1000,))
        else:
            key = next((k for k in ("record", "definition") if k in file.attrs), None)
            if key is not None:
                text = _dumped(_node(json.loads(file.attrs[key]), rng))
                file.attrs[key] = text if len(text) < 60_000 else text[:60_000]
    return sealed(stream.getvalue())
