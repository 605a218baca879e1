"""OpenCV's image decoder as zsdata uses it: stored orientation, RGB, and BadPhoto for whatever it cannot decode."""

from __future__ import annotations

import cv2
import numpy as np

from zsdata.faults import BadPhoto

BAND_PX = 1 << 20  # pixels blended at a time

_REDUCED = {1: 0, 2: 16, 4: 32, 8: 64}  # the bits of cv2.IMREAD_REDUCED_COLOR_2, _4 and _8
_RGB = getattr(cv2, "IMREAD_COLOR_RGB", None)  # OpenCV 4.11 and later


def decode_color(data: bytes, reduction: int = 1) -> np.ndarray:
    """Any image without alpha to uint8 [H, W, 3] RGB, as stored (EXIF not applied).

    Args:
        reduction: 1, 2, 4 or 8: each side is decoded at one part in so many. A JPEG's decoder then leaves out the finer frequencies.
    """
    flags = _REDUCED[reduction] | cv2.IMREAD_IGNORE_ORIENTATION
    if _RGB is not None:
        return _decode(data, _RGB | flags)
    image = _decode(data, cv2.IMREAD_COLOR | flags)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)


def decode_over_white(data: bytes, transparent_grey: int | None = None) -> np.ndarray:
    """An image that may have alpha or 16 bits to uint8 [H, W, 3] RGB, transparency laid over white, as stored (EXIF not applied).

    Args:
        transparent_grey: the value that a grey PNG declares transparent, at the depth it is decoded to.
    """
    image = decode_unchanged(data)
    if image.dtype not in (np.uint8, np.uint16) or (image.ndim == 3 and image.shape[2] not in (3, 4)):
        raise BadPhoto(f"damaged: decodes to {image.dtype} {image.shape}")
    height, width = image.shape[:2]
    rgb = np.empty((height, width, 3), np.uint8)
    rows = max(1, BAND_PX // width)  # at a time, as the steps between take several times the photo's bytes
    for top in range(0, height, rows):
        rgb[top : top + rows] = _over_white(image[top : top + rows], transparent_grey)
    return rgb


def decode_unchanged(data: bytes) -> np.ndarray:
    """Any image with the channels (BGR, BGRA) and the depth that its file has, as stored (EXIF not applied)."""
    return _decode(data, cv2.IMREAD_UNCHANGED)  # which also leaves the orientation alone


def _over_white(image: np.ndarray, transparent_grey: int | None) -> np.ndarray:
    """Grey, BGR or BGRA of 8 or 16 bits to RGB of 8."""
    see_through = image == transparent_grey if transparent_grey is not None and image.ndim == 2 else None
    if image.dtype == np.uint16:
        image = ((image.astype(np.uint32) + 128) // 257).astype(np.uint8)  # 65535 is 255 * 257
    if image.ndim == 2:
        if see_through is not None:
            image = np.where(see_through, np.uint8(255), image)
        return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
    if image.shape[2] == 3:
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    alpha = image[..., 3:].astype(np.uint16)
    blend = (image[..., 2::-1] * alpha + 255 * (255 - alpha) + 127) // 255  # at most 65,152: fits 16 bits
    return blend.astype(np.uint8)


def _decode(data: bytes, flags: int) -> np.ndarray:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        if error.code == cv2.Error.StsNoMem:
            raise MemoryError(f"no memory to decode a photo: {error}") from error
        raise BadPhoto("damaged: cannot be decoded") from error
    if image is None:
        raise BadPhoto("damaged: cannot be decoded")
    return image
