"""Every shard walked and every photo decoded: what a stream would trip over, found before training."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import dataclass, field

from zsdata.faults import BadPhoto, BadShard
from zsdata.progress import Progress
from zsdata.source.archive import DepthMember, Problem, photo_members
from zsdata.source.depth_map import DepthMap, misfit
from zsdata.source.index import CHANGED_BYTES, CHANGED_DEPTH, NO_DEPTH, StaleIndex, load_listing
from zsdata.source.photo import PhotoHeader, usable_photo
from zsdata.source.ranges import ShardFile
from zsdata.source.urls import base_name, expand_urls, shown_url


@dataclass
class VerifyReport:
    """What was looked at, and what is wrong with it."""

    shards: int = 0
    opened: int = 0  # shards of which something could be read
    photos: int = 0  # those that decode
    depth_maps: int = 0  # those that decode and fit such a photo
    bytes: int = 0  # of the shards
    indexed: int = 0  # shards whose photos were held against the checksums of their index
    problems: list[Problem] = field(default_factory=list)


def verify(
    urls: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    on_problem: Callable[[Problem], None] | None = None,
    *,
    shortest_side_px: int = 1,
    progress: bool | None = None,
) -> VerifyReport:
    """Reads all of a source: the headers of its shards, and each photo and depth map down to its pixels. Nothing is written.

    A shard that cannot be read, or holds no photo at all, is a problem of that shard; the others are still looked at. Where a shard has an
    index (`write_index`), each photo and depth map must have the bytes that it had then, and none may be missing. A photo without a depth
    map is no problem, a depth map that a stream could not use (see `zsdata.source.depth_map`) is one.

    Args:
        urls: as `expand_urls` takes them.
        on_problem: gets each problem as it is found.
        shortest_side_px: a photo with a shorter side is a problem.
        progress: show a progress bar; by default where stderr is a terminal.

    Raises:
        ValueError, FileNotFoundError: as `expand_urls` raises them.
        ImportError: a package that a remote url needs is missing.
    """
    shard_urls = expand_urls(urls)
    report = VerifyReport()

    def add(problem: Problem) -> None:
        report.problems.append(problem)
        if on_problem is not None:
            on_problem(problem)

    with Progress(desc="verifying", unit="photo", disable=None if progress is None else not progress) as bar:
        for number, url in enumerate(shard_urls, start=1):
            bar.set_postfix_str(f"shard {number} of {len(shard_urls)}: {base_name(url)}")
            before = report.photos + len(report.problems)
            shown = shown_url(url)
            try:
                with ShardFile(url) as file:
                    report.opened += 1
                    report.bytes += file.size
                    indexed = _Indexed(url, add)
                    report.indexed += indexed.found
                    depths = _Depths(file)
                    headers: dict[str, PhotoHeader] = {}
                    for key, offset, size in photo_members(file, add, on_depth=depths.look_at):
                        data = file.read_at(offset, size)
                        changed = indexed.reason_against(key, data)
                        try:
                            header = usable_photo(data, shortest_side_px).header
                            if changed is not None:
                                raise BadPhoto(changed)
                            headers[key] = header
                            report.photos += 1
                        except BadPhoto as fault:
                            add(Problem(shown, key, offset, fault.reason))
                        bar.update()
                    for key, depth in depths.of(headers):
                        changed = indexed.reason_against_depth(key, depth.checksum)
                        reason = depth.reason_against(headers[key]) or changed
                        if reason is None:
                            report.depth_maps += 1
                        else:
                            add(Problem(shown, key, depth.member.offset, reason))
                    indexed.report_missing(headers)
            except BadShard as fault:  # it changed meanwhile
                add(Problem(shown, None, fault.offset, fault.reason))
            except OSError as error:
                add(Problem(shown, None, 0, f"cannot be read: {error.strerror or error}"))
            if report.photos + len(report.problems) == before:
                add(Problem(shown, None, 0, "no JPEG, PNG or WebP in it"))
            report.shards += 1
    return report


@dataclass(frozen=True)
class _Depth:
    """A depth map that was looked at: its sides, or why it cannot be used whatever its photo is."""

    member: DepthMember
    checksum: int
    width: int = 0
    height: int = 0
    fault: str | None = None

    def reason_against(self, photo: PhotoHeader) -> str | None:
        return self.fault or misfit(self.width, self.height, photo)


class _Depths:
    """The depth maps of a shard, each looked at as it comes; of a photo's two the one that counts."""

    def __init__(self, file: ShardFile) -> None:
        self._file = file
        self._found: dict[str, _Depth] = {}

    def look_at(self, member: DepthMember) -> None:
        other = self._found.get(member.key)
        if not member.counts_before(other and other.member):
            return
        data = self._file.read_at(member.offset, member.size)
        checksum = zlib.crc32(data)
        try:
            depth = DepthMap.parse(data)
            depth.decode()
            self._found[member.key] = _Depth(member, checksum, depth.width, depth.height)
        except BadPhoto as fault:
            self._found[member.key] = _Depth(member, checksum, fault=fault.reason)

    def of(self, keys: Container[str]) -> Iterator[tuple[str, _Depth]]:
        """Those of these photos."""
        return ((key, depth) for key, depth in self._found.items() if key in keys)


class _Indexed:
    """What the index of a shard knows of its photos and depth maps; nothing without an index."""

    def __init__(self, url: str, add: Callable[[Problem], None]) -> None:
        self._url, self._add = shown_url(url), add
        try:
            listing = load_listing(url, even_if_touched=True)  # a copy has another time and must have the same bytes
        except StaleIndex as stale:
            add(Problem(self._url, None, 0, f"index not usable: {stale}; zsdata index renews it"))
            listing = None
        self.found = listing is not None
        self._checksums = {} if listing is None else dict(zip(listing.keys, listing.checksums, strict=True))
        self._offsets = {} if listing is None else dict(zip(listing.keys, listing.offsets, strict=True))
        self._depths: dict[str, tuple[int, int]] = {}  # offset, checksum
        if listing is not None:
            rows = zip(listing.keys, *listing.depth_columns(), strict=True)
            self._depths = {key: (offset, checksum) for key, offset, _, checksum in rows if offset != NO_DEPTH}

    def reason_against(self, key: str, data: bytes) -> str | None:
        if not self.found:
            return None
        self._offsets.pop(key, None)
        checksum = self._checksums.get(key)
        if checksum is None:
            return "not in the index of its shard"
        return None if zlib.crc32(data) == checksum else CHANGED_BYTES

    def reason_against_depth(self, key: str, checksum: int) -> str | None:
        if not self.found:
            return None
        _, indexed = self._depths.pop(key, (0, None))
        if indexed is None:
            return "depth map not in the index of its shard"
        return None if checksum == indexed else CHANGED_DEPTH

    def report_missing(self, photos: Container[str]) -> None:
        """What is no longer there; depth maps as far as their photos, by key, still are."""
        for key, offset in self._offsets.items():
            self._add(Problem(self._url, key, offset, "lost: it was there when the shard was indexed"))
        for key, (offset, _) in self._depths.items():
            if key in photos:
                self._add(Problem(self._url, key, offset, "depth map lost: it was there when the shard was indexed"))
