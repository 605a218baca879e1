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
    words = [word for number in (seed, epoch, index, crc32(purpose.encode())) for word in _words(number)]
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(np.array(words, np.uint32))))


def _words(number: int) -> list[int]:
    """Its 32-bit words from the lowest on, as SeedSequence takes whole numbers apart, in half the time that it takes."""
    return [number] if number < 2**32 else [number % 2**32, *_words(number >> 32)]
