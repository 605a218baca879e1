"""A call that nobody waits for longer than they said."""

from __future__ import annotations

import threading
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import TypeVar

Result = TypeVar("Result")


def within(seconds: float, call: Callable[[], Result]) -> Result:
    """What `call()` returns or raises.

    It runs in a thread of its own (0.1 ms), which a call that never returns keeps to itself: neither this one nor the end of the process
    waits for it. So a name server or a library without a time limit cannot stop anybody.

    Raises:
        TimeoutError: `seconds` have passed.
    """
    outcome: SimpleQueue[tuple[Callable[[], Result], BaseException | None]] = SimpleQueue()

    def run() -> None:
        try:
            result = call()
        except BaseException as error:
            outcome.put((call, error))
        else:
            outcome.put((lambda: result, None))

    threading.Thread(target=run, name="zsdata remote read", daemon=True).start()
    error = None
    try:
        result, error = outcome.get(timeout=seconds)
        if error is not None:
            raise error
        return result()
    except Empty:
        raise TimeoutError(f"no answer for {seconds:.3g} s") from None
    finally:
        error = None  # its traceback knows this frame: nothing in it would be closed before the next garbage collection
