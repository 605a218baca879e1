"""Disparity and depth maps from the bytes of a file: PNG, PFM, NPY."""

from __future__ import annotations

import io
from typing import NamedTuple

import cv2
import numpy as np

from trainers.pfm import parse_pfm
from zsdata.faults import BadPhoto

MAP_EXTENSIONS = ("png", "pfm", "npy")
SPARSE_TRUTH = "sparse truth"  # the reason that such pairs are counted by: no failure, as outdoor scenes of Falling Things have it
LEAST_KNOWN = 0.5  # share of a map; what nobody knows becomes a hole, and where a lidar tells the truth that is most of the example


class StereoFrame(NamedTuple):
    """A rectified pair with the truth of at least its left view: left (x, y) is right (x - disparity, y)."""

    left: np.ndarray  # uint8 [H, W, 3], RGB
    right: np.ndarray
    disparity: np.ndarray  # float32 [H, W], pixels, left view, > 0; NaN where nobody knows
    right_disparity: np.ndarray | None  # the same of the right view: right (x, y) is left (x + disparity, y)

    def checked(self) -> StereoFrame:
        """Itself; raises BadPhoto where its parts differ in size or a truth is empty or sparse."""
        for name, part in (("right image", self.right), ("disparity", self.disparity), ("right disparity", self.right_disparity)):
            if part is not None and part.shape[:2] != self.left.shape[:2]:
                height, width = self.left.shape[:2]
                raise BadPhoto(f"sizes differ: the {name} is {part.shape[1]} x {part.shape[0]}, the left image {width} x {height}")
        for name, disparity in (("disparity map", self.disparity), ("right disparity map", self.right_disparity)):
            if disparity is not None and (known := np.isfinite(disparity).mean()) < LEAST_KNOWN:
                if not known:
                    raise BadPhoto(f"no truth: nothing of the {name} is known")
                raise BadPhoto(f"{SPARSE_TRUTH}: {int(100 * known)} % of the {name} is known, half is needed")
        return self


def decode_map(data: bytes, extension: str) -> np.ndarray:
    """The numbers of a map as they are stored: float32 [H, W], upright.

    Args:
        data: the file.
        extension: "png" (one channel, 16 bits), "pfm" (one channel, either byte order) or "npy" (numbers; a pickled array is refused).

    Raises:
        BadPhoto: damaged, cut off, or another kind of file.
    """
    if extension == "pfm":
        return _decode_pfm(data)
    if extension == "npy":
        return _decode_npy(data)
    stored = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if stored is None or stored.dtype != np.uint16 or stored.ndim != 2:
        found = "no image" if stored is None else f"{stored.dtype} {list(stored.shape)}"
        raise BadPhoto(f"damaged map: a 16-bit PNG of one channel was expected, found {found}")
    return stored.astype(np.float32)


def _decode_pfm(data: bytes) -> np.ndarray:
    try:
        stored = parse_pfm(data)
    except ValueError as error:
        raise BadPhoto(f"damaged map: it {error}") from error
    if stored.ndim != 2:
        raise BadPhoto("damaged map: a PFM file of one channel was expected, found one in colour")
    return stored


def _decode_npy(data: bytes) -> np.ndarray:
    if not data.startswith(b"\x93NUMPY"):
        raise BadPhoto("damaged map: it does not begin as an NPY file does")
    try:
        stored = np.load(io.BytesIO(data), allow_pickle=False)  # a pickled array could run code
    except (ValueError, EOFError, OSError) as error:
        raise BadPhoto(f"damaged map: {error}") from error
    if stored.ndim != 2 or stored.dtype.kind not in "fiu":
        raise BadPhoto(f"damaged map: numbers [H, W] were expected, found {stored.dtype} {list(stored.shape)}")
    return stored.astype(np.float32)
