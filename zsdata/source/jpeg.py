"""JPEG: what its segments say, whether it is whole, and its pixels."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from zsdata.faults import BadPhoto
from zsdata.source.exif import read_orientation
from zsdata.source.opencv import decode_color

SIGNATURE = b"\xff\xd8\xff"

MAX_SEGMENTS = 10_000  # before the first scan; a large colour profile takes some hundred
MAX_SCANS = 100  # real progressive files have about ten; each one is a pass over the whole picture, however few bytes it has

_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_PROGRESSIVE = 0xC2
_HUFFMAN_CODED = frozenset({0xC0, 0xC1, _PROGRESSIVE})  # the others are lossless, hierarchical or arithmetic
_WITHOUT_LENGTH = frozenset({0x01, *range(0xD0, 0xD8)})
_START_OF_SCAN, _END_OF_IMAGE, _APP1 = 0xDA, 0xD9, 0xE1
_SCAN, _END = b"\xff\xda", b"\xff\xd9"
_MARKER = re.compile(rb"\xff+[^\xff]")  # fill bytes may precede a marker
_MARKER_IN_SCAN = re.compile(rb"\xff+[^\x00\xd0-\xd7\xff]")  # stuffed bytes and restarts are part of the scan
_ZEROS = bytes(512)  # a sector that was never written


@dataclass(frozen=True)
class Jpeg:
    """A JPEG whose segments are in order and whose scan data have an end; sides in pixels, as stored."""

    extension: ClassVar[str] = "jpg"

    data: bytes
    width: int
    height: int
    components: int
    working_bytes: int  # what the decoder holds beside two RGB images: the coefficients, where they come in several scans
    orientation: int
    scan: int  # where the first scan's data begin

    @staticmethod
    def parse(data: bytes) -> Jpeg:
        """Reads the segments up to the first scan; thumbnails lie inside of them and are stepped over."""
        frame: _Frame | None = None
        orientation = 1
        position = 2
        for _ in range(MAX_SEGMENTS):
            found = _MARKER.search(data, position)
            if found is None or found.end() + 2 > len(data):
                raise BadPhoto("truncated: ends inside the JPEG header")
            position, marker = found.end() - 2, data[found.end() - 1]
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
                frame = _Frame.parse(marker, data[start:end])
            elif marker == _APP1 and orientation == 1 and data.startswith(b"Exif\0\0", start):
                orientation = read_orientation(data[start:end])
            elif marker == _START_OF_SCAN:
                break
            position = end
        else:
            raise BadPhoto(f"damaged: a JPEG header of more than {MAX_SEGMENTS:,} segments")
        if frame is None:
            raise BadPhoto("damaged: no size in the JPEG header")
        if data.rfind(_END, end) < 0:  # scan data never hold this pair, and OpenCV would fill what is missing with grey
            raise BadPhoto("truncated: a JPEG without its end")
        one_scan = not frame.progressive and data[start] == frame.components  # the decoder stops after it, whatever comes
        if not one_scan and data.count(_SCAN, end) >= MAX_SCANS and _scans(data, end) > MAX_SCANS:
            raise BadPhoto(f"damaged: a JPEG of more than {MAX_SCANS} scans")
        return Jpeg(data, frame.width, frame.height, frame.components, 0 if one_scan else frame.coefficient_bytes, orientation, end)

    def decode(self, reduction: int = 1) -> np.ndarray:
        """uint8 [height, width, 3] RGB; grey and CMYK (inverted, as Adobe stores it) are converted.

        Args:
            reduction: 1, 2, 4 or 8: decoded at one part in so many of each side, rounded up.
        """
        image = decode_color(self.data, reduction)
        if self.components < 4 and set(image[-1, -1].tolist()) == {128} and self._lacks_scan_data(image, reduction):
            raise BadPhoto("truncated: JPEG data are missing before its end")
        if (
            self.data.find(_ZEROS, self.scan) >= 0  # quick, and hardly any photo has them
            and self.data.find(_ZEROS, self.scan, self._scan_end) >= 0
            and (self._lacks_scan_data(image, reduction) or self._has_surplus_scan_data(image, reduction))
        ):
            raise BadPhoto("damaged: zeros among the JPEG data")
        return image

    @property
    def _scan_end(self) -> int:
        return self.data.find(_END, self.scan)

    def _lacks_scan_data(self, image: np.ndarray, reduction: int) -> bool:
        """Whether OpenCV ran out of data and filled up with grey (128).

        It says so to stderr only. But surplus data before the end marker change nothing in a whole JPEG, and are taken for the missing
        blocks in another.
        """
        surplus = self.data[: self._scan_end] + bytes(range(1, 200, 2)) + self.data[self._scan_end :]
        return not np.array_equal(image, decode_color(surplus, reduction))

    def _has_surplus_scan_data(self, image: np.ndarray, reduction: int) -> bool:
        """Whether the picture was complete before its data ended, as the last bytes change nothing; a flat last row cannot tell."""
        without_last = self.data[: self._scan_end - 64] + self.data[self._scan_end :]
        return bool(np.ptp(image[-1], axis=0).any()) and np.array_equal(image, decode_color(without_last, reduction))


@dataclass(frozen=True)
class _Frame:
    """What the start of the frame says."""

    width: int
    height: int
    components: int
    progressive: bool
    coefficient_bytes: int

    @staticmethod
    def parse(marker: int, body: bytes) -> _Frame:
        if len(body) < 6 or len(body) < 6 + 3 * body[5]:
            raise BadPhoto("damaged: no size in the JPEG header")
        if marker not in _HUFFMAN_CODED:
            raise BadPhoto("not supported: a JPEG that is neither baseline nor progressive (lossless, hierarchical or arithmetic)")
        if body[0] != 8:
            raise BadPhoto(f"not supported: a JPEG of {body[0]} bits")
        height, width, components = int.from_bytes(body[1:3], "big"), int.from_bytes(body[3:5], "big"), body[5]
        if components not in (1, 3, 4):
            raise BadPhoto(f"damaged: a JPEG of {components} channels")
        samplings = [(body[7 + 3 * i] >> 4, body[7 + 3 * i] & 15) for i in range(components)]
        densest = max(across for across, _ in samplings) * max(down for _, down in samplings)
        if any(not 1 <= factor <= 4 for sampling in samplings for factor in sampling):
            raise BadPhoto("damaged: senseless sampling in the JPEG header")
        coefficients = width * height * sum(across * down for across, down in samplings) // densest
        return _Frame(width, height, components, marker == _PROGRESSIVE, 2 * coefficients)


def _scans(data: bytes, position: int) -> int:
    """How many scans there are up to the end marker, the first one, whose data begin at `position`, included."""
    scans = 1
    while marker := _MARKER_IN_SCAN.search(data, position):
        position = marker.end()
        kind = data[position - 1]
        if kind == _END_OF_IMAGE:
            break
        scans += kind == _START_OF_SCAN
        position += int.from_bytes(data[position : position + 2], "big")
    return scans
