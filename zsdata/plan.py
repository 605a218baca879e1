"""Which photo is sample i of epoch e: sources, weights, order and spares, all by arithmetic, nothing by memory."""

from __future__ import annotations

import hashlib
import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from typing import NamedTuple


class Choice(NamedTuple):
    """A photo: which source, and which of its photos."""

    source: int
    member: int


class Shuffle:
    """A pseudo-random permutation of 0..size - 1 that is computed, not stored: any place in constant time and memory.

    A Feistel network over the next even power of two, walked until it falls into the range (at most four tries on average).
    """

    ROUNDS = 6

    def __init__(self, size: int, *key: int | str) -> None:
        if size < 1:
            raise ValueError(f"a permutation needs at least one element; got {size}")
        self.size = size
        self._half_bits = max(1, math.ceil(((size - 1).bit_length()) / 2))
        digest = hashlib.blake2b(repr(key).encode(), digest_size=8 * self.ROUNDS).digest()
        self._keys = [int.from_bytes(digest[8 * i : 8 * i + 8], "little") for i in range(self.ROUNDS)]

    def __call__(self, place: int) -> int:
        if not 0 <= place < self.size:
            raise IndexError(f"place {place} of a permutation of {self.size}")
        while True:
            place = self._scramble(place)
            if place < self.size:
                return place

    def _scramble(self, place: int) -> int:
        mask = (1 << self._half_bits) - 1
        high, low = place >> self._half_bits, place & mask
        for key in self._keys:
            high, low = low, high ^ (_mix(low ^ key) & mask)
        return high << self._half_bits | low


@lru_cache(maxsize=256, typed=True)  # a key of another type is another shuffle, whatever was asked for before
def _shuffle(size: int, *key: int | str) -> Shuffle:
    """Those of an epoch, which all its samples ask for."""
    return Shuffle(size, *key)


def _mix(value: int) -> int:
    """A 64-bit finalizer (the constants are splitmix64's): every bit of the result depends on every bit of the value."""
    value = (value ^ (value >> 30)) * 0xBF58476D1CE4E5B9 & 0xFFFFFFFFFFFFFFFF
    value = (value ^ (value >> 27)) * 0x94D049BB133111EB & 0xFFFFFFFFFFFFFFFF
    return value ^ (value >> 31)


@dataclass(frozen=True)
class EpochPlan:
    """The order of photos while one set of sources is in use.

    Every source gives a fixed number of photos per epoch (its `quota`) and goes through all its photos before it repeats one; the
    sources are mixed by one permutation of the epoch. Samples k i to k i + k - 1 are made from one photo, so that whoever makes them
    one after another decodes it once.

    Args:
        seed: of the whole stream.
        names: of the sources; a source keeps its order whatever stands beside it.
        sizes: photos per source.
        quotas: photos per source and epoch.
        samples_per_photo: k.
        samples: per epoch, where the last photo gives fewer than the others.
    """

    seed: int
    names: tuple[str, ...]
    sizes: tuple[int, ...]
    quotas: tuple[int, ...]
    samples_per_photo: int = 1
    samples: int | None = None

    @property
    def epoch_size(self) -> int:
        """Samples per epoch."""
        return self.samples if self.samples is not None else sum(self.quotas) * self.samples_per_photo

    def choose(self, epoch: int, index: int) -> Choice:
        """The photo of sample `index` of `epoch`."""
        if not 0 <= index < self.epoch_size:
            raise IndexError(f"sample {index} of an epoch of {self.epoch_size}")
        place = _shuffle(sum(self.quotas), self.seed, "mix", epoch)(index // self.samples_per_photo)
        ends = list(accumulate(self.quotas))
        source = bisect_right(ends, place)
        turn = epoch * self.quotas[source] + place - (ends[source] - self.quotas[source])
        rounds, position = divmod(turn, self.sizes[source])
        return Choice(source, _shuffle(self.sizes[source], self.seed, "order", self.names[source], rounds)(position))

    def spare(self, epoch: int, index: int, attempt: int) -> Choice | None:
        """The photo that stands in when the first choice and `attempt` spares before it could not be used; None when all have been tried.

        From the same source, so that the mixture stays as it is."""
        chosen = self.choose(epoch, index)
        others = self.sizes[chosen.source] - 1
        if attempt >= others:
            return None
        other = Shuffle(others, self.seed, "spare", epoch, index // self.samples_per_photo)(attempt)
        return Choice(chosen.source, other + (other >= chosen.member))


def quotas_for(sizes: Sequence[int], weights: Sequence[float | None], photos: int | None) -> tuple[int, ...]:
    """Photos per source and epoch.

    Args:
        sizes: photos per source.
        weights: relative shares; a source without one weighs as many photos as it has. Either all have one or none.
        photos: per epoch, shared out by largest remainder; None is one exact pass over all photos, whatever the weights.
    """
    if photos is None:
        return tuple(sizes)
    if any(weight is None for weight in weights) and any(weight is not None for weight in weights):
        raise ValueError(f"give every source a weight or none; got {list(weights)}")
    shares = [float(size) if weight is None else float(weight) for size, weight in zip(sizes, weights, strict=True)]
    if not all(math.isfinite(share) and share >= 0 for share in shares) or not sum(shares) > 0:
        raise ValueError(f"weights are finite, >= 0 and not all 0; got {list(weights)}")
    exact = [photos * share / sum(shares) for share in shares]
    quotas = [math.floor(value) for value in exact]
    by_remainder = sorted(range(len(sizes)), key=lambda i: (quotas[i] - exact[i], i))
    for i in by_remainder[: photos - sum(quotas)]:
        quotas[i] += 1
    return tuple(quotas)
