"""WebP: what its chunks say, whether they are whole, and its pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from zsdata.faults import BadPhoto
from zsdata.source.exif import read_orientation
from zsdata.source.opencv import decode_color, decode_over_white

MAX_CHUNKS = 1_000_000  # an animation has one for each frame

_ANIMATED, _HAS_ALPHA = 0x02, 0x10  # flags of VP8X


@dataclass(frozen=True)
class WebP:
    """A WebP whose chunks are all there; sides in pixels, as stored. Of an animation it is the first frame on its canvas."""

    extension: ClassVar[str] = "webp"

    still: bytes  # a WebP of one picture, without what a decoder does not need
    width: int
    height: int
    may_have_alpha: bool
    orientation: int
    left: int = 0  # of the first frame on the canvas
    top: int = 0

    @staticmethod
    def parse(data: bytes) -> WebP:
        """Reads the chunks of the file and, in an animation, of its first frame."""
        riff_end = 8 + int.from_bytes(data[4:8], "little")
        if riff_end > len(data):
            raise BadPhoto(f"truncated: has {len(data):,} of {riff_end:,} bytes")
        chunks = _chunks(data, 12, riff_end)
        orientation = read_orientation(chunks[b"EXIF"]) if b"EXIF" in chunks else 1
        extended = chunks.get(b"VP8X")
        if extended is None:
            return WebP(_still(chunks), *_bitstream_size(chunks), b"VP8L" in chunks, orientation)
        if len(extended) < 10:
            raise BadPhoto("damaged: no size in the WebP header")
        width, height = _uint24(extended, 4) + 1, _uint24(extended, 7) + 1
        if not extended[0] & _ANIMATED:
            if _bitstream_size(chunks) != (width, height):
                raise BadPhoto("damaged: a WebP image of another size than its canvas")
            return WebP(_still(chunks), width, height, True, orientation)
        frame = chunks.get(b"ANMF", b"")
        if len(frame) < 16:
            raise BadPhoto("damaged: an animated WebP without a frame")
        left, top = 2 * _uint24(frame, 0), 2 * _uint24(frame, 3)
        frame_chunks = _chunks(frame, 16, len(frame))
        frame_width, frame_height = _bitstream_size(frame_chunks)
        if left + frame_width > width or top + frame_height > height:
            raise BadPhoto("damaged: a WebP frame outside of its canvas")
        return WebP(_still(frame_chunks), width, height, True, orientation, left, top)

    @property
    def working_bytes(self) -> int:
        """What the decoder holds beside two RGB images: a lossless one its colours, and both an image with alpha."""
        return self.width * self.height * (4 if self.may_have_alpha else 0)

    def decode(self) -> np.ndarray:
        """uint8 [height, width, 3] RGB over white."""
        image = decode_over_white(self.still) if self.may_have_alpha else decode_color(self.still)
        if image.shape[:2] == (self.height, self.width):
            return image
        canvas = np.full((self.height, self.width, 3), 255, np.uint8)
        canvas[self.top : self.top + image.shape[0], self.left : self.left + image.shape[1]] = image
        return canvas


def _chunks(data: bytes, position: int, end: int) -> dict[bytes, bytes]:
    """The first chunk of each kind."""
    chunks: dict[bytes, bytes] = {}
    for _ in range(MAX_CHUNKS):
        if position + 8 > end:
            return chunks
        kind, size = data[position : position + 4], int.from_bytes(data[position + 4 : position + 8], "little")
        if position + 8 + size > end:
            raise BadPhoto("truncated: ends inside the WebP chunks")
        chunks.setdefault(kind, data[position + 8 : position + 8 + size])
        position += 8 + size + size % 2
    raise BadPhoto(f"damaged: a WebP of more than {MAX_CHUNKS:,} chunks")


def _bitstream_size(chunks: dict[bytes, bytes]) -> tuple[int, int]:
    """Width and height from the header of the compressed pixels."""
    lossless, lossy = chunks.get(b"VP8L"), chunks.get(b"VP8 ")
    if lossless is not None and lossy is not None:
        raise BadPhoto("damaged: a WebP with two pictures in one frame")
    if lossless is not None and len(lossless) >= 5 and lossless[0] == 0x2F:
        bits = int.from_bytes(lossless[1:5], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if lossy is not None and len(lossy) >= 10 and lossy[3:6] == b"\x9d\x01\x2a":
        width, height = int.from_bytes(lossy[6:8], "little") & 0x3FFF, int.from_bytes(lossy[8:10], "little") & 0x3FFF
        if not width or not height:
            raise BadPhoto(f"damaged: {width} x {height} pixels")
        return width, height
    raise BadPhoto("damaged: a WebP without image data")


def _still(chunks: dict[bytes, bytes]) -> bytes:
    """A WebP file of one frame's chunks."""
    width, height = _bitstream_size(chunks)
    body = b"WEBP"
    if b"ALPH" in chunks:
        body += _chunk(b"VP8X", bytes([_HAS_ALPHA, 0, 0, 0]) + (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little"))
    for kind in (b"ALPH", b"VP8 ", b"VP8L"):
        if kind in chunks:
            body += _chunk(kind, chunks[kind])
    return _chunk(b"RIFF", body)


def _chunk(kind: bytes, body: bytes) -> bytes:
    return kind + len(body).to_bytes(4, "little") + body + b"\0" * (len(body) % 2)


def _uint24(data: bytes, position: int) -> int:
    return int.from_bytes(data[position : position + 3], "little")
