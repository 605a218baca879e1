"""The orientation in EXIF data."""

from __future__ import annotations

import struct

import cv2
import numpy as np

_ORIENTATION_TAG = 0x0112
_SHORT, _LONG = 3, 4

_UPRIGHT = {  # what brings a photo upright, by the value of the tag
    2: lambda image: cv2.flip(image, 1),
    3: lambda image: cv2.rotate(image, cv2.ROTATE_180),
    4: lambda image: cv2.flip(image, 0),
    5: lambda image: cv2.transpose(image),
    6: lambda image: cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE),
    7: lambda image: cv2.rotate(cv2.transpose(image), cv2.ROTATE_180),
    8: lambda image: cv2.rotate(image, cv2.ROTATE_90_COUNTERCLOCKWISE),
}


def read_orientation(exif: bytes) -> int:
    """1..8 from a TIFF structure (with or without "Exif" before it); 1, upright, where it says nothing sensible."""
    tiff = exif.removeprefix(b"Exif\0\0")
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(tiff[:4])
    if order is None:
        return 1
    try:
        (directory,) = struct.unpack_from(order + "I", tiff, 4)
        (entries,) = struct.unpack_from(order + "H", tiff, directory)
        for entry in range(directory + 2, directory + 2 + 12 * entries, 12):
            tag, kind, count = struct.unpack_from(order + "HHI", tiff, entry)
            if tag == _ORIENTATION_TAG:
                if count != 1 or kind not in (_SHORT, _LONG):
                    return 1
                (value,) = struct.unpack_from(order + ("H" if kind == _SHORT else "I"), tiff, entry + 8)
                return value if 1 <= value <= 8 else 1
    except struct.error:  # ends inside: no orientation, and no reason to lose the photo
        pass
    return 1


def make_upright(image: np.ndarray, orientation: int) -> np.ndarray:
    """A stored image [H, W, 3] or map [H, W] as it is meant to be seen; the sides swap for orientations 5 to 8."""
    turn = _UPRIGHT.get(orientation)
    return image if turn is None else turn(image)
