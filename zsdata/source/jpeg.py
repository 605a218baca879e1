"""JPEG: what its segments say, whether it is whole, and its pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from zsdata.faults import BadPhoto
from zsdata.source.exif import read_orientation
from zsdata.source.opencv import decode_color

SIGNATURE = b"\xff\xd8\xff"

_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_WITHOUT_LENGTH = frozenset({0x01, *range(0xD0, 0xD8)})
_START_OF_SCAN, _END_OF_IMAGE, _APP1 = 0xDA, 0xD9, 0xE1
_END = b"\xff\xd9"


@dataclass(frozen=True)
class Jpeg:
    """A JPEG whose segments are in order and whose scan data have an end; sides in pixels, as stored."""

    extension: ClassVar[str] = "jpg"

    data: bytes
    width: int
    height: int
    components: int
    orientation: int
    scan: int  # where the first scan's data begin

    @staticmethod
    def parse(data: bytes) -> Jpeg:
        """Reads the segments up to the first scan; thumbnails lie inside of them and are stepped over."""
        frame: tuple[int, int, int] | None = None
        orientation = 1
        position = 2
        while True:
            position = data.find(b"\xff", position)
            while 0 <= position < len(data) - 1 and data[position + 1] == 0xFF:  # fill bytes
                position += 1
            if position < 0 or position + 4 > len(data):
                raise BadPhoto("truncated: ends inside the JPEG header")
            marker = data[position + 1]
            if marker in _WITHOUT_LENGTH:
                position += 2
                continue
            if marker in (0x00, 0xD8, _END_OF_IMAGE):
                raise BadPhoto("damaged: a JPEG without image data")
            start, end = position + 4, position + 2 + int.from_bytes(data[position + 2 : position + 4], "big")
            if end < start:
                raise BadPhoto("damaged: a JPEG segment without length")
            if end > len(data):
                raise BadPhoto("truncated: ends inside the JPEG header")
            if marker in _START_OF_FRAME and frame is None:
                if end - start < 6:
                    raise BadPhoto("damaged: no size in the JPEG header")
                frame = (
                    int.from_bytes(data[start + 3 : start + 5], "big"),
                    int.from_bytes(data[start + 1 : start + 3], "big"),
                    data[start + 5],
                )
            elif marker == _APP1 and orientation == 1 and data.startswith(b"Exif\0\0", start):
                orientation = read_orientation(data[start:end])
            elif marker == _START_OF_SCAN:
                break
            position = end
        if frame is None:
            raise BadPhoto("damaged: no size in the JPEG header")
        if data.rfind(_END, end) < 0:  # scan data never hold this pair, and OpenCV would fill what is missing with grey
            raise BadPhoto("truncated: a JPEG without its end")
        return Jpeg(data, *frame, orientation, end)

    def decode(self) -> np.ndarray:
        """uint8 [height, width, 3] RGB; grey and CMYK (inverted, as Adobe stores it) are converted."""
        image = decode_color(self.data)
        if self.components < 4 and (image[-1, -1] == 128).all() and self._lacks_scan_data(image):
            raise BadPhoto("truncated: JPEG data are missing before its end")
        return image

    def _lacks_scan_data(self, image: np.ndarray) -> bool:
        """Whether OpenCV ran out of data and filled up with grey (128).

        It says so to stderr only. But surplus data before the end marker change nothing in a whole JPEG, and are taken for the missing
        blocks in another.
        """
        end = self.data.find(_END, self.scan)
        surplus = self.data[:end] + bytes(range(1, 200, 2)) + self.data[end:]
        return not np.array_equal(image, decode_color(surplus))
