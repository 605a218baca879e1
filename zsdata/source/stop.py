"""Reads that nobody waits for any more are broken off."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

_of_thread = threading.local()


class Stopped(Exception):
    """A read was broken off, see `stoppable`."""


@contextmanager
def stoppable(stop: threading.Event) -> Iterator[None]:
    """Between here and the end of the block, the reads of this thread raise Stopped soon after `stop` is set."""
    _of_thread.stop = stop
    try:
        yield
    finally:
        del _of_thread.stop


def check_stop() -> None:
    """Raises Stopped where this thread's reads are to end."""
    stop = _stop()
    if stop is not None and stop.is_set():
        raise Stopped


def pause(seconds: float) -> None:
    """Sleeps, but not through a stop."""
    stop = _stop()
    if stop is None:
        time.sleep(seconds)
    elif stop.wait(seconds):
        raise Stopped


def _stop() -> threading.Event | None:
    return getattr(_of_thread, "stop", None)
