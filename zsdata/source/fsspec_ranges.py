"""Ranges of a shard behind what fsspec opens (s3, gs, hf, memory, ...): one try, every fault in our own words."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from fsspec.core import url_to_fs

from zsdata.source import retry
from zsdata.source.retry import MISSING_CURE, REFUSED_CURE, MissingShard, RefusedShard, RemoteFault, Stamp, fault_of_status
from zsdata.source.stop import check_stop
from zsdata.source.time_limit import within
from zsdata.source.urls import without_secrets

PIECE_BYTES = 1 << 20  # asked for at a time: fsspec does not say how far it is, so a piece is what has to come within the stall limit
RECHECK_SECONDS = 60.0  # a shard that was looked at for so long is looked at again; each look is a request
STAMP_NAMES = ("ETag", "etag", "Content-MD5", "md5Hash", "Last-Modified", "LastModified", "updated", "blob_id", "mtime", "created")

_systems: dict[str, tuple[int, Any, str]] = {}  # by url: the process, its file system and the path in it
_looked: dict[str, tuple[float, Stamp]] = {}  # when, and what it was


def look_anew(url: str) -> None:
    """The next read looks at the shard, whenever it was looked at before."""
    _looked.pop(url, None)


def fetch_fsspec(url: str, offset: int, size: int, data: bytearray, check: Callable[[Stamp], None]) -> bool:
    """One try to read a range, see `retry.Fetch`.

    The shard is looked at before the first read of a process, after RECHECK_SECONDS, and around a read that takes several requests.
    """
    several = size > PIECE_BYTES or bool(data)
    limit = time.monotonic() + retry.STALL_SECONDS
    file_system, path = _opened(url, limit)
    stamp = _look(url, file_system, path, limit, again=several)
    check(stamp)
    total = stamp["size"]
    assert isinstance(total, int)
    end = min(offset + size, total)
    while offset < end:
        check_stop()
        stop = min(end, offset + PIECE_BYTES)
        piece = _call(lambda start=offset, stop=stop: file_system.cat_file(path, start=start, end=stop), limit)
        limit = time.monotonic() + retry.STALL_SECONDS
        if len(piece) > stop - offset:
            raise RemoteFault("the server ignores ranges", again=False, cure="download the shard or use another server")
        data += piece
        if len(piece) < stop - offset:
            raise RemoteFault("the connection ends too early", again=True)
        offset = stop
    if several:
        check(_look(url, file_system, path, limit, again=True))
    return end == total


def _opened(url: str, limit: float) -> tuple[Any, str]:
    """The file system of a url and the path in it; a forked process gets its own."""
    process, file_system, path = _systems.get(url, (0, None, ""))
    if process != os.getpid():
        try:
            file_system, path = _call(lambda: url_to_fs(url), limit)
        except ImportError as error:
            raise ImportError(
                f'{without_secrets(f"{url}: {error}")}; pip install "zsdata[remote]" brings what s3, gs and hf need'
            ) from None
        _systems[url] = os.getpid(), file_system, path
    return file_system, path


def _look(url: str, file_system: Any, path: str, limit: float, *, again: bool) -> Stamp:
    """The stamp of a shard, as it is now or, without `again`, as it was a short time ago."""
    seconds, stamp = _looked.get(url, (0.0, {}))
    if again or not stamp or time.monotonic() - seconds > RECHECK_SECONDS:

        def look() -> Any:
            file_system.invalidate_cache(path)
            return file_system.info(path)

        info = _call(look, limit)
        size = info.get("size")
        if not isinstance(size, int):
            raise RemoteFault("the server does not say how large the file is", again=False, cure="download the shard")
        name = next((name for name in STAMP_NAMES if info.get(name)), None)
        stamp = {"size": size} if name is None else {"size": size, name: str(info[name])}
        _looked[url] = time.monotonic(), stamp
    return stamp


def _call(call: Callable[[], Any], limit: float) -> Any:
    try:
        return within(max(0.0, limit - time.monotonic()), call)
    except ImportError:
        raise
    except Exception as error:
        raise _fault_of(error) from None


def _fault_of(error: Exception) -> RemoteFault:
    """What an exception of a file system means for the next try. Each library has its own, so they are known by what they carry."""
    if isinstance(error, FileNotFoundError):
        return RemoteFault("not found", again=False, cure=MISSING_CURE, error=MissingShard)
    if isinstance(error, PermissionError):
        return RemoteFault("access is refused", again=False, cure=REFUSED_CURE, error=RefusedShard)
    for cause in _causes(error):
        status, headers = _answer_in(cause)
        if status is not None:
            return fault_of_status(status, headers)
        if "Credential" in type(cause).__name__:  # botocore, google.auth: there are none, or half of them
            return RemoteFault(_named(cause), again=False, cure="sign in, or give the credentials of this bucket", error=RefusedShard)
    if isinstance(error, TimeoutError):
        return RemoteFault("stalled", again=True)
    ours = isinstance(error, (TypeError, ValueError, AttributeError, LookupError, NotImplementedError, AssertionError))
    return RemoteFault(_named(error), again=not ours, cure="check the url and the file system's packages" if ours else retry.RUN_AGAIN)


def _causes(error: BaseException) -> Iterator[BaseException]:
    """An error and what it came from."""
    cause: BaseException | None = error
    for _ in range(10):
        if cause is None:
            return
        yield cause
        cause = cause.__cause__ or cause.__context__


def _answer_in(error: BaseException) -> tuple[int | None, Mapping[str, str]]:
    """Status and headers of the answer that an exception of aiohttp, gcsfs, requests, httpx or botocore carries."""
    response: Any = getattr(error, "response", None)
    if isinstance(response, Mapping):  # botocore
        metadata = response.get("ResponseMetadata") or {}
        status, headers = metadata.get("HTTPStatusCode"), metadata.get("HTTPHeaders")
    else:
        statuses = (getattr(place, name, None) for place in (error, response) for name in ("status", "code", "status_code"))
        status = next((status for status in statuses if isinstance(status, int) and 300 <= status < 600), None)
        headers = getattr(error, "headers", None) or getattr(response, "headers", None)
    found = {str(name): str(value) for name, value in dict(headers or {}).items()}
    return (status if isinstance(status, int) and status >= 300 else None), found


def _named(error: BaseException) -> str:
    """An error of another library on one line, short and without secrets."""
    text = " ".join(without_secrets(str(error)).split())
    return f"{type(error).__name__}: {text[:200]}" if text else type(error).__name__
