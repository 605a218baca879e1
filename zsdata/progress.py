"""Progress bars that no other process can stop."""

from __future__ import annotations

import os
import threading

from tqdm import tqdm


class Progress(tqdm):
    """A tqdm bar with a lock of this process.

    tqdm's own is one for all processes that were forked since its first bar: where one of them is killed while it draws, all others wait
    for good at their next bar.
    """


def use_own_lock(bars: type[tqdm]) -> None:
    """Gives bars of this type a lock of this process, in place of one that may never be free again."""
    bars.set_lock(threading.RLock())


use_own_lock(Progress)
os.register_at_fork(after_in_child=lambda: use_own_lock(Progress))  # another thread may have held the parent's
