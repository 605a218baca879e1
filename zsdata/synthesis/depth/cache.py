"""The depth cache: what a slow estimator said of a photo, kept on disk for the next epoch, worker, rank and run."""

from __future__ import annotations

import hashlib
import os

import numpy as np
from numpy.typing import NDArray

from zsdata.bounded_folder import NAME, BoundedFolder, Wording

from .cache_entry import CachedDepth, entry_bytes, pack_entry, read_entry

WORDING = Wording(
    kind="depth",
    title="the depth cache",
    without="depth that is not in it is estimated anew in every epoch",
    bound="depth_cache_bytes",
    others="what another estimator left",
)


def photo_digest(data: bytes) -> str:
    """Stands for a photo in a depth cache: sha256 of its file's bytes, hexadecimal (about 0.05 ms for 100 kB)."""
    return hashlib.sha256(data, usedforsecurity=False).hexdigest()


class DepthCache:
    """Depth maps on disk, one file per photo; a `BoundedFolder` with a shelf for each estimator, and as safe for many processes as that.

    What is of another version, estimator or photo, or damaged, is a miss, is removed and stored anew. May be pickled.

    Args:
        folder: made where it is missing; may be shared by estimators, each of which has its own folder in it.
        max_bytes: of all files of depth caches in `folder`. A map takes 3 bytes per pixel of its photo.
        identity: what the maps depend on besides the photo, see `depth_identity`.

    Raises:
        ValueError, TypeError: an argument that cannot work.
        OSError: the folder cannot be made, written or locked.
    """

    def __init__(self, folder: str | os.PathLike[str], max_bytes: int, identity: str) -> None:
        if not isinstance(identity, str) or not identity.strip():
            raise ValueError(f"identity is a string that names the estimator; got {identity!r}")
        self._kept = BoundedFolder(folder, max_bytes, identity, WORDING)
        self.folder = self._kept.folder
        self.max_bytes = max_bytes
        self.identity = identity

    def load(self, photo: str, rows: tuple[int, int] | None = None) -> CachedDepth | None:
        """The depth of a photo, or of some of its rows; None where it is not in the cache.

        Args:
            photo: as `photo_digest` returns it.
            rows: (first, stop), the second one excluded; None for all. A map with fewer rows is a miss. Compare `size` of the result with
                the photo's: a photo that is decoded to another size is to be stored anew.
        """
        if rows is not None and not 0 <= rows[0] < rows[1]:
            raise ValueError(f"rows are (first, stop) with 0 <= first < stop; got {rows!r}")
        digest = _checked(photo)
        return self._kept.load(photo, lambda descriptor, size: read_entry(descriptor, size, self._kept.digest, digest, rows))

    def store(self, photo: str, inverse_depth: NDArray[np.uint16], confidence: NDArray[np.uint8], consistency: float) -> bool:
        """Keeps the depth of a photo, in place of what was kept of it.

        Args:
            photo: as `photo_digest` returns it.
            inverse_depth: uint16 [h, w], 0..65535 for 0..1.
            confidence: uint8 [h, w], 0..255 for 0..1.
            consistency: mean flip consistency of the photo.

        Returns:
            Whether it is kept. It is not when the cache is full or its folder cannot be written, which is logged once as a warning.
        """
        digest = _checked(photo)
        if (
            (inverse_depth.dtype, confidence.dtype) != (np.uint16, np.uint8)
            or inverse_depth.ndim != 2
            or inverse_depth.shape != confidence.shape
            or not inverse_depth.size
        ):
            raise ValueError(
                f"inverse depth is uint16 and confidence uint8, both [h, w]; got {inverse_depth.dtype} {list(inverse_depth.shape)} "
                f"and {confidence.dtype} {list(confidence.shape)}"
            )
        parts = pack_entry(self._kept.digest, digest, inverse_depth, confidence, float(consistency))
        return self._kept.store(photo, entry_bytes(*inverse_depth.shape), parts)


def _checked(photo: str) -> bytes:
    if not NAME.fullmatch(photo):
        raise ValueError(f"a photo is named by photo_digest(data), 64 hexadecimal digits; got {photo!r}")
    return bytes.fromhex(photo)
