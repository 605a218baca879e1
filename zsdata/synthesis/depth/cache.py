"""The depth cache: what a slow estimator said of a photo, kept on disk for the next epoch, worker, rank and run."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import logging
import os
import re
import time
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from .cache_entry import BadEntry, CachedDepth, entry_bytes, pack_entry, read_entry
from .cache_ledger import IDENTITY_NAME, LEDGER_NAME, TOKEN_BYTES, Ledger, charge, count_shelf, open_ledger, shelves

logger = logging.getLogger("zsdata")

SMALLEST_CACHE_BYTES = 1 << 20  # one map of 480x640 and the bookkeeping; less is a slip of the unit
RETRY_SECONDS = 60.0  # after an error nothing is stored for so long: neither a full disk nor a stopped process is asked for every photo
# Not the entry's fault, or gone by itself at the next try; anything else that keeps an entry from being read costs it its place.
PASSING_ERRORS = {errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EINTR, errno.EAGAIN, errno.ESTALE, errno.ETIMEDOUT}
PHOTO_DIGEST = re.compile(r"[0-9a-f]{64}")


def photo_digest(data: bytes) -> str:
    """Stands for a photo in a depth cache: sha256 of its file's bytes, hexadecimal (about 0.05 ms for 100 kB)."""
    return hashlib.sha256(data, usedforsecurity=False).hexdigest()


class DepthCache:
    """Depth maps on disk, one file per photo, bounded in bytes over all processes that use the folder.

    Any number of processes may load and store at once, on several machines too where the file system shares locks (`flock`) between them.
    What cannot be believed (cut, damaged, of another version, estimator or photo) is a miss, is removed and stored anew.

    A full cache takes no new entries: epochs go round all photos, so an entry that gives way to another one would always be the one that is
    needed next. A bound below what lies in the folder already removes nothing. Files with other names than the cache's own are neither
    counted nor touched.

    The object is plain data and holds no open file: it may be pickled, and goes through fork and spawn.

    Args:
        folder: made where it is missing; may be shared by estimators, each of which has its own folder in it.
        max_bytes: of all files of the cache in `folder`, those of other estimators and unfinished ones too, each counted in whole blocks of
            4 KiB. A map takes 3 bytes per pixel of its photo.
        identity: what the maps depend on besides the photo, see `depth_identity`.

    Raises:
        ValueError, TypeError: an argument that cannot work.
        OSError: the folder cannot be made, written or locked.
    """

    def __init__(self, folder: str | os.PathLike[str], max_bytes: int, identity: str) -> None:
        if isinstance(max_bytes, bool) or not isinstance(max_bytes, int):
            raise TypeError(f"max_bytes is an integer, in bytes; got {max_bytes!r}")
        if max_bytes < SMALLEST_CACHE_BYTES:
            raise ValueError(
                f"max_bytes is {SMALLEST_CACHE_BYTES:,} or more; got {max_bytes:,}. It counts bytes: 20 GB are 20_000_000_000, "
                "and a map takes 3 bytes per pixel of its photo"
            )
        if not isinstance(identity, str) or not identity.strip():
            raise ValueError(f"identity is a string that names the estimator; got {identity!r}")
        self.folder = os.path.abspath(os.fspath(folder))
        self.max_bytes = max_bytes
        self.identity = identity
        self._identity_digest = hashlib.sha256(identity.encode("utf-8", "surrogateescape"), usedforsecurity=False).digest()
        self._shelf = os.path.join(self.folder, f"depth-{self._identity_digest.hex()[:16]}")
        self._token = os.urandom(TOKEN_BYTES)  # says "the same run" in the ledger
        self._told: set[str] = set()
        self._retry_at = 0.0
        try:
            self._open_folder()
        except OSError as error:
            raise OSError(error.errno, f"the depth cache's folder {self.folder} cannot be used: {error}; {_cure(error)}") from error

    def load(self, photo: str, rows: tuple[int, int] | None = None) -> CachedDepth | None:
        """The depth of a photo, or of some of its rows; None where it is not in the cache.

        Args:
            photo: as `photo_digest` returns it.
            rows: (first, stop), the second one excluded; None for all. A map with fewer rows is a miss. Compare `size` of the result with
                the photo's: a photo that is decoded to another size is to be stored anew.
        """
        if rows is not None and not 0 <= rows[0] < rows[1]:
            raise ValueError(f"rows are (first, stop) with 0 <= first < stop; got {rows!r}")
        path, status = self._path(photo), None
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
            try:
                status = os.fstat(descriptor)
                return read_entry(descriptor, self._identity_digest, bytes.fromhex(photo), rows)
            finally:
                os.close(descriptor)
        except FileNotFoundError:
            return None
        except (BadEntry, OSError) as error:
            if isinstance(error, BadEntry) or error.errno not in PASSING_ERRORS:
                self._discard(path, status, error)
            return None

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
        path = self._path(photo)
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
        if time.monotonic() < self._retry_at:
            return False
        size = entry_bytes(*inverse_depth.shape)
        temporary = f"{path.removesuffix('.depth')}.{os.urandom(8).hex()}.tmp"
        descriptor = None
        try:
            descriptor = self._begin(temporary, size)
            if descriptor is None:
                return False
            offset = 0
            for part in pack_entry(self._identity_digest, bytes.fromhex(photo), inverse_depth, confidence, float(consistency)):
                left = memoryview(part)
                while left:
                    count = os.pwrite(descriptor, left, offset)
                    left, offset = left[count:], offset + count
            with open_ledger(self.folder) as ledger:
                replaced = charge(os.lstat(path).st_size) if os.path.lexists(path) else 0
                os.replace(temporary, path)
                ledger.release(min(replaced, charge(size)))
            return True
        except OSError as error:
            self._retry_at = time.monotonic() + RETRY_SECONDS
            self._warn_once(
                f"the depth cache in {self.folder} takes no new entries for now: {error}; {_cure(error)}. Until then depth that is "
                "not in it is estimated anew in every epoch."
            )
            return False
        finally:
            if descriptor is not None:
                self._end(temporary, descriptor, size)

    def _path(self, photo: str) -> str:
        if not PHOTO_DIGEST.fullmatch(photo):
            raise ValueError(f"a photo is named by photo_digest(data), 64 hexadecimal digits; got {photo!r}")
        return os.path.join(self._shelf, f"{photo}.depth")

    def _open_folder(self) -> None:
        """Makes the folder, tries to write it, and removes what killed processes left in it."""
        os.makedirs(self.folder, exist_ok=True)
        with suppress(TimeoutError), open_ledger(self.folder) as ledger:  # held: by a process that counts a large folder, most likely
            ledger.count_if_due()
            self._make_shelf(ledger)
        trial = f"{self._path('0' * 64).removesuffix('.depth')}.{os.urandom(8).hex()}.tmp"
        if os.path.isdir(self._shelf):
            os.close(os.open(trial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
            with suppress(FileNotFoundError):  # another process may take it for a leftover, and be right
                os.unlink(trial)

    def _make_shelf(self, ledger: Ledger) -> bool:
        """The folder of this estimator and the text in it that says whose it is; False where the cache is full."""
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
        """A file of `size` bytes to be filled, open and locked while its writer lives; None where the cache is full."""
        with open_ledger(self.folder) as ledger:
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
            if os.path.lexists(temporary):
                with open_ledger(self.folder) as ledger:  # both at once: between them a count would be taken off twice
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
            f"the depth cache in {self.folder} holds an entry that cannot be used, {os.path.basename(path)}: {reason}. It is removed and "
            "stored anew where possible; further ones are not reported.",
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
        message = (
            f"the depth cache in {self.folder} has no room for another {_said(charge(size))}: it holds {_said(ledger.held_bytes)} of at "
            f"most {_said(self.max_bytes)}. Depth that is not in it is estimated anew in every epoch. Give a larger depth_cache_bytes"
        )
        others = [shelf for shelf in shelves(self.folder) if shelf != self._shelf]
        if not others:
            return message + "."
        return message + ", or remove what another estimator left: " + "; ".join(map(_described, others)) + "."

    def _warn_once(self, message: str, kind: str = "storing") -> None:
        if kind not in self._told:
            self._told.add(kind)
            logger.warning(message)


def _described(shelf: str) -> str:
    """A folder of the cache, its estimator and its size."""
    try:
        with open(os.path.join(shelf, IDENTITY_NAME), encoding="utf-8", errors="replace") as file:
            identity = file.read(200).strip()
    except OSError:
        identity = "unknown"
    return f"{shelf} ({identity}, {_said(count_shelf(shelf))})"


def _said(count: int) -> str:
    return f"{count / 1e9:.2f} GB" if count >= 1e9 else f"{count / 1e6:.2f} MB"


def _cure(error: OSError) -> str:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "free space on its disk"
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return "make it writable for this user, or give another folder"
    if isinstance(error, TimeoutError):
        return f"look for a stopped process that uses it (fuser {LEDGER_NAME})"
    return "give another folder, on a file system that can lock files"
