"""A cache's folder: small files that are whole or not there, bounded in bytes over all processes that use it.

What cannot be believed (cut, damaged, something else in its place) is a miss and is removed. A full folder takes no new entries: epochs go
round all photos, so an entry that gives way to another one would always be the one that is needed next.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import logging
import os
import re
import stat
import time
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from typing import TypeVar

from zsdata.folder_ledger import IDENTITY_NAME, TOKEN_BYTES, Ledger, charge, count_shelf, ledger_name, open_ledger, shelves

logger = logging.getLogger("zsdata")

SMALLEST_BOUND_BYTES = 1 << 20  # a few entries and the bookkeeping; less is a slip of the unit
RETRY_SECONDS = 60.0  # after an error nothing is stored for so long: neither a full disk nor a stopped process is asked for every photo
# Not the entry's fault, or gone by itself at the next try; anything else that keeps an entry from being read costs it its place.
PASSING_ERRORS = {errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EINTR, errno.EAGAIN, errno.ESTALE, errno.ETIMEDOUT}
NAME = re.compile(r"[0-9a-f]{64}")

Entry = TypeVar("Entry")


class BadEntry(Exception):
    """A file is not what was stored under its name; the message says why."""


@dataclass(frozen=True, kw_only=True)
class Wording:
    """What messages say of a cache.

    Attributes:
        kind: lower-case letters, part of every file name.
        title: "the depth cache".
        without: what becomes of entries that are not in it, a sentence without its full stop.
        bound: the argument that makes it larger.
        others: what else in its folder takes room.
    """

    kind: str
    title: str
    without: str
    bound: str
    others: str


class BoundedFolder:
    """Entries by name on one shelf of a folder.

    Any number of processes may load and store at once, on several machines too where the file system shares locks (`flock`) between them.
    The object is plain data and holds no open file: it may be pickled, and goes through fork and spawn.

    Args:
        folder: made where it is missing. Files with other names than the cache's own are neither counted nor touched.
        max_bytes: of all files of this kind of cache in `folder`, those of other shelves and unfinished ones too, each counted in whole
            blocks of 4 KiB. A bound below what lies there already removes nothing.
        identity: what all entries of the shelf depend on; other identities have other shelves.

    Raises:
        ValueError, TypeError: a bound that cannot work.
        OSError: the folder cannot be made, written or locked.
    """

    def __init__(self, folder: str | os.PathLike[str], max_bytes: int, identity: str, wording: Wording) -> None:
        if isinstance(max_bytes, bool) or not isinstance(max_bytes, int):
            raise TypeError(f"max_bytes is an integer, in bytes; got {max_bytes!r}")
        if max_bytes < SMALLEST_BOUND_BYTES:
            raise ValueError(f"max_bytes is {SMALLEST_BOUND_BYTES:,} or more; got {max_bytes:,}. It counts bytes: 20 GB are 20_000_000_000")
        self.folder = os.path.abspath(os.fspath(folder))
        self.max_bytes = max_bytes
        self.identity = identity
        self.digest = hashlib.sha256(identity.encode("utf-8", "surrogateescape"), usedforsecurity=False).digest()
        self._wording = wording
        self._shelf = os.path.join(self.folder, f"{wording.kind}-{self.digest.hex()[:16]}")
        self._token = os.urandom(TOKEN_BYTES)  # says "the same run" in the ledger
        self._told: set[str] = set()
        self._retry_at = 0.0
        try:
            self._open_folder()
        except OSError as error:
            raise OSError(error.errno, f"{wording.title}'s folder {self.folder} cannot be used: {error}; {self._cure(error)}") from error

    def path(self, name: str) -> str:
        """Where the entry `name`, 64 hexadecimal digits, is kept."""
        if not NAME.fullmatch(name):
            raise ValueError(f"an entry is named by 64 hexadecimal digits; got {name!r}")
        return os.path.join(self._shelf, f"{name}.{self._wording.kind}")

    def load(self, name: str, read: Callable[[int, int], Entry]) -> Entry | None:
        """What `read(descriptor, size in bytes)` makes of an entry; None without one, or where it raises BadEntry."""
        path, status = self.path(name), None
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
            try:
                status = os.fstat(descriptor)
                if not stat.S_ISREG(status.st_mode):
                    raise BadEntry("not a regular file")
                return read(descriptor, status.st_size)
            finally:
                os.close(descriptor)
        except FileNotFoundError:
            return None
        except (BadEntry, OSError) as error:
            if isinstance(error, BadEntry) or error.errno not in PASSING_ERRORS:
                self._discard(path, status, error)
            return None

    def store(self, name: str, size: int, parts: Iterable[bytes | memoryview]) -> bool:
        """Keeps an entry of `size` bytes, the `parts` one after the other, in place of what was kept under its name.

        Returns:
            Whether it is kept. It is not when the folder is full or cannot be written, which is logged once as a warning.
        """
        path = self.path(name)
        if time.monotonic() < self._retry_at:
            return False
        temporary = self._temporary(name)
        descriptor = None
        try:
            descriptor = self._begin(temporary, size)
            if descriptor is None:
                return False
            offset = 0
            for part in parts:
                left = memoryview(part)
                while left:
                    count = os.pwrite(descriptor, left, offset)
                    left, offset = left[count:], offset + count
            with self._ledger() as ledger:
                replaced = 0
                with suppress(FileNotFoundError):  # a reader removes what is damaged, without the lock
                    replaced = charge(os.lstat(path).st_size)
                os.replace(temporary, path)
                ledger.release(min(replaced, charge(size)))
            return True
        except OSError as error:
            self._retry_at = time.monotonic() + RETRY_SECONDS
            self._warn_once(
                f"{self._wording.title} in {self.folder} takes no new entries for now: {error}; {self._cure(error)}. "
                f"Until then {self._wording.without}."
            )
            return False
        finally:
            if descriptor is not None:
                self._end(temporary, descriptor, size)

    def _ledger(self) -> AbstractContextManager[Ledger]:
        return open_ledger(self.folder, self._wording.kind)

    def _temporary(self, name: str) -> str:
        return os.path.join(self._shelf, f"{name}.{os.urandom(8).hex()}.tmp")

    def _open_folder(self) -> None:
        """Makes the folder, tries to write it, and removes what killed processes left in it."""
        os.makedirs(self.folder, exist_ok=True)
        with suppress(TimeoutError), self._ledger() as ledger:  # held: by a process that counts a large folder, most likely
            ledger.count_if_due()
            self._make_shelf(ledger)
        if os.path.isdir(self._shelf):
            trial = self._temporary("0" * 64)
            os.close(os.open(trial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
            with suppress(FileNotFoundError):  # another process may take it for a leftover, and be right
                os.unlink(trial)

    def _make_shelf(self, ledger: Ledger) -> bool:
        """The shelf and the text in it that says whose it is; False where the folder is full."""
        path = os.path.join(self._shelf, IDENTITY_NAME)
        if os.path.exists(path):
            return True
        text = self.identity.encode("utf-8", "surrogateescape") + b"\n"
        if not ledger.reserve(charge(0) + charge(len(text)), self.max_bytes):
            return False
        os.makedirs(self._shelf, exist_ok=True)
        with open(path, "wb") as file:
            file.write(text)
        return True

    def _begin(self, temporary: str, size: int) -> int | None:
        """A file of `size` bytes to be filled, open and locked while its writer lives; None where the folder is full."""
        with self._ledger() as ledger:
            if not (self._make_shelf(ledger) and ledger.reserve(charge(size), self.max_bytes)):
                if "full" not in self._told and ledger.first_time(self._token):
                    logger.warning(self._full(ledger, size))
                self._told.add("full")
                return None
            descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                os.ftruncate(descriptor, size)  # at once at its full size: a count at any time is right
            except BaseException:
                os.close(descriptor)
                raise
            return descriptor

    def _end(self, temporary: str, descriptor: int, size: int) -> None:
        """Closes the file of a writer; where it was not finished it is removed and its bytes are given back."""
        try:
            if os.path.lexists(temporary):  # and no other process removes it while it is locked
                with self._ledger() as ledger:  # both at once: between them a count would be taken off twice
                    os.unlink(temporary)
                    ledger.release(charge(size))
        except OSError:
            with suppress(OSError):
                os.unlink(temporary)
        finally:
            os.close(descriptor)

    def _discard(self, path: str, status: os.stat_result | None, reason: BaseException) -> None:
        """Removes what lies in an entry's place. The ledger keeps its bytes until the next count: nobody knows how many were reserved."""
        self._warn_once(
            f"{self._wording.title} in {self.folder} holds an entry that cannot be used, {os.path.basename(path)}: {reason}. It is removed "
            "and stored anew where possible; further ones are not reported.",
            "entry",
        )
        with suppress(OSError):
            now = os.lstat(path)
            if status is not None and not os.path.samestat(now, status):
                return  # another process has stored it anew
            if os.path.isdir(path) and not os.path.islink(path):
                os.rmdir(path)
            else:
                os.unlink(path)

    def _full(self, ledger: Ledger, size: int) -> str:
        words, kind = self._wording, self._wording.kind
        message = (
            f"{words.title} in {self.folder} has no room for another {_said(charge(size))}: it holds {_said(ledger.held_bytes)} of at most "
            f"{_said(self.max_bytes)}. {words.without[0].upper()}{words.without[1:]}. Give a larger {words.bound}"
        )
        others = [shelf for shelf in shelves(self.folder, kind) if shelf != self._shelf]
        if not others:
            return message + "."
        return message + f", or remove {words.others}: " + "; ".join(_described(shelf, kind) for shelf in others) + "."

    def _cure(self, error: OSError) -> str:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            return "free space on its disk"
        if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
            return "make it writable for this user, or give another folder"
        if isinstance(error, TimeoutError):
            return f"look for a stopped process that uses it (fuser {ledger_name(self._wording.kind)})"
        return "give another folder, on a file system that can lock files"

    def _warn_once(self, message: str, kind: str = "storing") -> None:
        if kind not in self._told:
            self._told.add(kind)
            logger.warning(message)


def _described(shelf: str, kind: str) -> str:
    """A shelf, what its entries depend on, and its size."""
    try:
        with open(os.path.join(shelf, IDENTITY_NAME), encoding="utf-8", errors="replace") as file:
            identity = file.read(200).strip()
    except OSError:
        identity = "unknown"
    return f"{shelf} ({identity}, {_said(count_shelf(shelf, kind))})"


def _said(count: int) -> str:
    return f"{count / 1e9:.2f} GB" if count >= 1e9 else f"{count / 1e6:.2f} MB"
