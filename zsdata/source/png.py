"""PNG: what its chunks say, whether they are whole, and its pixels."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from zsdata.faults import BadPhoto
from zsdata.source.exif import read_orientation
from zsdata.source.opencv import decode_color, decode_over_white

SIGNATURE = b"\x89PNG\r\n\x1a\n"

MAX_CHUNKS = 1_000_000  # real files have pixels in chunks of 8 KB and more

_DECODED = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")
GREY, RGB, GREY_ALPHA, RGB_ALPHA = 0, 2, 4, 6  # colour types


@dataclass(frozen=True)
class Png:
    """A PNG whose chunks are all there with the right checksums; sides in pixels, as stored."""

    extension: ClassVar[str] = "png"

    data: bytes  # without what a decoder does not need
    width: int
    height: int
    bits: int  # per channel
    color_type: int
    transparency: bytes | None  # the tRNS chunk
    orientation: int

    @staticmethod
    def parse(data: bytes) -> Png:
        """Reads all chunks and keeps those that make the pixels: no text or profile is ever unpacked.

        Of an animation that is the default image, which viewers that know no animation show.
        """
        header, transparency, orientation = b"", None, 1
        has_pixels = False
        needed: list[bytes | memoryview] = [SIGNATURE]
        position = len(SIGNATURE)
        view = memoryview(data)
        for _ in range(MAX_CHUNKS):
            start = position + 8
            end = start + int.from_bytes(data[position : position + 4], "big")
            kind = data[position + 4 : start]
            if end + 4 > len(data):
                raise BadPhoto("truncated: ends inside the PNG chunks")
            if zlib.crc32(view[position + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
                raise BadPhoto(f"damaged: wrong checksum of the PNG chunk {kind.decode('latin-1')!r}")
            if kind == b"IHDR" and not header:
                header = data[start:end]
            elif kind == b"tRNS":
                transparency = data[start:end]
            elif kind == b"eXIf":
                orientation = read_orientation(data[start:end])
            has_pixels |= kind == b"IDAT"
            position = end + 4
            if kind in _DECODED:
                needed.append(view[start - 8 : position])
            elif kind[:1].isupper():
                raise BadPhoto(f"damaged: an unknown PNG chunk {kind.decode('latin-1')!r}, and no decoder may pass it over")
            if kind == b"IEND":
                break
        else:
            raise BadPhoto(f"damaged: a PNG of more than {MAX_CHUNKS:,} chunks")
        if len(header) != 13 or not has_pixels:
            raise BadPhoto("damaged: a PNG without header or image data")
        width, height = int.from_bytes(header[:4], "big"), int.from_bytes(header[4:8], "big")
        return Png(b"".join(needed), width, height, header[8], header[9], transparency, orientation)

    @property
    def working_bytes(self) -> int:
        """What the decoder holds beside two RGB images."""
        if not self._needs_blending:
            return 0
        channels = 1 if self.color_type == GREY else 4 if self.color_type != RGB or self.transparency is not None else 3
        bytes_per_pixel = channels * (2 if self.bits == 16 else 1)
        return self.width * self.height * max(0, 2 * bytes_per_pixel - 6)  # it is held twice, but before there is any RGB

    @property
    def _needs_blending(self) -> bool:
        return self.bits > 8 or self.transparency is not None or self.color_type in (GREY_ALPHA, RGB_ALPHA)

    def decode(self) -> np.ndarray:
        """uint8 [height, width, 3] RGB over white; 16 bits are rounded to 8."""
        if self._needs_blending:
            return decode_over_white(self.data, self._transparent_grey())
        return decode_color(self.data)

    def _transparent_grey(self) -> int | None:
        """OpenCV knows the transparent entries of a palette and a transparent colour, but not a transparent grey."""
        if self.color_type != GREY or self.transparency is None or len(self.transparency) != 2:
            return None
        value = int.from_bytes(self.transparency, "big") & ((1 << self.bits) - 1)
        return value if self.bits >= 8 else value * 255 // ((1 << self.bits) - 1)
