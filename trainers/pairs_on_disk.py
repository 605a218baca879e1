"""Stereo pairs with ground truth, read from files as they are: one folder each, or scikit-image's motorcycle."""

from __future__ import annotations

import json
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from trainers.image_files import known, read_disparity, read_image, read_mask

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
PAIR_JSON = "pair.json"
PAIR_LAYOUT = "a pair is a folder with left.*, right.* (png, jpg, tif) and disp.* (pfm, png, tif, npy, npz)"


class StereoPair(NamedTuple):
    """One rectified pair: left (x, y) is right (x - disparity, y)."""

    name: str
    left: np.ndarray  # uint8 [H, W, 3], RGB
    right: np.ndarray
    disparity: np.ndarray  # float32 [H, W], pixels, left view; 0 where not valid
    valid: np.ndarray  # bool [H, W], left view: True where the disparity is known
    nonoccluded: np.ndarray | None  # bool [H, W], left view: True where the right camera sees the point; None where nobody knows
    group: str = ""  # which part of its benchmark it belongs to, such as the weather


@dataclass(frozen=True)
class PairFiles:
    """Where one pair lies."""

    name: str
    left: Path
    right: Path
    disparity: Path
    divisor: float | None = None
    nonoccluded: Path | None = None  # as `read_mask` takes it
    mask_tells_unknown: bool = False  # points where an 8-bit mask is 0 are not judged, whatever the disparity map says
    group: str = ""

    @property
    def paths(self) -> list[Path]:
        return [path for path in (self.left, self.right, self.disparity, self.nonoccluded) if path is not None]

    def read(self) -> StereoPair:
        """Raises FileNotFoundError or ValueError, naming the file, for what is missing, damaged or of another size."""
        left, right = read_image(self.left), read_image(self.right)
        disparity, valid = read_disparity(self.disparity, self.divisor)
        nonoccluded, unknown = (None, None) if self.nonoccluded is None else read_mask(self.nonoccluded)
        for path, array in ((self.right, right), (self.disparity, disparity), (self.nonoccluded, nonoccluded)):
            if array is not None and array.shape[:2] != left.shape[:2]:
                raise ValueError(f"{path} is {_size(array)} but {self.left.name} is {_size(left)}; all files of a pair have one size")
        if self.mask_tells_unknown and unknown is not None:
            valid = valid & ~unknown
            disparity = np.where(valid, disparity, np.float32(0))
        return StereoPair(self.name, left, right, disparity, valid, nonoccluded, self.group)


def find_pairs(root: str | PathLike[str]) -> list[Path]:
    """The folders below `root` (or `root` itself) that hold a file left.*, sorted by name; each is for `read_pair`."""
    root = Path(root)
    if not root.is_dir():
        raise FileNotFoundError(f"no folder {root}")
    if _files_called(root, "left"):
        return [root]
    folders = sorted(folder for folder in root.iterdir() if folder.is_dir() and _files_called(folder, "left"))
    if not folders:
        raise FileNotFoundError(f"no pair in {root}: {PAIR_LAYOUT}")
    return folders


def pair_files(folder: str | PathLike[str]) -> PairFiles:
    """The files of one folder's pair: left.*, right.*, disp.* and, if there, mask_left.png (255: visible in both views).

    What a stored disparity is divided by: "divisor" in the folder's pair.json, e.g. {"divisor": 3}; or the known divisor of a folder of
    this name; or as `read_disparity` has it.

    Raises:
        FileNotFoundError, ValueError: a file is missing or there twice, or pair.json is wrong.
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
    )


def read_pair(folder: str | PathLike[str]) -> StereoPair:
    """The pair of one folder, see `pair_files`.

    Raises:
        FileNotFoundError, ValueError: a file is missing, there twice, damaged, of another size, or of an unknown divisor.
    """
    return pair_files(folder).read()


def motorcycle() -> StereoPair:
    """Middlebury 2014's motorcycle at a quarter of its size, 741x500, from scikit-image."""
    try:
        from skimage.data import stereo_motorcycle
    except ImportError as error:
        raise ImportError("the motorcycle pair comes with scikit-image: pip install scikit-image") from error
    left, right, disparity = stereo_motorcycle()
    disparity, valid = known(np.asarray(disparity))
    return StereoPair("motorcycle", left, right, disparity, valid, None)


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
