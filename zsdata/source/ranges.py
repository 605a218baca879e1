"""Bytes of a shard by position, local or remote."""

from __future__ import annotations

import errno
import os
import stat
from types import TracebackType

from zsdata.faults import BadShard
from zsdata.source.fsspec_ranges import fetch_fsspec, look_anew
from zsdata.source.http_ranges import fetch_http
from zsdata.source.retry import Stamp, check_unchanged, read_patiently
from zsdata.source.shard_cache import ShardCache
from zsdata.source.stop import check_stop
from zsdata.source.urls import HTTP, local_path, shown_url

FIRST_BYTES = 1 << 16  # of a remote shard, to learn its size; on most lines they take no longer than one byte
WINDOW_BYTES = 1 << 22  # of a remote shard, read at a time: the headers of a tar lie closer to each other than a request is worth


class ShardFile:
    """A shard opened for reading by position; a context manager.

    Walks use it: a local read is one system call, a remote one takes WINDOW_BYTES ahead, so that the small members of a shard share a
    request. It belongs to the process that opened it.

    Attributes:
        url: as it may stand in messages, see `shown_url`.
        size: bytes.
        stamp: what changes with the shard: {"size": bytes} with "modified_ns" of a local one, or with a remote one's tag or time where its
            server gives one ("ETag", "Last-Modified", ...). Plain JSON.

    Raises:
        OSError: the shard cannot be opened; UnreachableShard (MissingShard, RefusedShard) for a remote one, after all that was tried.
    """

    url: str
    size: int
    stamp: Stamp

    def __init__(self, url: str) -> None:
        self.url = shown_url(url)
        self._url = url
        self._window, self._window_start = b"", 0
        self._descriptor = -1
        path = local_path(url)
        self._remote = path is None
        if path is not None:
            self._descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # a pipe would wait for its writer
            self.stamp = _local_stamp(self._descriptor)
            mode = os.fstat(self._descriptor).st_mode
            if not stat.S_ISREG(mode):
                self.close()
                what = "it is a folder" if stat.S_ISDIR(mode) else "it is no regular file"
                raise OSError(errno.EINVAL, f"{what}; a shard is an uncompressed tar", path)
        else:
            look_anew(url)
            self._window, self.stamp = _read_remote(url, 0, FIRST_BYTES, None)
        size = self.stamp["size"]
        assert isinstance(size, int)
        self.size = size

    def read_at(self, offset: int, size: int) -> bytes:
        """The `size` bytes from `offset` on, or as many of them as the shard has.

        Raises:
            ChangedShard: a remote shard is no longer the one that was opened. (A local one that is replaced stays open as it was.)
            UnreachableShard: a remote shard cannot be read any more.
            Stopped: see `stoppable`.
        """
        check_stop()
        size = min(size, self.size - offset)
        if size <= 0:
            return b""
        if not self._remote:
            return _pread(self._descriptor, size, offset)
        first = offset - self._window_start
        if first < 0 or first + size > len(self._window):
            ahead = max(size, min(WINDOW_BYTES, self.size - offset))
            self._window, self._window_start, first = _read_remote(self._url, offset, ahead, self.stamp)[0], offset, 0
        return self._window[first : first + size]

    def close(self) -> None:
        """Closes the file; harmless when repeated."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
        self._window, self._descriptor = b"", -1

    def __enter__(self) -> ShardFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def read_range(
    url: str,
    offset: int,
    size: int,
    inside: str = "a photo",
    *,
    stamp: Stamp | None = None,
    cache: ShardCache | None = None,
) -> bytes:
    """Exactly `size` bytes of `url` from `offset` on; nothing stays open that a fork could share, so any process may call it at any time.

    Args:
        inside: what lies there, for the message.
        stamp: what the shard was when it was listed (`ShardFile.stamp`); bytes of another one are not returned.
        cache: keeps what is read of a remote shard, where `stamp` says of which one.

    Raises:
        BadShard: the shard ends before, never fewer bytes; or it has changed (ChangedShard).
        OSError: the shard cannot be opened or read, or its server ignores ranges; UnreachableShard for a remote one.
    """
    path = local_path(url)
    if path is not None:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            if stamp is not None:
                check_unchanged(url, offset, stamp, _local_stamp(descriptor))
            data = _pread(descriptor, size, offset)
        finally:
            os.close(descriptor)
    elif size == 0:
        return b""
    elif cache is None or stamp is None:
        data, _ = _read_remote(url, offset, size, stamp)
    else:
        kept = cache.load(url, stamp, offset, size)
        if kept is not None:
            return kept
        data, _ = _read_remote(url, offset, size, stamp)
        if len(data) == size:
            cache.store(url, stamp, offset, data)
    if len(data) < size:
        raise ends_inside(url, inside, offset, size, len(data))
    return data


def ends_inside(url: str, inside: str, offset: int, size: int, got: int) -> BadShard:
    """The fault of a shard that has only `got` of the `size` bytes at `offset`."""
    return BadShard(f"ends inside {inside} ({got:,} of {size:,} bytes); download it again", shown_url(url), offset + got)


def _read_remote(url: str, offset: int, size: int, stamp: Stamp | None) -> tuple[bytes, Stamp]:
    fetch = fetch_http if url.split("://", 1)[0] in HTTP else fetch_fsspec
    return read_patiently(url, offset, size, fetch, stamp)


def _local_stamp(descriptor: int) -> Stamp:
    status = os.fstat(descriptor)
    return {"size": status.st_size, "modified_ns": status.st_mtime_ns}


def _pread(descriptor: int, size: int, offset: int) -> bytes:
    data = os.pread(descriptor, size, offset)
    while len(data) < size:  # the kernel may give less than asked for; only nothing at all means the end
        more = os.pread(descriptor, size - len(data), offset + len(data))
        if not more:
            break
        data += more
    return data
