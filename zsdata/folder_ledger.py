"""How many bytes a cache's folder holds: one number for all processes, in a small file that is also their lock.

The number may be too high (after a process was killed), never too low: it grows before a file does, and shrinks after one is gone.
Only files with names of ours are counted or removed. The kind of the cache ("depth", "shard") is part of these names, so that caches of two
kinds may share a folder.
"""

from __future__ import annotations

import fcntl
import os
import re
import struct
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress

IDENTITY_NAME = "identity.txt"  # in each shelf: what its entries depend on
TEMPORARY_NAME = re.compile(r"[0-9a-f]{64}\.[0-9a-f]{16}\.tmp")

BLOCK_BYTES = 4096  # file systems give space in such blocks
NAME_BYTES = 256  # a name of 70 to 90 characters in its folder, whose blocks are half full at worst
RECOUNT_PAUSE = 20.0  # times as long as a count takes passes until the next one: counting is at most 5 % of one process's time
LOCK_SECONDS = 5.0  # far longer than any step under the lock but the count of a large folder on a slow file system
LOCK_POLL_SECONDS = 0.002

RECORD = struct.Struct("<16sQdd256s")  # magic, bytes held, when they were counted (s since 1970), how long that took (s), tokens
MAGIC = b"zsdata ledger 1\n"
CHECKSUM = struct.Struct("<I")
TOKEN_BYTES = 8


def ledger_name(kind: str) -> str:
    """The file's name in the folder."""
    return f"{kind}-cache.ledger"


class Ledger:
    """The number, while its lock is held; made by `open_ledger`."""

    def __init__(self, folder: str, kind: str, descriptor: int) -> None:
        self._folder = folder
        self._kind = kind
        self._descriptor = descriptor
        data = os.pread(descriptor, RECORD.size + CHECKSUM.size + 1, 0)
        record, checksum = data[: RECORD.size], data[RECORD.size :]
        if len(checksum) != CHECKSUM.size or checksum != CHECKSUM.pack(zlib.crc32(record)) or not record.startswith(MAGIC):
            os.ftruncate(descriptor, 0)
            self.held_bytes, self._counted_at, self._count_seconds, self._tokens = 0, 0.0, 0.0, b""
            self._count()
        else:
            _, self.held_bytes, self._counted_at, self._count_seconds, self._tokens = RECORD.unpack(record)

    def reserve(self, count: int, bound: int) -> bool:
        """Adds `count` bytes, unless `bound` would be exceeded, even by a new count of the folder."""
        if self.held_bytes + count > bound:
            self.count_if_due()
        if self.held_bytes + count > bound:
            return False
        self.held_bytes += count
        self._save()
        return True

    def release(self, count: int) -> None:
        """Takes off `count` bytes that are gone."""
        self.held_bytes = max(0, self.held_bytes - count)
        self._save()

    def first_time(self, token: bytes) -> bool:
        """Whether `token` was not given before (of the last 32 different ones); for what a run should say once."""
        said = [self._tokens[at : at + TOKEN_BYTES] for at in range(0, len(self._tokens), TOKEN_BYTES)]
        if token in said:
            return False
        self._tokens = (token + self._tokens)[: 32 * TOKEN_BYTES]
        self._save()
        return True

    def count_if_due(self) -> None:
        """Counts the folder and removes what killed processes left in it, unless a process did so a short time ago."""
        if not 0 <= time.time() - self._counted_at < RECOUNT_PAUSE * self._count_seconds:
            self._count()

    def _count(self) -> None:
        start = time.monotonic()
        self.held_bytes = charge(0) + charge(RECORD.size)  # the folder and this file
        self.held_bytes += sum(count_shelf(shelf, self._kind) for shelf in shelves(self._folder, self._kind))
        self._counted_at, self._count_seconds = time.time(), time.monotonic() - start
        self._save()

    def _save(self) -> None:
        record = RECORD.pack(MAGIC, self.held_bytes, self._counted_at, self._count_seconds, self._tokens)
        os.pwrite(self._descriptor, record + CHECKSUM.pack(zlib.crc32(record)), 0)


@contextmanager
def open_ledger(folder: str, kind: str) -> Iterator[Ledger]:
    """The ledger of a cache's folder; no other process has it meanwhile.

    Args:
        kind: of the cache, lower-case letters.

    Raises:
        TimeoutError: another process has held it for LOCK_SECONDS.
        OSError: the file cannot be made, locked, read or written.
    """
    path = os.path.join(folder, ledger_name(kind))
    deadline = time.monotonic() + LOCK_SECONDS
    while (descriptor := _try_lock(path)) is None:
        if time.monotonic() > deadline:
            raise TimeoutError(f"another process has held {path} for {LOCK_SECONDS:g} s")
        time.sleep(LOCK_POLL_SECONDS)
    try:
        yield Ledger(folder, kind, descriptor)
    finally:
        fcntl.flock(descriptor, fcntl.LOCK_UN)  # closing is not enough: a process forked meanwhile has the descriptor too
        os.close(descriptor)


def _try_lock(path: str) -> int | None:
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.path.samestat(os.fstat(descriptor), os.stat(path)):
            return descriptor  # and not a file that was removed before it was locked
    except (BlockingIOError, FileNotFoundError):
        pass
    except BaseException:
        os.close(descriptor)
        raise
    os.close(descriptor)
    return None


def charge(size: int) -> int:
    """Bytes that a file or folder of `size` bytes is counted as: whole blocks, at least one, and its name."""
    return max(1, -(-size // BLOCK_BYTES)) * BLOCK_BYTES + NAME_BYTES


def shelves(folder: str, kind: str) -> list[str]:
    """Paths of the shelves in a cache: folders whose entries depend on the same."""
    name = re.compile(rf"{kind}-[0-9a-f]{{16}}")
    with os.scandir(folder) as found:
        return sorted(place.path for place in found if name.fullmatch(place.name) and place.is_dir())


def count_shelf(shelf: str, kind: str) -> int:
    """Bytes in a shelf, itself included; temporary files that no process writes any more are removed."""
    entry = re.compile(rf"[0-9a-f]{{64}}\.{kind}")
    total = charge(0)
    with suppress(FileNotFoundError), os.scandir(shelf) as found:  # removed by hand, meanwhile
        for place in found:
            temporary = TEMPORARY_NAME.fullmatch(place.name)
            if not (temporary or entry.fullmatch(place.name) or place.name == IDENTITY_NAME):
                continue
            with suppress(FileNotFoundError):
                if not (temporary and _remove_abandoned(place.path)):
                    total += charge(place.stat(follow_symlinks=False).st_size)
    return total


def _remove_abandoned(temporary: str) -> bool:
    """Removes a temporary file unless its writer lives, which holds a lock on it."""
    try:
        descriptor = os.open(temporary, os.O_WRONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.unlink(temporary)
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)
