"""Pairs on disk as ZeroStereo publishes them: where each file lies, what is in it, and how it is read back.

=======================  ======================================================================================================
below the folder         holds
=======================  ======================================================================================================
filelist.txt             a line per pair: the six paths that follow, in this order, relative to the folder, one space between them
left/NAME.jpg            8-bit RGB; JPEG, so a little off the image that was warped (see JPEG_QUALITY)
right/NAME.png           8-bit RGB, without loss
disparity/NAME.npy       float32 [H, W], pixels, > 0, left view: left (x, y) is right (x - d, y)
confidence/NAME.npy      float32 [H, W], 0..1, left view
mask_nocc/NAME.png       8-bit grey, left view: 255 where the left pixel is visible in the right image, else 0
mask_inpaint/NAME.png    8-bit grey, right view: 255 where the right pixel was invented, else 0
meta/NAME.json           where the pair comes from and how it was drawn; of zsdata, the published code passes over it
=======================  ======================================================================================================

The layout is that of the code at github.com/Windsrain/ZeroStereo: folders and extensions of `convert_filepath` in util/util.py (there, the
left photo may lie in any folder called "left"); lines of the list and how files are read (a mask is True at exactly 255, a label valid
where the disparity is > 0) of `ZeroDataset` and `MfS35K` in dataset/zero_dataset.py; values of generate_mono.py and generate_stereo.py.
Two differences: the published left image is the original file, and the published disparity is stored as float64, to be read as float32.

To train the published code on an export: `train_stereo.py train_set.MfS35K.instance.root=FOLDER
train_set.MfS35K.instance.filelist=FOLDER/filelist.txt`.
"""

from __future__ import annotations

import io
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from torch import Tensor

from zsdata.sample import StereoBatch
from zsdata.source.urls import base_name

FILE_LIST = "filelist.txt"
META = "meta"
KINDS = (("left", "jpg"), ("right", "png"), ("disparity", "npy"), ("confidence", "npy"), ("mask_nocc", "png"), ("mask_inpaint", "png"))
FOLDERS = (*(kind for kind, _ in KINDS), META)

# With full colour resolution (4:4:4). Measured on crops of 31 photos: 0.66 grey levels off on average, 11 at most, 0.78 bytes a pixel; at
# quality 95 with 4:2:0, OpenCV's default, 1.5, 31 and 0.47. All of a pair takes about 10 bytes a pixel.
JPEG_QUALITY = 98
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
MAX_JPEG_SIDE = 65_500  # pixels; of libjpeg

# Characters of a file name spent on each part; with the place and the extension far below the 255 that file systems take.
MAX_SOURCE, MAX_SHARD, MAX_KEY = 40, 60, 100


class ExportedPair(NamedTuple):
    """The files of one pair, in the order of the file list."""

    left: Path
    right: Path
    disparity: Path
    confidence: Path
    nonocclusion: Path
    inpaint: Path


class LoadedPair(NamedTuple):
    """One pair, read: images uint8 [H, W, 3] RGB, disparity and confidence float32 [H, W], masks bool [H, W]; frames as in the table."""

    left: np.ndarray
    right: np.ndarray
    disparity: np.ndarray
    confidence: np.ndarray
    nonocclusion: np.ndarray
    inpaint: np.ndarray


def read_exported(folder: str | os.PathLike[str]) -> list[ExportedPair]:
    """The pairs that the folder's file list names, in its order.

    Raises:
        FileNotFoundError: there is no file list.
        ValueError: a line of it does not hold six paths.
    """
    path = Path(folder) / FILE_LIST
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; `zsdata export` writes it")
    return [pair_of_line(folder, line, number) for number, line in enumerate(path.read_text().splitlines(), start=1)]


def load_exported(entry: ExportedPair) -> LoadedPair:
    """Reads the files of one pair.

    Raises:
        FileNotFoundError, ValueError: a file is missing or damaged; it is named.
    """
    left, right = _read_image(entry.left, cv2.IMREAD_COLOR), _read_image(entry.right, cv2.IMREAD_COLOR)
    return LoadedPair(
        cv2.cvtColor(left, cv2.COLOR_BGR2RGB, dst=left),
        cv2.cvtColor(right, cv2.COLOR_BGR2RGB, dst=right),
        np.load(entry.disparity).astype(np.float32, copy=False),
        np.load(entry.confidence).astype(np.float32, copy=False),
        _read_image(entry.nonocclusion, cv2.IMREAD_GRAYSCALE) == 255,
        _read_image(entry.inpaint, cv2.IMREAD_GRAYSCALE) == 255,
    )


def place_name(epoch: int, index: int) -> str:
    """What the names of a sample's files begin with; no two samples share it."""
    return f"e{epoch:03d}-i{index:07d}-"


def pair_name(meta: Mapping[str, Any]) -> str:
    """Epoch, index, source, shard and key of a pair as a file name without extension: ASCII letters, digits, "-" and "_" only.

    Long keys keep their end; `meta/NAME.json` has them whole.
    """
    source, shard, key = (re.sub(r"[^A-Za-z0-9_-]", "_", part) for part in (meta["source"], _stem(meta["shard"]), meta["key"]))
    return place_name(meta["epoch"], meta["index"]) + f"{source[:MAX_SOURCE]}-{shard[:MAX_SHARD]}-{key[-MAX_KEY:]}"


def file_list_line(name: str) -> str:
    """The line of the file list for the pair of this name, without its end."""
    return " ".join(f"{kind}/{name}.{extension}" for kind, extension in KINDS)


def pair_of_line(folder: str | os.PathLike[str], line: str, number: int) -> ExportedPair:
    """The files that line `number` (from 1) of the folder's file list names."""
    paths = line.split(" ")
    if len(paths) != len(KINDS):
        raise ValueError(f"{Path(folder) / FILE_LIST}, line {number}: a pair has {len(KINDS)} paths with one space between; got {line!r}")
    return ExportedPair(*(Path(folder, path) for path in paths))


def meta_file(pair: ExportedPair) -> Path:
    """Where the JSON of an exported pair lies."""
    return pair.left.parent.parent / META / f"{pair.left.stem}.json"


def encode_pair(pair: StereoBatch) -> dict[str, bytes]:
    """The content of a pair's files, by path below the folder; meta last.

    Args:
        pair: a single finished pair on the CPU; what is written is its clean images.

    Raises:
        ValueError: the pair is too large for a JPEG.
    """
    name = pair_name(pair.meta)
    height, width = pair.left_clean.shape[-2:]
    if max(height, width) > MAX_JPEG_SIDE:
        raise ValueError(f"{name} is {width:,} x {height:,} px and a JPEG has at most {MAX_JPEG_SIDE:,} a side; export crops (--size)")
    contents = (
        _encode_image("jpg", _bgr(pair.left_clean), _JPEG),
        _encode_image("png", _bgr(pair.right_clean), []),
        _encode_array(pair.disparity),
        _encode_array(pair.confidence),
        _encode_image("png", pair.masks.nonocclusion[0].numpy().astype(np.uint8) * 255, []),
        _encode_image("png", pair.masks.inpaint[0].numpy().astype(np.uint8) * 255, []),
    )
    files = {f"{kind}/{name}.{extension}": content for (kind, extension), content in zip(KINDS, contents, strict=True)}
    return {**files, f"{META}/{name}.json": _encode_meta(pair.meta)}


def _encode_meta(meta: Mapping[str, Any]) -> bytes:
    """Shards by name only: where they lie may hold an access token, and the same shards give the same export anywhere."""
    replaced = [[source, base_name(shard), key, reason] for source, shard, key, reason in meta["replaced"]]
    return (json.dumps({**meta, "shard": base_name(meta["shard"]), "replaced": replaced}, indent=1) + "\n").encode()


def _encode_image(extension: str, image: np.ndarray, options: list[int]) -> bytes:
    encoded, data = cv2.imencode(f".{extension}", image, options)
    if not encoded:
        raise RuntimeError(f"OpenCV cannot write {image.shape} as {extension}")
    return data.tobytes()


def _encode_array(label: Tensor) -> bytes:
    """float32 [1, H, W] to the bytes of an .npy of [H, W]."""
    file = io.BytesIO()
    np.save(file, label[0].numpy())
    return file.getvalue()


def _bgr(image: Tensor) -> np.ndarray:
    """float [3, H, W] RGB 0..255 to what OpenCV writes, rounded."""
    rgb = image.round().byte().permute(1, 2, 0).contiguous().numpy()
    return cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)


def _read_image(path: Path, flags: int) -> np.ndarray:
    image = cv2.imread(os.fspath(path), flags)
    if image is None:
        if not path.is_file():
            raise FileNotFoundError(f"{path} is named by the file list but does not exist")
        raise ValueError(f"{path} is no image that OpenCV can read, or is damaged; export it again")
    return image


def _stem(url: str) -> str:
    return base_name(url).removesuffix(".tar")
