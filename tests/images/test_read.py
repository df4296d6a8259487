"""Files of images that are damaged, too large or of another kind: read right, or refused by name in
one sentence.
"""

from __future__ import annotations

import gzip
import io
import os
import struct
import sys
import tracemalloc
import warnings
import zlib
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import PIL.Image
import pytest
from astropy.io import fits as astropy_fits
from scipy.spatial import cKDTree
from scipy.special import ndtr

from starcal_uq.core import files
from starcal_uq.core.errors import ImageError, MissingExtraError
from starcal_uq.images.centroids import COLUMNS, FRAME_COLUMNS
from starcal_uq.images.extract import _Measure, extract_centroids
from starcal_uq.images.image import Image
from starcal_uq.images.read import read_image, read_images


def card(key, value, comment=""):
    return f"{key:<8}= {value:>20} / {comment}".ljust(80).encode()


def fits(shape, data=b"", *extra, bitpix=16, naxis=None):
    sizes = [card(f"NAXIS{k + 1}", size) for k, size in enumerate(reversed(shape))]
    cards = [
        card("SIMPLE", "T"),
        card("BITPIX", bitpix),
        card("NAXIS", naxis or len(shape)),
        *sizes,
        *extra,
    ]
    header = b"".join(cards) + b"END".ljust(80)
    return header + b" " * (-len(header) % 2880) + data + bytes(-len(data) % 2880)


def png(width, height, depth, colour, rows=b""):
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    chunks = (b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")
    made = (
        struct.pack(">I", len(c)) + n + c + struct.pack(">I", zlib.crc32(n + c)) for n, c in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(made)


def dng(counts):
    """A DNG file of one uncompressed mosaic, GRBG, of 12 bits, exposed for half a second."""
    height, width = counts.shape
    exposure = 1000
    tags = {
        254: (4, 0), 256: (4, width), 257: (4, height), 258: (3, 16), 259: (3, 1), 262: (3, 32803), 271: (2, b"X\0"),
        272: (2, b"Y\0"), 273: (4, 4096), 277: (3, 1), 278: (4, height), 279: (4, counts.nbytes), 33421: (3, (2, 2)),
        33422: (1, bytes([1, 0, 2, 1])), 33434: (5, exposure), 50706: (1, bytes([1, 4, 0, 0])), 50708: (2, b"XY\0"),
        50717: (3, 4095), 50721: (10, 2000), 50778: (3, 21),
    }  # fmt: skip
    sizes, head = {1: 1, 2: 1, 3: 2, 4: 4}, struct.pack("<2sHIH", b"II", 42, 8, len(tags))
    for tag, (kind, value) in tags.items():
        if isinstance(value, bytes):
            head += struct.pack("<HHI", tag, kind, len(value)) + value.ljust(4, b"\0")
        elif kind in (5, 10):
            head += struct.pack("<HHII", tag, kind, 9 if kind == 10 else 1, value)
        else:
            values = value if isinstance(value, tuple) else (value,)
            packed = b"".join(int(v).to_bytes(sizes[kind], "little") for v in values)
            head += struct.pack("<HHI", tag, kind, len(values)) + packed.ljust(4, b"\0")
    content = bytearray((head + bytes(4)).ljust(4096, b"\0"))
    content[exposure : exposure + 8] = struct.pack("<II", 1, 2)
    content[2000:2072] = b"".join(
        struct.pack("<ii", int(j == k), 1) for j in range(3) for k in range(3)
    )
    return bytes(content) + counts.tobytes()


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
    "deep.png": (png(2, 1, 16, 2, bytes(13)), r"16 bits need cv2: .*starcal-uq\[raw\]"),
    "alpha.png": (png(2, 1, 16, 4, bytes(9)), r"16 bits need cv2: .*starcal-uq\[raw\]"),
    "camera.nef": (b"II*\0", r"need rawpy: run `pip install \"starcal-uq\[raw\]"),
    "drawing.png": (EPS, "is not an image"),
    "fits.png": (fits((4, 6), bytes(48)), "give its name the ending .fits"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_read_right_is_refused_by_name(tmp_path, monkeypatch, name):
    for library in ("cv2", "rawpy"):
        monkeypatch.setitem(sys.modules, library, None)
    content, words = REFUSED[name]
    with pytest.raises((ImageError, MissingExtraError), match=words) as error:
        read(tmp_path, name, content)
    assert name in str(error.value) and str(error.value).endswith(".")


def test_a_small_packed_file_takes_no_memory(tmp_path, monkeypatch):
    """Refused by what the first header declares, and by what comes out where the header is
    silent.
    """
    zeros = bytes(5_000_000)
    packed = (
        gzip.compress(fits((40_000, 40_000), zeros)),
        gzip.compress(fits((), zeros + zeros, naxis="0")),
    )
    monkeypatch.setattr(files, "_MODEST_BYTES", 2**20)
    for content in packed:
        (tmp_path / "packed.fits.gz").write_bytes(content)
        tracemalloc.start()
        with pytest.raises(ImageError, match="bytes of content, far more than it can hold"):
            read_image(tmp_path / "packed.fits.gz")
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 2e7


def test_a_damaged_tiff_is_one_sentence_and_nothing_more(tmp_path, capfd):
    """The library that reads it prints for itself, to the terminal of the command."""
    counts = np.random.default_rng(1).integers(0, 60_000, (64, 64)).astype(np.uint16)
    PIL.Image.fromarray(counts).save(tmp_path / "a.tif", compression="tiff_adobe_deflate")
    content = bytearray((tmp_path / "a.tif").read_bytes())
    content[200:500] = bytes(byte ^ 0x5A for byte in content[200:500])
    (tmp_path / "a.tif").write_bytes(content)
    with pytest.raises(ImageError):
        read_image(tmp_path / "a.tif")
    assert capfd.readouterr() == ("", "")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.fits")
    with pytest.raises(ImageError):
        read_image(tmp_path / "pipe.fits")


def test_wide_images_and_cards_that_cannot_be_read_do_no_harm(tmp_path):
    wide = np.arange(4 * 1500, dtype=">i2").reshape(4, 1500)
    image = read(
        tmp_path,
        "wide.fits",
        fits(wide.shape, wide.tobytes(), card("SATURATE", "NaN"), card("EXPTIME", 2.0)),
    )
    np.testing.assert_array_equal(image.data, wide)
    assert image.exposure_s == 2.0


def test_numbers_beyond_all_counts_have_no_value(tmp_path):
    counts = np.full((4, 6), 7.0)
    counts[1, 2:5] = 1e300, -np.inf, 3e38
    image = read(
        tmp_path, "odd.fits", fits(counts.shape, counts.astype(">f8").tobytes(), bitpix=-64)
    )
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


@pytest.mark.parametrize("ending", ["png", "tiff"])
def test_colours_of_16_bits_keep_their_depth(tmp_path, ending):
    cv2 = pytest.importorskip("cv2")
    colours = np.random.default_rng(2).integers(0, 60_000, (5, 7, 3)).astype(np.uint16)
    colours[1, 2] = 65_535, 7, 7
    (tmp_path / f"deep.{ending}").write_bytes(
        cv2.imencode(f".{ending}", colours[..., ::-1])[1].tobytes()
    )
    image = read_image(tmp_path / f"deep.{ending}")
    expected = colours @ [0.299, 0.587, 0.114]
    expected[1, 2] = 65_535.0
    np.testing.assert_allclose(image.data, expected, rtol=1e-6)
    assert image.saturation == 65_535.0 and "luminance" in image.messages[0]
    found = extract_centroids(tmp_path / f"deep.{ending}", bayer="RGGB")
    assert found.problem[0] == "the colours of its mosaic were put together before"


def test_planes_pages_and_extensions_are_frames(tmp_path):
    """Each with its own name and time; noise maps, previews and pages of another size are named,
    not read.
    """
    data = np.arange(24, dtype=np.int16).reshape(4, 6)
    header = {"DATE-OBS": "2026-11-21T01:00:00", "EXPTIME": 2.0}
    path = tmp_path / "cube.fits"
    for extra, middles in (
        ({}, (1, 3, 5)),
        ({"KCT": 10.0}, (1, 11, 21)),
        ({"DATE-END": "2026-11-21T01:00:12"}, (1, 5, 9)),
        ({"CTYPE3": "TIME", "CDELT3": 0.1, "CUNIT3": "min"}, (1, 7, 13)),
        # All planes together were exposed for so long.
        ({"DATE-END": "2026-11-21T01:00:03"}, (0.5, 1.5, 2.5)),
    ):
        astropy_fits.writeto(
            path, np.stack([data + k for k in range(3)]), astropy_fits.Header(header | extra)
        )
        images = read_images(path)
        path.unlink()
        assert [image.name for image in images] == ["cube.fits[0]", "cube.fits[1]", "cube.fits[2]"]
        assert [float(image.time_utc[17:]) for image in images] == list(middles)
        assert [int(image.data[0, 0]) for image in images] == [0, 1, 2]
        assert "3 planes were read as frames" in images[0].messages[0] and not images[1].messages
    hdus = [astropy_fits.PrimaryHDU(), astropy_fits.ImageHDU(data), astropy_fits.ImageHDU(data[:2])]
    hdus += [
        astropy_fits.ImageHDU(data, name="ERR"),
        astropy_fits.ImageHDU(np.stack([data + 1, data + 2])),
    ]
    astropy_fits.HDUList(hdus).writeto(path)
    images = read_images(path)
    assert [image.name for image in images] == ["cube.fits[1]", "cube.fits[4,0]", "cube.fits[4,1]"]
    assert (
        "of 4 images in the file, 2 of 6 x 4 px" in images[0].messages[0]
        and "ERR" in images[0].messages[1]
    )
    np.testing.assert_array_equal(read_image(tmp_path / "cube.fits[4,1]").data, data + 2)
    with pytest.raises(ImageError, match=r"no such frame; the file has cube.fits\[1\], .*\[4,1\]"):
        read_image(tmp_path / "cube.fits[9]")
    pages = [PIL.Image.fromarray(page) for page in (GREY, GREY + 1, GREY[:2])]
    pages[0].save(tmp_path / "pages.tiff", save_all=True, append_images=pages[1:])
    images = read_images(tmp_path / "pages.tiff")
    assert [image.name for image in images] == ["pages.tiff[0]", "pages.tiff[1]"]
    assert images[0].messages == ("pages.tiff: of 3 pages, 2 of 6 x 4 px were read as frames.",)
    np.testing.assert_array_equal(images[1].data, GREY + 1)
    found = extract_centroids(tmp_path)
    assert found.image.tolist() == [
        "cube.fits[1]",
        "cube.fits[4,0]",
        "cube.fits[4,1]",
        "pages.tiff[0]",
        "pages.tiff[1]",
    ]
    assert found.frame_ids.tolist() == list(range(5))


def test_what_a_folder_holds_beside_images_is_named_once(tmp_path):
    for name in ("notes.txt", "camera.toml"):
        (tmp_path / name).write_text("x")
    (tmp_path / "inner").mkdir()
    PIL.Image.fromarray(GREY).save(tmp_path / "a.png")
    messages = extract_centroids(tmp_path).messages
    assert [text for text in messages if "not read" in text] == [
        f"{tmp_path}: not read, because subfolders are not searched: inner.",
        (
            f"{tmp_path}: not read, because the ending is of no image that is read: camera.toml, "
            "notes.txt."
        ),
    ]


def mosaic_scene(pattern, seed=5, shape=(512, 640), sigma=0.8):
    """Places of stars, and counts that a sensor of one colour and one with a mosaic of colours give
    for them.
    """
    rng = np.random.default_rng(seed)
    # One star in each of 120 cells, so that none is near another.
    y, x = (np.indices((10, 12)).reshape(2, -1) + rng.uniform(0.3, 0.7, (2, 120))) * 50.0
    edges = [(np.arange(size + 1) - 0.5)[:, None] for size in shape]
    parts = [
        np.diff(ndtr((edge - at) / sigma), axis=0) for edge, at in zip(edges, (y, x), strict=True)
    ]
    light = (parts[0] * rng.uniform(300, 2500, 120)) @ parts[1].T
    # Red and blue see other parts of the light of stars, and of that of the sky.
    seen, sky = np.ones(shape), np.ones(shape)
    for k, colour in enumerate(pattern):
        place = slice(k // 2, None, 2), slice(k % 2, None, 2)
        seen[place], sky[place] = {"R": (0.6, 1.6), "G": (1.0, 1.0), "B": (0.4, 0.7)}[colour]
    counts = [
        rng.poisson(light * part + 200.0 * glow) + rng.normal(100.0, 3.0, shape)
        for part, glow in ((1, 1), (seen, sky))
    ]
    return np.column_stack([x, y]), [np.rint(values).astype(np.uint16) for values in counts]


@pytest.mark.parametrize("pattern", ["RGGB", "GBRG"])
def test_green_pixels_of_a_mosaic_are_measured_at_their_places(tmp_path, pattern):
    """Most stars come, without bias by half a pixel, where a mosaic that is read as grey loses
    most.
    """
    true, (grey, counts) = mosaic_scene(pattern)

    def measured(data, **options):
        found = extract_centroids(Image(data, "a"), gain_e_per_count=1.0, **options)
        place, nearest = cKDTree(true).query(found.xy)
        assert np.count_nonzero(place > 1.0) <= 2
        clear = (place < 1.0) & (found.snr > 10.0) & ~found.blended
        z = (found.xy - true[nearest])[clear] / np.sqrt([found.var_x_px2, found.var_y_px2]).T[clear]
        return np.count_nonzero(place < 1.0), z

    whole, _ = measured(grey)
    green, z = measured(counts, bayer=pattern)
    as_grey, _ = measured(counts)
    assert whole > 110 and green > 0.8 * whole and as_grey < 0.6 * whole
    assert np.abs(z.mean(axis=0)).max() < 4.0 / np.sqrt(len(z)) and 0.8 < z.std() < 1.2
    # The pattern belongs to its place: half of the pixels would be another colour's.
    other = {"RGGB": "GRBG", "GBRG": "BGGR"}[pattern]
    assert measured(counts, bayer=other)[0] < green


def test_the_mosaic_of_a_header_counts_from_the_row_that_is_stored_first(tmp_path):
    def pattern(*cards, rows=4):
        return read(
            tmp_path,
            "a.fits",
            fits((rows, 6), bytes(2 * rows * 6), card("BAYERPAT", "'RGGB    '"), *cards),
        ).mosaic

    order = card("ROWORDER", "'BOTTOM-UP'")
    assert (
        pattern() == "RGGB"
        and pattern(card("XBAYROFF", 1)) == "GRBG"
        and pattern(card("YBAYROFF", 1)) == "GBRG"
    )
    assert pattern(order) == "GBRG" and pattern(order, rows=5) == "RGGB"


def test_what_rawpy_says_is_taken_over(tmp_path, monkeypatch):
    """By a stand-in for the library, which is an extra: the test after this one has the library
    itself.
    """
    counts = np.arange(24, dtype=np.uint16).reshape(4, 6)

    class StandInForRawpy:
        raw_image_visible, raw_pattern, color_desc, white_level = (
            counts,
            np.array([[2, 3], [1, 0]]),
            b"RGBG",
            4095,
        )
        raw_colors_visible = np.tile(raw_pattern, (2, 3))
        other = SimpleNamespace(shutter_speed=0.5, focal_length=0.0)

    monkeypatch.setitem(
        sys.modules, "rawpy", SimpleNamespace(imread=lambda file: nullcontext(StandInForRawpy))
    )
    (tmp_path / "a.NEF").write_bytes(b"any")
    image = read_image(tmp_path / "a.NEF")
    np.testing.assert_array_equal(image.data, counts)
    assert (image.mosaic, image.saturation, image.exposure_s, image.header) == (
        "BGGR",
        4095.0,
        0.5,
        {"EXPTIME": 0.5},
    )
    StandInForRawpy.raw_pattern = np.zeros((6, 6), dtype=int)
    with pytest.raises(ImageError):
        read_image(tmp_path / "a.NEF")


def test_raw_files_are_read_as_the_detector_gave_them(tmp_path):
    """By LibRaw, of a DNG file made here from the tags that its standard asks for."""
    pytest.importorskip("rawpy")
    counts = np.random.default_rng(3).integers(100, 4000, (64, 96)).astype("<u2")
    (tmp_path / "a.dng").write_bytes(dng(counts))
    image = read_image(tmp_path / "a.dng")
    np.testing.assert_array_equal(image.data, counts)
    assert (image.mosaic, image.saturation, image.exposure_s) == ("GRBG", 4095.0, 0.5)
    (tmp_path / "a.dng").write_bytes(dng(counts)[:90])
    with pytest.raises(ImageError):
        read_image(tmp_path / "a.dng")


def test_a_gain_without_a_unit_is_not_believed_and_a_mosaic_is_named(tmp_path):
    def made(*extra):
        return read(tmp_path, "zwo.fits", fits((4, 6), bytes(48), *extra))

    setting = made(card("GAIN", 120, "camera setting"), card("BAYERPAT", "'RGGB    '"))
    assert setting.gain_e_per_count is None
    assert "GAIN (120)" in setting.messages[0] and setting.mosaic == "RGGB"
    unknown = made(card("BAYERPAT", "'CYMG    '"))
    assert unknown.mosaic == "" and "mosaic of colours (CYMG)" in unknown.messages[0]
    assert made(card("GAIN", 2.5, "Gain in e-/ADU")).gain_e_per_count == 2.5
    assert made(card("GAIN", 120), card("EGAIN", 0.8)).gain_e_per_count == 0.8


def eighteen(folder):
    """Images of a star each, one of them damaged."""
    rng = np.random.default_rng(4)
    for k in range(18):
        counts = rng.normal(100.0, 3.0, (40, 48))
        counts[5 + k, 20:22] += 200.0
        PIL.Image.fromarray(counts.astype(np.uint16)).save(folder / f"{k:02d}.png")
    (folder / "07.png").write_bytes(b"cut off")


def test_interrupted_centroids_go_on_bit_for_bit(tmp_path, monkeypatch):
    (tmp_path / "img").mkdir()
    eighteen(tmp_path / "img")
    monkeypatch.setattr("starcal_uq.images.extract._WORTH_PROCESSES", 18)
    measured = []
    measure = _Measure.__call__
    monkeypatch.setattr(
        _Measure, "__call__", lambda task, number: measured.append(number) or measure(task, number)
    )
    whole = extract_centroids(tmp_path / "img", workers=0)
    measured.clear()

    def stop(done, _total):
        if done == 11:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        extract_centroids(tmp_path / "img", workers=0, keep=tmp_path, progress=stop)
    found = extract_centroids(tmp_path / "img", workers=0, keep=tmp_path)
    assert measured == list(range(18))
    for name in (*COLUMNS, *FRAME_COLUMNS):
        one, other = getattr(found, name), getattr(whole, name)
        assert (one.tobytes(), one.dtype) == (other.tobytes(), other.dtype), name
    assert (found.messages, found.meta) == (whole.messages, whole.meta)
    # Other options, or another file, start again.
    extract_centroids(tmp_path / "img", workers=0, keep=tmp_path, threshold_sigma=6.0)
    (tmp_path / "img" / "07.png").write_bytes(b"cut")
    extract_centroids(tmp_path / "img", workers=0, keep=tmp_path)
    assert len(measured) == 3 * 18


def test_centroids_do_not_depend_on_the_number_of_processes(tmp_path):
    eighteen(tmp_path)
    done = []
    one, two = (
        extract_centroids(tmp_path, workers=workers, progress=lambda n, of: done.append((n, of)))
        for workers in (0, 2)
    )
    for name in ("frame", "x_px", "y_px", "flux", "image", "problem"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert (
        (one.messages, one.meta) == (two.messages, two.meta)
        and len(one) > 5
        and one.n_left_out == 1
    )
    assert done[-1] == (18, 18)
