"""Reads from far away: what is tried again and for how long, and what is said in the end."""

from __future__ import annotations

import random
import time
from collections import Counter
from collections.abc import Callable, Mapping
from email.utils import parsedate_to_datetime
from http import HTTPStatus
from typing import Protocol

from zsdata.faults import BadShard
from zsdata.source.stop import check_stop, pause
from zsdata.source.urls import shown_url

STALL_SECONDS = 10.0  # one try: to the first bytes, and then from some to the next ones; a healthy bucket answers within 5 s
STALL_BYTES = 16 << 10  # fewer in STALL_SECONDS are as good as none
GIVE_UP_SECONDS = 35.0  # after the first fault; with the stalls of the first and the last try, every fault ends within 60 s
FIRST_PAUSE_SECONDS = 0.1
LONGEST_PAUSE_SECONDS = 5.0
PASSING_STATUSES = {408, 425, 429}  # and 5xx but those that say "never"
LASTING_STATUSES = {501, 505}
MISSING_CURE = "check the address and the range of the braces"
RUN_AGAIN = "run again when the server answers; a saved state goes on where it was"
REFUSED_CURE = "check the credentials, or get a new url if a signed one has expired"

Stamp = Mapping[str, object]  # what changes with a shard: {"size": bytes} and, where it is known, its tag or time


class UnreachableShard(OSError):
    """A shard that could not be read, whatever was tried; not a fault of its bytes, so no photo is refused for it."""


class MissingShard(UnreachableShard, FileNotFoundError):
    """There is no shard at this url."""


class RefusedShard(UnreachableShard, PermissionError):
    """The server does not let this user read the shard."""


class RemoteFault(Exception):
    """One try that failed.

    Args:
        reason: a short phrase, without the url.
        again: whether another try may help.
        cure: what the user can do.
        wait_seconds: the pause that the server asks for.
        error: what the user gets in the end.
    """

    def __init__(
        self,
        reason: str,
        *,
        again: bool,
        cure: str = RUN_AGAIN,
        wait_seconds: float | None = None,
        error: type[UnreachableShard] = UnreachableShard,
    ) -> None:
        super().__init__(reason)
        self.reason = reason
        self.again = again
        self.cure = cure
        self.wait_seconds = wait_seconds
        self.error = error


class ChangedShard(BadShard):
    """The shard is not the one that was listed: its size, tag or time is another."""


class Fetch(Protocol):
    """One try to read a range; a backend is such a function."""

    def __call__(self, url: str, offset: int, size: int, data: bytearray, check: Callable[[Stamp], None]) -> bool:
        """Appends bytes [offset, offset + size) to `data` as they arrive; `check` is given the shard's stamp before.

        Returns:
            Whether the shard ends with what was appended. Otherwise it may be less than asked for, but is not nothing.

        Raises:
            RemoteFault: it failed, perhaps after some bytes.
        """
        ...


def read_patiently(url: str, offset: int, size: int, fetch: Fetch, stamp: Stamp | None = None) -> tuple[bytes, Stamp]:
    """Bytes [offset, offset + size) of a remote shard, or as many as it has, and its stamp. A try goes on where the last one broke off.

    Args:
        size: 1 or more.
        stamp: what the shard was when it was listed; None where that is not known.

    Raises:
        ChangedShard: it is another one now, or became another one between two tries; no byte of the two is ever put together.
        UnreachableShard: MissingShard, RefusedShard or another, within 60 s of the first sign of a fault.
        Stopped: see `stoppable`.
    """
    data = bytearray()

    def check(found: Stamp) -> None:
        nonlocal stamp
        if stamp is not None:
            check_unchanged(url, offset, stamp, found)
        else:
            stamp = found

    faults: Counter[str] = Counter()
    start = give_up_at = time.monotonic()
    while len(data) < size:
        check_stop()
        try:
            if fetch(url, offset + len(data), size - len(data), data, check):
                break
        except RemoteFault as fault:
            now = time.monotonic()
            if not faults:
                give_up_at = now + GIVE_UP_SECONDS
            faults[fault.reason] += 1
            if not fault.again or now >= give_up_at:
                what = f"bytes {offset:,} to {offset + size:,}" + (f" ({len(data):,} of them came)" if data else "")
                raise fault.error(_said(url, what, faults, now - start, fault)) from None
            seconds = min(LONGEST_PAUSE_SECONDS, FIRST_PAUSE_SECONDS * 2 ** min(faults.total() - 1, 30))
            if fault.wait_seconds is not None:
                seconds = max(seconds, fault.wait_seconds)
            # Jitter, so that workers which failed together do not come back together; it changes no byte.
            pause(min(seconds * random.uniform(1.0, 1.5), give_up_at - now))
    assert stamp is not None  # a fetch that returns has said it
    return bytes(data), stamp


def check_unchanged(url: str, offset: int, listed: Stamp, now: Stamp) -> None:
    """Raises ChangedShard where something that both stamps know is another."""
    if listed == now:
        return
    different = [name for name in listed if name in now and listed[name] != now[name]]
    if different:
        changes = ", ".join(f"{name} {_value(listed[name])} then, {_value(now[name])} now" for name in different)
        raise ChangedShard(f"changed since it was listed: {changes}; start again with the shard as it is now", shown_url(url), offset)


def fault_of_status(status: int, headers: Mapping[str, str]) -> RemoteFault:
    """What an HTTP status other than success means for the next try."""
    try:
        reason = f"{status} {HTTPStatus(status).phrase}"
    except ValueError:
        reason = f"status {status}"
    if status in (404, 410):
        return RemoteFault(reason, again=False, cure=MISSING_CURE, error=MissingShard)
    if status in (401, 403, 407):
        return RemoteFault(reason, again=False, cure=REFUSED_CURE, error=RefusedShard)
    if status in PASSING_STATUSES or (status >= 500 and status not in LASTING_STATUSES):
        return RemoteFault(
            reason, again=True, wait_seconds=_wait_of(next((headers[name] for name in headers if name.lower() == "retry-after"), None))
        )
    return RemoteFault(reason, again=False, cure="check the address")


def _wait_of(text: str | None) -> float | None:
    """Seconds that a Retry-After header asks for: a number or a date."""
    if text is None:
        return None
    if text.strip().isdecimal():
        return float(text.strip()[:9])
    try:
        return max(0.0, parsedate_to_datetime(text).timestamp() - time.time())
    except (ValueError, OverflowError):
        return None


def _said(url: str, what: str, faults: Counter[str], seconds: float, last: RemoteFault) -> str:
    if faults.total() == 1:
        tried = last.reason
    else:
        reasons = ", ".join(reason if count == 1 else f"{reason} {count} times" for reason, count in faults.most_common())
        tried = f"tried {faults.total()} times in {seconds:.0f} s: {reasons}"
    return f"{shown_url(url)}: {what} cannot be read: {tried}; {last.cure}"


def _value(value: object) -> str:
    return f"{value:,}" if isinstance(value, int) and value < 1 << 50 else str(value)[:80]
