"""The depth map that lies beside a photo in its shard: from bytes to inverse depth, one value for each of the photo's pixels.

    KEY.depth.png    16-bit grey
    KEY.depth.npy    float16, float32, float64 or uint16, [h, w]

Values are inverse depth in any scale and offset, larger is nearer, as an estimator returns it (`zsdata.synthesis.depth`); each map is
normalised by its own extremes. 0 is a value like any other, most often that of the farthest point: there is no value for "unknown", so a
map with NaN or infinity is refused, and so is one that is flat. Negative values are allowed, as the offset is free.

A map has the pixels of the photo's file as they are stored: where that carries an EXIF orientation, both are turned. It may be smaller than
the photo, as networks return it, and is then enlarged (bilinear).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from zsdata.faults import BadPhoto
from zsdata.source import png
from zsdata.source.exif import make_upright
from zsdata.source.opencv import decode_unchanged
from zsdata.source.photo import MAX_DECODE_BYTES, MAX_PIXELS, MAX_SIDE, PhotoHeader
from zsdata.source.png import Png

ASPECT_TOLERANCE = 0.05  # networks round both sides to whole patches, of up to 32 px at 384
NPY_SIGNATURE = b"\x93NUMPY"
MAX_NPY_HEADER_BYTES = 10_000  # numpy's own limit; a map's header has 118

_DTYPE = re.compile(r"'descr'\s*:\s*(?:'([^']*)'|([^,]*))")
_ORDER = re.compile(r"'fortran_order'\s*:\s*(True|False)")
_SHAPE = re.compile(r"'shape'\s*:\s*\(([^)]*)\)")
_TWO_SIDES = re.compile(r"\s*([0-9]{1,10})L?\s*,\s*([0-9]{1,10})L?\s*,?\s*")
_NUMBERS = re.compile(r"([<>])(f2|f4|f8|u2)")


@dataclass(frozen=True)
class DepthMap:
    """A depth map whose header is sound and whose size is within the limits; sides in pixels, as stored."""

    data: bytes
    width: int
    height: int
    extension: Literal["png", "npy"]
    dtype: np.dtype
    start: int = 0  # of an NPY file's numbers
    by_columns: bool = False

    @staticmethod
    def parse(data: bytes) -> DepthMap:
        """Tells by its content what the file is; nothing is decoded.

        Raises:
            BadPhoto: another kind of file or of numbers, damaged, cut off, or too large (the limits are those of photos).
        """
        if data.startswith(png.SIGNATURE):
            depth = _parse_png(data)
        elif data.startswith(NPY_SIGNATURE):
            depth = _parse_npy(data)
        else:
            raise BadPhoto("stored depth of another kind: neither a PNG nor an NPY file" if data else "stored depth damaged: empty file")
        sides = f"{depth.width:,} x {depth.height:,}"
        if not depth.width or not depth.height:
            raise BadPhoto(f"stored depth damaged: {sides} values")
        needed = depth.width * depth.height * (depth.dtype.itemsize + 4)  # as stored and in float32
        if max(depth.width, depth.height) > MAX_SIDE or depth.width * depth.height > MAX_PIXELS or needed > MAX_DECODE_BYTES:
            raise BadPhoto(
                f"stored depth too large: {sides} values take {needed // 1_000_000:,} MB, at most {MAX_DECODE_BYTES // 1_000_000} and "
                f"{MAX_SIDE:,} a side"
            )
        return depth

    def decode(self) -> np.ndarray:
        """float32 [height, width], as stored.

        Raises:
            BadPhoto: the pixels are damaged or cut off, a value is not finite, or all are the same.
        """
        stored = self._decode_png() if self.extension == "png" else self._decode_npy()
        with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold is found below
            depth = stored.astype(np.float32, order="C")
        low, high = float(depth.min()), float(depth.max())
        if not math.isfinite(high - low):
            count = depth.size - int(np.count_nonzero(np.isfinite(depth)))
            raise BadPhoto(f"stored depth not finite: NaN or infinity at {count:,} of {depth.size:,} pixels; every pixel needs a value")
        if high - low > float(np.finfo(np.float32).max):
            raise BadPhoto(f"stored depth not finite: from {low:.3g} to {high:.3g} is more than float32 holds")
        if high == low:
            raise BadPhoto(f"stored depth flat: {low:g} at every pixel")
        return depth

    def _decode_png(self) -> np.ndarray:
        try:
            stored = decode_unchanged(self.data)
        except BadPhoto as fault:
            raise BadPhoto(f"stored depth damaged: {fault.reason.removeprefix('damaged: ')}") from fault
        if stored.dtype != np.uint16 or stored.shape != (self.height, self.width):
            raise BadPhoto(f"stored depth damaged: decodes to {stored.dtype} {list(stored.shape)}")
        return stored

    def _decode_npy(self) -> np.ndarray:
        numbers = np.frombuffer(self.data, self.dtype, offset=self.start)
        return numbers.reshape(self.width, self.height).T if self.by_columns else numbers.reshape(self.height, self.width)


def decode_depth(data: bytes, photo: PhotoHeader) -> np.ndarray:
    """The depth map of a photo: float32 [H, W], inverse depth, upright, with the sides of the photo.

    Args:
        photo: as `probe_photo` returns it.

    Raises:
        BadPhoto: the map cannot be used (see `DepthMap`), or is not of this photo.
    """
    stored = DepthMap.parse(data)
    fault = misfit(stored.width, stored.height, photo)
    if fault is not None:
        raise BadPhoto(fault)
    depth, size = stored.decode(), photo.stored_size
    if (stored.width, stored.height) != size:
        depth = cv2.resize(depth, size, interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(make_upright(depth, photo.orientation))


def misfit(width: int, height: int, photo: PhotoHeader) -> str | None:
    """Why a map of these sides cannot be the depth of a photo; None where it can."""
    across, down = photo.stored_size
    if width <= across and height <= down and _same_aspect(width, height, across, down):
        return None
    reason = f"stored depth does not fit: the photo has {across} x {down} pixels as stored, the depth map {width} x {height}"
    if photo.orientation >= 5 and height <= across and width <= down and _same_aspect(height, width, across, down):
        return reason + "; it seems to be of the photo turned upright (EXIF), and must have the pixels of the photo's file"
    return reason + "; it must have the photo's size, or be a smaller one of its proportions"


def _same_aspect(width: int, height: int, across: int, down: int) -> bool:
    return abs(width * down - height * across) <= ASPECT_TOLERANCE * max(width * down, height * across)


def _parse_png(data: bytes) -> DepthMap:
    try:
        parsed = Png.parse(data)
    except BadPhoto as fault:
        raise BadPhoto(f"stored depth damaged: {fault.reason.removeprefix('damaged: ')}") from fault
    if (parsed.color_type, parsed.bits) != (png.GREY, 16) or parsed.transparency is not None:
        kind = {png.GREY: "grey", png.RGB: "RGB", png.GREY_ALPHA: "grey with alpha", png.RGB_ALPHA: "RGB with alpha"}
        see_through = " with transparency" if parsed.transparency is not None else ""
        found = f"{parsed.bits}-bit {kind.get(parsed.color_type, 'palette')}{see_through}"
        raise BadPhoto(f"stored depth of another kind: a PNG of 16-bit grey is needed, this is {found}")
    return DepthMap(parsed.data, parsed.width, parsed.height, "png", np.dtype(np.uint16))


def _parse_npy(data: bytes) -> DepthMap:
    """Reads the header by its own rules: it is a text that numpy would evaluate."""
    version, length_bytes = data[6:7], 2 if data[6:7] == b"\1" else 4
    begin = 8 + length_bytes
    start = begin + int.from_bytes(data[8:begin], "little")
    if version not in (b"\1", b"\2", b"\3") or start - begin > MAX_NPY_HEADER_BYTES or start > len(data):
        raise BadPhoto("stored depth damaged: no NPY header of version 1, 2 or 3")
    header = data[begin:start].decode("latin-1")
    dtype, order, shape = _DTYPE.search(header), _ORDER.search(header), _SHAPE.search(header)
    if dtype is None or order is None or shape is None:
        raise BadPhoto("stored depth damaged: no dtype, order or shape in its NPY header")
    numbers, sides = _NUMBERS.fullmatch(dtype[1] or ""), _TWO_SIDES.fullmatch(shape[1])
    if numbers is None or sides is None:
        found = f"{(dtype[1] or dtype[2])[:20]} [{shape[1][:40]}]".encode("unicode_escape").decode()
        raise BadPhoto(f"stored depth of another kind: float16, float32, float64 or uint16 [h, w] is needed, this is {found}")
    kind, height, width = np.dtype(numbers[0]), int(sides[1]), int(sides[2])
    if len(data) - start != kind.itemsize * height * width:
        raise BadPhoto(f"stored depth damaged: {len(data) - start:,} bytes for {width:,} x {height:,} values of {kind.itemsize}")
    return DepthMap(data, width, height, "npy", kind, start, order[1] == "True")
