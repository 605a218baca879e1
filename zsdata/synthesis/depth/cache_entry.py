"""The file of one photo's depth: written whole, read by bands of rows, believed only where every checksum holds.

A header, then the checksums of all bands, then the whole inverse depth, then the whole confidence; little-endian, rows from the top. So a
crop is two reads, and what it does not need is neither read nor checked.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsdata.bounded_folder import BadEntry

MAGIC = b"zsdepth\n"
VERSION = 1
# magic, version, height, width, rows of a band, consistency, identity and photo (sha256), CRC-32 of all before it and of the band table
HEADER = struct.Struct("<8sIIIId32s32sI")
CRC_BYTES = 4
BAND_ROWS = 16  # a band of a 2048 px wide photo is 96 KiB; with fewer rows the calls cost more than the rows that are read in vain
FIRST_READ_BYTES = 4096  # holds header and table of photos of up to 7,984 rows

DEPTH_DTYPE = np.dtype("<u2")
CONFIDENCE_DTYPE = np.dtype("u1")
PIXEL_BYTES = DEPTH_DTYPE.itemsize + CONFIDENCE_DTYPE.itemsize


class CachedDepth(NamedTuple):
    """Depth of some rows of a photo.

    Attributes:
        inverse_depth: uint16 [rows, w]; 0..65535 stands for 0..1. The rows asked for, widened to whole bands.
        confidence: uint8 [rows, w]; 0..255 stands for 0..1.
        consistency: mean flip consistency of the whole photo.
        first_row: of both arrays, in the whole map.
        size: (h, w) of the whole map, in pixels.
    """

    inverse_depth: NDArray[np.uint16]
    confidence: NDArray[np.uint8]
    consistency: float
    first_row: int
    size: tuple[int, int]


def entry_bytes(height: int, width: int) -> int:
    """Size of the file of a map of `height` rows and `width` columns."""
    return HEADER.size + _table_bytes(height, BAND_ROWS) + height * width * PIXEL_BYTES


def pack_entry(
    identity: bytes, photo: bytes, inverse_depth: NDArray[np.uint16], confidence: NDArray[np.uint8], consistency: float
) -> Iterator[bytes | memoryview]:
    """The file's parts in their order; `identity` and `photo` are sha256 digests of 32 bytes."""
    planes = np.ascontiguousarray(inverse_depth, DEPTH_DTYPE), np.ascontiguousarray(confidence, CONFIDENCE_DTYPE)
    height, width = inverse_depth.shape
    table = np.array([_band_checksums(plane, BAND_ROWS) for plane in planes], "<u4").tobytes()
    fields = (MAGIC, VERSION, height, width, BAND_ROWS, consistency, identity, photo)
    head = HEADER.pack(*fields, 0)[:-CRC_BYTES]
    yield HEADER.pack(*fields, zlib.crc32(table, zlib.crc32(head)))
    yield table
    for plane in planes:
        yield plane.reshape(-1).view(np.uint8).data


def read_entry(descriptor: int, size: int, identity: bytes, photo: bytes, rows: tuple[int, int] | None) -> CachedDepth | None:
    """Rows `rows[0]` to `rows[1]` (exclusive) of an open file of `size` bytes, or all; None where the map has not all of them.

    Raises:
        BadEntry: the file has another size than its header says, is of another version, estimator or photo, or a checksum is wrong.
        OSError: the file cannot be read.
    """
    begin = os.pread(descriptor, FIRST_READ_BYTES, 0)
    if len(begin) < HEADER.size:
        raise BadEntry(f"it ends inside the header, after {len(begin)} bytes")
    magic, version, height, width, band_rows, consistency, its_identity, its_photo, checksum = HEADER.unpack_from(begin)
    if (magic, version) != (MAGIC, VERSION):
        raise BadEntry(f"not of format version {VERSION}")
    if not (height and width and band_rows):
        raise BadEntry("damaged header")
    table_end = HEADER.size + _table_bytes(height, band_rows)
    expected_bytes = table_end + height * width * PIXEL_BYTES
    if size != expected_bytes:
        raise BadEntry(f"{size:,} bytes instead of {expected_bytes:,}")
    if table_end > len(begin):
        begin += os.pread(descriptor, table_end - len(begin), len(begin))
    table_bytes = begin[HEADER.size : table_end]
    if zlib.crc32(table_bytes, zlib.crc32(begin[: HEADER.size - CRC_BYTES])) != checksum:
        raise BadEntry("damaged header")
    if (its_identity, its_photo) != (identity, photo):
        raise BadEntry("of another photo or estimator")

    first, stop = rows if rows is not None else (0, height)
    if stop > height:
        return None
    first_band, stop_band = first // band_rows, -(-stop // band_rows)
    first, stop = first_band * band_rows, min(stop_band * band_rows, height)
    planes, offset = [], table_end
    for table, dtype in zip(np.frombuffer(table_bytes, "<u4").reshape(2, -1), (DEPTH_DTYPE, CONFIDENCE_DTYPE), strict=True):
        plane = np.empty((stop - first, width), dtype)
        _read_into(plane, descriptor, offset + first * width * dtype.itemsize)
        if _band_checksums(plane, band_rows) != table[first_band:stop_band].tolist():
            raise BadEntry(f"damaged between rows {first} and {stop}")
        planes.append(plane.astype(dtype.newbyteorder("="), copy=False))
        offset += height * width * dtype.itemsize
    return CachedDepth(planes[0], planes[1], consistency, first, (height, width))


def _table_bytes(height: int, band_rows: int) -> int:
    return 2 * CRC_BYTES * -(-height // band_rows)


def _band_checksums(plane: np.ndarray, band_rows: int) -> list[int]:
    return [zlib.crc32(plane[row : row + band_rows].data) for row in range(0, len(plane), band_rows)]


def _read_into(plane: np.ndarray, descriptor: int, offset: int) -> None:
    left = plane.reshape(-1).view(np.uint8).data
    while left:
        count = os.preadv(descriptor, [left], offset)
        if count == 0:
            raise BadEntry("it became shorter while it was read")
        left, offset = left[count:], offset + count
