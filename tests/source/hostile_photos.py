"""Odd and hostile image files, made the same each time, and what a sensible user expects of each."""

# ruff: noqa: E501  one file a line
from __future__ import annotations

import gzip
import io
import pickle
import random
import struct
import zlib
from functools import cache
from typing import NamedTuple

import numpy as np
from PIL import Image

from ..scenes import photo
from .images import encode, exif, picture, png, png_chunk

HEIGHT, WIDTH = 37, 51
PNG_START = b"\x89PNG\r\n\x1a\n"
EITHER = "a picture, or refused"  # damage that the format cannot show: JPEG and WebP have no checksums


class Odd(NamedTuple):
    """A file, and either the (width, height) of the picture that is expected of it, or how the reason for its refusal begins."""

    data: bytes
    expected: tuple[int, int] | str


@cache
def hostile_photos() -> dict[str, Odd]:
    """All of them, by name."""
    return {
        **_unusual_but_good(),
        **_cut(),
        **_flipped(),
        **_lying(),
        **_bombs(),
        **_damaged_jpegs(),
        **_damaged_pngs(),
        **_damaged_webps(),
        **_not_photos(),
    }


class Canary:
    """Leaves a file behind where it is unpickled."""

    def __reduce__(self):
        return (open, ("executed", "w"))


SIZE = (WIDTH, HEIGHT)
JPEG = encode(picture(), quality=90)
PROGRESSIVE = encode(picture(), progressive=True)
PNG = encode(picture(), "PNG")
ALPHA = picture(channels=4)
WEBP = encode(picture(), "WEBP", quality=90)
LOSSLESS = encode(picture(), "WEBP", lossless=True)
ANIMATED = encode(
    Image.fromarray(picture()), "WEBP", save_all=True, append_images=[Image.fromarray(255 - picture())], lossless=True
)  # fmt: skip


def _unusual_but_good() -> dict[str, Odd]:
    frames = [Image.fromarray(picture()), Image.fromarray(255 - picture())]
    one = np.zeros((1, 1, 3), np.uint8)
    files = {
        "grey jpeg": encode(picture(), mode="L"),
        "cmyk jpeg": encode(picture(), mode="CMYK"),
        "progressive jpeg": PROGRESSIVE,
        "jpeg with restarts": encode(picture(), restart_marker_blocks=1),
        "jpeg 4:1:1": encode(picture(), subsampling=2),
        "jpeg of quality 1": encode(picture(), quality=1),
        "jpeg of quality 100": encode(picture(), quality=100),
        "jpeg without JFIF": JPEG[:2] + JPEG[2 + 18 :],
        "jpeg with fill bytes": JPEG[:2] + b"\xff" * 1000 + JPEG[2:],
        "jpeg with a second picture": JPEG + encode(255 - picture(99, 99)),
        "jpeg with a video behind it": JPEG + random.Random(0).randbytes(100_000),
        "jpeg with zeros behind it": JPEG + bytes(4096),
        "jpeg with a thumbnail": segment(JPEG, 0xE1, b"Exif\0\0" + encode(picture(8, 8))),
        "jpeg with a long profile": segment(JPEG, 0xE2, *[b"ICC_PROFILE\0" + bytes(65_000)] * 50),
        "jpeg with EXIF in a circle": segment(JPEG, 0xE1, b"Exif\0\0II*\0\x08\0\0\0\x01\0\x69\x87\x04\0\x01\0\0\0\x08\0\0\0\x08\0\0\0"),
        "jpeg with EXIF of 65535 entries": segment(JPEG, 0xE1, b"Exif\0\0II*\0\x08\0\0\0\xff\xff" + bytes(60_000)),
        "jpeg with EXIF beyond its end": segment(JPEG, 0xE1, b"Exif\0\0MM\0*\xff\xff\xff\xff"),
        "png of 16 bits": png([struct.pack(f">{3 * WIDTH}H", *range(0, 600 * WIDTH, 200))] * HEIGHT, WIDTH, 16, 2),
        "png grey with alpha": encode(Image.fromarray(ALPHA).convert("LA"), "PNG"),
        "png with alpha": encode(ALPHA, "PNG"),
        "png of 1 bit": encode(picture(), "PNG", "1"),
        "png palette": encode(Image.fromarray(picture()).quantize(9), "PNG", transparency=3),
        "png animation": encode(frames[0], "PNG", save_all=True, append_images=frames[1:]),
        "png in many pieces": in_pieces(PNG),
        "png with an empty piece": PNG.replace(png_chunk(b"IEND", b""), png_chunk(b"IDAT", b"") + png_chunk(b"IEND", b"")),
        "png with bytes behind it": PNG + b"more",
        "webp with alpha": encode(ALPHA, "WEBP", quality=80),
        "webp lossless with alpha": encode(ALPHA, "WEBP", lossless=True),
        "webp animation": ANIMATED,
        "webp with bytes behind it": WEBP + b"more",
    }  # fmt: skip
    good = {name: Odd(data, SIZE) for name, data in files.items()}
    for kind in ("JPEG", "PNG", "WEBP"):
        good[f"{kind} of one pixel"] = Odd(encode(one, kind), (1, 1))
        good[f"{kind} one pixel high"] = Odd(encode(picture(1, 3000), kind), (3000, 1))
        good[f"{kind} on its side"] = Odd(encode(picture(), kind, exif=exif(6)), (HEIGHT, WIDTH))
        good[f"{kind} with a senseless orientation"] = Odd(encode(picture(), kind, exif=exif(9)), SIZE)
    return good


def _cut() -> dict[str, Odd]:
    """Cut off behind the signature, in the header, in the tables, in the pixels, and just before the end."""
    files = {}
    whole = {"jpeg": JPEG, "progressive": PROGRESSIVE, "png": PNG, "webp": WEBP, "lossless webp": LOSSLESS, "animated webp": ANIMATED}
    for kind, data in whole.items():
        places = [*(data.find(marker) for marker in STRUCTURE[kind]), len(data) // 2, len(data) - 20, len(data) - 2, len(data) - 1]
        for place in sorted(places):
            files[f"{kind} cut at {place}"] = Odd(data[:place], "truncated")
        files[f"{kind} cut at 3"] = Odd(data[:3], "truncated" if "webp" not in kind and kind != "png" else "not a JPEG, PNG or WebP")
    files["jpeg half, with an end"] = Odd(encode(picture(200, 300))[:4000] + b"\xff\xd9", "truncated")
    return files


STRUCTURE = {
    "jpeg": (b"\xff\xdb", b"\xff\xc0", b"\xff\xc4", b"\xff\xda"),
    "progressive": (b"\xff\xc2", b"\xff\xc4", b"\xff\xda"),
    "png": (b"IHDR", b"IDAT", b"IEND"),
    "webp": (b"VP8 ",),
    "lossless webp": (b"VP8L",),
    "animated webp": (b"VP8X", b"ANMF", b"VP8L"),
}


def _flipped() -> dict[str, Odd]:
    files = {}
    for kind, data, expected in (
        ("jpeg", JPEG, EITHER),
        ("png", PNG, "damaged"),
        ("webp", WEBP, EITHER),
        ("lossless webp", LOSSLESS, EITHER),
    ):
        chance = random.Random(1)
        for _ in range(4):
            place = chance.randrange(40, len(data) - 1)
            files[f"{kind} with bit {place} flipped"] = Odd(changed(data, place, data[place] ^ 1 << chance.randrange(8)), expected)
    return files


def _lying() -> dict[str, Odd]:
    frame, canvas, bitstream = JPEG.index(b"\xff\xc0"), ANIMATED.index(b"VP8X") + 12, WEBP.index(b"\x9d\x01\x2a") + 3
    files = {
        "jpeg says 65500 x 65500": (over(JPEG, frame + 5, struct.pack(">HH", 65500, 65500)), "too large"),
        "jpeg says no height": (over(JPEG, frame + 5, b"\0\0"), "damaged"),
        "jpeg says no width": (over(JPEG, frame + 7, b"\0\0"), "damaged"),
        "jpeg says twice its height": (over(JPEG, frame + 5, struct.pack(">H", 2 * HEIGHT)), "truncated"),
        "jpeg says 12 bits": (over(JPEG, frame + 4, b"\x0c"), "not supported: a JPEG of 12 bits"),
        "jpeg says arithmetic coding": (over(JPEG, frame + 1, b"\xc9"), "not supported"),
        "jpeg says lossless": (over(JPEG, frame + 1, b"\xc3"), "not supported"),
        "jpeg says hierarchical": (over(JPEG, frame + 1, b"\xc5"), "not supported"),
        "jpeg says two channels": (over(JPEG, frame + 9, b"\x02"), "damaged: a JPEG of 2 channels"),
        "jpeg says five channels": (over(JPEG, frame + 9, b"\x05"), "damaged"),
        "jpeg says 255 channels": (over(JPEG, frame + 9, b"\xff"), "damaged"),
        "jpeg says no sampling": (over(JPEG, frame + 11, b"\0"), "damaged"),
        "jpeg segment without length": (over(JPEG, 4, b"\0\0"), "damaged"),
        "jpeg segment beyond the end": (over(JPEG, 4, b"\xff\xff"), "truncated"),
        "png says 2^31 x 1": (with_size(PNG, 2**31 - 1, 1), "too large"),
        "png says 2^32 x 2^32": (with_size(PNG, 2**32 - 1, 2**32 - 1), "too large"),
        "png says 0 x 5": (with_size(PNG, 0, 5), "damaged"),
        "png says twice its height": (with_size(PNG, WIDTH, 2 * HEIGHT), "damaged"),
        "png says twice its width": (with_size(PNG, 2 * WIDTH, HEIGHT), "damaged"),
        "png chunk of 2^31 bytes": (over(PNG, 33, struct.pack(">I", 2**31 - 1)), "truncated"),
        "png chunk of 2^32 bytes": (over(PNG, 33, b"\xff" * 4), "truncated"),
        "webp says 2^24 x 2^24": (over(ANIMATED, canvas, b"\xff" * 6), "too large"),
        "webp says another size": (over(WEBP, bitstream, struct.pack("<HH", 16383, 16383)), "too large"),
        "webp of no width": (over(WEBP, bitstream, bytes(2)), "damaged: 0 x"),
        "webp of no width with alpha": (webp(chunk(b"ALPH", bytes(2)) + over(WEBP, bitstream, bytes(2))[12:]), "damaged: 0 x"),
        "webp file of 2^32 bytes": (over(WEBP, 4, b"\xff" * 4), "truncated"),
        "webp file of no bytes": (over(WEBP, 4, b"\0" * 4), "damaged"),
        "webp chunk of 2^32 bytes": (over(WEBP, 16, b"\xff" * 4), "truncated"),
        "webp frame outside": (over(ANIMATED, ANIMATED.index(b"ANMF") + 8, b"\xff\xff\xff"), "damaged"),
        "webp of two pictures": (webp(LOSSLESS[12:] + WEBP[12:]), "damaged: a WebP with two pictures"),
        "webp of a small and a hidden large picture": (webp(over(WEBP, bitstream, b"\xff\x3f\xff\x3f")[12:] + LOSSLESS[12:]), "damaged"),
    }  # fmt: skip
    return {name: Odd(*odd) for name, odd in files.items()}


def _bombs() -> dict[str, Odd]:
    side = 7900  # 62.4 megapixels: nearly what a decoder is allowed
    rows = zlib.compress(bytes(1 + (side + 7) // 8) * side)
    zeros = zlib.compress(bytes(100_000_000))
    scan = PROGRESSIVE[PROGRESSIVE.rindex(b"\xff\xda") : -2]
    wide = np.zeros((side, side), np.uint8)
    text = lambda kind, body: PNG[:33] + png_chunk(kind, body) + PNG[33:]  # noqa: E731
    files = {
        "png of 62 megapixels in 1 bit": (raw_png(side, side, 1, 0, rows), (side, side)),
        "png of 10^9 pixels": (raw_png(60_000, 20_000, 1, 0, zeros), "too large"),
        "png of 62 megapixels in 16 bits and alpha": (raw_png(side, side, 16, 6, zeros), "too large"),
        "png of 40 megapixels in 16 bits and alpha": (raw_png(6300, 6300, 16, 6, zlib.compress(bytes((1 + 6300 * 8) * 6300))), "too large"),
        "png of 23 megapixels in 16 bits and alpha": (raw_png(4800, 4800, 16, 6, zlib.compress(bytes((1 + 4800 * 8) * 4800))), (4800, 4800)),
        "png of 46 megapixels and alpha": (raw_png(6800, 6800, 8, 6, zlib.compress(bytes((1 + 6800 * 4) * 6800))), (6800, 6800)),
        "png with pixels for 100 MB more": (raw_png(WIDTH, HEIGHT, 8, 2, zeros), SIZE),
        "png with a text bomb": (text(b"zTXt", b"Comment\0\0" + zeros), SIZE),
        "png with an international text bomb": (text(b"iTXt", b"Comment\0\1\0\0\0" + zeros), SIZE),
        "png with a profile bomb": (text(b"iCCP", b"profile\0\0" + zeros), SIZE),
        "png with 100 000 texts": (PNG[:33] + png_chunk(b"tEXt", b"a\0b") * 100_000 + PNG[33:], SIZE),
        "png with 2 000 000 texts": (PNG[:33] + png_chunk(b"tEXt", b"") * 2_000_000 + PNG[33:], "damaged: a PNG of more than"),
        "png with 60 MB of text": (text(b"tEXt", b"Comment\0" + b"x" * 60_000_000), SIZE),
        "jpeg of 62 megapixels": (encode(wide), (side, side)),
        "jpeg of 62 megapixels on its side": (encode(wide, exif=exif(6)), (side, side)),
        "progressive jpeg of 62 megapixels in 4:4:4": (
            encode(np.zeros((side, side, 3), np.uint8), progressive=True, subsampling=0), "too large: 7,900 x 7,900 pixels take"),
        "progressive jpeg of 30 megapixels in 4:4:4": (
            encode(np.zeros((5500, 5500, 3), np.uint8), progressive=True, subsampling=0), (5500, 5500)),
        "jpeg of 100 megapixels": (over(JPEG, JPEG.index(b"\xff\xc0") + 5, struct.pack(">HH", 10_000, 9_990)), "too large"),
        "jpeg of 20 000 scans": (PROGRESSIVE[:-2] + scan * 20_000 + b"\xff\xd9", "damaged: a JPEG of more than"),
        "jpeg of 20 000 scans, hidden behind an end": (
            PROGRESSIVE[:-2] + b"\xff\xfe\0\6\xff\xd9\xff\xd9" + scan * 20_000 + b"\xff\xd9", "damaged: a JPEG of more than"),
        "jpeg of 500 comments": (segment(JPEG, 0xFE, *[b"x" * 65_000] * 500), SIZE),
        "jpeg of 100 000 comments": (segment(JPEG, 0xFE, *[b""] * 100_000), "damaged: a JPEG header of more than"),
        "jpeg with 20 MB of fill bytes": (JPEG[:2] + b"\xff" * 20_000_000 + JPEG[2:], SIZE),
        "webp of 62 megapixels": (encode(wide, "WEBP", mode="RGB", lossless=True, quality=0, method=0), "too large"),
        "webp of 30 megapixels": (encode(wide[:3700], "WEBP", mode="RGB", lossless=True, quality=0, method=0), (side, 3700)),
        "webp with a profile of 30 MB": (webp(b"VP8X\x0a\0\0\0\x20\0\0\0" + sides(WIDTH, HEIGHT) + chunk(b"ICCP", bytes(30_000_000)) + WEBP[12:]), SIZE),
        "webp of 2 000 000 chunks": (webp(WEBP[12:] + chunk(b"JUNK", b"") * 2_000_000), "damaged: a WebP of more than"),
    }  # fmt: skip
    return {name: Odd(*odd) for name, odd in files.items()}


def _damaged_jpegs() -> dict[str, Odd]:
    scan = JPEG.index(b"\xff\xda")
    large = encode(photo(3, 480, 640), quality=90)
    files = {
        "jpeg without quantization": (without(JPEG, b"\xff\xdb"), "damaged"),
        "jpeg without Huffman tables": (without(without(without(without(JPEG, b"\xff\xc4"), b"\xff\xc4"), b"\xff\xc4"), b"\xff\xc4"), EITHER),
        "jpeg without a frame": (without(JPEG, b"\xff\xc0"), "damaged"),
        "jpeg without a scan": (JPEG[:scan] + b"\xff\xd9", "truncated"),
        "jpeg of two frames": (JPEG[:scan] + JPEG[JPEG.index(b"\xff\xc0") : scan] + JPEG[scan:], "damaged"),
        "jpeg that starts twice": (JPEG[:2] + JPEG, "damaged"),
        "jpeg with a reserved marker": (segment(JPEG, 0x02, b"x"), "damaged"),
        "jpeg of a start and an end": (b"\xff\xd8\xff\xd9" + bytes(10), "damaged"),
        "jpeg with an empty scan": (JPEG[: scan + 14] + b"\xff\xd9", "truncated"),
        "jpeg with a zeroed sector": (large[:8192] + bytes(4096) + large[8192 + 4096 :], "truncated"),
        "jpeg with a zeroed sector that hides": (large_zeroed(), "damaged: zeros among the JPEG data"),
        "jpeg zeroed to its end": (large[:-4098] + bytes(4096) + large[-2:], "truncated"),
        "jpeg of noise": (b"\xff\xd8\xff" + random.Random(2).randbytes(5000) + b"\xff\xd9", EITHER),
    }  # fmt: skip
    return {name: Odd(*odd) for name, odd in files.items()}


def _damaged_pngs() -> dict[str, Odd]:
    end = png_chunk(b"IEND", b"")
    rows = b"\0" + bytes(3 * WIDTH)
    header = PNG[8:33]
    files = {
        "png without a header": (PNG_START + PNG[33:], "damaged"),
        "png with its header behind the pixels": (PNG_START + PNG[33:-12] + header + end, "damaged"),
        "png with two headers": (PNG[:33] + header + PNG[33:], "damaged"),
        "png without pixels": (PNG[:33] + end, "damaged"),
        "png without an end": (PNG[:-12], "truncated"),
        "png palette without a palette": (raw_png(WIDTH, HEIGHT, 8, 3, zlib.compress(b"\0" * (1 + WIDTH) * HEIGHT)), "damaged"),
        "png of 3 bits": (raw_png(WIDTH, HEIGHT, 3, 0, zlib.compress(rows * HEIGHT)), "damaged"),
        "png of colour type 5": (raw_png(WIDTH, HEIGHT, 8, 5, zlib.compress(rows * HEIGHT)), "damaged"),
        "png with an unknown filter": (raw_png(WIDTH, HEIGHT, 8, 2, zlib.compress((b"\x09" + rows[1:]) * HEIGHT)), "damaged"),
        "png with broken compression": (raw_png(WIDTH, HEIGHT, 8, 2, b"\x78\x9c" + random.Random(3).randbytes(500)), "damaged"),
        "png without compression": (raw_png(WIDTH, HEIGHT, 8, 2, rows * HEIGHT), "damaged"),
        "png with an unknown part that must be known": (PNG[:33] + png_chunk(b"ABcD", b"x") + PNG[33:], "damaged: an unknown PNG chunk"),
        "png with a wrong checksum": (changed(PNG, -1, 0), "damaged: wrong checksum"),
        "png with its lines turned to DOS": (PNG.replace(b"\n", b"\r\n"), "not a JPEG, PNG or WebP"),
    }  # fmt: skip
    return {name: Odd(*odd) for name, odd in files.items()}


def _damaged_webps() -> dict[str, Odd]:
    extended = chunk(b"VP8X", bytes(4) + sides(WIDTH, HEIGHT))
    files = {
        "webp without a picture": (webp(extended), "damaged"),
        "webp with a short header": (webp(chunk(b"VP8X", b"")), "damaged"),
        "webp animation without a frame": (webp(chunk(b"VP8X", b"\x02\0\0\0" + sides(WIDTH, HEIGHT))), "damaged"),
        "webp of another size than its canvas": (webp(chunk(b"VP8X", bytes(4) + sides(99, 99)) + WEBP[12:]), "damaged"),
        "webp that goes on from a frame before": (over(WEBP, WEBP.index(b"\x9d\x01\x2a") - 3, b"\x01"), "damaged"),
        "webp with alpha of noise": (webp(extended + chunk(b"ALPH", random.Random(4).randbytes(99)) + WEBP[12:]), EITHER),
        "webp with pixels of noise": (WEBP[:60] + random.Random(5).randbytes(len(WEBP) - 60), EITHER),
        "webp lossless with pixels of zeros": (LOSSLESS[:30] + bytes(len(LOSSLESS) - 30), EITHER),
    }  # fmt: skip
    return {name: Odd(*odd) for name, odd in files.items()}


def _not_photos() -> dict[str, Odd]:
    archive = io.BytesIO()
    np.savez(archive, a=np.zeros(3))
    objects = io.BytesIO()
    np.save(objects, np.array([Canary()], dtype=object), allow_pickle=True)
    files = {
        "empty": (b"", "empty file"),
        "zeros": (bytes(5000), "only zeros"),
        "one byte": (b"\xff", "not a JPEG, PNG or WebP"),
        "gif": (encode(picture(), "GIF"), "not a JPEG, PNG or WebP: GIF"),
        "bmp": (encode(picture(), "BMP"), "not a JPEG, PNG or WebP: BMP"),
        "tiff": (encode(picture(), "TIFF"), "not a JPEG, PNG or WebP: TIFF"),
        "big-endian tiff": (b"MM\0*" + bytes(100), "not a JPEG, PNG or WebP: TIFF"),
        "jpeg 2000": (encode(picture(), "JPEG2000"), "not a JPEG, PNG or WebP: JPEG 2000"),
        "portable pixmap": (encode(picture(), "PPM"), "not a JPEG, PNG or WebP"),
        "icon": (encode(picture(), "ICO"), "not a JPEG, PNG or WebP: an icon"),
        "heic": (b"\0\0\0\x18ftypheic\0\0\0\0mif1heic", "not a JPEG, PNG or WebP: HEIC"),
        "avif": (b"\0\0\0\x18ftypavif", "not a JPEG, PNG or WebP: AVIF"),
        "video": (b"\0\0\0\x18ftypisom" + bytes(100), "not a JPEG, PNG or WebP: a video"),
        "radiance": (b"#?RADIANCE\n-Y 9 +X 9\n", "not a JPEG, PNG or WebP"),
        "openexr": (b"\x76\x2f\x31\x01" + bytes(100), "not a JPEG, PNG or WebP"),
        "svg": (b"<svg xmlns='http://www.w3.org/2000/svg'/>", "not a JPEG, PNG or WebP: HTML or XML"),
        "html error page": (b"<!DOCTYPE html><title>404 Not Found</title>", "not a JPEG, PNG or WebP: HTML or XML"),
        "json error": (b'{"error": "expired"}', "not a JPEG, PNG or WebP"),
        "git lfs pointer": (b"version https://git-lfs.github.com/spec/v1\n", "not a JPEG, PNG or WebP: a Git LFS pointer"),
        "pdf": (b"%PDF-1.4", "not a JPEG, PNG or WebP: PDF"),
        "gzip": (gzip.compress(PNG, mtime=0), "not a JPEG, PNG or WebP: gzip"),
        "numpy archive": (archive.getvalue(), "not a JPEG, PNG or WebP: a zip"),
        "pickle that runs code": (pickle.dumps(Canary()), "not a JPEG, PNG or WebP"),
        "numpy file that runs code": (objects.getvalue(), "not a JPEG, PNG or WebP"),
        "shell script": (b"#!/bin/sh\ntouch executed\n", "not a JPEG, PNG or WebP"),
        "program": (b"\x7fELF" + bytes(100), "not a JPEG, PNG or WebP"),
        "sound": (b"RIFF\x10\0\0\0WAVEfmt " + bytes(100), "not a JPEG, PNG or WebP"),
        "noise": (random.Random(6).randbytes(5000), "not a JPEG, PNG or WebP"),
    }  # fmt: skip
    return {name: Odd(*odd) for name, odd in files.items()}


def large_zeroed() -> bytes:
    """The first sector at which zeros stand for as many blocks as were there, so that the picture ends as it should."""
    data = encode(photo(0, 480, 640), quality=90)
    return data[:26624] + bytes(512) + data[26624 + 512 :]


def over(data: bytes, place: int, new: bytes) -> bytes:
    return data[:place] + new + data[place + len(new) :]


def changed(data: bytes, place: int, byte: int) -> bytes:
    return over(data, place % len(data), bytes([byte]))


def segment(data: bytes, marker: int, *bodies: bytes) -> bytes:
    """A JPEG with further segments behind its start."""
    return data[:2] + b"".join(bytes([0xFF, marker]) + struct.pack(">H", len(body) + 2) + body for body in bodies) + data[2:]


def without(data: bytes, marker: bytes) -> bytes:
    """A JPEG without the first segment of a kind."""
    start = data.index(marker)
    return data[:start] + data[start + 2 + int.from_bytes(data[start + 2 : start + 4], "big") :]


def with_size(data: bytes, width: int, height: int) -> bytes:
    """A PNG that says to be of another size."""
    return data[:8] + png_chunk(b"IHDR", struct.pack(">II", width, height) + data[24:29]) + data[33:]


def in_pieces(data: bytes) -> bytes:
    """A PNG with a chunk for each byte of its pixels."""
    start, end = data.index(b"IDAT") - 4, data.index(b"IEND") - 4
    pixels = data[start + 8 : end - 4]
    return data[:start] + b"".join(png_chunk(b"IDAT", pixels[i : i + 1]) for i in range(len(pixels))) + data[end:]


def raw_png(width: int, height: int, bits: int, color_type: int, pixels: bytes) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, bits, color_type, 0, 0, 0)
    return PNG_START + png_chunk(b"IHDR", header) + png_chunk(b"IDAT", pixels) + png_chunk(b"IEND", b"")


def webp(body: bytes) -> bytes:
    return b"RIFF" + struct.pack("<I", len(body) + 4) + b"WEBP" + body


def chunk(kind: bytes, body: bytes) -> bytes:
    return kind + struct.pack("<I", len(body)) + body + b"\0" * (len(body) % 2)


def sides(width: int, height: int) -> bytes:
    return (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
