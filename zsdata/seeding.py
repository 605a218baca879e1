"""The random numbers of one sample for one purpose."""

from __future__ import annotations

from zlib import crc32

import numpy as np


def rng(seed: int, epoch: int, index: int, purpose: str) -> np.random.Generator:
    """A counter-based generator keyed by what the sample is, never by who makes it.

    The same four values give the same numbers on every rank, worker, retry and machine.

    Args:
        seed, epoch, index: non-negative integers.
        purpose: what the numbers are for ("view", "disparity", "inpaint", ...); each purpose has numbers of its own, so that
            drawing more of one never shifts another.
    """
    key = np.random.SeedSequence([seed, epoch, index, crc32(purpose.encode())])
    return np.random.Generator(np.random.Philox(key))
