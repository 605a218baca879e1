"""Ranges of a shard behind http or https: one try, every answer understood.

Not by way of fsspec: its reader takes in the whole body where a server ignores ranges, keeps the headers (tag, Retry-After) to itself, and
needs a thread that does not survive a fork. This one keeps connections open, checks on each answer that the shard is still the same, and
needs no other package.
"""

from __future__ import annotations

import base64
import os
import re
import socket
import ssl
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from http.client import HTTPConnection, HTTPException, HTTPResponse, HTTPSConnection
from typing import Any
from urllib.parse import SplitResult, quote, unquote, urljoin, urlsplit
from urllib.request import getproxies, proxy_bypass

from zsdata.source import retry
from zsdata.source.retry import RemoteFault, Stamp, fault_of_status
from zsdata.source.stop import check_stop
from zsdata.source.time_limit import within
from zsdata.source.urls import HTTP

CHUNK_BYTES = 1 << 20  # the most that is taken from a connection at a time
MOST_REDIRECTS = 5  # a hub's resolve address and its delivery network need two
MOST_REDIRECT_BYTES = 1 << 16  # a longer page is not read to its end
IDLE_CONNECTIONS = 16  # per process, as many as threads ask at once
IDLE_SECONDS = 30.0  # what was unused for longer may have been dropped on the way without a word
USER_AGENT = "zsdata"
_QUOTED = "/%:@!$&'()*+,;=~?-._[]"  # left as they are in a path and its query
_CONTENT_RANGE = re.compile(r"bytes\s+(\d{1,18})-(\d{1,18})/(\d{1,18}|\*)\s*")
_UNSATISFIED = re.compile(r"bytes\s+\*/(\d{1,18})\s*")

_IGNORED = RemoteFault(
    "the server ignores ranges",
    again=False,
    cure="download the shard or use another server (nginx, Apache and all buckets know ranges; `python -m http.server` does not)",
)
_SIZE_UNKNOWN = RemoteFault("the server does not say how large the file is", again=False, cure="download the shard or use another server")


class _Connection:
    """One open connection, and how requests are written for it."""

    def __init__(self, parts: SplitResult) -> None:
        self._broken_off = False
        self._answer: HTTPResponse | None = None
        host, secure = parts.hostname or "", parts.scheme == "https"
        proxy = None if proxy_bypass(parts.netloc.rpartition("@")[2]) else getproxies().get(parts.scheme)
        self.by_proxy: dict[str, str] = {}  # headers for the proxy; the whole address goes to it too
        self.absolute = bool(proxy) and not secure
        kind: Any = _secure if secure else HTTPConnection
        if not proxy:
            self.http = kind(host, parts.port, timeout=retry.STALL_SECONDS)
            return
        way = urlsplit(proxy if "://" in proxy else f"http://{proxy}")
        self.http = kind(way.hostname or "", way.port or 80, timeout=retry.STALL_SECONDS)
        if secure:
            self.http.set_tunnel(host, parts.port, headers=_credentials(way, "Proxy-Authorization"))
        else:
            self.by_proxy = _credentials(way, "Proxy-Authorization")

    def ask(self, parts: SplitResult, headers: dict[str, str]) -> tuple[HTTPResponse, socket.socket]:
        """The answer to a GET, up to its headers, and the socket that its body comes from."""
        target = quote(parts.path or "/", safe=_QUOTED) + (f"?{quote(parts.query, safe=_QUOTED)}" if parts.query else "")
        if self.absolute:
            target = f"http://{parts.netloc.rpartition('@')[2]}{target}"
        if self.http.sock is None:
            self.http.connect()
        channel: Any = self.http.sock  # the connection forgets it where the answer is to be the last one
        self.http.request("GET", target, headers={**headers, **self.by_proxy})
        answer = self._answer = self.http.getresponse()
        if self._broken_off:
            self.break_off()
        return answer, channel

    def break_off(self) -> None:
        """Closes the connection, also one that another thread still asks."""
        self._broken_off = True
        with suppress(OSError, AttributeError):
            self.http.sock.shutdown(socket.SHUT_RDWR)
        if self._answer is not None:
            self._answer.close()
        self.http.close()


_Origin = tuple[str, str]  # protocol; host and port, with the user if there is one
_idle: deque[tuple[_Origin, float, _Connection]] = deque()  # and since when


def close_connections() -> None:
    """Closes what is kept open between reads. A forked process begins with it: a connection has one owner."""
    while _idle:
        _idle.pop()[2].http.close()


os.register_at_fork(after_in_child=close_connections)


def fetch_http(url: str, offset: int, size: int, data: bytearray, check: Callable[[Stamp], None]) -> bool:
    """One try to read a range, see `retry.Fetch`."""
    limit = time.monotonic() + retry.STALL_SECONDS
    headers = {"Range": f"bytes={offset}-{offset + size - 1}", "Accept-Encoding": "identity", "User-Agent": USER_AGENT}
    try:
        for _ in range(MOST_REDIRECTS + 1):
            parts = urlsplit(url)
            connection, response, channel = _open(parts, headers, limit)
            try:
                if response.status not in (301, 302, 303, 307, 308):
                    return _take(response, channel, offset, size, data, check, limit)
                if response.length is not None and response.length <= MOST_REDIRECT_BYTES:
                    _take_bytes(response, channel, response.length, bytearray(), limit)
            finally:
                _keep(parts, connection, response)
            url = urljoin(url, response.headers.get("Location", ""))
            if urlsplit(url).scheme not in HTTP or (parts.scheme == "https" and not url.startswith("https:")):
                raise RemoteFault("it redirects to what is not https", again=False, cure="use the other address if you trust it")
        raise RemoteFault(f"it redirects more than {MOST_REDIRECTS} times", again=False, cure="check the address")
    except ssl.SSLCertVerificationError as error:
        raise RemoteFault(
            f"the server's certificate is not trusted ({error.verify_message})",
            again=False,
            cure="check the address, and the machine's clock and certificates (SSL_CERT_FILE)",
        ) from None
    except TimeoutError:
        raise RemoteFault(f"stalled for {retry.STALL_SECONDS:g} s", again=True) from None
    except socket.gaierror as error:
        raise RemoteFault(f"its host is not known ({error.strerror})", again=True, cure="check the host and the network") from None
    except (OSError, HTTPException) as error:
        raise RemoteFault(_named(error), again=True) from None
    except ValueError:
        raise RemoteFault("it leads to an address that cannot be used", again=False, cure="check the address") from None


def _open(parts: SplitResult, headers: dict[str, str], limit: float) -> tuple[_Connection, HTTPResponse, socket.socket]:
    """The answer, up to its headers, by a connection that was kept if one still lives."""
    headers = headers | _credentials(parts, "Authorization")
    while True:
        kept = _kept((parts.scheme, parts.netloc))
        connection = _Connection(parts) if kept is None else kept
        try:
            response, channel = within(max(0.01, limit - time.monotonic()), lambda it=connection: it.ask(parts, headers))
            return connection, response, channel
        except BaseException as error:
            connection.break_off()
            if kept is None or not isinstance(error, (ConnectionError, HTTPException)):
                raise  # else the server has closed it meanwhile, which is no fault


def _kept(origin: _Origin) -> _Connection | None:
    for _ in range(len(_idle)):
        try:
            kept = _idle.popleft()
        except IndexError:  # another thread was faster
            return None
        if time.monotonic() - kept[1] > IDLE_SECONDS:
            kept[2].http.close()
        elif kept[0] == origin:
            return kept[2]
        else:
            _idle.append(kept)
    return None


def _keep(parts: SplitResult, connection: _Connection, response: HTTPResponse) -> None:
    """Keeps a connection for the next read where nothing is left in it; closes it otherwise."""
    if not response.isclosed() or connection.http.sock is None:
        response.close()
        connection.http.close()
        return
    _idle.append(((parts.scheme, parts.netloc), time.monotonic(), connection))
    if len(_idle) > IDLE_CONNECTIONS:
        _idle.popleft()[2].http.close()


def _take(
    response: HTTPResponse,
    channel: socket.socket,
    offset: int,
    size: int,
    data: bytearray,
    check: Callable[[Stamp], None],
    limit: float,
) -> bool:
    """The body of an answer that has one of the shard; whether the shard ends with it."""
    total: int | None
    if response.headers.get("Content-Encoding", "identity") != "identity":
        raise RemoteFault("the server compresses what it sends", again=False, cure="make it send .tar files as they are")
    if response.status == 416:
        found = _UNSATISFIED.fullmatch(response.headers.get("Content-Range", ""))
        total = int(found[1]) if found else 0 if offset == 0 else None
        if total is not None and total > offset:
            raise RemoteFault("the server refuses a range that it has", again=True)
        check(_stamp(response, total))
        return True
    if response.status == 206:
        found = _CONTENT_RANGE.fullmatch(response.headers.get("Content-Range", ""))
        if found is None or int(found[1]) != offset or int(found[2]) < offset:
            raise RemoteFault("the server sends another range than asked for", again=True)
        total = None if found[3] == "*" else int(found[3])
        count = min(size, int(found[2]) + 1 - offset)
    elif response.status == 200:  # the whole shard
        if offset:
            raise _IGNORED
        total = response.length
        count = min(size, total or 0)
    else:
        raise fault_of_status(response.status, dict(response.headers))
    if total is None:
        raise _SIZE_UNKNOWN
    check(_stamp(response, total))
    _take_bytes(response, channel, count, data, limit)
    return offset + count >= total


def _take_bytes(response: HTTPResponse, channel: socket.socket, count: int, data: bytearray, limit: float) -> None:
    """Appends the next `count` bytes of the body to `data`; a connection that moves as good as nothing for too long has stalled."""
    recent, left = 0, count
    while left:
        check_stop()
        channel.settimeout(max(0.01, limit - time.monotonic()))
        chunk = response.read1(min(left, CHUNK_BYTES))
        if not chunk:
            raise RemoteFault("the connection ends too early", again=True)
        data += chunk
        left -= len(chunk)
        recent += len(chunk)
        now = time.monotonic()
        if recent >= retry.STALL_BYTES:
            recent, limit = 0, now + retry.STALL_SECONDS
        elif left and now >= limit:
            raise TimeoutError
    channel.settimeout(retry.STALL_SECONDS)
    if response.length == 0:
        response.read()  # nothing: it is closed, and the connection can be used again


def _stamp(response: HTTPResponse, total: int | None) -> Stamp:
    stamp: dict[str, object] = {} if total is None else {"size": total}
    for name in ("ETag", "Last-Modified"):
        value = response.headers.get(name)
        if value:
            return {**stamp, name: value}
    return stamp


def _credentials(parts: SplitResult, header: str) -> dict[str, str]:
    """Basic authentication with the user and password that stand in an address."""
    if parts.username is None:
        return {}
    pair = f"{unquote(parts.username)}:{unquote(parts.password or '')}"
    return {header: "Basic " + base64.b64encode(pair.encode()).decode()}


def _named(error: Exception) -> str:
    if isinstance(error, ConnectionRefusedError):
        return "connection refused"
    if isinstance(error, (ConnectionError, HTTPException)):
        return "connection broken"
    return getattr(error, "strerror", None) or type(error).__name__


def _secure(host: str, port: int | None, timeout: float) -> HTTPSConnection:
    return HTTPSConnection(host, port, timeout=timeout, context=_trust())


@cache
def _trust() -> ssl.SSLContext:
    return ssl.create_default_context()
