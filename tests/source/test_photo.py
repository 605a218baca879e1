"""Every kind of image file against Pillow, and every kind of broken one refused."""

import struct
import zlib

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from zsdata.faults import BadPhoto
from zsdata.source import jpeg, opencv
from zsdata.source.photo import MAX_PIXELS, PhotoFile, decode_photo, decode_rgb, probe_size

from .images import encode, exif, over_white, picture, png, png_chunk

PALETTE = Image.fromarray(picture()).quantize(16)
FRAMES = [Image.fromarray(picture()), Image.fromarray(255 - picture())]
ALPHA_FRAMES = [Image.fromarray(picture(channels=4)), Image.fromarray(255 - picture(channels=4))]

# kind: (file, largest difference to Pillow: both decode JPEG with libjpeg and WebP with libwebp, where versions round chroma differently)
FILES = {
    "jpeg": (encode(picture(), quality=90), 3),
    "jpeg 4:4:4": (encode(picture(), quality=90, subsampling=0), 3),
    "jpeg progressive": (encode(picture(), progressive=True), 3),
    "jpeg grey": (encode(picture(), mode="L"), 1),
    "jpeg cmyk": (encode(picture(), mode="CMYK", quality=95), 4),
    "jpeg restarts": (encode(picture(), restart_marker_blocks=2), 3),
    "png": (encode(picture(), "PNG"), 0),
    "png grey": (encode(picture(), "PNG", "L"), 0),
    "png 1 bit": (encode(picture(), "PNG", "1"), 0),
    "png alpha": (encode(picture(channels=4), "PNG"), 1),
    "png grey alpha": (encode(Image.fromarray(picture(channels=4)).convert("LA"), "PNG"), 1),
    "png palette": (encode(PALETTE, "PNG"), 0),
    "png palette 1 bit": (encode(Image.fromarray(picture()).quantize(2), "PNG", bits=1), 0),
    "png palette with transparency": (encode(PALETTE, "PNG", transparency=bytes(range(0, 256, 17))), 1),
    "png palette with a transparent entry": (encode(PALETTE, "PNG", transparency=3), 1),
    "png transparent colour": (encode(picture(), "PNG", transparency=tuple(int(value) for value in picture()[5, 5])), 0),
    "png transparent grey": (encode(picture()[..., 0], "PNG", transparency=int(picture()[5, 5, 0])), 0),
    "webp": (encode(picture(), "WEBP", quality=90), 3),
    "webp lossless": (encode(picture(), "WEBP", lossless=True), 0),
    "webp alpha": (encode(picture(channels=4), "WEBP", quality=90), 4),
    "webp lossless alpha": (encode(picture(channels=4), "WEBP", lossless=True, exact=True), 1),
    "webp animated": (encode(FRAMES[0], "WEBP", save_all=True, append_images=FRAMES[1:], lossless=True), 0),
    "webp animated lossy": (encode(FRAMES[0], "WEBP", save_all=True, append_images=FRAMES[1:], quality=90), 3),
    "webp animated alpha": (encode(ALPHA_FRAMES[0], "WEBP", save_all=True, append_images=ALPHA_FRAMES[1:], quality=90), 4),
    "png animated": (encode(FRAMES[0], "PNG", save_all=True, append_images=FRAMES[1:]), 0),
    "png animated with a default image": (encode(FRAMES[0], "PNG", save_all=True, append_images=FRAMES[::-1], default_image=True), 0),
}
kinds = pytest.mark.parametrize("data", [data for data, _ in FILES.values()], ids=FILES.keys())


@pytest.mark.parametrize(("data", "tolerance"), FILES.values(), ids=FILES.keys())
def test_every_kind_of_image_looks_as_in_pillow(data, tolerance):
    rgb = decode_rgb(data)
    assert rgb.dtype == np.uint8 and rgb.shape == (37, 51, 3)
    assert np.abs(rgb.astype(int) - over_white(data)).max() <= tolerance
    assert probe_size(data) == (51, 37)


@kinds
def test_decode_photo_is_the_same_with_channels_first(data):
    photo = decode_photo(data)
    assert photo.dtype == torch.uint8 and photo.is_contiguous()
    assert torch.equal(photo, torch.from_numpy(decode_rgb(data)).permute(2, 0, 1))


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
def test_all_eight_orientations_are_applied(kind, orientation):
    options = {"quality": 90} if kind == "JPEG" else {"lossless": True} if kind == "WEBP" else {}
    data = encode(picture(), kind, exif=exif(orientation), **options)
    expected = over_white(data)
    rgb = decode_rgb(data)
    assert rgb.shape == expected.shape == ((51, 37, 3) if orientation >= 5 else (37, 51, 3))
    assert np.abs(rgb.astype(int) - expected).max() <= (3 if kind == "JPEG" else 0)
    assert probe_size(data) == (rgb.shape[1], rgb.shape[0])


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    ("orientation", "kind", "count", "applied"), [(6, 3, 1, 6), (6, 4, 1, 6), (9, 3, 1, 1), (0, 3, 1, 1), (6, 3, 2, 1), (6, 2, 1, 1)]
)
def test_exif_of_either_byte_order_and_senseless_values(order, orientation, kind, count, applied):
    value = struct.pack(order + ("HH" if kind == 3 else "I"), *((orientation, 0) if kind == 3 else (orientation,)))
    body = b"Exif\0\0" + (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "IHHHI", 8, 1, 0x0112, kind, count) + value
    data = with_segment(FILES["jpeg"][0], 0xE1, body)
    assert probe_size(data) == ((37, 51) if applied == 6 else (51, 37))


@given(st.binary(max_size=80))
def test_damaged_exif_costs_no_photo(noise):
    for start in (b"", b"II*\0\x08\0\0\0", b"MM\0*\0\0\0\x08"):
        assert decode_rgb(with_segment(FILES["jpeg"][0], 0xE1, b"Exif\0\0" + start + noise)).size == 37 * 51 * 3


def with_segment(data, marker, body):
    return data[:2] + bytes([0xFF, marker]) + struct.pack(">H", len(body) + 2) + body + data[2:]


def test_sixteen_bits_are_rounded_to_eight():
    values = [0, 127, 128, 129, 257, 385, 386, 32767, 32768, 65405, 65406, 65535]
    expected = [round(value / 257) for value in values]
    grey = png([struct.pack(f">{len(values)}H", *values)], len(values), 16, 0)
    assert decode_rgb(grey)[0].tolist() == [[value] * 3 for value in expected]
    color = png([struct.pack(">6H", 0, 257, 65535, 129, 32768, 300)], 2, 16, 2)
    assert decode_rgb(color)[0].tolist() == [[0, 1, 255], [1, 128, 1]]
    alpha = png([struct.pack(">8H", 0, 257, 65535, 65535, 9, 9, 9, 0)], 2, 16, 6)
    assert decode_rgb(alpha)[0].tolist() == [[0, 1, 255], [255, 255, 255]]
    transparent = png([struct.pack(">3H", 511, 512, 513)], 3, 16, 0, png_chunk(b"tRNS", struct.pack(">H", 512)))
    assert decode_rgb(transparent)[0, :, 0].tolist() == [2, 255, 2]


@pytest.mark.parametrize(("bits", "row"), [(1, b"\xa0"), (2, b"\x1b"), (4, b"\x05\xaf")])
def test_few_bits_fill_the_range_and_know_a_transparent_grey(bits, row):
    width, top = len(row) * 8 // bits if bits > 1 else 4, (1 << bits) - 1
    levels = [int(f"{int.from_bytes(row, 'big'):0{8 * len(row)}b}"[bits * i : bits * (i + 1)], 2) for i in range(width)]
    assert decode_rgb(png([row], width, bits, 0))[0, :, 0].tolist() == [level * 255 // top for level in levels]
    transparent = png([row], width, bits, 0, png_chunk(b"tRNS", struct.pack(">H", levels[1])))
    assert decode_rgb(transparent)[0, :, 0].tolist() == [255 if level == levels[1] else level * 255 // top for level in levels]


def test_an_interlaced_png_is_read():
    interlaced = bytes.fromhex(  # 2 x 2 pixels, Adam7: red, green / blue, white
        "89504e470d0a1a0a"
        + png_chunk(b"IHDR", struct.pack(">IIBBBBB", 2, 2, 8, 2, 0, 0, 1)).hex()
        + png_chunk(b"IDAT", zlib.compress(b"\0\xff\0\0" + b"\0\0\xff\0" + b"\0\0\0\xff\xff\xff\xff")).hex()
        + png_chunk(b"IEND", b"").hex()
    )
    assert decode_rgb(interlaced).tolist() == [[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]]
    assert np.array_equal(decode_rgb(interlaced), over_white(interlaced))


def test_a_webp_frame_smaller_than_its_canvas_lies_on_white():
    data = bytearray(FILES["webp animated"][0])
    canvas = data.index(b"VP8X") + 8 + 4
    data[canvas : canvas + 6] = (60 - 1).to_bytes(3, "little") + (40 - 1).to_bytes(3, "little")
    frame = data.index(b"ANMF") + 8
    data[frame : frame + 6] = (2).to_bytes(3, "little") + (1).to_bytes(3, "little")  # in steps of 2 pixels
    expected = np.full((40, 60, 3), 255, np.uint8)
    expected[2:39, 4:55] = picture()
    assert np.array_equal(decode_rgb(bytes(data)), expected)
    data[frame : frame + 3] = (5).to_bytes(3, "little")
    with pytest.raises(BadPhoto, match="outside of its canvas"):
        decode_rgb(bytes(data))


@kinds
def test_a_cut_off_file_is_refused_and_never_half_a_picture(data):
    needed = len(data)
    for cut in [*range(0, needed, max(1, needed // 150)), *range(max(0, needed - 40), needed)]:
        with pytest.raises(BadPhoto):
            decode_photo(data[:cut])


@kinds
def test_bytes_behind_the_end_do_no_harm(data):
    assert np.array_equal(decode_rgb(data + b"trailing" + bytes(99)), decode_rgb(data))


@kinds
@given(position=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_flipped_bit_gives_a_picture_or_bad_photo_and_nothing_else(data, position, bit):
    damaged = bytearray(data)
    damaged[int(position * len(data))] ^= 1 << bit
    try:
        assert decode_rgb(bytes(damaged)).ndim == 3
    except BadPhoto as fault:
        assert fault.reason


def test_the_end_of_a_thumbnail_is_not_the_end_of_the_photo():
    whole = with_segment(encode(picture(200, 300)), 0xE1, b"Exif\0\0" + encode(picture(20, 30)))
    assert decode_rgb(whole).shape == (200, 300, 3)
    with pytest.raises(BadPhoto, match="a JPEG without its end"):
        decode_rgb(whole[: len(whole) * 2 // 3])


def test_the_second_picture_of_a_jpeg_is_ignored():
    first = encode(picture())
    assert np.array_equal(decode_rgb(first + encode(255 - picture(99, 99))), decode_rgb(first))


def test_a_jpeg_whose_data_are_missing_before_its_end_is_refused():
    whole = encode(picture(200, 300))
    half = whole[: len(whole) * 2 // 3] + b"\xff\xd9"
    assert (cv2.imdecode(np.frombuffer(half, np.uint8), cv2.IMREAD_COLOR)[-1, -1] == 128).all()
    with pytest.raises(BadPhoto, match="data are missing before its end"):
        decode_rgb(half)


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"subsampling": 0}, {"restart_marker_blocks": 1}])
def test_a_photo_that_is_grey_in_its_corner_is_no_damage(options):
    grey = np.full((64, 64, 3), 128, np.uint8)
    grey[:32] = picture(32, 64)
    for image in (grey, np.full((64, 64, 3), 128, np.uint8), grey[..., 0].copy()):
        assert (decode_rgb(encode(image, **options))[-1, -1] == 128).all()


def test_a_flipped_bit_in_a_png_is_found_by_its_checksum():
    data = bytearray(FILES["png"][0])
    data[data.index(b"IDAT") + 30] ^= 1
    with pytest.raises(BadPhoto, match="wrong checksum of the PNG chunk 'IDAT'"):
        decode_rgb(bytes(data))


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_a_png_that_lacks_rows_is_refused(share):
    rows = [bytes(range(60))] * int(20 * share)
    short = png(rows, 20, 8, 2).replace(png_chunk(b"IHDR", struct.pack(">IIBBBBB", 20, len(rows), 8, 2, 0, 0, 0)),
                                        png_chunk(b"IHDR", struct.pack(">IIBBBBB", 20, 20, 8, 2, 0, 0, 0)))  # fmt: skip
    assert probe_size(short) == (20, 20)
    with pytest.raises(BadPhoto, match="cannot be decoded"):
        decode_rgb(short)


def bomb(kind, width, height):
    if kind == "JPEG":
        data = bytearray(encode(picture()))
        at = data.index(b"\xff\xc0") + 5
        data[at : at + 4] = struct.pack(">HH", height, width)
        return bytes(data)
    if kind == "PNG":
        data = FILES["png"][0]
        return data[:8] + png_chunk(b"IHDR", struct.pack(">II", width, height) + data[24:29]) + data[33:]
    data = bytearray(FILES["webp animated"][0])
    at = data.index(b"VP8X") + 12
    data[at : at + 6] = (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    return bytes(data)


@pytest.mark.parametrize(
    ("kind", "width", "height"),
    [("JPEG", 65500, 65500), ("PNG", 2**31 - 1, 1), ("PNG", 70_000, 10), ("PNG", 10_001, 10_000), ("WEBP", 2**24, 2**24)],
)
def test_what_is_too_large_is_refused_before_anything_is_decoded(kind, width, height, monkeypatch):
    data = bomb(kind, width, height)
    monkeypatch.setattr(cv2, "imdecode", None)
    for look in (decode_photo, decode_rgb, probe_size):
        with pytest.raises(BadPhoto, match=f"too large: {width:,} x {height:,} pixels, at most {MAX_PIXELS // 10**6} megapixels"):
            look(data)


@pytest.mark.parametrize(("kind", "width", "height"), [("JPEG", 0, 10), ("JPEG", 10, 0), ("PNG", 0, 5)])
def test_a_photo_without_pixels_is_refused(kind, width, height):
    with pytest.raises(BadPhoto, match=f"damaged: {width} x {height} pixels"):
        decode_rgb(bomb(kind, width, height))


@pytest.mark.parametrize("alpha", [b"", b"ALPH\2\0\0\0\0\0"])
@pytest.mark.parametrize(("width", "height"), [(0, 10), (10, 0), (0, 0)])
def test_a_webp_without_pixels_is_refused(width, height, alpha):
    lossy = FILES["webp"][0]
    at = lossy.index(b"\x9d\x01\x2a") + 3
    body = alpha + lossy[12:at] + struct.pack("<HH", width, height) + lossy[at + 4 :]
    data = b"RIFF" + struct.pack("<I", len(body) + 4) + b"WEBP" + body
    for look in (decode_rgb, probe_size):
        with pytest.raises(BadPhoto, match=f"damaged: {width} x {height} pixels"):
            look(data)


def tiny(kind):
    return encode(picture(), kind)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (tiny("GIF"), "not a JPEG, PNG or WebP: GIF"),
        (tiny("BMP"), "not a JPEG, PNG or WebP: BMP"),
        (tiny("TIFF"), "not a JPEG, PNG or WebP: TIFF"),
        (tiny("JPEG2000"), "not a JPEG, PNG or WebP: JPEG 2000"),
        (b"\0\0\0\x18ftypheic\0\0\0\0mif1heic", "not a JPEG, PNG or WebP: HEIC"),
        (b"\0\0\0\x18ftypavif", "not a JPEG, PNG or WebP: AVIF"),
        (b"%PDF-1.4", "not a JPEG, PNG or WebP: PDF"),
        (b"<!DOCTYPE html><html>", "not a JPEG, PNG or WebP: HTML or XML"),
        (b"RIFF\x10\0\0\0WAVEfmt ", "not a JPEG, PNG or WebP: unknown format"),
        (b"hello", "not a JPEG, PNG or WebP: unknown format"),
        (b"", "empty file"),
        (bytes(100), "only zeros"),
    ],
)
def test_other_files_are_refused_by_name(data, reason):
    for look in (decode_photo, probe_size, PhotoFile):
        with pytest.raises(BadPhoto) as caught:
            look(data)
        assert caught.value.reason == reason


@given(st.binary(max_size=200))
def test_noise_behind_a_signature_is_refused(noise):
    for start in (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"RIFF\x40\0\0\0WEBP", b"RIFF\0\0\0\0WEBPVP8X\x0a\0\0\0", b""):
        with pytest.raises(BadPhoto):
            decode_rgb(start + noise)


def test_anything_but_bytes_is_an_error():
    with pytest.raises(TypeError, match="bytes of a file, got str"):
        decode_photo("photo.jpg")


def test_the_extension_is_that_of_the_content():
    assert [PhotoFile(FILES[kind][0]).extension for kind in ("jpeg", "png", "webp")] == ["jpg", "png", "webp"]


def test_decoding_looks_at_the_picture_once(monkeypatch):
    calls = []
    decode = jpeg.decode_color
    monkeypatch.setattr(jpeg, "decode_color", lambda *arguments: calls.append(1) or decode(*arguments))
    decode_rgb(encode(picture(200, 300)))
    assert len(calls) == 1


def pieces(*parts):
    return st.lists(st.one_of(st.sampled_from(parts), st.binary(max_size=20)), max_size=8).map(b"".join)


JPEG_PIECES = pieces(
    *(FILES["jpeg"][0][start:end] for start, end in ((2, 20), (20, 158), (158, 177), (177, 600), (-300, -2))),
    b"\xff\xd9",
    b"\xff\xda\0\x0c\3\1\0\2\x11\3\x11\0\x3f\0",
    b"\xff\xc0\0\x0b\x08\0\x10\0\x10\1\1\x11\0",
    b"\xff\xff\xff",
    b"\xff\xe1\0\x08Exif\0\0",
)
PNG_PIECES = pieces(
    png_chunk(b"IHDR", struct.pack(">IIBBBBB", 3, 2, 8, 2, 0, 0, 0)),
    png_chunk(b"IHDR", struct.pack(">IIBBBBB", 3, 2, 16, 6, 0, 0, 1)),
    png_chunk(b"IDAT", zlib.compress(bytes(20))),
    png_chunk(b"PLTE", bytes(6)),
    png_chunk(b"tRNS", b"\0\1"),
    png_chunk(b"eXIf", b"II*\0"),
    png_chunk(b"IEND", b""),
    png_chunk(b"acTL", bytes(8)),
)
WEBP_PIECES = pieces(
    FILES["webp"][0][12:], FILES["webp lossless"][0][12:], FILES["webp animated"][0][12:], FILES["webp"][0][12:30],
    b"VP8X\x0a\0\0\0\2\0\0\0" + bytes(6), b"ALPH\4\0\0\0\0\0\0\0", b"EXIF\2\0\0\0II",
)  # fmt: skip


@given(
    st.one_of(
        JPEG_PIECES.map(b"\xff\xd8\xff".__add__),
        PNG_PIECES.map(b"\x89PNG\r\n\x1a\n".__add__),
        WEBP_PIECES.map(lambda body: b"RIFF" + struct.pack("<I", len(body) + 4) + b"WEBP" + body),
    )
)
@settings(max_examples=600)
def test_a_file_of_any_pieces_has_a_size_within_limits_and_a_picture_of_that_size_or_a_reason(data):
    try:
        width, height = probe_size(data)
    except BadPhoto as fault:
        assert fault.reason
        with pytest.raises(BadPhoto):
            decode_rgb(data)
        return
    assert 0 < width * height <= MAX_PIXELS
    try:
        assert decode_rgb(data).shape == (height, width, 3)
    except BadPhoto as fault:
        assert fault.reason


def test_without_opencvs_own_rgb_the_colours_are_the_same(monkeypatch):
    whole = decode_rgb(FILES["jpeg"][0])
    monkeypatch.setattr(opencv, "_RGB", None)  # before OpenCV 4.11
    assert np.array_equal(decode_rgb(FILES["jpeg"][0]), whole)


def test_no_memory_is_no_fault_of_the_photo(monkeypatch):
    def fail(code):
        def imdecode(data, flags):
            error = cv2.error("failed")
            error.code = code
            raise error

        return imdecode

    monkeypatch.setattr(cv2, "imdecode", fail(cv2.Error.StsNoMem))
    with pytest.raises(MemoryError, match="no memory to decode a photo"):
        decode_rgb(FILES["jpeg"][0])
    monkeypatch.setattr(cv2, "imdecode", fail(cv2.Error.StsAssert))
    with pytest.raises(BadPhoto, match="cannot be decoded"):
        decode_rgb(FILES["jpeg"][0])


def test_a_decoder_that_gives_something_else_is_not_believed(monkeypatch):
    monkeypatch.setattr(cv2, "imdecode", lambda data, flags: np.zeros((5, 5, 3), np.float32))
    with pytest.raises(BadPhoto, match=r"decodes to float32 \(5, 5, 3\)"):
        decode_rgb(FILES["png alpha"][0])
    monkeypatch.setattr(cv2, "imdecode", lambda data, flags: np.zeros((5, 6, 3), np.uint8))
    with pytest.raises(BadPhoto, match="6 x 5 pixels where the header says 51 x 37"):
        decode_rgb(FILES["png"][0])
    with pytest.raises(BadPhoto, match="where the header says 51 x 37, at one part in 2"):
        decode_rgb(FILES["jpeg"][0], reduction=2)


def test_a_large_photo_that_is_decoded_at_a_part_needs_the_memory_of_that_part():
    grey = encode(np.full((9000, 9000), 99, np.uint8))
    with pytest.raises(BadPhoto, match="too large: 9,000 x 9,000 pixels take 486 MB to decode, at most 380"):
        decode_rgb(grey)
    assert probe_size(grey) == (9000, 9000)
    assert decode_rgb(grey, reduction=8).shape == (1125, 1125, 3)
