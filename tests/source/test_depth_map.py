"""Depth maps that lie beside photos: their values, their sides, and what is refused by which name."""

import struct
import tracemalloc

import cv2
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from zsdata.faults import BadPhoto
from zsdata.source.depth_map import DepthMap, decode_depth
from zsdata.source.photo import MAX_SIDE, PhotoHeader, decode_rgb, probe_photo

from ..scenes import grey16, npy
from .images import encode, exif, picture, png_chunk

HEIGHT, WIDTH = 37, 51
UPRIGHT = PhotoHeader(WIDTH, HEIGHT, 1)
RAMP = np.arange(HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
SIGNATURE = b"\x89PNG\r\n\x1a\n"


def header_only(descr="'<f4'", shape="(37, 51)", order="False", version=b"\1\0"):
    text = f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY" + version + struct.pack("<H" if version[0] == 1 else "<I", len(text)) + text


@pytest.mark.parametrize("dtype", ["<f2", ">f2", "<f4", ">f4", "<f8", ">f8", "<u2", ">u2"])
@pytest.mark.parametrize("by_columns", [False, True])
def test_numbers_of_each_kind_come_back_as_they_are(dtype, by_columns):
    values = RAMP.astype(dtype)
    depth = decode_depth(npy(np.asfortranarray(values) if by_columns else values), UPRIGHT)
    assert depth.dtype == np.float32 and depth.flags.c_contiguous and depth.flags.writeable
    assert np.array_equal(depth, values.astype(np.float32))


@pytest.mark.parametrize("version", [(1, 0), (2, 0), (3, 0)])
def test_npy_files_of_each_version_are_read(version):
    import io

    stream = io.BytesIO()
    np.lib.format.write_array(stream, RAMP, version=version)
    assert np.array_equal(decode_depth(stream.getvalue(), UPRIGHT), RAMP)


def test_a_grey_png_of_16_bits_comes_back_as_it_is():
    values = (RAMP * 30).astype(np.uint16)
    assert np.array_equal(decode_depth(grey16(values), UPRIGHT), values.astype(np.float32))


@pytest.mark.parametrize("values", [RAMP - 1000, RAMP * 1e30, RAMP * 1e-30, np.where(RAMP < 500, 0, RAMP).astype(np.float32)])
def test_scale_and_offset_are_free_and_zero_is_a_value_like_any_other(values):
    assert np.array_equal(decode_depth(npy(values), UPRIGHT), values)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("shrink", [1, 2])
def test_the_map_has_the_pixels_of_the_photos_file_and_is_turned_with_it(orientation, shrink):
    values = picture(HEIGHT, WIDTH)[..., 0]
    photo = encode(np.dstack([values] * 3), "PNG", exif=exif(orientation))
    if shrink > 1:
        small = cv2.resize(values.astype(np.float32), (26, 19), interpolation=cv2.INTER_AREA)
    else:
        small = values.astype(np.float32)
    depth, seen = decode_depth(npy(small), probe_photo(photo)), decode_rgb(photo)[..., 0]
    assert depth.shape == seen.shape == ((WIDTH, HEIGHT) if orientation >= 5 else (HEIGHT, WIDTH))
    assert np.abs(depth - seen).max() <= (0 if shrink == 1 else 8)


def test_a_smaller_map_of_the_photos_proportions_is_enlarged_bilinearly():
    values = RAMP[:19, :26].copy()
    assert np.array_equal(decode_depth(npy(values), UPRIGHT), cv2.resize(values, (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR))


@pytest.mark.parametrize(("photo", "depth"), [((640, 480), (686, 518)), ((640, 427), (574, 378)), ((1920, 1080), (672, 384))])
def test_sides_in_whole_patches_fit_and_a_larger_map_does_not(photo, depth):
    width, height = depth
    data = npy(np.tile(np.arange(width, dtype=np.float16), (height, 1)))
    if depth > photo:
        with pytest.raises(BadPhoto, match=f"^stored depth does not fit: the photo has 640 x 480 .* the depth map {width} x {height}; it"):
            decode_depth(data, PhotoHeader(photo[0], photo[1], 1))
    else:
        assert decode_depth(data, PhotoHeader(photo[0], photo[1], 1)).shape == photo[::-1]


@pytest.mark.parametrize("sides", [(HEIGHT + 1, WIDTH), (HEIGHT, WIDTH + 1), (HEIGHT, WIDTH // 2), (10, 40), (WIDTH, HEIGHT), (1, 1)])
def test_a_map_of_other_sides_is_refused_with_both_sizes(sides):
    height, width = sides
    with pytest.raises(BadPhoto) as fault:
        decode_depth(npy(np.random.default_rng(0).random(sides, np.float32)), UPRIGHT)
    assert fault.value.reason == (
        f"stored depth does not fit: the photo has 51 x 37 pixels as stored, the depth map {width} x {height}; it must have the photo's "
        "size, or be a smaller one of its proportions"
    )


def test_a_map_of_the_turned_photo_is_refused_with_the_reason():
    with pytest.raises(
        BadPhoto, match="does not fit: the photo has 51 x 37 pixels as stored, the depth map 37 x 51; it seems to be of the"
    ):
        decode_depth(npy(RAMP.T), PhotoHeader(HEIGHT, WIDTH, 6))


def with_value(value):
    values = RAMP.copy()
    values[3, 5] = value
    return npy(values)


GREY = "stored depth of another kind: a PNG of 16-bit grey is needed, this is "
PNG16 = grey16((RAMP * 30).astype(np.uint16))
DAMAGED, OTHER, FLAT, INFINITE = (f"stored depth {word}" for word in ("damaged: ", "of another kind: ", "flat: ", "not finite: "))
REFUSED = {
    "nothing": (b"", DAMAGED + "empty file"),
    "a photo": (encode(picture()), OTHER + "neither a PNG nor an NPY file"),
    "a zip of arrays": (b"PK\x03\x04", OTHER + "neither"),
    "NaN": (with_value(np.nan), INFINITE + "NaN or infinity at 1 of 1,887 pixels"),
    "infinity": (with_value(np.inf), INFINITE + "NaN or infinity at 1 of"),
    "more than float32": (npy(RAMP.astype(np.float64) * 1e300), INFINITE + "NaN or infinity at 1,886 of"),
    "a range beyond float32": (npy(np.where(RAMP > 900, 3e38, -3e38).astype(np.float32)), INFINITE + "from -3e+38 to 3e+38"),
    "constant": (npy(RAMP * 0 + 7), FLAT + "7 at every pixel"),
    "constant PNG": (grey16(np.zeros((HEIGHT, WIDTH), np.uint16)), FLAT + "0 at every pixel"),
    "grey of 8 bits": (grey16(RAMP.astype(np.uint8)), GREY + "8-bit grey"),
    "colour of 16 bits": (grey16(np.dstack([(RAMP * 30).astype(np.uint16)] * 3)), GREY + "16-bit RGB"),
    "palette": (encode(picture(), "PNG", mode="P"), GREY + "8-bit palette"),
    "alpha": (encode(picture(channels=4), "PNG"), GREY + "8-bit RGB with alpha"),
    "a transparent grey": (PNG16[:33] + png_chunk(b"tRNS", b"\0\1") + PNG16[33:], GREY + "16-bit grey "),
    "half a PNG": (PNG16[: len(PNG16) // 2], DAMAGED),
    "a PNG without pixels": (SIGNATURE + PNG16[8:33] + png_chunk(b"IEND", b""), DAMAGED + "a PNG without"),
    "a PNG of no width": (SIGNATURE + png_chunk(b"IHDR", struct.pack(">IIBBBBB", 0, 5, 16, 0, 0, 0, 0)) + PNG16[33:], DAMAGED + "0 x 5"),
    "a PNG of noise": (
        SIGNATURE + PNG16[8:33] + png_chunk(b"IDAT", b"noise") + png_chunk(b"IEND", b""),
        DAMAGED,
    ),
    "half an NPY": (npy(RAMP)[:600], DAMAGED + "472 bytes for 51 x 37 values of 4"),
    "bytes too many": (npy(RAMP) + b"\0", DAMAGED + "7,549 bytes for 51 x 37 values of 4"),
    "a header cut off": (npy(RAMP)[:60], DAMAGED + "no NPY header"),
    "a header of 60 kB": (b"\x93NUMPY\1\0\xff\xff" + bytes(70_000), DAMAGED + "no NPY header"),
    "a header of 4 GB": (b"\x93NUMPY\2\0\xff\xff\xff\xff" + bytes(70_000), DAMAGED + "no NPY header"),
    "a version to come": (header_only(version=b"\4\0"), DAMAGED + "no NPY header"),
    "a header of nonsense": (b"\x93NUMPY\1\0\4\0{1:2", DAMAGED + "no dtype, order or shape"),
    "a pickle": (npy(np.array([[{"a": 1}]], object)), OTHER + "float16, float32, float64 or uint16 [h, w] is needed, this is |O [1, 1]"),
    "a structure": (npy(np.zeros((2, 2), [("a", "<f4")])), OTHER),
    "whole numbers": (npy(RAMP.astype(np.int32)), OTHER + "float16, float32, float64 or uint16 [h, w] is needed, this is <i4 [37, 51]"),
    "bytes": (npy(RAMP.astype(np.uint8)), OTHER),
    "truth values": (npy(RAMP > 5), OTHER),
    "complex": (npy(RAMP.astype(np.complex64)), OTHER),
    "three axes": (npy(RAMP[None]), OTHER + "float16, float32, float64 or uint16 [h, w] is needed, this is <f4 [1, 37, 51]"),
    "one axis": (npy(RAMP.ravel()), OTHER),
    "no axis": (npy(np.array(1, np.float32)), OTHER),
    "no rows": (npy(RAMP[:0]), DAMAGED + "51 x 0 values"),
    "negative sides": (header_only(shape="(-37, -51)"), OTHER),
    "sides that are no numbers": (header_only(shape="(__import__('os'), 5)"), OTHER),
    "sides of a bomb": (header_only(shape="(999999999, 999999999)"), DAMAGED + "0 bytes for 999,999,999 x 999,999,999 values"),
    "a strip": (npy(np.zeros((1, MAX_SIDE + 1), np.float16)), "stored depth too large: 65,536 x 1 values take 0 MB"),
    "a PNG bomb": (
        SIGNATURE + png_chunk(b"IHDR", struct.pack(">IIBBBBB", 60_000, 60_000, 16, 0, 0, 0, 0)) + PNG16[33:],
        "stored depth too large: 60,000 x 60,000 values take 21,600 MB",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_depth_map_is_refused_by_name_before_it_takes_memory(name):
    data, reason = REFUSED[name]
    tracemalloc.start()
    try:
        with pytest.raises(BadPhoto) as fault:
            DepthMap.parse(data).decode()
        assert fault.value.reason.startswith(reason), fault.value.reason
        assert fault.value.reason.isprintable()
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()


def test_memory_is_counted_before_it_is_taken():
    data = header_only(descr="'<f2'", shape="(9000, 9000)") + bytes(2 * 9000 * 9000)
    with pytest.raises(BadPhoto, match="too large: 9,000 x 9,000 values take 486 MB, at most 380"):
        DepthMap.parse(data)


@given(st.binary(max_size=200), st.sampled_from([b"", b"\x93NUMPY\1\0", header_only(), SIGNATURE, PNG16[:60]]))
@example(b"", npy(RAMP)[:128])
def test_noise_is_refused_as_a_bad_photo(noise, start):
    with pytest.raises(BadPhoto):
        decode_depth(start + noise, UPRIGHT)


@given(st.integers(0, len(PNG16) - 1), st.integers(0, 7))
def test_a_flipped_bit_in_a_png_is_found(place, bit):
    damaged = bytearray(PNG16)
    damaged[place] ^= 1 << bit
    with pytest.raises(BadPhoto):
        decode_depth(bytes(damaged), UPRIGHT)
