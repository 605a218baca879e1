"""Stereo pairs with ground truth, read from files as they are: one folder each, or scikit-image's motorcycle."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

# Stored value = divisor * disparity. The files do not say it; these are the divisors of well-known pairs by folder name.
DIVISORS = {
    "middlebury2001_venus": 8,
    "middlebury2003_teddy": 4,
    "middlebury2005_art": 3,
    "middlebury2005_moebius": 3,
    "middlebury2005_reindeer": 3,
    "middlebury2006_aloe": 1,
    "middlebury2006_cloth3": 2,
    "middlebury2006_wood2": 2,
}
KITTI_DIVISOR = 256  # 16-bit PNG as KITTI, DrivingStereo and others store it
PAIR_JSON = "pair.json"


class StereoPair(NamedTuple):
    """One rectified pair: left (x, y) is right (x - disparity, y)."""

    name: str
    left: np.ndarray  # uint8 [H, W, 3], RGB
    right: np.ndarray
    disparity: np.ndarray  # float32 [H, W], pixels, left view; 0 where not valid
    valid: np.ndarray  # bool [H, W], left view: True where the disparity is known
    nonoccluded: np.ndarray | None  # bool [H, W], left view: True where the right camera sees the point; None where nobody knows


@dataclass(frozen=True)
class PairFiles:
    """Where one pair lies."""

    name: str
    left: Path
    right: Path
    disparity: Path
    divisor: float | None = None
    nonoccluded: Path | None = None  # an image of the left view, 255 where visible in both views

    def read(self) -> StereoPair:
        """Raises FileNotFoundError or ValueError, naming the file, for what is missing, damaged or of another size."""
        left, right = read_image(self.left), read_image(self.right)
        disparity, valid = read_disparity(self.disparity, self.divisor)
        nonoccluded = None if self.nonoccluded is None else read_mask(self.nonoccluded)
        for path, array in ((self.right, right), (self.disparity, disparity), (self.nonoccluded, nonoccluded)):
            if array is not None and array.shape[:2] != left.shape[:2]:
                raise ValueError(f"{path} is {_size(array)} but {self.left.name} is {_size(left)}; all files of a pair have one size")
        return StereoPair(self.name, left, right, disparity, valid, nonoccluded)


def find_pairs(root: str | PathLike[str]) -> list[Path]:
    """The folders below `root` (or `root` itself) that hold a file left.*, sorted by name; each is for `read_pair`."""
    root = Path(root)
    if not root.is_dir():
        raise FileNotFoundError(f"no folder {root}")
    if _files_called(root, "left"):
        return [root]
    folders = sorted(folder for folder in root.iterdir() if folder.is_dir() and _files_called(folder, "left"))
    if not folders:
        raise FileNotFoundError(f"no pair in {root}: a pair is a folder with left.*, right.* and disp.* (png, jpg, tif; disp also pfm)")
    return folders


def read_pair(folder: str | PathLike[str]) -> StereoPair:
    """The pair of one folder: left.*, right.*, disp.* and, if there, mask_left.png (255: visible in both views).

    What a stored disparity is divided by: "divisor" in the folder's pair.json, e.g. {"divisor": 3}; or the known divisor of a folder of
    this name; or 256 for 16-bit PNG and 1 for PFM and TIFF.

    Raises:
        FileNotFoundError, ValueError: a file is missing, there twice, damaged, of another size, or of an unknown divisor.
    """
    folder = Path(folder)
    mask = folder / "mask_left.png"
    return PairFiles(
        name=folder.resolve().name,
        left=_one_file(folder, "left"),
        right=_one_file(folder, "right"),
        disparity=_one_file(folder, "disp"),
        divisor=_divisor(folder),
        nonoccluded=mask if mask.exists() else None,
    ).read()


def motorcycle() -> StereoPair:
    """Middlebury 2014's motorcycle at a quarter of its size, 741x500, from scikit-image."""
    try:
        from skimage.data import stereo_motorcycle
    except ImportError as error:
        raise ImportError("the motorcycle pair comes with scikit-image: pip install scikit-image") from error
    left, right, disparity = stereo_motorcycle()
    disparity, valid = _known(np.asarray(disparity))
    return StereoPair("motorcycle", left, right, disparity, valid, None)


def read_image(path: Path) -> np.ndarray:
    """RGB, uint8 [H, W, 3], of an 8-bit, 16-bit or float (0..255) image; grey becomes three equal channels, alpha is dropped."""
    image = _decode(path)
    if image.dtype == np.uint16:
        image = image / 257
    if image.dtype != np.uint8:
        image = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    if image.ndim == 2:
        return np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., 2::-1])


def read_mask(path: Path) -> np.ndarray:
    """bool [H, W]: True where the (first channel of the) image is 255."""
    mask = _decode(path)
    return (mask if mask.ndim == 2 else mask[..., 0]) == 255


def read_disparity(path: str | PathLike[str], divisor: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """A disparity map from PNG (8 or 16 bit), TIFF or PFM.

    Args:
        path: the file. PFM in either byte order.
        divisor: what a stored value is divided by; None: 256 for 16 bit, 1 for floating point, an error for 8 bit.
    Returns:
        disparity, float32 [H, W], pixels, and valid, bool [H, W]: False where the file holds 0, inf, NaN or a negative value (the
        disparity is 0 there).
    """
    path = Path(path)
    stored = _decode_pfm(path) if path.suffix.lower() == ".pfm" else _decode(path)
    if stored.ndim != 2:
        raise ValueError(f"{path} has {stored.shape[2]} channels; a disparity map has one")
    if divisor is None:
        if stored.dtype == np.uint8:
            raise ValueError(f'{path} is 8-bit and does not say its divisor; put {{"divisor": N}} into {path.parent / PAIR_JSON}')
        divisor = KITTI_DIVISOR if stored.dtype == np.uint16 else 1
    return _known(stored / np.float32(divisor))


def _known(disparity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    valid = np.isfinite(disparity) & (disparity > 0)
    return np.where(valid, disparity, 0).astype(np.float32), valid


def _divisor(folder: Path) -> float | None:
    path = folder / PAIR_JSON
    if not path.exists():
        return DIVISORS.get(folder.resolve().name)
    try:
        content = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is not JSON: {error}") from error
    divisor = content.get("divisor") if isinstance(content, dict) else None
    if not isinstance(divisor, (int, float)) or isinstance(divisor, bool) or not divisor > 0:
        raise ValueError(f'{path} is to hold {{"divisor": N}} with a positive number; got {content}')
    return divisor


def _decode(path: Path) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(_content(path), np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"{path} is no image that OpenCV can read, or is damaged")
    return image


def _decode_pfm(path: Path) -> np.ndarray:
    content = _content(path)
    header = re.match(rb"(P[fF])\s+(\d+)\s+(\d+)\s+([-+.\deE]+)[ \t\r]*\n", content)
    if header is None:
        raise ValueError(f"{path} does not begin as a PFM file does (Pf, width, height, scale)")
    kind, width, height, scale = header[1], int(header[2]), int(header[3]), float(header[4])
    channels = 3 if kind == b"PF" else 1
    values = content[header.end() :]
    if len(values) != 4 * width * height * channels:
        raise ValueError(f"{path} holds {len(values):,} of the {4 * width * height * channels:,} bytes of {width} x {height} values")
    stored = np.frombuffer(values, "<f4" if scale < 0 else ">f4").reshape(height, width, channels)[::-1]
    return stored.astype(np.float32) if channels == 3 else stored[..., 0].astype(np.float32)


def _content(path: Path) -> bytes:
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}")
    content = path.read_bytes()
    if not content:
        raise ValueError(f"{path} is empty")
    return content


def _files_called(folder: Path, stem: str) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.stem == stem and path.is_file())


def _one_file(folder: Path, stem: str) -> Path:
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder {folder}")
    files = _files_called(folder, stem)
    if len(files) != 1:
        found = ", ".join(path.name for path in files) or "none"
        raise FileNotFoundError(f"{folder} is to hold one file {stem}.*; found {found}")
    return files[0]


def _size(array: np.ndarray) -> str:
    return f"{array.shape[1]} x {array.shape[0]} px"
