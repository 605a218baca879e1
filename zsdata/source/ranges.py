"""Bytes of a shard by position, local or remote."""

from __future__ import annotations

import os
from types import TracebackType
from typing import Any

from fsspec.core import url_to_fs

from zsdata.faults import BadShard
from zsdata.source.urls import local_path


class ShardFile:
    """A shard opened for reading by position; a context manager.

    Walks use it: a local read is one system call, a remote one goes through fsspec's read-ahead, so that the small members of a shard share
    a request. It belongs to the process that opened it.
    """

    url: str
    size: int  # bytes

    def __init__(self, url: str) -> None:
        self.url = url
        self._remote: Any = None
        self._descriptor = -1
        path = local_path(url)
        if path is not None:
            self._descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
            self.size = os.fstat(self._descriptor).st_size
            return
        file_system, remote_path = _remote(url)
        size = file_system.size(remote_path)
        if size is None:
            raise OSError(f"{url}: the server does not say how large the file is, so ranges of it cannot be read; download the shard")
        self.size = int(size)
        self._remote = file_system.open(remote_path, "rb")

    def read_at(self, offset: int, size: int) -> bytes:
        """The `size` bytes from `offset` on, or as many of them as the shard has."""
        size = min(size, self.size - offset)
        if size <= 0:
            return b""
        if self._remote is not None:
            self._remote.seek(offset)
            return self._remote.read(size)
        return _pread(self._descriptor, size, offset)

    def close(self) -> None:
        """Closes the file; harmless when repeated."""
        if self._remote is not None:
            self._remote.close()
        elif self._descriptor >= 0:
            os.close(self._descriptor)
        self._remote, self._descriptor = None, -1

    def __enter__(self) -> ShardFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def read_range(url: str, offset: int, size: int, inside: str = "a photo") -> bytes:
    """Exactly `size` bytes of `url` from `offset` on; nothing stays open, so any process may call it at any time.

    Args:
        inside: what lies there, for the message.

    Raises:
        BadShard: the shard ends before, never fewer bytes.
        OSError: the shard cannot be opened or read, or its server ignores ranges.
    """
    path = local_path(url)
    if path is not None:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            data = _pread(descriptor, size, offset)
        finally:
            os.close(descriptor)
    elif size == 0:
        data = b""
    else:
        file_system, remote_path = _remote(url)
        data = file_system.cat_file(remote_path, start=offset, end=offset + size)
    if len(data) > size:
        raise OSError(f"{url}: asked for {size:,} bytes, got {len(data):,}: the server ignores ranges; download the shard or use another")
    if len(data) < size:
        raise ends_inside(url, inside, offset, size, len(data))
    return data


def _remote(url: str) -> tuple[Any, str]:
    """The file system of a url and the path in it; asked for anew each time, so that a forked process gets its own."""
    try:
        return url_to_fs(url)
    except ImportError as error:
        raise ImportError(f'{url}: {error}; pip install "zsdata[remote]" brings what http, s3, gs and hf need') from error


def ends_inside(url: str, inside: str, offset: int, size: int, got: int) -> BadShard:
    """The fault of a shard that has only `got` of the `size` bytes at `offset`."""
    return BadShard(f"ends inside {inside} ({got:,} of {size:,} bytes); download it again", url, offset + got)


def _pread(descriptor: int, size: int, offset: int) -> bytes:
    data = os.pread(descriptor, size, offset)
    while len(data) < size:  # the kernel may give less than asked for; only nothing at all means the end
        more = os.pread(descriptor, size - len(data), offset + len(data))
        if not more:
            break
        data += more
    return data
