"""The bytes of a photo to its pixels, the right way up, or the reason why not."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from zsdata.faults import BadPhoto
from zsdata.source import jpeg, png
from zsdata.source.exif import make_upright
from zsdata.source.jpeg import Jpeg
from zsdata.source.png import Png
from zsdata.source.webp import WebP

MAX_PIXELS = 100_000_000  # what a camera makes; larger ones take seconds to decode
MAX_DECODE_BYTES = 380_000_000  # for one photo, all that its decoding holds at once; a 60-megapixel JPEG takes 360 MB
MAX_SIDE = 65_535  # pixels; as JPEG has it

_OTHERS = (  # at byte, signature, name
    (0, b"GIF8", "GIF"),
    (0, b"BM", "BMP"),
    (0, b"II*\0", "TIFF"),
    (0, b"MM\0*", "TIFF"),
    (4, b"ftypavi", "AVIF"),
    (4, b"ftyphei", "HEIC"),
    (4, b"ftyphev", "HEIC"),
    (4, b"ftypmi", "HEIC"),
    (4, b"ftyp", "a video"),
    (0, b"\0\0\0\x0cjP", "JPEG 2000"),
    (0, b"\0\0\0\x0cJXL", "JPEG XL"),
    (0, b"\xff\x0a", "JPEG XL"),
    (0, b"8BPS", "Photoshop"),
    (0, b"\0\0\1\0", "an icon"),
    (0, b"%PDF", "PDF"),
    (0, b"PK\x03\x04", "a zip"),
    (0, b"\x1f\x8b", "gzip"),
    (0, b"version https://git-lfs", "a Git LFS pointer"),
    (0, b"<", "HTML or XML"),
)


class PhotoHeader(NamedTuple):
    """What a photo's header says: width and height in pixels as the photo is seen, and the EXIF orientation, 1..8, that makes it so."""

    width: int
    height: int
    orientation: int

    @property
    def stored_size(self) -> tuple[int, int]:
        """Width and height of the pixels in the file."""
        return (self.height, self.width) if self.orientation >= 5 else (self.width, self.height)


def decode_photo(data: bytes) -> Tensor:
    """A JPEG, PNG or WebP file to uint8 [3, H, W], RGB, as it is meant to be seen.

    The EXIF orientation is applied; grey, palette and CMYK become RGB; 16 bits are rounded to 8; what is transparent is laid over white;
    an animation gives its first frame. Colour profiles are not applied.

    Raises:
        BadPhoto: another format, damaged or cut off (no part of such a photo is returned), or too large (MAX_PIXELS, MAX_SIDE,
            MAX_DECODE_BYTES).
    """
    return torch.from_numpy(decode_rgb(data)).permute(2, 0, 1).contiguous()


def decode_rgb(data: bytes, reduction: int = 1) -> np.ndarray:
    """As `decode_photo`, to uint8 [H, W, 3]; see `PhotoFile.decode`."""
    return PhotoFile(data).decode(reduction)


class PhotoFile:
    """A photo whose structure has been checked and whose size is known, not yet decoded.

    Attributes:
        header: the size of what `decode` returns, and how the file is turned.
        extension: the usual one: "jpg", "png" or "webp".

    Raises:
        BadPhoto: as `decode_photo`, as far as it can know; whether the memory suffices depends on the reduction.
    """

    def __init__(self, data: bytes) -> None:
        self._photo = photo = _open(data)
        self.extension = photo.extension
        width, height = (photo.height, photo.width) if photo.orientation >= 5 else (photo.width, photo.height)
        self.header = PhotoHeader(width, height, photo.orientation)

    def decode(self, reduction: int = 1) -> np.ndarray:
        """uint8 [H, W, 3], RGB, as it is meant to be seen.

        Args:
            reduction: 1, 2, 4 or 8: a JPEG is decoded at one part in so many of each side, rounded up, in less time; other formats are not.

        Raises:
            BadPhoto: as `decode_photo`.
        """
        photo = self._photo
        if isinstance(photo, Jpeg):
            _check_memory(photo, reduction)
            image = photo.decode(reduction)
        else:
            reduction = 1
            _check_memory(photo, reduction)
            image = photo.decode()
        if image.shape != (-(-photo.height // reduction), -(-photo.width // reduction), 3):
            raise BadPhoto(
                f"damaged: {image.shape[1]} x {image.shape[0]} pixels where the header says {photo.width} x {photo.height}"
                + (f", at one part in {reduction}" if reduction > 1 else "")
            )
        return make_upright(image, photo.orientation)


def usable_photo(data: bytes, shortest_side_px: int = 1) -> PhotoFile:
    """A photo that was decoded to see whether it can be; BadPhoto as `decode_photo`, or where a side is shorter."""
    photo = PhotoFile(data)
    photo.decode()
    width, height, _ = photo.header
    if min(width, height) < shortest_side_px:
        raise BadPhoto(f"too small: a side shorter than {shortest_side_px} px: {width}x{height}")
    return photo


def probe_photo(data: bytes) -> PhotoHeader:
    """The header of a photo, without decoding it; raises as `PhotoFile`."""
    return PhotoFile(data).header


def probe_size(data: bytes) -> tuple[int, int]:
    """Width and height in pixels of what `decode_photo` would return; as `probe_photo`."""
    return probe_photo(data)[:2]


def _open(data: bytes) -> Jpeg | Png | WebP:
    """The file by its first bytes, its structure checked and its size within the limits."""
    if not isinstance(data, bytes):
        raise TypeError(f"a photo is the bytes of a file, got {type(data).__name__}")
    if data.startswith(jpeg.SIGNATURE):
        photo = Jpeg.parse(data)
    elif data.startswith(png.SIGNATURE):
        photo = Png.parse(data)
    elif data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        photo = WebP.parse(data)
    else:
        raise BadPhoto(_what_else(data))
    width, height = photo.width, photo.height
    if not width or not height:
        raise BadPhoto(f"damaged: {width} x {height} pixels")
    if max(width, height) > MAX_SIDE or width * height > MAX_PIXELS:
        raise BadPhoto(f"too large: {width:,} x {height:,} pixels, at most {MAX_PIXELS // 1_000_000} megapixels and {MAX_SIDE:,} a side")
    return photo


def _check_memory(photo: Jpeg | Png | WebP, reduction: int) -> None:
    """Refuses what would take more than MAX_DECODE_BYTES: two RGB, as OpenCV copies its own, and what the format needs beside."""
    side = f"{photo.width:,} x {photo.height:,} pixels"
    needed = photo.working_bytes + 6 * -(-photo.width // reduction) * -(-photo.height // reduction)
    if needed > MAX_DECODE_BYTES:
        raise BadPhoto(f"too large: {side} take {needed // 1_000_000} MB to decode, at most {MAX_DECODE_BYTES // 1_000_000}")


def _what_else(data: bytes) -> str:
    if not data:
        return "empty file"
    if not data.strip(b"\0"):
        return "only zeros"
    for position, signature, name in _OTHERS:
        if data.startswith(signature, position):
            return f"not a JPEG, PNG or WebP: {name}"
    return "not a JPEG, PNG or WebP: unknown format"
