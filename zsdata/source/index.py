"""The index of a shard: its photos and their checksums, stored once, so that opening the shard again reads no headers."""

from __future__ import annotations

import hashlib
import json
import os
import threading
import zlib
from array import array
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from zsdata.progress import Progress
from zsdata.source.archive import MAX_PHOTO_BYTES, DepthMember, Problem, header_inside, photo_members
from zsdata.source.ranges import ShardFile
from zsdata.source.retry import Stamp
from zsdata.source.stop import stoppable
from zsdata.source.urls import base_name, expand_urls, lasting_url, local_path, shown_url

INDEX_ENDING = ".index.json"
VERSION = 2  # 1 had no depth maps
MAX_INDEX_BYTES = 1 << 28  # 256 MiB; a photo takes about 50 bytes, its depth map 30
CHECKSUM_UNKNOWN = -1
NO_DEPTH = -1  # in place of an offset
CHANGED_BYTES = "damaged: other bytes than when the shard was indexed"
CHANGED_DEPTH = f"stored depth {CHANGED_BYTES}"
REMOTE_AT_ONCE = 16  # shards asked for their state at the same time


@dataclass
class Listing:
    """The photos of one shard in order, and where their depth maps lie; `problems` is what could not be taken.

    The three columns of the depth maps are empty where no photo of the shard has one.
    """

    stamp: Stamp  # of the shard, see `ShardFile`
    keys: list[str] = field(default_factory=list)
    offsets: array[int] = field(default_factory=lambda: array("q"))
    sizes: array[int] = field(default_factory=lambda: array("i"))
    checksums: array[int] = field(default_factory=lambda: array("q"))  # CRC-32 of the bytes, or CHECKSUM_UNKNOWN
    problems: list[Problem] = field(default_factory=list)
    depth_offsets: array[int] = field(default_factory=lambda: array("q"))  # NO_DEPTH where a photo has none
    depth_sizes: array[int] = field(default_factory=lambda: array("i"))
    depth_checksums: array[int] = field(default_factory=lambda: array("q"))

    @property
    def size(self) -> int:
        """Bytes of the shard."""
        return int(self.stamp["size"])  # type: ignore[arg-type]

    def depth_columns(self) -> tuple[array[int], array[int], array[int]]:
        """Offsets, sizes and checksums of the depth maps, a row for each photo."""
        if self.depth_offsets:
            return self.depth_offsets, self.depth_sizes, self.depth_checksums
        none = len(self.keys)
        return array("q", [NO_DEPTH]) * none, array("i", [0]) * none, array("q", [CHECKSUM_UNKNOWN]) * none


@dataclass
class IndexReport:
    """What `write_index` wrote and found."""

    shards: int = 0
    photos: int = 0
    bytes: int = 0  # of the shards
    unchanged: int = 0  # shards whose index was up to date
    files: list[str] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)


def list_shard(url: str, checksums: bool = False) -> Listing:
    """Walks the headers of a shard; with `checksums` it reads the photos and depth maps too. Raises what opening it raises."""
    depths: dict[str, tuple[DepthMember, int]] = {}
    with ShardFile(url) as file:
        listing = Listing(file.stamp)

        def checksum_of(key: str, offset: int, size: int) -> int | None:
            """None where the bytes cannot be taken."""
            if not checksums:
                return CHECKSUM_UNKNOWN
            data = file.read_at(offset, size)
            fault = header_inside(file.url, key, offset, data)
            if fault is None:
                return zlib.crc32(data)
            listing.problems.append(Problem(file.url, key, fault.offset, fault.reason))
            return None

        def add_depth(member: DepthMember) -> None:
            checksum = checksum_of(member.key, member.offset, member.size)
            other = depths.get(member.key)
            if checksum is not None and member.counts_before(other and other[0]):
                depths[member.key] = member, checksum

        for key, offset, size in photo_members(file, listing.problems.append, on_depth=add_depth):
            checksum = checksum_of(key, offset, size)
            if checksum is not None:
                listing.keys.append(key)
                listing.offsets.append(offset)
                listing.sizes.append(size)
                listing.checksums.append(checksum)
    if not depths.keys().isdisjoint(listing.keys):
        for key in listing.keys:
            member, checksum = depths.get(key, (None, CHECKSUM_UNKNOWN))
            listing.depth_offsets.append(NO_DEPTH if member is None else member.offset)
            listing.depth_sizes.append(0 if member is None else member.size)
            listing.depth_checksums.append(checksum)
    return listing


def write_index(urls: str | os.PathLike[str] | Sequence[str | os.PathLike[str]], progress: bool | None = None) -> IndexReport:
    """Stores an index for each shard of a source: SHARD.index.json beside a local one, in the cache for a remote one or a folder that
    cannot be written. The cache is $ZSDATA_CACHE, or zsdata in the user's cache folder. An index that is up to date stays.

    Args:
        urls: as `expand_urls` takes them.
        progress: show a progress bar; by default where stderr is a terminal.

    Raises:
        OSError: a shard cannot be read, or changed while it was read.
        ValueError, FileNotFoundError: as `expand_urls` raises them.
    """
    report = IndexReport()
    for url in Progress(expand_urls(urls), desc="indexing", unit="shard", disable=None if progress is None else not progress):
        try:
            listing, unchanged = load_listing(url), True
        except StaleIndex:
            listing, unchanged = None, False
        if listing is None:
            listing, unchanged = list_shard(url, checksums=True), False
            stamp = dict(listing.stamp)
            if shard_stamp(url) != stamp:
                raise OSError(f"{shown_url(url)} changed while it was indexed; run this again when nothing writes to it")
            report.files.append(_store(url, _to_json(url, stamp, listing)))
        report.shards += 1
        report.unchanged += unchanged
        report.photos += len(listing.keys)
        report.bytes += listing.size
        report.problems += listing.problems
    return report


class StaleIndex(Exception):
    """An index that is there and cannot be used, and why."""


def load_listing(url: str, *, even_if_touched: bool = False) -> Listing | None:
    """What the index of a shard says; None without an index.

    Args:
        even_if_touched: take it where only the time of the shard has changed, not its size.

    Raises:
        StaleIndex: the shard has changed, or the index is damaged or of another version.
        OSError: the shard is not there.
    """
    for path in _places(url):
        try:
            if os.path.getsize(path) > MAX_INDEX_BYTES:
                raise StaleIndex(f"{path} is too large for an index")
            text = Path(path).read_bytes()
        except OSError:  # not there, or not for us to read
            continue
        try:
            stamp, listing = _from_json(url, text)
        except (ValueError, RecursionError) as error:
            raise StaleIndex(f"{path} is no index of version {VERSION}, or damaged ({error})") from error
        now = shard_stamp(url)
        if now != stamp and not (even_if_touched and now["size"] == stamp["size"]):
            raise StaleIndex(f"{path} is older than its shard")
        listing.stamp = now
        return listing
    return None


def load_or_list(urls: Sequence[str], stale: list[str]) -> Iterable[Listing]:
    """The listing of each shard in order, from its index where it has one; adds to `stale` why an index was not used.

    Where it ends early, by an error of a shard or of the caller, no read of another shard goes on.
    """
    stop = threading.Event()

    def one(url: str) -> Listing:
        try:
            listing = load_listing(url)
        except StaleIndex as reason:
            stale.append(str(reason))
            listing = None
        return list_shard(url) if listing is None else listing

    def one_of_many(url: str) -> Listing:
        with stoppable(stop):
            return one(url)

    if all(local_path(url) is not None for url in urls):
        yield from map(one, urls)
        return
    with ThreadPoolExecutor(REMOTE_AT_ONCE) as threads:
        try:
            yield from threads.map(one_of_many, urls)
        finally:
            stop.set()  # else leaving the pool waits for the whole of the shards that are being listed


def _places(url: str) -> list[str]:
    """Where the index of a shard may be, the first one preferred."""
    path = local_path(url)
    identity = os.path.realpath(path) if path is not None else lasting_url(url)
    cached = f"{hashlib.sha256(identity.encode('utf-8', 'surrogateescape')).hexdigest()[:32]}-{base_name(url)}{INDEX_ENDING}"
    cache = os.environ.get("ZSDATA_CACHE") or os.path.join(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "zsdata")
    return [*([] if path is None else [f"{path}{INDEX_ENDING}"]), os.path.join(cache, "index", cached)]


def shard_stamp(url: str) -> dict[str, Any]:
    """What changes with the shard: its size, and its time or the server's tag."""
    path = local_path(url)
    if path is not None:
        state = os.stat(path)
        return {"size": state.st_size, "modified_ns": state.st_mtime_ns}
    with ShardFile(url) as file:
        return dict(file.stamp)


def _store(url: str, text: str) -> str:
    """Writes an index where it may be."""
    *beside, cached = _places(url)
    for path in beside:
        try:
            return _replace(path, text)
        except OSError:  # the folder cannot be written
            continue
    os.makedirs(os.path.dirname(cached), exist_ok=True)
    return _replace(cached, text)


def _replace(path: str, text: str) -> str:
    """Whoever reads at the same time gets the old one or the new one."""
    partial = Path(f"{path}.{os.getpid()}.partial")
    try:
        partial.write_text(text, encoding="ascii")
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    return path


def _to_json(url: str, stamp: dict[str, Any], listing: Listing) -> str:
    content = {
        "zsdata_index": VERSION,
        "shard": base_name(url),
        "stamp": stamp,
        "keys": listing.keys,
        "offsets": listing.offsets.tolist(),
        "sizes": listing.sizes.tolist(),
        "crc32": listing.checksums.tolist(),
        "depth_offsets": listing.depth_offsets.tolist(),
        "depth_sizes": listing.depth_sizes.tolist(),
        "depth_crc32": listing.depth_checksums.tolist(),
        "problems": [[problem.key, problem.offset, problem.reason] for problem in listing.problems],
    }
    return json.dumps({**content, "sha256": _digest(content)}, separators=(",", ":"))


def _digest(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _from_json(url: str, text: bytes) -> tuple[dict[str, Any], Listing]:
    """The stamp and the listing; ValueError for anything that `_to_json` would not have written."""
    content = json.loads(text)
    if not isinstance(content, dict) or content.get("zsdata_index") != VERSION:
        raise ValueError("another version")
    if content.pop("sha256", None) != _digest(content):
        raise ValueError("wrong checksum")
    if content.get("shard") != base_name(url):
        raise ValueError(f"it belongs to {content.get('shard')!r}")
    try:
        stamp, keys = content["stamp"], content["keys"]
        offsets, sizes, checksums = array("q", content["offsets"]), array("i", content["sizes"]), array("q", content["crc32"])
        depth_offsets, depth_sizes = array("q", content["depth_offsets"]), array("i", content["depth_sizes"])
        depth_checksums = array("q", content["depth_crc32"])
        problems = [Problem(shown_url(url), key, offset, reason) for key, offset, reason in content["problems"]]
        size = stamp["size"]
        in_order = (
            isinstance(size, int)
            and len(keys) == len(set(keys)) == len(offsets) == len(sizes) == len(checksums)
            and all(before + length <= after for before, length, after in zip(offsets, sizes, [*offsets[1:], size], strict=True))
        )
        in_range = all(0 <= length <= MAX_PHOTO_BYTES for length in sizes) and all(0 <= crc < 1 << 32 for crc in checksums)
        told = all(isinstance(key, str) for key in keys) and all(
            isinstance(problem.key, str | None) and isinstance(problem.offset, int) and isinstance(problem.reason, str)
            for problem in problems
        )
    except (KeyError, TypeError, OverflowError) as error:
        raise ValueError("a field is missing or of another type") from error
    listing = Listing(stamp, keys, offsets, sizes, checksums, problems, depth_offsets, depth_sizes, depth_checksums)
    if not (in_order and in_range and told and (not offsets or offsets[0] >= 0) and _depths_fit(listing)):
        raise ValueError("members overlap or lie outside of the shard")
    return stamp, listing


def _depths_fit(listing: Listing) -> bool:
    """Whether the depth maps lie in the shard, apart from each other and from the photos."""
    columns = listing.depth_offsets, listing.depth_sizes, listing.depth_checksums
    if not any(columns):
        return True
    if any(len(column) != len(listing.keys) for column in columns):
        return False
    depths = []
    for offset, size, checksum in zip(*columns, strict=True):
        if offset == NO_DEPTH:
            if (size, checksum) != (0, CHECKSUM_UNKNOWN):
                return False
        elif offset >= 0 and 0 <= size <= MAX_PHOTO_BYTES and 0 <= checksum < 1 << 32:
            depths.append((offset, size))
        else:
            return False
    members = sorted([*zip(listing.offsets, listing.sizes, strict=True), *depths])
    ends = [offset for offset, _ in members[1:]] + [listing.size]
    return all(offset + size <= end for (offset, size), end in zip(members, ends, strict=True))
