"""Images, masks and disparity maps, read from the files in which stereo benchmarks keep them."""

from __future__ import annotations

from io import BytesIO
from os import PathLike
from pathlib import Path
from zipfile import BadZipFile

import cv2
import numpy as np

from trainers.pfm import parse_pfm

KITTI_DIVISOR = 256  # 16-bit PNG as KITTI and others store it
ARRAY_SUFFIXES = (".npy", ".npz")
NPZ_NAMES = ("disparity", "disp")  # which array it is where a .npz file holds several


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


def read_mask(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Which points both cameras see, as benchmarks store it.

    Args:
        path: an 8-bit image, of which the first channel counts: 255 seen by both, 0 unknown, anything else occluded. Or a 16-bit
            disparity map of only the points that both see, such as KITTI's disp_noc.
    Returns:
        nonoccluded, bool [H, W], and unknown, bool [H, W]: True where an 8-bit mask is 0.
    """
    mask = _decode(path)
    if mask.ndim == 3:
        mask = mask[..., 0]
    if mask.dtype == np.uint16:
        return mask > 0, np.zeros_like(mask, bool)
    return mask == 255, mask == 0


def read_disparity(path: str | PathLike[str], divisor: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """A disparity map from PFM (either byte order), PNG (8 or 16 bit), TIFF, .npy or .npz.

    Args:
        path: the file. Of several equal channels one is taken. A .npz file holds one array, or one called "disparity" or "disp".
        divisor: what a stored value is divided by; None: 256 for 16-bit images, 1 for floating point, an error for all else.
    Returns:
        disparity, float32 [H, W], pixels, and valid, bool [H, W]: False where the file holds 0, inf, NaN or a negative value (the
        disparity is 0 there).
    Raises:
        FileNotFoundError, ValueError: naming the file.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    stored = _decode_pfm(path) if suffix == ".pfm" else _decode_array(path) if suffix in ARRAY_SUFFIXES else _decode(path)
    stored = _one_channel(path, stored)
    if divisor is None:
        if stored.dtype == np.uint16 and suffix not in ARRAY_SUFFIXES:
            divisor = KITTI_DIVISOR
        elif np.issubdtype(stored.dtype, np.floating):
            divisor = 1
        else:
            kind = "8-bit" if stored.dtype == np.uint8 else stored.dtype
            raise ValueError(f'{path} is {kind} and does not say its divisor; put {{"divisor": N}} into {path.parent / "pair.json"}')
    return known(stored / np.float32(divisor))


def known(disparity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The map as float32, 0 where it has no value, and where it has one: finite and above 0."""
    valid = np.isfinite(disparity) & (disparity > 0)
    return np.where(valid, disparity, 0).astype(np.float32), valid


def _one_channel(path: Path, stored: np.ndarray) -> np.ndarray:
    if stored.ndim == 3 and all(np.array_equal(stored[..., 0], stored[..., i], equal_nan=True) for i in range(1, stored.shape[2])):
        stored = stored[..., 0]
    if stored.ndim != 2:
        shape = f"{stored.shape[2]} channels that differ" if stored.ndim == 3 else f"the shape {list(stored.shape)}"
        raise ValueError(f"{path} has {shape}; a disparity map has one channel [H, W]")
    return stored


def _decode(path: Path) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(_content(path), np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"{path} is no image that OpenCV can read, or is damaged")
    return image


def _decode_array(path: Path) -> np.ndarray:
    content = _content(path)
    try:
        loaded = np.load(BytesIO(content), allow_pickle=False)  # a pickled array could run code
        if not isinstance(loaded, np.ndarray):
            with loaded as archive:
                names = list(archive.files)
                chosen = names if len(names) == 1 else [name for name in NPZ_NAMES if name in names]
                if not chosen:
                    raise ValueError(f'it holds {", ".join(names) or "no array"}, and none is called "disparity" or "disp"')
                loaded = archive[chosen[0]]
    except (ValueError, OSError, EOFError, BadZipFile) as error:
        raise ValueError(f"{path} is no array that NumPy can read: {error}") from error
    if loaded.dtype.kind not in "fiu":
        raise ValueError(f"{path} holds {loaded.dtype}; a disparity map holds numbers")
    return loaded[0] if loaded.ndim == 3 and len(loaded) == 1 else loaded


def _decode_pfm(path: Path) -> np.ndarray:
    content = _content(path)
    try:
        return parse_pfm(content)
    except ValueError as error:
        raise ValueError(f"{path} {error}") from error


def _content(path: Path) -> bytes:
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}")
    content = path.read_bytes()
    if not content:
        raise ValueError(f"{path} is empty")
    return content
