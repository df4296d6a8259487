"""Files of images that are damaged, too large or of another kind: read right, or refused by name in one sentence."""

from __future__ import annotations

import gzip
import io
import os
import struct
import tracemalloc
import warnings
import zlib

import numpy as np
import PIL.Image
import pytest

from starcal_uq.core import files
from starcal_uq.core.errors import ImageError
from starcal_uq.images.extract import extract_centroids
from starcal_uq.images.image import read_image


def card(key, value, comment=""):
    return f"{key:<8}= {value:>20} / {comment}".ljust(80).encode()


def fits(shape, data=b"", *extra, bitpix=16, naxis=None):
    sizes = [card(f"NAXIS{k + 1}", size) for k, size in enumerate(reversed(shape))]
    cards = [card("SIMPLE", "T"), card("BITPIX", bitpix), card("NAXIS", naxis or len(shape)), *sizes, *extra]
    header = b"".join(cards) + b"END".ljust(80)
    return header + b" " * (-len(header) % 2880) + data + bytes(-len(data) % 2880)


def png(width, height, depth, colour, rows=b""):
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    chunks = (b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")
    made = (struct.pack(">I", len(c)) + n + c + struct.pack(">I", zlib.crc32(n + c)) for n, c in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(made)


def read(folder, name, content):
    (folder / name).write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read_image(folder / name)


GREY = np.arange(24, dtype=np.uint8).reshape(4, 6) * 10
EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\nshowpage\n"
REFUSED = {
    "axes.fits": (fits((4, 6), bytes(48), naxis=10**12), "truncated or damaged"),
    "back.fits": (fits((4, -32), bytes(48)), "truncated or damaged"),
    "groups.fits": (fits((4, 6), bytes(48), card("PCOUNT", -9999)), "truncated or damaged"),
    "large.png": (png(60_000, 60_000, 8, 0), "declares 3.6e[+]09 bytes .* without compression"),
    "deep.png": (png(2, 1, 16, 2, bytes(13)), "16 bits, of which only 8"),
    "alpha.png": (png(2, 1, 16, 4, bytes(9)), "16 bits, of which only 8"),
    "drawing.png": (EPS, "is not an image"),
    "fits.png": (fits((4, 6), bytes(48)), "give its name the ending .fits"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_read_right_is_refused_by_name(tmp_path, name):
    content, words = REFUSED[name]
    with pytest.raises(ImageError, match=words) as error:
        read(tmp_path, name, content)
    assert name in str(error.value) and str(error.value).endswith(".")


def test_a_small_packed_file_takes_no_memory(tmp_path, monkeypatch):
    """Refused by what the first header declares, and by what comes out where the header is silent."""
    zeros = bytes(5_000_000)
    packed = gzip.compress(fits((40_000, 40_000), zeros)), gzip.compress(fits((), zeros + zeros, naxis="0"))
    monkeypatch.setattr(files, "_MODEST_BYTES", 2**20)
    for content in packed:
        (tmp_path / "packed.fits.gz").write_bytes(content)
        tracemalloc.start()
        with pytest.raises(ImageError, match="bytes of content, far more than it can hold"):
            read_image(tmp_path / "packed.fits.gz")
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 2e7


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.fits")
    with pytest.raises(ImageError, match="not a regular file"):
        read_image(tmp_path / "pipe.fits")


def test_wide_images_and_cards_that_cannot_be_read_do_no_harm(tmp_path):
    wide = np.arange(4 * 1500, dtype=">i2").reshape(4, 1500)
    image = read(tmp_path, "wide.fits", fits(wide.shape, wide.tobytes(), card("SATURATE", "NaN"), card("EXPTIME", 2.0)))
    np.testing.assert_array_equal(image.data, wide)
    assert image.exposure_s == 2.0


def test_numbers_beyond_all_counts_have_no_value(tmp_path):
    counts = np.full((4, 6), 7.0)
    counts[1, 2:5] = 1e300, -np.inf, 3e38
    image = read(tmp_path, "odd.fits", fits(counts.shape, counts.astype(">f8").tobytes(), bitpix=-64))
    assert np.isnan(image.data[1, 2:5]).all() and np.count_nonzero(np.isnan(image.data)) == 3
    assert "3 pixels without a value" in image.messages[0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(extract_centroids(type(image)(counts, "in memory"))) == 0


def test_bmp_is_read_and_found_in_a_folder(tmp_path):
    stream = io.BytesIO()
    PIL.Image.fromarray(GREY).save(stream, "BMP")
    np.testing.assert_array_equal(read(tmp_path, "grey.bmp", stream.getvalue()).data, GREY)
    assert extract_centroids(tmp_path).image.tolist() == ["grey.bmp"]


def test_a_gain_without_a_unit_is_not_believed_and_a_mosaic_is_named(tmp_path):
    def made(*extra):
        return read(tmp_path, "zwo.fits", fits((4, 6), bytes(48), *extra))

    setting = made(card("GAIN", 120, "camera setting"), card("BAYERPAT", "'RGGB    '"))
    assert setting.gain_e_per_count is None
    assert "GAIN (120)" in setting.messages[0] and "mosaic of colours (RGGB)" in setting.messages[1]
    assert made(card("GAIN", 2.5, "Gain in e-/ADU")).gain_e_per_count == 2.5
    assert made(card("GAIN", 120), card("EGAIN", 0.8)).gain_e_per_count == 0.8


def test_centroids_do_not_depend_on_the_number_of_processes(tmp_path):
    rng = np.random.default_rng(4)
    for k in range(18):
        counts = rng.normal(100.0, 3.0, (40, 48))
        counts[5 + k, 20:22] += 200.0
        PIL.Image.fromarray(counts.astype(np.uint16)).save(tmp_path / f"{k:02d}.png")
    (tmp_path / "07.png").write_bytes(b"cut off")
    done = []
    one, two = (
        extract_centroids(tmp_path, workers=workers, progress=lambda n, of: done.append((n, of))) for workers in (0, 2)
    )
    for name in ("frame", "x_px", "y_px", "flux", "image", "problem"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert (one.messages, one.meta) == (two.messages, two.meta) and len(one) > 5 and one.n_left_out == 1
    assert done[-1] == (18, 18)
