"""Stereo pairs with ground truth in WebDataset tars: KEY.left.png, KEY.right.png, KEY.disp.pfm, all of one key a pair.

    KEY.left.EXT, KEY.right.EXT    the images; EXT is png, jpg, jpeg or webp
    KEY.disp.EXT                   disparity of the left view: .pfm or .npy in pixels, .png of 16 bits 256 times that
    KEY.disp_right.EXT             the same of the right view, where it is known

0, inf and NaN mean that nobody knows; of each map at least half is to be known. The sign of a map that is nowhere above 0 is the direction
of the shift, as some releases of Scene Flow write it for the right view, and counts for nothing, unless all of it is one value, such as -1;
in other maps what is below 0 is unknown. Nothing is unpacked and nothing in a tar is ever run.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from trainers.inpaint_data.stored_maps import MAP_EXTENSIONS, StereoFrame, decode_map
from zsdata.faults import BadShard
from zsdata.source.archive import PHOTO_EXTENSIONS, split_name
from zsdata.source.photo import decode_rgb
from zsdata.source.ranges import ShardFile, read_range
from zsdata.source.tar import walk_tar
from zsdata.source.urls import base_name, expand_urls

logger = logging.getLogger("zsdata")

PNG_DIVISOR = 256  # as KITTI stores disparity
NEEDED = ("left", "right", "disp")
PARTS = (*NEEDED, "disp_right")


class _Part(NamedTuple):
    extension: str
    offset: int
    size: int


class _Pair(NamedTuple):
    shard: int
    key: str
    parts: dict[str, _Part]


class StereoTars:
    """The pairs of some tars, in the order of the shards and of the first member of each pair.

    Args:
        urls: as `zsdata.ImageSource` takes them.

    Raises:
        ValueError: not one whole pair.
        FileNotFoundError and others: as `expand_urls` raises them.
    """

    def __init__(self, urls: str | os.PathLike[str] | Sequence[str | os.PathLike[str]]) -> None:
        self._urls = expand_urls(urls)
        self._pairs: list[_Pair] = []
        faults, incomplete = list[BadShard](), list[str]()
        for number, url in enumerate(self._urls):
            for key, parts in _pairs_of(url, faults).items():
                if missing := [name for name in NEEDED if name not in parts]:
                    incomplete.append(f'"{key}" in {url} lacks {", ".join(f"{key}.{name}.*" for name in missing)}')
                else:
                    self._pairs.append(_Pair(number, key, parts))
        problems = [str(fault) for fault in faults] + incomplete
        if not self._pairs:
            found = f"; {problems[0]}" if problems else ""
            raise ValueError(
                f"no stereo pair in {', '.join(map(str, self._urls[:3]))}: a pair is KEY.left.png, KEY.right.png, KEY.disp.pfm{found}"
            )
        if problems:
            logger.warning("%d faults in the tars of pairs, the first: %s", len(problems), problems[0])

    def __len__(self) -> int:
        return len(self._pairs)

    @property
    def digest(self) -> str:
        """Changes with the shards' names, the pairs and where they lie in their shards."""
        content = [(base_name(self._urls[shard]), key, sorted(parts.items())) for shard, key, parts in self._pairs]
        return hashlib.sha256(repr(content).encode("utf-8", "surrogateescape")).hexdigest()

    def place(self, index: int) -> tuple[str, str]:
        """The shard and the key."""
        return self._urls[self._pairs[index].shard], self._pairs[index].key

    def read(self, index: int) -> StereoFrame:
        """Pair `index`; raises BadPhoto or BadShard where a part is damaged."""
        left, right = (decode_rgb(self._bytes(index, name)) for name in ("left", "right"))
        right_disparity = self._disparity(index, "disp_right") if "disp_right" in self._pairs[index].parts else None
        return StereoFrame(left, right, self._disparity(index, "disp"), right_disparity).checked()

    def _bytes(self, index: int, name: str) -> bytes:
        shard, key, parts = self._pairs[index]
        return read_range(self._urls[shard], parts[name].offset, parts[name].size, inside=f'"{key}.{name}"')

    def _disparity(self, index: int, name: str) -> np.ndarray:
        extension = self._pairs[index].parts[name].extension
        stored = decode_map(self._bytes(index, name), extension) / (PNG_DIVISOR if extension == "png" else 1)
        stored = np.where(np.isfinite(stored), stored, 0)
        if not (stored > 0).any() and len(np.unique(stored[stored < 0])) > 1:  # one value, such as -1, stands for what nobody knows
            stored = -stored
        return np.where(stored > 0, stored, np.nan).astype(np.float32)


def _pairs_of(url: str, faults: list[BadShard]) -> dict[str, dict[str, _Part]]:
    """All that belongs to a pair, by key and name of the part."""
    found: dict[str, dict[str, _Part]] = {}
    with ShardFile(url) as file:
        for member in walk_tar(file, faults.append):
            key, ending = split_name(member.name) or ("", "")
            name, _, extension = ending.partition(".")
            allowed = PHOTO_EXTENSIONS if name in ("left", "right") else MAP_EXTENSIONS if name in PARTS else ()
            if member.kind == "file" and extension in allowed:
                found.setdefault(key, {}).setdefault(name, _Part(extension, member.offset, member.size))
    return found
