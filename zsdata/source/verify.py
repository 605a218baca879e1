"""Every shard walked and every photo decoded: what a stream would trip over, found before training."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from tqdm import tqdm

from zsdata.faults import BadPhoto, BadShard
from zsdata.source.archive import Problem, photo_members
from zsdata.source.index import CHANGED_BYTES, StaleIndex, load_listing
from zsdata.source.photo import decode_rgb
from zsdata.source.ranges import ShardFile
from zsdata.source.urls import base_name, expand_urls, shown_url


@dataclass
class VerifyReport:
    """What was looked at, and what is wrong with it."""

    shards: int = 0
    photos: int = 0  # those that decode
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
    """Reads all of a source: the headers of its shards, and each photo down to its pixels. Nothing is written.

    A shard that cannot be read, or holds no photo at all, is a problem of that shard; the others are still looked at. Where a shard has an
    index (`write_index`), each photo must have the bytes that it had then, and none may be missing.

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

    with tqdm(desc="verifying", unit="photo", disable=None if progress is None else not progress) as bar:
        for number, url in enumerate(shard_urls, start=1):
            bar.set_postfix_str(f"shard {number} of {len(shard_urls)}: {base_name(url)}")
            before = report.photos + len(report.problems)
            shown = shown_url(url)
            try:
                with ShardFile(url) as file:
                    report.bytes += file.size
                    indexed = _Indexed(url, add)
                    report.indexed += indexed.found
                    for key, offset, size in photo_members(file, add):
                        data = file.read_at(offset, size)
                        reason = _reason_against(data, shortest_side_px) or indexed.reason_against(key, data)
                        if reason is None:
                            report.photos += 1
                        else:
                            add(Problem(shown, key, offset, reason))
                        bar.update()
                    indexed.report_missing()
            except BadShard as fault:  # it changed meanwhile
                add(Problem(shown, None, fault.offset, fault.reason))
            except OSError as error:
                add(Problem(shown, None, 0, f"cannot be read: {error.strerror or error}"))
            if report.photos + len(report.problems) == before:
                add(Problem(shown, None, 0, "no JPEG, PNG or WebP in it"))
            report.shards += 1
    return report


class _Indexed:
    """What the index of a shard knows of its photos; nothing without an index."""

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

    def reason_against(self, key: str, data: bytes) -> str | None:
        if not self.found:
            return None
        self._offsets.pop(key, None)
        checksum = self._checksums.get(key)
        if checksum is None:
            return "not in the index of its shard"
        return None if zlib.crc32(data) == checksum else CHANGED_BYTES

    def report_missing(self) -> None:
        for key, offset in self._offsets.items():
            self._add(Problem(self._url, key, offset, "lost: it was there when the shard was indexed"))


def _reason_against(data: bytes, shortest_side_px: int) -> str | None:
    """Why this photo cannot be used; None where it can."""
    try:
        height, width, _ = decode_rgb(data).shape
    except BadPhoto as fault:
        return fault.reason
    if min(height, width) < shortest_side_px:
        return f"too small: a side shorter than {shortest_side_px} px: {width}x{height}"
    return None
