"""What photos a source holds and where each of them lies, found once."""

from __future__ import annotations

import hashlib
import logging
import os
import sys
import zlib
from array import array
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from zsdata.faults import BadPhoto
from zsdata.progress import Progress
from zsdata.source.archive import Problem, header_inside
from zsdata.source.index import CHANGED_BYTES, CHANGED_DEPTH, CHECKSUM_UNKNOWN, NO_DEPTH, load_or_list, shard_stamp
from zsdata.source.ranges import ShardFile, read_range
from zsdata.source.retry import Stamp
from zsdata.source.shard_cache import ShardCache
from zsdata.source.tar import walk_tar
from zsdata.source.urls import base_name, expand_urls, local_path, shown_url

logger = logging.getLogger("zsdata")


class Member(NamedTuple):
    """One photo: `size` bytes at `offset` of a shard, whose url is as it may stand in messages."""

    shard_url: str
    key: str
    offset: int
    size: int


@dataclass(frozen=True, eq=False)
class Manifest:
    """The photos of one source in the order of its shards and of their members; small enough to send to every worker.

    `digest` (sha256, hexadecimal) stands for all of it but the folder or host that the shards lie in: the same shards have the same digest
    anywhere. `problems` lists what could not be taken.
    """

    shard_urls: tuple[str, ...]
    shard_sizes: tuple[int, ...]  # bytes
    shard_numbers: np.ndarray  # [N] int32, into shard_urls
    offsets: np.ndarray  # [N] int64, bytes
    sizes: np.ndarray  # [N] int32, bytes
    key_text: bytes  # all keys, one after the other
    key_ends: np.ndarray  # [N] int64, into key_text
    problems: tuple[Problem, ...]
    digest: str
    stamps: tuple[Stamp, ...] | None = None  # what changes with each shard, see `ShardFile`
    checksums: np.ndarray | None = None  # [N] int64, CRC-32 of the bytes where an index knows it, else CHECKSUM_UNKNOWN
    depth_offsets: np.ndarray | None = None  # [N] int64, bytes; NO_DEPTH of a photo without a depth map; None: no photo has one
    depth_sizes: np.ndarray | None = None  # [N] int32, bytes
    depth_checksums: np.ndarray | None = None  # [N] int64

    def __len__(self) -> int:
        """How many photos."""
        return len(self.offsets)

    @property
    def depth_maps(self) -> int:
        """How many of the photos have a depth map."""
        return 0 if self.depth_offsets is None else int(np.count_nonzero(self.depth_offsets != NO_DEPTH))

    def is_current(self, urls: str | os.PathLike[str] | Sequence[str | os.PathLike[str]]) -> bool:
        """Whether `urls` still name the shards that were listed, and none of the local ones has changed. Servers are not asked.

        Raises:
            FileNotFoundError and others: as `expand_urls` raises them.
        """
        return tuple(expand_urls(urls)) == self.shard_urls and all(
            local_path(url) is None or shard_stamp(url) == stamp for url, stamp in zip(self.shard_urls, self.stamps or (), strict=True)
        )

    def member(self, index: int) -> Member:
        """Photo `index`, 0 <= index < len(self)."""
        number, key, offset, size = self._place(index)
        return Member(shown_url(self.shard_urls[number]), key, offset, size)

    def _place(self, index: int) -> tuple[int, str, int, int]:
        """Shard, key, offset and size of photo `index`."""
        if not 0 <= index < len(self):
            raise IndexError(f"photo {index} of a source with {len(self):,}")
        start = int(self.key_ends[index - 1]) if index else 0
        key = self.key_text[start : int(self.key_ends[index])].decode("utf-8", "surrogateescape")
        return int(self.shard_numbers[index]), key, int(self.offsets[index]), int(self.sizes[index])

    def read(self, index: int, cache: ShardCache | None = None) -> bytes:
        """The bytes of photo `index`, read by range.

        Args:
            cache: where those of a remote shard are looked for first, and kept.

        Raises:
            BadShard: the shard no longer has all of them, another member has moved into them, or it is another shard now (ChangedShard).
            BadPhoto: they are not those that were indexed.
            OSError: the shard cannot be read; UnreachableShard for a remote one.
        """
        number, key, offset, size = self._place(index)
        checksum = CHECKSUM_UNKNOWN if self.checksums is None else int(self.checksums[index])
        return self._read(number, key, offset, size, checksum, cache, CHANGED_BYTES)

    def read_depth(self, index: int, cache: ShardCache | None = None) -> bytes:
        """The bytes of the depth map of photo `index`, read as `read` does.

        Raises:
            BadPhoto: also where the photo has no depth map.
        """
        number, key, _, _ = self._place(index)
        if self.depth_offsets is None or self.depth_sizes is None or self.depth_offsets[index] == NO_DEPTH:
            raise BadPhoto(f"no stored depth: neither {key}.depth.npy nor {key}.depth.png; add one, or let depth be estimated", key)
        checksum = CHECKSUM_UNKNOWN if self.depth_checksums is None else int(self.depth_checksums[index])
        offset, size = int(self.depth_offsets[index]), int(self.depth_sizes[index])
        return self._read(number, f"{key}.depth", offset, size, checksum, cache, CHANGED_DEPTH)

    def _read(self, number: int, name: str, offset: int, size: int, checksum: int, cache: ShardCache | None, changed: str) -> bytes:
        """A member's bytes; `changed` is the reason where they have another checksum."""
        url = self.shard_urls[number]
        stamp = None if self.stamps is None else self.stamps[number]
        if checksum != CHECKSUM_UNKNOWN and local_path(url) is not None:
            stamp = None  # a file may be touched; its bytes say more
        data = read_range(url, offset, size, inside=f'"{name}"', stamp=stamp, cache=cache)
        if checksum == CHECKSUM_UNKNOWN:
            fault = header_inside(shown_url(url), name, offset, data)
            if fault is not None:
                raise fault
        elif zlib.crc32(data) != checksum:
            raise BadPhoto(changed, name)
        return data


def build_manifest(urls: str | os.PathLike[str] | Sequence[str | os.PathLike[str]], progress: bool = False) -> Manifest:
    """Lists the photos of a source's shards: from their indexes where they have them (`write_index`), else from their headers.

    Args:
        urls: as `expand_urls` takes them.
        progress: show a progress bar even where stderr is no terminal.

    Raises:
        ValueError: not one photo in all the shards; the message says what was found.
        FileNotFoundError and others: as `expand_urls` raises them, and what opening a shard raises.
    """
    shard_urls = expand_urls(urls)
    shard_sizes: list[int] = []
    stamps: list[Stamp] = []
    shard_numbers, offsets, sizes, key_ends, checksums = array("i"), array("q"), array("i"), array("q"), array("q")
    depth_offsets, depth_sizes, depth_checksums = array("q"), array("i"), array("q")
    key_text = bytearray()
    problems: list[Problem] = []
    stale: list[str] = []
    hidden = not (progress or (len(shard_urls) > 1 and sys.stderr.isatty()))
    listings = load_or_list(shard_urls, stale)
    for number, listing in enumerate(Progress(listings, desc="indexing", unit="shard", total=len(shard_urls), disable=hidden)):
        shard_sizes.append(listing.size)
        stamps.append(listing.stamp)
        problems += listing.problems
        shard_numbers.extend([number] * len(listing.keys))
        offsets.extend(listing.offsets)
        sizes.extend(listing.sizes)
        checksums.extend(listing.checksums)
        for column, values in zip((depth_offsets, depth_sizes, depth_checksums), listing.depth_columns(), strict=True):
            column.extend(values)
        for key in listing.keys:
            key_text += key.encode("utf-8", "surrogateescape")
            key_ends.append(len(key_text))
    if stale:
        logger.warning("%d of %d indexes are not used, the first as %s; `zsdata index` renews them", len(stale), len(shard_urls), stale[0])
    if not offsets:
        raise ValueError(_nothing_found(shard_urls, problems))
    columns = {
        "shard_numbers": np.array(shard_numbers, np.int32),
        "offsets": np.array(offsets, np.int64),
        "sizes": np.array(sizes, np.int32),
        "key_text": bytes(key_text),
        "key_ends": np.array(key_ends, np.int64),
    }
    with_depth = any(offset != NO_DEPTH for offset in depth_offsets)
    if with_depth:  # a source without keeps the digest that it has had
        columns |= {"depth_offsets": np.array(depth_offsets, np.int64), "depth_sizes": np.array(depth_sizes, np.int32)}
    return Manifest(
        shard_urls=tuple(shard_urls),
        shard_sizes=tuple(shard_sizes),
        problems=tuple(problems),
        stamps=tuple(stamps),
        checksums=np.array(checksums, np.int64),
        depth_checksums=np.array(depth_checksums, np.int64) if with_depth else None,
        digest=_digest(shard_urls, shard_sizes, columns),
        **columns,
    )


def _digest(urls: Sequence[str], sizes: Sequence[int], columns: dict[str, np.ndarray | bytes]) -> str:
    digest = hashlib.sha256(b"zsdata manifest 1\n")
    for url, size in zip(urls, sizes, strict=True):
        name = base_name(url).encode("utf-8", "surrogateescape")
        digest.update(b"shard %d %d %s\n" % (size, len(name), name))
    for title, column in columns.items():
        data = column if isinstance(column, bytes) else column.astype(column.dtype.newbyteorder("<")).tobytes()
        digest.update(b"%s %d\n" % (title.encode(), len(data)))
        digest.update(data)
    return digest.hexdigest()


def _nothing_found(urls: Sequence[str], problems: Sequence[Problem]) -> str:
    """The message for a source without photos: what its first shard holds, and the first problems."""
    with ShardFile(urls[0]) as file:
        extensions = Counter(
            "." + base.partition(".")[2] if "." in base else "files without a dot"
            for base in (member.name.rpartition("/")[2] for member in walk_tar(file, lambda fault: None) if member.kind == "file")
        )
    first = shown_url(urls[0])
    found = ", ".join(f"{count:,} {extension}" for extension, count in extensions.most_common(5)) or "no files"
    shards = first if len(urls) == 1 else f"{len(urls):,} shards (the first is {first})"
    message = f"no JPEG, PNG or WebP in {shards}: it holds {found}"
    if problems:
        message += "; " + "; ".join(f"{problem.key or base_name(problem.shard)}: {problem.reason}" for problem in problems[:3])
    return message + ". A photo is a member named KEY.jpg, .jpeg, .png or .webp; `zsdata pack FOLDER OUTPUT` makes such shards"
