"""The shard cache: ranges of remote shards, kept on a local disk for the next epoch, worker, rank and run."""

from __future__ import annotations

import hashlib
import json
import os
import struct
import zlib

from zsdata.bounded_folder import BadEntry, BoundedFolder, Wording
from zsdata.source.retry import Stamp

HEADER = struct.Struct("<8s32sQI")  # magic, what range it is (sha256), its bytes, CRC-32 of all before it and of the bytes
MAGIC = b"zsrange\n"
IDENTITY = "ranges of remote shards"
WORDING = Wording(
    kind="shard",
    title="the shard cache",
    without="what is not in it is read from its server in every epoch",
    bound="shard_cache_bytes",
    others="what is not needed any more",
)


class ShardCache:
    """Photos of remote shards on disk, one file each; a `BoundedFolder`, and as safe for many processes as that.

    A range is known by its url, the shard's stamp, offset and size, so a shard that was replaced is read anew. What it left stays until the
    folder is removed. Loading asks no server. What is damaged is a miss, is removed and stored anew. May be pickled.

    Args:
        folder: made where it is missing.
        max_bytes: of all files of shard caches in `folder`, each counted in whole blocks of 4 KiB. A full cache keeps what it has.

    Raises:
        ValueError, TypeError: an argument that cannot work.
        OSError: the folder cannot be made, written or locked.
    """

    def __init__(self, folder: str | os.PathLike[str], max_bytes: int) -> None:
        self._kept = BoundedFolder(folder, max_bytes, IDENTITY, WORDING)
        self.folder = self._kept.folder
        self.max_bytes = max_bytes

    def load(self, url: str, stamp: Stamp, offset: int, size: int) -> bytes | None:
        """The bytes [offset, offset + size) of the shard at `url` as it was stamped; None where they are not in the cache."""
        name = _name(url, stamp, offset, size)

        def read(descriptor: int, length: int) -> bytes:
            if length != HEADER.size + size:
                raise BadEntry(f"{length:,} bytes instead of {HEADER.size + size:,}")
            entry = os.pread(descriptor, length, 0)
            data = entry[HEADER.size :]
            if entry[: HEADER.size] != _header(name, data):
                raise BadEntry("damaged, or of another range")
            return data

        return self._kept.load(name, read)

    def store(self, url: str, stamp: Stamp, offset: int, data: bytes) -> bool:
        """Keeps bytes of a shard; whether they are kept, see `BoundedFolder.store`."""
        name = _name(url, stamp, offset, len(data))
        return self._kept.store(name, HEADER.size + len(data), (_header(name, data), data))


def _name(url: str, stamp: Stamp, offset: int, size: int) -> str:
    """The whole url counts, its query too: two shards of one server may differ in nothing else."""
    text = json.dumps([url, dict(stamp), offset, size], sort_keys=True)
    return hashlib.sha256(text.encode("ascii"), usedforsecurity=False).hexdigest()


def _header(name: str, data: bytes) -> bytes:
    begin = MAGIC + bytes.fromhex(name) + len(data).to_bytes(8, "little")
    return HEADER.pack(MAGIC, bytes.fromhex(name), len(data), zlib.crc32(data, zlib.crc32(begin)))
